"""Backward elimination: drops effects that only stood in for later ones."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.splits import carries_over, unseen_score
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.search.candidates import Place
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.scoring import Trial, nonlinear, score
from semiparam_ros.effects import Effect


def without_needless(fit: Fit, declared: Collection[Place]) -> tuple[Fit, tuple[Effect, ...]]:
    """The model without the effects that the others make needless, and the effects dropped.

    Drops the effect of least evidence over the model without it, then asks about the others again. Keeps a last one.

    :param declared: kinds and places that were in the model before the search and stay.
    """
    dropped: list[Effect] = []
    while True:
        found = [effect for effect in fit.effects if (effect.kind, effect.where) not in declared]
        if len(found) < 2:
            break
        doubtful = _doubtful(fit, found)
        needless = []
        for effect in doubtful:
            evidence, rest = _worth(fit, effect)
            if _needless(fit, rest, evidence):
                needless.append((evidence, effect, rest))
            rest.forget()
        if not needless:
            break
        _, weakest, rest = min(needless, key=lambda answer: answer[0])
        dropped.append(weakest)
        fit = rest
    return fit, tuple(dropped)


def _needless(fit: Fit, rest: Fit, evidence: float) -> bool:
    """Whether the model without an effect may stand for the model with it: the score of all rounds must hardly fall."""
    if evidence > fit.config.least_evidence and carries_over(rest, fit):
        return False
    return unseen_score(rest) < unseen_score(fit) + fit.config.needless_score


def _doubtful(fit: Fit, found: list[Effect]) -> list[Effect]:
    """Those of the effects found that may be needless, at least one: to ask about each costs a fit."""
    worth = worth_at_once(fit)
    order = sorted(found, key=lambda effect: worth[fit.effects.index(effect)])
    bound = fit.config.clear_factor * fit.config.least_evidence
    return [effect for effect in order if worth[fit.effects.index(effect)] < bound] or order[:1]


def worth_at_once(fit: Fit) -> Array:
    """(effects,) evidence [nat] of each effect from its coefficients over their covariance (Wald); -inf where that
    does not tell, as of calibrations."""
    covariance = fit.theta_covariance()
    blocks = fit.assembly.blocks
    correlation, count = float(fit.correlation.mean()), float((fit.counts / fit.correlation).sum())
    worth = np.full(len(fit.effects), -np.inf)
    for index, effect in enumerate(fit.effects):
        part = blocks[str(index)]
        if not effect.is_calibration and part.stop > part.start:
            theta = fit.theta[part]
            power = float(theta @ np.linalg.lstsq(covariance[part, part], theta, rcond=1e-12)[0])
            spent = part.stop - part.start + nonlinear(effect)
            worth[index] = 0.5 * power / correlation - 0.5 * spent * np.log(count)
    return worth


def _worth(fit: Fit, effect: Effect) -> tuple[float, Fit]:
    """Evidence [nat] of an effect over the model without it, and that model."""
    others = [known for known in fit.effects if known is not effect]
    spent = len(effect.coefficients(fit.body)) + len(effect.calibrations) + nonlinear(effect)
    whole = Trial(effect, fit.residual, spent)
    rest = with_effects(fit, others)
    if score(rest, whole, fit.correlation).evidence < fit.config.undoubted_factor * fit.config.least_evidence:
        rest = declare(rest, [])  # the other calibrations may make up for it
    return score(rest, whole, fit.correlation).evidence, rest
