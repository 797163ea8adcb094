"""Values that are told and their standard deviations: of coefficients and calibrations, nothing else known.

*Where joints slide.* At a turn, and while a joint is slow, the form of its friction decides what its effort is, and no
form is exact: what a wrong one leaves there bends the friction, and the inertias beside it, the same way in every
stretch. So the same model is fitted where joints slide, too (:attr:`Fit.sliding`). It has fewer outputs, so where the
form is right it knows less; where it knows more, its values are told, but for what acts in none of its samples.

*How much stretches contradict one another.* The model's own covariance takes the law of every effect for exact and the
noise for what is left on average. Where a law fits less well in one stretch than in another, where noise grows with the
motion, or where errors of an acceleration reach several outputs at once, the stretches contradict one another by more
than that. How much they do is the sandwich covariance of clustered samples (Liang and Zeger 1986, Biometrika 73), with
stretches of time as clusters. The larger of the two is told: with few stretches the sandwich itself is uncertain, and
one stretch may hold all that tells of a value.

*What acts in a joint of which the efforts are read with a gain* is told as it is, not as they read it, and is as unsure
as the gain besides.

*What no sample shows*, as the zero of a last joint that turned inertias explain, is as unsure as it was beforehand.

*Errors of a smoothed motion* do the same in every stretch: they make an inertia too small and a spring too stiff by up
to a deviation. The same errors put on the smoothed motion once more shift the values by about as much again. So that
shift is taken off the values (simulation extrapolation; Cook and Stefanski 1994, Journal of the American Statistical
Association 89), and counted as a deviation too.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.search.candidates import added_columns
from semiparam_ros.diagnosis.search.refit import Shape, calibrated_values, moved_by, shape_columns, shapes_of
from semiparam_ros.effects import Effect
from semiparam_ros.effects.drive import gains
from semiparam_ros.effects.friction import JointEffect

GAIN_STEP = 1e-6
"""Half the difference of gains that stands for a derivative."""


class Estimates(NamedTuple):
    """Values with their standard deviations: (2, p) of the coefficients theta, (2, c) of calibrations by the number of
    their effect."""

    coefficients: Array
    calibrations: dict[int, Array]


def estimates(fit: Fit, found: Collection[int], disturbed: Sequence[Samples] = ()) -> Estimates:
    """Estimates of a fitted model, where its calibrations and the nonlinear values of the effects with the numbers
    ``found`` are open too.

    :param disturbed: the samples with the errors of their motion once more.
    """
    whole = _estimates(fit, found, disturbed)
    if fit.body.outputs != 'effort':
        return whole
    sliding = _estimates(fit.sliding, found, disturbed)
    if np.log(whole.coefficients[1] + 1e-300).mean() <= np.log(sliding.coefficients[1] + 1e-300).mean():
        return whole
    acts = np.zeros(fit.n_columns, dtype=bool)
    for support, rows in zip(fit.sliding.design.support, fit.sliding.design.rows, strict=True):
        acts[support] |= rows.any(axis=0)
    return sliding._replace(coefficients=np.where(acts, sliding.coefficients, whole.coefficients))


def _estimates(fit: Fit, found: Collection[int], disturbed: Sequence[Samples]) -> Estimates:
    calibrated = [number for number, effect in enumerate(fit.effects) if effect.is_calibration]
    shapes = shapes_of(fit, found)
    further = _further(fit, calibrated, shapes)
    columns = np.concatenate(further, axis=2)
    edges = len(fit.theta) + np.cumsum([0, *(part.shape[2] for part in further)])
    parts = {number: slice(start, end) for number, start, end in zip(calibrated, edges, edges[1:], strict=False)}
    told, values = np.eye(edges[-1]), np.append(fit.theta, np.zeros(edges[-1] - edges[0]))
    read = _read(fit, fit.effects)
    values[:edges[0]] /= read
    told[:edges[0], :edges[0]] /= read
    for number, part in parts.items():
        values[part] = calibrated_values(fit.effects[number])
        told[:edges[0], part] = -(values[:edges[0]] / read)[:, None] * _slopes(fit, number)
        if not fit.knows_mass:
            told[part, part] = _without_common_gain(fit.effects[number])
    deviation = _deviations(fit, columns, told)
    for number, part in parts.items():
        unseen = [not fit.explain(columns[:, :, [column - len(fit.theta)]]).rank for column in range(edges[-1])[part]]
        deviation[part][unseen] = fit.effects[number].calibration_scale(fit.body)[unseen]
    if disturbed:
        shift = told @ np.mean([_shift(fit, samples, calibrated, shapes) for samples in disturbed], axis=0)
        values, deviation = values - shift, np.hypot(deviation, shift)
    both = np.stack([values, deviation])
    return Estimates(both[:, :edges[0]], {number: both[:, part] for number, part in parts.items()})


def _read(fit: Fit, effects: Sequence[Effect]) -> Array:
    """(p,) factor by which the efforts read each coefficient of theta: the gain of its joint, of what acts in one."""
    of_joint, read = gains(effects, fit.body), np.ones(fit.n_columns)
    for number, effect in enumerate(effects):
        if isinstance(effect, JointEffect):
            read[fit.assembly.blocks[str(number)]] = of_joint[str(effect.where)]
    return read


def _slopes(fit: Fit, number: int) -> Array:
    """(p, c) derivatives of these factors by the calibrations of one effect."""
    def moved(step: Array) -> Array:
        effects = list(fit.effects)
        effects[number] = moved_by(effects[number], step)
        return _read(fit, effects)

    return _differences(moved, len(fit.effects[number].calibrations))


def _differences(moved: Callable[[Array], Array], count: int) -> Array:
    """(k, count) central differences of a function (k,) by each of its numbers, where all of them are zero."""
    steps = GAIN_STEP * np.eye(count)
    return np.column_stack([(moved(step) - moved(-step)) / (2.0 * GAIN_STEP) for step in steps])


def _without_common_gain(effect: Effect) -> Array:
    """(c, c) derivative of the calibrations that are told, see :meth:`Effect.without_common_gain`, by the fitted
    ones."""
    def moved(step: Array) -> Array:
        return calibrated_values(moved_by(effect, step).without_common_gain())

    return _differences(moved, len(effect.calibrations))


def _further(fit: Fit, calibrated: Sequence[int], shapes: list[Shape]) -> list[Array]:
    """(N, n, c) each, the derivatives of the prediction by the calibrations of the effects with these numbers, and by
    the shapes."""
    return [*(added_columns(fit, fit.effects[number]) for number in calibrated), shape_columns(fit, shapes)]


def _rows(fit: Fit, columns: Array) -> Iterator[tuple[int, Indices, Indices, Array]]:
    """Each channel, its samples in use (M,), the columns of theta and further ones (N, n, c) that
    act there (a,), and these over the channel's scale (M, a)."""
    further = fit.n_columns + np.arange(columns.shape[2])
    for channel, (used, support, rows) in enumerate(zip(
            fit.samples_in_use.numbers, fit.design.support, fit.design.rows, strict=True)):
        weighed = np.hstack([rows, columns[used, channel]]) / fit.scale[channel]
        yield channel, used, np.append(support, further), weighed


def _deviations(fit: Fit, columns: Array, told: Array) -> Array:
    """(p + c,) standard deviations of theta and of the coefficients of further columns (N, n, c), or of what is linear
    in them by ``told`` (p + c, p + c)."""
    covariance = fit.covariance_with(columns)
    stretches = np.array_split(np.flatnonzero(fit.train_mask), fit.config.blocks)
    repeated, scores = np.zeros_like(covariance), np.zeros((len(stretches), len(covariance)))
    for channel, used, acting, weighed in _rows(fit, columns):
        repeated[np.ix_(acting, acting)] += (fit.correlation[channel] - 1.0) * (weighed.T @ weighed)
        weighed *= fit.residual[used, channel, None] / fit.scale[channel]
        ends = np.searchsorted(used, [stretch[-1] for stretch in stretches], side='right')
        sums = np.vstack([np.zeros(len(acting)), np.cumsum(weighed, axis=0)])  # a channel may begin late
        scores[:, acting] += np.diff(sums[[0, *ends]], axis=0)
    changes, repeated = scores @ covariance @ told.T, covariance + covariance @ repeated @ covariance
    clustered = (changes**2).sum(axis=0) * len(stretches) / (len(stretches) - 1)
    return np.asarray(np.sqrt(np.maximum(np.diag(told @ repeated @ told.T), clustered)))


def _shift(fit: Fit, disturbed: Samples, calibrated: Sequence[int], shapes: list[Shape]) -> Array:
    """(p + c,) by which a fit on the disturbed samples would miss what the fit predicts on its own."""
    there = replace(fit, samples=disturbed)
    columns = np.concatenate(_further(there, calibrated, shapes), axis=2)
    missed = (fit.samples.outputs - fit.residual - there.design.predicted(fit.theta)) / fit.scale
    moments = np.zeros(there.n_columns + columns.shape[2])
    for channel, used, acting, weighed in _rows(there, columns):
        moments[acting] += weighed.T @ missed[used, channel]
    return there.covariance_with(columns) @ moments
