"""Find what the model lacks: rank the candidates, add the best, refit, repeat until nothing significant is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.candidates import candidates
from semiparam_ros.diagnosis.cross_validation import carries_over
from semiparam_ros.diagnosis.ranking import (
    Trial,
    coarse_trial,
    correlation_of,
    declare,
    overlap,
    refined,
    score,
)
from semiparam_ros.diagnosis.regression import Fit, fit, refit_weights, residual_scale
from semiparam_ros.effects import Effect

REFINED = 8
LEAST_EVIDENCE = 12.0
RIVAL_NATS = 6.0
RIVAL_SHARE = 0.02
RIVAL_OVERLAP = 0.7
MOST_ROUNDS = 12
Progress = Callable[[str, float], None]


class Rival(NamedTuple):
    """An effect that explains the same about as well; ``odds`` are against the one chosen."""

    kind: str
    where: str | None
    odds: float


@dataclass(frozen=True)
class Step:
    """One round: the effects added, the rivals of each, and the trials of the round by evidence."""

    added: tuple[Trial, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    ranking: tuple[Trial, ...]
    before: Fit
    after: Fit


def starting_fit(body: RigidBody, samples: Samples, effects: Sequence[Effect], use: Array) -> Fit:
    """The declared model, each channel weighed by its own residual."""
    outputs = samples.outputs[use]
    state = fit(body, samples, effects, use, residual_scale(outputs - outputs.mean(axis=0), outputs))
    return refit_weights(refit_weights(state))


def search(state: Fit, kinds: dict[str, type[Effect]], progress: Progress = lambda words, share: None) -> list[Step]:
    """Add effects to the declared model until none is significant."""
    steps: list[Step] = []
    for round_number in range(MOST_ROUNDS):
        step = next_step(state, kinds, lambda words, share, n=round_number: progress(f'round {n + 1}: {words}', share))
        if step is None:
            break
        steps.append(step)
        state = step.after
    return steps


def ranked(state: Fit, kinds: dict[str, type[Effect]], progress: Progress) -> list[Trial]:
    """Every candidate's best trial by evidence, the foremost refined."""
    trials = []
    pool = list(candidates(state, kinds))
    for number, candidate in enumerate(pool):
        progress(candidate.kind.kind, number / len(pool))
        trial = coarse_trial(state, candidate)
        if trial is not None and trial.free:
            trials.append(trial)
    if not trials:
        return []
    trials = _by_evidence(state, trials)
    foremost = [refined(state, trial) for trial in trials[:REFINED]]
    return _by_evidence(state, foremost + trials[REFINED:])


def _by_evidence(state: Fit, trials: list[Trial]) -> list[Trial]:
    correlation = correlation_of(state, trials)
    return sorted((score(state, trial, correlation) for trial in trials), key=lambda trial: -trial.evidence)


def next_step(state: Fit, kinds: dict[str, type[Effect]], progress: Progress) -> Step | None:
    """The most credible effect (of efforts: the most credible of each joint), or None when nothing is left."""
    ranking = ranked(state, kinds, progress)
    chosen = _one_for_each_joint(state, ranking) if state.body.outputs == 'effort' else ranking[:1]
    chosen = [trial for trial in chosen if trial.evidence > LEAST_EVIDENCE]
    if not chosen:
        return None
    after = declare(state, [trial.effect for trial in chosen])
    if not carries_over(state, after):
        chosen = chosen[:1]
        after = declare(state, [chosen[0].effect])
        if not carries_over(state, after):
            return None
    rivals = tuple(rivals_of(state, trial, ranking) for trial in chosen)
    return Step(tuple(chosen), rivals, tuple(ranking), state, after)


def _one_for_each_joint(state: Fit, ranking: list[Trial]) -> list[Trial]:
    """The best trial, and with it the best of every other joint, as long as they act on single joints."""
    joints = state.body.joints
    if not ranking or ranking[0].effect.where not in joints:
        return ranking[:1]
    best: dict[str | None, Trial] = {}
    for trial in ranking:
        best.setdefault(trial.effect.where, trial)
    return [trial for trial in best.values() if trial.effect.where in joints and not trial.effect.is_calibration]


def rivals_of(state: Fit, chosen: Trial, ranking: Sequence[Trial]) -> tuple[Rival, ...]:
    """The trials that explain the same thing about as well as the chosen one."""
    tolerance = max(RIVAL_NATS, RIVAL_SHARE * chosen.evidence)
    close = [trial for trial in ranking if trial is not chosen and chosen.evidence - trial.evidence < tolerance
             and overlap(state, chosen, trial) > RIVAL_OVERLAP]
    return tuple(Rival(trial.effect.kind, trial.effect.where, float(np.exp(min(trial.evidence - chosen.evidence, 0.0))))
                 for trial in close)
