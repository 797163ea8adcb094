"""Accelerations that no encoder measures, estimated from velocities as they come."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError


class CausalDifferentiator:
    """Fading-memory quadratic fit to the velocities (Morrison 1969): no lag while the acceleration is a ramp.

    Samples lose weight as exp(-2 pi cutoff age), so a higher cutoff follows faster and is noisier. Steps in time may
    vary. A gap longer than five memories starts afresh.
    """

    def __init__(self, n_joints: int, cutoff_hz: float) -> None:
        """``cutoff_hz``: rate at which the past fades [Hz], positive."""
        if not cutoff_hz > 0.0:
            raise SemiparamError(f'acceleration.cutoff is {cutoff_hz}; expected a positive frequency in Hz.')
        self._n_joints = n_joints
        self._decay = 2.0 * np.pi * cutoff_hz
        self.reset()

    def reset(self) -> None:
        """Forget the past, as after a jump of the clock."""
        self._stamp: int | None = None
        self._velocity = self._acceleration = self._jerk = np.zeros(self._n_joints)

    def update(self, stamp: int, position: Array, velocity: Array) -> Array:
        """(n_joints,) accelerations [rad/s^2] at ``stamp`` [ns], from this and earlier velocities [rad/s]."""
        step = 0.0 if self._stamp is None else (stamp - self._stamp) * 1e-9
        if self._stamp is None or step * self._decay > 5.0:
            self._velocity, self._stamp = np.array(velocity, dtype=float), stamp
            self._acceleration = self._jerk = np.zeros(self._n_joints)
            self._age = 0
            return self._acceleration
        self._age += 1
        g, h, k = self._gains(step)
        innovation = velocity - (self._velocity + step * self._acceleration + 0.5 * step**2 * self._jerk)
        self._velocity = velocity - (1.0 - g) * innovation
        self._acceleration = self._acceleration + step * self._jerk + (h / step) * innovation
        self._jerk = self._jerk + (k / step**2) * innovation
        self._stamp = stamp
        return self._acceleration

    def _gains(self, step: float) -> tuple[float, float, float]:
        """Steady gains, reached from those of an ordinary line while the first samples come."""
        fade = max(np.exp(-self._decay * step), 1e-6)
        if self._age < 3 / (1.0 - fade):
            fade = min(fade, 1.0 - 1.0 / (self._age + 1.0))
        rest = 1.0 - fade
        return 1.0 - fade**3, 1.5 * rest**2 * (1.0 + fade), rest**3
