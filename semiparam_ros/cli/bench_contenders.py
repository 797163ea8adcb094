"""The recursions that `semiparam bench` runs beside ours: parts of it alone, and the textbook's."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.blas import dgemv, dger, drot, dsymv, dsyr, dtrsv

from semiparam_ros.core.types import Array

SIGMA = 0.1


class Covariance:
    """P alone, as a symmetric matrix: k = P phi, P -= k k' / (sigma^2 + phi'k). Cheapest, and the least accurate."""

    def __init__(self, n_features: int) -> None:
        self._covariance = np.asfortranarray(np.eye(n_features))

    def update(self, phi: Array) -> None:
        """Learn that the features (D,) were seen; weights are not kept."""
        gain = dsymv(1.0, self._covariance, phi)
        dsyr(-1.0 / (SIGMA**2 + float(phi @ gain)), gain, a=self._covariance, overwrite_a=1)


class Potter:
    """The square root S of P alone, by Potter's update: what ours does to the features and nothing else."""

    def __init__(self, n_features: int) -> None:
        self._root = np.asfortranarray(np.eye(n_features))

    def update(self, phi: Array) -> None:
        """As :meth:`Covariance.update`."""
        f = dgemv(1.0, self._root, phi, trans=1)
        s = SIGMA**2 + float(f @ f)
        gain = dgemv(1.0, self._root, f)
        dger(-1.0 / (s + SIGMA * math.sqrt(s)), gain, f, a=self._root, overwrite_a=1)


class Dense:
    """The textbook's recursion on all p + D n unknowns: a Cholesky factor, one rank-1 update for each output.

    The factor R (R'R = information) is stored by rows.

    :param together: pass over the factor once a sample with all n rows, instead of once for each row: the same
        rotations in another order, kinder to the caches than the textbook.
    """

    def __init__(self, n_columns: int, n_features: int, n_outputs: int, together: bool = False) -> None:
        self.size = n_columns + n_features * n_outputs
        self.n_outputs, self.together = n_outputs, together
        self._factor = np.eye(self.size)
        self._rhs = np.zeros(self.size)
        self.unknowns = np.zeros(self.size)

    def update(self, columns: Array, phi: Array, outputs: Array) -> None:
        """Learn one sample: coupled columns (n, p), features (D,), outputs (n,); solve for the unknowns."""
        rows = np.hstack([columns, np.kron(phi, np.eye(self.n_outputs))]) / SIGMA
        self._rhs += rows.T @ outputs / SIGMA
        for several in [rows] if self.together else rows[:, None]:
            self._rotate(several)
        half = dtrsv(self._factor.T, self._rhs, lower=1)
        self.unknowns = dtrsv(self._factor.T, half, lower=1, trans=1)

    def _rotate(self, rows: Array) -> None:
        """Givens rotations of each row of R with the new rows; scipy has no rank-1 update of a Cholesky factor."""
        flat, size = self._factor.reshape(-1), self.size
        for index in range(size):
            start = index * (size + 1)
            for row in rows:
                diagonal, below = flat[start], row[index]
                if below == 0.0:
                    continue
                radius = math.hypot(diagonal, below)
                drot(flat, row, diagonal / radius, below / radius, n=size - index, offx=start, offy=index,
                     overwrite_x=1, overwrite_y=1)
