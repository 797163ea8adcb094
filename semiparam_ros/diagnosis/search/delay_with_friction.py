"""Efforts that come late, beside friction: two causes of which each hides the other.

Dry friction turns over when its joint does; in efforts that come late it seems to turn a little way after, as if every
joint had bristles that bend first. So a delay is tried beside frictions that turn over at once, whose nonlinear
parameters are then searched anew.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from semiparam_ros.diagnosis.data.splits import improves
from semiparam_ros.diagnosis.regression import Fit, refit_weights, with_effects
from semiparam_ros.diagnosis.search.candidates import Candidate, Place, others
from semiparam_ros.diagnosis.search.plausibility import without_impossible
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.scoring import Trial, coarse_trial, nonlinear, refined, score
from semiparam_ros.diagnosis.search.shapes import settled
from semiparam_ros.effects import Effect
from semiparam_ros.effects.geometry import TimeDelay

KIND = TimeDelay.kind
BRISTLE, TURN, LEAD = 'presliding', 'turn_speed', 'lead_s'


def delay_with_friction(fit: Fit, kinds: dict[str, type[Effect]],
                        declared: Collection[Place]) -> tuple[Trial, Fit] | None:
    """A delay and the model with it; None where friction's shape is not at stake, or the delay carries nothing over.

    :param declared: kinds and places that were in the model before the search and stay as they are.
    """
    known = any(effect.kind == KIND for effect in fit.effects)
    if KIND not in kinds or known or not _at_stake(fit, declared):
        return None
    after = declare(_turning_at_once(fit, declared), [kinds[KIND](None, {'delay_s': 0.0})])
    for _ in range(fit.config.delay_rounds):
        after = reshaped(after, declared)
    after = without_impossible(after, declared)
    delay = next(effect for effect in after.effects if effect.kind == KIND)
    trial = score(fit, Trial(delay, after.residual, 1), after.correlation)
    return (trial, after) if delay.is_noticeable(fit.samples) and improves(fit, after) else None


def reshaped(fit: Fit, declared: Collection[Place]) -> Fit:
    """The model with the shape of each friction that was found searched anew beside all the others.

    Calibrations are settled once, beside the shapes that are left.
    """
    before = fit
    for effect in _at_stake(fit, declared):
        without = with_effects(fit, others(fit, effect))
        trial = _other_shape(without, effect)
        if trial is None:
            continue
        other = refit_weights(with_effects(without, [*without.effects, refined(without, trial).effect]))
        other = without_impossible(other, declared)
        if _left(other, fit) < _left(fit, fit):
            fit = other
    return fit if fit is before else declare(fit, [])


def with_leads(fit: Fit, declared: Collection[Place]) -> Fit:
    """The model whose dry frictions turn over ahead of the recorded velocities or after them, if that helps.

    Their own form comes before any further cause, such as a delay of all that the efforts hold.
    """
    bare = [effect for effect in _at_stake(fit, declared)
            if TURN in effect.parameters and LEAD not in effect.parameters]
    if not bare:
        return fit
    leading = with_effects(fit, [effect.with_values(**{LEAD: 0.0}) if effect in bare else effect
                                 for effect in fit.effects])
    after = without_impossible(settled(leading, [
        index for index, effect in enumerate(leading.effects) if LEAD in effect.parameters]), declared)
    worth = score(fit, Trial(bare[0], after.residual, len(bare)), after.correlation).evidence
    return after if worth > fit.config.least_evidence and improves(fit, after) else fit


def _turning_at_once(fit: Fit, declared: Collection[Place]) -> Fit:
    """The model with frictions that depend on the velocity alone: bristles and leads take up a delay."""
    for effect in _at_stake(fit, declared):
        if LEAD in effect.parameters:
            rest = {name: value for name, value in effect.parameters.items() if name != LEAD}
            fit = with_effects(fit, [replace(known, parameters=rest) if known is effect else known
                                     for known in fit.effects])
        elif BRISTLE in effect.parameters:
            without = with_effects(fit, others(fit, effect))
            trial = _other_shape(without, effect, leave_out=BRISTLE)
            fit = fit if trial is None else with_effects(without, [*without.effects, trial.effect])
    return fit


def _other_shape(without: Fit, effect: Effect, leave_out: str = '') -> Trial | None:
    """The effect at the best of its coarse shapes, those with one nonlinear parameter left out."""
    searches = effect.searches(without.body, without.samples, effect.where, without.residual)
    shapes = tuple(dict(values) for values in searches if leave_out not in values)
    return coarse_trial(without, Candidate(type(effect), effect.where, shapes))


def _at_stake(fit: Fit, declared: Collection[Place]) -> list[Effect]:
    """Of efforts, effects at single joints whose shape the search has chosen."""
    if fit.body.outputs != 'effort':
        return []
    return [effect for effect in fit.effects if effect.where in fit.body.joints and not effect.is_calibration
            and nonlinear(effect) and (effect.kind, effect.where) not in declared]


def _left(fit: Fit, scale_of: Fit) -> float:
    return float((fit.squares / scale_of.scale**2).sum())
