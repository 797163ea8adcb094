"""The node's estimator on recordings, sample by sample."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from semiparam_ros.bags.loading import LoadedBag
from semiparam_ros.cli.scores import Scores
from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.model import Prediction
from semiparam_ros.core.samples import Sample
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros import jobs
from semiparam_ros.ros.contact_gate import ContactGate, standardised_innovation
from semiparam_ros.ros.model_switcher import completes_window, sentence_of
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator


class OfflineLearner:
    """The estimator of the settings behind the contact gate, as in the node.

    An initial window that gives no hyperparameters, as of a robot that stood still, is followed by another one;
    ``failed_windows`` holds a sentence for each.

    :param bags: the first one that carries a robot description gives it, where the settings do not.
    :param tick: called after each sample.
    """

    def __init__(self, settings: Settings, bags: Sequence[LoadedBag], tick: Callable[[], None]) -> None:
        description = next((bag.robot_description for bag in bags if bag.robot_description), None)
        self.settings, self.gate, self._tick = settings, ContactGate(), tick
        self.estimator = build_estimator(settings, description)
        self.failed_windows: list[str] = []

    def take(self, bag: LoadedBag, scores: Scores, learning: bool) -> None:
        """Predict, then perhaps learn, one recording; what the variant itself predicts is scored."""
        scores.start_recording(bag.samples.origin)
        self.estimator.begin_recording(bag.samples.origin)
        for sample in bag.samples:
            start = time.perf_counter()
            prediction = self.step(sample, learning)
            elapsed = time.perf_counter() - start
            self._tick()
            if not prediction.ready:
                continue
            scores.add(sample.outputs, prediction.mean, elapsed)
            if prediction.horizon is not None:
                scores.add_horizon(prediction.horizon)
        self.gate.reset()
        self.estimator.clear_pending()

    def step(self, sample: Sample, learning: bool) -> Prediction:
        """One sample: a contact is predicted but not learnt."""
        prediction = self.estimator.predict(sample)
        contact = self.gate.judge(sample.stamp, standardised_innovation(prediction), self.settings)
        learn = learning and not contact
        if learn and completes_window(self.estimator):
            return prediction._replace(horizon=self._finish_window(prediction))
        return prediction._replace(horizon=self.estimator.observe(prediction, learn))

    def _finish_window(self, prediction: Prediction) -> HorizonErrors | None:
        window = jobs.finish_window(self.estimator, prediction)
        if window.failure is not None:
            self.failed_windows.append(sentence_of(window.failure))
        return window.errors

    def finish(self, training: Sequence[LoadedBag], frozen: bool) -> None:
        """After training: a model must stand if nothing more is learnt, from however short a window."""
        if training and not self.estimator.ready and self.estimator.window:
            self.estimator.finish_window()
        if not self.estimator.ready and (frozen or not self.settings.learning):
            raise SemiparamError('with the parameter learning off there is no model to evaluate; expected --train BAG.')
