"""Rests of joints, as their positions tell them: the noise of recorded velocities hides a rest."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from semiparam_ros.core.types import Array, Mask

SPEED_SHARE = 0.01
LEAST_S = 0.1
"""A joint rests that is slower than this share of its highest speed for so long [s]."""


def typical_step(time: Array) -> float:
    """Median time between samples [s], those with the same stamp aside."""
    steps = np.diff(time)
    forward = steps[steps > 0.0]
    return float(np.median(forward)) if len(forward) else 1e-9


def window_size(time: Array, rest_s: float) -> int:
    """Number of samples, an odd one, within which a joint has to stay."""
    return 2 * min(max(round(0.5 * rest_s / typical_step(time)), 1), max(len(time), 1)) + 1


def still(time: Array, position: Array, velocity: Array, share: float = SPEED_SHARE, rest_s: float = LEAST_S) -> Mask:
    """(N, ...) true in the middle of every window in which a joint stays where it is.

    A joint that turns back moves on both sides.
    """
    size = window_size(time, rest_s)
    travel = maximum_filter1d(position, size, axis=0) - minimum_filter1d(position, size, axis=0)
    return np.asarray(travel < share * np.abs(velocity).max(axis=0, initial=0.0) * (size - 1) * typical_step(time))
