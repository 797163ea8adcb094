"""Score of each candidate, by the residual it explains: coarse search, refinement, and a score that fears flexibility.

The score is a Schwarz (BIC) approximation of the log evidence with each channel's noise profiled out, and with as many
independent samples as the residual's autocorrelation leaves: a likelihood that takes samples for independent prefers
the effect with the most columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from semiparam_ros.core.robot.frames import links_beside, nearest_link
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.splits import correlation_times
from semiparam_ros.diagnosis.regression import Fit, reweighted, with_effects
from semiparam_ros.diagnosis.search.candidates import added_columns, explained_by, identity, not_held_by
from semiparam_ros.diagnosis.search.refit import gauss_newton
from semiparam_ros.diagnosis.search.spans import best_spans
from semiparam_ros.effects import Effect
from semiparam_ros.effects.application_point import POINT
from semiparam_ros.effects.base import ALWAYS, Values

Progress = Callable[[str, float], None]
POINT_DIFFERENCE = 1e-3
"""Difference of a point of application [m] that stands for a derivative."""


@dataclass(frozen=True, eq=False)
class Trial:
    """An effect tried on a declared model.

    :param n_parameters: parameters it spends.
    :param squares: (n,) sum of squares that it leaves of the samples in use.
    :param residual: computes the (N, n) that it leaves, for few are asked for; None once the round
        is over.
    """

    effect: Effect
    n_parameters: float
    squares: Array
    residual: Callable[[], Array] | None = None
    physical: bool = True  # the cause can have these coefficients
    evidence: float = 0.0  # [nat] over the declared model

    @property
    def many_valued(self) -> bool:
        """Return whether the best value of one nonlinear parameter depends on another; a coarse search tries few."""
        return len(self.effect.searched) > 1


def coarse_trial(fit: Fit, kind: type[Effect], where: str | None) -> Trial | None:
    """An effect at the best of its coarse values and starts; None when none is physical, or nothing
    was recorded that it depends on."""
    best: tuple[float, Effect, Array] | None = None
    known, fit = fit, beside(fit, kind(where))
    reference = next((known.reference for known in fit.effects if known.reference), tuple(fit.rigid_part.tolist()))
    tried = kind.searches(fit.body, fit.samples, where, fit.residual)
    for values in [*tried, *_as_replaced(known, fit, kind, tried)]:
        effect, columns = _started(fit, kind.from_values(where, values, reference))
        told = explained_by(fit, effect, columns)
        physical = effect.is_calibration or effect.physical(told.coefficients)
        if physical and (best is None or told.loss < best[0]):
            best = told.loss, effect, columns
    return None if best is None else _fitted(fit, *best[1:])


def _as_replaced(known: Fit, kept: Fit, kind: type[Effect], tried: Sequence[Values]) -> list[Values]:
    """The forms of what an effect takes the place of, where they hold all that its own tried forms do.

    They were bent to the samples. Beside such a form a coarse one loses more than the new cause gains.
    """
    replaced = [effect for effect in known.effects if effect not in kept.effects and effect.searched]
    return [dict(effect.parameters) for effect in replaced if effect.parameters.keys() <= kind.parameter_units.keys()
            and any(values.keys() <= effect.parameters.keys() for values in tried)]


def beside(fit: Fit, effect: Effect) -> Fit:
    """The model without what the effect would take the place of: what it adds to a plainer friction may have the
    wrong sign, though all of it resists."""
    kept = not_held_by(fit.effects, effect)
    return fit if len(kept) == len(fit.effects) else with_effects(fit, kept)


def _started(fit: Fit, effect: Effect) -> tuple[Effect, Array]:
    """The effect when it explains most, if it can begin or end or be in some recordings and its times are open, and its
    columns."""
    columns = added_columns(fit, effect)
    may_end = effect.changes or (fit.samples.breaks and not effect.of_one_recording)
    if may_end and not effect.is_calibration and effect.span == ALWAYS:
        effect = replace(effect, span=best_spans(fit, effect, columns, most=1)[0])
        columns = columns * effect.span.holds(fit.samples.stamps, fit.samples.origin)[:, None, None]
    return effect, columns


def _linear_trial(fit: Fit, effect: Effect) -> Trial:
    """The effect with its coefficients fitted, when it explains most, if it can begin or end."""
    return _fitted(fit, *_started(fit, effect))


def _fitted(fit: Fit, effect: Effect, columns: Array) -> Trial:
    explained, residual = explained_by(fit, effect, columns), partial(_left_by, fit, effect)
    if effect.is_calibration:
        names = [coefficient.name for coefficient in effect.calibrations]
        effect = effect.with_values(**dict(zip(names, explained.coefficients.tolist(), strict=True)))
    physical = effect.is_calibration or effect.physical(explained.coefficients)
    values = len(effect.searched) + len(effect.span.values)
    return Trial(effect, explained.rank + values, explained.squares, residual, physical)


def _left_by(fit: Fit, effect: Effect) -> Array:
    """(N, n) residual beside an effect, with the best coefficients."""
    return explained_by(fit, effect, added_columns(fit, effect)).residual


def squared_loss(fit: Fit, trial: Trial) -> float:
    """Sum of squares, in scaled units, that the trial leaves of the samples in use."""
    return float((trial.squares / fit.scale**2).sum())


def score(fit: Fit, trial: Trial, correlation: Array) -> Trial:
    """The trial with its evidence over the declared model; channel k is correlated over correlation[k] samples."""
    counts = fit.counts / correlation
    gain = 0.5 * float(counts @ np.log(fit.squares / trial.squares))
    return replace(trial, evidence=gain - 0.5 * trial.n_parameters * float(np.log(counts.sum())))


def refined(fit: Fit, trial: Trial) -> Trial:
    """The trial with its nonlinear parameters at their best and the weights those of its own residual."""
    fit = beside(fit, trial.effect)
    near = _weighed(fit, trial)
    if trial.effect.is_calibration:
        settled = gauss_newton(with_effects(near, [*fit.effects, trial.effect]), [trial.effect])
        left = settled.residual
        return replace(trial, effect=settled.effects[-1], residual=lambda: left, squares=settled.squares)
    best = _refined_once(near, trial)
    if trial.many_valued:
        best = _settled(fit, best)
    return _at_best_point(fit, best) if best.physical else trial


def _settled(fit: Fit, trial: Trial) -> Trial:
    """The trial with many nonlinear parameters, of which the best value of one depends on the others."""
    for number in range(fit.config.line_search_rounds):
        trial = _refined_once(_weighed(fit, trial), trial)
        if trial.physical and 2 * number >= fit.config.line_search_rounds:
            trial = _at_best_point(fit, trial)
    return trial


def _refined_once(fit: Fit, trial: Trial) -> Trial:
    """The trial with one nonlinear parameter after the other at its best, and at the best link of its body."""
    effect = trial.effect
    for name in effect.searched:
        if name not in POINT:
            effect = line_searched(fit, effect, name)
    best = _linear_trial(fit, effect.without_span())
    return best if effect.parameters.keys() & POINT.keys() else _at_best_link(fit, best)


def _weighed(fit: Fit, trial: Trial) -> Fit:
    """The declared model with the weights of what the trial leaves."""
    return reweighted(fit, fit.scale_of(trial.squares))


def _at_best_link(fit: Fit, trial: Trial) -> Trial:
    """The trial at whichever link of the same body explains most, where the kind moves the outputs there."""
    where = trial.effect.where
    if where is None or trial.effect.at_joint(fit.body) or not trial.effect.refine_link:
        return trial
    moved = [_linear_trial(fit, replace(trial.effect, where=link)) for link in links_beside(fit.body, where)[1:]]
    return min([trial, *moved], key=lambda tried: squared_loss(fit, tried))


def _at_best_point(fit: Fit, trial: Trial) -> Trial:
    """The trial at the point of its body that explains most, by Gauss-Newton, if that is worth the parameters."""
    if not POINT.keys() <= trial.effect.parameter_units.keys() or trial.effect.at_joint(fit.body):
        return trial
    best = trial
    for _ in range(fit.config.newton_steps):
        near = _weighed(fit, best)
        moved = _linear_trial(near, _towards_best_point(near, best.effect))
        if not moved.physical or squared_loss(near, moved) >= squared_loss(near, best):
            break
        best = moved
    correlation = correlation_of(fit, [best])
    return max([trial, best], key=lambda tried: score(fit, tried, correlation).evidence)


def _towards_best_point(fit: Fit, effect: Effect) -> Effect:
    """One step of the point of application, which is then given in the frame of the link nearest to it."""
    here = added_columns(fit, effect)
    coefficients = explained_by(fit, effect, here).coefficients
    place = {axis: effect.value(axis) for axis in POINT}
    moved = [effect.with_values(**{axis: value + POINT_DIFFERENCE}) for axis, value in place.items()]
    slopes = [(added_columns(fit, there) - here) @ (coefficients / POINT_DIFFERENCE) for there in moved]
    step = fit.explain(np.concatenate([here, np.stack(slopes, axis=2)], axis=2)).coefficients[-len(POINT):]
    step *= min(1.0, fit.config.longest_lever_m / (float(np.linalg.norm(step)) + 1e-300))
    link, inside = nearest_link(fit.body, str(effect.where), np.array(list(place.values())) + step)
    return replace(effect, where=link).with_values(**dict(zip(POINT, inside.tolist(), strict=True)))


def line_searched(fit: Fit, effect: Effect, name: str) -> Effect:
    """One nonlinear parameter at its best near its present value."""
    low, high = effect.bounds(name, fit.body, fit.samples, fit.residual)

    def cost(value: float) -> float:
        moved = effect.with_values(**{name: value})
        return explained_by(fit, moved, added_columns(fit, moved)).loss

    best = minimize_scalar(cost, bounds=(low, high), method='bounded',
                           options={'maxiter': fit.config.refine_evaluations})
    return effect.with_values(**{name: float(best.x)}) if best.fun < cost(effect.value(name)) else effect


def correlation_of(fit: Fit, trials: Sequence[Trial]) -> Array:
    """(n,) correlation time [samples] of each channel in what the trial that explains it best leaves of it."""
    best = np.array([trial.squares for trial in trials]).argmin(axis=0)
    left = [trials[index].residual for index in best.tolist()]
    columns = [fit.used(residual())[:, channel] for channel, residual in enumerate(left) if residual]
    return correlation_times(np.column_stack(columns), fit.config)


def overlap(fit: Fit, one: Array, other: Array) -> float:
    """Cosine between what two models explain that leave residuals (N, n): 1 when they explain the same, 0 when
    different things."""
    first, second = ((fit.used(fit.residual - left) / fit.scale).ravel() for left in (one, other))
    return float(first @ second / (np.linalg.norm(first) * np.linalg.norm(second) + 1e-300))


def coarse(fit: Fit, pool: Sequence[tuple[type[Effect], str | None]],
           report: Progress) -> list[Trial]:
    """Every candidate's best trial by evidence, coarse."""
    trials = []
    for number, (kind, where) in enumerate(pool):
        report(kind.kind, number / len(pool))
        trial = coarse_trial(fit, kind, where)
        if trial is not None and trial.n_parameters:
            trials.append(trial)
    return _by_evidence(fit, trials) if trials else []


def refine_foremost(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """The foremost trials refined, and the rest."""
    if not trials:
        return []
    chosen = worth_refining(fit, trials)
    best = [refined(fit, trial) for trial in chosen] + [trial for trial in trials if trial not in chosen]
    possible = [trial for trial in best if trial.effect.possible]
    return _by_evidence(fit, possible) if possible else []


def worth_refining(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """Candidates worth refining: the best, calibrations, which are linear only while small, and the best of each
    kind with many values, of which a coarse search tries few."""
    config, kept = fit.config, list[Trial]()
    for trial in trials:
        same = sum(other.many_valued and other.effect.kind == trial.effect.kind for other in kept)
        open_ended = trial.effect.is_calibration or (trial.many_valued and same < config.of_each_kind)
        if len(kept) < config.tried or (open_ended and trial.evidence > math.log(config.odds)):
            kept.append(trial)
    return kept


def _by_evidence(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """The best of each kind at each place; refinement may have led several to one place."""
    correlation = correlation_of(fit, trials)
    scored = sorted((score(fit, trial, correlation) for trial in trials), key=lambda trial: trial.evidence)
    best = {identity(trial.effect): trial for trial in scored}
    return sorted(best.values(), key=lambda trial: -trial.evidence)
