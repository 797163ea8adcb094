"""The topic desired_trajectory and its answers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from semiparam_ros.bags.recording_layout import stamp_ns
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.feedforward import Desired
from semiparam_ros.ros.learner import Learner
from semiparam_ros.ros.messages import ValueMessage

DEPTH = 100


class DesiredTrajectory:
    """Answers every point on ``~/feedforward``, and the trajectory as a whole, efforts filled in, on
    ``~/feedforward_trajectory``.

    :param guarded: runs a function so that its errors end in the log.
    """

    def __init__(self, node: Node, outputs: str, learner: Callable[[], Learner], frame_id: Callable[[], str],
                 guarded: Callable[[Callable[[], None]], None]) -> None:
        self._learner, self._frame_id = learner, frame_id
        kind = WrenchStamped if outputs == 'wrench' else JointState
        self._points = node.create_publisher(kind, '~/feedforward', DEPTH)
        self._trajectory = node.create_publisher(JointTrajectory, '~/feedforward_trajectory', DEPTH)
        node.create_subscription(JointTrajectory, 'desired_trajectory',
                                 lambda message: guarded(lambda: self._answer(message)), DEPTH)

    def _answer(self, message: JointTrajectory) -> None:
        learner = self._learner()
        body, bias = learner.body, learner.tare.bias
        order = joint_order(message.joint_names, body.joints)
        start = stamp_ns(message.header.stamp)
        value = ValueMessage(None if body.outputs == 'wrench' else body.joints)
        answers = []
        for index, point in enumerate(message.points):
            stamp = start + stamp_ns(point.time_from_start)
            answers.append((stamp, Desired(learner.estimator, stamp, *desired_state(point, order, index))))
        for (stamp, desired), point in zip(answers, message.points, strict=True):
            self._points.publish(value.filled(stamp, self._frame_id(), desired.outputs + bias))
            point.effort = desired.efforts[np.argsort(order)].tolist()
        self._trajectory.publish(message)


def joint_order(names: list[str], joints: tuple[str, ...]) -> list[int]:
    """Where our joints are in the message, which must name exactly those; raises SemiparamError otherwise."""
    if sorted(names) != sorted(joints):
        raise SemiparamError(f'desired_trajectory names the joints {", ".join(names) or "none"}; expected '
                             f'{", ".join(joints)}.')
    return [names.index(joint) for joint in joints]


def desired_state(point: JointTrajectoryPoint, order: list[int], index: int) -> list[Array]:
    """Position, velocity and acceleration in our order; raises SemiparamError for a point that lacks one."""
    state = []
    for what in ('positions', 'velocities', 'accelerations'):
        values = np.asarray(getattr(point, what), dtype=float)
        if len(values) != len(order):
            raise SemiparamError(f'point {index} of desired_trajectory has {len(values)} {what} for {len(order)} '
                                 'joints.')
        state.append(values[order])
    return state
