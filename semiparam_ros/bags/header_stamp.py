"""Header stamps read and written in place in serialised messages: nothing is decoded.

A message whose first field is a std_msgs/Header serialises (XCDR1) as a 4-byte encapsulation, whose
second byte names the byte order, then ``int32 sec`` and ``uint32 nanosec``.
"""

from __future__ import annotations

import struct

from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.errors import SemiparamError

_OFFSET = 4
_FORMAT = {0: '>iI', 1: '<iI'}


def read_stamp(raw: bytes) -> int:
    """The header stamp [ns] of a serialised message that begins with a header.

    Raises SemiparamError for bytes too short to hold one.
    """
    try:
        seconds, nanoseconds = struct.unpack_from(_format(raw), raw, _OFFSET)
    except struct.error:
        raise SemiparamError(f'a message of {len(raw)} bytes is too short for a header '
                             'stamp.') from None
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def with_stamp(raw: bytes, stamp: int) -> bytes:
    """The same serialised message with its header stamp set to ``stamp`` [ns]."""
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    try:
        field = struct.pack(_format(raw), seconds, nanoseconds)
    except struct.error:
        raise SemiparamError(f'a header stamp cannot hold {seconds} s: expected 32-bit '
                             'seconds.') from None
    return raw[:_OFFSET] + field + raw[_OFFSET + len(field):]


def _format(raw: bytes) -> str:
    return _FORMAT[raw[1] & 1] if len(raw) > 1 else '<iI'
