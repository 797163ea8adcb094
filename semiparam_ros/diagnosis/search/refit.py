"""The model with further effects: what is not linear settled by Gauss-Newton, loads named, weights its own."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.regression import (
    CoefficientPrior,
    Fit,
    refit_weights,
    refitted,
    with_effects,
)
from semiparam_ros.diagnosis.search.candidates import added_columns, held, identity
from semiparam_ros.diagnosis.search.shapes import Shape, shape_columns, shapes_of
from semiparam_ros.effects import Effect


def gauss_newton(fit: Fit, moving: Sequence[Effect], found: Collection[int] = ()) -> Fit:
    """Move the calibrations of the effects ``moving``, and the nonlinear values of the effects with the numbers
    ``found``, to their most likely values, all together.

    One may pull against another, as the lead of frictions and a delay of the efforts do. A step that would not lower
    the loss is shortened, one that would hardly lower it is not taken.
    """
    places, config = {identity(effect) for effect in moving}, fit.config
    for _ in range(config.newton_steps):
        calibrations = [effect for effect in fit.effects if identity(effect) in places]
        shapes = shapes_of(fit, found)
        slopes = [shape_columns(fit, shapes), *(added_columns(fit, effect) for effect in calibrations)]
        explained = fit.explain(np.concatenate(slopes, axis=2), prior_of_steps(fit, calibrations, len(shapes)))
        gained = fit.counts @ (1.0 - explained.squares / np.maximum(fit.squares, 1e-300))
        if gained < config.settled_gain:
            break
        tried = (_moved(fit, shapes, calibrations, config.backtracking**number * explained.coefficients)
                 for number in range(config.line_search_rounds))
        better = next((after for after in tried if objective(after) < objective(fit) and _possible(after, found)), None)
        if better is None:
            break
        fit = better
    return fit


def _possible(fit: Fit, found: Collection[int]) -> bool:
    """Whether the effects with these numbers can have the values that they have."""
    blocks = fit.assembly.blocks
    return all(fit.effects[number].possible and fit.effects[number].physical(fit.theta[blocks[str(number)]])
               for number in found if not fit.effects[number].is_calibration)


def settled(fit: Fit, found: Collection[int]) -> Fit:
    """The model with the nonlinear values of these effects, and all calibrations, at the least squares."""
    return declare(gauss_newton(fit, [effect for effect in fit.effects if effect.is_calibration
                                      and not told_by_sliding(fit, effect)], found), [])


def objective(fit: Fit) -> float:
    """Twice the negative log posterior of a model's calibrations, but for a constant: what it leaves, and how far they
    are from nothing."""
    prior = prior_of_steps(fit, [effect for effect in fit.effects if effect.is_calibration])
    return fit.loss + float(prior.precision @ prior.mean**2)


def prior_of_steps(fit: Fit, moving: Sequence[Effect], free: int = 0) -> CoefficientPrior:
    """That of further changes of ``free`` values of which nothing is known, and of calibrations, which are about zero
    beforehand. Neighbouring samples repeat each other, so it weighs as much more."""
    values = np.concatenate([np.zeros(free), *(calibrated_values(effect) for effect in moving)])
    spread = np.concatenate([np.full(free, np.inf), *(effect.calibration_scale(fit.body) for effect in moving)])
    return CoefficientPrior(-values, float(fit.correlation.mean()) * spread**-2.0)


def _moved(fit: Fit, shapes: Sequence[Shape], calibrations: Sequence[Effect], steps: Array) -> Fit:
    """The model with its shapes and calibrations moved by steps (s + c,)."""
    ends = np.cumsum([len(shapes), *(len(effect.calibrations) for effect in calibrations)])[:-1]
    own, *parts = np.split(steps, ends)
    moved = {identity(effect): moved_by(effect, part) for effect, part in zip(calibrations, parts, strict=True)}
    effects = [moved.get(identity(effect), effect) for effect in fit.effects]
    for (number, name, low, high), step in zip(shapes, own.tolist(), strict=True):
        value = float(np.clip(effects[number].value(name) + step, low, high))
        effects[number] = effects[number].with_values(**{name: value})
    return with_effects(fit, effects)


def calibrated_values(effect: Effect) -> Array:
    """(c,) the calibrations of an effect."""
    return np.array([effect.value(name) for name, _ in effect.calibrations])


def moved_by(effect: Effect, step: Array) -> Effect:
    """The effect with its calibrations moved by a step (c,)."""
    values = calibrated_values(effect) + step
    names = [coefficient.name for coefficient in effect.calibrations]
    return effect.with_values(**dict(zip(names, values.tolist(), strict=True)))


def declare(fit: Fit, effects: list[Effect]) -> Fit:
    """The model with further effects, every calibration settled and the weights those of the new residual.

    One that holds a part of what a known one holds takes its place: dry friction twice at a joint has no value.
    """
    for effect in effects:
        parts = held([effect])
        known = [one for one in fit.effects if not held([one]) & parts]
        fit = with_effects(fit, [*known, effect])
    fit = _relocated(refit_weights(fit))
    return calibrated(fit, [effect for effect in fit.effects if effect.is_calibration])


def calibrated(fit: Fit, calibrations: list[Effect]) -> Fit:
    """The model with these calibrations settled, and the weights those of what that leaves.

    Where one of them moves friction, they are settled on the outputs of joints that slide. Leads of
    frictions follow a delay: in the efforts their turns stay where they are.
    """
    whole, slides = fit, any(told_by_sliding(fit, effect) for effect in calibrations)
    fit = fit.sliding if slides else fit
    while calibrations:
        scale, fit = fit.scale, refit_weights(gauss_newton(fit, calibrations))
        if np.all(fit.scale > fit.config.most * scale):
            break  # else the prior was weighed against noise that there is not
    if not slides:
        return fit
    led = following(fit.effects, whole.effects)
    return refit_weights(refitted(fit, led, fit.nuisance, whole.counted))


def following(effects: Sequence[Effect], before: Sequence[Effect]) -> list[Effect]:
    """The effects of a model, where leads of frictions follow the delay from what it was ``before``."""
    later = sum(effect.late_s for effect in effects) - sum(effect.late_s for effect in before)
    return [effect.led(later) for effect in effects] if later else list(effects)


def told_by_sliding(fit: Fit, effect: Effect) -> bool:
    """Whether a calibration is told by joints that slide, for at a turn it looks like another form of
    friction."""
    return effect.moves_friction and fit.body.outputs == 'effort'


def _relocated(fit: Fit) -> Fit:
    """The same model with every effect at the place that its coefficients tell, such as a load's nearest link."""
    effects, blocks = list(fit.effects), fit.assembly.blocks
    for index, effect in enumerate(effects):
        effects[index] = effect.relocated(fit.body, fit.theta[blocks[str(index)]])
    return fit if effects == list(fit.effects) else with_effects(fit, effects)
