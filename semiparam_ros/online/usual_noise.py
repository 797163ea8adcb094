"""Innovations that are usual in free motion, and how far beyond these chance goes.

Innovations are coloured, and no model is exactly true: so what causes explain of free motion is learnt, over windows
of each length. The root of it over its usual mean square has a tail, and what stands out is a ratio that chance exceeds
only so often an hour over all causes and lengths (:class:`~semiparam_ros.online.usual_peaks.Tail`).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.online.motion_block import BLOCK_S
from semiparam_ros.online.usual_peaks import Tail

LENGTHS = (2, 4, 8, 16, 32)
"""[blocks] Half a second to eight."""
USUAL, FEWEST = 20, 4
"""Windows of each length that a usual mean square is from, and so many at least."""
PER_HOUR = 0.1
"""[1/h] So often anything may stand out of free motion."""


class Usual:
    """Part that causes explain in free motion over windows of one length, and which ratio to that stands
    out.

    :param length: [blocks]
    """

    def __init__(self, length: int, n_causes: int) -> None:
        self.tail = Tail(n_causes, length * BLOCK_S)
        self._squares: deque[Array] = deque(maxlen=USUAL)
        self._noise: deque[float] = deque(maxlen=USUAL)

    def add(self, explained: Array, noise: float, level: float) -> None:
        """Add that of one window (c,) that nothing stands out of, and what the whole rigid body explains of
        its innovations."""
        if self.known:
            self.tail.add(np.sqrt(explained / self.mean(level)))
        self._squares.append(explained)
        self._noise.append(noise)

    @property
    def known(self) -> bool:
        """Return whether there is anything to compare with."""
        return len(self._squares) >= FEWEST

    def mean(self, level: float) -> Array:
        """(c,) usual mean squares; those of white noise, ``level``, at least."""
        return np.maximum(np.mean(self._squares, axis=0), level)

    def median(self, level: float) -> float:
        """Median that the whole rigid body explains of the usual window, whatever a few others were."""
        return max(float(np.median([squares[-1] for squares in self._squares])), level)

    def noise(self, level: float) -> float:
        """Median of its innovations."""
        return max(float(np.median(self._noise)), level)

    def ratio(self, explained: Array, level: float) -> float:
        """The largest over what stands out; 0 while nothing is known."""
        if not self.known:
            return 0.0
        thresholds, _ = self.tail.thresholds(PER_HOUR / len(LENGTHS))
        return float((np.sqrt(explained / self.mean(level)) / thresholds).max())
