"""Change that was told, and is followed until it is over: what it explains is taken off."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.online.change_causes import Cause, CauseFit, Judged, with_prior
from semiparam_ros.online.motion_block import MotionBlock

SETTLED = 8
"""[blocks] The newest ones say whether a change goes on; the older ones say how large it is."""
JUDGED_ANEW = 32
"""[blocks] So long after it began, what a change is may still be told anew."""


class Change(NamedTuple):
    """Change as it was told.

    :param number: counts them; one that is judged anew keeps its own.
    :param since: [ns] stamp at which it began. :param noticed: [ns] when that was.
    :param kind: the likeliest cause ('' for none that is known), at ``where``.
    :param value: of a load its mass [kg], with its standard deviation; of what was put down
        negative; else NaN.
    :param evidence: [nat] over what is next likely: no change, a contact. :param outputs: those
        that feel it, the strongest first. :param ended: [ns] when it was over; None while it is
        there.
    """

    number: int
    since: int
    noticed: int
    kind: str
    where: str | None
    value: float
    std: float
    evidence: float
    outputs: tuple[str, ...]
    ended: int | None = None
    touched: int = 0
    """[ns] since when what was taken for a contact stood out, from which it cannot be told."""


class End(NamedTuple):
    """End of a change: since when [ns] it is over, by which log evidence of it until then, under noise kappa (1,)."""

    since: int
    evidence: float
    kappa: Array


class Followed:
    """A change that was told, with the sums of all blocks since it began but the first, which has a
    part of it: its coefficients, in units of their prior.

    :param size: K, directions of all causes.
    """

    def __init__(self, change: Change, judged: Judged, blocks: Sequence[MotionBlock], size: int) -> None:
        self.change, self.cause, self.blocks = change, judged.cause, 0
        self.theta = judged.theta
        self._latest = deque([judged.theta], maxlen=SETTLED)
        self._grams, self._moments = np.zeros((size, size)), np.zeros(size)
        for block in blocks[1:]:
            self._sum(block)

    def _sum(self, block: MotionBlock) -> None:
        self._grams = self._grams + block.gram
        self._moments = self._moments + block.moment
        self.blocks += 1

    @property
    def _gram(self) -> Array:
        part = self.cause.part
        return np.asarray(self._grams[part, part])

    @property
    def _moment(self) -> Array:
        return np.asarray(self._moments[self.cause.part])

    def among(self, blocks: Iterable[MotionBlock]) -> list[tuple[int, MotionBlock]]:
        """Blocks that it acts in, with their places."""
        return [(row, block) for row, block in enumerate(blocks) if block.start >= self.change.since]

    def fit(self, cause: Cause) -> CauseFit:
        """Fit with which another cause explains all blocks since it began."""
        part = cause.part
        return CauseFit.of(cause, self._grams[None, part, part], self._moments[None, part])

    def told_anew(self, change: Change, cause: Cause) -> None:
        """It was another cause, since then."""
        self.change, self.cause = change, cause
        self.theta = np.asarray(np.linalg.solve(with_prior(self._gram), self._moment), dtype=float)
        self._latest = deque([self.theta], maxlen=SETTLED)

    def add(self, block: MotionBlock, stands_out: bool) -> None:
        """One more; the newest ones are left to say whether it goes on. As long as anything ``stands_out`` beside it,
        its coefficients stay what they were."""
        self._sum(block)
        if stands_out and self.blocks > JUDGED_ANEW:
            return
        self._latest.append(
            np.asarray(np.linalg.solve(with_prior(self._gram), self._moment), dtype=float)
        )
        self.theta = self._latest[0]

    def without(self, grams: Array, sums: Array) -> CauseFit:
        """Fit with which it explains all blocks since it began but the last ones, which have these A
        (S, K, K) and h (S, K)."""
        part = self.cause.part
        return CauseFit.of(
            self.cause, self._gram - grams[:, part, part], self._moment - sums[:, part]
        )

    def estimate(self, noise: float) -> tuple[Array, Array]:
        """(k,) its coefficients by all blocks, and (k, k) their covariance, under noise kappa."""
        whole = self._gram + noise * np.eye(len(self._gram))
        inverse = np.asarray(np.linalg.inv(whole), dtype=float)
        return inverse @ self._moment, noise * inverse
