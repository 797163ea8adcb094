"""Trajectories read from and written to their bytes, point by point.

rclpy decodes a message as a whole: one of ten thousand points would keep every sample waiting for a third of a second.
Here (XCDR1) only the head is read at once, so that a message that is too long is refused before its points are touched.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from struct import Struct, error, unpack_from
from typing import NamedTuple

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from trajectory_msgs.msg import JointTrajectory

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.replay_stamps import NANOSECONDS
from semiparam_ros.ros.serialised import ENCAPSULATION, Layout

MOST_POINTS = 10_000
MOST_NAMES = 1000
MOST_BYTES = 20_000_000
"""What a trajectory_msgs/JointTrajectory may hold to be answered."""

SEQUENCES = ('positions', 'velocities', 'accelerations', 'effort')


class Point(NamedTuple):
    """One point: ``values`` of positions, velocities, accelerations and effort in this order, as the message has them,
    and the time from the trajectory's start [ns]."""

    values: tuple[Array, ...]
    from_start: int


class TrajectoryReader:
    """Head of a message, and its points one after another.

    Raises SemiparamError for one that is too long, or none.
    """

    def __init__(self, raw: bytes) -> None:
        self._size, self._place = len(raw), len(ENCAPSULATION)
        if not raw.startswith(ENCAPSULATION) and self._size <= MOST_BYTES:
            raw = self._usual(raw)
        self._raw = raw
        try:
            seconds, nanoseconds = self._numbers('iI')
            self.stamp = seconds * NANOSECONDS + nanoseconds
            self.frame_id = self._text()
            count = self._count()
            _limit('names', count, MOST_NAMES)
            self.names = [self._text() for _ in range(count)]
            self.n_points = self._count()
        except (error, ValueError) as failure:
            raise self._refusal(failure) from None
        _limit('points', self.n_points, MOST_POINTS)
        _limit('bytes', self._size, MOST_BYTES)

    def points(self) -> Iterator[Point]:
        """Every point; raises SemiparamError where the message breaks off."""
        for _ in range(self.n_points):
            try:
                values = tuple(self._doubles() for _ in SEQUENCES)
                seconds, nanoseconds = self._numbers('iI')
            except (error, ValueError) as failure:
                raise self._refusal(failure) from None
            yield Point(values, seconds * NANOSECONDS + nanoseconds)

    def _usual(self, raw: bytes) -> bytes:
        """In the machine's byte order, whatever encoding the sender chose."""
        try:
            return bytes(serialize_message(deserialize_message(raw, JointTrajectory)))
        except Exception as failure:  # of several kinds, from rmw and from the conversion of texts
            raise self._refusal(failure) from None

    def _refusal(self, failure: Exception) -> Exception:
        if isinstance(failure, SemiparamError):
            return failure
        return SemiparamError(f'a message of {self._size} bytes is no JointTrajectory ({type(failure).__name__}).')

    def _align(self, size: int) -> None:
        self._place += -(self._place - len(ENCAPSULATION)) % size

    def _numbers(self, code: str) -> tuple[int, ...]:
        self._align(4)
        numbers = unpack_from(f'={code}', self._raw, self._place)
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
        values = np.frombuffer(self._raw, dtype=np.float64, count=count, offset=self._place)
        self._place += 8 * count
        return values


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
