"""Several joints whose zeros are off at once: a set of causes that one at a time is not seen.

Each zero alone explains little of what all of them do, and a tilt, springs or crosstalk resemble the sum more closely.
"""

from __future__ import annotations

from itertools import compress

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.residual.noise import correlation_times
from semiparam_ros.diagnosis.search.candidates import added_columns
from semiparam_ros.diagnosis.search.elimination import without_needless
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.scoring import Trial, score
from semiparam_ros.effects import Effect
from semiparam_ros.effects.geometry import JointOffset

KIND = JointOffset.kind


def joint_offsets(fit: Fit, kinds: dict[str, type[Effect]], ranking: list[Trial]) -> tuple[list[Trial], Fit] | None:
    """The zeros of several joints and the model with them, where together they may beat the best of the ranking."""
    declared = {(effect.kind, effect.where) for effect in fit.effects}
    if not any(trial.effect.kind == KIND and trial.evidence > 0.0 for trial in ranking):
        return None
    zeros = [kinds[KIND](joint, {'offset': 0.0}) for joint in fit.body.joints if (KIND, joint) not in declared]
    columns = [added_columns(fit, zero) for zero in zeros]
    felt = [np.abs(fit.weighed(column)).max() > fit.config.offset_felt for column in columns]
    zeros, columns = list(compress(zeros, felt)), list(compress(columns, felt))
    if len(zeros) < 2:
        return None
    linear = fit.explain(np.concatenate(columns, axis=2))
    if _together(fit, zeros[0], linear.residual, linear.rank).evidence < fit.config.offsets_worth * ranking[0].evidence:
        return None
    after, _ = without_needless(declare(fit, zeros), declared)
    found = [effect for effect in after.effects if (effect.kind, effect.where) not in declared]
    return [_together(fit, zero, after.residual, len(found)) for zero in found], after


def _together(fit: Fit, zero: Effect, residual: Array, n_parameters: int) -> Trial:
    return score(fit, Trial(zero, residual, n_parameters), correlation_times(fit.used(residual), fit.config))
