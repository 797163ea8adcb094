"""Stepwise search: rank the candidates, add the best, refit, and repeat until nothing significant is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from semiparam_ros.core.hyperparameters.window import residual_scale
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.splits import improves, unseen_score
from semiparam_ros.diagnosis.regression import Fit, fit_model, refit_weights, with_effects
from semiparam_ros.diagnosis.search.ambiguity import Rival, rivals_of, simplest, tolerance
from semiparam_ros.diagnosis.search.candidates import Place, candidates, held, others
from semiparam_ros.diagnosis.search.delay_with_friction import KIND as DELAY
from semiparam_ros.diagnosis.search.delay_with_friction import delay_with_friction, reshaped, with_leads
from semiparam_ros.diagnosis.search.elimination import without_needless, worth_at_once
from semiparam_ros.diagnosis.search.friction_everywhere import friction_of_all, friction_where_it_helps
from semiparam_ros.diagnosis.search.joint_offsets import joint_offsets
from semiparam_ros.diagnosis.search.plausibility import all_plausible
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.scoring import Trial, coarse_trial, correlation_of, refined, retried, score
from semiparam_ros.diagnosis.search.shapes import settled
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import place

Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True)
class Step:
    """One round: the effects added, the rivals of each, the trials by evidence, and effects that it made needless."""

    added: tuple[Trial, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    ranking: tuple[Trial, ...]
    before: Fit
    after: Fit
    dropped: tuple[Effect, ...] = ()


def starting_fit(body: RigidBody, samples: Samples, effects: Sequence[Effect], train_mask: Mask,
                 config: DiagnosisConfig = DEFAULTS, counted: Mask | None = None) -> Fit:
    """The declared model, each channel weighed by its own residual; ``counted`` as in :func:`fit_model`."""
    outputs = samples.outputs[train_mask]
    scale = residual_scale(outputs - outputs.mean(axis=0), outputs)
    fit = fit_model(body, samples, effects, train_mask, scale, config, counted)
    return refit_weights(refit_weights(fit))


def search(fit: Fit, kinds: dict[str, type[Effect]], progress: Progress = lambda words, share: None,
           hopeless: Callable[[Fit], bool] = lambda fit: False) -> list[Step]:
    """Add effects to the declared model until none is significant, then drop those that others made needless.

    :param hopeless: of a model with one more effect, whether to stop there.
    """
    declared = {(effect.kind, effect.where) for effect in fit.effects}
    stays = set(declared)
    steps: list[Step] = []
    while len(steps) < fit.config.most_rounds:
        report = _in_round(progress, len(steps) + 1)
        step = None
        if not steps:
            report('friction of all joints', 0.0)
            step = _friction_step(fit, friction_of_all(fit, kinds, declared))
            stays |= {(trial.effect.kind, trial.effect.where) for trial in step.added} if step else set()
        elif len(steps) == 1 and stays != declared:  # late efforts bend what was just found of every joint
            step = _delay_step(fit, kinds, declared)
        step = step or next_step(fit, kinds, report)
        if step is None:
            report('delay beside friction', 1.0)
            if steps:
                fit = with_leads(fit, declared)
                steps[-1] = replace(steps[-1], after=fit)
            step = _delay_step(fit, kinds, declared)
        elif any(trial.effect.kind == DELAY for trial in step.added):
            step = replace(step, after=with_leads(reshaped(step.after, declared), declared))
        if step is None and stays == declared:
            report('friction where it helps', 1.0)
            step = _friction_step(fit, friction_where_it_helps(fit, kinds, declared))
        if step is None:
            break
        steps.append(_over(step))
        report('found ' + ', '.join(place(trial.effect.kind, trial.effect.where) for trial in step.added), 1.0)
        fit = step.after
        if hopeless(fit):
            break
    if steps:
        after, dropped = without_needless(fit, stays)
        steps[-1] = replace(steps[-1], after=after, dropped=dropped)
    return steps


def _over(step: Step) -> Step:
    """The step without what only its own round needed, which is far larger than the rest where samples are many."""
    step.before.forget()
    return replace(step, added=tuple(trial.without_residual() for trial in step.added),
                   ranking=tuple(trial.without_residual() for trial in step.ranking))


def _delay_step(fit: Fit, kinds: dict[str, type[Effect]], declared: set[Place]) -> Step | None:
    found = delay_with_friction(fit, kinds, declared)
    if found is None or found[0].evidence < fit.config.least_evidence:
        return None
    trial, after = found
    return Step(added=(trial,), rivals=((),), ranking=(trial,), before=fit, after=after)


def _friction_step(fit: Fit, after: Fit | None) -> Step | None:
    """The step to a model with friction of many joints, if there is one."""
    if after is None:
        return None
    known = {(effect.kind, effect.where) for effect in fit.effects}
    added = [effect for effect in after.effects if (effect.kind, effect.where) not in known]
    kept = {(effect.kind, effect.where) for effect in after.effects}
    gone = tuple(effect for effect in fit.effects if (effect.kind, effect.where) not in kept)
    worth = worth_at_once(after)
    trials = tuple(Trial(effect, after.residual, len(added), evidence=float(worth[after.effects.index(effect)]))
                   for effect in added)
    return Step(added=trials, rivals=((),) * len(trials), ranking=trials, before=fit, after=after, dropped=gone)


def _in_round(progress: Progress, number: int) -> Progress:
    def report(words: str, share: float) -> None:
        progress(f'round {number}: {words}', share)
    return report


def ranked(fit: Fit, kinds: dict[str, type[Effect]], progress: Progress) -> list[Trial]:
    """Every candidate's best trial by evidence, the foremost refined."""
    trials = []
    pool = list(candidates(fit, kinds))
    for number, candidate in enumerate(pool):
        progress(candidate.kind.kind, number / len(pool))
        trial = coarse_trial(fit, candidate)
        if trial is not None and trial.n_parameters:
            trials.append(trial)
    if not trials:
        return []
    trials = _by_evidence(fit, trials)
    chosen = worth_refining(fit, trials)
    rest = [trial for trial in trials if trial not in chosen]
    best = [refined(fit, trial) for trial in chosen] + rest
    noticeable = [trial for trial in best if trial.effect.is_noticeable(fit.samples) and trial.effect.possible]
    return _by_evidence(fit, noticeable) if noticeable else []


def worth_refining(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """Those worth refining: the best, calibrations (which are linear only while small), the best of each kind with many
    values, and of efforts each joint's."""
    config = fit.config
    chosen = trials[:config.refined_candidates]
    chosen += [trial for trial in trials[config.refined_candidates:]
               if trial.effect.is_calibration and trial.evidence > config.least_evidence]
    best_of_kind: dict[str, Trial] = {}
    for trial in trials:
        if trial.many_valued:
            best_of_kind.setdefault(trial.effect.kind, trial)
    chosen += [trial for trial in best_of_kind.values()
               if trial not in chosen and trial.evidence > config.least_evidence]
    for joint in fit.body.output_names if fit.body.outputs == 'effort' else ():
        at_joint = [trial for trial in trials if trial.effect.where == joint]
        chosen += [trial for trial in at_joint[:config.refined_at_joint]
                   if trial not in chosen and trial.evidence > 0.0]
    return chosen


def _by_evidence(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """The best of each kind at each place; refinement may have led several to one place."""
    correlation = correlation_of(fit, trials)
    scored = sorted((score(fit, trial, correlation) for trial in trials), key=lambda trial: trial.evidence)
    best = {(trial.effect.kind, trial.effect.where): trial for trial in scored}
    return sorted(best.values(), key=lambda trial: -trial.evidence)


def next_step(fit: Fit, kinds: dict[str, type[Effect]], progress: Progress) -> Step | None:
    """The most credible effect (of efforts: the most credible of each joint), or None when nothing is left."""
    ranking = [trial for trial in ranked(fit, kinds, progress) if trial.evidence > fit.config.least_evidence]
    if not ranking:
        return None
    found, after = joint_offsets(fit, kinds, ranking) or ([], fit)
    if len(found) > 1 and all_plausible(fit, after) and improves(fit, after) \
            and found[0].evidence > ranking[0].evidence + tolerance(fit, found[0]):
        return Step(added=tuple(found), rivals=((),) * len(found), ranking=tuple(ranking), before=fit, after=after)
    first, after, ranking = _first_that_helps(fit, ranking, list(kinds))
    if first is None:
        return None
    chosen, first_tried = [first], [first]
    for at_joint in _other_joints(fit, first, ranking):
        for trial in at_joint[:fit.config.tries_at_joint]:
            again = retried(after, trial)
            if again.physical and again.evidence > max(fit.config.least_evidence,
                                                       fit.config.kept_share * trial.evidence):
                further = declare(after, [again.effect])
                if all_plausible(after, further) and improves(after, further):
                    chosen, after = [*chosen, again], further
                    first_tried.append(trial)
                    break
    rivals = [rivals_of(fit, trial, ranking) for trial in first_tried]
    for trial, those in list(zip(chosen, rivals, strict=True)):
        parts, simpler = in_parts(after, trial)
        if parts and unseen_score(simpler) < unseen_score(fit):
            at = chosen.index(trial)
            names = {(part.effect.kind, part.effect.where) for part in parts}
            those = tuple(rival for rival in those if (rival.kind, rival.where) not in names)
            chosen[at:at + 1], rivals[at:at + 1], after = parts, [those] * len(parts), simpler
    return Step(added=tuple(chosen), rivals=tuple(rivals), ranking=tuple(ranking), before=fit, after=after)


def _first_that_helps(fit: Fit, ranking: list[Trial], order: Sequence[str]) -> tuple[Trial | None, Fit, list[Trial]]:
    """The most credible trial whose model helps on unseen blocks, that model, and the ranking without those before it.

    One that does not carry over says nothing of the next.
    """
    for _ in range(min(len(ranking), fit.config.most_tries)):
        first = simplest(fit, ranking, order)
        after = declare(fit, [first.effect])
        if all_plausible(fit, after) and improves(fit, after):
            return first, _own_form_settled(after, first.effect), ranking
        ranking = [trial for trial in ranking if trial is not first]
    return None, fit, ranking


def _own_form_settled(fit: Fit, effect: Effect) -> Fit:
    """The model with all nonlinear values of the effect just added at their best, where that helps on unseen blocks.

    What they leave, others would take up.
    """
    if not effect.searched or effect.is_calibration:
        return fit
    numbers = [number for number, known in enumerate(fit.effects) if known.kind == effect.kind
               and known.searched == effect.searched and known.start == effect.start][-1:]
    finer = [known.finer() if number in numbers else known for number, known in enumerate(fit.effects)]
    after = settled(with_effects(fit, finer), numbers)
    return after if unseen_score(after) < unseen_score(fit) else fit


def in_parts(fit: Fit, trial: Trial) -> tuple[list[Trial], Fit]:
    """Plainer effects in place of one that the model holds, where they explain about as much; else none."""
    effect = trial.effect
    plainer = list(effect.plainer())
    without = with_effects(fit, others(fit, effect))
    if not plainer or held(plainer) & held(without.effects):
        return [], fit
    simpler = declare(without, plainer)
    saved = trial.n_parameters - len(plainer) - 1
    whole, parts = (score(without, Trial(effect, known.residual, n_parameters), fit.correlation)
                    for known, n_parameters in ((fit, trial.n_parameters), (simpler, trial.n_parameters - saved)))
    if whole.evidence - parts.evidence > tolerance(without, whole):
        return [], fit
    return [replace(trial, effect=part, leaves=simpler.residual, squares=None) for part in plainer], simpler


def _other_joints(fit: Fit, first: Trial, ranking: list[Trial]) -> list[list[Trial]]:
    """The trials of every joint but the first one's, best first, where all act on the efforts of single joints.

    Each has a channel of its own, so one round can take them all; but what one joint lacks also bends the rigid
    body's fit of the others, so each must show again what it is worth once the first is declared.
    """
    joints = fit.body.output_names
    if fit.body.outputs != 'effort' or first.effect.where not in joints:
        return []
    at: dict[str | None, list[Trial]] = {}
    for trial in ranking:
        at.setdefault(trial.effect.where, []).append(trial)
    return [trials for where, trials in at.items() if where in joints and where != first.effect.where
            and not trials[0].effect.is_calibration]
