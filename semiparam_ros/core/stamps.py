"""Time stamps: nanoseconds since the epoch, as integers."""

from __future__ import annotations

from typing import Protocol

NANOSECONDS = 1_000_000_000
LONGEST_PAUSE_NS = 3600 * NANOSECONDS
"""A stamp further ahead of the last one, or before it, is that of a clock that jumped."""


class Time(Protocol):
    """A builtin_interfaces/Time, of rclpy or as a bag decodes it."""

    sec: int
    nanosec: int


def stamp_ns(stamp: Time) -> int:
    """A builtin_interfaces/Time in ns."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def stamp_fields(stamp: int) -> dict[str, int]:
    """The fields of builtin_interfaces/Time for ``stamp`` [ns]."""
    return {'sec': stamp // NANOSECONDS, 'nanosec': stamp % NANOSECONDS}


def in_seconds(stamp: int) -> str:
    """A stamp [ns] as seconds with nine decimals, exactly."""
    return f'{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d}'
