"""Moves: changes of a model by further effects, with what each gains and what it costs."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from semiparam_ros.diagnosis.data.recordings import breaks_s
from semiparam_ros.diagnosis.named_change import Gain
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.search.candidates import added_columns, candidates, fixed, identity, includes, others
from semiparam_ros.diagnosis.search.plausibility import (
    all_plausible,
    needed_errors,
    plausible,
    prices,
    without_impossible,
)
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.revision import formed_anew, pruned, reshaped
from semiparam_ros.diagnosis.search.score import gain
from semiparam_ros.diagnosis.search.scoring import Progress, Trial, coarse, coarse_trial, refine_foremost
from semiparam_ros.diagnosis.search.spans import best_spans, with_best_edge
from semiparam_ros.effects import Effect


class Move(NamedTuple):
    """A change of the model: the effects added, the model with them, what it gains, and what it costs."""

    added: tuple[Effect, ...]
    after: Fit
    gain: Gain
    price: float

    @classmethod
    def of(cls, added: Sequence[Effect], fit: Fit, after: Fit, price: float, times_s: Collection[float] = ()) -> Move:
        """The move from a model to one with effects added; see :func:`gain`. One of many is made, so of the model only
        what tells it from others is kept."""
        gained = gain(fit, after, times_s)
        if after is not fit:
            after.forget('sums')
        return cls(tuple(added), after, gained, price)

    @property
    def net(self) -> float:
        """[nat] what it gains beyond its price."""
        return self.gain.total - self.price

    @property
    def good(self) -> bool:
        """Return whether it may be made."""
        names = {identity(effect) for effect in self.added}
        known = [effect for effect in self.after.effects if identity(effect) not in names]
        return self.gain.exceeds(self.price, max(needed_errors(effect, known, self.after) for effect in self.added))


def _plausible_moves(fit: Fit, after: Fit, added: Sequence[Effect]) -> list[Move]:
    """The move that adds some effects, unless it gives one of the model values that it cannot have."""
    if not all_plausible(fit, after):
        return []
    times = [time_s for effect in added for time_s in effect.span.values.values()]
    return [Move.of(added, fit, after, prices(added, fit), times)]


def single_moves(fit: Fit, ranking: Sequence[Trial]) -> list[Move]:
    """Each of the foremost trials by itself, and the foremost of each kind, with each of its times.

    The ranking fears many values more than the score does: several places of one kind shut out a better one.
    """
    of_kind = {trial.effect.kind: trial for trial in reversed(ranking)}
    foremost = [trial.effect for number, trial in enumerate(ranking) if trial.evidence > 0.0
                and (number < fit.config.tried or trial is of_kind[trial.effect.kind])]
    return [move for effect in foremost for timed in _at_each_time(fit, effect) if not includes(fit.effects, timed)
            for move in _plausible_moves(fit, declare(fit, [timed]), [timed])]


def _at_each_time(fit: Fit, effect: Effect) -> list[Effect]:
    """The effect, and the same always, from a start on, until an end and between both, where it may
    be so."""
    if not effect.changes:
        return [effect]
    spans = best_spans(fit, effect, added_columns(fit, effect.without_span()))
    return [effect, *(replace(effect, span=span) for span in spans
                      if span.values.keys() != effect.span.values.keys())]


def repeated_moves(fit: Fit, ranking: Sequence[Trial]) -> list[Move]:
    """Moves of what begins twice, as a load picked up again: with one of them alone the model is no better, for the
    rest of it bends towards the other."""
    moves, known = list[Move](), {identity(effect) for effect in fit.effects}
    foremost = {trial.effect.kind: trial for trial in reversed(ranking) if trial.effect.must_start
                and identity(trial.effect) not in known}
    for trial in foremost.values():
        once, where = declare(fit, [trial.effect]), trial.effect.where
        again = coarse_trial(once, type(trial.effect), where)
        if again is not None and identity(again.effect) not in {*known, identity(trial.effect)}:
            moves += _plausible_moves(fit, declare(once, [again.effect]), [trial.effect, again.effect])
    return moves


def ending_moves(fit: Fit) -> list[Move]:
    """Moves that end what may be over: a load that was put down. One that weighs less than nothing was not there:
    another was picked up when it would be over; and one that begins after the recording is not over."""
    moves, (first, last) = [], fit.samples.time[fit.train_mask][[0, -1]].tolist()
    for number, effect in enumerate(fit.effects):
        of_recording = effect.own_in_each_recording and effect.start_s in breaks_s(fit.samples)
        begins = first if effect.start_s is None else max(first, effect.start_s)
        if effect.changes and effect.end_s is None and not of_recording and begins < last:
            rest = with_effects(fit, others(fit, effect))
            ended = with_best_edge(rest, effect, 'end_s', (begins, last))
            after = declare(with_effects(fit, [ended if known is effect else known for known in fit.effects]), [])
            if all_plausible(fit, after) and plausible(after, number):
                moves.append(Move.of((ended,), fit, after, math.log(fit.config.start_grid),
                                     [float(ended.end_s or last)]))
    return moves


def swapping_moves(fit: Fit, pairs: Sequence[tuple[Effect, Effect]]) -> list[Move]:
    """Moves that put a rival in the place of what was found: what has come in since may tell the two apart."""
    moves = []
    for known, rival in pairs:
        rest = with_effects(fit, others(fit, known))
        after = declare(rest, [rival])
        if all_plausible(rest, after):
            times = set(known.span.values.values()) ^ set(rival.span.values.values())
            price = prices([rival], rest) - prices([known], rest)
            moves.append(Move.of((rival,), fit, after, price, times))
    return moves


def group_moves(fit: Fit, trials: Sequence[Trial]) -> list[Move]:
    """Kinds at all their places at once: what one joint lacks bends the rigid body's fit of the others."""
    groups: dict[str, list[Effect]] = {}
    for trial in trials:
        if trial.effect.group and not includes(fit.effects, trial.effect.without_span()):
            groups.setdefault(trial.effect.group, []).append(trial.effect.without_span())
    known, moves = {identity(effect) for effect in fit.effects}, []
    order = list(fit.considered)
    for effects in groups.values():
        effects.sort(key=lambda effect: (order.index(effect.kind), effect.places(fit.body).index(effect.where)))
        if len(effects) > 1:
            after = without_impossible(declare(fit, effects))
            after = reshaped(after, known) if any(effect.searched for effect in effects) else after
            after = pruned(after, known=known)
            added = tuple(effect for effect in after.effects if identity(effect) not in known)
            if added:
                moves.append(Move.of(added, fit, after, prices(added, fit)))
    return moves


def hidden_moves(fit: Fit, trials: Sequence[Trial], report: Progress) -> list[Move]:
    """The best move that gives joints their friction and rotors, and one more cause there, at once.

    A joint that lacks two hides either of them: with one alone, what is left repeats itself for so long that hardly
    any of its samples tell something.
    """
    known, tried = {identity(effect) for effect in fit.effects}, {identity(trial.effect): trial for trial in trials}
    lacking = [(kind, where) for kind, where in candidates(fit) if kind.group and kind.resists]
    if not lacking:
        return []
    friction = [tried[identity(kind(where))].effect if identity(kind(where)) in tried else
                kind.from_values(where, kind.searches(fit.body, fit.samples, where, fit.residual)[0])
                for kind, where in lacking]
    joints = {where for _, where in lacking}
    beside = reshaped(declare(fit, friction), known)
    pool = [(kind, where) for kind, where in candidates(beside) if where in joints]
    ranking = refine_foremost(beside, coarse(beside, pool, report))
    good = [move for move in single_moves(beside, ranking) if move.good]
    after = without_impossible(max(good, key=lambda move: move.net).after if good else beside)
    after = pruned(reshaped(after, known), known=known)
    added = [effect for effect in after.effects if identity(effect) not in known]
    return _plausible_moves(fit, after, added) if added else []


def moving_moves(fit: Fit) -> list[Move]:
    """Calibrations that move what the effects depend on, each with all forms of these searched anew beside it.

    Efforts that come late make dry friction seem to bend before it slides: each of the two hides the other.
    """
    formed = [effect for effect in fit.effects if effect.searched and not effect.is_calibration]
    known, moves = {effect.kind for effect in fit.effects}, list[Move]()
    for kind in fit.considered.values():
        if formed and kind.moves_friction and kind.kind not in known and None in kind.places(fit.body):
            nothing = kind(None, {coefficient.name: 0.0 for coefficient in kind.calibrations})
            after = declare(formed_anew(declare(fit, [nothing])), [])
            after = reshaped(without_impossible(after), fixed(fit))
            added = next(effect for effect in after.effects if effect.kind == kind.kind)
            moves += _plausible_moves(fit, after, [added])
    return moves


def simplest(moves: Sequence[Move]) -> Move:
    """Move of the fewest values among those that no block tells from the best one; of as many, what lasts, and what the
    robot description leaves open, as a rotor, before what it says, as where a joint's zero is."""
    best = max(moves, key=lambda move: move.net)
    alike = [move for move in moves if len(move.added) == 1 == len(best.added)
             and (move is best or _alike(move, best))]
    return min(alike, key=lambda move: (
        sum(values_of(effect, move.after) for effect in move.after.effects), move.added[0].ends,
        move.added[0].is_calibration, -move.net)) if alike else best


def _alike(one: Move, other: Move) -> bool:
    """Return whether no block tells them apart, nor rounding: an offset from a time on is one until then. What the
    description leaves open is taken up to ``better_odds`` before as many values of what it says."""
    difference, config = gain(one.after, other.after), one.after.config
    one.after.forget('sums')
    mine, known = one.added[0], other.added[0]
    left_open = known.is_calibration and not mine.is_calibration \
        and values_of(mine, one.after) == values_of(known, other.after)
    return difference.total < max(difference.error, math.log(config.better_odds) if left_open else config.settled_gain)


def values_of(effect: Effect, fit: Fit) -> int:
    """Number of values of an effect: coefficients, calibrations and those that a search chose."""
    return (len(effect.coefficients(fit.body)) + len(effect.searched) + len(effect.calibrations)
            + len(effect.span.values))
