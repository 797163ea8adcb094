"""Fate of a sample: whether it is news and learnt, and whether the robot changed before it.

Kept with each sample, so that a model built later from the samples kept does what the model in force did.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array, Codes, Mask
from semiparam_ros.effects.loads import Payload
from semiparam_ros.online.change_causes import OF_FRICTION, friction_directions, load_directions
from semiparam_ros.online.contact_gate import ContactGate

if TYPE_CHECKING:
    from semiparam_ros.online.change_watch import ChangeWatch


OFF, APPLY = 'off', 'apply'
"""Of ``diagnosis.auto``."""


class Learning(IntEnum):
    """Fate of one sample; above zero where it is learnt."""

    RETURNED = -4
    """As OFFSET: with it the robot is as before its last change, and the model returns to what it knew then."""
    TAKEN_BACK = -3
    """As OFFSET, the first of them: what stands out began before it was seen, so what was learnt in the last two
    seconds is taken back."""
    OFFSET = -2
    """The wandering offset alone follows it: the robot may have changed, and what it is will be known soon."""
    NO_NEWS = -1
    """Not learnt, nor do bands and offset follow it: the robot is at rest, its motors are off, or
    the clock has just jumped. A model that predicts otherwise, or does not know all samples of a
    rest, could not tell that again."""
    NO = 0
    YES = 1
    AFTER_CHANGE = 2
    """The first one learnt after a lasting change of the robot: the model begins anew from what it knows."""
    AFTER_LOAD = 3
    """The first one learnt after a load was picked up, or put down: nothing else is in doubt."""
    AFTER_FRICTION = 4
    """The same after friction or an offset became another one."""


ANEW = 16
"""Added to the fate of a sample, away from zero, where something else is taken off the outputs since the one before
that was news: a tare has moved, or tools are others. The wandering offset begins anew with it."""


def begins_anew(learning: int) -> int:
    """The fate of a sample so marked."""
    return learning + (ANEW if learning > 0 else -ANEW)


def plain(learning: Codes) -> Codes:
    """(N,) fates without that mark."""
    return np.asarray(np.where(np.abs(learning) > ANEW // 2, learning - ANEW * np.where(learning > 0, 1, -1), learning))


def learning_of(estimator: Estimator, prediction: Prediction, learn: bool, gate: ContactGate,
                changes: ChangeWatch) -> Learning:
    """Fate of a sample which the model in force has predicted and the gate has just judged.

    :param learn: let it be learnt if it is news. :param changes: keep what may be a change from being learnt.
    """
    if not prediction.motion.is_news:
        return Learning.NO_NEWS
    after = Learning.AFTER_CHANGE if gate.changed else changes.follows
    follows = learn and after is not None and not changes.holds
    if estimator.compare(prediction) or (follows and estimator.as_before_s):
        return Learning.RETURNED
    if learn and changes.holds:
        return Learning.TAKEN_BACK if changes.begins_to_hold else Learning.OFFSET
    return after if follows and after is not None else Learning(learn)


def see_again(estimator: Estimator, sample: Sample, learning: int, finish: bool = True) -> HorizonErrors | None:
    """Predict a sample and observe it, as another model did before."""
    if abs(learning) > ANEW // 2:
        estimator.forget_offset()
        learning = int(plain(np.array(learning)))
    return observe(estimator, estimator.predict(sample), learning, finish)


def observe(estimator: Estimator, prediction: Prediction, learning: int, finish: bool = True) -> HorizonErrors | None:
    """See :meth:`Estimator.observe <semiparam_ros.core.estimator.Estimator.observe>`."""
    motion, is_news = prediction.motion, learning != Learning.NO_NEWS
    if motion.is_news != is_news:
        prediction = prediction._replace(motion=motion._replace(is_news=is_news))
    follow = learning in (Learning.OFFSET, Learning.TAKEN_BACK, Learning.RETURNED)
    complete = estimator.observe(prediction, learning > 0, finish, follow)
    if learning == Learning.TAKEN_BACK:
        estimator.take_back()
    follow_change(estimator, learning)
    return complete


def follow_change(estimator: Estimator, learning: int) -> None:
    """Let a model follow the change that is told with a sample, if any is."""
    if learning == Learning.RETURNED:
        estimator.go_back()
    elif learning >= Learning.AFTER_CHANGE:
        estimator.follow_change(directions_of(learning, estimator.columns))


def is_change(learning: Codes) -> Mask:
    """(N,) which samples came with a change of the robot that was followed, or its end."""
    fates = plain(learning)
    return (fates >= Learning.AFTER_CHANGE) | (fates == Learning.RETURNED)


def directions_of(learning: int, columns: CoupledColumns) -> Array | None:
    """(q, k) the coefficients that are in doubt after a change; None: all of them."""
    if learning == Learning.AFTER_LOAD:
        return load_directions(columns)
    return friction_directions(columns) if learning == Learning.AFTER_FRICTION else None


def learning_after(kind: str) -> Learning:
    """Fate of the first sample learnt after a change that was told as of some kind ('': of none)."""
    if kind == Payload.kind:
        return Learning.AFTER_LOAD
    return Learning.AFTER_FRICTION if kind in OF_FRICTION else Learning.AFTER_CHANGE
