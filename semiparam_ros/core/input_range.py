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


def beyond(known: Array, sample: Sample, radians: Array | None = None) -> tuple[Array, float]:
    """The inputs x (m,) of a sample, and how far the farthest lies outside, as a share of its range; 0 within, and NaN
    when one is not finite.

    A range counts as at least a fifth of the largest of its kind.

    :param radians: (n_joints,) what of each joint's unit is as much as a radian; 1 unless given.
    """
    n_joints = len(sample.position)
    x, radians = np.empty(3 * n_joints), np.ones(n_joints) if radians is None else radians
    return x, _beyond(known, sample.position, sample.velocity, sample.acceleration, radians, x)


@compiled
def widen(known: Matrix, x: Vector) -> None:
    """The same in place, of a range (2, m)."""
    for i in range(len(x)):
        known[0, i] = min(known[0, i], x[i])
        known[1, i] = max(known[1, i], x[i])


@compiled
def _beyond(known: Matrix, position: Strided, velocity: Strided, acceleration: Strided, radians: Vector,
            x: Vector) -> float:
    n_joints = len(position)
    if not len(velocity) == len(acceleration) == len(radians) == n_joints or (len(known) and known.shape[1] != len(x)):
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
            largest = max(largest, (known[1, i] - known[0, i]) / radians[i - start])
        for i in range(start, start + n_joints):
            least = max(known[1, i] - known[0, i], LEAST_SHARE * largest * radians[i - start], LEAST_RANGE)
            farthest = max(farthest, (known[0, i] - x[i]) / least, (x[i] - known[1, i]) / least)
    return farthest
