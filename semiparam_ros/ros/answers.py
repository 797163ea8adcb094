"""What a learner tells whoever listens to it."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.model import Prediction
from semiparam_ros.core.types import Array
from semiparam_ros.settings.snapshot import Settings


class Answer(NamedTuple):
    """What is published of one sample."""

    prediction: Prediction
    residual: Array  # (n,) outputs minus prediction, in N and N m
    innovation: float  # root mean square of the residual in predictive standard deviations
    learnt: bool
    contact: bool


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
