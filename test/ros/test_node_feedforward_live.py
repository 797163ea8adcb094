"""Desired trajectories over DDS: any stamp, other joints too, a tared sensor, and many points while samples come."""

import signal
import time
from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from semiparam_ros.online.feedforward import STATUS
from semiparam_ros.ros.estimator.desired_trajectory import MOST_POINTS
from support.node_client import KEEP_ALL
from support.node_helpers import BODY, JOINTS, SETTINGS, motion

MANY_POINTS = 1200
"""Half a second of work for the node; the reader's own test has as many as it takes."""
THIS_YEAR_NS = 1_700_000_000_000_000_000
EFFECTS = ('time_delay{"delay_s": 0.0047}', 'payload@ft{"start_s": 0.5}', 'sensor_drift',
           'thermal_drift{"time_constant_s": 2.0}', 'periodic_disturbance{"frequency_hz": 3.0, "directions": 6}',
           'cable_hysteresis@a{"slip": 0.1}', 'terms@tx{"time*abs(dq_b)": 0.01}')
ROW = ([0.4, -0.3], [0.5, 0.2], [1.0, -1.0])


def samples_of_this_year(count):
    return [sample._replace(stamp=sample.stamp + THIS_YEAR_NS) for sample in motion(count)]


def wish(seconds=0, points=1, gripper=True):
    """A trajectory of our joints in another order, with a gripper among them."""
    message = JointTrajectory(joint_names=['b', 'gripper', 'a'] if gripper else ['b', 'a'])
    message.header.stamp.sec = seconds
    message.header.frame_id = 'base'
    columns = [[b, 7.0, a] if gripper else [b, a] for a, b in ROW]
    point = JointTrajectoryPoint(positions=columns[0], velocities=columns[1], accelerations=columns[2])
    message.points = [point] * points
    return message


def listen(client, outputs):
    client.listen(WrenchStamped if outputs == 'wrench' else JointState, 'feedforward')
    client.listen(JointTrajectory, 'feedforward_trajectory')


def await_the_model(client):
    """Until then feedforward is withheld."""
    client.wait_report('learning', lambda level, message, values: message == 'learning with P.')


def answer(client, message):
    """Outputs and efforts of the first point, in the order a, b."""
    before = len(client.heard['feedforward_trajectory'])
    client.outputs['desired_trajectory'].publish(message)
    client.wait(lambda: len(client.heard['feedforward_trajectory']) > before, 'the answer')
    client.wait(lambda: len(client.heard['feedforward']) > before, 'the answers of the points')
    trajectory = client.heard['feedforward_trajectory'][-1]
    assert trajectory.joint_names == ['b', 'a']
    assert trajectory.header == message.header
    point = trajectory.points[0]
    for name, row in zip(('positions', 'velocities', 'accelerations'), ROW, strict=True):
        assert list(getattr(point, name)) == row[::-1]
    return client.values('feedforward')[-1], list(point.effort)[::-1]


def answered_before(node, client, samples):
    """How many samples are answered before a long trajectory that came before them.

    All of it waits for the node, which may answer the trajectory in less time than this process stands still.
    """
    counts = []
    client.node.create_subscription(JointTrajectory, 'estimator/feedforward_trajectory',
                                    lambda _: counts.append(len(client.heard['residual'])), KEEP_ALL)
    client.meet()
    node.process.send_signal(signal.SIGSTOP)
    client.outputs['desired_trajectory'].publish(wish(points=MANY_POINTS, gripper=False))
    for sample in samples:
        client.state(sample, JOINTS)
        client.accelerations(sample, JOINTS)
        client.wrench(sample)
    node.process.send_signal(signal.SIGCONT)
    client.wait(lambda: counts, 'the trajectory is answered')
    return counts[0]


def test_whatever_its_stamp_a_desired_state_is_one_of_now(start_node):
    """Torques of 3e50 N m came of a stamp of zero and a delay of 4.7 ms."""
    node, client = start_node(replace(SETTINGS, variant='P', acceleration_source='measured', effects=EFFECTS))
    listen(client, 'wrench')
    client.listen(JointState, 'feedforward_status')
    client.listen(WrenchStamped, 'feedforward_std')
    client.listen(JointTrajectory, 'feedforward_trajectory_std')
    client.offer('joint_states', 'joint_accelerations', 'wrench', 'desired_trajectory')
    for _ in range(3):
        client.outputs['desired_trajectory'].publish(wish())
    level, message, _ = client.wait_report('feedforward', lambda level, message, values: values['withheld'] == '3')
    assert level == DiagnosticStatus.WARN and message.startswith('3 trajectories withheld: feedforward is withheld')
    _, _, inputs = client.wait_report('inputs', lambda *_: True)
    assert not inputs['last refusal'] and 'refused: desired_trajectory' not in inputs, 'the message is not at fault'
    assert node.output.count('feedforward is withheld') == 1, 'a controller sends many a second'
    assert not client.heard['feedforward'] and not client.heard['feedforward_trajectory']
    assert client.set(feedforward__before_ready='description')[0].successful
    described = BODY.regressor(*map(np.array, ROW)) @ BODY.base_parameters
    for _ in range(2):
        np.testing.assert_allclose(answer(client, wish())[0], described, atol=1e-12)
        time.sleep(1.0)
    assert node.output.count('answered by the robot description alone') == 1, 'a controller sends many a second'
    client.wait(lambda: client.heard['feedforward_status'], 'its marks')
    assert dict(zip(STATUS, client.heard['feedforward_status'][0].position, strict=True))['described'] == 1.0
    client.wait_report('feedforward', lambda level, message, values: values['withheld'] == '3'
                       and level == DiagnosticStatus.OK)
    samples = samples_of_this_year(150)
    client.play(samples, JOINTS)
    await_the_model(client)
    now = samples[-1].stamp // 10**9
    answers = [answer(client, wish(seconds)) for seconds in (now, 0, now - 5, now - 1, now + 3600)]
    for outputs, efforts in answers:
        assert (outputs, efforts) == answers[0]
        assert np.abs(outputs).max() < 3.0 * np.abs(described).max()
        assert np.abs(efforts).max() < 3.0 * np.abs(described).max()
    client.wait(lambda: len(client.heard['feedforward_std']) == len(client.heard['feedforward_status']) == 7, 'marks')
    assert client.heard['feedforward_status'][-1].name == list(STATUS)
    assert client.heard['feedforward_status'][-1].header.stamp == client.heard['feedforward'][-1].header.stamp
    assert min(client.values('feedforward_std')[-1]) > 0.0
    deviations = client.heard['feedforward_trajectory_std'][-1]
    assert deviations.joint_names == ['b', 'a'] and min(deviations.points[0].effort) > 0.0

    client.forget()
    client.outputs['desired_trajectory'].publish(wish(points=MOST_POINTS + 1, gripper=False))
    refusal = f'has {MOST_POINTS + 1} points'
    client.wait_report('inputs', lambda level, message, values: refusal in values['last refusal'])
    later = [sample._replace(stamp=sample.stamp + 10**10) for sample in samples[:20]]
    assert answered_before(node, client, later) == 20, 'samples are answered while a long trajectory is'
    client.wait(lambda: client.heard['feedforward_trajectory'], 'all of it is answered')
    client.wait(lambda: len(client.heard['feedforward']) == MANY_POINTS, 'and every point')
    assert len(client.heard['feedforward_trajectory'][0].points) == MANY_POINTS


def test_a_tare_takes_the_sensors_bias_out_of_the_efforts_on_both_topics(start_node):
    _, client = start_node(replace(SETTINGS, outputs='effort', sensor_frame='', variant='P', forgetting=1.0))
    listen(client, 'effort')
    client.offer('joint_states', 'desired_trajectory')

    def play(samples, bias):
        for sample in samples:
            client.state(sample, JOINTS, effort=[bias + 1.0 * value for value in sample.position])
        client.wait(lambda: client.stamps('residual')[-1:] == [samples[-1].stamp], 'every sample is answered')

    samples = samples_of_this_year(200)
    play(samples[:120], 0.0)
    await_the_model(client)
    assert client.pause(True).success
    before = answer(client, wish())
    play(samples[120:], 5.0)
    tared = client.trigger('tare')
    assert tared.success, tared.message
    outputs, efforts = answer(client, wish())
    assert outputs == efforts
    assert (outputs, efforts) == before
