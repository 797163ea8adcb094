"""Revises a model without adding a cause: its values at their best, plainer effects, and what is needless off."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import numpy as np

from semiparam_ros.diagnosis.named_change import Gain
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.search.candidates import Place, added_columns, fixed, held, identity, others
from semiparam_ros.diagnosis.search.plausibility import all_plausible, needed_errors, price, prices, usual
from semiparam_ros.diagnosis.search.refit import calibrated, declare, remaining, settled, told_by_sliding
from semiparam_ros.diagnosis.search.score import gain, gain_of_values, repetition, unlikely, worth
from semiparam_ros.diagnosis.search.scoring import coarse_trial, line_searched
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import Values


def bent(fit: Fit, places: Collection[Place]) -> Fit:
    """The model with the nonlinear values of the effects at some places at their best, beside all
    others, where that helps on unseen blocks.

    Values of a form that are left as they usually are open where that gains more than they are worth as guesses.
    """
    numbers = [number for number, effect in enumerate(fit.effects) if identity(effect) in places
               and not effect.is_calibration and (effect.searched or effect.finer() != effect)]
    if not numbers:
        return fit
    opened = [number for number in numbers if fit.effects[number].finer() != fit.effects[number]]
    tried = [(settled(fit, numbers), 0.0)]
    if opened:
        price_of_guesses = len(opened) * math.log(max(len(fit.considered), 1))
        tried.append((settled(_opened(fit, opened), numbers), price_of_guesses))
    options = [(fit.config.settled_gain, fit), *(
        (gain(fit, after).total - spent, after) for after, spent in tried
        if all_plausible(fit, after))]
    return max(options, key=lambda option: option[0])[1]


def _opened(fit: Fit, numbers: Collection[int]) -> Fit:
    """The model with the finer forms of the effects with these numbers, each new value where a line
    search finds it: from where it usually is, the slopes of a sharp form lead nowhere."""
    effects = list(fit.effects)
    for number in numbers:
        known, finer = fit.effects[number], fit.effects[number].finer()
        rest = with_effects(fit, others(fit, known))
        for name in sorted(finer.parameters.keys() - known.parameters.keys()):
            finer = line_searched(rest, finer, name)
        effects[number] = finer
    return with_effects(fit, effects)


def reshaped(fit: Fit, kept: Collection[Place]) -> Fit:
    """:func:`bent` of all effects but those that are ``kept``."""
    return bent(fit, {identity(effect) for effect in fit.effects}.difference(kept))


def with_common_forms(fit: Fit) -> Fit:
    """The model with one form for all places of a kind, but where the blocks of a place tell another one.

    A joint that was always fast tells nothing of how its friction turns over. Its own form would be chance, and wrong
    wherever the joint is slow.
    """
    found = [effect for effect in fit.effects if effect.group and effect.searched and not effect.span.values
             and identity(effect) not in fixed(fit)]
    for kind in dict.fromkeys(type(effect) for effect in found):
        alike = [effect for effect in found if type(effect) is kind]
        forms = [kind.searches(fit.body, fit.samples, effect.where, fit.residual) for effect in alike]
        if len(alike) < 2 or len({len(tried) for tried in forms}) > 1:
            continue
        common = int(np.sum([_losses(fit, effect, tried) for effect, tried in zip(alike, forms, strict=True)],
                            axis=0).argmin())
        for effect, tried in zip(alike, forms, strict=True):
            other = kind.from_values(effect.where, tried[common], effect.reference)
            if other != effect:
                after = with_effects(fit, [other if known is effect else known for known in fit.effects])
                fit = after if gain(after, fit).total < math.log(len(tried)) else fit
    return fit


def with_usual(fit: Fit) -> Fit:
    """The model with what joints commonly have in place of a rarer cause that no block tells from it.

    What half of the joints have has to lose by more than its odds: a joint that goes one way shows no offset from its
    dry friction. Other kinds that come in groups take its place where its values are far from what was known before:
    an offset of a lift makes up for a rotor that was taken for eight kilograms more of its link.
    """
    rare = [effect for effect in fit.effects if effect.where is not None and not effect.is_calibration
            and identity(effect) not in fixed(fit) and not usual(effect, others(fit, effect), fit)]
    for effect in rare:
        rest = with_effects(fit, others(fit, effect))
        for kind in fit.considered.values():
            if not kind.group or (kind.kind, effect.where) in held(rest.effects) \
                    or effect.where not in kind.places(fit.body):
                continue
            trial = coarse_trial(rest, kind, effect.where)
            if trial is not None:
                after = bent(declare(rest, [trial.effect]), [identity(trial.effect)])
                if _likelier_beforehand(rest, fit, effect, after, trial.effect) and all_plausible(fit, after):
                    after = pruned(after)
                    if (kind.kind, effect.where) in held(after.effects):  # else the rarer one would come again
                        return after
    return fit


def _likelier_beforehand(rest: Fit, fit: Fit, effect: Effect, after: Fit, other: Effect) -> bool:
    """Return whether the model ``after``, the rest with another effect, is likelier beforehand than that with the
    effect, by strong evidence, and no blocks outweigh that. Their densities, each given all the others, hardly hold the
    prior's."""
    dearer = prices([effect], rest) - prices([other], rest) + unlikely(fit) - unlikely(after)
    errors = fit.config.sure if usual(other, rest.effects, fit) else 0.0
    return dearer > math.log(fit.config.better_odds) and not gain(after, fit).exceeds(dearer, errors)


def _losses(fit: Fit, effect: Effect, forms: Sequence[Values]) -> list[float]:
    """Losses (f,) of the model with the effect in each of some forms."""
    rest = with_effects(fit, others(fit, effect))
    formed = (type(effect).from_values(effect.where, values, effect.reference) for values in forms)
    return [rest.explain(added_columns(rest, other)).loss for other in formed]


def formed_anew(fit: Fit) -> Fit:
    """The model with each effect that was found at the best of its coarse forms beside all the others."""
    after = fit
    for effect in fit.effects:
        if identity(effect) in fixed(fit) or effect.is_calibration or effect.span.values or not effect.searched:
            continue
        without = with_effects(after, others(after, effect))
        trial = coarse_trial(without, type(effect), effect.where)
        if trial is not None:
            other = with_effects(without, [*without.effects, trial.effect])
            after = other if other.loss < after.loss else after
    return after


def split(fit: Fit, places: Collection[Place]) -> Fit:
    """The model with the plainer effects of which some at these places are made up, unless blocks tell them apart."""
    for effect in fit.effects:
        plainer = list(effect.plainer()) if identity(effect) in places else []
        rest = with_effects(fit, others(fit, effect))
        if not plainer or held(plainer) & held(rest.effects):
            continue
        simpler = declare(rest, plainer)
        simpler = bent(simpler, [identity(part) for part in plainer])
        if not gain(simpler, fit).exceeds(prices([effect], rest), fit.config.sure):
            fit = simpler
    return fit


def revalued(fit: Fit) -> tuple[Fit, set[Place]]:
    """The model with other values of those calibrations whose declared ones are wrong, and which these are: with other
    values it leaves less by more than a cause of that kind costs, the most telling first."""
    moved = set[Place]()
    while True:
        tried = [(worth_more.total - cost, identity(effect), after) for effect in fit.effects
                 if effect.is_calibration and identity(effect) not in moved
                 for after, worth_more, cost in [_with_other_values(fit, effect)]
                 if worth_more.exceeds(cost, fit.config.sure) and all_plausible(fit, after)]
        if not tried:
            return fit, moved
        _, which, fit = max(tried, key=lambda each: each[0])
        moved.add(which)


def _with_other_values(fit: Fit, effect: Effect) -> tuple[Fit, Gain, float]:
    """The model with a calibration settled anew, what that gains, and what it costs: each value what a search among as
    many as the samples tell apart does (Schwarz 1978)."""
    after = calibrated(fit, [effect])
    before, there = (fit.sliding, after.sliding) if told_by_sliding(fit, effect) else (fit, after)
    independent = float((there.counts / repetition(there)).sum())
    cost = price(effect, others(fit, effect), fit) + 0.5 * len(effect.calibrations) * math.log(independent)
    return after, gain_of_values(before, there), cost


def other_forms(fit: Fit, after: Fit) -> tuple[Effect, ...]:
    """The declared effects that the second model holds with other nonlinear values, where that gains more than it would
    cost to add them."""
    changed = [effect for effect in after.effects if identity(effect) in fixed(fit) and effect not in fit.effects
               and not effect.is_calibration]
    cost = sum(price(effect, others(fit, effect), fit) for effect in changed)
    return tuple(changed) if changed and gain(fit, after).exceeds(cost, fit.config.sure) else ()


def pruned(fit: Fit, worth: Callable[[Fit], list[Gain]] = worth,
           known: Collection[Place] = ()) -> Fit:
    """The model without the effects that the others make needless, the weakest first; ``worth`` is that of each. Those
    that were declared stay, and those that are ``known``.

    Those that nothing speaks for go at once, but of two loads at one place one: each makes the other needless.
    """
    kept = fixed(fit).union(known)
    while True:
        weak = []
        for number, (effect, each) in enumerate(zip(fit.effects, worth(fit), strict=True)):
            rest = others(fit, effect)
            cost, errors = price(effect, rest, fit), needed_errors(effect, rest, fit)
            if identity(effect) not in kept and not each.exceeds(cost, errors):
                weak.append((each.total, number))
        if not weak:
            return fit
        worthless = {(fit.effects[number].kind, fit.effects[number].where): number
                     for total, number in sorted(weak, reverse=True) if total < 0.0}
        gone = set(worthless.values()) or {min(weak)[1]}
        fit = remaining(fit, [effect for number, effect in enumerate(fit.effects) if number not in gone])
