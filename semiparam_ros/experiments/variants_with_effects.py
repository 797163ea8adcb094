"""Evaluation of every variant without and with the effects found, where the diagnosis judged.

Features can swallow an effect: their residual is small where they learnt, and the effect shows only
in how they carry over to other motion. Features are drawn by chance, and a draw's luck is as large
as what is looked for: several are drawn, the same ones without and with the effects. They learn
from the recording as the node does, sample by sample with the accelerations that came with it, not
from the smoothed motion that causes are looked for in. The models with the effects are judged as
such, not as far as a node would believe them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import islice
from typing import Literal, TypedDict

import numpy as np

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.core.variants import variant_named
from semiparam_ros.diagnosis.diagnose import Diagnosis, Recorded
from semiparam_ros.diagnosis.evaluation import EvaluationFigures, evaluation_of
from semiparam_ros.effects import Effect
from semiparam_ros.experiments.parallel import run_all, workers
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import model_options

DRAWS = 5
"""Draws of the features; a variant without features has one."""


class Draws(TypedDict):
    """The normalised error of each draw of the features."""

    before: list[float]
    after: list[float]


class VariantErrors(TypedDict):
    """A variant without the effects found and with them: means over the draws, and the draws."""

    before: EvaluationFigures
    after: EvaluationFigures
    draws: Draws


def evaluate_variants(settings: Settings, diagnosis: Diagnosis, variants: Sequence[str], jobs: int,
                      progress: Callable[[int, int], None]) -> dict[str, VariantErrors]:
    """Figures of each variant on the held-out samples.

    :param jobs: how many to learn at a time.
    :param progress: called with the number of models learnt, and of all.
    """
    body, models = diagnosis.first.body, (diagnosis.first, diagnosis.final)
    calls = [(replace(settings, variant=variant, features_seed=settings.features_seed + draw), body, diagnosis.recorded,
              model.effects)
             for variant in variants for model in models for draw in range(_draws(variant))]
    done = iter(range(1, len(calls) + 1))
    with workers(jobs):
        evaluations = iter(run_all(_judge, calls, lambda: progress(next(done), len(calls))))
    judged: dict[str, VariantErrors] = {}
    for variant in variants:
        before, after = (list(islice(evaluations, _draws(variant))) for _ in models)
        judged[variant] = {'before': mean_of(before), 'after': mean_of(after),
                           'draws': {'before': [one['nmse_mean'] for one in before],
                                     'after': [one['nmse_mean'] for one in after]}}
    return judged


def mean_of(evaluations: Sequence[EvaluationFigures]) -> EvaluationFigures:
    """Mean of every figure."""
    def mean(name: Literal['nmse', 'rmse', 'nmse_mean_interval']) -> list[float]:
        return np.mean([each[name] for each in evaluations], axis=0).tolist()  # type: ignore[no-any-return]

    forces = [each['eps_force'] for each in evaluations if each['eps_force'] is not None]
    return {'nmse': mean('nmse'), 'rmse': mean('rmse'),
            'nmse_mean': float(np.mean([each['nmse_mean'] for each in evaluations])),
            'nmse_mean_interval': mean('nmse_mean_interval'), 'eps_force': float(np.mean(forces)) if forces else None,
            'eps_torque': float(np.mean([each['eps_torque'] for each in evaluations]))}


def _draws(variant: str) -> int:
    return DRAWS if variant_named(variant).features else 1


def _judge(settings: Settings, body: RigidBody, recorded: Recorded, effects: Sequence[Effect]) -> EvaluationFigures:
    options = model_options(settings)
    window = min(options.initial_samples, int(recorded.fitting.sum()))
    first, judged = recorded.samples, recorded.judged
    if judged is not first:  # what belongs to the first one's clock, as a drift, is over when the other begins
        effects = [effect.with_values(end_s=float(first.time[-1])) if effect.of_one_recording and not effect.ends
                   else effect for effect in effects]
    estimator = Estimator(body, replace(options, initial_samples=window, alone=True), effects, first.origin)
    _errors(estimator, first, first.origin, recorded.fitting)
    if not estimator.ready:  # the robot stood still in some of them
        estimator.finish_window()
    # another recording goes on where the first one ends: what began during that one is there
    since = 0 if judged is first else int(first.stamps[-1] - judged.stamps[0])
    residual = _errors(estimator, judged, first.origin - since, np.zeros(len(judged), dtype=bool))
    return evaluation_of(body, judged.outputs, residual, recorded.valid).as_dict()


def _errors(estimator: Estimator, samples: Samples, origin: int, learnt: Mask) -> Array:
    """(N, n) what is left of samples, of which those ``learnt`` (N,) are; each recording begins afresh."""
    begin, errors = {int(samples.stamps[0]), *samples.breaks}, []
    for sample, learn in zip(samples, learnt, strict=True):
        if sample.stamp in begin:
            estimator.begin_recording(origin, sample.stamp)
        errors.append(sample.outputs - estimator.step(sample, bool(learn)).mean)
    return np.array(errors)
