"""Frequencies beyond what the working samples hold: means of fast samples turn them into lower ones."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.diagnosis.regression import Fit, predicted, with_effects
from semiparam_ros.effects import Effect


def as_recorded(fit: Fit, recorded: Samples, found: Collection[int]) -> Fit:
    """The model with each effect with a number of ``found`` as the recorded samples have it, of those that the working
    samples do not tell from it: a shake of 50 Hz reads as one of 10 Hz in means of 25 samples at 1 kHz."""
    effects = [_likeliest(fit, recorded, number) if number in found else effect
               for number, effect in enumerate(fit.effects)]
    return with_effects(fit, effects) if effects != list(fit.effects) else fit


def _likeliest(fit: Fit, recorded: Samples, number: int) -> Effect:
    effect = fit.effects[number]
    options = effect.alike(fit.samples)
    if len(options) == 1:
        return effect
    own = predicted(fit.assembly.of_effect(number, *fit.corrected), fit.coefficients_of(number))
    rows = _in_use(fit, len(recorded))
    rest, some = fit.samples.outputs - fit.residual - own, recorded[rows]
    left = some.outputs - np.column_stack([np.interp(some.time, fit.samples.time, each) for each in rest.T])
    return max(options, key=lambda option: _explained(option.columns(fit.body, some, None)[0] / fit.scale[:, None],
                                                      left / fit.scale))


def _in_use(fit: Fit, count: int) -> Indices:
    """Numbers of the first recorded samples of those that are averaged to samples in use."""
    numbers = np.flatnonzero(np.repeat(fit.train_mask, fit.samples.averaged_of)[:count])
    return np.asarray(numbers[:fit.config.most_working_samples])


def _explained(columns: Array, left: Array) -> float:
    """Squares of what is left (N, n) that columns (N, n, c) explain."""
    rows, values = columns.reshape(-1, columns.shape[2]), left.ravel()
    return float(values @ rows @ np.linalg.lstsq(rows.T @ rows, rows.T @ values, rcond=None)[0])
