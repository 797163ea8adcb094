"""Errors of a model that learns no more on the motion that follows: what to expect of it elsewhere.

Errors of a model that goes on learning say little of other motion, for it follows each sample. So a copy of the
coefficients is kept for a block of some seconds and predicts them without learning, without the wandering offset (a
left-out block; Stone 1974). Of each block, each model m and each output k the mean square is kept, e_mk^2. Then

    s_mk = median over the blocks of e_mk                  the error to expect
    w_mk ~ prod over the blocks of 1 / e_mk                the weights of the models

with one degree of freedom for each block, since errors within one are alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.errors import SemiparamError

BLOCK_NS = 5 * NANOSECONDS
"""Errors of measured arms stay alike for one to three seconds."""
BLOCKS = 32
"""The latest ones count: two to three minutes of motion."""
CHARGED_EVERY = 8
"""Of the samples of a block, one in so many is predicted."""
FEWEST = 5
"""Samples of a block that counts, which lasts until it has them."""
LEAST_SQUARE, LARGEST_ERROR = 1e-24, 1e100


class Coefficients(NamedTuple):
    """Coefficients of one model: mean = C theta + alpha phi, with the columns C that it covers."""

    theta: Array  # (p,)
    alpha: Array  # (n, D)


class CarryOver:
    """Squared errors of K models over the last blocks, from coefficients that stood still since each began."""

    def __init__(self, n_models: int, n_outputs: int) -> None:
        self._blocks = np.zeros((BLOCKS, n_models, n_outputs))
        self._finished = 0
        self._sums = np.zeros((n_models, n_outputs))
        self._frozen: tuple[Coefficients, ...] = ()
        self._told: tuple[int, Array, Array] | None = None
        self.interrupt()

    def interrupt(self) -> None:
        """Drop the block that is not finished, as after a jump of the clock or a change of the robot."""
        self._frozen, self._since, self._charged, self._passed = (), 0, 0, 0
        self._sums[:] = 0.0

    def next_is_due(self) -> bool:
        """Count one more sample, and tell whether it is predicted."""
        self._passed += 1
        return self._passed % CHARGED_EVERY == 0

    def wants_coefficients(self, stamp: int) -> bool:
        """Tell whether a block ends with the sample of ``stamp`` [ns], and another one begins; one of a slow robot, or
        of short motions, goes on until it counts."""
        since = stamp - self._since
        return not self._frozen or since < 0 or (since >= BLOCK_NS and self._charged >= FEWEST)

    def begin_block(self, stamp: int, coefficients: Sequence[Coefficients]) -> None:
        """The next block is predicted from these; one in which the clock jumped back is dropped."""
        if self._charged >= FEWEST and stamp >= self._since:
            self._blocks[self._finished % BLOCKS] = np.maximum(self._sums / self._charged, LEAST_SQUARE)
            self._finished += 1
        self.interrupt()
        self._since, self._frozen = stamp, tuple(coefficients)

    def charge(self, outputs: Array, columns: Sequence[Array], features: Sequence[Array]) -> None:
        """Add the errors of a sample (n,), from each model's columns (n, p) and features (D,)."""
        for sums, (theta, alpha), c, phi in zip(self._sums, self._frozen, columns, features, strict=True):
            error = outputs - c @ theta
            if len(phi):
                error -= alpha @ phi
            sums += np.square(np.clip(error, -LARGEST_ERROR, LARGEST_ERROR))
        self._charged += 1

    @property
    def squares(self) -> Array:
        """(B, K, n) mean squares of the finished blocks, in no order."""
        return self._blocks[:min(self._finished, BLOCKS)]

    def expected(self, otherwise: Array) -> Array:
        """(K, n) s, and ``otherwise`` (K, n) where it is larger or no block is finished."""
        return np.maximum(self._of_blocks()[1], otherwise) if self._finished else otherwise

    @property
    def log_weights(self) -> Array:
        """(K, n) log w, 0 for the best of the models, from at least one block."""
        return self._of_blocks()[2]

    def _of_blocks(self) -> tuple[int, Array, Array]:
        """Number of blocks, s and log w: kept until the next one is finished."""
        if self._told is None or self._told[0] != self._finished:
            log_weights = -0.5 * np.log(self.squares).sum(axis=0)
            self._told = (self._finished, np.sqrt(np.median(self.squares, axis=0)),
                          log_weights - log_weights.max(axis=0))
        return self._told

    def state(self) -> dict[str, Array | Stamps]:
        """Copies; :meth:`restore` takes them back bit for bit."""
        frozen = {f'{name}{index}': np.array(values) for index, each in enumerate(self._frozen)
                  for name, values in each._asdict().items()}
        return {'blocks': self._blocks.copy(), 'sums': self._sums.copy(), **frozen,
                'counts': np.array([self._finished, self._since, self._charged, self._passed], dtype=np.int64)}

    def restore(self, state: Mapping[str, Array | Stamps], sizes: Sequence[tuple[int, int]]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, when it cannot be one.

        :param sizes: (p, D) of each model.
        """
        blocks, sums = (np.array(state.get(name, np.nan), dtype=float) for name in ('blocks', 'sums'))
        if blocks.shape != self._blocks.shape or sums.shape != self._sums.shape or not (
                np.isfinite(blocks).all() and np.isfinite(sums).all()):
            raise SemiparamError(f'the saved errors of left-out blocks have shapes {blocks.shape} and {sums.shape}; '
                                 f'expected finite ones of {self._blocks.shape} and {self._sums.shape}.')
        counts = np.asarray(state['counts']).tolist()
        models = range(len(sums)) if 'theta0' in state else ()
        frozen = tuple(Coefficients(np.array(state[f'theta{index}'], dtype=float),
                                    np.array(state[f'alpha{index}'], dtype=float)) for index in models)
        found = [(each.theta.shape, each.alpha.shape) for each in frozen]
        expected = [((p,), (sums.shape[1], count)) for p, count in sizes]
        if (found and found != expected) or not all(np.isfinite(values).all() for each in frozen for values in each):
            raise SemiparamError(f'the saved coefficients of left-out blocks have shapes {found}; expected finite '
                                 f'values of {expected}.')
        if min(counts) < 0 or (blocks[:min(counts[0], BLOCKS)] <= 0.0).any():
            raise SemiparamError('the saved errors of left-out blocks are no squares of so many blocks.')
        self._blocks, self._sums, self._frozen, self._told = blocks, sums, frozen, None
        self._finished, self._since, self._charged, self._passed = map(int, counts)
