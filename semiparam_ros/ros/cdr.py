"""Messages read from and written to their bytes (CDR), where decoding them would take too long.

A robot sends a thousand messages a second. rclpy makes objects of
every message, which takes nearly as long as predicting from it. Here the layout of a message (XCDR1) is worked out
once, and holds for all messages with the same texts and lengths: of each of them only the stamp and the numbers are
read, in one call.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import cache
from operator import itemgetter
from struct import Struct, error
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message

from semiparam_ros.bags.readings import Reading
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.message_types import message_class

ENCAPSULATION = bytes((0, sys.byteorder == 'little', 0, 0))
"""XCDR1 in the machine's byte order."""
MOST_LAYOUTS = 64
MOST_BYTES = 100_000
"""Bytes beyond which a message is refused unread: a joint state of a thousand joints has fewer."""


@cache
def begins_with_header(type_name: str) -> bool:
    """Tell whether messages of this type carry a stamp that
    :mod:`semiparam_ros.bags.header_stamp` finds."""
    try:
        fields = message_class(type_name).get_fields_and_field_types()
    except SemiparamError:
        return False
    return next(iter(fields.values()), '') == 'std_msgs/Header'


class Floats(NamedTuple):
    """Doubles of a sequence, which writes how many there are, or the members of a structure."""

    length: int
    in_sequence: bool = True


Part = str | list[str] | Floats
"""Part behind the stamp of a header: a text, a sequence of texts, doubles."""


class Layout:
    """Layout of a message that begins with a header's stamp: where its parts stand."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self._values: list[int | float | bytes] = [0, 0]
        self._numbers: list[slice] = []
        code = ''.join(self._floats(part) if isinstance(part, Floats) else self._texts(part) for part in parts)
        # The machine's own alignment is that of XCDR1, counted from behind the encapsulation.
        self._struct = Struct(f'@iI{code}')
        self._filled = [place for place in self._numbers if place.start < place.stop]
        numbers = {index for place in self._numbers for index in range(place.start, place.stop)}
        self._fixed = itemgetter(*(index for index in range(2, len(self._values)) if index not in numbers))
        self._expected = self._fixed(self._values)

    def read(self, raw: bytes) -> tuple[int, list[tuple[float, ...]]] | None:
        """Stamp [ns] and the doubles of each :class:`Floats`; None for bytes that are laid out otherwise."""
        try:
            values = self._struct.unpack_from(raw, len(ENCAPSULATION))
        except error:
            return None
        if self._fixed(values) != self._expected or not raw.startswith(ENCAPSULATION):
            return None
        return values[0] * NANOSECONDS + values[1], [values[place] for place in self._numbers]

    def write(self, stamp: int, *numbers: Sequence[float]) -> bytes:
        """The message with a stamp [ns] and the doubles of each :class:`Floats` that is not empty."""
        values = self._values
        values[:2] = divmod(stamp, NANOSECONDS)
        for place, given in zip(self._filled, numbers, strict=True):
            values[place] = given
        return ENCAPSULATION + self._struct.pack(*values)

    def _texts(self, part: str | list[str]) -> str:
        texts = [part] if isinstance(part, str) else part
        encoded = [text.encode() + b'\0' for text in texts]
        in_sequence = texts is part
        self._values += [len(encoded)] * in_sequence
        for text in encoded:
            self._values += [len(text), text]
        return 'I' * in_sequence + ''.join(f'I{len(text)}s' for text in encoded)

    def _floats(self, part: Floats) -> str:
        self._values += [part.length] * part.in_sequence + [0.0] * part.length
        self._numbers.append(slice(len(self._values) - part.length, len(self._values)))
        return 'I' * part.in_sequence + f'{part.length}d' * (part.length > 0)


def joint_state_layout(frame_id: str, names: Sequence[str], *counts: int) -> Layout:
    """Layout of a sensor_msgs/JointState with so many positions, velocities and efforts."""
    return Layout([frame_id, list(names), *map(Floats, counts)])


def wrench_layout(frame_id: str) -> Layout:
    """Layout of a geometry_msgs/WrenchStamped."""
    return Layout([frame_id, Floats(6, in_sequence=False)])


def decoded(raw: bytes, message_class: type) -> Any:
    """The message as rclpy decodes it; raises SemiparamError for bytes that are none."""
    try:
        return deserialize_message(raw, message_class)
    except Exception as failure:  # of several kinds, from rmw and from the conversion of texts
        raise SemiparamError(f'a message of {len(raw)} bytes is no {message_class.__name__} '
                             f'({type(failure).__name__}).') from None


class Reader:
    """Reads the messages of one topic.

    :param message_class: of rclpy, which decodes the first message of a layout, and what is laid out in no usual way.
    :param read: what of such a message is needed.
    :param layout: that of a message with the same texts and lengths; None where rclpy decodes every one.
    """

    def __init__(self, message_class: type, read: Callable[[Any], Reading],
                 layout: Callable[[Reading], Layout] | None) -> None:
        self._message_class, self._read, self._layout = message_class, read, layout
        self._known: dict[int, tuple[Layout, Reading]] = {}

    def __call__(self, raw: bytes) -> Reading:
        """Raises SemiparamError for bytes that are no such message, or too many."""
        if len(raw) > MOST_BYTES:
            raise SemiparamError(f'a {self._message_class.__name__} of {len(raw)} bytes is too long; expected at most '
                                 f'{MOST_BYTES}.')
        known = self._known.get(len(raw))
        found = known[0].read(raw) if known else None
        if known is None or found is None:
            return self._decoded(raw)
        stamp, numbers = found
        _, frame_id, (texts, *_) = known[1]
        return Reading(stamp, frame_id, (texts, *numbers))

    def _decoded(self, raw: bytes) -> Reading:
        reading = self._read(decoded(raw, self._message_class))
        if self._layout is not None:
            if len(self._known) >= MOST_LAYOUTS:
                self._known.clear()
            self._known[len(raw)] = (self._layout(reading), reading)
        return reading


def joint_state_layout_of(reading: Reading) -> Layout:
    """Layout of the joint state that was read."""
    names, *columns = reading.fields
    return joint_state_layout(reading.frame_id, names, *map(len, columns))
