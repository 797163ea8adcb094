"""Backward elimination: drops effects that only stood in for later ones."""

from __future__ import annotations

from semiparam_ros.diagnosis.data.splits import carries_over
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.scoring import Trial, nonlinear, score
from semiparam_ros.effects import Effect

Place = tuple[str, str | None]


def without_needless(fit: Fit, declared: set[Place]) -> tuple[Fit, tuple[Effect, ...]]:
    """The model without the effects that the others make needless, and the effects dropped.

    Drops the effect of least evidence over the model without it, then asks about the others again. Keeps a last one.

    :param declared: kinds and places that were in the model before the search and stay.
    """
    dropped: list[Effect] = []
    while True:
        found = [effect for effect in fit.effects if (effect.kind, effect.where) not in declared]
        if len(found) < 2:
            break
        asked = [(effect, *_worth(fit, effect)) for effect in found]
        weakest, evidence, rest = min(asked, key=lambda answer: answer[1])
        if evidence > fit.config.least_evidence and carries_over(rest, fit):
            break
        dropped.append(weakest)
        fit = rest
    return fit, tuple(dropped)


def _worth(fit: Fit, effect: Effect) -> tuple[float, Fit]:
    """Evidence [nat] of an effect over the model without it, and that model."""
    others = [known for known in fit.effects if known is not effect]
    spent = len(effect.coefficients(fit.body)) + len(effect.calibrations) + nonlinear(effect)
    whole = Trial(effect, fit.residual, spent)
    rest = with_effects(fit, others)
    if score(rest, whole, fit.correlation).evidence < fit.config.undoubted_factor * fit.config.least_evidence:
        rest = declare(rest, [])  # the other calibrations may make up for it
    return score(rest, whole, fit.correlation).evidence, rest
