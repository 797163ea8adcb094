"""Faults in what the node's callbacks call: every call is answered, every fault counted, and the node goes on."""

import time
from dataclasses import replace
from pathlib import Path

from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from semiparam_ros.settings import dump_params
from support.faulty_node import UNLUCKY_STAMP_NS
from support.node_client import Client, NodeProcess
from support.node_helpers import JOINTS, PERIOD_NS, SETTINGS, START_NS, motion

FAULT = 'ZeroDivisionError: a fault put there by a test'


def test_an_error_in_any_callback_is_an_answer_and_a_count_and_never_the_end(tmp_path, ros_domain):
    dump_params(replace(SETTINGS, variant='P', acceleration_source='filter'), tmp_path / 'p.yaml')
    program = [str(Path(__file__).resolve().parents[1] / 'support/faulty_node.py')]
    samples = motion(120)
    assert (UNLUCKY_STAMP_NS - START_NS) % PERIOD_NS == 0
    with NodeProcess(tmp_path, tmp_path / 'p.yaml', program=program) as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'wrench')
        client.wait_report('inputs', lambda _, __, values: values['joint_states publishers'] != '0'
                           and values['wrench publishers'] != '0')  # the node sees them, too
        for sample in samples:
            client.state(sample, JOINTS)
            client.wrench(sample)
        client.wait(lambda: len(client.heard['residual']) == len(samples) - 1, 'all but one are published')
        for service in ('tare', 'diagnose'):
            answer = client.trigger(service)
            assert not answer.success and FAULT in answer.message, service
        for value in (0.9, 0.8):
            answer = client.set(forgetting=value)[0]
            assert not answer.successful and FAULT in answer.reason
            assert client.get('forgetting')[0].string_value == 'auto'
        for sample in samples[:8]:  # the clock goes back, which the learner is to hear of
            client.state(sample, JOINTS)
            client.wrench(sample)
        level, message, counts = client.wait_report('errors', lambda _, __, values: any(
            f'internal errors: {topic}' in values for topic in ('wrench', 'joint_states'))
            and 'internal errors: the status of timing' in values)  # each status is told once a second
        assert level == DiagnosticStatus.ERROR and FAULT in message
        assert counts['internal errors: ~/tare'] == counts['internal errors: ~/diagnose'] == '1'
        assert counts['internal errors: the parameters'] == '2' and counts['internal errors: publishing'] == '1'
        assert answers_on(client, samples)
        assert node.stop() == 0
    log = node.output
    kinds = ('tare', 'diagnose', 'parameters', 'publishing', 'jump of the clock', 'status of timing')
    assert log.count('Traceback (most recent call last)') == len(kinds), 'one for each kind, however often it happens'


def answers_on(client, samples):
    """Whether samples later than all before are answered still."""
    before = len(client.heard['residual'])
    for sample in samples:
        later = sample._replace(stamp=sample.stamp + 10**10)
        client.state(later, JOINTS)
        client.wrench(later)
        time.sleep(0.002)
    client.wait(lambda: len(client.heard['residual']) > before + 100, 'answers go on')
    return True


def test_every_call_with_fields_at_their_ends_is_answered(tmp_path, ros_domain):
    """Types that are none, empty and long names, stamps at the ends of their fields: sentences, no internal errors."""
    dump_params(replace(SETTINGS, variant='P', acceleration_source='filter'), tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'wrench', 'desired_trajectory')
        for number in (*range(11), 99, 255):
            wrong = [Parameter(name=name, value=ParameterValue(type=number)) for name in ('forgetting', 'noise', '')]
            good = Parameter(name='gate.hold', value=ParameterValue(type=3, double_value=0.25 + number / 1000))
            request = SetParameters.Request(parameters=[*wrong, good])
            results = client.call(SetParameters, 'set_parameters', request).results
            assert [result.successful for result in results] == [False] * 3 + [True]
            assert client.get('gate.hold')[0].double_value == 0.25 + number / 1000
            sentences = [result.reason for result in results[:3]]
            for parameters in ([wrong[0]], [good, wrong[1]], [wrong[2], good]):
                request = SetParametersAtomically.Request(parameters=parameters)
                result = client.call(SetParametersAtomically, 'set_parameters_atomically', request).result
                assert not result.successful
                sentences.append(result.reason)
            assert all(sentences) and not any('internal error' in sentence for sentence in sentences), sentences
        assert 'has a value of the type 255' in sentences[0], sentences
        samples = motion(120)
        for seconds, nanoseconds in ((2**31 - 1, 2**32 - 1), (-2**31, 0), (2**31 - 1, 10**9 - 1), (0, 2**32 - 1)):
            stamp = Time(sec=seconds, nanosec=nanoseconds)
            state = JointState(name=list(JOINTS), position=[0.0] * 2, velocity=[0.0] * 2)
            for topic, message in (('joint_states', state), ('wrench', WrenchStamped())):
                message.header.stamp, message.header.frame_id = stamp, 'ft' * (topic == 'wrench')
                client.outputs[topic].publish(message)
            point = JointTrajectoryPoint(positions=[0.0] * 2, velocities=[0.0] * 2, accelerations=[0.0] * 2)
            point.time_from_start = Duration(sec=seconds, nanosec=nanoseconds)
            trajectory = JointTrajectory(joint_names=list(JOINTS), points=[point])
            client.outputs['desired_trajectory'].publish(trajectory)
            trajectory.header.stamp = stamp
            point.time_from_start = Duration(sec=-2**31)
            client.outputs['desired_trajectory'].publish(trajectory)
        assert answers_on(client, samples)
        values = client.wait_report('errors', lambda level, message, values: True)[2]
        assert values['internal errors'] == '0' and 'Traceback' not in node.output
        assert client.wait_report('inputs', lambda level, message, values: True)[2]['refused: out_of_range'] == '2'
        assert node.stop() == 0
