"""The covariance A = sigma^2 I + F F' that all outputs share, factored in the smaller of its two dimensions."""

from __future__ import annotations

import numpy as np
from scipy.linalg import LinAlgError, lapack

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError


class SharedFactor:
    """A = sigma^2 I_t + F F' for scaled features F = rho Phi (t, D), never factored beyond min(t, D).

    With D < t the factor is that of S = sigma^2 I_D + F'F, and A^-1 = (I - F S^-1 F') / sigma^2.
    """

    def __init__(self, features: Array, sigma: float) -> None:
        """:param features: F, (t, D); D = 0 leaves white noise. :param sigma: noise std, > 0."""
        self.features, self.noise = features, sigma * sigma
        self.rows, self.count = features.shape
        self.narrow = self.count < self.rows
        gram = features.T @ features if self.narrow else features @ features.T
        self._root = _cholesky(gram, self.noise)

    @property
    def log_determinant(self) -> float:
        """log |A|."""
        spare = (self.rows - self.count) * np.log(self.noise) if self.narrow else 0.0
        return float(2.0 * np.log(np.diag(self._root)).sum() + spare)

    def solve(self, columns: Array) -> Array:
        """A^-1 B for B (t, q)."""
        if not self.narrow:
            return self._back_substitute(columns)
        if not self.count:
            return np.asarray(columns / self.noise)
        weights = self._back_substitute(self.features.T @ columns)
        return np.asarray((columns - self.features @ weights) / self.noise)

    def solved_features(self) -> Array:
        """A^-1 F, (t, D); equal to F S^-1."""
        if not self.count:
            return self.features
        if self.narrow:
            return self._back_substitute(self.features.T).T
        return self._back_substitute(self.features)

    def _back_substitute(self, columns: Array) -> Array:
        solution, _ = lapack.dpotrs(self._root, columns, lower=1)
        return np.asarray(solution)


def _cholesky(gram: Array, noise: float) -> Array:
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
