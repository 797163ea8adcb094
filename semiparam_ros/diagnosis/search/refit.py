"""The model with further effects: what is not linear settled by Gauss-Newton, loads named, weights
its own.

After the judgement it is fitted once more to all samples, its times searched to the sample. What
judges must not fit. But a time inside a block that was held out is known to that block only, and
what is declared from then on should rest on everything that was recorded.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.data.recordings import breaks_s
from semiparam_ros.diagnosis.regression import Fit, predicted, refit_weights, refitted, with_effects
from semiparam_ros.diagnosis.search.candidates import added_columns, identity, not_held_by
from semiparam_ros.diagnosis.search.spans import around, with_best_edge, without_divided
from semiparam_ros.effects import Effect
from semiparam_ros.effects.application_point import POINT

DIFFERENCE = 1e-3
"""Difference that stands for a derivative, over the range in which a line search looks."""
POINT_REACH = 0.1
"""The same range of a point of application [m]."""


class Shape(NamedTuple):
    """One nonlinear value of the effect with this number, and the range in which a line search looks for it."""

    number: int
    name: str
    low: float
    high: float


def shapes_of(fit: Fit, found: Collection[int]) -> list[Shape]:
    """The nonlinear values of the effects with these numbers."""
    shapes = []
    for number in found:
        effect = fit.effects[number]
        for name in () if effect.is_calibration else effect.searched:
            value = effect.value(name)
            low, high = (value - POINT_REACH, value + POINT_REACH) if name in POINT \
                else effect.bounds(name, fit.body, fit.samples, fit.residual)
            if low < high:
                shapes.append(Shape(number, name, low, high))
    return shapes


def points_of(fit: Fit) -> list[Shape]:
    """The coordinates of points of application that are no frame's origin."""
    at_points = [number for number, effect in enumerate(fit.effects) if effect.parameters.keys() & POINT.keys()]
    return [shape for shape in shapes_of(fit, at_points) if shape.name in POINT]


def shape_columns(fit: Fit, shapes: list[Shape]) -> Array:
    """(N, n, len(shapes)) derivatives of the prediction by the values, at the fitted coefficients."""
    slopes = [np.zeros((*fit.residual.shape, 0))]
    for number, name, low, high in shapes:
        effect, step = fit.effects[number], DIFFERENCE * (high - low)
        ahead, behind = (_columns(fit, effect.with_values(**{name: effect.value(name) + change}))
                         for change in (step, -step))
        slope = predicted(ahead - behind, fit.coefficients_of(number)) / (2.0 * step)
        slopes.append(slope[:, :, None])
    return np.concatenate(slopes, axis=2)


def _columns(fit: Fit, effect: Effect) -> Array:
    return fit.assembly.beside(effect, *fit.corrected, None)[0]


def gauss_newton(fit: Fit, moving: Sequence[Effect], found: Collection[int] = ()) -> Fit:
    """Move the calibrations of the effects ``moving``, and the nonlinear values of the effects with the numbers
    ``found``, to their most likely values, all together.

    One may pull against another, as the lead of frictions and a delay of the efforts do. A step that would not lower
    the loss is shortened, one that would hardly lower it is not taken. What no search tries, as a filter of velocities,
    stays as it was declared.
    """
    places = {identity(effect) for effect in moving if effect.places(fit.body)}
    config = fit.config
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
    """Return whether the effects with these numbers can have the values that they have."""
    return all(fit.effects[number].possible and fit.effects[number].physical(fit.coefficients_of(number))
               for number in found if not fit.effects[number].is_calibration)


def settled(fit: Fit, found: Collection[int]) -> Fit:
    """The model with the nonlinear values of these effects, and all calibrations, at the least squares."""
    return declare(gauss_newton(fit, [effect for effect in fit.effects if effect.is_calibration
                                      and not told_by_sliding(fit, effect)], found), [])


def objective(fit: Fit) -> float:
    """Twice the negative log posterior of a model's calibrations, but for a constant: what it leaves, and how far they
    are from what was declared."""
    calibrations = [effect for effect in fit.effects if effect.is_calibration]
    mean, precision = prior_of_steps(fit, calibrations)
    return fit.loss + float(precision @ mean**2)


def prior_of_steps(fit: Fit, moving: Sequence[Effect], free: int = 0) -> tuple[Array, Array]:
    """Means and precisions of further changes of ``free`` values of which nothing is known, and of calibrations, which
    are beforehand about what was declared, zero where nothing was. Neighbouring samples repeat each other, so these
    weigh as much more."""
    declared = {identity(effect): calibrated_values(effect) for effect in fit.declared}
    means = [declared.get(identity(effect), 0.0) - calibrated_values(effect) for effect in moving]
    spread = np.concatenate([np.full(free, np.inf), *(effect.calibration_scale(fit.body) for effect in moving)])
    return np.concatenate([np.zeros(free), *means]), float(fit.correlation.mean()) * spread**-2.0


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
        fit = with_effects(fit, [*not_held_by(fit.effects, effect), effect])
    fit = _relocated(refit_weights(fit))
    return calibrated(fit, [effect for effect in fit.effects if effect.is_calibration])


def remaining(fit: Fit, kept: Sequence[Effect]) -> Fit:
    """The model with those of its effects that are ``kept`` alone, settled anew."""
    return declare(with_effects(fit, following(kept, fit.effects)), [])


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
    """Return whether a calibration is told by joints that slide, for at a turn it looks like another form of
    friction."""
    return effect.moves_friction and fit.body.outputs == 'effort'


def _relocated(fit: Fit) -> Fit:
    """The same model with every effect at the place that its coefficients tell, such as a load's nearest link."""
    effects = [effect.relocated(fit.body, fit.coefficients_of(index)) for index, effect in enumerate(fit.effects)]
    return fit if effects == list(fit.effects) else with_effects(fit, effects)


def fitted_to_all(fit: Fit, usable: Mask, found: Collection[int], counted: Mask | None = None) -> Fit:
    """The same effects in the same order, fitted to all usable samples (N,).

    :param found: numbers of the effects that were found, whose times are searched again near where they are, and whose
        nonlinear values are settled.
    :param counted: (N, n) outputs that tell something, those too in which something begins, for they tell when; the
        model's unless given.
    """
    everything = replace(fit, train_mask=usable, counted=fit.counted if counted is None else counted)
    effects = list(fit.effects)
    for number in found:
        effects[number] = _timed_anew(everything, effects, number)
    timed = without_divided(with_effects(everything, effects))
    return _without_common_gain(settled(declare(timed, []), found))


def _without_common_gain(fit: Fit) -> Fit:
    """The same model with gains as :meth:`Effect.without_common_gain` has them, unless a known mass tells them."""
    effects = [effect.without_common_gain() for effect in fit.effects]
    return fit if fit.knows_mass or effects == list(fit.effects) else refit_weights(with_effects(fit, effects))


def _timed_anew(fit: Fit, effects: list[Effect], number: int) -> Effect:
    effect = effects[number]
    rest = with_effects(fit, [*effects[:number], *effects[number + 1:]])
    for name, time_s in effect.span.values.items():
        if time_s not in breaks_s(fit.samples):
            effect = with_best_edge(rest, effect, name, around(fit, time_s))
    return effect
