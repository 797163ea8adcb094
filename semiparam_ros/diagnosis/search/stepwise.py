"""Search for the model of the best score: effects are added, all places of a kind at once, and taken off again."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.hyperparameters.window import residual_scale
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.regression import Fit, fit_model, refit_weights, with_effects
from semiparam_ros.diagnosis.search.candidates import Candidate, Place, candidates, held, identity
from semiparam_ros.diagnosis.search.plausibility import all_plausible, without_impossible
from semiparam_ros.diagnosis.search.refit import declare, moved_by
from semiparam_ros.diagnosis.search.score import Gain, block_gains, gain, worth
from semiparam_ros.diagnosis.search.scoring import Trial, coarse_trial, correlation_of, overlap, refined, score
from semiparam_ros.diagnosis.search.shapes import settled
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import place

Progress = Callable[[str, float], None]


class Rival(NamedTuple):
    """An effect that explains the same about as well; ``odds`` are against the one chosen."""

    kind: str
    where: str | None
    odds: float


@dataclass(frozen=True, kw_only=True)
class Step:
    """One round: the effects added, the rivals of each, the trials by evidence, and effects that it made needless."""

    added: tuple[Trial, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    ranking: tuple[Trial, ...]
    before: Fit
    after: Fit
    dropped: tuple[Effect, ...] = ()


class Move(NamedTuple):
    """A change of the model: the effects added, the model with them, what it gains, and what it costs."""

    added: tuple[Effect, ...]
    after: Fit
    gain: Gain
    price: float

    @property
    def net(self) -> float:
        """[nat] what it gains beyond its price."""
        return self.gain.total - self.price

    @property
    def good(self) -> bool:
        """Whether it may be made."""
        return self.net > 0.0 and self.gain.total > self.after.config.sure * self.gain.error


def starting_fit(body: RigidBody, samples: Samples, effects: Sequence[Effect], train_mask: Mask,
                 config: DiagnosisConfig = DEFAULTS, counted: Mask | None = None) -> Fit:
    """The declared model, each channel weighed by its own residual; ``counted`` as in :func:`fit_model`."""
    outputs = samples.outputs[train_mask]
    scale = residual_scale(outputs - outputs.mean(axis=0), outputs)
    fit = fit_model(body, samples, effects, train_mask, scale, config, counted)
    return refit_weights(refit_weights(fit))


def search(fit: Fit, kinds: dict[str, type[Effect]], progress: Progress = lambda words, share: None,
           hopeless: Callable[[Fit], bool] = lambda fit: False) -> list[Step]:
    """Change the model by the best move, until no move is good.

    :param hopeless: of a model with one more effect, whether to stop there.
    """
    fixed = {identity(effect) for effect in fit.effects}
    steps: list[Step] = []
    for _ in range(fit.config.most_rounds):
        late = bool(steps) and len(steps[-1].added) > 1  # what moves in time bends what was just found at many places
        step = _next_step(fit, kinds, fixed, late, _in_round(progress, len(steps) + 1))
        if step is None:
            if not steps:
                break
            shaped = reshaped(fit, fixed, kinds)
            shaped = shaped if shaped is fit else pruned(shaped, fixed, kinds)
            steps[-1] = replace(steps[-1], after=shaped)
            step = swapped(shaped, fixed, kinds)
            if step is None and shaped is fit:
                break
            fit = shaped
            if step is None:
                continue
        steps.append(_over(step))
        fit = step.after
        if hopeless(fit):
            break
    return steps


def price(effect: Effect, others: Sequence[Effect], fit: Fit, kinds: Collection[str]) -> float:
    """[nat] minus the log of an effect's prior probability beside others.

    Each kind is as unlikely as any other, at each of its places. One of a group, such as friction, that is at k of n
    places already is there too with probability (k + 1) / (n + 2) (Laplace's rule of succession). One of several forms
    is as likely as any other, and one that begins may do so at any time.
    """
    config, places = fit.config, max(len(effect.places(fit.body)), 1)
    same = sum(other.kind == effect.kind for other in others) if effect.group else 0
    choices = effect.choices(fit.body, fit.samples, effect.where) if effect.searched else 1
    starts = config.start_grid if effect.start_s is not None else 1
    odds = (places + 2) / (same + 1) if same else config.odds * places * max(len(kinds), 1)
    return math.log(choices * starts * odds)


def prices(added: Sequence[Effect], fit: Fit, kinds: Collection[str]) -> float:
    """[nat] the same of effects that come one after the other."""
    known = list(fit.effects)
    total = 0.0
    for effect in added:
        total += price(effect, known, fit, kinds)
        known.append(effect)
    return total


def _next_step(fit: Fit, kinds: dict[str, type[Effect]], fixed: Collection[Place], late: bool,
               report: Progress) -> Step | None:
    """The best move and what it makes needless.

    :param late: tries what moves all inputs beside other forms of what is known; as where nothing else is good.
    """
    trials = coarse(fit, list(candidates(fit, kinds)), report)
    ranking = _refined(fit, trials)
    moves = [*single_moves(fit, ranking, kinds), *group_moves(fit, trials, fixed, kinds)]
    if late or not any(move.good for move in moves):
        moves += moving_moves(fit, fixed, kinds)
    good = [move for move in moves if move.good]
    if not good:
        return None
    step = _made(fit, _simplest(good), moves, ranking, fixed, kinds)
    if step is not None:
        names = [place(trial.effect.kind, trial.effect.where) for trial in step.added]
        report(f'found {", ".join(names)}', 1.0)
    return step


def _made(fit: Fit, best: Move, moves: Sequence[Move], ranking: Sequence[Trial], fixed: Collection[Place],
          kinds: Collection[str]) -> Step | None:
    """The step that a move is, with what was added at its best and what it makes needless taken off."""
    added = [identity(effect) for effect in best.added]
    after = bent(best.after, added, kinds)
    after = pruned(split(after, added, kinds), fixed, kinds)
    before = {identity(effect) for effect in fit.effects}
    names = {identity(effect) for effect in after.effects}
    found = tuple(effect for effect in after.effects if identity(effect) not in before)
    if not found:
        return None
    alone = len(found) == 1 == len(best.added)
    rivals = _rivals(fit, best, moves) if alone else ()
    if alone:  # a load may have moved to the link nearest to its centre
        ranking = [replace(trial, effect=found[0]) if identity(trial.effect) == added[0] else trial
                   for trial in ranking]
    return Step(
        added=tuple(Trial(effect, after.residual, 1, evidence=best.gain.total / len(found)) for effect in found),
        rivals=(rivals,) * len(found), ranking=tuple(ranking), before=fit, after=after,
        dropped=tuple(effect for effect in fit.effects if identity(effect) not in names))


def coarse(fit: Fit, pool: Sequence[Candidate], report: Progress) -> list[Trial]:
    """Every candidate's best trial by evidence, coarse."""
    trials = []
    for number, candidate in enumerate(pool):
        report(candidate.kind.kind, number / len(pool))
        trial = coarse_trial(fit, candidate)
        if trial is not None and trial.n_parameters:
            trials.append(trial)
    return _by_evidence(fit, trials) if trials else []


def _refined(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """The foremost trials refined, and the rest."""
    if not trials:
        return []
    chosen = worth_refining(fit, trials)
    best = [refined(fit, trial) for trial in chosen] + [trial for trial in trials if trial not in chosen]
    noticeable = [trial for trial in best if trial.effect.is_noticeable(fit.samples) and trial.effect.possible]
    return _by_evidence(fit, noticeable) if noticeable else []


def worth_refining(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """Those worth refining: the best, calibrations (which are linear only while small), and the best of each kind with
    many values."""
    config = fit.config
    chosen = trials[:config.refined_candidates]
    chosen += [trial for trial in trials[config.refined_candidates:]
               if trial.effect.is_calibration and trial.evidence > config.least_evidence]
    for kind in {trial.effect.kind for trial in trials if trial.many_valued}:
        foremost = [trial for trial in trials if trial.many_valued and trial.effect.kind == kind][:config.swapped]
        chosen += [trial for trial in foremost if trial not in chosen and trial.evidence > config.least_evidence]
    return chosen


def single_moves(fit: Fit, ranking: Sequence[Trial], kinds: Collection[str]) -> list[Move]:
    """Each of the foremost trials by itself."""
    moves = []
    for trial in [trial for trial in ranking[:fit.config.tried] if trial.evidence > 0.0]:
        after = declare(fit, [trial.effect])
        if trial.many_valued:
            trial, after = _at_its_best(fit, trial, after, kinds)
        if all_plausible(fit, after):
            moves.append(Move((trial.effect,), after, gain(fit, after, trial.effect.start_s),
                              prices([trial.effect], fit, kinds)))
    return moves


def _at_its_best(fit: Fit, trial: Trial, after: Fit, kinds: Collection[str]) -> tuple[Trial, Fit]:
    """A trial of many nonlinear values and the model with it, searched one by one and all together in turn."""
    known = {identity(effect) for effect in fit.effects}
    for _ in range(fit.config.line_search_rounds):
        moved = bent(after, [identity(trial.effect)], kinds)
        own = [effect for effect in moved.effects if identity(effect) not in known]
        if moved is after or len(own) != 1:
            break
        trial = refined(fit, replace(trial, effect=own[0], leaves=moved.residual, squares=moved.squares))
        other = declare(fit, [trial.effect])
        after = max(moved, other, key=lambda model: gain(fit, model).total)
        if after is moved:
            trial = replace(trial, effect=own[0])
            break
    return trial, after


def group_moves(fit: Fit, trials: Sequence[Trial], fixed: Collection[Place], kinds: Collection[str]) -> list[Move]:
    """Kinds at all their places at once: what one joint lacks bends the rigid body's fit of the others."""
    groups: dict[str, list[Effect]] = {}
    for trial in trials:
        if trial.effect.group and trial.effect.start_s is None:
            groups.setdefault(trial.effect.group, []).append(trial.effect)
    known, moves = {identity(effect) for effect in fit.effects}, []
    order = [(kind, where) for kind in kinds for where in fit.body.joints]
    for effects in groups.values():
        effects.sort(key=lambda effect: order.index((effect.kind, str(effect.where))))
        if len(effects) > 1:
            after = without_impossible(declare(fit, effects), fixed)
            after = reshaped(after, known, kinds) if any(effect.searched for effect in effects) else after
            after = pruned(after, {*fixed, *known}, kinds)
            added = tuple(effect for effect in after.effects if identity(effect) not in known)
            if added:
                moves.append(Move(added, after, gain(fit, after), prices(added, fit, kinds)))
    return moves


def moving_moves(fit: Fit, fixed: Collection[Place], kinds: dict[str, type[Effect]]) -> list[Move]:
    """Calibrations that move what the effects depend on, each with all forms of these searched anew beside it.

    Efforts that come late make dry friction seem to bend before it slides: each of the two hides the other.
    """
    formed = [effect for effect in fit.effects if effect.searched and not effect.is_calibration]
    known, moves = {effect.kind for effect in fit.effects}, []
    for kind in kinds.values():
        if formed and kind.moves_friction and kind.kind not in known and None in kind.places(fit.body):
            nothing = kind(None, {coefficient.name: 0.0 for coefficient in kind.calibrations})
            spread = nothing.calibration_scale(fit.body)
            starts = [moved_by(nothing, share * spread) for share in fit.config.moved]
            tried = [formed_anew(with_effects(fit, [*fit.effects, start]), fixed) for start in starts]
            after = declare(min(tried, key=lambda model: model.loss), [])
            after = reshaped(without_impossible(after, fixed), fixed, kinds)
            added = next(effect for effect in after.effects if effect.kind == kind.kind)
            if added.is_noticeable(fit.samples) and all_plausible(fit, after):
                moves.append(Move((added,), after, gain(fit, after), prices([added], fit, kinds)))
    return moves


def _simplest(moves: Sequence[Move]) -> Move:
    """Of the moves that no block tells from the best one, that of the fewest values."""
    best = max(moves, key=lambda move: move.net)
    alike = [move for move in moves if len(move.added) == 1 == len(best.added)
             and (move is best or _alike(move, best))]
    return min(alike, key=lambda move: (_spent(move), -move.net)) if alike else best


def _alike(one: Move, other: Move) -> bool:
    difference = gain(one.after, other.after)
    return difference.total < difference.error


def _spent(move: Move) -> int:
    return sum(_values(effect, move.after) for effect in move.after.effects)


def _values(effect: Effect, fit: Fit) -> int:
    return len(effect.coefficients(fit.body)) + len(effect.searched) + len(effect.calibrations)


def bent(fit: Fit, places: Collection[Place], kinds: Collection[str]) -> Fit:
    """The model with the nonlinear values of the effects at some places at their best, beside all others.

    Values of a form that are left as they usually are open where that gains more than they are worth as guesses.
    """
    numbers = [number for number, effect in enumerate(fit.effects) if identity(effect) in places
               and not effect.is_calibration and (effect.searched or effect.finer() != effect)]
    if not numbers:
        return fit
    finer = [effect.finer() if number in numbers else effect for number, effect in enumerate(fit.effects)]
    opened = sum(one != other for one, other in zip(finer, fit.effects, strict=True))
    plain, open_ = (settled(with_effects(fit, effects), numbers) for effects in (fit.effects, finer))
    options = [(0.0, fit)]
    options += [(gain(fit, after).total - spent, after)
                for after, spent in ((plain, 0.0), (open_, opened * math.log(max(len(kinds), 1))))
                if all_plausible(fit, after)]
    return max(options, key=lambda option: option[0])[1]


def reshaped(fit: Fit, fixed: Collection[Place], kinds: Collection[str]) -> Fit:
    """The model with the nonlinear values of each effect that was found searched anew beside all the others, where that
    helps on unseen blocks."""
    after = formed_anew(fit, fixed)
    after = declare(after, []) if after is not fit else fit
    after = bent(after, [identity(effect) for effect in after.effects
                         if identity(effect) not in fixed], kinds)
    better = after is not fit and all_plausible(fit, after) and gain(fit, after).total > fit.config.settled_gain
    return after if better else fit


def formed_anew(fit: Fit, fixed: Collection[Place]) -> Fit:
    """The model with each effect that was found at the best of its coarse forms beside all the others."""
    after = fit
    for effect in fit.effects:
        searches = tuple(dict(values) for values in effect.searches(
            fit.body, fit.samples, effect.where, fit.residual))
        if identity(effect) in fixed or effect.is_calibration or len(searches) < 2 \
                or effect.start.values or not effect.searched:
            continue
        without = with_effects(after, [known for known in after.effects
                                       if identity(known) != identity(effect)])
        trial = coarse_trial(without, Candidate(type(effect), effect.where, searches))
        if trial is not None:
            other = with_effects(without, [*without.effects, trial.effect])
            after = other if other.loss < after.loss else after
    return after


def swapped(fit: Fit, fixed: Collection[Place], kinds: dict[str, type[Effect]]) -> Step | None:
    """The step to one of the effects that were found at another place, or of a kind that is mistaken for it, where that
    is better."""
    for effect in fit.effects:
        if identity(effect) in fixed or usual(effect, fit):
            continue
        rest = declare(with_effects(fit, [known for known in fit.effects if known is not effect]), [])
        names = {effect.kind, *effect.mistaken_for}
        pool = [candidate for candidate in candidates(rest, {name: kinds[name] for name in names if name in kinds})
                if (candidate.kind.kind, candidate.where) != (effect.kind, effect.where)]
        own = score(rest, Trial(effect, fit.residual, _values(effect, fit)), fit.correlation).evidence
        trials = [trial for trial in coarse(rest, pool, lambda words, share: None)
                  if trial.evidence > fit.config.worth_swapping * own]
        ranking = _refined(rest, trials[:fit.config.swapped])
        cost = prices([effect], rest, kinds)
        moves = [move._replace(gain=gain(fit, move.after, move.added[0].start_s), price=move.price - cost)
                 for move in single_moves(rest, ranking, kinds)]
        best = max((move for move in moves if move.good), key=lambda move: move.net, default=None)
        step = None if best is None else _made(fit, best, moves, ranking, fixed, kinds)
        if step is not None:
            return step
    return None


def usual(effect: Effect, fit: Fit) -> bool:
    """Whether the model holds a kind of a group at half of its other places or more."""
    others = sum(known.kind == effect.kind for known in fit.effects if known is not effect)
    return bool(effect.group) and 2 * others >= max(len(effect.places(fit.body)) - 1, 1)


def split(fit: Fit, places: Collection[Place], kinds: Collection[str]) -> Fit:
    """The model with the plainer effects of which some at these places are made up, unless blocks tell them apart."""
    for effect in fit.effects:
        plainer = list(effect.plainer()) if identity(effect) in places else []
        rest = with_effects(fit, [known for known in fit.effects if known is not effect])
        if not plainer or held(plainer) & held(rest.effects):
            continue
        simpler = declare(rest, plainer)
        simpler = bent(simpler, [identity(part) for part in plainer], kinds)
        whole = Move((effect,), fit, gain(simpler, fit), prices([effect], rest, kinds))
        if not whole.good:
            fit = simpler
    return fit


def pruned(fit: Fit, fixed: Collection[Place], kinds: Collection[str]) -> Fit:
    """The model without the effects that the others make needless, the weakest first."""
    while True:
        weak = []
        for number, (effect, each) in enumerate(zip(fit.effects, worth(fit), strict=True)):
            others = [known for known in fit.effects if known is not effect]
            cost = price(effect, others, fit, kinds)
            sure = 1.0 if usual(effect, fit) else fit.config.sure
            if identity(effect) not in fixed and each.total < max(cost, sure * each.error):
                weak.append((each.total, number))
        if not weak:
            return fit
        gone = {number for total, number in weak if total < 0.0} or {min(weak)[1]}
        kept = [effect for number, effect in enumerate(fit.effects) if number not in gone]
        fit = declare(with_effects(fit, kept), [])


def _rivals(fit: Fit, chosen: Move, moves: Sequence[Move]) -> tuple[Rival, ...]:
    """Those as good as the chosen move, with odds from a bootstrap of the blocks."""
    generator, found, draws = np.random.default_rng(0), [], fit.config.bootstrap_draws
    ours = Trial(chosen.added[0], chosen.after.residual, 1)
    for move in moves:
        known = {identity(effect) for effect in chosen.added}
        if len(move.added) > 1 or identity(move.added[0]) in known:
            continue
        if overlap(fit, ours, Trial(move.added[0], move.after.residual, 1)) < fit.config.rival_overlap:
            continue
        gains = block_gains(chosen.after, move.after)
        drawn = gains[generator.integers(len(gains), size=(draws, len(gains)))].sum(axis=1)
        better = min(int((drawn > 0.0).sum()), draws - 1)
        if better > 1:
            found.append(Rival(move.added[0].kind, move.added[0].where, better / (draws - better)))
    return tuple(found)


def _over(step: Step) -> Step:
    """The step without what only its own round needed, which is far larger than the rest where samples are many."""
    step.before.forget()
    return replace(step, added=tuple(trial.without_residual() for trial in step.added),
                   ranking=tuple(trial.without_residual() for trial in step.ranking))


def _in_round(progress: Progress, number: int) -> Progress:
    def report(words: str, share: float) -> None:
        progress(f'round {number}: {words}', share)
    return report


def _by_evidence(fit: Fit, trials: list[Trial]) -> list[Trial]:
    """The best of each kind at each place; refinement may have led several to one place."""
    correlation = correlation_of(fit, trials)
    scored = sorted((score(fit, trial, correlation) for trial in trials), key=lambda trial: trial.evidence)
    best = {identity(trial.effect): trial for trial in scored}
    return sorted(best.values(), key=lambda trial: -trial.evidence)
