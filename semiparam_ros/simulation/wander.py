"""Slow random functions of time, for everything on a robot that is never twice the same."""

from __future__ import annotations

import numpy as np

from semiparam_ros.simulation.arrays import Array

TERMS = 5


def wander(time: Array, period_s: float, rng: np.random.Generator) -> Array:
    """Smooth random function (N,) of unit RMS whose ups and downs take about ``period_s``; it never repeats."""
    frequency = rng.uniform(0.4, 1.6, TERMS) / period_s
    phase = rng.uniform(0, 2 * np.pi, TERMS)
    weight = rng.uniform(0.5, 1.0, TERMS)
    weight *= np.sqrt(2 / np.sum(weight**2))
    return np.asarray(np.sin(2 * np.pi * np.outer(time, frequency) + phase) @ weight)


def wanders(time: Array, period_s: float, count: int, rng: np.random.Generator) -> Array:
    """``count`` independent ones as columns, (N, count)."""
    return np.stack([wander(time, period_s, rng) for _ in range(count)], axis=1)


def unit_vector(rng: np.random.Generator) -> Array:
    """A random direction, (3,)."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))
