"""What becomes of a sample: whether it is learnt, and whether the robot has changed before it.

Kept with each sample, so that a model built later from the samples kept does what the model in force did.
"""

from __future__ import annotations

from enum import IntEnum

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.online.contact_gate import ContactGate


class Learning(IntEnum):
    """Of one sample; true where it is learnt."""

    NO = 0
    YES = 1
    AFTER_CHANGE = 2
    """The first one learnt after a lasting change of the robot: what was learnt before counts for less."""


def learning_of(learn: bool, gate: ContactGate) -> Learning:
    """That of a sample which the gate has just judged."""
    return Learning.AFTER_CHANGE if learn and gate.changed else Learning(learn)


def observe(estimator: Estimator, prediction: Prediction, learning: int, finish: bool = True) -> HorizonErrors | None:
    """See :meth:`Estimator.observe <semiparam_ros.core.estimator.Estimator.observe>`."""
    if learning == Learning.AFTER_CHANGE:
        estimator.follow_change()
    return estimator.observe(prediction, learning > 0, finish)
