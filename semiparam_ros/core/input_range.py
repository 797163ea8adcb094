"""The range of inputs that a model has learnt: (2, m) lowest and highest x = [q, dq, ddq], (0, m) before the first."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.compiled import Matrix, Strided, Vector, compiled
from semiparam_ros.core.random_features import LEAST_SHARE
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array

LEAST_RANGE = 1e-9


def widened(known: Array, x: Array) -> Array:
    """The range with one input (m,) more."""
    if not len(known):
        return np.array([x, x])
    found = known.copy()
    widen(found, x)
    return found


def beyond(known: Array, sample: Sample) -> tuple[Array, float]:
    """The inputs x (m,) of a sample, and how far the farthest lies outside, as a share of its range; 0 within, and NaN
    when one is not finite.

    A range counts as at least a fifth of the largest of its kind.
    """
    x = np.empty(3 * len(sample.position))
    return x, _beyond(known, sample.position, sample.velocity, sample.acceleration, x)


@compiled
def widen(known: Matrix, x: Vector) -> None:
    """The same in place, of a range (2, m)."""
    for i in range(len(x)):
        known[0, i] = min(known[0, i], x[i])
        known[1, i] = max(known[1, i], x[i])


@compiled
def _beyond(known: Matrix, position: Strided, velocity: Strided, acceleration: Strided, x: Vector) -> float:
    n_joints = len(position)
    if not len(velocity) == len(acceleration) == n_joints or (len(known) and known.shape[1] != len(x)):
        x[:] = 0.0  # nothing is read beyond an end; the regressor tells what does not fit the robot
        return 0.0
    for i in range(n_joints):
        x[i], x[n_joints + i], x[2 * n_joints + i] = position[i], velocity[i], acceleration[i]
    if not np.isfinite(x).all():
        return np.nan
    farthest = 0.0
    for start in range(0, len(x) if len(known) else 0, n_joints):
        largest = 0.0
        for i in range(start, start + n_joints):
            largest = max(largest, known[1, i] - known[0, i])
        for i in range(start, start + n_joints):
            least = max(known[1, i] - known[0, i], LEAST_SHARE * largest, LEAST_RANGE)
            farthest = max(farthest, (known[0, i] - x[i]) / least, (x[i] - known[1, i]) / least)
    return farthest
