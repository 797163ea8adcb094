"""The nonlinear values of effects: close to the least squares the outputs are linear in them too."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.regression import Fit, predicted
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
    blocks, slopes = fit.assembly.blocks, [np.zeros((*fit.residual.shape, 0))]
    for number, name, low, high in shapes:
        effect, step = fit.effects[number], DIFFERENCE * (high - low)
        ahead, behind = (_columns(fit, effect.with_values(**{name: effect.value(name) + change}))
                         for change in (step, -step))
        slope = predicted(ahead - behind, fit.theta[blocks[str(number)]]) / (2.0 * step)
        slopes.append(slope[:, :, None])
    return np.concatenate(slopes, axis=2)


def _columns(fit: Fit, effect: Effect) -> Array:
    return effect.columns(*fit.corrected, None)[0]
