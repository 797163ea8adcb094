"""What a learner hands out."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

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


class Outlets(NamedTuple):
    """Where a learner's results go.

    ``answer`` receives each answer, ``errors`` the horizon errors that it completed, ``shadow`` a shadow variant and
    those it completed, ``news`` a sentence for the log, ``switched`` whether a change of the model came about, and a
    sentence, ``reverted`` the settings that stay after a change failed.
    """

    answer: Callable[[Answer], None]
    errors: Callable[[HorizonErrors], None] = lambda errors: None
    shadow: Callable[[str, HorizonErrors], None] = lambda variant, errors: None
    news: Callable[[str], None] = lambda sentence: None
    switched: Callable[[bool, str], None] = lambda success, sentence: None
    reverted: Callable[[Settings], None] = lambda settings: None
