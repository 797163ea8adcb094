"""A square root S of the covariance P = S S' of D weights, updated with Potter's formula (1963).

At D = 1000 the root is 8 MB, and a sample's time is that of moving it through the processor. So the update of one
sample waits for the next one, and is done, a block of columns at a time, together with what that one asks of S: two
passes in place of four.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.blas import dgemv, dger

from semiparam_ros.core.types import Array

RENORMALISE_ABOVE = 1e3
BLOCK_ELEMENTS = 2**17
"""Elements of a block of columns: 1 MB, which stays in a processor's second cache."""


class SquareRoot:
    """S = inflation (M + waiting update), starting from ``deviation`` times the identity."""

    def __init__(self, size: int, deviation: float) -> None:
        self.size = size
        self._matrix = np.asfortranarray(deviation * np.eye(size))
        self._inflation = 1.0  # apart from M, so that growing costs no pass over it
        self._waiting: tuple[float, Array, Array] | None = None

    def project(self, phi: Array) -> tuple[Array, Array]:
        """f = S' phi and S f, both (D,)."""
        f, reach = np.empty(self.size), np.zeros(self.size)
        width = max(1, BLOCK_ELEMENTS // self.size)
        for start in range(0, self.size, width):
            block = slice(start, min(start + width, self.size))
            columns = self._settled(block)
            part = dgemv(self._inflation, columns, phi, trans=1)
            reach = dgemv(self._inflation, columns, part, beta=1.0, y=reach, overwrite_y=1)
            f[block] = part
        self._waiting = None
        return f, reach

    def shrink(self, f: Array, reach: Array, sigma: float) -> None:
        """S -= S f f' / (s + sigma sqrt(s)), s = sigma^2 + f'f: learn one observation with noise ``sigma``.

        ``f`` and ``reach`` are those of :meth:`project`, with no other update since.
        """
        self._settle()
        s = sigma**2 + float(f @ f)
        self._waiting = (-1.0 / (self._inflation * (s + sigma * np.sqrt(s))), reach, f)

    def inflate(self, factor: float) -> None:
        """S times ``factor``."""
        self._inflation *= factor
        if self._inflation > RENORMALISE_ABOVE:
            self._settle()
            self._matrix *= self._inflation
            self._inflation = 1.0

    def state(self) -> dict[str, Array]:
        """M with no update waiting, and the inflation; :meth:`restore` takes them back bit for bit."""
        self._settle()
        return {'root': self._matrix.copy(order='F'), 'inflation': np.array(self._inflation)}

    def restore(self, state: dict[str, Array]) -> None:
        """Return to a saved :meth:`state` of the same size."""
        self._matrix = np.array(state['root'], dtype=float, order='F')
        self._inflation = float(state['inflation'])
        self._waiting = None

    def _settle(self) -> None:
        if self._waiting is not None:
            self._settled(slice(0, self.size))
            self._waiting = None

    def _settled(self, block: slice) -> Array:
        """A view of columns of M, after the waiting update."""
        columns = self._matrix[:, block]
        if self._waiting is not None:
            factor, reach, f = self._waiting
            dger(factor, reach, f[block], a=columns, overwrite_a=1)
        return columns
