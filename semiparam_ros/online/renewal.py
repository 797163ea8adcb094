"""When the hyperparameters must be estimated again: later motion has left what they were estimated from.

The features see inputs scaled by the window's spread. A window of slow motion, or one in which a joint stood still,
scales later motion so large that any two of its samples look unlike, and the model learns each of them anew.
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.estimator import Estimator, Prediction
from semiparam_ros.core.types import Array, Mask

SPREADS = 6.0
"""An input further than so many of the window's scales from its mean lies outside."""
SHARE = 0.25
"""So large a share of a window lies outside, and hyperparameters are estimated from it."""
SURE = 0.1
"""Share of a window from which on it is dropped when less than ``SHARE`` of it lies outside."""
LEAD = 0.3
"""So large a share more is gathered first, while motion sets out and the model in force learns it. The first time, as
after a slow start, there is no time for it: the hyperparameters are far off."""
MOST_WORSE = 1.1
"""A model takes over unless its errors over the window are so many times those of the model in force."""
MOST_ATTEMPTS = 60
"""More than a life is long enough for."""


class Errors:
    """Of a model over the samples of a window."""

    def __init__(self, n_outputs: int) -> None:
        self.sums: Array = np.zeros((4, n_outputs))
        """(4, n) of ones, the outputs, their squares, and the squares of the errors."""

    def add(self, prediction: Prediction) -> None:
        """One sample, before it is learnt."""
        outputs = prediction.sample.outputs
        self.sums += (np.ones_like(outputs), outputs, outputs**2, (outputs - prediction.mean) ** 2)

    @property
    def size(self) -> float:
        """Root of the normalised mean squared error, the mean over the outputs that vary."""
        _, mean, square, error = self.sums / np.maximum(self.sums[0], 1.0)
        variance = square - mean**2
        varies = variance > 0.0
        return float(np.sqrt(np.mean(error[varies] / variance[varies]))) if varies.any() else 0.0


class Renewal:
    """Watches the samples that are learnt. Another window begins with the first one outside of the window before.

    The third must wait for two windows' samples, each further one for twice as many, so that there are few in any life.

    :param wanted: samples of a window.
    """

    def __init__(self, wanted: int, n_outputs: int) -> None:
        self._wanted, self._n_outputs = wanted, n_outputs
        self.done = False
        """Whether any hyperparameters are from a later window than the initial one."""
        self._attempts, self._learnt = 0, 0
        self._clear()

    def _clear(self) -> None:
        self._gathered, self._outside, self._errors = 0, 0, Errors(self._n_outputs)

    @property
    def unsettled(self) -> bool:
        """Whether motion has left the window, until the model that follows has seen another window's samples."""
        return self._gathered >= SURE * self._wanted or (self._attempts > 0 and self._learnt < self._wanted)

    def see(self, estimator: Estimator, prediction: Prediction) -> bool:
        """Take note of a sample that was just learnt; True when the latest ones are another window."""
        if estimator.input_scaling is None or not estimator.ready:
            return False
        self._learnt += 1
        mean, scale = estimator.input_scaling
        outside = bool((np.abs(prediction.sample.inputs - mean) > SPREADS * scale).any())
        waits = self._attempts > 0 and self._learnt < self._wanted * 2**self._attempts
        if not self._gathered and (waits or not outside):
            return False
        self._gathered += 1
        self._outside += outside
        enough = self._wanted * (1.0 + LEAD) if self._attempts else self._wanted
        if self._gathered > enough - judged(self._wanted):
            self._errors.add(prediction)
        if self._gathered >= SURE * self._wanted and self._outside < SHARE * self._gathered:
            self._clear()
        return self._gathered >= enough

    def begin(self) -> float:
        """Watch anew, for hyperparameters are being estimated; the size of the errors over the end of the window."""
        size = self._errors.size
        self._attempts, self._learnt = self._attempts + 1, 0
        self._clear()
        return size

    def state(self) -> Memory:
        """For a file; :meth:`restore` takes it back."""
        return {'done': self.done, 'attempts': self._attempts, 'learnt': self._learnt, 'gathered': self._gathered,
                'outside': self._outside, 'errors': self._errors.sums.copy()}

    def restore(self, state: Memory) -> None:
        """Go on from a state; raises LookupError, TypeError or ValueError for what is none."""
        if not isinstance(state, dict):
            raise TypeError('the state of the renewal is no mapping')
        self.done, self._gathered, self._outside = bool(state['done']), int(state['gathered']), int(state['outside'])
        self._attempts, self._learnt = int(state['attempts']), int(state['learnt'])
        if not 0 <= self._attempts <= MOST_ATTEMPTS:
            raise ValueError(f'the hyperparameters were estimated {self._attempts} times')
        self._errors.sums = np.array(state['errors'], dtype=float).reshape(4, self._n_outputs)


def judged(wanted: int) -> int:
    """Samples at the end of a window over which models are compared: until then both must learn the new motion."""
    return (wanted + 1) // 2


def later_window(learnt: Mask, wanted: int) -> Mask:
    """Which of the samples of a life (N,) make up its latest window."""
    chosen = np.zeros(len(learnt), dtype=bool)
    chosen[np.flatnonzero(learnt)[-wanted:]] = True
    return chosen
