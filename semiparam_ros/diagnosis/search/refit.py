"""The model with further effects: calibrations settled by Gauss-Newton, loads named, weights its own."""

from __future__ import annotations

from collections.abc import Sequence

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
from semiparam_ros.effects import Effect


def gauss_newton(fit: Fit, moving: list[Effect]) -> Fit:
    """Move the calibrations of the effects ``moving`` to their most likely values, all together.

    A step that would raise the loss is shortened, one that would hardly lower it is not taken.
    """
    places = {identity(effect) for effect in moving}
    for _ in range(fit.config.newton_steps):
        moving = [effect for effect in fit.effects if identity(effect) in places]
        slopes = np.concatenate([added_columns(fit, effect) for effect in moving], axis=2)
        explained = fit.explain(slopes, prior_of_steps(fit, moving))
        gained = fit.counts @ (1.0 - explained.squares / np.maximum(fit.squares, 1e-300))
        if gained < fit.config.settled_gain:
            break
        step = explained.coefficients
        after = _stepped(fit, moving, step)
        while objective(after) > objective(fit) and np.abs(step).max() > fit.config.settled_step:
            step = step * fit.config.backtracking
            after = _stepped(fit, moving, step)
        if objective(after) > objective(fit):
            break
        fit = after
        if np.abs(step).max() < fit.config.settled_step:
            break
    return fit


def objective(fit: Fit) -> float:
    """Twice the negative log posterior of a model's calibrations, but for a constant: what it leaves, and how far they
    are from nothing."""
    prior = prior_of_steps(fit, [effect for effect in fit.effects if effect.is_calibration])
    return fit.loss + float(prior.precision @ prior.mean**2)


def prior_of_steps(fit: Fit, moving: Sequence[Effect]) -> CoefficientPrior:
    """That of further changes of calibrations, which are about zero beforehand. Neighbouring samples repeat each other,
    so it weighs as much more."""
    values = np.concatenate([np.zeros(0), *(calibrated_values(effect) for effect in moving)])
    spread = np.concatenate([np.ones(0), *(effect.calibration_scale(fit.body) for effect in moving)])
    return CoefficientPrior(-values, float(fit.correlation.mean()) * spread**-2.0)


def _stepped(fit: Fit, moving: list[Effect], step: Array) -> Fit:
    return with_effects(fit, calibrations_moved(fit, moving, step))


def calibrations_moved(fit: Fit, moving: list[Effect], step: Array) -> list[Effect]:
    """The model's effects, the calibrations of some moved by a step (c,), one value after the other."""
    ends = np.cumsum([len(effect.calibrations) for effect in moving])[:-1]
    moved = {identity(effect): moved_by(effect, part)
             for effect, part in zip(moving, np.split(step, ends), strict=True)} if moving else {}
    return [moved.get(identity(effect), effect) for effect in fit.effects]


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
        if np.all(fit.scale > fit.config.reweighted * scale):
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
