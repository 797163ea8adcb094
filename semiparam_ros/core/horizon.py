"""Relative squared prediction error over a horizon, the paper's index (Romeres et al. 2016, section V).

    eps_t[k] = sum_{s=1..T} (y_{t+s}[k] - yhat_{t+s|t}[k])^2 / sum_{s=1..T} y_{t+s}[k]^2

with the model as it stood at t and the inputs as they came. Every sample is predicted by the last T models at once:
their feature weights lie side by side, so that is one product with the features.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dgemv

from semiparam_ros.core.recursion import SemiParametricRecursion
from semiparam_ros.core.types import Array

TINY = np.finfo(float).tiny


class HorizonErrors(NamedTuple):
    """The index of one origin t, known T samples later."""

    origin: int  # [ns] stamp of sample t
    eps: Array  # (n,)
    eps_centred: Array  # (n,) the same with the window's mean removed from the outputs of the denominator


class HorizonIndex:
    """The running index of a :class:`SemiParametricRecursion` over ``length`` T samples."""

    def __init__(self, length: int, n_outputs: int, n_features: int, n_columns: int) -> None:
        self.length = length
        self._weights = np.zeros((length, n_outputs, n_features))
        self._theta = np.zeros((length, n_columns))
        self._squared_error = np.zeros((length, n_outputs))
        self._outputs = np.zeros((length, n_outputs))
        self._origins = np.zeros(length, dtype=np.int64)
        self._filled = 0
        self._next = 0

    def score(self, phi: Array, columns: Array, fixed: Array, outputs: Array) -> HorizonErrors | None:
        """Charge one sample to the last T models; the errors of the oldest when its horizon is now complete.

        :param phi: (D,) features. :param columns: (n, p). :param fixed: (n,) the part that no model learns.
        Call it before the sample is learnt, then :meth:`remember` afterwards.
        """
        predicted = fixed + self._theta @ columns.T
        if phi.size:
            flat = self._weights.reshape(-1, phi.size).T
            predicted += dgemv(1.0, flat, phi, trans=1).reshape(predicted.shape)
        self._squared_error += (outputs - predicted) ** 2
        self._outputs[self._next - 1 if self._filled else 0] = outputs
        return self._complete() if self._filled == self.length else None

    def remember(self, stamp: int, model: SemiParametricRecursion) -> None:
        """Keep the model as it stands after the sample of ``stamp`` [ns], in place of the oldest."""
        slot = self._next
        if model.n_features:
            model.weights(out=self._weights[slot])
        self._theta[slot] = model.theta
        self._squared_error[slot] = 0.0
        self._origins[slot] = stamp
        self._next = (slot + 1) % self.length
        self._filled = min(self._filled + 1, self.length)

    def clear(self) -> None:
        """Forget the pending horizons, as after a jump of the clock."""
        self._filled = self._next = 0

    def _complete(self) -> HorizonErrors:
        oldest = self._next
        error, y = self._squared_error[oldest], self._outputs
        power = np.sum(y**2, axis=0)
        spread = np.sum((y - y.mean(axis=0)) ** 2, axis=0)
        return HorizonErrors(int(self._origins[oldest]), error / np.maximum(power, TINY),
                             error / np.maximum(spread, TINY))


def force_and_torque(eps: Array) -> tuple[float, float]:
    """eps^F and eps^T: means over the three forces and the three torques of a wrench (6,)."""
    return float(np.mean(eps[:3])), float(np.mean(eps[3:]))
