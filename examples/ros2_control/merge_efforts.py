"""Fills learnt efforts into trajectories for ros2_control's joint_trajectory_controller.

    python examples/ros2_control/merge_efforts.py --ros-args -r ~/out:=/joint_trajectory_controller/joint_trajectory

A trajectory on ``~/in`` goes to the estimator, and on to ``~/out`` with ``effort`` filled in; joints
that the model does not know get 0. It is refused, with a sentence in the log and nothing sent, when
the estimator does not answer within ``patience`` seconds (it has no model yet, or the trajectory
lacks velocities or accelerations), and when an effort would be beyond the limit of the robot
description. Where states are unlike those learnt it is sent with a warning, or refused with
``only_valid``. Trajectories are answered one after another, in their order.
"""

from __future__ import annotations

import time
from collections import deque
from copy import deepcopy

import rclpy
from builtin_interfaces.msg import Duration, Time
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

QUEUE = 100
MOST_POINTS = 10_000


class EffortMerger(Node):
    """One trajectory at a time."""

    def __init__(self) -> None:
        super().__init__('effort_merger')
        estimator = self.declare_parameter('estimator', 'estimator').value
        self._patience = self.declare_parameter('patience', 1.0).value
        self._only_valid = self.declare_parameter('only_valid', False).value
        self._waiting: deque[JointTrajectory] = deque()
        self._asked = JointTrajectory()
        self._due: set[int] = set()
        self._answer: JointTrajectory | None = None
        self._marks: list[dict[str, float]] = []
        self._out = self.create_publisher(JointTrajectory, '~/out', QUEUE)
        self._ask = self.create_publisher(JointTrajectory, 'desired_trajectory', QUEUE)
        self.create_subscription(JointTrajectory, f'{estimator}/feedforward_trajectory', self._answered, QUEUE)
        self.create_subscription(JointState, f'{estimator}/feedforward_status', self._marked, MOST_POINTS)
        self.create_subscription(JointTrajectory, '~/in', self._receive, QUEUE)
        self._timer = self.create_timer(self._patience, self._give_up, autostart=False)

    def _receive(self, trajectory: JointTrajectory) -> None:
        self._waiting.append(trajectory)
        if len(self._waiting) == 1:
            self._send()

    def _send(self) -> None:
        """Ask for the oldest that waits."""
        self._answer, self._marks = None, []
        if self._waiting:
            self._asked = stamped(self._waiting[0], time.time_ns())
            start = nanoseconds(self._asked.header.stamp)
            self._due = {start + nanoseconds(point.time_from_start) for point in self._asked.points}
            self._ask.publish(self._asked)
            self._timer.reset()
        else:
            self._timer.cancel()

    def _answered(self, answer: JointTrajectory) -> None:
        if self._waiting and same_points(answer, self._asked):
            self._answer = answer
            self._perhaps_finish()

    def _marked(self, status: JointState) -> None:
        if nanoseconds(status.header.stamp) in self._due:
            self._marks.append(dict(zip(status.name, status.position, strict=True)))
            self._perhaps_finish()

    def _perhaps_finish(self) -> None:
        """Once the answer and the marks of all its points have come, in whatever order."""
        if self._answer is None or len(self._marks) < len(self._answer.points):
            return
        trajectory, answer = self._waiting.popleft(), self._answer
        limited = sum(mark['limited'] > 0 for mark in self._marks)
        unlike = sum(not mark['valid'] for mark in self._marks) - limited
        if limited:
            self._refuse(f'{limited} of {len(self._marks)} points need efforts beyond the limits of the robot '
                         'description')
        elif unlike and self._only_valid:
            self._refuse(f'{unlike} of {len(self._marks)} points are unlike what was learnt')
        else:
            if unlike:
                self.get_logger().warning(f'{unlike} of {len(self._marks)} points are unlike what was learnt.')
            self._out.publish(merged(trajectory, answer))
        self._send()

    def _give_up(self) -> None:
        if self._waiting:
            self._waiting.popleft()
            self._refuse(f'the estimator has not answered within {self._patience:g} s; its log says why')
            self._send()

    def _refuse(self, reason: str) -> None:
        self.get_logger().error(f'the trajectory is refused: {reason}.')


def nanoseconds(time_of: Time | Duration) -> int:
    return int(time_of.sec) * 10**9 + int(time_of.nanosec)


def stamped(trajectory: JointTrajectory, stamp: int) -> JointTrajectory:
    """A copy with a stamp [ns] of its own, for one that was given up may be answered yet, and planners leave it 0."""
    asked = deepcopy(trajectory)
    asked.header.stamp = Time(sec=stamp // 10**9, nanosec=stamp % 10**9)
    return asked


def same_points(answer: JointTrajectory, trajectory: JointTrajectory) -> bool:
    """Whether a trajectory of the estimator's answers this one."""
    return answer.header.stamp == trajectory.header.stamp and \
        [point.time_from_start for point in answer.points] == [point.time_from_start for point in trajectory.points]


def merged(trajectory: JointTrajectory, answer: JointTrajectory) -> JointTrajectory:
    """The trajectory with the answer's efforts."""
    place = {name: index for index, name in enumerate(answer.joint_names)}
    for point, found in zip(trajectory.points, answer.points, strict=True):
        point.effort = [found.effort[place[name]] if name in place else 0.0 for name in trajectory.joint_names]
    return trajectory


def main() -> None:
    rclpy.init()
    node = EffortMerger()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
