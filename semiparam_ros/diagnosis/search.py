"""Find what the model lacks: rank the candidates, add the best, refit, repeat until nothing significant is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Mask
from semiparam_ros.diagnosis.candidates import candidates, others
from semiparam_ros.diagnosis.cross_validation import carries_over
from semiparam_ros.diagnosis.declaration import declare
from semiparam_ros.diagnosis.delayed_friction import KIND as DELAY
from semiparam_ros.diagnosis.delayed_friction import delayed_friction, reshaped
from semiparam_ros.diagnosis.elimination import without_needless
from semiparam_ros.diagnosis.encoder_zeros import encoder_zeros
from semiparam_ros.diagnosis.noise import correlation_times
from semiparam_ros.diagnosis.ranking import (
    Trial,
    coarse_trial,
    correlation_of,
    refined,
    retried,
    score,
)
from semiparam_ros.diagnosis.regression import Fit, fit, refit_weights, residual_scale
from semiparam_ros.diagnosis.rivals import Rival, rivals_of, simplest, tolerance
from semiparam_ros.effects import Effect

REFINED = 8
REFINED_AT_JOINT = 3
LEAST_EVIDENCE = 12.0
KEPT_SHARE = 0.5
MOST_ROUNDS = 12
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Step:
    """One round: the effects added, the rivals of each, the trials by evidence, and effects that it made needless."""

    added: tuple[Trial, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    ranking: tuple[Trial, ...]
    before: Fit
    after: Fit
    dropped: tuple[Effect, ...] = ()


def starting_fit(body: RigidBody, samples: Samples, effects: Sequence[Effect], use: Mask) -> Fit:
    """The declared model, each channel weighed by its own residual."""
    outputs = samples.outputs[use]
    state = fit(body, samples, effects, use, residual_scale(outputs - outputs.mean(axis=0), outputs))
    return refit_weights(refit_weights(state))


def search(state: Fit, kinds: dict[str, type[Effect]], progress: Progress = lambda words, share: None,
           hopeless: Callable[[Fit], bool] = lambda state: False) -> list[Step]:
    """Add effects to the declared model until none is significant, then drop those that others made needless.

    :param hopeless: of a model with one more effect, whether to stop there.
    """
    declared = {(effect.kind, effect.where) for effect in state.effects}
    steps: list[Step] = []
    while len(steps) < MOST_ROUNDS:
        report = _in_round(progress, len(steps) + 1)
        step = next_step(state, kinds, report)
        if step is None:
            report('delay beside friction', 1.0)
            step = _delay_step(state, kinds, declared)
        elif any(trial.effect.kind == DELAY for trial in step.added):
            step = replace(step, after=reshaped(step.after, declared))
        if step is None:
            break
        steps.append(step)
        state = step.after
        if hopeless(state):
            break
    if steps:
        after, dropped = without_needless(state, declared, LEAST_EVIDENCE)
        steps[-1] = replace(steps[-1], after=after, dropped=dropped)
    return steps


def _delay_step(state: Fit, kinds: dict[str, type[Effect]], declared: set[tuple[str, str | None]]) -> Step | None:
    found = delayed_friction(state, kinds, declared)
    if found is None or found[0].evidence < LEAST_EVIDENCE:
        return None
    trial, after = found
    return Step((trial,), ((),), (trial,), state, after)


def _in_round(progress: Progress, number: int) -> Progress:
    def report(words: str, share: float) -> None:
        progress(f'round {number}: {words}', share)
    return report


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
    chosen = worth_refining(state, trials)
    rest = [trial for trial in trials if trial not in chosen]
    best = [refined(state, trial) for trial in chosen] + rest
    noticeable = [trial for trial in best if trial.effect.is_noticeable(state.samples)]
    return _by_evidence(state, noticeable) if noticeable else []


def worth_refining(state: Fit, trials: list[Trial]) -> list[Trial]:
    """Those worth refining: the best, calibrations (which are linear only while small), and of efforts each joint's."""
    chosen = trials[:REFINED]
    chosen += [trial for trial in trials[REFINED:] if trial.effect.is_calibration and trial.evidence > LEAST_EVIDENCE]
    for joint in state.body.joints if state.body.outputs == 'effort' else ():
        at_joint = [trial for trial in trials if trial.effect.where == joint]
        chosen += [trial for trial in at_joint[:REFINED_AT_JOINT] if trial not in chosen and trial.evidence > 0.0]
    return chosen


def _by_evidence(state: Fit, trials: list[Trial]) -> list[Trial]:
    """The best of each kind at each place; refinement may have led several to one place."""
    correlation = correlation_of(state, trials)
    scored = sorted((score(state, trial, correlation) for trial in trials), key=lambda trial: trial.evidence)
    best = {(trial.effect.kind, trial.effect.where): trial for trial in scored}
    return sorted(best.values(), key=lambda trial: -trial.evidence)


def next_step(state: Fit, kinds: dict[str, type[Effect]], progress: Progress) -> Step | None:
    """The most credible effect (of efforts: the most credible of each joint), or None when nothing is left."""
    ranking = ranked(state, kinds, progress)
    if not ranking or ranking[0].evidence < LEAST_EVIDENCE:
        return None
    zeros = encoder_zeros(state, kinds, ranking, LEAST_EVIDENCE)
    if zeros is not None and len(zeros[0]) > 1 and carries_over(state, zeros[1]) \
            and zeros[0][0].evidence > ranking[0].evidence + tolerance(state, zeros[0][0]):
        return Step(tuple(zeros[0]), ((),) * len(zeros[0]), tuple(ranking), state, zeros[1])
    chosen = [simplest(state, ranking, list(kinds))]
    first_tried = list(chosen)
    after = declare(state, [chosen[0].effect])
    if not carries_over(state, after):
        return None
    for trial in _other_joints(state, chosen[0], ranking):
        again = retried(after, trial)
        if again.physical and again.evidence > max(LEAST_EVIDENCE, KEPT_SHARE * trial.evidence):
            further = declare(after, [again.effect])
            if carries_over(after, further):
                chosen, after = [*chosen, again], further
                first_tried.append(trial)
    rivals = [rivals_of(state, trial, ranking) for trial in first_tried]
    for trial, those in list(zip(chosen, rivals, strict=True)):
        parts, simpler = in_parts(after, trial)
        if parts:
            at = chosen.index(trial)
            names = {(part.effect.kind, part.effect.where) for part in parts}
            those = tuple(rival for rival in those if (rival.kind, rival.where) not in names)
            chosen[at:at + 1], rivals[at:at + 1], after = parts, [those] * len(parts), simpler
    return Step(tuple(chosen), tuple(rivals), tuple(ranking), state, after)


def in_parts(state: Fit, trial: Trial) -> tuple[list[Trial], Fit]:
    """Plainer effects in place of one that the model holds, where they explain about as much; else none."""
    effect = trial.effect
    plainer = list(effect.plainer())
    if not plainer or any((part.kind, part.where) in {(e.kind, e.where) for e in state.effects} for part in plainer):
        return [], state
    without = fit(state.body, state.samples, others(state, effect), state.use, state.scale)
    simpler = declare(without, plainer)
    saved = trial.free - len(plainer) - 1
    whole, parts = (score(without, Trial(effect, known.residual, free), correlation_times(state.residual[state.use]))
                    for known, free in ((state, trial.free), (simpler, trial.free - saved)))
    if whole.evidence - parts.evidence > tolerance(without, whole, same_form=True):
        return [], state
    return [replace(trial, effect=part, residual=simpler.residual) for part in plainer], simpler


def _other_joints(state: Fit, first: Trial, ranking: list[Trial]) -> list[Trial]:
    """The best trial of every joint but the first one's, where all act on the efforts of single joints.

    Each has a channel of its own, so one round can take them all; but what one joint lacks also bends the rigid
    body's fit of the others, so each must show again what it is worth once the first is declared.
    """
    joints = state.body.joints
    if state.body.outputs != 'effort' or first.effect.where not in joints:
        return []
    best: dict[str | None, Trial] = {}
    for trial in ranking:
        best.setdefault(trial.effect.where, trial)
    return [trial for where, trial in best.items() if where in joints and where != first.effect.where
            and not trial.effect.is_calibration]
