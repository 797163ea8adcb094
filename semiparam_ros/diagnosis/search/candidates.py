"""Candidate effects: the columns each would add to the declared model, and where its search begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semiparam_ros.core.columns import CoupledColumns, shaping_order
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.regression import Explained, Fit, predicted
from semiparam_ros.effects import Effect

DERIVATIVE_STEP = 1e-3
"""Half the difference [rad, s or 1] that stands for a derivative: dry friction that turns over between two samples is
no smooth function of a delay, and a much smaller one would see it jump or not at all."""
Place = tuple[str, str | None, tuple[float | None, float | None] | None]
"""Kind and place of an effect, and when it began where several may come one after the other, as loads do; until when
it was there, where it did not begin."""


def candidates(fit: Fit) -> list[tuple[type[Effect], str | None]]:
    """Every kind at every place of the robot, without those that are declared already and cannot come twice."""
    declared = held(fit.effects)
    return [(kind, where) for name, kind in fit.considered.items() for where in kind.places(fit.body)
            if (name, where) not in declared]


def identity(effect: Effect) -> Place:
    """Key that tells an effect from the others of a model."""
    until_s = effect.end_s if effect.start_s is None else None
    return effect.kind, effect.where, (effect.start_s, until_s) if effect.must_start else None


def fixed(fit: Fit) -> set[Place]:
    """Keys of the effects that were declared, which stay whatever a search finds, also what was always there and is
    over."""
    declared = {identity(effect) for effect in fit.declared}
    gone = declared - {identity(effect) for effect in fit.effects}
    return declared | {identity(effect) for effect in fit.effects
                       if identity(replace(effect, span=replace(effect.span, end_s=None))) in gone}


def held(effects: Sequence[Effect]) -> set[tuple[str, str | None]]:
    """Keys of what these effects hold already, as such or as a part of another one, and a model cannot hold twice."""
    return {(part.kind, part.where) for effect in effects if not effect.must_start
            for part in (effect, *effect.plainer())}


def not_held_by(known: Sequence[Effect], effect: Effect) -> list[Effect]:
    """Effects of the known ones that hold nothing of what another one holds: it takes the place of the rest."""
    parts = held([effect])
    return [each for each in known if not held([each]) & parts and not includes([effect], each)]


def includes(effects: Sequence[Effect], other: Effect) -> bool:
    """Return whether one of these effects does the same as another at its place all the time."""
    return any(other.kind in effect.includes and (other.where, other.span) == (effect.where, effect.span)
               for effect in effects)


def explained_by(fit: Fit, effect: Effect, columns: Array) -> Explained:
    """Part that an effect explains by its columns (N, n, c), its coefficients as they may be beforehand.

    Without that a direction that the rigid body nearly holds, as a spring's beside weights, counts for nothing.
    """
    if effect.is_calibration:
        mean = np.zeros(len(effect.calibrations))
        return fit.explain(columns, (mean, float(fit.correlation.mean()) * effect.calibration_scale(fit.body)**-2.0))
    return fit.explain(columns, (effect.prior_mean(fit.body), effect.prior_scale(fit.body)**-2.0))


def added_columns(fit: Fit, effect: Effect) -> Array:
    """(N, n, c) columns that the effect adds to the declared model: its own, or the derivatives of the prediction."""
    if effect.is_calibration:
        values = {**{name: 0.0 for name, _ in effect.calibrations}, **effect.values}
        key = effect.kind, effect.where, *values.items()
        if key not in fit.asked:
            fit.asked[key] = _derivatives(fit, effect)
        return np.asarray(fit.asked[key])
    return fit.assembly.beside(effect, *fit.corrected, None)[0]


def _derivatives(fit: Fit, effect: Effect) -> Array:
    """(N, n, c) central differences of the prediction by the calibrations, where they are, in the order declared."""
    declared = [identity(known) for known in fit.effects]
    place = declared.index(identity(effect)) if identity(effect) in declared else len(declared)
    before, after = fit.effects[:place], fit.effects[place + 1:]
    still = type(effect).correct is Effect.correct
    load = _load(fit, *_corrected(fit, [*before, *after])) if still else None

    def prediction(name: str, step: float) -> Array:
        effects = [*before, effect.with_values(**{name: effect.value(name) + step}), *after]
        return _prediction(fit, effects, effect.moves_friction) if load is None else \
            _shaped(effects, fit.body, load)

    step = DERIVATIVE_STEP
    return np.concatenate([(prediction(name, step) - prediction(name, -step)) / (2.0 * step)
                           for name, _ in effect.calibrations], axis=2)


def others(fit: Fit, effect: Effect) -> list[Effect]:
    """The declared effects without the one of the same kind and place."""
    return [known for known in fit.effects if identity(known) != identity(effect)]


def _prediction(fit: Fit, effects: list[Effect], whole: bool) -> Array:
    """(N, n, 1) outputs of the rigid body and of what it carries, as the effects correct and shape
    it, or of the whole model: late efforts bring late friction with them."""
    body, inputs = _corrected(fit, effects)
    load = _shaped(effects, body, _load(fit, body, inputs))
    return load + _of_effects(fit, body, inputs, loads=False) if whole else load


def _corrected(fit: Fit, effects: list[Effect]) -> tuple[RigidBody, Samples]:
    known = len(fit.effects)
    if tuple(effects[:known]) != fit.effects:
        return CoupledColumns(fit.body, effects).corrected(fit.samples)[:2]
    body, inputs = fit.corrected
    for effect in effects[known:]:
        body, inputs, _ = effect.correct(body, inputs, None)
    return body, inputs


def _load(fit: Fit, body: RigidBody, inputs: Samples) -> Array:
    return body.outputs_of(inputs, fit.rigid_part)[:, :, None] + _of_effects(fit, body, inputs, loads=True)


def _shaped(effects: list[Effect], body: RigidBody, load: Array) -> Array:
    for effect in shaping_order(effects):
        load = effect.transform(body, load)
    return load


def _of_effects(fit: Fit, body: RigidBody, inputs: Samples, loads: bool) -> Array:
    """(N, n, 1) outputs of what acts on the links in the model, as loads do, or of its other effects."""
    outputs = np.zeros((len(inputs), body.n_outputs))
    for index, effect in enumerate(fit.effects):
        if effect.on_links(body) == loads and not effect.is_calibration:
            outputs += predicted(effect.columns(body, inputs, None)[0], fit.coefficients_of(index))
    return outputs[:, :, None]
