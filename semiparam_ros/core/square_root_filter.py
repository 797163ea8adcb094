"""D random weights in one array [S | Theta]: a square root S of their covariance P = S S', and q
estimates beside it.

What is learnt changes both by multiples of the same vector S f (Potter 1963):

    f = S' phi,  s = sigma^2 + f'f,   S -= S f f' / (s + sigma sqrt(s)),   Theta += S f e' / s

and of both a prediction asks for products with phi. At D = 1000 the array is 9 MB, and the time of
a sample is that of moving it through the processor. So the changes of a few samples wait, M + U V',
and are added together; and S f is computed four columns at a time, while those that gave their part
of f are near.

An estimate whose e has always been zero is zero itself: a joint's friction in the effort of
another, a distal body in the effort of a joint that does not carry it. It gets a column in memory
with the first e that is not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dgemm

from semiparam_ros.core.compiled import Integers, Matrix, Vector, compiled
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.errors import SemiparamError

RENORMALISE_ABOVE = 1e3
BLOCK_ELEMENTS = 2**16
"""Elements of a block of columns: 512 kB, which stay in a processor's second cache beside what else
is at work."""
MOST_WAITING = 8
"""Changes that wait: with more of them their own products take longer than is won."""


class Root(NamedTuple):
    """[inflation S | Theta] = M + U V' of D features and q estimates; arrays are changed in
    place."""

    array: Matrix  # (D + q, D) M'
    left: Matrix  # (w, D) U'
    right: Matrix  # (w, D + q) V'
    waiting: int  # columns of U and V in use
    inflation: float  # apart from M, so that growing costs no pass over it
    places: Integers  # (q,) of each estimate among the columns after S; -1 while it is zero
    placed: int


class Projection(NamedTuple):
    """The array's products with features phi (D,)."""

    f: Vector  # (D,) S' phi
    reach: Vector  # (D,) S f = P phi
    regressed: Vector  # (q,) Theta' phi


class SquareRootFilter:
    """The array [S | Theta], S starting from ``deviation`` times the identity and Theta from
    zero."""

    def __init__(self, size: int, deviation: float, n_estimates: int = 0) -> None:
        self.size = size
        array = np.zeros((size + n_estimates, size))
        left, right = np.zeros((MOST_WAITING, size)), np.zeros((MOST_WAITING, size + n_estimates))
        self.root = Root(array, left, right, 0, 1.0, np.full(n_estimates, -1), 0)
        self.begin(deviation, np.zeros((n_estimates, size)))

    def begin(self, deviation: float | None, estimates: Array) -> None:
        """Start anew, Theta' from estimates (q, D); where no deviation is given S stays."""
        if deviation is None and self.root.waiting:
            self._settle()
        root, size, used = self.root, self.size, estimates.any(axis=1)
        placed = int(used.sum())
        root.array[size:], root.right[:, size:] = 0.0, 0.0  # of an estimate whose place is yet to be given again
        if deviation is not None:
            root.array[:size] = deviation * np.eye(size)
            root = root._replace(waiting=0, inflation=1.0)
        root.array[size : size + placed] = estimates[used]
        places = np.where(used, np.cumsum(used) - 1, -1)
        self.root = root._replace(places=places, placed=placed)

    def project(self, phi: Array) -> Projection:
        """Products that a prediction at phi (D,) needs; nothing changes."""
        size, n_estimates = self.size, len(self.root.places)
        found = Projection(np.empty(size), np.empty(size), np.empty(n_estimates))
        project(self.root, phi, found)
        return found

    def learn(self, projection: Projection, sigma: float, innovations: Array | None = None) -> None:
        """Take in one observation with noise ``sigma``, whose estimates were wrong by
        ``innovations`` (q,), None: by 0.

        ``projection`` is that of its features, with no change since.
        """
        innovations = np.zeros(len(self.root.places)) if innovations is None else innovations
        self.has_changed(wait(self.root, projection, innovations, sigma))

    def has_changed(self, placed: int) -> None:
        """One change more waits, and so many estimates have a place now."""
        array, left, right, waiting, inflation, places, _ = self.root
        self.root = Root(array, left, right, waiting + 1, inflation, places, placed)
        if waiting + 1 == MOST_WAITING:
            self._settle()

    def inflate(self, factor: float) -> None:
        """S times ``factor``."""
        inflation = self.root.inflation * factor
        if inflation > RENORMALISE_ABOVE:
            self._settle()
            self.root.array[:self.size] *= inflation
            inflation = 1.0
        self.root = self.root._replace(inflation=inflation)

    def estimates(self) -> Array:
        """Theta' (q, D)."""
        root, size = self.root, self.size
        used = root.places >= 0
        placed = root.array[size:] + root.right[:root.waiting, size:].T @ root.left[:root.waiting]
        found = np.zeros((len(root.places), size))
        found[used] = placed[root.places[used]]
        return found

    def state(self) -> dict[str, Array | Indices]:
        """M', U', V', the places and the inflation; :meth:`restore` takes them back bit for bit."""
        return {name: np.array(value) for name, value in self.root._asdict().items()
                if name != 'placed'}

    def restore(self, state: Mapping[str, Array | Indices]) -> None:
        """Return to a saved :meth:`state` of the same size.

        Raises SemiparamError, with nothing changed, when the number of waiting changes or a place
        is impossible.
        """
        if state['waiting'] not in range(MOST_WAITING):
            raise SemiparamError(f"the saved 'waiting' is {state['waiting']}; expected a number from 0 to "
                                 f'{MOST_WAITING - 1}.')
        places = np.array(state['places'], dtype=np.int64)
        used = np.sort(places[places >= 0])
        if (used != np.arange(len(used))).any() or places.min(initial=0) < -1:
            raise SemiparamError(f"the saved 'places' of the estimates are {places.tolist()}; expected different ones "
                                 'from 0 on, and -1.')
        array, left, right = (np.array(state[name], dtype=float, order='C')
                              for name in ('array', 'left', 'right'))
        self.root = Root(array, left, right, int(state['waiting']), float(state['inflation']),
                         places, len(used))

    def _settle(self) -> None:
        """M takes in the changes that wait."""
        root = self.root
        array, left, right = root.array.T, root.left[:root.waiting].T, root.right[:root.waiting].T
        width, end = max(1, BLOCK_ELEMENTS // self.size), self.size + root.placed
        for start in range(0, end, width):
            block = slice(start, min(start + width, end))
            dgemm(1.0, left, right[block], beta=1.0, c=array[:, block], trans_b=1, overwrite_c=1)
        self.root = root._replace(waiting=0)


@compiled
def pass_over(array: Matrix, phi: Vector, products: Vector, reach: Vector) -> None:
    """M' phi added to ``products`` (D + q,), and of the first D of these M times them into
    ``reach`` (D,).

    Four columns of M at a time: what they give of f goes at once into S f, while they are in the
    first cache.
    """
    size, width = len(phi), len(products)
    fours, together = width - width % 4, size - size % 4
    reach[:] = 0.0
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


@compiled
def project(root: Root, phi: Vector, projection: Projection) -> None:
    """See :meth:`SquareRootFilter.project`."""
    left, right, places = root.left, root.right, root.places
    f, reach, regressed = projection
    size, width = len(f), len(f) + root.placed
    products = np.zeros(width)  # f, then Theta' phi as far as it is placed
    for change in range(root.waiting):
        along = 0.0
        for i in range(size):
            along += left[change, i] * phi[i]
        for j in range(width):
            products[j] += along * right[change, j]
    pass_over(root.array, phi, products, reach)
    for change in range(root.waiting):
        along = 0.0
        for j in range(size):
            along += right[change, j] * products[j]
        for i in range(size):
            reach[i] += along * left[change, i]
    for i in range(size):
        f[i] = products[i] * root.inflation
        reach[i] *= root.inflation * root.inflation
    for e in range(len(places)):
        regressed[e] = products[size + places[e]] if places[e] >= 0 else 0.0


@compiled
def variance(f: Vector, sigma: float) -> float:
    """s = sigma^2 + f'f of a projection."""
    s = sigma * sigma
    for i in range(len(f)):
        s += f[i] * f[i]
    return s


@compiled
def wait(root: Root, projection: Projection, innovations: Vector, sigma: float) -> int:
    """One more change, a row of U' and one of V'; how many estimates have a place now."""
    s = variance(projection.f, sigma)
    size, placed, places = len(projection.f), root.placed, root.places
    if size == 0:
        return placed
    left, right = root.left[root.waiting], root.right[root.waiting]
    share = -1.0 / (root.inflation * (s + sigma * np.sqrt(s)))
    for i in range(size):
        left[i] = projection.reach[i]
        right[i] = share * projection.f[i]
    for e in range(len(innovations)):
        if places[e] < 0 and innovations[e] != 0.0:
            places[e] = placed
            placed += 1
        if places[e] >= 0:
            right[size + places[e]] = innovations[e] / s
    return placed
