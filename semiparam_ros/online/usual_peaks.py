"""Peaks of innovations that are usual in free motion, and the tail of their ratios to these.

The usual peak of an output is the median of the peaks of blocks of half a second, at a speed (:class:`Band`), or where
its joint turns round or sets out (:class:`TurnPeaks`). The :class:`Tail` of the ratios of peaks to the usual one
decides how large a ratio comes by chance only so often. Ratios above their 90th percentile are taken as exponentially
distributed (peaks over a threshold, Coles 2001, An Introduction to Statistical Modeling of Extreme Values, chapter 4).
Their mean comes from a median, so that a few pushes too small to be seen do not widen it. A weak prior, and the
predictive distribution in place of the fitted one, keep the threshold high while few blocks are known.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import exp, log

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.compiled import Vector, compiled
from semiparam_ros.core.types import Array, Mask

BLOCK_S = 0.5
SCALE_BLOCKS, FEWEST_BLOCKS = 20, 4
TAIL_BLOCKS = 600

SPEEDS = (0.02, 0.2, 0.8, 2.0)
"""[rad/s, m/s] Between bands; the first band is rest. The fastest joint counts, over about the last
second."""
SPEED_MEMORY_S = 1.0
REST_MEMORY_S = 5.0
TURN_SHARE, TURN_S = 0.3, 0.3
"""A joint turns while it is slower than this share of its speed, and for so long after."""
OTHERS_SHARE, APART = 0.5, 0.001
"""A joint that has moved for less than this share of the time of the others has rested; once it is
so far [rad, m] from where it was, its effort is not judged until it has moved for as long as usual
peaks are from."""
TAIL_SHARE = 0.1
PRIOR_LEVEL, PRIOR_EXCESS = 1.6, 0.25
"""Of the 90th percentile of the ratios and the mean excess over it; those of coloured Gaussian
noise, and of the free motion of three measured arms, are near."""
PRIOR_BLOCKS, PRIOR_EXCESSES = 20.0, 8.0
MOST_EXCESSES = 8.0
"""However many blocks are known, the tail counts as known by so many: real tails are heavier than
exponential ones."""


class Tail:
    """Ratios of peaks to usual ones, and the thresholds (n,) that follow.

    :param block_s: [s] how long a block is.
    """

    def __init__(self, n_outputs: int, block_s: float = BLOCK_S) -> None:
        self._block_s = block_s
        self.ratios = np.zeros((0, n_outputs))
        self._rate: float | None = None

    def add(self, ratios: Array) -> None:
        """Keep the ratios (n,) of one block."""
        self.ratios = np.vstack([self.ratios, ratios])[-TAIL_BLOCKS:]
        self._rate = None

    def thresholds(self, per_hour: float) -> tuple[Array, Array]:
        """(n,) ratios that chance exceeds ``per_hour`` times an hour over all outputs, and (n,)
        usual large ones."""
        if self._rate != per_hour:
            self._rate, (self._thresholds, self._levels) = per_hour, self._fitted(per_hour)
        return self._thresholds, self._levels

    def _fitted(self, per_hour: float) -> tuple[Array, Array]:
        count, n_outputs = self.ratios.shape
        levels = np.full(n_outputs, PRIOR_LEVEL)
        excesses = np.full(n_outputs, PRIOR_EXCESSES * PRIOR_EXCESS)
        known = min(0.5 * TAIL_SHARE * count, MOST_EXCESSES)  # a median tells half of what a mean would
        if count >= 1 / TAIL_SHARE:
            level, higher = np.quantile(self.ratios, (1 - TAIL_SHARE, 1 - TAIL_SHARE / 2), axis=0)
            levels = (count * level + PRIOR_BLOCKS * levels) / (count + PRIOR_BLOCKS)
            excesses += known * (higher - level) / log(2.0)
        chance = min(per_hour / n_outputs * self._block_s / 3600.0 / TAIL_SHARE, 1.0)
        return levels + excesses * (chance ** (-1.0 / (known + PRIOR_EXCESSES)) - 1.0), levels


class Band:
    """Usual peaks (n,) of the innovations at some speed, and the block that is being gathered."""

    def __init__(self, n_outputs: int) -> None:
        self.peaks = np.zeros((0, n_outputs))
        self.usual: Array | None = None
        self.blocks = 0
        """So many were finished, since the last change that lasted; the peaks of that are those
        beyond them."""
        self.clear()

    @property
    def known(self) -> float:
        """Share, from 0 to 1, to which the usual peaks are known."""
        return min(max(len(self.peaks), self.blocks) / SCALE_BLOCKS, 1.0)

    def clear(self) -> None:
        """Drop the unfinished block."""
        self.peak: Array = np.zeros(self.peaks.shape[1])
        self.ratio: Array = np.zeros(self.peaks.shape[1])
        self.seconds = 0.0

    def add(self, size: Array, ratio: Array, seconds: float) -> Array | None:
        """One sample: size of its innovations and their ratio to the usual peaks, (n,) each.

        Returns the largest ratios (n,) of the block that it ends, once usual peaks are known.
        """
        np.maximum(self.peak, size, out=self.peak)
        np.maximum(self.ratio, ratio, out=self.ratio)
        self.seconds += seconds
        if self.seconds < BLOCK_S:
            return None
        ratios = None if self.usual is None else self.ratio
        self.blocks += 1
        self.restore(np.vstack([self.peaks, self.peak])[-SCALE_BLOCKS:])
        return ratios

    def restore(self, peaks: Array) -> None:
        """Go on from the peaks of finished blocks, (N, n)."""
        self.peaks = peaks
        self.usual = np.median(peaks, axis=0) if len(peaks) >= FEWEST_BLOCKS else None
        self.clear()


SAVED_OF_TURNS = ('speed', 'left', 'peak', 'peaks', 'counts', 'moved', 'place')
"""Arrays of :class:`TurnPeaks` that a state has."""


class TurnPeaks:
    """Usual peaks (n,) of efforts while their own joints turn round or set out, at whatever speed.

    Dry friction is then between its two values. What the model does not know of it comes as a
    burst, at every turn. Turns count also while the gate is closed: a median does not mind a few
    contacts, and a burst that closes the gate must not be missing.
    """

    def __init__(self, n_outputs: int) -> None:
        self.speed: Array = np.zeros(n_outputs)
        """Envelope (n,) of the speeds [rad/s, m/s]; it falls within about a second."""
        self.left: Array = np.zeros(n_outputs)
        """[s] (n,) until a turn is over."""
        self.peak: Array = np.zeros(n_outputs)
        """(n,) of the turns that are not over."""
        self.peaks: Array = np.zeros((SCALE_BLOCKS, n_outputs))
        """Of the latest turns of each joint, the newest last."""
        self.counts: Array = np.zeros(n_outputs, dtype=int)
        """(n,) turns so far."""
        self.usual: Array = np.zeros(n_outputs)
        """(n,) medians; 0 where fewer than ``FEWEST_BLOCKS`` turns are known."""
        self.moved: Array = np.zeros(n_outputs)
        """[s] (n,) that each joint has moved so far."""
        self.place: Array = np.zeros(n_outputs)
        """[rad, m] (n,) where each joint was over the last seconds."""
        self.new: Mask = np.zeros(n_outputs, dtype=bool)
        """(n,) whether a joint moves that rested while others moved: what is usual of it is from
        when its friction was not felt."""

    def follow(self, position: Array, velocity: Array, seconds: float) -> Mask:
        """(n,) whether each joint turns at this sample."""
        self.moved += seconds * (np.abs(velocity) > SPEEDS[0])
        if not self.place.any():
            self.place = position.copy()
        self.place += seconds / REST_MEMORY_S * (position - self.place)
        known = min(SCALE_BLOCKS * BLOCK_S, OTHERS_SHARE * self.moved.max())
        self.new = (self.moved < known) & (np.abs(position - self.place) > APART)
        turned = self.left > 0.0
        _follow_turns(np.abs(velocity), self.speed, self.left, seconds)
        turns = self.left > 0.0
        for joint in np.flatnonzero(turned & ~turns).tolist():
            self._end(joint)
        return turns

    def add(self, size: Array, turns: Mask) -> None:
        """Innovations (n,) of one sample."""
        np.maximum(self.peak, size, out=self.peak, where=turns)

    def reset(self) -> None:
        """Drop the turns that are not over."""
        self.speed, self.left, self.peak = (np.zeros_like(self.speed) for _ in range(3))

    def state(self) -> Memory:
        """For a file; :meth:`restore` takes it back."""
        return {name: getattr(self, name).copy() for name in SAVED_OF_TURNS}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Go on from a state."""
        for name in SAVED_OF_TURNS:
            setattr(self, name, state[name].astype(getattr(self, name).dtype))
        for joint in range(len(self.counts)):
            self._renew(joint)

    def _end(self, joint: int) -> None:
        self.peaks[:-1, joint] = self.peaks[1:, joint]
        self.peaks[-1, joint] = self.peak[joint]
        self.counts[joint] += 1
        self.peak[joint] = 0.0
        self._renew(joint)

    def _renew(self, joint: int) -> None:
        if self.counts[joint] >= FEWEST_BLOCKS:
            self.usual[joint] = np.median(self.peaks[-self.counts[joint]:, joint])


@compiled
def _follow_turns(now: Vector, speed: Vector, left: Vector, seconds: float) -> None:
    """Go on by one sample with the speeds ``now``."""
    fall = exp(-seconds / SPEED_MEMORY_S)
    for joint in range(len(now)):
        sets_out = speed[joint] <= SPEEDS[0] < now[joint]
        speed[joint] = max(now[joint], speed[joint] * fall)
        turns = speed[joint] > SPEEDS[0] and (now[joint] < TURN_SHARE * speed[joint] or sets_out)
        left[joint] = TURN_S if turns else max(left[joint] - seconds, 0.0)
