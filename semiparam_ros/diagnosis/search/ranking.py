"""Candidates by evidence: all of them coarse, the foremost refined."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.search.candidates import Candidate, identity
from semiparam_ros.diagnosis.search.scoring import Trial, coarse_trial, correlation_of, refined, score

Progress = Callable[[str, float], None]


def coarse(fit: Fit, pool: Sequence[Candidate], report: Progress) -> list[Trial]:
    """Every candidate's best trial by evidence, coarse."""
    trials = []
    for number, candidate in enumerate(pool):
        report(candidate.kind.kind, number / len(pool))
        trial = coarse_trial(fit, candidate)
        if trial is not None and trial.n_parameters:
            trials.append(trial)
    return _by_evidence(fit, trials) if trials else []


def refine_foremost(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """The foremost trials refined, and the rest."""
    if not trials:
        return []
    chosen = worth_refining(fit, trials)
    best = [refined(fit, trial) for trial in chosen] + [trial for trial in trials if trial not in chosen]
    noticeable = [trial for trial in best if trial.effect.is_noticeable(fit.samples) and trial.effect.possible]
    return _by_evidence(fit, noticeable) if noticeable else []


def worth_refining(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """Those worth refining: the best, calibrations, which are linear only while small, and the best of each kind with
    many values, of which a coarse search tries few."""
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
