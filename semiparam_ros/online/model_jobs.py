"""Estimators built from samples: what the process beside the node does for models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.ensemble import MARK_NS, MARKS
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.motion import beginning_steps
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.types import Codes, Indices, Mask, Stamps
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.history import SampleBatch
from semiparam_ros.online.learning import OFF, Learning, follow_change, is_change, observe, plain, see_again
from semiparam_ros.online.renewal import MOST_WORSE, Errors, RecentWindow, judged, later_window
from semiparam_ros.settings.build import declared_effects, hyperparameter_values, model_options
from semiparam_ros.settings.snapshot import Settings

EstimatorJob = Callable[..., Estimator]
"""Gives an estimator, in the background."""

OLDER = 5
"""One of so many samples before a later window is learnt: hyperparameters of that window make a model
that fits other motion less well than it believes, and where that is most of what it learns the new
motion is fitted the worse. From before a change of the robot they are what it may return to."""
OLDER_OF_DRAFT = 1000
"""Of a draft, which is wanted soon, so many at most."""

TAKEN_BACK_NS = MARK_NS * (MARKS - 1)
"""So long ago the oldest copy is from, at least."""


class Known(NamedTuple):
    """Hyperparameters that an earlier estimate gave for the same model, with the scaling of its
    inputs."""

    hyperparameters: Hyperparameters
    input_mean: tuple[float, ...]
    input_scale: tuple[float, ...]
    window: int  # samples that they are from
    others: tuple[Hyperparameters, ...] = ()  # of the variants averaged with it


def finish_window(estimator: Estimator, draft: bool = False) -> Estimator:
    """The estimator whose initial window is full, with its hyperparameters estimated and the window
    learnt."""
    estimator.finish_window(draft)
    return estimator


def build(settings: Settings, body: RigidBody, batch: SampleBatch, known: Known | None,
          origin: int | None) -> Estimator:
    """A new estimator that has seen all samples of a batch; time counts from ``origin`` [ns]."""
    return absorb(new_estimator(settings, body, known, origin), batch)


def renew(settings: Settings, body: RigidBody, batch: SampleBatch, origin: int | None,
          later: RecentWindow | None = None) -> Estimator:
    """The same with hyperparameters from a later window, see :mod:`semiparam_ros.online.renewal`.

    Raises SemiparamError when the window holds too little to estimate from, or the model predicts
    it worse than the one that it is to beat.
    """
    later = later or RecentWindow(settings.initial_samples)
    gathering, learning = new_estimator(settings, body, origin=origin), plain(batch.learning)
    anew = learning != batch.learning
    learnt = (learning > 0) & beginning_steps(batch.stamps)
    window = later_window(learnt, later.samples)
    begin = int(window.argmax())
    start = 0 if settings.effects else begin  # they may remember all that was before
    for (sample, _), chosen in zip(batch.part(start).pairs(), window[start:].tolist(), strict=True):
        gathering.gather(sample, chosen)
    gathering.finish_window(later.draft, learn=False)
    estimator, errors = new_estimator(settings, body, known_of(gathering), origin), Errors(body.n_outputs)
    estimator.marks |= bool((learning == Learning.TAKEN_BACK).any())
    compared = later_window(learnt, judged(later.samples))
    changes = 1 + np.flatnonzero(is_change(learning[1:begin]))  # of what was before the first nothing is known
    fates = dict(zip(changes.tolist(), learning[changes].tolist(), strict=True))
    older = _thin(learning[:begin], batch.stamps[:begin], changes, later.draft)
    replayed = np.append(older[:start], np.ones(len(batch) - start, dtype=bool))
    each = zip(np.flatnonzero(replayed).tolist(), batch.chosen(replayed).pairs(), learning[replayed].tolist(),
               compared[replayed].tolist(), strict=True)
    for number, (sample, _), learns, chosen in each:
        _follow(estimator, fates.get(number, Learning.NO), anew[number])
        prediction = estimator.predict(sample)
        if chosen:
            errors.add(prediction)
        observe(estimator, prediction, learns)
    if errors.size > MOST_WORSE * later.to_beat:
        raise SemiparamError(f'the model that follows has errors of {errors.size:.3g} over that window where the model '
                             f'in force has {later.to_beat:.3g}.')
    return estimator


def _thin(learning: Codes, stamps: Stamps, changes: Indices, draft: bool) -> Mask:
    """Mask (b,) of the samples before the window that are replayed; of the others ``learning`` (b,) then says no."""
    begin, since = len(learning), max(changes.tolist(), default=0)
    first, every = (max(OLDER, -(-count // OLDER_OF_DRAFT)) if draft else OLDER for count in (since, begin - since))
    older = np.zeros(begin, dtype=bool)
    older[:since:first] = older[since::every] = older[changes] = True
    _leave_out_taken_back(learning, stamps)
    learning[:] = np.minimum(learning, np.where(older, Learning.YES, Learning.NO))
    learning[learning == Learning.RETURNED] = Learning.NO
    return older


def _follow(estimator: Estimator, fate: int, anew: bool) -> None:
    """Follow what came with a sample, before it is learnt."""
    follow_change(estimator, fate)
    if anew:
        estimator.forget_offset()


def _leave_out_taken_back(learning: Codes, stamps: Stamps) -> None:
    """Learn nothing of what was taken back from the model in force, which a model of some of the samples cannot do
    by copies."""
    passed = np.cumsum(np.abs(np.diff(stamps, prepend=stamps[:1])))
    changed = np.flatnonzero(is_change(learning))
    for end in np.flatnonzero(learning == Learning.TAKEN_BACK).tolist():
        learnt_since = int(np.searchsorted(passed, passed[end] - TAKEN_BACK_NS))
        start = max([learnt_since, *changed[changed < end] + 1])
        learning[start:end] = np.minimum(learning[start:end], Learning.NO)
    learning[learning == Learning.TAKEN_BACK] = Learning.OFFSET


def new_estimator(settings: Settings, body: RigidBody, known: Known | None = None,
                  origin: int | None = None) -> Estimator:
    """An estimator that has learnt nothing yet; time counts from ``origin`` [ns]."""
    if known is not None:
        settings = settings.changed(hyperparameter_values(*known[:3]))
    options = replace(model_options(settings), others=known.others if known else ())
    estimator = Estimator(body, options, declared_effects(settings), origin, known.window if known else 0)
    estimator.marks = settings.diagnosis_auto != OFF
    return estimator


def absorb(estimator: Estimator, batch: SampleBatch) -> Estimator:
    """Predict and learn further samples, as the node did when they came."""
    estimator.marks |= bool((plain(batch.learning) == Learning.TAKEN_BACK).any())
    for sample, learnt in batch.pairs():
        see_again(estimator, sample, learnt)
    return estimator


def known_of(estimator: Estimator) -> Known | None:
    """The hyperparameters of an estimator whose initial window is over."""
    if not estimator.ready or estimator.input_scaling is None:
        return None
    mean, scale = estimator.input_scaling
    return Known(estimator.model.hyperparameters, tuple(mean.tolist()), tuple(scale.tolist()),
                 estimator.window_samples, estimator.others)
