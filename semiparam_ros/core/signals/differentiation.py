"""Accelerations (and velocities) that no encoder measures, estimated from velocities (from positions) as they come."""

from __future__ import annotations

from math import exp

import numpy as np

from semiparam_ros.core.compiled import Matrix, Vector, compiled
from semiparam_ros.core.finite import are_finite
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

GAP_MEMORIES, GAP_STEPS = 5.0, 4.5
LONGEST_STEP_S = 1.0
"""Longest first step after a start, when the usual step is not known yet."""


class CausalDifferentiator:
    """Fading-memory quadratic fit to values (Morrison 1969): no lag while their rate is a ramp.

    Samples lose weight as exp(-2 pi cutoff age), so a higher cutoff follows faster and is noisier; where the memory is
    shorter than a step, the parabola goes through the last three samples. Steps in time may vary. A gap longer than
    five memories and than four usual steps starts afresh.

    The values are velocities, whose rates are accelerations; or positions, whose rates are velocities. On motions of
    about 1 Hz with 0.5 % of noise in the velocities, 10 Hz leaves an error of 6 to 10 % of the acceleration at any rate
    from 20 Hz to 1 kHz (docs/mathematics.md); lower cutoffs lag, higher ones are noisier.
    """

    def __init__(self, n_joints: int, cutoff_hz: float, angles: bool = False) -> None:
        """``cutoff_hz``: rate at which the past fades [Hz], positive; ``angles``: values [rad] that may come within one
        turn, as of joints that turn without end."""
        if not 0.0 < cutoff_hz < np.inf:
            raise SemiparamError(f'acceleration.cutoff is {cutoff_hz}; expected a positive frequency in Hz.')
        self._n_joints = n_joints
        self._decay = 2.0 * np.pi * cutoff_hz
        self._turn = 2.0 * np.pi if angles else np.inf
        self.reset()

    def reset(self) -> None:
        """Forget the past, as after a jump of the clock."""
        self._stamp: int | None = None
        self._step = LONGEST_STEP_S / GAP_STEPS
        self._age = 0
        self._fit = np.zeros((3, self._n_joints))  # value, rate and its change at the last stamp

    def begin(self, stamp: int, values: Array, rates: Array) -> None:
        """Start afresh from values (n_joints,) and rates [1/s] that are known at ``stamp`` [ns]."""
        self.reset()
        self._fit[0], self._fit[1], self._stamp, self._age = values, rates, stamp, 2

    @property
    def knows_rates(self) -> bool:
        """Tell whether the last :meth:`update` gave rates; zeros stand for those of the first value after a start."""
        return self._age > 0

    def update(self, stamp: int, values: Array) -> Array:
        """(n_joints,) rates [1/s] of the values at ``stamp`` [ns], from these and earlier values.

        A repeated stamp changes nothing, an earlier one starts afresh. Raises SemiparamError for values that are not
        finite, and keeps the past.
        """
        values = np.array(values, dtype=float)
        if not are_finite(values):
            raise SemiparamError(f'the values to differentiate are {values.tolist()}; expected finite values.')
        step = 0.0 if self._stamp is None else (stamp - self._stamp) * 1e-9
        if self._stamp is not None and step == 0.0:
            return self._fit[1]
        if self._stamp is None or step < 0.0 or step > self._longest_step():
            self.reset()
            self._fit[0], self._stamp = values, stamp
            return self._fit[1]
        self._follow(step, values)
        self._stamp, self._step = stamp, step
        return self._fit[1]

    def _longest_step(self) -> float:
        return max(GAP_MEMORIES / self._decay, GAP_STEPS * self._step)

    def _follow(self, step: float, values: Array) -> None:
        self._age += 1
        g, h, k = self._gains(step)
        self._fit = follow(self._fit, values, step, g, h / step, k / step**2, self._turn)

    def _gains(self, step: float) -> tuple[float, float, float]:
        """Gains of the fading fit in the steady state, and at first those of a fit without weights to what there is.

        With two samples that is their line, with three or more a parabola (Brookner 1998, expanding memory).
        """
        fade = exp(-self._decay * step)
        rest = 1.0 - fade
        n = self._age
        if n == 1:
            return 1.0, 1.0, 0.0
        growing = 3.0 * (3 * n**2 + 3 * n + 2) / ((n + 1) * (n + 2) * (n + 3))
        if growing > 1.0 - fade**3:
            scale = (n + 1.0) * (n + 2) * (n + 3)
            return growing, 18.0 * (2 * n + 1) / scale, 60.0 / scale
        return 1.0 - fade**3, 1.5 * rest**2 * (1.0 + fade), rest**3


@compiled
def follow(before: Matrix, values: Vector, step: float, g: float, h: float, k: float, turn: float) -> Matrix:
    """The parabolas (3, n) a ``step`` [s] on, corrected by gains times what their values (n,) miss, but for turns."""
    after = np.empty(before.shape)
    for i in range(len(values)):
        value, rate, change = before[0, i], before[1, i], before[2, i]
        rate_now = rate + step * change
        value_now = value + step * rate + 0.5 * step**2 * change
        missed = values[i] - value_now
        if abs(missed) > 0.5 * turn:
            missed -= turn * np.round(missed / turn)
        after[0, i], after[1, i], after[2, i] = value_now + g * missed, rate_now + h * missed, change + k * missed
    return after
