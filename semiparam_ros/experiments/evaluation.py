"""The node's estimator on recordings, sample by sample, and how well it predicted."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from semiparam_ros.bags.loading import LoadedBag
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.horizon_error import HorizonErrors, force_and_torque
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.tools import Tools
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.change_watch import ChangeRecord, ChangeWatch
from semiparam_ros.online.contact_gate import ContactGate
from semiparam_ros.online.history import History, batch_of
from semiparam_ros.online.learner import APPLY
from semiparam_ros.online.learning import learning_of, observe
from semiparam_ros.online.model_switcher import sentence_of
from semiparam_ros.online.renewal import RecentWindow, Renewal, has_draft
from semiparam_ros.online.worker import Done, Job, Result, Urgency, absorb, finish_window, renew
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator

TRANSIENT_S = 30.0
"""The first part of learning, reported apart from the steady state as in the paper."""

INDICES = ('eps_force', 'eps_torque', 'eps_centred_force', 'eps_centred_torque')
EFFORT_INDICES = ('eps_effort', 'eps_centred_effort')


class VariantScores:
    """Figures of one variant over the samples that it predicted, from its first own prediction on.

    :param outputs: `wrench` (three forces, three torques) or `effort`.
    """

    def __init__(self, outputs: str) -> None:
        self.outputs = outputs
        self.features = 0
        """Number D of random features of the model that predicted last; 0 where it has none."""
        self._measured: list[Array] = []
        self._errors: list[Array] = []
        self._seconds: list[float] = []
        self._times: list[float] = []
        self._indices: list[tuple[float, ...]] = []
        self._origin, self._offset = 0, 0.0

    def start_recording(self, origin: int) -> None:
        """Stamps [ns] from now on belong to another recording, which starts at ``origin`` and continues the last."""
        self._offset = self._times[-1] if self._times else 0.0
        self._origin = origin

    def add(self, measured: Array, predicted: Array, seconds: float | None = None) -> None:
        """One sample's outputs (n,), the prediction of them, and the time that prediction and update took [s]."""
        self._measured.append(measured)
        self._errors.append(predicted - measured)
        if seconds is not None:
            self._seconds.append(seconds)

    def add_horizon(self, horizon: HorizonErrors) -> None:
        """The horizon errors of one origin."""
        self._times.append(self._offset + 1e-9 * (horizon.origin - self._origin))
        self._indices.append(means(horizon.eps, self.outputs) + means(horizon.eps_centred, self.outputs))

    def __len__(self) -> int:
        return len(self._errors)

    @property
    def index_names(self) -> tuple[str, ...]:
        """The indices in the order of :meth:`index_series`."""
        return INDICES if self.outputs == 'wrench' else EFFORT_INDICES

    def index_series(self) -> tuple[Array, Array]:
        """Times (N,) [s] of the origins since the first recording's start; values (N, indices)."""
        return np.array(self._times), np.array(self._indices).reshape(-1, len(self.index_names))

    def result(self, series: bool = False) -> dict[str, object]:
        """Figures by name, in SI units; None where there is nothing to take the mean of."""
        nmse, rmse = normalised_errors(np.array(self._errors), np.array(self._measured))
        known = [value for value in nmse if value is not None]
        figures: dict[str, object] = {'samples': len(self), 'features': self.features, 'nmse': nmse,
                                      'nmse_mean': _mean(known), 'rmse': rmse}
        figures |= dict.fromkeys(('eps_force', 'eps_torque'))
        times, values = self.index_series()
        figures |= {name: by_phase(times, column) for name, column in zip(self.index_names, values.T, strict=True)}
        figures['update_ms'] = update_times(self._seconds)
        if series:
            columns = {name: column.tolist() for name, column in zip(self.index_names, values.T, strict=True)}
            figures['series'] = {'time_s': times.tolist(), **columns}
        return figures


def means(eps: Array, outputs: str) -> tuple[float, ...]:
    """Indices eps^F and eps^T of a wrench (6,), or the one mean over all efforts (n,)."""
    if outputs == 'wrench':
        return force_and_torque(eps)
    return (float(np.mean(eps)),)


def normalised_errors(errors: Array, measured: Array) -> tuple[list[float | None], list[float]]:
    """Mean squared error over the channel's variance (None for a constant channel), and its root, for (N, n)."""
    square = np.mean(errors**2, axis=0)
    variance = np.var(measured, axis=0)
    ratios = [float(a / b) if b > 0.0 else None for a, b in zip(square, variance, strict=True)]
    return ratios, np.sqrt(square).tolist()


def by_phase(times: Array, values: Array) -> dict[str, float | None]:
    """Means over everything, the transient (the first 30 s after learning starts) and the steady state after it."""
    early = times - times[:1] < TRANSIENT_S if len(times) else np.zeros(0, dtype=bool)
    return {'mean': _mean(values), 'first_30_s': _mean(values[early]), 'steady_state': _mean(values[~early])}


def update_times(seconds: Iterable[float]) -> dict[str, float] | None:
    """Median and 99th percentile [ms]."""
    milliseconds = 1e3 * np.array(list(seconds))
    if not milliseconds.size:
        return None
    median, p99 = np.percentile(milliseconds, [50, 99]).tolist()
    return {'median': median, 'p99': p99}


def _mean(values: Array | list[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


class AtOnce:
    """A background that does its jobs at once."""

    urgency = Urgency.ASKED

    def submit(self, function: Callable[..., Result], *arguments: object, done: Done[Result],
               urgency: Urgency = Urgency.SHADOW) -> Job:
        """Do the job, and hand its result or its exception to ``done``."""
        try:
            result = function(*arguments)
        except Exception as error:
            done(None, error)
        else:
            done(result, None)
        return self

    def later(self, function: Callable[[], None]) -> None:
        """Call the function."""
        function()

    def cancel(self) -> None:
        """Do nothing: the job is done."""


class OfflineLearner:
    """The estimator of the settings behind the contact gate, as in the node.

    An initial window that gives no hyperparameters is followed by another one; ``failed_windows`` holds a sentence for
    each. Where later motion leaves the window, they are estimated again (:mod:`semiparam_ros.online.renewal`).

    :param bags: the first one that carries a robot description gives it, where the settings do not.
    :param tick: called after each sample. ``answered``: receives each prediction, tools taken off, and how much
        its bands are widened in free motion (n,).
    :param takeovers: samples from the end of each window until the model of it takes over, or cannot be; the last one
        for all that follow. The node estimates hyperparameters meanwhile, and the model that it has answers; here it
        need not. The initial window has two: that of a draft comes first.
    """

    def __init__(self, settings: Settings, bags: Sequence[LoadedBag], tick: Callable[[], None],
                 takeovers: Sequence[int] = (0,)) -> None:
        description = next((bag.robot_description for bag in bags if bag.robot_description), None)
        self.settings, self._tick = settings, tick
        self.answered: Callable[[Prediction, Array], None] = lambda prediction, widening: None
        self.estimator = build_estimator(settings, description)
        self.gate = ContactGate.of(self.estimator.body)
        self.tools = Tools(self.estimator.body, settings.tools)
        self.failed_windows: list[str] = []
        self._takeovers = deque(takeovers)
        body = self.estimator.body
        self.history = History(settings.initial_samples, settings.retained_samples, body.n_joints)
        self.renewals = 0
        self._renewal = Renewal(settings.initial_samples, body.n_outputs)
        self._later: RecentWindow | None = None
        self._successor: Callable[[], Estimator] | None = None
        self._draft: Callable[[], Estimator] | None = None
        self._waiting: list[tuple[Sample, int]] = []
        self.changes: ChangeWatch | None = None

    def look_for_changes(self, told: Callable[[ChangeRecord], None]) -> None:
        """Look for changes, as ``diagnosis.auto`` does; ``told`` receives each record."""
        def failed(place: str, error: BaseException) -> None:
            raise error

        self.changes = ChangeWatch(self.estimator.body, AtOnce(), told, failed)
        self.changes.applies = self.settings.diagnosis_auto == APPLY

    def take(self, bag: LoadedBag, scores: VariantScores, learning: bool) -> None:
        """Predict, then perhaps learn, one recording; what the variant itself predicts is scored."""
        scores.start_recording(bag.samples.origin)
        self.begin(bag.samples.origin)
        for sample in bag.samples:
            start = time.perf_counter()
            prediction = self.step(sample, learning)
            elapsed = time.perf_counter() - start
            self._tick()
            if not prediction.ready:
                continue
            scores.add(sample.outputs, prediction.mean, elapsed)
            scores.features = self.estimator.features_count
            if prediction.horizon is not None:
                scores.add_horizon(prediction.horizon)
        if self._successor is not None:
            self._take_over()
        self.gate.reset()
        if self.changes is not None:
            self.changes.reset()
        self.estimator.clear_pending()

    def begin(self, origin: int) -> None:
        """Go on with another recording, whose time starts at ``origin`` [ns]."""
        self.estimator.begin_recording(origin)
        self.history.origin = origin if self.history.origin is None else self.history.origin

    def step(self, sample: Sample, learning: bool) -> Prediction:
        """One sample: a contact, and a robot at rest, are predicted but not learnt.

        The prediction's mean has what the tools and applied changes add, its sample has not, as in the node's answers.
        """
        sample, added = self.tools.taken_off(sample)
        if self.changes is not None:
            sample, of_changes = self.changes.applied.taken_off(sample)
            added = of_changes if added is None else added if of_changes is None else added + of_changes
        prediction = self.estimator.predict(sample)
        contact = self.gate.judge(prediction, self.settings, self._renewal.unsettled)
        learns = learning_of(prediction, learning and not contact, self.gate, self.changes)
        if self.changes is not None:
            self.changes.see(self.estimator, prediction, self.history)
        errors = observe(self.estimator, prediction, learns, finish=False)
        self.history.append(sample, learns)
        due = (learns > 0 and not self.settings.hyperparameters_sigma
               and self._renewal.see(self.estimator, prediction))
        if due and (self._successor is None or (self._draft is None and self._renewal.outdates(self._later))):
            if self._successor is not None:
                self._next_takeover()
            self._later, self._waiting = self._renewal.begin(), []
            self._successor = partial(renew, self.settings, self.estimator.body, self.history.batch(),
                                      self.history.origin, self._later)
        elif self._successor is not None:
            self._waiting.append((sample, learns))
        elif self.estimator.window_full:
            self._later = None
            if has_draft(self.settings.initial_samples):
                self._draft = partial(finish_window, self.estimator.with_window_alone(), True)
            self._successor = partial(finish_window, self.estimator.with_window_alone())
        if self._draft is not None and len(self._waiting) == self._takeovers[0]:
            self._draft_takes_over(self._draft)
        if self._successor is not None and self._draft is None and len(self._waiting) == self._takeovers[0]:
            self._take_over()
        self.answered(prediction, self.gate.widening)
        mean = prediction.mean if added is None else prediction.mean + added
        return prediction._replace(mean=mean, horizon=errors)

    def _draft_takes_over(self, draft: Callable[[], Estimator]) -> None:
        """Let a draft answer, taught what came since; hyperparameters are estimated yet."""
        self._draft = None
        self._next_takeover()
        if len(self._waiting) == self._takeovers[0]:
            return  # the successor takes over at once
        with suppress(SemiparamError):
            self.estimator = absorb(draft(), batch_of(self._waiting))
            self._renewal.go_on_with_draft()

    def _next_takeover(self) -> None:
        if len(self._takeovers) > 1:
            self._takeovers.popleft()

    def _take_over(self) -> None:
        """The variant has its hyperparameters, and has learnt what came since."""
        assert self._successor is not None
        successor, batch = self._successor, batch_of(self._waiting)
        self._successor, self._draft, self._waiting = None, None, []
        self._next_takeover()
        before = self.estimator
        try:
            self.estimator = absorb(successor(), batch)
        except SemiparamError as error:
            if not before.ready:
                self.failed_windows.append(sentence_of(error))
                before.discard_window()
                self.history.discard(before.origin)
            elif self._later is None:
                self._renewal.clear()
            return
        if self._later is None:
            self._renewal.clear()
            return
        self.estimator.origin = before.origin
        if self._later.draft:
            self._renewal.go_on_with_draft()
        else:
            self._renewal.clear()
            self.renewals += 1

    def finish(self, training: Sequence[LoadedBag], frozen: bool) -> None:
        """End the training: a model must stand, however short its window, if nothing more comes."""
        if training and not self.estimator.ready and len(self.estimator.window):
            self.estimator.finish_window()
        if not self.estimator.ready and (frozen or not self.settings.learning):
            raise SemiparamError('with the parameter learning off there is no model to evaluate; expected --train BAG.')
