"""What becomes of a sample: whether it is learnt, and whether the robot has changed before it.

Kept with each sample, so that a model built later from the samples kept does what the model in force did.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.online.contact_gate import ContactGate

if TYPE_CHECKING:
    from semiparam_ros.online.change_watch import ChangeWatch


class Learning(IntEnum):
    """Of one sample; positive where it is learnt."""

    OFFSET = -1
    """The wandering offset alone follows it: the robot may have changed, and what it is will be known soon."""
    NO = 0
    YES = 1
    AFTER_CHANGE = 2
    """The first one learnt after a lasting change of the robot: what was learnt before counts for less."""


def learning_of(learn: bool, gate: ContactGate, changes: ChangeWatch | None) -> Learning:
    """That of a sample which the gate has just judged.

    :param learn: whether it may be learnt, for all that is known without these two.
    """
    if not learn:
        return Learning.NO
    if changes is not None and changes.holds:
        return Learning.OFFSET
    return Learning.AFTER_CHANGE if gate.changed else Learning.YES


def observe(estimator: Estimator, prediction: Prediction, learning: int, finish: bool = True) -> HorizonErrors | None:
    """See :meth:`Estimator.observe <semiparam_ros.core.estimator.Estimator.observe>`."""
    if learning == Learning.AFTER_CHANGE:
        estimator.follow_change()
    return estimator.observe(prediction, learning > 0, finish, learning == Learning.OFFSET)
