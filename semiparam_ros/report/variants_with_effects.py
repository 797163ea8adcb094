"""Every variant learnt without and with the effects found, judged where the diagnosis judged.

Features can swallow an effect: their residual is small where they learnt, and the effect shows only in how they carry
over to other motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from semiparam_ros.core.model import Estimator
from semiparam_ros.diagnosis.diagnose import Diagnosis
from semiparam_ros.diagnosis.judgement import Judgement
from semiparam_ros.effects import Effect
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import model_options


def judge_variants(settings: Settings, diagnosis: Diagnosis, variants: Sequence[str],
                   progress: Callable[[str], None]) -> dict[str, Any]:
    """``{variant: {'before': ..., 'after': ...}}`` on the held-out samples, learning only those that fitted."""
    judged = {}
    for variant in variants:
        entry = {}
        for label, effects in (('before', diagnosis.first.effects), ('after', diagnosis.final.effects)):
            progress(f'{variant} {label}')
            entry[label] = _judge(replace(settings, variant=variant), diagnosis, effects).as_dict()
        judged[variant] = entry
    return judged


def _judge(settings: Settings, diagnosis: Diagnosis, effects: Sequence[Effect]) -> Judgement:
    body, samples, use = diagnosis.first.body, diagnosis.first.samples, diagnosis.first.use
    options = model_options(settings)
    estimator = Estimator(body, replace(options, initial_samples=min(options.initial_samples, int(use.sum()))),
                          effects)
    for sample, learn in zip(samples, use, strict=True):
        estimator.step(sample, bool(learn))
    estimator.clear_pending()
    judged, mask = (samples, diagnosis.held_out) if diagnosis.judged is None or diagnosis.judged_valid is None \
        else (diagnosis.judged, diagnosis.judged_valid)
    residual = np.array([sample.outputs - estimator.step(sample, learn=False).mean for sample in judged])
    return Judgement(judged.outputs[mask], residual[mask], diagnosis.after.parts, diagnosis.after.wrench)
