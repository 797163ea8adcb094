"""How long answers take, over the last thousand of them."""

from __future__ import annotations

import time

import numpy as np


class Stopwatch:
    """Between the arrival of the message that completes a sample and the publishing of its answer."""

    SIZE = 1000

    def __init__(self) -> None:
        self._spans = np.zeros(self.SIZE)
        self._count = 0
        self._start = 0.0

    def start(self) -> None:
        """A message has come in."""
        self._start = time.perf_counter()

    def stop(self) -> None:
        """An answer has gone out."""
        self._spans[self._count % self.SIZE] = time.perf_counter() - self._start
        self._count += 1

    def quantiles_ms(self) -> tuple[float, float, float] | None:
        """(median, p99, maximum) in ms, None before the first answer."""
        spans = self._spans[:self._count]
        if not len(spans):
            return None
        median, late, last = np.quantile(spans, (0.5, 0.99, 1.0)) * 1e3
        return float(median), float(late), float(last)
