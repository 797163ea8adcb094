"""The node's estimator on recordings, sample by sample, and how well it predicted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from semiparam_ros.bags.loading import LoadedBag, description_in
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.horizon_error import HorizonErrors, force_and_torque
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.samples import Sample, variance
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.change_record import ChangeRecord
from semiparam_ros.online.learner import Answer, Learner, LearnerListener
from semiparam_ros.online.model_jobs import finish_window, renew
from semiparam_ros.online.worker import Done, Job, Result, Urgency
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body

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
        self._starts = [(0, 0.0)]  # stamp [ns] at which each recording starts, and its time [s] in the series

    def start_recording(self, origin: int) -> None:
        """Stamps [ns] from now on belong to another recording, which starts at ``origin`` and
        continues the last."""
        start = origin, self._times[-1] if self._times else 0.0
        self._starts = [*self._starts, start] if self._times else [start]

    def add(self, measured: Array, predicted: Array, seconds: float | None = None) -> None:
        """One sample's outputs (n,), the prediction of them, and the time that prediction and
        update took [s]."""
        self._measured.append(measured)
        self._errors.append(predicted - measured)
        if seconds is not None:
            self._seconds.append(seconds)

    def add_horizon(self, horizon: HorizonErrors) -> None:
        """The horizon errors of one origin."""
        origin, offset = self._starts[-1]
        self._times.append(offset + 1e-9 * (horizon.origin - origin))
        self._indices.append(means(horizon.eps, self.outputs) + means(horizon.eps_centred, self.outputs))

    def __len__(self) -> int:
        return len(self._errors)

    def time_of(self, stamp: int) -> float:
        """Time [s] in the series of a stamp [ns], by the recording in which it lies."""
        origin, offset = max((start for start in self._starts if start[0] <= stamp), default=self._starts[0])
        return offset + 1e-9 * (stamp - origin)

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
    """Mean squared error over the channel's variance (None for a constant channel), and its root,
    for (N, n)."""
    square = np.mean(errors**2, axis=0)
    ratios = [float(a / b) if b > 0.0 else None for a, b in zip(square, variance(measured), strict=True)]
    return ratios, np.sqrt(square).tolist()


def by_phase(times: Array, values: Array) -> dict[str, float | None]:
    """Means over everything, the transient (the first 30 s after learning starts) and the steady
    state after it."""
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


class Held(AtOnce):
    """The job of a :class:`TakeoverBackground` that is held back."""

    def __init__(self, run: Callable[[], object]) -> None:
        self.run, self.cancelled = run, False

    def cancel(self) -> None:
        """Forget it."""
        self.cancelled = True


class TakeoverBackground(AtOnce):
    """A background that holds models of a window back until they are to take over."""

    def __init__(self) -> None:
        self._held: list[Held] = []

    @property
    def holds(self) -> bool:
        """Tell whether a model is to take over."""
        self._held = [job for job in self._held if not job.cancelled]
        return bool(self._held)

    def submit(self, function: Callable[..., Result], *arguments: object, done: Done[Result],
               urgency: Urgency = Urgency.SHADOW) -> Job:
        """Hold a model of a window back; do any other job at once."""
        run = partial(super().submit, function, *arguments, done=done)
        if function not in (finish_window, renew):
            return run()
        self._held.append(Held(run))
        return self._held[-1]

    def release(self) -> None:
        """Let the model that was asked for first take over."""
        self._held.pop(0).run()


class OfflineLearner(LearnerListener):
    """The node's learner without a node, on whole recordings.

    :param bags: the first one that carries a robot description gives it, where the settings do not.
    :param tick: called after each sample. ``on_answer``: receives each answer, and how much its
        bands are widened in free motion (n,). ``on_change``: receives each record of a change.
    :param takeovers: samples from the end of each window until the model of it takes over, or
        cannot be; the last one for all that follow. The node estimates hyperparameters meanwhile,
        and the model that it has answers; here it need not. The initial window has two: that of a
        draft comes first.
    """

    def __init__(self, settings: Settings, bags: Sequence[LoadedBag], tick: Callable[[], None],
                 takeovers: Sequence[int] = (0,)) -> None:
        self._tick, self._takeovers = tick, tuple(takeovers)
        self.answer: Answer | None = None
        self.on_answer: Callable[[Answer, Array], None] = lambda answer, widening: None
        self.on_change: Callable[[ChangeRecord], None] = lambda record: None
        self._horizon: HorizonErrors | None = None
        self._background = TakeoverBackground()
        body = build_rigid_body(settings, description_in(bags))
        self.learner = Learner(replace(settings, shadow_variants=()), body, self._background, self)

    @property
    def estimator(self) -> Estimator:
        """The model in force."""
        return self.learner.estimator

    def take(self, bag: LoadedBag, scores: VariantScores, learning: bool) -> None:
        """Predict, then perhaps learn, one recording; what the variant itself predicts is
        scored."""
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
        while self._background.holds:
            self._take_over()
        self.learner.clear_pending()

    def begin(self, origin: int) -> None:
        """Go on with another recording, whose time starts at ``origin`` [ns]: what is half seen is
        dropped, as after a jump of the clock."""
        self.learner.clear_pending()
        self.estimator.begin_recording(origin)
        history = self.learner.history
        history.origin = origin if history.origin is None else history.origin

    def step(self, sample: Sample, learning: bool) -> Prediction:
        """Answer a sample as the node does; it learns one of a robot that moves, without a
        contact."""
        learner = self.learner
        if learner.settings.learning != learning:
            learner.settings = replace(learner.settings, learning=learning)
        self._horizon = None
        learner.offer(sample)
        while self._background.holds and learner.waited >= self._takeover:
            self._take_over()
        assert self.answer is not None
        return self.answer.prediction._replace(horizon=self._horizon)

    @property
    def _takeover(self) -> int:
        """Samples after which the next model takes over."""
        return self._takeovers[min(len(self.learner.takeovers), len(self._takeovers) - 1)]

    def _take_over(self) -> None:
        origin = self.estimator.origin
        self._background.release()
        self.estimator.origin = origin  # of this recording, where the history counts from the first

    def finish(self, training: Sequence[LoadedBag], frozen: bool) -> None:
        """End the training: a model must stand, however short its window, if nothing more comes."""
        if training and not self.estimator.ready and len(self.estimator.window):
            self.estimator.finish_window()
        if not self.estimator.ready and (frozen or not self.learner.settings.learning):
            raise SemiparamError('with the parameter learning off there is no model to evaluate; expected --train BAG.')

    # What the learner tells (LearnerListener)

    def answered(self, answer: Answer) -> None:
        """Keep the answer."""
        self.answer = answer
        self.on_answer(answer, self.learner.gate.widening)

    def horizon_completed(self, errors: HorizonErrors) -> None:
        """Keep them."""
        self._horizon = errors

    def change_reported(self, record: ChangeRecord) -> None:
        """Hand it on."""
        self.on_change(record)

    def failed(self, place: str, error: BaseException) -> None:
        """Raise it: nobody is there whom the learner must answer."""
        raise error
