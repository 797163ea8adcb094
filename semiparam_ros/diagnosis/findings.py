"""Findings of a diagnosis for each effect: how large, how sure, and what else it could be."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.named_change import Quantity
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.search.candidates import identity
from semiparam_ros.diagnosis.search.score import worth
from semiparam_ros.diagnosis.search.stepwise import Rival, Step
from semiparam_ros.diagnosis.uncertainty import Estimates
from semiparam_ros.effects import Effect


@dataclass(frozen=True)
class Finding:
    """One effect found; rivals cannot be told from it on this motion.

    ``round_number`` counts from 1; 0 is that of an effect declared beforehand.
    """

    effect: Effect
    round_number: int
    log_evidence_gain: float
    parameters: dict[str, Quantity]
    rivals: tuple[Rival, ...]

    def as_dict(self) -> dict[str, object]:
        """The entry of ``effects`` in the machine-readable report."""
        return {'kind': self.effect.kind, 'where': self.effect.where, 'start_s': self.effect.start_s,
                'end_s': self.effect.end_s,
                'sentence': self.effect.sentence, 'log_evidence_gain': self.log_evidence_gain,
                'parameters': {name: vars(quantity) for name, quantity in self.parameters.items()},
                'indistinguishable_from': [
                    {'kind': rival.effect.kind, 'where': rival.effect.where, 'odds': rival.odds,
                     'separated_by': rival.effect.separated_by} for rival in self.rivals]}


def findings(fit: Fit, steps: list[Step], everything: Fit, told: Estimates) -> list[Finding]:
    """Every effect that a step added and the final model still holds, in that order, with what each is worth there.

    :param everything: the final model fitted to all samples, its effects in the same order.
    :param told: its values and their deviations.
    """
    gains = worth(fit)
    return [Finding(everything.effects[index], number, gains[index].total,
                    _parameters(everything, index, told), _still_rivals(everything.effects[index], steps[number - 1]))
            for index, number in places_in(fit, steps)]


def _still_rivals(effect: Effect, step: Step) -> tuple[Rival, ...]:
    """The rivals of the step that found an effect, without what that has become since: a load moves to another link."""
    return tuple(rival for rival in step.rivals
                 if (rival.effect.kind, rival.effect.where) != (effect.kind, effect.where))


def places_in(fit: Fit, steps: list[Step]) -> list[tuple[int, int]]:
    """Number and round of every effect that a step added and the model still holds."""
    found: dict[int, int] = {}
    for number, step in enumerate(steps, start=1):
        for effect in step.added:
            index = _index_in(fit, effect, found)
            if index is not None:
                found[index] = number
    return list(found.items())


def declared_findings(fit: Fit, found: list[Finding], told: Estimates) -> list[Finding]:
    """The effects of the model that were declared beforehand, with their fitted values and the deviations of these."""
    return [Finding(effect, 0, 0.0, _parameters(fit, index, told), ())
            for index, effect in enumerate(fit.effects) if effect not in [finding.effect for finding in found]]


def _index_in(fit: Fit, effect: Effect, taken: Collection[int]) -> int | None:
    """Index of the effect in the model now: at its place, or, as a load moves to the nearest link, with its times; None
    where it is there no longer, or taken."""
    same = [index for index, known in enumerate(fit.effects)
            if identity(replace(known, where=effect.where) if known.must_start else known) == identity(effect)]
    index = min(same, key=lambda number: fit.effects[number].where != effect.where, default=None)
    return None if index in taken else index


def _parameters(fit: Fit, index: int, told: Estimates) -> dict[str, Quantity]:
    effect, body = fit.effects[index], fit.body
    coefficients = quantities(effect.coefficients(body), told.coefficients[:, fit.assembly.blocks[str(index)]])
    calibrations = [(name, effect.unit_of(name, body)) for name, _ in effect.calibrations]
    searched = {name: Quantity(effect.value(name), None, effect.unit_of(name, body)) for name in effect.searched}
    return coefficients | quantities(calibrations, told.calibrations.get(index, np.zeros((2, 0)))) | searched


def quantities(named: Sequence[tuple[str, str]], told: Array) -> dict[str, Quantity]:
    """Quantities by name, from names and units, and values with their deviations (2, c)."""
    return {name: Quantity(value, std, unit)
            for (name, unit), (value, std) in zip(named, told.T.tolist(), strict=True)}
