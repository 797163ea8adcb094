"""The tables of a diagnosis: errors of each output and round, what was found, and what else it could be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.diagnose import Diagnosis
from semiparam_ros.diagnosis.findings import Finding
from semiparam_ros.diagnosis.judgement import BOOTSTRAP_BLOCK, BOOTSTRAP_DRAWS, CONFIDENCE, Judgement
from semiparam_ros.diagnosis.words import place
from semiparam_ros.effects import kinds

MOST_ODDS = 1000


class OutputRow(NamedTuple):
    """One output: its errors before and after with their 95 % intervals, and the noise floor."""

    name: str
    unit: str
    nmse: tuple[float, float]
    nmse_interval: tuple[float, float]
    rmse: tuple[float, float]
    rmse_interval: tuple[float, float]
    floor: float


class RoundRow(NamedTuple):
    """One round: what it added, and the held-out error that was left with its interval."""

    number: int
    added: str
    nmse: float
    low: float
    high: float


class Parameter(NamedTuple):
    """A fitted number as text; ``std`` is empty where it was searched."""

    name: str
    value: str
    std: str
    unit: str


class Alternative(NamedTuple):
    """Another cause that would explain the same, and its odds against the one that was added."""

    name: str
    odds: str
    separated_by: str


class Cause(NamedTuple):
    """One finding for reading."""

    name: str
    since: str
    evidence: float
    parameters: list[Parameter]
    alternatives: list[Alternative]
    separated_by: str


def output_rows(diagnosis: Diagnosis) -> list[OutputRow]:
    """One row for each output."""
    body, before, after = diagnosis.first.body, diagnosis.before, diagnosis.after
    bounds, variance = square_intervals(after), np.maximum(after.outputs.var(axis=0), 1e-300)
    rows = []
    for index, (name, unit) in enumerate(zip(body.output_names, body.output_units, strict=True)):
        low, high = bounds[index]
        rows.append(OutputRow(
            name, unit, (before.nmse[index], after.nmse[index]), (low / variance[index], high / variance[index]),
            (before.rmse[index], after.rmse[index]), (float(np.sqrt(low)), float(np.sqrt(high))),
            diagnosis.noise_floor_rmse[index]))
    return rows


def square_intervals(judgement: Judgement) -> Array:
    """(n, 2) 95 % interval of each output's mean squared error, from a bootstrap of contiguous blocks."""
    count = max(len(judgement.residual) // BOOTSTRAP_BLOCK, 1)
    means = np.array([block.mean(axis=0) for block in np.array_split(judgement.residual**2, count)])
    draws = np.random.default_rng(0).integers(count, size=(BOOTSTRAP_DRAWS, count))
    return np.asarray(np.percentile(means[draws].mean(axis=1), CONFIDENCE, axis=0).T)


def relative_floor(diagnosis: Diagnosis) -> Array:
    """(n,) squared noise floor over the variance of each output."""
    return np.asarray(diagnosis.noise_floor_rmse**2 / np.maximum(diagnosis.after.outputs.var(axis=0), 1e-300))


def round_rows(diagnosis: Diagnosis) -> list[RoundRow]:
    """The declared model, and then every round."""
    named = [', '.join(place(trial.effect.kind, trial.effect.where) for trial in step.added)
             for step in diagnosis.steps]
    judged = [diagnosis.before, *diagnosis.judged_by_step]
    return [RoundRow(number, added, float(judgement.nmse.mean()), *judgement.interval())
            for number, (added, judgement) in enumerate(zip(['as declared', *named], judged, strict=True))]


def causes(diagnosis: Diagnosis) -> list[Cause]:
    """Every finding with its numbers and its rivals."""
    return [_cause(finding) for finding in diagnosis.findings]


def _cause(finding: Finding) -> Cause:
    effect = finding.effect
    since = 'from the beginning' if effect.start_s is None else f'since {effect.start_s:.1f} s'
    parameters = [Parameter(name, f'{quantity.value:.4g}', '' if quantity.std is None else f'{quantity.std:.2g}',
                            quantity.unit.replace('^2', '²')) for name, quantity in finding.parameters.items()]
    alternatives = [Alternative(place(rival.kind, rival.where), odds_text(rival.odds),
                                kinds()[rival.kind].separated_by) for rival in finding.rivals]
    return Cause(place(effect.kind, effect.where), since, finding.log_evidence_gain, parameters,
                 alternatives, effect.separated_by)


def odds_text(odds: float) -> str:
    """Odds as people say them: ``1 : 20``."""
    ratio = max(odds, 1.0 / odds)
    if ratio > MOST_ODDS:
        return f'over {MOST_ODDS} : 1' if odds > 1.0 else f'under 1 : {MOST_ODDS}'
    number = f'{ratio:.1f}' if ratio < 9.95 else f'{ratio:.0f}'
    return f'{number} : 1' if odds >= 1.0 else f'1 : {number}'


def variant_rows(variants: Mapping[str, Any]) -> list[tuple[str, float, float, str]]:
    """Variant, mean held-out error without the effects and with them, and in how many draws of features it fell."""
    rows = []
    for name, entry in variants.items():
        pairs = list(zip(entry['draws']['before'], entry['draws']['after'], strict=True))
        lower = f' (lower in {sum(after < before for before, after in pairs)} of {len(pairs)} draws)' \
            if len(pairs) > 1 else ''
        rows.append((name, entry['before']['nmse_mean'], entry['after']['nmse_mean'], lower))
    return rows
