"""Temperatures of joints or of a sensor: warming up as a first-order system, with slow swings as the work changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.trajectory import wanders

Temperature: TypeAlias = Callable[[Array], Array]
"""Function from times (N,) [s] to temperatures (N, k) [deg C]."""

SWING_SHARE = 0.2
PERIOD_S = 1.0
"""Time between two readings [s]."""
STEP = 2.0**-4
READING_NOISE = 0.05


def warming(count: int, duration: float, rng: np.random.Generator) -> Temperature:
    """Temperature of ``count`` parts of one robot over a recording of ``duration`` [s]."""
    ambient, rise = rng.uniform(18.0, 28.0), rng.uniform(8.0, 25.0, count)
    time_constant, seed = duration * rng.uniform(0.3, 0.8, count), int(rng.integers(2**31))

    def temperature(time: Array) -> Array:
        swing = wanders(time, duration, count, np.random.default_rng(seed))
        warm = -np.expm1(-np.maximum(time, 0.0)[:, None] / time_constant)
        return np.asarray(ambient + rise * (warm + SWING_SHARE * swing))
    return temperature


def readings(temperature: Temperature, time: Array, noise: float, rng: np.random.Generator) -> Array:
    """Readings (N, k), the newest at each time (N,) [s], with ``noise`` times the usual one."""
    number = np.floor(time / PERIOD_S).astype(int)
    read = temperature(PERIOD_S * np.arange(number[-1] + 1))
    read += noise * READING_NOISE * rng.standard_normal(read.shape)
    return np.asarray(np.round(read / STEP) * STEP)[number]
