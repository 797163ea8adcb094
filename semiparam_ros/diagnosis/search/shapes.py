"""The nonlinear values of effects, settled together with all coefficients, and what not knowing them exactly costs.

A line search finds one value after the other while the rest stays, and ends near the least squares. Close to it the
outputs are linear in these values too.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.regression import CoefficientPrior, Fit, predicted, with_effects
from semiparam_ros.diagnosis.search.candidates import added_columns
from semiparam_ros.diagnosis.search.refit import (
    calibrations_moved,
    declare,
    objective,
    prior_of_steps,
    told_by_sliding,
)
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


def shape_columns(fit: Fit, shapes: list[Shape]) -> Array:
    """(N, n, len(shapes)) derivatives of the prediction by the values, at the fitted coefficients."""
    blocks, slopes = fit.assembly.blocks, []
    for number, name, low, high in shapes:
        effect, step = fit.effects[number], DIFFERENCE * (high - low)
        ahead, behind = (_columns(fit, effect.with_values(**{name: effect.value(name) + change}))
                         for change in (step, -step))
        slopes.append(predicted(ahead - behind, fit.theta[blocks[str(number)]]) / (2.0 * step))
    return np.stack(slopes, axis=2)


def settled(fit: Fit, found: Collection[int]) -> Fit:
    """The model with the nonlinear values of these effects and all calibrations at the least squares, by Gauss-Newton.

    One of them may pull against another, as the lead of frictions and a delay of the efforts do. Steps that do not
    lower the loss are shortened.
    """
    for _ in range(fit.config.newton_steps):
        shapes = shapes_of(fit, found)
        if not shapes:
            break
        calibrations = [effect for effect in fit.effects
                        if effect.is_calibration and not told_by_sliding(fit, effect)]
        slopes = [shape_columns(fit, shapes), *(added_columns(fit, effect) for effect in calibrations)]
        known = prior_of_steps(fit, calibrations)
        free = np.zeros(len(shapes))
        prior = CoefficientPrior(np.append(free, known.mean), np.append(free, known.precision))
        steps = fit.explain(np.concatenate(slopes, axis=2), prior).coefficients
        moved = next((moved for share in (1.0, fit.config.backtracking, fit.config.backtracking**2)
                      if objective(moved := _moved(fit, shapes, calibrations, share * steps)) < objective(fit)
                      and _possible(moved, found)), None)
        if moved is None:
            break
        gained, fit = objective(fit) - objective(moved), moved
        if gained < fit.config.settled_gain:
            break
    return declare(fit, [])


def _moved(fit: Fit, shapes: list[Shape], calibrations: list[Effect], steps: Array) -> Fit:
    """The model with its shapes and calibrations moved by steps (s + c,)."""
    effects = calibrations_moved(fit, calibrations, steps[len(shapes):])
    for (number, name, low, high), step in zip(shapes, steps.tolist(), strict=False):
        value = float(np.clip(effects[number].value(name) + step, low, high))
        effects[number] = effects[number].with_values(**{name: value})
    return with_effects(fit, effects)


def _columns(fit: Fit, effect: Effect) -> Array:
    return effect.columns(*fit.corrected, None)[0]


def _possible(fit: Fit, found: Collection[int]) -> bool:
    blocks = fit.assembly.blocks
    return all(fit.effects[number].possible and fit.effects[number].physical(fit.theta[blocks[str(number)]])
               for number in found if not fit.effects[number].is_calibration)
