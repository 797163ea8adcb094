"""Relative squared prediction error over a horizon, the paper's index (Romeres et al. 2016, section V).

    eps_t[k] = sum_{s=1..T} (y_{t+s}[k] - yhat_{t+s|t}[k])^2 / sum_{s=1..T} y_{t+s}[k]^2

with the model as it stood at t and the inputs as they came. Every sample is thus predicted by the last T models, none
of which is kept: learning sample i added g_i E_i' to Theta, so that a model of the past says

    phi' Theta_t = phi' Theta_now - sum_{i > t} (phi' g_i) E_i'

and T gains, with what each innovation means to each model, do the work of T models: T (D + n p + T n) operations a
sample in place of T copies of D n weights.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semiparam_ros.core.recursion import Correction, Prior
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

LEAST_POWER = 1e-18
"""Floor of a denominator for each sample, in squared outputs: far below any sensor, and keeps the index finite."""


class HorizonErrors(NamedTuple):
    """The index of one origin t, known T samples later."""

    origin: int  # [ns] stamp of sample t
    eps: Array  # (n,)
    eps_centred: Array  # (n,) the same with the window's mean removed from the outputs of the denominator


class HorizonIndex:
    """The running index of a :class:`SemiParametricRecursion` over ``length`` T samples, at least 1.

    Rings of T slots: model t, and the correction that made it, stand in slot t mod T; ``_next`` is the oldest's slot.
    """

    def __init__(self, length: int, n_outputs: int, n_features: int, n_columns: int) -> None:
        if length < 1:
            raise SemiparamError(f'horizon.length is {length}; expected at least one sample.')
        self.length = length
        self._gains = np.zeros((length, n_features))
        self._lacking = np.zeros((length, n_outputs, length))  # [t, :, i] E_y - E_C theta_t of each i > t, or 0
        self._theta = np.zeros((length, n_columns))
        self._squared_error = np.zeros((length, n_outputs))
        self._outputs = np.zeros((length, n_outputs))
        self._origins = np.zeros(length, dtype=np.int64)
        self._filled = 0
        self._next = 0

    def score(self, prior: Prior, fixed: Array, outputs: Array) -> HorizonErrors | None:
        """Charge one sample to the last T models; the errors of the oldest when its horizon is now complete.

        :param prior: of the sample. :param fixed: (n,) the part that no model learns. :param outputs: (n,) measured.
        Call it before the sample is learnt, then :meth:`remember` afterwards.
        """
        predicted = prior.regressed[-1] + self._theta @ prior.columns_left.T
        predicted -= self._lacking @ (self._gains @ prior.phi)
        self._squared_error += (outputs - fixed - predicted) ** 2
        self._outputs[self._next] = outputs  # in place of the oldest sample, which no horizon holds any more
        return self._complete() if self._filled == self.length else None

    def remember(self, stamp: int, theta: Array, correction: Correction | None) -> None:
        """Keep the model as it stands after the sample of ``stamp`` [ns], in place of the oldest.

        :param theta: (p,) its coefficients. :param correction: what learning the sample did, None if it did not.
        """
        slot = self._next
        self._gains[slot] = 0.0
        if correction is not None:
            self._gains[slot] = correction.gain
            self._lacking[:, :, slot] = correction.innovations[-1] - self._theta @ correction.innovations[:-1]
        self._lacking[slot] = 0.0
        self._theta[slot] = theta
        self._squared_error[slot] = 0.0
        self._origins[slot] = stamp
        self._next = (slot + 1) % self.length
        self._filled = min(self._filled + 1, self.length)

    def clear(self) -> None:
        """Forget the pending horizons, as after a jump of the clock."""
        self._filled = self._next = 0

    def _complete(self) -> HorizonErrors:
        error, y = self._squared_error[self._next], self._outputs
        centred = y - y.sum(axis=0) / self.length
        floor = LEAST_POWER * self.length
        power, spread = (np.maximum(np.einsum('tk,tk->k', values, values), floor) for values in (y, centred))
        return HorizonErrors(int(self._origins[self._next]), error / power, error / spread)


def force_and_torque(eps: Array) -> tuple[float, float]:
    """eps^F and eps^T: means over the three forces and the three torques of a wrench (6,)."""
    return float(np.mean(eps[:3])), float(np.mean(eps[3:]))
