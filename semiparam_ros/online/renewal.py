"""Renewal of the hyperparameters, when later motion has left what they were estimated from.

The features see inputs scaled by the window's spread. A window of slow motion, or one in which a joint stood still,
scales later motion so large that any two of its samples look unlike, and the model learns each of them anew.

A draft of the new ones, from less than half a window and by a search of a fraction of a second, takes over first.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.compiled import Matrix, Strided, Vector, compiled
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.hyperparameters.window import ROUNDING
from semiparam_ros.core.prediction import Prediction
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
DRAFT_SHARE = 0.4
"""So large a share of a window gives a draft."""
LEAST_DRAFT = 200
"""[samples] A draft is not from fewer: so small a window gives hyperparameters as fast without one."""
MOST_WORSE = 1.1
"""A model takes over unless its errors over the window are so many times those of the model in force."""
MOST_ATTEMPTS = 60
"""More than a life is long enough for."""


class RecentWindow(NamedTuple):
    """The latest samples that were learnt, to estimate hyperparameters from."""

    samples: int
    to_beat: float = inf
    """Root mean square over its end (:func:`judged`), and over the outputs in their own scale, of the errors of the
    model in force."""
    draft: bool = False


class Errors:
    """Errors of a model over the samples of a window."""

    def __init__(self, n_outputs: int) -> None:
        self.sums: Array = np.zeros((4, n_outputs))
        """(4, n) of ones, the outputs, their squares, and the squares of the errors."""

    def add(self, prediction: Prediction) -> None:
        """One sample, before it is learnt."""
        _charge(prediction.sample.outputs, prediction.mean, self.sums)

    @property
    def size(self) -> float:
        """Root of the normalised mean squared error, the mean over the outputs that vary."""
        _, mean, square, error = self.sums / np.maximum(self.sums[0], 1.0)
        variance = square - mean**2
        varies = variance > ROUNDING * square
        return float(np.sqrt(np.mean(error[varies] / variance[varies]))) if varies.any() else 0.0


class Watch:
    """Gathers a window, from the first sample on that lies outside of the one before.

    :param window: its samples.
    """

    def __init__(self, window: int, n_outputs: int) -> None:
        self.window, self._n_outputs = window, n_outputs
        self.clear()

    def clear(self) -> None:
        """Watch anew, from the next sample on."""
        self.gathered, self.outside, self.errors = 0, 0, Errors(self._n_outputs)

    def add(self, prediction: Prediction, outside: bool, enough: float) -> None:
        """One sample of it; the last of ``enough`` are those over which models are compared."""
        self.gathered += 1
        self.outside += outside
        if self.gathered > enough - judged(self.window):
            self.errors.add(prediction)

    def state(self) -> Memory:
        """For a file; :meth:`restore` takes it back."""
        return {'gathered': self.gathered, 'outside': self.outside, 'errors': self.errors.sums.copy()}

    def restore(self, state: Memory) -> None:
        """Go on from a state; raises LookupError, TypeError or ValueError for what is none."""
        if not isinstance(state, dict):
            raise TypeError('the state of a window is no mapping')
        self.gathered, self.outside = int(state['gathered']), int(state['outside'])
        self.errors.sums = np.array(state['errors'], dtype=float).reshape(4, self._n_outputs)


class Renewal:
    """Watches the samples that are learnt, one of each step. Another window begins with the first one outside of the
    window before.

    The third must wait for two windows' samples, each further one for twice as many, so that there are few in any life.
    Drafts do not wait for that, but for each other: the third for one draft's samples, each further one for about twice
    as many, until the model of a whole window takes over.

    :param wanted: samples of a window.
    """

    def __init__(self, wanted: int, n_outputs: int) -> None:
        self._wanted, self._n_outputs = wanted, n_outputs
        self.done = False
        """Whether any hyperparameters are from a later window than the initial one."""
        self._attempts, self._learnt = 0, 0
        """Whole windows, and samples learnt since the latest of them."""
        self._whole, self._draft = Watch(wanted, n_outputs), Watch(drafted(wanted), n_outputs)
        self.clear()

    def clear(self) -> None:
        """The model of a whole window has taken over: watch anew, from the next sample on."""
        self._drafts, self._since_draft = 0, 0
        self._watch_anew()

    def _watch_anew(self) -> None:
        self._whole.clear()
        self._draft.clear()
        self._follows = self._whole_drafted = self._draft_rules = False

    @property
    def unsettled(self) -> bool:
        """Tell whether motion has left the window, until the model that follows has seen another
        window's samples."""
        gathered = self._draft.gathered if self._waits else max(self._whole.gathered, self._draft.gathered)
        return (gathered >= SURE * self._wanted or (self._attempts > 0 and self._learnt < self._wanted)
                or (self._drafts > 0 and self._since_draft < self._wanted))

    @property
    def _waits(self) -> bool:
        """Tell whether it is too early for a whole window."""
        return self._attempts > 0 and self._learnt < self._wanted * 2**self._attempts

    @property
    def _draft_waits(self) -> bool:
        """Tell whether it is too early for a draft."""
        return not has_draft(self._wanted) or (
            self._drafts > 0 and self._since_draft < self._draft.window * (2**(self._drafts - 1) - 1))

    def see(self, estimator: Estimator, prediction: Prediction) -> bool:
        """Take note of a sample that was just learnt; True when the latest ones are enough of another window."""
        if estimator.input_scaling is None or not (estimator.ready and prediction.begins_step):
            return False
        self._learnt += 1
        self._since_draft += 1
        mean, scale = estimator.input_scaling
        position, velocity, acceleration = prediction.sample[1:4]
        outside = bool(_is_outside(position, velocity, acceleration, mean, scale))
        if not (outside or self._whole.gathered or self._draft.gathered):
            return False
        for watch, waits in ((self._whole, self._waits), (self._draft, self._draft_waits)):
            if not waits and (watch.gathered or outside):
                watch.add(prediction, outside, self._enough(watch))
                few = watch.gathered >= SURE * self._wanted and watch.outside < SHARE * watch.gathered
                if few and not (watch is self._whole and self._follows):  # a draft's window is wider
                    watch.clear()
        return self._is_due(self._whole) or self._is_due(self._draft)

    @property
    def draft_is_next(self) -> bool:
        """Tell whether of what is due a draft comes first."""
        return not self._is_due(self._whole) or (has_draft(self._wanted) and not self._whole_drafted)

    def outdates(self, later: RecentWindow | None) -> bool:
        """Tell whether a model that is being built has none of the motion of a draft that is due.

        :param later: the window that it is built from; None for the initial one.
        """
        return self.draft_is_next and not (later is not None and later.draft)

    def _is_due(self, watch: Watch) -> bool:
        return 0 < self._enough(watch) <= watch.gathered

    def _enough(self, watch: Watch) -> float:
        """Samples to gather for it."""
        return watch.window * (1.0 + LEAD) if self._attempts else watch.window

    def begin(self) -> RecentWindow:
        """Hyperparameters are being estimated from this window: watch anew, or go on after a draft."""
        draft, whole = self.draft_is_next, self._is_due(self._whole)
        watch = self._whole if whole else self._draft
        window = RecentWindow(watch.window, inf if self._draft_rules and whole else watch.errors.size, draft)
        if draft and whole:
            self._follows = self._whole_drafted = True
        elif draft:
            self._whole.gathered = max(self._whole.gathered, watch.gathered)
            self._drafts, self._since_draft, self._follows = self._drafts + 1, 0, True
            watch.clear()
        else:
            self._attempts, self._learnt = self._attempts + 1, 0
            self._watch_anew()
        return window

    def go_on_with_draft(self) -> None:
        """One has taken over, from this or from the initial window. What follows knows more, and need not beat it."""
        self._draft_rules = True
        self._draft.clear()

    @property
    def refines(self) -> bool:
        """Tell whether a draft from the initial window is in force."""
        return self._draft_rules and not self._drafts

    def state(self) -> Memory:
        """For a file; :meth:`restore` takes it back."""
        return {'done': self.done, 'attempts': self._attempts, 'learnt': self._learnt, 'drafts': self._drafts,
                'since_draft': self._since_draft, 'follows': self._follows, 'whole_drafted': self._whole_drafted,
                'draft_rules': self._draft_rules,
                'whole': self._whole.state(), 'draft': self._draft.state()}

    def restore(self, state: Memory) -> None:
        """Go on from a state; raises LookupError, TypeError or ValueError for what is none."""
        if not isinstance(state, dict):
            raise TypeError('the state of the renewal is no mapping')
        self.done, self._draft_rules = bool(state['done']), bool(state['draft_rules'])
        self._follows, self._whole_drafted = bool(state['follows']), bool(state['whole_drafted'])
        self._attempts, self._learnt = int(state['attempts']), int(state['learnt'])
        self._drafts, self._since_draft = int(state['drafts']), int(state['since_draft'])
        for count in (self._attempts, self._drafts):
            if not 0 <= count <= MOST_ATTEMPTS:
                raise ValueError(f'the hyperparameters were estimated {count} times')
        self._whole.restore(state['whole'])
        self._draft.restore(state['draft'])


def drafted(wanted: int) -> int:
    """Samples that a draft is from."""
    return round(DRAFT_SHARE * wanted)


def has_draft(wanted: int) -> bool:
    """Tell whether hyperparameters of so many samples are preceded by a draft."""
    return drafted(wanted) >= LEAST_DRAFT


def judged(wanted: int) -> int:
    """Samples at the end of a window over which models are compared: until then both must learn the new motion."""
    return (wanted + 1) // 2


def later_window(learnt: Mask, wanted: int) -> Mask:
    """Mask of the samples of a life (N,) that make up its latest window."""
    chosen = np.zeros(len(learnt), dtype=bool)
    chosen[np.flatnonzero(learnt)[-wanted:]] = True
    return chosen


@compiled
def _is_outside(position: Strided, velocity: Strided, acceleration: Strided, mean: Vector, scale: Vector) -> bool:
    """Tell whether an input, of joints (n_joints,), is further than ``SPREADS`` scales from its
    mean, of inputs (m,)."""
    n_joints = len(position)
    for i in range(n_joints):
        for kind, values in enumerate((position, velocity, acceleration)):
            at = kind * n_joints + i
            if abs(values[i] - mean[at]) > SPREADS * scale[at]:
                return True
    return False


@compiled
def _charge(outputs: Strided, mean: Vector, sums: Matrix) -> None:
    """Add a sample's outputs (n,) and their predictions to the sums of :class:`Errors`."""
    for k in range(len(mean)):
        sums[0, k] += 1.0
        sums[1, k] += outputs[k]
        sums[2, k] += outputs[k] ** 2
        sums[3, k] += (outputs[k] - mean[k]) ** 2
