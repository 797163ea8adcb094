"""Every variant learnt without and with the effects found, judged where the diagnosis judged.

Features can swallow an effect: their residual is small where they learnt, and the effect shows only in how they carry
over to other motion. Features are drawn by chance, and a draw's luck is as large as what is looked for: several are
drawn, the same ones without and with the effects. They learn from the recording as the node does, sample by sample with
the accelerations that came with it, not from the smoothed motion that causes are looked for in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.variants import variant_named
from semiparam_ros.diagnosis.diagnose import Diagnosis, Recorded
from semiparam_ros.diagnosis.evaluation import evaluation_of
from semiparam_ros.effects import Effect
from semiparam_ros.experiments.parallel import run_all, workers
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import model_options

DRAWS = 5
LABELS = ('before', 'after')


def evaluate_variants(settings: Settings, diagnosis: Diagnosis, variants: Sequence[str], jobs: int,
                      progress: Callable[[int, int], None]) -> dict[str, Any]:
    """``{variant: {'before': ..., 'after': ..., 'draws': {'before': [...], 'after': [...]}}}`` on the held-out samples.

    Figures are means over the draws of the features; ``draws`` holds the normalised error of each.

    :param jobs: how many to learn at a time.
    :param progress: called with the number of models learnt, and of all.
    """
    body, effects = diagnosis.first.body, (diagnosis.first.effects, diagnosis.final.effects)
    keys = [(variant, label, draw) for variant in variants for label in (0, 1) for draw in range(_draws(variant))]
    calls = [(replace(settings, variant=variant, features_seed=settings.features_seed + draw), body, diagnosis.recorded,
              effects[label])
             for variant, label, draw in keys]
    done = iter(range(1, len(calls) + 1))
    with workers(jobs):
        evaluations = dict(zip(keys, run_all(_judge, calls, lambda: progress(next(done), len(calls))), strict=True))
    judged: dict[str, Any] = {}
    for variant in variants:
        draws = [[evaluations[variant, label, draw] for draw in range(_draws(variant))] for label in (0, 1)]
        judged[variant] = {name: mean_of(each) for name, each in zip(LABELS, draws, strict=True)} | {
            'draws': {name: [one['nmse_mean'] for one in each] for name, each in zip(LABELS, draws, strict=True)}}
    return judged


def mean_of(evaluations: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Every figure's mean."""
    return {name: None if first is None else np.mean([each[name] for each in evaluations], axis=0).tolist()
            for name, first in evaluations[0].items()}


def _draws(variant: str) -> int:
    return DRAWS if variant_named(variant).features else 1


def _judge(settings: Settings, body: RigidBody, recorded: Recorded, effects: Sequence[Effect]) -> dict[str, Any]:
    options = model_options(settings)
    window = min(options.initial_samples, int(recorded.fitting.sum()))
    first, judged = recorded.samples, recorded.judged
    estimator = Estimator(body, replace(options, initial_samples=window), effects, first.origin)
    for sample, learn in zip(recorded.samples, recorded.fitting, strict=True):
        estimator.step(sample, bool(learn))
    estimator.clear_pending()
    if judged is not first:  # it goes on where the first one ends: what began during that one is there
        estimator.begin_recording(int(judged.stamps[0] - (first.stamps[-1] - first.origin)))
    residual = np.array([sample.outputs - estimator.step(sample, learn=False).mean for sample in judged])
    return evaluation_of(body, judged.outputs, residual, recorded.valid).as_dict()
