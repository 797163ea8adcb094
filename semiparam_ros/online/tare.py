"""The bias of the outputs, set anew on demand without hiding what the arm carries."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

WINDOW_NS = NANOSECONDS
OLDEST_S = 10.0
"""Since the latest sample: a call takes its time on a busy machine, but of a sensor that is silent nothing is known."""
LARGEST = 1e6
"""No sensor [N, N m] is off by so much; taken off, it would leave nothing of the measured outputs' digits."""


class Tare:
    """Taken off every measured output before the model sees it, and put back on what is published.

    A plain tare makes the sensor read zero, weight and all. This one makes it read what the model expects, so weight
    and payload stay: the bias grows by the mean residual of the last second.
    """

    def __init__(self, n_outputs: int, bias: Array | None = None) -> None:
        self.bias = np.zeros(n_outputs) if bias is None else bias
        self._residuals: deque[tuple[int, Array]] = deque()
        self._came = 0.0
        """[s] When the latest came, by time.monotonic: stamps stand still where samples end."""

    @property
    def bias(self) -> Array:
        """(n,) in N and N m."""
        return self._bias

    @bias.setter
    def bias(self, bias: Array) -> None:
        self._bias = bias
        self.active = bool(bias.any())
        """Whether there is a bias: asked of every sample."""

    def add(self, stamp: int, residual: Array, counts: bool) -> None:
        """Keep the residual of one answer for a second, where it counts."""
        if counts:
            self._residuals.append((stamp, residual))
            self._came = time.monotonic()
        while self._residuals and not 0 <= stamp - self._residuals[0][0] <= WINDOW_NS:
            self._residuals.popleft()

    def begin_anew(self) -> None:
        """Forget the residuals, as where a tool, a model or an applied change is another one; the bias stays."""
        self._residuals.clear()

    def take(self) -> int:
        """Move the bias; returns from how many samples.

        Raises SemiparamError, with the bias as it was, when there is nothing to go by, or only absurd predictions.
        """
        if not self._residuals or time.monotonic() - self._came > OLDEST_S:
            raise SemiparamError('there is no prediction of the last second to tare by; the initial window must be '
                                 'over and samples must come.')
        count = len(self._residuals)
        bias = self.bias + np.mean([residual for _, residual in self._residuals], axis=0)
        if not np.abs(bias).max() < LARGEST:
            raise SemiparamError(f'the bias would be {np.abs(bias).max():.3g}, for the model predicts nothing like the '
                                 f'measured outputs; expected less than {LARGEST:g}.')
        self.bias = bias
        self._residuals.clear()
        return count
