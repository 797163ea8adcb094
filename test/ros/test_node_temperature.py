"""Temperatures live: the node, and whoever publishes them in a process of its own, over real DDS."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.cli.main import main
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.ros.estimator import diagnostics
from semiparam_ros.ros.estimator.subscriptions import InputStream
from semiparam_ros.settings import Settings, dump_params
from support.arms import ICUB_JOINTS
from support.node_client import PATIENCE_S, Client, NodeProcess, set_stamp
from support.node_helpers import JOINTS
from support.replay_peers import Tool

KIND = 'temperature_friction@r_elbow'
LIVE = Settings(joints=ICUB_JOINTS, outputs='effort', temperatures=('r_elbow',), variant='P', initial_samples=100,
                effects=(f'{KIND}{{"reference_c": 25.0}}',), diagnosis_window=1000.0)


def test_a_robot_that_warms_is_answered_as_offline_and_the_diagnosis_says_why(ros_domain, tmp_path):
    bag = tmp_path / 'a.mcap'
    assert main(['simulate', str(bag), '--outputs', 'effort', '--effect', KIND, '--samples', '1000',
                 '--seed', '3']) == 0
    dump_params(LIVE, tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.connect('effort')
        client.listen(String, 'diagnosis')
        with Tool(tmp_path, 'replay', bag, '--as-fast-as-followed', '--quiet') as played:
            assert played.wait() == 0, played.output
        takeovers = client.take_over()
        loaded = load_samples(bag, LIVE)
        assert np.ptp(loaded.samples.temperature[25:, ICUB_JOINTS.index('r_elbow')]) > 5.0
        learner = OfflineLearner(LIVE, [loaded], lambda: None, takeovers)
        predictions = [learner.step(sample, True) for sample in loaded.samples]
        client.wait(lambda: len(client.heard['predicted_effort']) >= len(predictions), 'the last answer')
        np.testing.assert_array_equal(client.values('predicted_effort'), [each.mean for each in predictions])
        _, _, values = client.report('inputs')
        assert int(values['temperature received']) == 50, 'those of the other joints are ignored'
        assert client.set(effects=[])[0].successful
        answer = client.call(Trigger, 'diagnose', Trigger.Request())
        assert answer.success and 'temperature_friction at r_elbow' in answer.message, answer.message
        client.wait(lambda: client.heard['diagnosis'], 'the diagnosis')
        found = json.loads(client.heard['diagnosis'][-1].data)['effects']
        assert [(each['kind'], each['where']) for each in found] == [('temperature_friction', 'r_elbow')]
        assert node.stop() == 0
    assert 'Traceback' not in node.output and 'internal error' not in node.output


class Listener:
    """What the node is to its inputs."""

    def __init__(self):
        self.samples, self.failed = [], []

    def sample_completed(self, sample):
        self.samples.append(sample)

    def frame_changed(self, frame_id):
        pass

    def described(self, urdf):
        pass

    def clock_jumped(self):
        raise AssertionError('no clock jumped')

    def message_failed(self, topic, error):
        self.failed.append((topic, error))


@pytest.fixture
def ros(ros_domain):
    """A node of this process, and its executor."""
    context = Context()
    rclpy.init(args=[], context=context)
    node = rclpy.create_node('robot', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    yield node, executor
    node.destroy_node()
    rclpy.shutdown(context=context)


def until(executor, condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.05)


def test_a_temperature_that_stops_coming_is_told_and_samples_go_on_with_the_last(ros, monkeypatch):
    monkeypatch.setattr(diagnostics, 'SILENCE_S', PATIENCE_S)  # a busy machine is no silence of the joint states
    node, executor = ros
    settings, listener = Settings(joints=JOINTS, outputs='effort', temperatures=('b',)), Listener()
    inputs = InputStream(node, settings, listener, executor.create_task)
    inputs.open(JOINTS)
    states = node.create_publisher(JointState, 'joint_states', 10)
    warmth = node.create_publisher(Temperature, 'temperature', 10)
    until(executor, lambda: inputs.publishers('temperature') and inputs.publishers('joint_states'))
    report = diagnostics.InputReport(inputs, diagnostics.Rejections(), print)

    def state(stamp):
        message = JointState(name=list(JOINTS), position=[0.1, 0.2], velocity=[0.0, 0.0], effort=[1.0, 2.0])
        set_stamp(message.header.stamp, stamp)
        count = len(listener.samples)
        states.publish(message)
        until(executor, lambda: len(listener.samples) > count)
        return listener.samples[-1].temperature

    def warm(stamp, value, frame='b'):
        message = Temperature(temperature=value)
        set_stamp(message.header.stamp, stamp)
        message.header.frame_id = frame
        before = inputs.counts['temperature'], inputs.stream.ignored
        warmth.publish(message)
        until(executor, lambda: (inputs.counts['temperature'], inputs.stream.ignored) != before)

    assert np.isnan(state(10**9)).all()
    assert 'temperature' in inputs.topics and 'temperature' not in inputs.needed
    warm(10**9, 31.0)
    warm(10**9, 99.0, 'gripper')
    assert state(2 * 10**9)[1] == 31.0
    assert report.make().message == 'receiving.'
    monkeypatch.setattr(diagnostics, 'TEMPERATURE_SILENCE_S', 0.0)
    found = report.make()
    assert found.level == diagnostics.WARN
    assert found.message == ("no temperature of b for more than 0 s; answers go on with the last one. Ignored: "
                             "temperature at 1.000000000 s is of 'gripper'; expected b.")
    assert state(3 * 10**9)[1] == 31.0
    for _ in range(9):  # a clock of its own that went back says nothing of the robot's
        warm(10**8, 40.0)
    assert state(4 * 10**9)[1] == 31.0 and inputs.stream.faults['backward_stamp'] == 9 and not listener.failed


def test_nothing_is_listened_to_unless_it_is_asked_for(ros):
    node, executor = ros
    inputs = InputStream(node, replace(LIVE, temperatures=()), Listener(), executor.create_task)
    assert inputs.topics == ['joint_states', 'joint_accelerations']
    assert not node.get_subscriptions_info_by_topic('/temperature')
