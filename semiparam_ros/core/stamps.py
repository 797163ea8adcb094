"""Time stamps: nanoseconds since the epoch, as integers."""

from __future__ import annotations

from typing import Protocol

NANOSECONDS = 1_000_000_000
LONGEST_PAUSE_NS = 3600 * NANOSECONDS
"""A stamp further ahead of the last one, or before it, is that of a clock that jumped."""
LONGEST_STEP_S = 0.1
"""[s] Time under observation between two samples at most: a pause is none."""


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


def observed_s(stamp: int, before: int | None) -> float:
    """Time under observation [s] from the sample before, None where there is none, to one at
    ``stamp`` [ns]."""
    return 0.0 if before is None else min(max(1e-9 * (stamp - before), 0.0), LONGEST_STEP_S)


def in_seconds(stamp: int) -> str:
    """A stamp [ns] as seconds with nine decimals, exactly."""
    return f'{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d}'
