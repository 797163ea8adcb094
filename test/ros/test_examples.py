"""The examples, short: tracking in MuJoCo with the live node, and efforts merged into trajectories."""

import json
import os
import subprocess
import sys
import time
from collections import deque
from copy import deepcopy
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
from builtin_interfaces.msg import Duration, Time
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from support.node_helpers import JOINTS, SETTINGS, URDF, motion

REPOSITORY = Path(__file__).resolve().parents[2]
EXAMPLES = REPOSITORY / 'examples'
LIVE = replace(SETTINGS, acceleration_source='measured', variant='P')


def test_an_arm_in_mujoco_is_driven_by_the_torques_of_the_live_node(ros_domain, tmp_path):
    pytest.importorskip('mujoco', reason='MuJoCo is an extra')
    result = subprocess.run(
        [sys.executable, str(EXAMPLES / 'tracking' / 'tracking.py'), '--urdf',
         str(REPOSITORY / 'config' / 'icub_right_arm.urdf'), '--seconds', '8', '--speed', '8', '--folder',
         str(tmp_path)], capture_output=True, text=True, timeout=240, check=False,
        env={**os.environ, 'PYTHONPATH': str(REPOSITORY)})
    assert result.returncode == 0, result.stdout + result.stderr
    assert 'learnt live' in result.stdout and (tmp_path / 'tracking.png').stat().st_size > 10_000
    found = json.loads((tmp_path / 'tracking.json').read_text())['icub_right_arm']
    first = found['first seconds']
    assert first['learnt'] < first['none'] and first['learnt'] == pytest.approx(first['description'], rel=0.3)


class Merger:
    """The example's node as a process."""

    def __init__(self, *arguments):
        self.process = subprocess.Popen(
            [sys.executable, str(EXAMPLES / 'ros2_control' / 'merge_efforts.py'), '--ros-args', *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def refusal(self):
        """The next sentence by which it refuses a trajectory."""
        return next(line for line in self.process.stdout if 'refused' in line)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


def wish(scale, count=3):
    """A trajectory of the model's joints and a gripper, at some scale of accelerations."""
    points = [JointTrajectoryPoint(positions=[0.1, 0.2, 0.0], velocities=[0.3, 0.1, 0.0],
                                   accelerations=[scale, -scale, 0.0], time_from_start=Duration(nanosec=index * 10**7))
              for index in range(count)]
    return JointTrajectory(joint_names=['b', 'a', 'gripper'], points=points)


def test_what_was_given_up_and_is_answered_late_is_not_taken_for_the_next_one(monkeypatch):
    """Of planners, which leave stamps at 0: the next trajectory was judged by its marks, and sent with its efforts."""
    monkeypatch.syspath_prepend(EXAMPLES / 'ros2_control')
    merge_efforts = import_module('merge_efforts')
    merger = object.__new__(merge_efforts.EffortMerger)
    asked, sent, log = [], [], []
    merger.__dict__.update(
        _waiting=deque(), _answer=None, _marks=[], _patience=1.0, _only_valid=False,
        _ask=SimpleNamespace(publish=asked.append), _out=SimpleNamespace(publish=sent.append),
        _timer=SimpleNamespace(reset=lambda: None, cancel=lambda: None),
        get_logger=lambda: SimpleNamespace(error=log.append, warning=log.append))

    def answer(trajectory, effort, limited):
        found = deepcopy(trajectory)
        for point in found.points:
            point.effort = [effort] * 3
            due = nanoseconds(trajectory.header.stamp) + nanoseconds(point.time_from_start)
            status = JointState(name=['valid', 'limited'], position=[1.0 - limited, limited])
            status.header.stamp = Time(sec=due // 10**9, nanosec=due % 10**9)
            merger._marked(status)
        merger._answered(found)

    nanoseconds = merge_efforts.nanoseconds
    merger._receive(wish(1.0))
    merger._give_up()
    merger._receive(wish(2.0))
    answer(asked[0], 7.0, 0.0)
    assert not sent
    answer(asked[1], 9.0, 1.0)
    assert not sent and '3 of 3 points need efforts beyond the limits' in log[-1]
    merger._receive(wish(3.0))
    answer(asked[2], 5.0, 0.0)
    assert [(each.points[0].effort[0], nanoseconds(each.header.stamp)) for each in sent] == [(5.0, 0)]


def test_efforts_are_merged_into_trajectories_or_refused_in_a_sentence(start_node):
    """Nothing is sent while there is no model, and nothing beyond the limits of the description."""
    node, client = start_node(replace(LIVE, robot_description=URDF.replace('effort="10"', 'effort="6"')))
    client.offer('joint_states', 'joint_accelerations', 'wrench')
    with Merger('-p', 'patience:=2.0') as merger:
        asked = client.node.create_publisher(JointTrajectory, 'effort_merger/in', 10)
        client.wait(asked.get_subscription_count, 'the merger listens')
        client.subscribe(JointTrajectory, '/effort_merger/out')
        client.wait(lambda: client.node.count_publishers('/effort_merger/out')
                    and client.node.count_subscribers('/desired_trajectory') >= 1, 'they have met')
        client.meet()
        asks = []

        def ask_again():
            """Who has found a topic may be found on it only later, and an answer may take longer on a busy machine."""
            if not asks or time.monotonic() - asks[-1] > 2.5:
                asked.publish(wish(0.5))
                asks.append(time.monotonic())

        client.wait_report('feedforward', lambda level, message, values: ask_again() or int(values['withheld']) >= 1)
        assert 'the trajectory is refused: the estimator has not answered within 2 s' in merger.refusal()
        client.play(client.play_window(motion(150), JOINTS, 60), JOINTS)
        refusal, beyond = 'has not answered', 0
        while 'has not answered' in refusal:
            asked.publish(wish(1e3))
            refusal, beyond = merger.refusal(), beyond + 3
        assert 'refused: 3 of 3 points need efforts beyond the limits of the robot description.' in refusal
        client.wait_report('feedforward',
                           lambda level, message, values: int(values['cut to the effort limits']) == beyond)
        asks.clear()
        client.wait(lambda: ask_again() or client.heard['/effort_merger/out'], 'the merged trajectory')
        heard = client.heard['/effort_merger/out']
        assert len(heard) <= len(asks)
        assert all(point.accelerations[0] == 0.5 for each in heard for point in each.points), 'what was refused'
        found = heard[0]
        assert list(found.joint_names) == ['b', 'a', 'gripper'] and len(found.points) == 3
        assert all(point.effort[2] == 0.0 and abs(point.effort[1]) > 0.01 for point in found.points)
        assert found.points[1].positions[0] == 0.1
    assert node.stop() == 0
