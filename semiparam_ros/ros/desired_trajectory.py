"""The topic desired_trajectory and its answers."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from semiparam_ros.bags.alignment import LARGEST
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError, listed
from semiparam_ros.ros.feedforward import Desired
from semiparam_ros.ros.learner import Learner
from semiparam_ros.ros.messages import ValueMessage
from semiparam_ros.ros.replay_stamps import NANOSECONDS
from semiparam_ros.ros.serialised_trajectory import MOST_POINTS, SEQUENCES, Point, TrajectoryReader, TrajectoryWriter

DEPTH = 100
MOST_WAITING = 100
"""Trajectories that may wait for one that is being answered."""
SLICE_S = 0.002
"""How long the points of a trajectory are worked on before samples get their turn."""


class DesiredTrajectory:
    """Answers every point on ``~/feedforward``, and the trajectory as a whole, efforts filled in, on
    ``~/feedforward_trajectory``; a long one in slices, between which samples are answered and learnt.

    :param guarded: runs a function so that its errors end in the log.
    :param later: lets the executor run a function after what has come meanwhile.
    """

    def __init__(self, node: Node, outputs: str, learner: Callable[[], Learner], frame_id: Callable[[], str],
                 guarded: Callable[[Callable[[], None]], None], later: Callable[[Callable[[], None]], object]) -> None:
        self._learner, self._frame_id, self._guarded, self._later = learner, frame_id, guarded, later
        self._work: deque[Iterator[None]] = deque()
        kind = WrenchStamped if outputs == 'wrench' else JointState
        self._points = node.create_publisher(kind, '~/feedforward', MOST_POINTS)
        self._trajectory = node.create_publisher(JointTrajectory, '~/feedforward_trajectory', DEPTH)

        def receive(raw: Any) -> None:
            guarded(lambda: self._receive(raw))

        node.create_subscription(JointTrajectory, 'desired_trajectory', receive, DEPTH, raw=True)

    def _receive(self, raw: bytes) -> None:
        trajectory = TrajectoryReader(raw)
        order = joint_order(trajectory.names, self._learner().body.joints)
        if len(self._work) >= MOST_WAITING:
            raise SemiparamError(f'desired_trajectory: {MOST_WAITING} others wait already to be answered.')
        self._work.append(self._answered(trajectory, order))
        if len(self._work) == 1:
            self._go_on()

    def _go_on(self) -> None:
        """One slice of the oldest trajectory."""
        end = time.monotonic() + SLICE_S
        try:
            for _ in self._work[0]:
                if time.monotonic() > end:
                    break
            else:
                self._work.popleft()
        except BaseException:
            self._work.popleft()
            raise
        finally:
            if self._work:
                self._later(lambda: self._guarded(self._go_on))

    def _answered(self, trajectory: TrajectoryReader, order: Sequence[int]) -> Iterator[None]:
        """Step by step: every point is checked before the first one is answered."""
        points = []
        for index, point in enumerate(trajectory.points()):
            stamp = stamp_of(trajectory.stamp, point, index)
            points.append((stamp, desired_state(point, order, len(trajectory.names), index), point))
            yield
        learner = self._learner()
        joints, is_wrench = learner.body.joints, learner.body.outputs == 'wrench'
        value = ValueMessage(None if is_wrench else joints)
        columns = np.argsort(order)  # our joints as the message orders them
        answer = TrajectoryWriter(trajectory.stamp, trajectory.frame_id, [joints[column] for column in columns])
        for stamp, state, point in points:
            learner = self._learner()
            desired = Desired(learner.estimator, *state)
            outputs = desired.outputs + learner.tare.bias if is_wrench else desired.outputs
            self._points.publish(value.filled(stamp, self._frame_id(), outputs))
            answer.add([part[columns].tolist() for part in (*state, desired.efforts)], point.from_start)
            yield
        self._trajectory.publish(answer.message())


def joint_order(names: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Where our joints are in the message, which may name others too; raises SemiparamError unless each is there once.
    """
    wrong = [joint for joint in joints if names.count(joint) != 1]
    if wrong:
        raise SemiparamError(f'desired_trajectory must name joint {wrong[0]!r} once; it names {listed(names)}.')
    return [names.index(joint) for joint in joints]


def desired_state(point: Point, order: Sequence[int], n_names: int, index: int) -> list[Array]:
    """Position, velocity and acceleration in our order; raises SemiparamError for a point that lacks one."""
    state = []
    for what, values in zip(SEQUENCES[:3], point.values, strict=False):
        if len(values) != n_names:
            raise SemiparamError(f'point {index} of desired_trajectory has {len(values)} {what} for {n_names} joints.')
        chosen = values[order]
        if not (np.abs(chosen) < LARGEST).all():
            raise SemiparamError(f'point {index} of desired_trajectory has {what} {chosen.tolist()}; expected finite '
                                 f'ones within {LARGEST:g}.')
        state.append(chosen)
    return state


def stamp_of(start: int, point: Point, index: int) -> int:
    """Time of a point [ns]; raises SemiparamError for one that no stamp can tell."""
    stamp = start + point.from_start
    if not -2**31 <= stamp // NANOSECONDS < 2**31:
        raise SemiparamError(f'point {index} of desired_trajectory lies at {stamp / NANOSECONDS:g} s, which no header '
                             'can hold; expected a sum of stamp and time_from_start below 2^31 s.')
    return stamp
