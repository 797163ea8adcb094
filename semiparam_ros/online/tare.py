"""The bias of the outputs, set anew on demand without hiding what the arm carries."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

WINDOW_NS = NANOSECONDS
LEAST_NS = WINDOW_NS // 2
"""Of samples after a change of what is predicted or taken off: the mean of a few is their noise."""
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
        self._first: int | None = None
        """[ns] Stamp of the first of them since the beginning."""
        self._anew = self._changed = False
        """Whether there was a beginning; whether residuals were forgotten then, and none came since."""
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
            self._first = stamp if self._first is None else min(self._first, stamp)
            self._came, self._changed = time.monotonic(), False
        while self._residuals and not 0 <= stamp - self._residuals[0][0] <= WINDOW_NS:
            self._residuals.popleft()
        if not self._residuals:
            self._first = None

    def begin_anew(self) -> None:
        """Forget the residuals, as where a tool, a model or an applied change is another one; the bias stays."""
        self._changed |= bool(self._residuals)
        self._anew, self._first = True, None
        self._residuals.clear()

    def _require_enough(self) -> None:
        """Raise SemiparamError when no or too few residuals tell what would be taken."""
        if not self._residuals and self._changed:
            raise SemiparamError('there is no prediction of the last second to tare by since a tool, the model or the '
                                 f'bias changed; wait for {LEAST_NS / NANOSECONDS:g} s of samples.')
        if self._first is None or time.monotonic() - self._came > OLDEST_S:
            raise SemiparamError('there is no prediction of the last second to tare by; the initial window must be '
                                 'over and samples must come.')
        missing = LEAST_NS - (self._residuals[-1][0] - self._first)
        if self._anew and missing > 0:
            raise SemiparamError(f'{len(self._residuals)} samples came since a tool, the model or the bias changed, '
                                 f'which are too few to tare by; wait {missing / NANOSECONDS:.2g} s more.')

    def take(self) -> int:
        """Move the bias; returns from how many samples.

        Raises SemiparamError, with the bias as it was, when there is too little to go by, or only absurd predictions.
        """
        self._require_enough()
        count = len(self._residuals)
        bias = self.bias + np.mean([residual for _, residual in self._residuals], axis=0)
        if not np.abs(bias).max() < LARGEST:
            raise SemiparamError(f'the bias would be {np.abs(bias).max():.3g}, for the model predicts nothing like the '
                                 f'measured outputs; expected less than {LARGEST:g}.')
        self.bias = bias
        self.begin_anew()
        return count
