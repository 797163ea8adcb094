"""Search for the model of the best score: the best move is made, until none is good."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.hyperparameters.window import residual_scale
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.regression import Fit, fit_model, refit_weights
from semiparam_ros.diagnosis.search.candidates import candidates, fixed, identity
from semiparam_ros.diagnosis.search.moves import (
    Move,
    ending_moves,
    group_moves,
    hidden_moves,
    moving_moves,
    repeated_moves,
    simplest,
    single_moves,
    swapping_moves,
)
from semiparam_ros.diagnosis.search.revision import (
    bent,
    other_forms,
    pruned,
    reshaped,
    revalued,
    split,
    with_common_forms,
    with_usual,
)
from semiparam_ros.diagnosis.search.score import block_gains, gain
from semiparam_ros.diagnosis.search.scoring import Progress, Trial, coarse, overlap, refine_foremost
from semiparam_ros.diagnosis.search.spans import without_divided
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import place


class Rival(NamedTuple):
    """An effect that explains the same about as well; ``odds`` are against the one chosen."""

    effect: Effect
    odds: float


@dataclass(frozen=True, kw_only=True)
class Step:
    """One round: the effects added, the rivals of a single one, the trials by evidence, and effects
    that it made needless."""

    added: tuple[Effect, ...]
    rivals: tuple[Rival, ...]
    ranking: tuple[Trial, ...]
    before: Fit
    after: Fit
    dropped: tuple[Effect, ...] = ()


def starting_fit(body: RigidBody, samples: Samples, effects: Sequence[Effect], train_mask: Mask,
                 config: DiagnosisConfig = DEFAULTS, counted: Mask | None = None,
                 considered: Mapping[str, type[Effect]] | None = None) -> Fit:
    """The declared model, each channel weighed by its own residual; the rest as in :func:`fit_model`."""
    outputs = samples.outputs[train_mask]
    scale = residual_scale(outputs - outputs.mean(axis=0), outputs)
    fit = fit_model(body, samples, effects, train_mask, scale, config, counted, considered)
    return refit_weights(refit_weights(fit))


def search(fit: Fit, progress: Progress = lambda words, share: None,
           hopeless: Callable[[Fit], bool] = lambda fit: False) -> list[Step]:
    """Change the model by the best move, until no move is good.

    :param hopeless: of a model with one more effect, whether to stop there.
    """
    steps: list[Step] = []
    for _ in range(fit.config.most_rounds):
        step = _next_step(fit, steps, lambda words, share: progress(f'round {len(steps) + 1}: {words}', share))
        if step is None:
            shaped = reshaped(fit, fixed(fit)) if steps else fit
            if shaped is fit:
                break
            before, fit = fit, pruned(shaped)
            steps[-1] = replace(steps[-1], after=fit)
            if len(fit.effects) == len(before.effects) and not _worth_a_round(before, fit):
                break
            continue
        step.before.forget()  # far larger than the rest, as what trials leave
        fit = step.after
        if not step.added:
            steps[-1] = replace(steps[-1], after=fit)
            continue
        steps.append(replace(step, ranking=tuple(replace(trial, residual=None) for trial in step.ranking)))
        if hopeless(fit):
            break
    return [*steps[:-1], *(replace(step, after=with_common_forms(fit)) for step in steps[-1:])]


def _rivalries(fit: Fit, steps: Sequence[Step]) -> list[tuple[Effect, Effect]]:
    """Each effect that was found and is still there, with the likeliest rival of each kind."""
    pairs = []
    for step in steps:
        held = [effect for effect in fit.effects if identity(effect) == identity(step.added[0])]
        likeliest = {rival.effect.kind: rival.effect for rival in sorted(step.rivals, key=lambda rival: rival.odds)}
        pairs += [(held[0], rival) for rival in likeliest.values() if held]
    return pairs


def _next_step(fit: Fit, steps: Sequence[Step], report: Progress) -> Step | None:
    """The best move that comes to something, and what it makes needless.

    What moves in time bends what was just found at many places, so it is tried beside other forms of what is known
    then; and where nothing else is good. Two causes at once are tried where one alone comes to nothing.
    """
    trials = coarse(fit, candidates(fit), report)
    ranking = refine_foremost(fit, trials)
    moves = [*single_moves(fit, ranking), *group_moves(fit, trials), *ending_moves(fit),
             *repeated_moves(fit, ranking), *swapping_moves(fit, _rivalries(fit, steps))]
    if (steps and len(steps[-1].added) > 1) or not any(move.good for move in moves):
        moves += moving_moves(fit)
    made = partial(_first_made, fit, ranking, steps, report)
    return made(moves) or made(hidden_moves(fit, trials, report)) or \
        _changed(fit, with_usual(fit), ranking) or (None if steps else _revalued(fit, ranking))


def _first_made(fit: Fit, ranking: Sequence[Trial], steps: Sequence[Step], report: Progress,
                moves: Sequence[Move]) -> Step | None:
    """The step of the best of the good moves that comes to something."""
    good = [move for move in moves if move.good]
    while good:
        best = simplest(good)
        step = _made(fit, best, moves, ranking)
        if step.added:
            report(f'found {", ".join(place(effect.kind, effect.where) for effect in step.added)}', 1.0)
        if step.added or (steps and _worth_a_round(fit, step.after)):
            return step
        good = [move for move in good if move is not best]
    return None


def _worth_a_round(before: Fit, after: Fit) -> bool:
    """Return whether other values of a model gain as much as any effect costs: less than that makes no other one
    worth its price."""
    return gain(before, after).total > math.log(before.config.odds)


def _revalued(fit: Fit, ranking: Sequence[Trial]) -> Step | None:
    """The step that gives declared calibrations other values, which every step with something new does along."""
    after, moved = revalued(fit)
    added = tuple(effect for effect in after.effects if identity(effect) in moved)
    return Step(added=added, rivals=(), ranking=tuple(ranking), before=fit, after=after) if added else None


def _changed(fit: Fit, after: Fit, ranking: Sequence[Trial]) -> Step | None:
    """The step to a model with other effects; None to the same model."""
    before, names = ({identity(effect) for effect in each.effects} for each in (fit, after))
    added = tuple(effect for effect in after.effects if identity(effect) not in before)
    dropped = tuple(effect for effect in fit.effects if identity(effect) not in names)
    return Step(added=added, rivals=(), ranking=tuple(ranking), before=fit, after=after, dropped=dropped) \
        if added or dropped else None


def _made(fit: Fit, best: Move, moves: Sequence[Move], ranking: Sequence[Trial]) -> Step:
    """The step that a move is, with what was added at its best and what it makes needless taken off. Where that is what
    was declared, in another form, it adds that; where it is what was found, nothing."""
    added = [identity(effect) for effect in best.added]
    after = without_divided(bent(best.after, added))
    after = pruned(split(after, added))
    before = {(identity(effect), effect.end_s) for effect in fit.effects}
    names = {identity(effect) for effect in after.effects}
    found = tuple(effect for effect in after.effects if (identity(effect), effect.end_s) not in before) \
        or other_forms(fit, after)
    alone = len(found) == 1 == len(best.added)
    if alone:  # a load may have moved to the link nearest to its centre
        ranking = [replace(trial, effect=found[0]) if identity(trial.effect) == added[0] else trial
                   for trial in ranking]
    return Step(
        added=found, rivals=_rivals(fit, best, moves) if alone else (), ranking=tuple(ranking),
        before=fit, after=after,
        dropped=tuple(effect for effect in fit.effects if identity(effect) not in names))


def _rivals(fit: Fit, chosen: Move, moves: Sequence[Move]) -> tuple[Rival, ...]:
    """Rivals as good as the chosen move, with odds from a bootstrap of the blocks; of one cause at several times the
    likeliest."""
    generator, draws = np.random.default_rng(0), fit.config.bootstrap_draws
    found: dict[tuple[str, str | None], Rival] = {}
    known = {(effect.kind, effect.where) for effect in chosen.added}
    for move in moves:
        if len(move.added) > 1 or (move.added[0].kind, move.added[0].where) in known:
            continue
        if overlap(fit, chosen.after.residual, move.after.residual) < fit.config.alike:
            continue
        gains = block_gains(chosen.after, move.after)
        move.after.forget('sums')
        drawn = gains[generator.integers(len(gains), size=(draws, len(gains)))].sum(axis=1)
        better = min(int((drawn > 0.0).sum()), draws - 1)
        if better > 1:
            effect = move.added[0]
            rival = Rival(effect, better / (draws - better))
            earlier = found.pop((effect.kind, effect.where), rival)
            found[effect.kind, effect.where] = max(rival, earlier, key=lambda each: each.odds)
    return tuple(found.values())
