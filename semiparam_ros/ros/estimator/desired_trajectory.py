"""The topic desired_trajectory, read from its bytes, and its answers.

Trajectories read from and written to their bytes, point by point. rclpy decodes a message as a whole: one of ten
thousand points would keep every sample waiting for a third of a second. Here only the head is read at once, in whatever
encoding the sender chose, so that a message that is too long is refused before its points are touched.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from struct import Struct, error, unpack_from
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from semiparam_ros.bags.alignment import END_OF_TIME_NS, LARGEST
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError, listed
from semiparam_ros.online.feedforward import MARKS, STATUS, Feedforward, WithheldError, status
from semiparam_ros.online.learner import Learner
from semiparam_ros.online.worker import Scheduler
from semiparam_ros.ros.cdr import ENCAPSULATION, Layout, joint_state_layout
from semiparam_ros.ros.estimator.publishers import ValueMessage

TOPIC = 'desired_trajectory'
MOST_POINTS = 10_000
MOST_NAMES = 1000
MOST_BYTES = 20_000_000
"""What a trajectory_msgs/JointTrajectory may hold to be answered."""

ENCODINGS = {b'\0\0': ('>', 8), b'\0\1': ('<', 8), b'\0\6': ('>', 4), b'\0\7': ('<', 4)}
"""Byte order, and the most bytes that a number is aligned to, of plain CDR and plain CDR2 by their two first bytes."""

SEQUENCES = ('positions', 'velocities', 'accelerations', 'effort')

DEPTH = 100
MOST_WAITING = 100
"""Trajectories that may wait for one that is being answered."""
SLICE_S = 0.0005
"""How long the points of a trajectory are worked on before samples get their turn."""


class TrajectoryPoint(NamedTuple):
    """One point: ``values`` of positions, velocities, accelerations and effort in this order, as the message has them,
    and the time from the trajectory's start [ns]."""

    values: tuple[Array, ...]
    from_start: int


class TrajectoryReader:
    """Head of a message, and its points one after another.

    Raises SemiparamError for one that is too long, or none.
    """

    def __init__(self, raw: bytes) -> None:
        self._size, self._place, self._raw = len(raw), len(ENCAPSULATION), raw
        try:
            self._order, self._widest = ENCODINGS[bytes(raw[:2])]
            seconds, nanoseconds = self._numbers('iI')
            self.stamp = seconds * NANOSECONDS + nanoseconds
            self.frame_id = self._text()
            count = self._count()
            _limit('names', count, MOST_NAMES)
            self.names = [self._text() for _ in range(count)]
            self.n_points = self._count()
        except (error, KeyError, ValueError) as failure:
            raise self._refusal(failure) from None
        _limit('points', self.n_points, MOST_POINTS)
        _limit('bytes', self._size, MOST_BYTES)
        if not self.stamp < END_OF_TIME_NS:
            raise SemiparamError(f'desired_trajectory has the stamp {self.stamp / NANOSECONDS:g} s; expected one below '
                                 '2^31 s.')

    def points(self) -> Iterator[TrajectoryPoint]:
        """Every point; raises SemiparamError where the message breaks off."""
        for _ in range(self.n_points):
            try:
                values = tuple(self._doubles() for _ in SEQUENCES)
                seconds, nanoseconds = self._numbers('iI')
            except (error, ValueError) as failure:
                raise self._refusal(failure) from None
            yield TrajectoryPoint(values, seconds * NANOSECONDS + nanoseconds)

    def _refusal(self, failure: Exception) -> Exception:
        if isinstance(failure, SemiparamError):
            return failure
        return SemiparamError(f'a message of {self._size} bytes is no JointTrajectory ({type(failure).__name__}).')

    def _align(self, size: int) -> None:
        self._place += -(self._place - len(ENCAPSULATION)) % min(size, self._widest)

    def _numbers(self, code: str) -> tuple[int, ...]:
        self._align(4)
        numbers = unpack_from(f'{self._order}{code}', self._raw, self._place)
        self._place += 4 * len(code)
        return numbers

    def _count(self) -> int:
        return self._numbers('I')[0]

    def _text(self) -> str:
        length = self._count()
        text = self._raw[self._place:self._place + length]
        if len(text) != length:
            raise ValueError('cut off')
        self._place += length
        return text.rstrip(b'\0').decode()

    def _doubles(self) -> Array:
        count = self._count()
        if not count:
            return np.zeros(0)
        self._align(8)
        values = np.frombuffer(self._raw, dtype=f'{self._order}f8', count=count, offset=self._place)
        self._place += 8 * count
        return values.astype(np.float64, copy=False)


class TrajectoryWriter:
    """A message that grows point by point; every point has all values of every joint.

    :param stamp: of the header [ns]. :param joints: names of the columns.
    """

    def __init__(self, stamp: int, frame_id: str, joints: Sequence[str]) -> None:
        head = Layout([frame_id, list(joints)]).write(stamp)
        self._head = head + bytes(-len(head) % 4)
        self._points: list[bytes] = []
        point = f'I{len(joints)}d' * len(SEQUENCES) + 'iI'
        # Points begin on four bytes and their numbers on eight; only the first one may begin between two eights.
        self._first = 4 * ((len(self._head) + 4 - len(ENCAPSULATION)) % 8 > 0)
        self._after_four, self._after_eight = Struct(f'@4x{point}'), Struct(f'@{point}')
        self._n_joints = len(joints)

    def add(self, values: Sequence[Sequence[float]], from_start: int) -> None:
        """One more point: positions, velocities, accelerations and efforts (n_joints,), and its time [ns]."""
        row = [item for column in values for item in (self._n_joints, *column)]
        row += divmod(from_start, NANOSECONDS)
        if self._first and not self._points:
            self._points.append(self._after_four.pack(*row)[4:])
        else:
            self._points.append(self._after_eight.pack(*row))

    def message(self) -> bytes:
        """All points so far."""
        return b''.join([self._head, len(self._points).to_bytes(4, 'little' if ENCAPSULATION[1] else 'big'),
                         *self._points])


def _limit(what: str, count: int, most: int) -> None:
    if count > most:
        raise SemiparamError(f'desired_trajectory has {count} {what}; expected at most {most}.')


class DesiredTrajectory:
    """Answers every point on ``~/feedforward``, and the trajectory as a whole, efforts filled in, on
    ``~/feedforward_trajectory``; a long one in slices, between which samples are answered and learnt.

    Standard deviations stand beside both, and the marks of each point on ``~/feedforward_status``.

    :param failed: receives the topic and what went wrong with a trajectory.
    :param schedule: see :data:`Scheduler`; what has come meanwhile goes first.
    """

    def __init__(self, node: Node, outputs: str, learner: Callable[[], Learner], frame_id: Callable[[], str],
                 failed: Callable[[str, Exception], None], schedule: Scheduler) -> None:
        self._learner, self._frame_id, self._failed, self._schedule = learner, frame_id, failed, schedule
        self._work: deque[Iterator[None]] = deque()
        kind = WrenchStamped if outputs == 'wrench' else JointState
        self.feedforward = Feedforward()
        self._log, self._warned = node.get_logger(), ''
        self._told: set[str] = set()
        self._points = node.create_publisher(kind, '~/feedforward', MOST_POINTS)
        self._std = node.create_publisher(kind, '~/feedforward_std', MOST_POINTS)
        self._status = node.create_publisher(JointState, '~/feedforward_status', MOST_POINTS)
        self._marks = joint_state_layout('', STATUS, len(STATUS), 0, 0)
        self._trajectory = node.create_publisher(JointTrajectory, '~/feedforward_trajectory', DEPTH)
        self._trajectory_std = node.create_publisher(JointTrajectory, '~/feedforward_trajectory_std', DEPTH)
        node.create_subscription(JointTrajectory, TOPIC, self._receive, DEPTH, raw=True)

    def _receive(self, raw: bytes) -> None:
        try:
            self._accept(raw)
        except Exception as error:
            self._failed(TOPIC, error)

    def _accept(self, raw: bytes) -> None:
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
            self._tell_withheld()
        except WithheldError:  # no fault of the message's
            self._work.popleft()
            self._tell_withheld()
        except Exception as error:
            self._work.popleft()
            self._failed(TOPIC, error)
        if self._work:
            self._schedule(self._go_on)

    def _tell_withheld(self) -> None:
        """Once when it begins, and once when trajectories are answered again: a controller sends many a second."""
        if bool(self.feedforward.withheld) != bool(self._warned):
            self._warned, self._told = self.feedforward.withheld, set()
            if self._warned:
                self._log.warning(self._warned)
            else:
                self._log.info('desired trajectories are answered.')

    def _answered(self, trajectory: TrajectoryReader, order: Sequence[int]) -> Iterator[None]:
        """Step by step: every point is checked before the first one is answered."""
        points = []
        for index, point in enumerate(trajectory.points()):
            stamp = stamp_of(trajectory.stamp, point, index)
            points.append((stamp, desired_state(point, order, len(trajectory.names), index), point))
            yield
        learner = self._learner()
        body, is_wrench = learner.body, learner.body.outputs == 'wrench'
        value = ValueMessage(None if is_wrench else body.output_names)
        # Our joints as the message orders them, those whose efforts follow.
        columns = [column for column in np.argsort(order).tolist() if body.joints[column] in body.effort_joints]
        efforts_of = [body.effort_joints.index(body.joints[column]) for column in columns]
        answer, answer_std = (TrajectoryWriter(trajectory.stamp, trajectory.frame_id,
                                               [body.joints[column] for column in columns]) for _ in range(2))
        before = self.feedforward.counts.copy()
        for stamp, state, point in points:
            learner = self._learner()
            found = self.feedforward.answer(learner, *state)
            outputs = found.outputs + learner.tare.bias if is_wrench else found.outputs
            self._points.publish(value.filled(stamp, self._frame_id(), outputs))
            if self._std.get_subscription_count():
                self._std.publish(value.filled(stamp, self._frame_id(), found.outputs_std))
            if self._status.get_subscription_count():
                self._status.publish(self._marks.write(stamp, status(found)))
            for writer, efforts in ((answer, found.efforts), (answer_std, found.efforts_std)):
                motion = [part[columns].tolist() for part in state]
                writer.add([*motion, efforts[efforts_of].tolist()], point.from_start)
            yield
        self._trajectory.publish(answer.message())
        self._trajectory_std.publish(answer_std.message())
        self._tell_marks(before)

    def _tell_marks(self, before: Counter[str]) -> None:
        """Each mark once: a controller that streams at the edge of what was learnt has it again and again."""
        new = {mark for mark in MARKS if self.feedforward.counts[mark] > before[mark]} - self._told
        if new:
            self._told |= new
            self._log.warning(f'{self.feedforward.sentence(before)} Further ones are counted on /diagnostics.')


def joint_order(names: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Places of our joints in the message, which may name others too; raises SemiparamError unless
    each is there once."""
    wrong = [joint for joint in joints if names.count(joint) != 1]
    if wrong:
        raise SemiparamError(f'desired_trajectory must name joint {wrong[0]!r} once; it names {listed(names)}.')
    return [names.index(joint) for joint in joints]


def desired_state(point: TrajectoryPoint, order: Sequence[int], n_names: int, index: int) -> list[Array]:
    """Position, velocity and acceleration in our order; raises SemiparamError for a point that lacks one."""
    state = []
    for what, values in zip(SEQUENCES[:3], point.values, strict=False):
        if len(values) != n_names:
            raise SemiparamError(f'point {index} of desired_trajectory has {len(values)} {what} for {n_names} joints.')
        chosen = values[order]
        if not (np.abs(chosen) <= LARGEST).all():
            raise SemiparamError(f'point {index} of desired_trajectory has {what} {chosen.tolist()}; expected finite '
                                 f'ones within {LARGEST:g}.')
        state.append(chosen)
    return state


def stamp_of(start: int, point: TrajectoryPoint, index: int) -> int:
    """Time of a point [ns]; raises SemiparamError for one that no stamp can tell."""
    stamp = start + point.from_start
    if not all(-END_OF_TIME_NS <= time < END_OF_TIME_NS for time in (start, point.from_start, stamp)):
        raise SemiparamError(f'point {index} of desired_trajectory lies at {stamp / NANOSECONDS:g} s, which no header '
                             'can hold; expected stamp, time_from_start and their sum below '
                             '2^31 s.')
    return stamp
