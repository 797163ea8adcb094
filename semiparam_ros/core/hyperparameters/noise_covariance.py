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

from semiparam_ros.core.compiled import Matrix, Vector, compiled
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
        diagonal, beside = self._factor
        return _whitened(np.ascontiguousarray(columns), diagonal, beside, self.kappa)

    @property
    def log_determinant(self) -> float:
        """log |N|, with |R| = (1 - a^2)^(t - 1)."""
        return float(np.log(self._factor[0]).sum() + (self.steps - 1) * np.log1p(-self.decay**2))

    def correlation(self, left: Array, right: Array) -> Array:
        """(2,) tr X'R Y and tr X'(dR / dlog memory) Y, the sums over all pairs of rows of x_i y_j a^k and of
        step / memory x_i y_j k a^k with k = |i - j|, for X and Y (t, q)."""
        sums = _correlated(np.ascontiguousarray(left), np.ascontiguousarray(right), self.decay)
        return sums * (1.0, self._rate)

    def determinant_slopes(self) -> Array:
        """(2,) derivatives of log |N| by log kappa and by log memory."""
        diagonal, beside = _tridiagonal_inverse(*self._factor)
        a, rate = self.decay, self._rate
        by_decay = _inverse_correlation_slope(self.steps, a)
        trace = float(diagonal @ by_decay[0] + 2.0 * beside @ by_decay[1]) - (self.steps - 1) * 2.0 * a / (1.0 - a * a)
        return np.array([self.kappa * diagonal.sum(), trace * rate * a])


@compiled
def _whitened(columns: Matrix, d: Vector, e: Vector, kappa: float) -> Matrix:
    """X - kappa T^-1 X for X (t, q), with T = L diag(d) L', L unit bidiagonal with e."""
    steps, width = columns.shape
    white = np.empty((steps, width))
    for j in range(width):
        white[0, j] = columns[0, j]
    for i in range(1, steps):
        for j in range(width):
            white[i, j] = columns[i, j] - e[i - 1] * white[i - 1, j]
    solved = np.zeros(width)
    for i in range(steps - 1, -1, -1):
        after = e[i] if i < steps - 1 else 0.0
        for j in range(width):
            solved[j] = white[i, j] / d[i] - after * solved[j]
            white[i, j] = columns[i, j] - kappa * solved[j]
    return white


@compiled
def _correlated(left: Matrix, right: Matrix, a: float) -> Vector:
    """See :meth:`Drift.correlation`, without its factors.

    What earlier rows bring to a row follows recursions: f_i = a (f_{i-1} + x_{i-1}) is the sum of
    a^k x_{i-k}, and g_i = a (g_{i-1} + f_{i-1} + x_{i-1}) that of k a^k x_{i-k}.
    """
    width, sums = left.shape[1], np.zeros(2)
    f_left, f_right, g_left, g_right = np.zeros(width), np.zeros(width), np.zeros(width), np.zeros(width)
    for i in range(len(left)):
        value = slope = 0.0
        for j in range(width):
            x, y = left[i, j], right[i, j]
            value += x * y + x * f_right[j] + y * f_left[j]
            slope += x * g_right[j] + y * g_left[j]
            g_left[j] = a * (g_left[j] + f_left[j] + x)
            g_right[j] = a * (g_right[j] + f_right[j] + y)
            f_left[j] = a * (f_left[j] + x)
            f_right[j] = a * (f_right[j] + y)
        sums[0] += value
        sums[1] += slope
    return sums


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
        white = columns.copy() if self.drift is None else self.drift.whiten(columns)
        if self.count:
            white -= self._white @ self._back_substitute(self._white.T @ columns)
        white /= self.noise
        return white

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
        # tr A^-1 X = tr B^-1 X - tr(B^-1 F (A^-1 F)' X) for the derivatives X of B by log kappa and log memory
        slow = self.drift.kappa * self.noise * self.drift.correlation(z, z)
        left = self.drift.kappa * self.drift.correlation(self._white, solved)
        kappa, memory = 0.5 * (slow - n * (self.drift.determinant_slopes() - left))
        return CovarianceSlopes(rho, square + float(slow[0]) - n * trace, float(kappa), float(memory), by_features)

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
