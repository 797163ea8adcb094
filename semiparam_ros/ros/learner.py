"""The active estimator and what happens around it: answers in order, learning, gating, and changes of the model.

No ROS here. Work that takes seconds goes to a background; samples that come meanwhile wait and are answered afterwards
in their order, so nothing is lost and the answers are those of an estimator that did everything at once.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.model import Estimator, Prediction
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros import jobs
from semiparam_ros.ros.answers import Answer, Outlets
from semiparam_ros.ros.background import Background
from semiparam_ros.ros.company import MODEL_PARAMETERS, Company, same_model
from semiparam_ros.ros.contact_gate import ContactGate, standardised_innovation
from semiparam_ros.ros.history import Chapter, History
from semiparam_ros.ros.state_file import SavedState
from semiparam_ros.ros.tare import Tare
from semiparam_ros.ros.understudy import Understudy, completes_window, sentence_of
from semiparam_ros.settings.snapshot import Settings

DRAIN_AT_ONCE = 20
WAITING_AT_MOST = 200_000


class Learner:
    """Answers every sample once, in order."""

    def __init__(self, settings: Settings, body: RigidBody, background: Background, outlets: Outlets) -> None:
        self.settings, self.body = settings, body
        self.gate = ContactGate()
        self.tare = Tare(body.n_outputs)
        self.waiting: deque[Sample] = deque()
        self.learnt = self.answered = self.lost = 0
        self._background, self._outlets = background, outlets
        self.company = Company(body, background, self._hand_over, self._cannot_build, outlets.shadow)
        self._begin(jobs.new_estimator(settings, body))

    def _begin(self, estimator: Estimator, past: Chapter | None = None) -> None:
        settings = self.settings
        self.estimator, self.built = estimator, settings
        self.history = History(settings.initial_samples, settings.retained_samples, self.body.n_joints,
                               self.body.n_outputs)
        if past is not None:
            self.history.refill(past)
        self._window_job: object | None = None
        self.company.remember(settings, estimator)
        self.company.set_shadows(settings, self.history)

    # Samples

    @property
    def busy(self) -> bool:
        """Whether the initial window is being evaluated: samples wait."""
        return self._window_job is not None

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
        for understudy in self.company.all:
            understudy.clear_pending()
        if not self.busy:
            self.estimator.clear_pending()

    def _take(self, sample: Sample) -> None:
        if self.tare.active:
            sample = sample._replace(outputs=sample.outputs - self.tare.bias)
        prediction = self.estimator.predict(sample)
        innovation = standardised_innovation(prediction)
        contact = self.gate.judge(sample.stamp, innovation, self.settings)
        learn = self.settings.learning and not contact
        answer = Answer(self._as_measured(prediction), sample.outputs - prediction.mean, innovation, learn, contact)
        self._emit(answer)  # before learning, which takes as long as predicting
        if learn and completes_window(self.estimator):
            self._finish_window(prediction)
        else:
            self._complete(self.estimator.observe(prediction, learn))

    def _complete(self, errors: HorizonErrors | None) -> None:
        if errors is not None:
            self._outlets.errors(errors)

    def _as_measured(self, prediction: Prediction) -> Prediction:
        """With the bias of the tare, which the sensor still has."""
        return prediction._replace(mean=prediction.mean + self.tare.bias) if self.tare.active else prediction

    def _emit(self, answer: Answer) -> None:
        sample = answer.prediction.sample
        self.answered += 1
        self.learnt += answer.learnt
        self.tare.add(sample.stamp, answer.residual, answer.prediction.ready)
        self._outlets.answer(answer)
        self.history.append(sample, answer.learnt)
        self.company.offer(sample, answer.learnt)

    def _finish_window(self, prediction: Prediction) -> None:
        job = self._window_job = object()
        self._background.submit(jobs.observe, self.estimator, prediction,
                                done=lambda result, error: self._window_done(job, result, error))

    def _window_done(self, job: object, result: tuple[Estimator, HorizonErrors | None] | None,
                     error: BaseException | None) -> None:
        if job is not self._window_job:
            return  # it was reset, or replaced, meanwhile
        self._window_job = None
        if result is None:
            self.estimator.window = []
            self._outlets.news(f'the initial window gives no hyperparameters ({sentence_of(error)}); another one is '
                               'gathered.')
        else:
            self.estimator, errors = result
            self._complete(errors)
            self.company.remember(self.built, self.estimator)
            self._outlets.news(f'{self.built.variant} has its hyperparameters from {self.built.initial_samples} '
                               'samples and takes over from the provisional model.')
        self._drain()

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
        jobs.new_estimator(settings, self.body).predict(latest)

    def _at_rest(self) -> Sample:
        zeros = np.zeros(self.body.n_joints)
        return Sample(0, zeros, zeros, zeros, np.zeros(self.body.n_outputs))

    def change(self, settings: Settings) -> str:
        """Take over new, already validated settings; returns a sentence on what happens now, '' for nothing much."""
        self.settings = settings
        successor = self.company.successor
        if successor is not None and not same_model(settings, successor.settings):
            self.company.dismiss_successor()
        elif successor is not None:
            return f'{settings.variant} is being built already.'
        if same_model(settings, self.built):
            self.company.set_shadows(settings, self.history, retry=True)
            return '' if successor is None else f'{settings.variant} goes on.'
        understudy = self.company.appoint(settings, self.history)
        if understudy.live:
            return f'{settings.variant} learnt as a shadow and answers from the next sample on.'
        return (f'{settings.variant} is being built from {len(self.history)} samples; {self.built.variant} answers '
                'until it takes over, between two samples.')

    def reset(self) -> None:
        """Forget everything learnt; samples that wait are still answered."""
        self.company.dismiss(forget_hyperparameters=True)
        self.gate.reset()
        self.tare = Tare(self.body.n_outputs)
        self._begin(jobs.new_estimator(self.settings, self.body))
        self._drain()

    def restore(self, saved: SavedState) -> None:
        """Go on with a state that was saved; what waits is answered by it."""
        self.settings = saved.settings
        self.company.dismiss(forget_hyperparameters=True)
        self.gate.restore(saved.gate)
        self.tare = Tare(self.body.n_outputs, saved.bias)
        self._begin(saved.estimator, saved.chapter)
        self._drain()

    def state(self) -> SavedState:
        """What :meth:`restore` needs; raises SemiparamError while the initial window is being evaluated."""
        if self.busy:
            raise SemiparamError('hyperparameters are being estimated; try again when the variant has taken over.')
        return SavedState(self.built, self.estimator, self.history.chapter(), self.tare.bias, self.gate.state())

    def _hand_over(self, successor: Understudy) -> None:
        assert successor.estimator is not None
        self.company.successor = None
        before, self.built, self.estimator = self.built, successor.settings, successor.estimator
        self._window_job = None
        self.company.remember(self.built, self.estimator)
        self._outlets.switched(True, f'{self.built.variant} takes over{_from(before, self.built)} after '
                                     f'{self.answered} samples.')
        self._follow_wishes()
        self._drain()

    def _follow_wishes(self) -> None:
        """The settings may have changed again while a model was being built."""
        if same_model(self.settings, self.built):
            self.company.set_shadows(self.settings, self.history)
        else:
            self.company.appoint(self.settings, self.history)

    def _cannot_build(self, settings: Settings, sentence: str) -> None:
        sentence = f'{settings.variant} could not be built ({sentence}); {self.built.variant} goes on.'
        if not same_model(settings, self.settings):
            self._outlets.news(sentence)
        else:
            self._outlets.switched(False, sentence)
            kept = {name: getattr(self.built, name) for name in MODEL_PARAMETERS}
            self.settings = replace(self.settings, **kept)
            self._outlets.reverted(self.settings)
        self._follow_wishes()


def _from(before: Settings, after: Settings) -> str:
    return f' from {before.variant}' if before.variant != after.variant else ', changed,'
