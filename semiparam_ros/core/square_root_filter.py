"""D random weights in one array [S | Theta]: a square root S of their covariance P = S S', and q estimates beside it.

What is learnt changes both by multiples of the same vector S f (Potter 1963):

    f = S' phi,  s = sigma^2 + f'f,   S -= S f f' / (s + sigma sqrt(s)),   Theta += S f e' / s

and of both a prediction asks for products with phi. At D = 1000 the array is 9 MB, and the time of a sample is that of
moving it through the processor. So the changes of a few samples wait, M + U V', and are added together; and S f is
computed a block of columns at a time, while the block that gave its part of f is near.

An estimate whose e has always been zero is zero itself: a joint's friction in the effort of another, a distal body in
the effort of a joint that does not carry it. It gets a column in memory with the first e that is not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dgemm, dgemv

from semiparam_ros.core.compiled import AVAILABLE, INTEGER, INTEGERS, MATRIX, NUMBER, VECTOR, compiled
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.errors import SemiparamError

RENORMALISE_ABOVE = 1e3
BLOCK_ELEMENTS = 2**16
"""Elements of a block of columns: 512 kB, which stay in a processor's second cache beside what else is at work."""
MOST_WAITING = 8
"""Changes that wait: with more of them their own products take longer than is won."""


class Projection(NamedTuple):
    """The array's products with features phi (D,)."""

    f: Array  # (D,) S' phi
    reach: Array  # (D,) S f = P phi
    regressed: Array  # (q,) Theta' phi


class SquareRootFilter:
    """[inflation S | Theta] = M + U V', S starting from ``deviation`` times the identity and Theta from zero.

    M', U' and V' lie in memory by rows.
    """

    def __init__(self, size: int, deviation: float, n_estimates: int = 0) -> None:
        self.size = size
        self._array = np.zeros((size + n_estimates, size))
        self._array[:size] = deviation * np.eye(size)
        self._inflation = 1.0  # apart from M, so that growing costs no pass over it
        self._left = np.zeros((MOST_WAITING, size))
        self._right = np.zeros((MOST_WAITING, size + n_estimates))
        self._waiting = 0  # columns of U and V in use
        self._places = np.full(n_estimates, -1)  # of each estimate among the columns after S; -1 while it is zero
        self._placed = 0

    @property
    def arrays(self) -> tuple[Array, Array, Array, int, float, Indices]:
        """M', U' and V', how many changes wait, the inflation and the places: what :func:`project` needs."""
        return self._array, self._left, self._right, self._waiting, self._inflation, self._places

    @property
    def changes(self) -> tuple[Array, Array, int, float, Indices, int]:
        """What :func:`wait` needs of them; :meth:`has_changed` follows it."""
        return self._left, self._right, self._waiting, self._inflation, self._places, self._placed

    def project(self, phi: Array) -> Projection:
        """What a prediction at phi (D,) needs; nothing changes."""
        if AVAILABLE:
            found = Projection(np.empty(self.size), np.empty(self.size), np.empty(len(self._places)))
            project(*self.arrays, phi, *found)
            return found
        return self._project(phi)

    @property
    def _width(self) -> int:
        """Columns of M in use."""
        return self.size + self._placed

    def _project(self, phi: Array) -> Projection:
        size, inflation, array = self.size, self._inflation, self._array.T
        left, right = self._left[:self._waiting].T, self._right[:self._waiting, :self._width].T
        products = right @ (phi @ left)
        f, reach = products[:size], np.zeros(size)
        width = max(1, BLOCK_ELEMENTS // size)
        for start in range(0, size, width):
            columns, part = array[:, start:min(start + width, size)], f[start:start + width]
            dgemv(1.0, columns, phi, beta=1.0, y=part, overwrite_y=1, trans=1)
            dgemv(1.0, columns, part, beta=1.0, y=reach, overwrite_y=1)
        if self._waiting:
            dgemv(1.0, left, f @ right[:size], beta=1.0, y=reach, overwrite_y=1)
        regressed, used = np.zeros(len(self._places)), self._places >= 0
        regressed[used] = (products[size:] + phi @ array[:, size:self._width])[self._places[used]]
        return Projection(inflation * f, inflation**2 * reach, regressed)

    def learn(self, projection: Projection, sigma: float, innovations: Array | None = None) -> None:
        """Take in one observation with noise ``sigma``, whose estimates were wrong by ``innovations`` (q,), None: by 0.

        ``projection`` is that of its features, with no change since.
        """
        if AVAILABLE:
            e = np.zeros(len(self._places)) if innovations is None else innovations
            left, right, waiting, inflation, places, placed = self.changes
            s = sigma**2 + float(projection.f @ projection.f)
            placed = wait(left, right, waiting, projection.f, projection.reach, e, sigma, s, inflation, places, placed)
        else:
            placed = self._wait(projection, sigma, innovations)
        self.has_changed(placed)

    def has_changed(self, placed: int) -> None:
        """One change more waits, and so many estimates have a place now."""
        self._placed = placed
        self._waiting += 1
        if self._waiting == MOST_WAITING:
            self._settle()

    def _wait(self, projection: Projection, sigma: float, innovations: Array | None) -> int:
        f, placed = projection.f, self._placed
        s = sigma**2 + float(f @ f)
        column = self._right[self._waiting]
        self._left[self._waiting] = projection.reach
        np.multiply(f, -1.0 / (self._inflation * (s + sigma * np.sqrt(s))), out=column[:self.size])
        column[self.size:] = 0.0
        if innovations is not None:
            new = np.flatnonzero((self._places < 0) & (innovations != 0.0))
            self._places[new] = placed + np.arange(len(new))
            placed += len(new)
            used = self._places >= 0
            column[self.size + self._places[used]] = innovations[used] / s
        return placed

    def inflate(self, factor: float) -> None:
        """S times ``factor``."""
        self._inflation *= factor
        if self._inflation > RENORMALISE_ABOVE:
            self._settle()
            self._array[:self.size] *= self._inflation
            self._inflation = 1.0

    def estimates(self) -> Array:
        """Theta' (q, D)."""
        size, waiting, used = self.size, self._waiting, self._places >= 0
        placed = self._array[size:] + self._right[:waiting, size:].T @ self._left[:waiting]
        found = np.zeros((len(self._places), size))
        found[used] = placed[self._places[used]]
        return found

    def state(self) -> dict[str, Array | Indices]:
        """M', U', V', the places and the inflation; :meth:`restore` takes them back bit for bit."""
        return {'array': self._array.copy(), 'left': self._left.copy(), 'right': self._right.copy(),
                'waiting': np.array(self._waiting), 'places': self._places.copy(),
                'inflation': np.array(self._inflation)}

    def restore(self, state: Mapping[str, Array | Indices]) -> None:
        """Return to a saved :meth:`state` of the same size.

        Raises SemiparamError, with nothing changed, when the number of waiting changes or a place is impossible.
        """
        if state['waiting'] not in range(MOST_WAITING):
            raise SemiparamError(f"the saved 'waiting' is {state['waiting']}; expected a number from 0 to "
                                 f'{MOST_WAITING - 1}.')
        places = np.array(state['places'], dtype=np.int64)
        used = np.sort(places[places >= 0])
        if (used != np.arange(len(used))).any() or places.min(initial=0) < -1:
            raise SemiparamError(f"the saved 'places' of the estimates are {places.tolist()}; expected different ones "
                                 'from 0 on, and -1.')
        self._places, self._placed = places, len(used)
        self._array, self._left, self._right = (np.array(state[name], dtype=float, order='C')
                                                for name in ('array', 'left', 'right'))
        self._waiting, self._inflation = int(state['waiting']), float(state['inflation'])

    def _settle(self) -> None:
        """M takes in the changes that wait."""
        array, left, right = self._array.T, self._left[:self._waiting].T, self._right[:self._waiting].T
        width = max(1, BLOCK_ELEMENTS // self.size)
        for start in range(0, self._width, width):
            block = slice(start, min(start + width, self._width))
            dgemm(1.0, left, right[block], beta=1.0, c=array[:, block], trans_b=1, overwrite_c=1)
        self._waiting = 0


@compiled(MATRIX, MATRIX, MATRIX, INTEGER, NUMBER, INTEGERS, VECTOR, VECTOR, VECTOR, VECTOR)
def project(array: Array, left: Array, right: Array, waiting: int, inflation: float, places: Indices, phi: Array,
            f: Array, reach: Array, regressed: Array) -> None:
    """f (D,), S f into ``reach`` (D,), and Theta' phi into ``regressed`` (q,), of M', U' and V'.

    Four columns of M at a time: what they give of f goes at once into S f, while they are in the first cache.
    """
    size, width = len(f), len(f)
    for e in range(len(places)):
        width += places[e] >= 0
    products = np.zeros(width)  # f, then Theta' phi as far as it is placed
    reach[:] = 0.0
    for change in range(waiting):
        along = 0.0
        for i in range(size):
            along += left[change, i] * phi[i]
        for j in range(width):
            products[j] += along * right[change, j]
    fours, together = width - width % 4, size - size % 4
    for j in range(0, fours, 4):
        a = b = c = d = 0.0
        for i in range(size):
            a += array[j, i] * phi[i]
            b += array[j + 1, i] * phi[i]
            c += array[j + 2, i] * phi[i]
            d += array[j + 3, i] * phi[i]
        products[j] += a
        products[j + 1] += b
        products[j + 2] += c
        products[j + 3] += d
        if j < together:
            a, b, c, d = products[j], products[j + 1], products[j + 2], products[j + 3]
            for i in range(size):
                reach[i] += array[j, i] * a + array[j + 1, i] * b + array[j + 2, i] * c + array[j + 3, i] * d
    for j in range(fours, width):
        a = 0.0
        for i in range(size):
            a += array[j, i] * phi[i]
        products[j] += a
    for j in range(together, size):
        for i in range(size):
            reach[i] += array[j, i] * products[j]
    for change in range(waiting):
        along = 0.0
        for j in range(size):
            along += right[change, j] * products[j]
        for i in range(size):
            reach[i] += along * left[change, i]
    for i in range(size):
        f[i] = products[i] * inflation
        reach[i] *= inflation * inflation
    for e in range(len(places)):
        regressed[e] = products[size + places[e]] if places[e] >= 0 else 0.0


@compiled(MATRIX, MATRIX, INTEGER, VECTOR, VECTOR, VECTOR, NUMBER, NUMBER, NUMBER, INTEGERS, INTEGER, returns=INTEGER)
def wait(left: Array, right: Array, waiting: int, f: Array, reach: Array, innovations: Array, sigma: float, s: float,
         inflation: float, places: Indices, placed: int) -> int:
    """One more change, a row of U' and one of V'; how many estimates have a place now."""
    size = len(f)
    if size == 0:
        return placed
    share = -1.0 / (inflation * (s + sigma * np.sqrt(s)))
    for i in range(size):
        left[waiting, i] = reach[i]
        right[waiting, i] = share * f[i]
    for e in range(len(innovations)):
        if places[e] < 0 and innovations[e] != 0.0:
            places[e] = placed
            placed += 1
        if places[e] >= 0:
            right[waiting, size + places[e]] = innovations[e] / s
    return placed
