"""The model with further effects: calibrations settled by Gauss-Newton, loads named, weights its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.frames import nearest_link
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.candidates import added_columns, others
from semiparam_ros.diagnosis.regression import Fit, fit, refit_weights
from semiparam_ros.effects import Effect

GAUSS_NEWTON_STEPS = 4
SETTLED, SHORTENED = 1e-4, 0.1
"""Largest change of a calibration [rad, s or 1] that no longer matters; share of the step before to go on with the same
derivatives."""


def replace_effect(state: Fit, effect: Effect) -> Fit:
    """The model with the effect declared, in place of one of the same kind and place."""
    return fit(state.body, state.samples, [*others(state, effect), effect], state.use, state.scale)


def gauss_newton(state: Fit, moving: list[Effect]) -> Fit:
    """Move the calibrations of the effects ``moving`` to the least squares, all together.

    Derivatives are costly and are kept as long as they shorten the steps well.
    """
    places, slopes, last = [(effect.kind, effect.where) for effect in moving], None, np.inf
    for _ in range(GAUSS_NEWTON_STEPS):
        moving = [effect for effect in state.effects if (effect.kind, effect.where) in places]
        if slopes is None:
            slopes = [added_columns(state, effect) for effect in moving]
        steps = state.explain(np.concatenate(slopes, axis=2)).coefficients
        parts = np.split(steps, np.cumsum([column.shape[2] for column in slopes])[:-1])
        moved = {(effect.kind, effect.where): _moved(effect, part) for effect, part in zip(moving, parts, strict=True)}
        effects = [moved.get((effect.kind, effect.where), effect) for effect in state.effects]
        state = fit(state.body, state.samples, effects, state.use, state.scale)
        size = float(np.abs(steps).max())
        if size < SETTLED:
            break
        if size > SHORTENED * last:
            slopes = None
        last = size
    return state


def _moved(effect: Effect, step: Array) -> Effect:
    names = [coefficient.name for coefficient in effect.calibrations]
    return effect.with_shape(**{name: effect.value(name) + float(change)
                                for name, change in zip(names, step, strict=True)})


def declare(state: Fit, effects: list[Effect]) -> Fit:
    """The model with further effects, every calibration settled and the weights those of the new residual."""
    for effect in effects:
        replaced = {(part.kind, part.where) for part in effect.plainer()}
        known = [one for one in (state.effects if effect.must_start else others(state, effect))
                 if (one.kind, one.where) not in replaced]
        state = fit(state.body, state.samples, [*known, effect], state.use, state.scale)
    state = _loads_at_nearest_link(refit_weights(state))
    calibrations = [effect for effect in state.effects if effect.is_calibration]
    return refit_weights(gauss_newton(state, calibrations)) if calibrations else state


def _loads_at_nearest_link(state: Fit) -> Fit:
    """The same model with every load named after the link nearest to its centre of mass."""
    effects = list(state.effects)
    blocks = CoupledColumns(state.body, effects).blocks
    for index, effect in enumerate(effects):
        if effect.kind == 'payload':
            mass, *moment = state.theta[blocks[str(index)]][:4]
            if mass > 0.0:
                link, _ = nearest_link(state.body, str(effect.where), np.array(moment) / mass)
                effects[index] = replace(effect, where=link)
    return state if effects == list(state.effects) else fit(state.body, state.samples, effects, state.use, state.scale)
