"""The motion as it happened: one smooth function of time for all joints, its derivatives exact; and slow random
functions of time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from semiparam_ros.core.types import Array

TERMS = 5

FINE_RATE_HZ = 1000
KNOT_STEP = 10
LEAD_S = 2.0
BANDWIDTH_HZ = 5.0
DAMPING = 0.9
TREMOR_RAD = 1.5e-3
TREMOR_HZ = 1.0


def wander(time: Array, period_s: float, rng: np.random.Generator) -> Array:
    """Smooth random function (N,) of unit RMS whose ups and downs take about ``period_s``; it never repeats."""
    frequency = rng.uniform(0.4, 1.6, TERMS) / period_s
    phase = rng.uniform(0, 2 * np.pi, TERMS)
    weight = rng.uniform(0.5, 1.0, TERMS)
    weight *= np.sqrt(2 / np.sum(weight**2))
    return np.asarray(np.sin(2 * np.pi * np.outer(time, frequency) + phase) @ weight)


def wanders(time: Array, period_s: float, count: int, rng: np.random.Generator) -> Array:
    """Independent functions as of :func:`wander`, as columns (N, count)."""
    return np.stack([wander(time, period_s, rng) for _ in range(count)], axis=1)


def unit_vector(rng: np.random.Generator) -> Array:
    """A random direction, (3,)."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


class Instants(NamedTuple):
    """Joint motion at N times [s]: ``position``, ``velocity``, ``acceleration`` (N, n_joints)."""

    time: Array
    position: Array
    velocity: Array
    acceleration: Array


class Trajectory:
    """Quintic spline through the tracked positions; position, velocity and acceleration belong to one curve."""

    def __init__(self, time: Array, position: Array) -> None:
        self.spline: BSpline = make_interp_spline(time, position, k=5)
        self.start, self.end = float(time[0]), float(time[-1])

    def at(self, time: Array) -> Instants:
        """The motion at ``time`` (N,) [s], which may lie ``LEAD_S`` before the recording."""
        inside = np.clip(time, self.start, self.end)
        return Instants(time, *(np.asarray(self.spline(inside, nu=order)) for order in range(3)))


def fine_time(duration: float) -> Array:
    """Times on a 1 kHz grid, from ``LEAD_S`` before the recording to half a second after it."""
    return np.arange(-LEAD_S, duration + 0.5, 1.0 / FINE_RATE_HZ)


def tracked(time: Array, reference: Array, rng: np.random.Generator) -> Trajectory:
    """Motion that a controller makes of ``reference`` (N, n_joints) on the 1 kHz grid ``time``.

    Each joint follows as a damped second-order system, q'' = w^2 (ref - q) - 2 z w q' +
    disturbance, integrated at the fine step, and the disturbance is slow noise: no turn is ever
    like the last one.
    """
    position = np.empty_like(reference)
    for joint in range(reference.shape[1]):
        omega = 2 * np.pi * BANDWIDTH_HZ * rng.uniform(0.8, 1.25)
        driven = reference[:, joint] + slow_noise(len(time), rng)
        position[:, joint] = second_order(driven, omega, DAMPING, 1.0 / FINE_RATE_HZ)
    return Trajectory(time[::KNOT_STEP], position[::KNOT_STEP])


def second_order(drive: Array, omega: float, damping: float, step: float) -> Array:
    """Response of w^2 / (s^2 + 2 z w s + w^2) to ``drive`` (N,), started in balance, at a time step [s]."""
    system = ([omega**2], [1.0, 2 * damping * omega, omega**2])
    numerator, denominator, _ = cont2discrete(system, step, method='bilinear')
    b, a = np.ravel(numerator), np.ravel(denominator)
    return np.asarray(lfilter(b, a, drive, zi=lfilter_zi(b, a) * drive[0])[0])


def slow_noise(count: int, rng: np.random.Generator) -> Array:
    """Noise of ``TREMOR_RAD`` RMS below about ``TREMOR_HZ``, (count,) [rad]."""
    omega = 2 * np.pi * TREMOR_HZ
    noise = rng.standard_normal(count)
    for _ in range(2):
        noise = second_order(noise, omega, 0.7, 1.0 / FINE_RATE_HZ)
    return TREMOR_RAD * noise / np.std(noise)
