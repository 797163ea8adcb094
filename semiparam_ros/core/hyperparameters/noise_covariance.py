"""The covariance of a window that all outputs share: white noise, a slow drift and the features.

Noise that is white plus a slow disturbance, for the evidence of a window. On real arms the residual stays correlated
for seconds (0.67 at lag 20 on the iCub). A likelihood that takes samples for independent then explains the disturbance
by features of short length scale, which no other recording repeats. Here the noise of each output has covariance
sigma^2 N with

    N = I + kappa R,  R[i, j] = a^|i - j|,  a = exp(-step / memory)

R^-1 is tridiagonal, so N^-1 = I - kappa T^-1 with T = R^-1 + kappa I costs O(t) a column.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, lapack

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError


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
        from scipy.signal import lfilter  # loads all of scipy.stats, which a node need not wait for when it starts

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


class CovarianceSlopes(NamedTuple):
    """Derivatives of the log evidence: by logarithms, and by the scaled features (t, D)."""

    rho: float
    sigma: float
    kappa: float
    memory: float
    features: Array


class SharedFactor:
    """A = B + F F' for scaled features F = rho Phi (t, D); B = sigma^2 I, or sigma^2 N when the noise drifts.

    With D < t, and always when it drifts, the factor is that of S = sigma^2 (I_D + F'B^-1 F), and
    A^-1 = B^-1 - sigma^2 B^-1 F S^-1 F'B^-1; otherwise that of A itself.
    """

    def __init__(self, features: Array, sigma: float, drift: Drift | None = None) -> None:
        """:param features: F, (t, D); D = 0 leaves noise alone. :param sigma: std of the white noise, > 0."""
        self.features, self.noise, self.drift = features, sigma * sigma, drift
        self.rows, self.count = features.shape
        self.narrow = drift is not None or self.count < self.rows
        self._white = features if drift is None or not self.count else drift.whiten(features)  # sigma^2 B^-1 F
        gram = features.T @ self._white if self.narrow else features @ features.T
        self._root = cholesky_with_noise(gram, self.noise)

    @property
    def log_determinant(self) -> float:
        """log |A|."""
        spare = (self.rows - self.count) * np.log(self.noise) if self.narrow else 0.0
        drift = self.drift.log_determinant if self.drift is not None else 0.0
        return float(2.0 * np.log(np.diag(self._root)).sum() + spare + drift)

    def solve(self, columns: Array) -> Array:
        """A^-1 X for X (t, q)."""
        if not self.narrow:
            return self._back_substitute(columns)
        white = columns if self.drift is None else self.drift.whiten(columns)
        if self.count:
            white = white - self._white @ self._back_substitute(self._white.T @ columns)
        return np.asarray(white / self.noise)

    def solved_features(self) -> Array:
        """A^-1 F, (t, D); equal to sigma^2 B^-1 F S^-1."""
        if not self.count:
            return self.features
        if self.narrow:
            return self._back_substitute(self._white.T).T
        return self._back_substitute(self.features)

    def slopes(self, z: Array, n: int) -> CovarianceSlopes:
        """Everything that follows from dL/dA = (Z Z' - n A^-1) / 2, for Z (t, q)."""
        solved = self.solved_features()
        by_features = z @ (z.T @ self.features) - n * solved
        rho = float(np.sum(by_features * self.features))
        # tr A^-1 B = t - tr(F'A^-1 F) keeps its absolute accuracy as sigma vanishes
        trace = self.rows - float(np.sum(self.features * solved))
        square = self.noise * float(np.sum(z * z))
        if self.drift is None:
            return CovarianceSlopes(rho, square - n * trace, 0.0, 0.0, by_features)
        kappa, memory = self._drift_slopes(self.drift, z, n, solved)
        slow = self.noise * self.drift.kappa * float(np.sum(z * self.drift.correlate(z)))
        return CovarianceSlopes(rho, square + slow - n * trace, kappa, memory, by_features)

    def _drift_slopes(self, drift: Drift, z: Array, n: int, solved: Array) -> tuple[float, float]:
        """By log kappa and log memory: tr A^-1 X = tr B^-1 X - tr(B^-1 F (A^-1 F)' X) for X = dB, both with O(t D)."""
        slopes = []
        for apply, whole in zip((drift.correlate, drift.correlate_slope), drift.determinant_slopes(), strict=True):
            part = float(np.sum(self._white * apply(solved))) if self.count else 0.0
            square = self.noise * float(np.sum(z * apply(z)))
            slopes.append(0.5 * (drift.kappa * square - n * (whole - drift.kappa * part)))
        return slopes[0], slopes[1]

    def _back_substitute(self, columns: Array) -> Array:
        solution, _ = lapack.dpotrs(self._root, columns, lower=1)
        return np.asarray(solution)


def cholesky_with_noise(gram: Array, noise: float) -> Array:
    """Lower factor of gram + noise I; where rounding eats a tiny noise, the least jitter that helps is added."""
    if not len(gram):
        return gram
    scale = float(np.trace(gram)) / len(gram)
    if not np.isfinite(scale):
        raise SemiparamError('the features or hyperparameters are not finite: the evidence cannot be computed.')
    for jitter in (0.0, 1e-15, 1e-14, 1e-13, 1e-12, 1e-11):
        matrix = np.array(gram, order='F')
        matrix[np.diag_indices_from(matrix)] += noise + jitter * scale * len(gram)
        root, fault = lapack.dpotrf(matrix, lower=1, clean=0, overwrite_a=1)
        if fault == 0:
            return np.asarray(root)
    raise LinAlgError('the shared covariance is not positive definite')  # pragma: no cover
