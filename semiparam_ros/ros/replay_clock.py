"""The clock of a playback: bag time against this machine's monotonic time, with a rate, a pause and jumps."""

from __future__ import annotations

import time
from collections.abc import Callable

from semiparam_ros.errors import SemiparamError

MonotonicClock = Callable[[], int]


def checked_rate(rate: float) -> float:
    """The rate, or SemiparamError unless it is a finite number above zero."""
    if not 0.0 < rate < float('inf'):
        raise SemiparamError(f'the rate must be a finite number above 0, got {rate:g}.')
    return float(rate)


class PlayClock:
    """bag_time(t) = bag_anchor + rate (t - wall_anchor) while running; constant while paused. All times in ns.

    Every change re-anchors at the present instant, so changing the rate never makes the bag time jump, and because
    due times are computed from the anchor and not from the previous message, a late wake-up does not add up.
    """

    def __init__(self, bag_time: int, rate: float = 1.0, paused: bool = False,
                 monotonic: MonotonicClock = time.monotonic_ns) -> None:
        self._monotonic = monotonic
        self._rate = checked_rate(rate)
        self._paused = paused
        self._bag_anchor = bag_time
        self._wall_anchor = monotonic()

    @property
    def rate(self) -> float:
        """Bag seconds in one second of this machine."""
        return self._rate

    @property
    def paused(self) -> bool:
        """Whether the bag time stands still."""
        return self._paused

    def now(self) -> int:
        """The present bag time [ns]."""
        if self._paused:
            return self._bag_anchor
        return self._bag_anchor + int((self._monotonic() - self._wall_anchor) * self._rate)

    def seconds_until(self, bag_time: int) -> float:
        """Seconds of this machine until ``bag_time`` [ns] is due; zero or less when it is due, for a running clock."""
        due = self._wall_anchor + (bag_time - self._bag_anchor) / self._rate
        return (due - self._monotonic()) * 1e-9

    def jump(self, bag_time: int) -> None:
        """Let the bag time be ``bag_time`` [ns] now."""
        self._bag_anchor, self._wall_anchor = bag_time, self._monotonic()

    def set_rate(self, rate: float) -> None:
        """Run at another rate from here on. Raises SemiparamError for a rate that is not above zero."""
        rate = checked_rate(rate)
        self.jump(self.now())
        self._rate = rate

    def set_paused(self, paused: bool) -> None:
        """Stop or start the bag time."""
        self.jump(self.now())
        self._paused = paused
