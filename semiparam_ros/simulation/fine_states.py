"""States with a memory, integrated on a fine grid of time: hysteresis, bristles, play in a gear."""

from __future__ import annotations

from collections.abc import Callable
from math import exp

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.trajectory import Instants, Trajectory

STEP_S = 1e-3


def fine_motion(trajectory: Trajectory, step: float = STEP_S) -> Instants:
    """The whole motion, the lead before the recording included, on a grid of ``step`` [s]."""
    return trajectory.at(np.arange(trajectory.start, trajectory.end, step))


def sampled(fine: Array, values: Array, times: Array) -> Array:
    """A state known on the grid ``fine`` (M,), read at ``times`` (N,)."""
    return np.asarray(np.interp(times, fine, values))


def bouc_wen(elongation: Array, yield_length: float, beta: float) -> Array:
    """Hysteretic part z of an elongation x (M,): z' = x' - (beta |x'| z + (1 - beta) x' |z|) / yield_length.

    Within a step z moves by an exponential in the way travelled, which is exact while the signs hold. |z| saturates at
    ``yield_length``.
    """
    states, z = [0.0], 0.0
    for dx in np.diff(elongation).tolist():
        way = abs(dx) / yield_length
        # With x' > 0 the two terms add up for z > 0 and oppose each other for z < 0 (and the other way round).
        rate = 1.0 if dx * z >= 0.0 else 2.0 * beta - 1.0
        z = z + dx if abs(rate * way) < 1e-12 else _relaxed(z, dx, rate, yield_length)
        states.append(z)
    return np.array(states)


def _relaxed(z: float, dx: float, rate: float, yield_length: float) -> float:
    target = (1.0 if dx > 0.0 else -1.0) * yield_length / rate
    return target + (z - target) * exp(-rate * abs(dx) / yield_length)


def bristle(position: Array, presliding: float, level: Callable[[Array], Array] | None = None) -> Array:
    """Deflection (M,) of a friction bristle, by z' = x' (1 - sgn(x') z / level) / presliding.

    It is Coulomb's sign of the velocity, reached over a small way instead of at once. ``level`` of the slope of
    position (per step) makes the sliding value depend on speed (LuGre with a Stribeck curve).
    """
    steps = np.diff(position)
    levels = np.ones_like(steps) if level is None else level(steps)
    states, z = [0.0], 0.0
    for dx, bound in zip(steps.tolist(), levels.tolist(), strict=True):
        target = bound if dx > 0.0 else -bound
        z = target + (z - target) * exp(-abs(dx) / (presliding * bound))
        states.append(z)
    return np.array(states)


def play(position: Array, gap: float) -> Array:
    """Place (M,) within a gap, 0 to ``gap``, of a part that ``position`` (M,) pushes from either flank."""
    states, x = [0.5 * gap], 0.5 * gap
    for dx in np.diff(position).tolist():
        x = min(max(x + dx, 0.0), gap)
        states.append(x)
    return np.array(states)
