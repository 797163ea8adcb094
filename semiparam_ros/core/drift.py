"""Noise that is white plus a slow disturbance, for the evidence of a window.

On real arms the residual stays correlated for seconds (0.67 at lag 20 on the iCub). A likelihood that takes samples
for independent then explains the disturbance by features of short length scale, which no other recording repeats.
Here the noise of each output has covariance sigma^2 N with

    N = I + kappa R,  R[i, j] = a^|i - j|,  a = exp(-step / memory)

R^-1 is tridiagonal, so N^-1 = I - kappa T^-1 with T = R^-1 + kappa I costs O(t) a column.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack
from scipy.signal import lfilter

from semiparam_ros.core.types import Array


class Drift:
    """N = I + kappa R on ``steps`` samples."""

    def __init__(self, steps: int, kappa: float, memory: float, step: int = 1) -> None:
        """:param kappa: variance of the drift over that of the white part, > 0. :param memory: e-folding time of the
        drift, in samples of the recording. :param step: distance of the window's samples in the recording."""
        self.steps, self.kappa = steps, kappa
        self.decay = float(np.exp(-step / memory))
        self._rate = step / memory
        self._inverse = _inverse_correlation(steps, self.decay)
        self._factor = lapack.dpttrf(self._inverse[0] + kappa, self._inverse[1])[:2]

    def whiten(self, columns: Array) -> Array:
        """N^-1 X for X (t, q)."""
        solved, _ = lapack.dpttrs(*self._factor, columns)
        return np.asarray(columns - self.kappa * solved)

    @property
    def log_determinant(self) -> float:
        """log |N|, with |R| = (1 - a^2)^(t - 1)."""
        return float(np.log(self._factor[0]).sum() + (self.steps - 1) * np.log1p(-self.decay**2))

    def correlate(self, columns: Array) -> Array:
        """R X, by one recursion forwards and one backwards."""
        return self._both_ways(columns, [1.0], [1.0, -self.decay]) - columns

    def correlate_slope(self, columns: Array) -> Array:
        """(dR / dlog memory) X; the weights k a^k have the generating function a z / (1 - a z)^2."""
        a = self.decay
        return self._rate * self._both_ways(columns, [0.0, a], [1.0, -2.0 * a, a * a])

    def determinant_slopes(self) -> tuple[float, float]:
        """Derivatives of log |N| by log kappa and by log memory."""
        diagonal, beside = _tridiagonal_inverse(*self._factor)
        a, rate = self.decay, self._rate
        by_decay = _inverse_correlation_slope(self.steps, a)
        trace = float(diagonal @ by_decay[0] + 2.0 * beside @ by_decay[1]) - (self.steps - 1) * 2.0 * a / (1.0 - a * a)
        return self.kappa * float(diagonal.sum()), trace * rate * a

    @staticmethod
    def _both_ways(columns: Array, numerator: list[float], denominator: list[float]) -> Array:
        forwards = lfilter(numerator, denominator, columns, axis=0)
        return np.asarray(forwards + lfilter(numerator, denominator, columns[::-1], axis=0)[::-1])


def _inverse_correlation(steps: int, a: float) -> tuple[Array, Array]:
    """Diagonal and off-diagonal of R^-1 = tridiag(-a, 1 + a^2, -a) / (1 - a^2), with 1 at both corners."""
    diagonal = np.full(steps, 1.0 + a * a)
    diagonal[[0, -1]] = 1.0
    return diagonal / (1.0 - a * a), np.full(steps - 1, -a / (1.0 - a * a))


def _inverse_correlation_slope(steps: int, a: float) -> tuple[Array, Array]:
    """Derivatives of :func:`_inverse_correlation` by a."""
    square = (1.0 - a * a) ** 2
    diagonal = np.full(steps, 4.0 * a / square)
    diagonal[[0, -1]] = 2.0 * a / square
    return diagonal, np.full(steps - 1, -(1.0 + a * a) / square)


def _tridiagonal_inverse(d: Array, e: Array) -> tuple[Array, Array]:
    """Diagonal and off-diagonal of T^-1 from T = L diag(d) L', L unit bidiagonal with e: the Takahashi recursion."""
    diagonal, beside = np.empty(len(d)), np.empty(len(e))
    diagonal[-1] = last = 1.0 / d[-1]
    for i, (pivot, factor) in enumerate(zip(d[-2::-1].tolist(), e[::-1].tolist(), strict=True)):
        beside[-1 - i] = -factor * last
        diagonal[-2 - i] = last = 1.0 / pivot + factor * factor * last
    return diagonal, beside
