"""Motions that the arm is asked for: circles, Fourier motion, reaching, and a mixture of all."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.interpolate import CubicSpline

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.arm import Arm, follow
from semiparam_ros.simulation.trajectory import Trajectory, fine_time, tracked, wander, wanders

Homes = Mapping[str, Array]
Reference = Callable[[Arm, Array, Homes, np.random.Generator], Array]

RADIUS_M = 0.05
TURN_S = 1.25
PLANES = {'circle_xy': (0, 1, 2), 'circle_xz': (0, 2, 1)}
COARSE_STEP = 20
MAX_SPEED = 2.0
SEGMENT_S, FADE_S = 15.0, 2.0


def trajectory(arm: Arm, motion: str, duration: float, homes: Homes, rng: np.random.Generator) -> Trajectory:
    """The tracked motion for ``duration`` [s]; circles go around the posture ``homes`` [rad] of their plane."""
    if motion not in MOTIONS:
        raise SemiparamError(f"motion '{motion}' is unknown; expected one of {', '.join(MOTIONS)}.")
    time = fine_time(duration)
    return tracked(time, MOTIONS[motion](arm, time, homes, rng), rng)


def circle(plane: str) -> Reference:
    """Circles of the tip with a diameter of 10 cm, one turn in about 1.25 s, in the base axes of ``plane``."""
    def reference(arm: Arm, time: Array, homes: Homes, rng: np.random.Generator) -> Array:
        coarse, home = time[::COARSE_STEP], homes[plane]
        path = circle_path(coarse, PLANES[plane], rng) + arm.pose(arm.tip, home[None]).place
        posture = home + 0.04 * wanders(coarse, 40.0, arm.n_joints, rng)
        return refined(coarse, follow(arm, arm.tip, path, posture), time)
    return reference


def circle_path(time: Array, axes: tuple[int, int, int], rng: np.random.Generator) -> Array:
    """Path (N, 3) [m] about the origin; speed, radius and centre wander by several per cent, at their own pace."""
    rate = (2 * np.pi / TURN_S) * (1 + 0.05 * wander(time, 25.0, rng))
    phase = np.concatenate([[0.0], np.cumsum(rate[1:] * np.diff(time))]) + rng.uniform(0, 2 * np.pi)
    radius = RADIUS_M * (1 + 0.04 * wander(time, 18.0, rng))
    path = np.empty((len(time), 3))
    path[:, axes[0]] = radius * np.cos(phase)
    path[:, axes[1]] = radius * np.sin(phase)
    path[:, axes[2]] = 0.0
    return path + 0.004 * wanders(time, 30.0, 3, rng)


def fourier(arm: Arm, time: Array, homes: Homes, rng: np.random.Generator) -> Array:
    """Fourier motion: a sum of sines for each joint, as wide as limits and speed allow."""
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in arm.limits)
    centre, reach = (low + high) / 2, 0.4 * (high - low)
    speed = np.minimum(MAX_SPEED, 0.7 * arm.speed_limits)
    frequency = rng.uniform(0.05, 0.45, (6, arm.n_joints))
    weight = rng.uniform(0.4, 1.0, (6, arm.n_joints)) / np.sqrt(frequency)
    phase = rng.uniform(0, 2 * np.pi, (6, arm.n_joints))
    scale = np.minimum(reach / weight.sum(0) * 1.6, speed / (2 * np.pi * frequency * weight).sum(0) * 1.6)
    waves = np.sin(2 * np.pi * time[:, None, None] * frequency + phase)
    wished = (scale * weight * waves).sum(1)
    shape = np.clip(np.divide(wished, reach, out=np.zeros_like(wished), where=reach > 0.0), -2.5, 2.5)
    # A soft bound keeps rare peaks off the joint limits.
    return np.asarray(centre + reach * np.tanh(shape))


def reach(arm: Arm, time: Array, homes: Homes, rng: np.random.Generator) -> Array:
    """Reaching from one random posture to the next along minimum-jerk curves, with short rests."""
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in arm.limits)
    speed = np.minimum(MAX_SPEED, 0.7 * arm.speed_limits)
    position, now, here = np.empty((len(time), arm.n_joints)), time[0], homes['circle_xy']
    while now <= time[-1]:
        target = low + (high - low) * rng.uniform(0.12, 0.88, arm.n_joints)
        move = max(rng.uniform(0.8, 1.6), float(np.max(1.9 * np.abs(target - here) / speed)))
        then = now + move + rng.uniform(0.1, 0.5)
        rows = slice(*np.searchsorted(time, (now, then)))
        s = np.clip((time[rows] - now) / move, 0.0, 1.0)[:, None]
        position[rows] = here + (target - here) * s**3 * (10 - 15 * s + 6 * s**2)
        now, here = then, target
    return position


def mixed(arm: Arm, time: Array, homes: Homes, rng: np.random.Generator) -> Array:
    """Circles in both planes, Fourier motion and reaching in turn, 15 s each, faded into one another."""
    parts = [part(arm, time, homes, rng) for part in (circle('circle_xy'), fourier, circle('circle_xz'), reach)]
    turn = np.clip(((time - time[0]) % SEGMENT_S - (SEGMENT_S - FADE_S)) / FADE_S, 0.0, 1.0)[:, None]
    fade = turn**3 * (10 - 15 * turn + 6 * turn**2)
    current = ((time - time[0]) // SEGMENT_S).astype(int) % len(parts)
    stacked, rows = np.stack(parts), np.arange(len(time))
    return np.asarray((1 - fade) * stacked[current, rows] + fade * stacked[(current + 1) % len(parts), rows])


def refined(coarse: Array, position: Array, time: Array) -> Array:
    """Positions on a coarse grid -> on the fine one."""
    return np.asarray(CubicSpline(coarse, position)(time))


MOTIONS: dict[str, Reference] = {'circle_xy': circle('circle_xy'), 'circle_xz': circle('circle_xz'),
                                 'fourier': fourier, 'mixed': mixed, 'reach': reach}
