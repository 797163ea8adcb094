"""The active estimator and what happens around it: answers in order, learning, gating, and changes of the model.

No ROS here. Work that takes seconds goes to a background; samples that come meanwhile wait and are answered afterwards
in their order, so nothing is lost and the answers are those of an estimator that did everything at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import isfinite
from typing import NamedTuple, Protocol

import numpy as np

from semiparam_ros.core.estimator import Estimator, Prediction
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import worker
from semiparam_ros.online.contact_gate import ContactGate, standardised_innovation
from semiparam_ros.online.history import History, SampleBatch
from semiparam_ros.online.model_switcher import (
    MODEL_PARAMETERS,
    ModelSwitcher,
    completes_window,
    same_model,
    sentence_of,
)
from semiparam_ros.online.state_file import SavedState
from semiparam_ros.online.tare import Tare
from semiparam_ros.online.worker import Background, Job
from semiparam_ros.settings.snapshot import Settings

DRAIN_AT_ONCE = 20
WAITING_AT_MOST = 200_000
FAILURES_AT_MOST = 3
"""So many samples in a row that the active model cannot answer, and it counts as broken."""


class Answer(NamedTuple):
    """What is published of one sample."""

    prediction: Prediction
    residual: Array  # (n,) outputs minus prediction, in N and N m
    innovation: float  # root mean square of the residual in predictive standard deviations
    learnt: bool
    contact: bool
    contact_level: Array  # (n,) residual over the gate's threshold; 0 where it does not judge


class LearnerListener(Protocol):
    """Receives what a learner has to tell; called in the learner's own thread."""

    def answered(self, answer: Answer) -> None:
        """The answer to one sample, in the order of the samples."""

    def horizon_completed(self, errors: HorizonErrors) -> None:
        """The horizon errors of the active model."""

    def shadow_horizon_completed(self, variant: str, errors: HorizonErrors) -> None:
        """The horizon errors of a shadow variant."""

    def told(self, sentence: str) -> None:
        """News for the log."""

    def model_switched(self, success: bool, sentence: str) -> None:
        """Whether a change of the model came about, and a sentence about it."""

    def settings_reverted(self, settings: Settings) -> None:
        """The settings that hold from now on, after a change that failed or a model that broke."""

    def failed(self, place: str, error: BaseException) -> None:
        """Something unexpected went wrong at ``place``; the learner goes on."""


class Learner:
    """Answers every sample once, in order.

    :param listener: told of every answer and of what happens to the model.
    :param checkpoint: gives the newest good saved state to replace a model that broke; None without one.
    """

    def __init__(self, settings: Settings, body: RigidBody, background: Background, listener: LearnerListener,
                 checkpoint: Callable[[], SavedState | None] = lambda: None) -> None:
        self.settings, self.body = settings, body
        self.gate = ContactGate(body.n_outputs)
        self.tare = Tare(body.n_outputs)
        self.waiting: deque[Sample] = deque()
        self.learnt = self.answered = self.lost = 0
        self._background, self._listener, self._checkpoint = background, listener, checkpoint
        self._estimating = False
        self._window_job: Job | None = None
        self._failures = 0
        self.switcher = ModelSwitcher(body, background, self)
        self._begin(settings, worker.new_estimator(settings, body))

    def _begin(self, settings: Settings, estimator: Estimator, past: SampleBatch | None = None) -> None:
        """Go on with an estimator that has seen a past, and with nothing else."""
        self._drop_window_job()
        self.switcher.retire_all(forget_hyperparameters=True)
        self.gate.forget()
        self.estimator, self.built = estimator, settings
        self.history = History(settings.initial_samples, settings.retained_samples, self.body.n_joints,
                               self.body.n_outputs, estimator.origin)
        if past is not None:
            self.history.refill(past)
        self._seen = len(self.history)
        self._failures = 0
        self.switcher.remember(settings, estimator)
        self.switcher.set_shadows(settings, self.history, retry=True)

    # Samples

    @property
    def busy(self) -> bool:
        """Whether the initial window is being evaluated: samples wait."""
        return self._estimating

    def offer(self, sample: Sample) -> None:
        """Answer a sample now, or when those before it are answered."""
        if not self.busy and not self.waiting:
            self._take(sample)
            return
        self.waiting.append(sample)
        if len(self.waiting) > WAITING_AT_MOST:
            self.waiting.popleft()
            self.lost += 1

    def clear_pending(self) -> None:
        """Forget half-finished horizons after a jump of the clock; the models stay."""
        self.gate.reset()
        self.switcher.clear_pending()
        if not self.busy:
            self.estimator.clear_pending()

    def _take(self, sample: Sample) -> None:
        if self.tare.active:
            sample = sample._replace(outputs=sample.outputs - self.tare.bias)
        prediction = self._predict(sample)
        if prediction is None:
            self.lost += 1
            return
        changes = self.gate.changes
        contact = self.gate.judge(prediction, self.settings)
        if self.gate.changes > changes:
            self._listener.told(f'the contact gate opens after {self.settings.gate_timeout:g} s: what lasts so long is '
                                'a change of the robot, and is learnt.')
        learn = self.settings.learning and not contact
        answer = Answer(self._as_measured(prediction), sample.outputs - prediction.mean,
                        standardised_innovation(prediction), learn, contact, self.gate.level)
        self._emit(answer)  # before learning, which takes as long as predicting
        if learn and completes_window(self.estimator):
            self._finish_window(prediction)
        else:
            self._observe(prediction, learn)

    def _predict(self, sample: Sample) -> Prediction | None:
        """The prediction of a sample; None where the active model fails, but is not yet known to be broken."""
        try:
            prediction = self.estimator.predict(sample)
            if not isfinite(float(prediction.mean.sum() + prediction.std.sum())):
                raise FloatingPointError('it predicts values that are not finite')
        except Exception as error:
            self._failures += 1
            broken = isinstance(error, FloatingPointError) or self._failures >= FAILURES_AT_MOST
            self._listener.failed('the active model', error)
            if not broken:
                return None
            self._fall_back(error)
            return self.estimator.predict(sample)
        self._failures = 0
        return prediction

    def _observe(self, prediction: Prediction, learn: bool) -> None:
        try:
            errors = self.estimator.observe(prediction, learn)
        except SemiparamError:
            raise  # of the sample: the model is as it was
        except Exception as error:  # who knows how much of it was learnt
            self._listener.failed('learning', error)
            self._fall_back(error)
        else:
            if errors is not None:
                self._listener.horizon_completed(errors)

    def _as_measured(self, prediction: Prediction) -> Prediction:
        """With the bias of the tare, which the sensor still has."""
        return prediction._replace(mean=prediction.mean + self.tare.bias) if self.tare.active else prediction

    def _emit(self, answer: Answer) -> None:
        sample = answer.prediction.sample
        self.answered += 1
        self._seen += 1
        self.learnt += answer.learnt
        self.tare.add(sample.stamp, sample.outputs - answer.prediction.model_mean, answer.prediction.ready)
        self._listener.answered(answer)
        self.history.append(sample, answer.learnt)
        self.switcher.offer(sample, answer.learnt)

    def _finish_window(self, prediction: Prediction) -> None:
        self._estimating, estimator = True, self.estimator
        self._window_job = self._background.submit(
            worker.finish_window, estimator, prediction,
            done=partial(self._window_done, estimator, prediction))

    def _drop_window_job(self) -> None:
        self._estimating = False
        if self._window_job is not None:
            self._window_job.cancel()
            self._window_job = None

    def _window_done(self, estimator: Estimator, prediction: Prediction, window: worker.Window | None,
                     error: BaseException | None) -> None:
        if estimator is not self.estimator:
            return  # it was reset, or replaced, meanwhile
        self._estimating = False
        if window is None:
            if error is not None and not isinstance(error, SemiparamError):
                self._listener.failed('the estimate of the hyperparameters', error)
            self.estimator.window = []
            self.estimator.observe(prediction)
            self.estimator.window = []
            self._discard_window(sentence_of(error))
        elif window.failure is not None:
            self.estimator = window.estimator
            self._discard_window(sentence_of(window.failure))
        else:
            self.estimator = window.estimator
            if window.errors is not None:
                self._listener.horizon_completed(window.errors)
            self.switcher.remember(self.built, self.estimator)
            self._listener.told(f'{self.built.variant} has its hyperparameters from {self.built.initial_samples} '
                                'samples and takes over from the provisional model.')
        self._drain()

    def _discard_window(self, reason: str) -> None:
        """Gather another initial window; nothing is built from the one that gave no hyperparameters."""
        self._listener.told(f'the initial window gives no hyperparameters ({reason}); another one is gathered.')
        self.history.discard()
        self.switcher.retire_all()
        self._follow_settings(retry=True)

    def _drain(self) -> None:
        """Answer some of those that waited, then let other callbacks in."""
        try:
            for _ in range(DRAIN_AT_ONCE):
                if self.busy or not self.waiting:
                    return
                self._take(self.waiting.popleft())
        finally:  # a sample that cannot be answered must not keep the others waiting
            if self.waiting and not self.busy:
                self._background.later(self._drain)

    # Changes of the model

    def check(self, settings: Settings) -> None:
        """Raise SemiparamError if a model of these settings cannot be built on this robot."""
        if same_model(settings, self.built):
            return
        latest = self.history.latest() or self._at_rest()
        worker.new_estimator(settings, self.body).predict(latest)

    def _at_rest(self) -> Sample:
        zeros = np.zeros(self.body.n_joints)
        return Sample(0, zeros, zeros, zeros, np.zeros(self.body.n_outputs))

    def change(self, settings: Settings) -> str:
        """Take over new, already validated settings; returns a sentence on what happens now, '' for nothing much."""
        self.settings = settings
        sentence = self._change_model(settings)
        self.switcher.set_shadows(settings, self.history, retry=True)
        return sentence

    def _change_model(self, settings: Settings) -> str:
        successor = self.switcher.successor
        if successor is not None and same_model(settings, successor.settings):
            return f'{settings.variant} is being built already.'
        self.switcher.retire_successor()
        if same_model(settings, self.built):
            return '' if successor is None else f'{settings.variant} goes on.'
        if self.switcher.appoint(settings, self.history):
            return f'{settings.variant} learnt as a shadow and answers from the next sample on.'
        return (f'{settings.variant} is being built from {len(self.history)} samples; {self.built.variant} answers '
                'until it takes over, between two samples.')

    def reset(self) -> None:
        """Forget everything learnt; samples that wait are still answered."""
        self.tare = Tare(self.body.n_outputs)
        self._begin(self.settings, worker.new_estimator(self.settings, self.body, origin=self.history.origin))
        self._drain()

    def restore(self, saved: SavedState) -> None:
        """Go on with a state that was saved; what waits is answered by it."""
        self._restore(saved)
        self._drain()

    def _restore(self, saved: SavedState) -> None:
        self.settings = saved.settings
        self.tare = Tare(self.body.n_outputs, saved.bias)
        self._begin(saved.settings, saved.estimator, saved.batch)
        self.gate.restore(saved.gate)

    def state(self) -> SavedState:
        """What :meth:`restore` needs; raises SemiparamError while the initial window is being evaluated."""
        if self.busy:
            raise SemiparamError('hyperparameters are being estimated; try again when the variant has taken over.')
        return SavedState(self.built, self.estimator, self.history.batch(), self.tare.bias, self.gate.state())

    def _fall_back(self, error: Exception) -> None:
        """The active model is broken: go on with the last checkpoint, else with P and no effects."""
        broken, saved = self.built.variant, self._newest_checkpoint()
        if saved is not None:
            self._restore(saved)
            instead = f'{self.built.variant} of the last checkpoint goes on'
        else:
            self.settings = replace(self.settings, variant='P', effects=(), shadow_variants=())
            estimator = worker.new_estimator(self.settings, self.body, origin=self.history.origin)
            self._begin(self.settings, estimator)
            instead = 'P begins anew'
        self._listener.settings_reverted(self.settings)
        self._listener.model_switched(False, f'{broken} is broken ({sentence_of(error)}); {instead}.')

    def _newest_checkpoint(self) -> SavedState | None:
        try:
            return self._checkpoint()
        except Exception as error:
            self._listener.failed('the checkpoint', error)
            return None

    # What the switcher tells

    def successor_live(self, settings: Settings, estimator: Estimator) -> None:
        """It takes over, between two samples."""
        before, self.built, self.estimator = self.built, settings, estimator
        self._drop_window_job()
        self._failures = 0
        changed = f' from {before.variant}' if before.variant != settings.variant else ', changed,'
        self._listener.model_switched(True, f'{settings.variant} takes over{changed} after {self._seen} samples.')
        self._follow_settings()
        self._drain()

    def successor_failed(self, settings: Settings, sentence: str) -> None:
        """The active model goes on, and so do its settings."""
        self.settings = replace(self.settings, **{name: getattr(self.built, name) for name in MODEL_PARAMETERS})
        self._listener.settings_reverted(self.settings)
        self._listener.model_switched(False, self._not_built(settings, sentence))
        self._follow_settings()

    def shadow_failed(self, settings: Settings, sentence: str) -> None:
        """The others go on."""
        self._listener.told(self._not_built(settings, sentence))

    def shadow_horizon(self, variant: str, errors: HorizonErrors) -> None:
        """Handed on."""
        self._listener.shadow_horizon_completed(variant, errors)

    def failed(self, place: str, error: BaseException) -> None:
        """Handed on."""
        self._listener.failed(place, error)

    def _not_built(self, settings: Settings, sentence: str) -> str:
        return f'{settings.variant} could not be built ({sentence}); {self.built.variant} goes on.'

    def _follow_settings(self, retry: bool = False) -> None:
        """Build what the settings ask for and is not there."""
        if same_model(self.settings, self.built):
            self.switcher.set_shadows(self.settings, self.history, retry)
        elif self.switcher.successor is None:
            self.switcher.appoint(self.settings, self.history)
