"""What others publish on the node's topics: a gripper's joint states, optional accelerations, messages of any size."""

import os
import signal
import time
from dataclasses import replace
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from semiparam_ros.core.robot.urdf import MOST_CHARACTERS
from semiparam_ros.ros.cdr import MOST_BYTES, joint_state_layout
from semiparam_ros.ros.estimator.subscriptions import InputStream
from semiparam_ros.settings import Settings, dump_params
from support.node_client import Client, NodeProcess, children_of, messages, set_stamp
from support.node_fuzz import resident_mb
from support.node_helpers import JOINTS, SETTINGS, URDF, motion
from support.replay_peers import Peer

GRIPPER = ('left_finger', 'right_finger')


def play(client, samples, gripper=False):
    """Joint states with efforts, and the gripper's own between them."""
    for sample in samples:
        if gripper:
            client.state(sample, GRIPPER)
        client.state(sample, JOINTS, effort=sample.position.tolist())
    client.wait(lambda: client.stamps('residual')[-1:] == [samples[-1].stamp], 'every sample is answered')


def test_a_gripper_and_absent_accelerations_are_nothing_to_warn_of(start_node):
    """The node said WARN for good: nothing on the optional topic, and two thousand refusals of a gripper's messages."""
    _, client = start_node(Settings.from_mapping({**SETTINGS.mapping(), 'sensor_frame': '', 'outputs': 'auto',
                                                  'variant': 'P'}))
    client.offer('joint_states')
    samples = motion(220)
    play(client, samples[:60], gripper=True)
    client.wait_report('inputs', lambda level, message, values: values.get('ignored: other_joints') == '60')
    client.forget()
    for sample in samples[60:210]:  # the robot moves while the reports come
        play(client, [sample], gripper=True)
        time.sleep(0.01)
    reports = [(status.level, status.message, {entry.key for entry in status.values}) for heard
               in client.heard['/diagnostics'] for status in heard.status if status.name == 'estimator: inputs']
    assert (DiagnosticStatus.OK, 'receiving.') in [report[:2] for report in reports]
    assert not [report for report in reports if 'accelerations' in report[1] or 'refused' in report[1] + str(report[2])]
    assert len(client.stamps('residual')) == 150
    client.state(samples[210], JOINTS[:1], position=[0.0], velocity=[0.0])
    _, message, _ = client.wait_report('inputs', lambda level, message, values: level == DiagnosticStatus.WARN
                                           and 'refused' in message)
    assert "must name joint 'b' once" in message


def test_a_driver_that_leaves_velocities_empty_after_a_reconnect_is_followed(start_node):
    _, client = start_node(Settings.from_mapping({**SETTINGS.mapping(), 'sensor_frame': '', 'outputs': 'effort',
                                                  'variant': 'P'}))
    client.offer('joint_states')
    samples = motion(350)
    play(client, samples[:100])
    for sample in samples[100:250]:
        client.state(sample, JOINTS, velocity=[], effort=sample.position.tolist())
        time.sleep(0.01)
    # Told while they come: who looks a second later finds that nothing is received any more.
    _, _, values = client.wait_report('inputs', lambda level, message, values: level == DiagnosticStatus.OK and
                                      message == 'receiving; velocities are estimated from the positions.', heard=True)
    assert values['refused: wrong_length'] == '3' and 'before it held velocities' in values['last refusal']
    play(client, samples[250:])
    assert len(client.stamps('residual')) == 347


def test_who_forgets_that_a_robot_has_efforts_alone_is_told(start_node):
    node, client = start_node(replace(SETTINGS, variant='P'))
    client.offer('joint_states')
    for sample in motion(60):
        client.state(sample, JOINTS, effort=sample.position.tolist())
    client.wait_report('inputs', lambda level, message, values: message == (
        'nothing received on wrench yet. The joint states hold efforts: outputs: effort predicts those.'))
    assert 'moves a, b; the wrench at ft is predicted.' in node.output


def test_a_description_that_did_not_fit_is_taken_when_the_settings_do(start_node):
    """A link that is none was an internal error of each status, and the description had to be sent again."""
    node, client = start_node(replace(SETTINGS, robot_description='', external_wrench_frame='hand'))
    client.offer('robot_description')
    client.outputs['robot_description'].publish(String(data=URDF))
    client.wait_report('inputs', lambda level, message, values: (
        "does not fit: link 'hand' is not a link of the robot description" in values['last refusal']))
    assert client.set(gate__enabled=True)[0].successful
    assert client.set(external_wrench__frame='ft')[0].successful
    client.wait_report('learning', lambda level, message, values: message.startswith('gathering'))
    assert client.report('inputs')[2]['refused: robot_description'] == '1', 'said once'
    assert node.stop() == 0
    assert 'internal error' not in node.output


def test_messages_of_any_size_leave_nothing_behind(start_node):
    """A joint state of a million joints left 650 MB; two hundred thousand leave none here."""
    node, client = start_node(replace(SETTINGS, outputs='effort', sensor_frame='', variant='P', robot_description=''))
    client.offer('joint_states', 'robot_description')
    for count in (MOST_CHARACTERS + 1, 5 * MOST_CHARACTERS):
        client.outputs['robot_description'].publish(String(data='<' * count))
        client.wait_report('inputs', lambda level, message, values: f'expected at most {MOST_CHARACTERS}' in values[
            'last refusal'])
    client.outputs['robot_description'].publish(String(data=URDF))
    client.wait_report('learning', lambda level, message, values: message.startswith('gathering'))
    samples = motion(100)
    play(client, samples[:50])
    before = resident_mb(node.process.pid)
    names = [f'joint_{index}' for index in range(200_000)]
    raw = joint_state_layout('', [*JOINTS, *names], 0, 0, 0).write(samples[50].stamp)
    for _ in range(5):
        client.outputs['joint_states'].publish(raw)
    _, _, values = client.wait_report('inputs', lambda level, message, values: values.get(
        'refused: joint_states') == '5')
    assert values['last refusal'] == f'a JointState of {len(raw)} bytes is too long; expected at most {MOST_BYTES}.'
    play(client, samples[50:])
    assert resident_mb(node.process.pid) < before + 60.0
    some = JointState(name=[JOINTS[0], *names[:2000]])
    client.outputs['joint_states'].publish(some)
    _, _, values = client.wait_report('inputs', lambda level, message, values: 'missing_joint' in str(values))
    assert len(values['last refusal']) < 700
    for value in ({'variant': 'x' * 100_000}, {'effects': ['payload@' + 'x' * 100_000]}, {'x' * 100_000: 1}):
        result = client.set(**value)[0]
        assert not result.successful, next(iter(value))[:20]
        assert 0 < len(result.reason) < 700
    assert all(len(line) < 1000 for line in node.output.splitlines())


def test_every_reason_of_a_refusal_is_told_and_not_its_last_consequence_alone(start_node):
    """A NaN in the joint states showed as wrenches that have no joint state."""
    _, client = start_node(replace(SETTINGS, variant='P'))
    client.offer('joint_states', 'wrench')
    another = client.node.create_publisher(JointState, client.outputs['joint_states'].topic, 10)
    client.meet()  # the node knows that there are two
    samples = motion(60)

    def told():
        return ' '.join(status.message for heard in client.heard['/diagnostics'] for status in heard.status
                        if status.name == 'estimator: inputs' and 'refused' in status.message)

    for sample in samples[:20]:
        client.state(sample, JOINTS)
        client.wrench(sample)
    for sample in samples[20:40]:
        client.state(sample, JOINTS, position=[0.0, float('nan')])
        client.wrench(sample)
    for sample in samples[40:]:
        client.state(sample, JOINTS)
        client.wrench(sample)
    client.wait(lambda: client.stamps('residual')[-1:] == [samples[-1].stamp], 'the last is answered')
    # One report may tell of the joint states, and a later one, after the last answer, of the wrenches.
    for sentence in ('not finite', 'has no joint state within the tolerance', '2 publish on joint_states.'):
        client.wait(lambda sentence=sentence: sentence in told(), sentence)
    client.node.destroy_publisher(another)


def test_a_second_publisher_is_told_once_by_its_node(start_node):
    """Zeros of another node between the robot's wrenches were learnt, and nobody said that there are two."""
    node, client = start_node(replace(SETTINGS, variant='P'))
    client.offer('joint_states', 'wrench')
    samples = motion(120)
    for sample in samples[:40]:
        client.state(sample, JOINTS)
        client.wrench(sample)
    assert 'publish on' not in node.output
    with Peer('stranger') as stranger:
        stranger.meet('/estimator')  # which knows its name then
        output = stranger.node.create_publisher(WrenchStamped, client.outputs['wrench'].topic, 10)
        client.wait(lambda: '2 publish on wrench: /client, /stranger. All that' in node.output, 'both are told')
        client.wait(lambda: output.get_subscription_count(), 'it is heard')
        zeros = WrenchStamped()
        set_stamp(zeros.header.stamp, samples[39].stamp)
        zeros.header.frame_id = 'ft'
        output.publish(zeros)
        output.publish(zeros)
        client.wait_report('inputs', lambda level, message, values: values.get('refused: duplicate_stamp') == '2')
    assert node.output.count('[estimator]: refused: wrench has the duplicate stamp') == 1, 'the first one of a kind'
    for sample in samples[40:]:
        client.state(sample, JOINTS)
        client.wrench(sample)
        time.sleep(0.02)
    client.report('learning')
    assert node.output.count('publish on wrench') == 1


def test_publishers_are_told_once_though_a_name_is_discovered_late():
    """On a busy machine '/client, participant 01..' was told, and a second later '/client, /stranger'."""
    def published(*names):
        found = [TopicEndpointInfo(node_name=name, node_namespace='/', endpoint_gid=[1] * 16) for name in names]
        node.get_publishers_info_by_topic = lambda _: found
        return [owners for _, owners in InputStream.newly_shared(inputs)]

    node = SimpleNamespace(resolve_topic_name=lambda topic: topic)
    inputs = SimpleNamespace(topics=['wrench'], publishers=lambda _: 2, _node=node, _seen_owners={}, _owners={})
    late = [published('client', '_NODE_NAME_UNKNOWN_') for _ in range(4)]
    named = [published('client', 'stranger') for _ in range(4)]
    assert (late, named) == ([[]] * 4, [[], [['/client', '/stranger']], [], []])
    unnamed = [published('client', '_NODE_NAME_UNKNOWN_') for _ in range(10)]
    assert [len(each) for each in unnamed] == [0] * 5 + [1] + [0] * 4, 'another vendor has no name at all'


def test_a_strangers_zeros_are_refused_as_another_robots(start_node):
    """They were learnt, and for a minute nothing that changed had a name."""
    _, client = start_node(Settings.from_mapping({**SETTINGS.mapping(), 'sensor_frame': '', 'outputs': 'effort',
                                                  'variant': 'P'}))
    client.offer('joint_states')
    samples = [sample._replace(position=sample.position + 2.0) for sample in motion(200)]
    play(client, samples[:100])
    with Peer('stranger') as stranger:
        zeros = stranger.node.create_publisher(JointState, client.outputs['joint_states'].topic, 10)
        client.wait(lambda: zeros.get_subscription_count(), 'it is heard')
        client.wait_report('inputs', lambda level, message, values: values['joint_states publishers'] == '2')
        for sample in samples[100:]:
            message = JointState(name=list(JOINTS), position=[0.0, 0.0], velocity=[0.0, 0.0], effort=[0.0, 0.0])
            set_stamp(message.header.stamp, sample.stamp - 5_000_000)
            zeros.publish(message)
            time.sleep(0.01)
            client.state(sample, JOINTS, effort=sample.position.tolist())
            time.sleep(0.01)
        _, _, values = client.wait_report('inputs', lambda level, message, values: 'refused: elsewhere' in values)
        client.wait(lambda: len(client.stamps('residual')) >= 200, 'the robot is answered')
    assert set(client.stamps('residual')) == {sample.stamp for sample in samples}
    assert 'this one is of another robot' in values['last refusal']


PATIENT = """
import sys
from semiparam_ros.cli.main import main
from semiparam_ros.ros.estimator import parameters
parameters.PATIENCE_S = 600.0
sys.exit(main(sys.argv[1:]))
"""
"""A node whose replies wait for a model until it ends: within a second the test may not come to end it."""


def test_who_waits_for_a_model_is_answered_when_the_node_ends(ros_domain, tmp_path):
    """The reply was held for the model, and never sent."""
    dump_params(replace(SETTINGS, variant='P'), tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml', program=('-c', PATIENT)) as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'wrench', 'joint_accelerations')
        client.play(motion(100), JOINTS)
        client.take_over()
        for worker in children_of(node.process.pid):
            os.kill(worker, signal.SIGSTOP)
        wish = SetParametersAtomically.Request(parameters=messages({'variant': 'NP-ML'}))
        reply = client.begin(SetParametersAtomically, 'set_parameters_atomically', wish)
        client.wait(lambda: client.get('variant')[0].string_value == 'NP-ML', 'the node knows')
        assert node.stop() == 0
        client.wait(reply.done, 'the answer')
        assert reply.result().result.reason == 'the node ends before the model is there.'
