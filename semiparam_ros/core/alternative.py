"""Does another model explain the outputs better than the one in force: the cumulative sum test of Page (1954).

The other one is that of before the last change, or one in which an effect that is known came or went.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.core.types import Array

CORRELATED_S = 0.25
"""Errors of a model that is not quite true are so long the same: in that time they tell as much as one sample
of white noise."""
SHARE = 0.5
"""Errors of the model in force count so much: of equal ones, there is no end to the chance that the other one is
better for a while."""
BETTER, BETTER_TOLD = 12.0, 3.0
"""[nat] Evidence with which the other one takes over, and where the robot is told to have changed."""
EVERY_NS, LONGEST_NS = NANOSECONDS // 100, NANOSECONDS // 10
"""Samples are charged no more often, and a pause counts for no more."""


class Alternative:
    """Evidence of another model over the one in force, since the time at which it is largest."""

    def __init__(self) -> None:
        self.nats = self.seconds = 0.0
        """[nat], and how long ago that time is [s]."""
        self.stamp = 0
        """[ns] Of the last sample that was charged."""

    def clear(self) -> None:
        """Begin anew, as when the two have changed places."""
        self.nats = self.seconds = 0.0

    def elapsed(self, stamp: int) -> float:
        """[s] that a sample at ``stamp`` [ns] is to be charged for, which the next one then counts from; 0: it is too
        soon."""
        since = stamp - self.stamp
        if 0 <= since < EVERY_NS:
            return 0.0
        self.stamp = stamp
        return max(min(since, LONGEST_NS), 0) / NANOSECONDS

    def charge(self, seconds: float, now: Array, then: Array, std: Array) -> bool:
        """Charge what the model in force and the other one left of a sample (n,), by the standard deviations that the
        one in force gave to it; whether the other one is better.

        Where the model in force is unsure there is little evidence: it is to learn, not to be replaced. A spike
        decides nothing: three samples are needed.
        """
        gained = sqrt(2.0) * float(((SHARE * np.abs(now) - np.abs(then)) / std).sum())  # by Laplace's density
        self.nats = max(self.nats + min(seconds / CORRELATED_S * gained, BETTER / 2.0), 0.0)
        self.seconds = self.seconds + seconds if self.nats else 0.0
        return self.nats > BETTER
