"""Friction and offset of all joints at once: what a plain model made by hand has, and a search may not reach.

Where many joints rub, no single effect need carry over: what one joint lacks bends the rigid body's fit of all. And a
robot most of whose joints are seen to rub does so at the others, too.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from semiparam_ros.diagnosis.data.splits import improves, unseen_score
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.search.candidates import Place, added_columns, held
from semiparam_ros.diagnosis.search.delay_with_friction import reshaped, with_leads
from semiparam_ros.diagnosis.search.elimination import worth_at_once
from semiparam_ros.diagnosis.search.plausibility import without_impossible
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.scoring import Trial, score
from semiparam_ros.effects import Effect
from semiparam_ros.effects.drive import EffortOffset
from semiparam_ros.effects.friction import SPEED_SHARES, CoulombFriction, ViscousFriction

FRICTION = (ViscousFriction.kind, CoulombFriction.kind)


def friction_of_all(fit: Fit, kinds: dict[str, type[Effect]], declared: Collection[Place]) -> Fit | None:
    """The model with dry and viscous friction of all joints, and the offsets that help, where most joints rub, with
    each friction in its own form too.

    :param declared: kinds and places that were in the model before the search and stay as they are.
    """
    full = _completed(fit, kinds, declared)
    if full is None or not _is_widespread(full, fit.config.least_evidence) or not _better(fit, full):
        return None
    after = _shaped(_pruned(full, (EffortOffset.kind,), declared), declared)
    # While its form is wrong, one joint's friction bends all others'.
    return after if _is_widespread(after, 0.0) else None


def friction_where_it_helps(fit: Fit, kinds: dict[str, type[Effect]], declared: Collection[Place]) -> Fit | None:
    """The model with friction and offset of those joints where they help; beside the effects found, or in their place.

    :param declared: kinds and places that were in the model before the search and stay as they are.
    """
    known = [effect for effect in fit.effects if (effect.kind, effect.where) in declared]
    starts = [fit, with_effects(fit, known)] if len(known) < len(fit.effects) else [fit]
    full = [_completed(start, kinds, declared) for start in starts]
    pruned = [_pruned(after, (*FRICTION, EffortOffset.kind), declared) for after in full if after is not None]
    best = min(pruned, key=unseen_score, default=None)
    return _shaped(best, declared) if best is not None and _better(fit, best) else None


def _better(fit: Fit, other: Fit) -> bool:
    """Whether the other model improves by more than noise that is correlated over long times would let offsets do."""
    if not other.effects:
        return False
    spent = other.n_columns - fit.n_columns
    worth = score(fit, Trial(other.effects[-1], other.residual, spent), other.correlation).evidence
    return worth > fit.config.least_evidence and improves(fit, other, least=fit.config.plain_gain)


def _shaped(fit: Fit, declared: Collection[Place]) -> Fit:
    return with_leads(min(fit, reshaped(fit, declared), key=unseen_score), declared)


def _completed(fit: Fit, kinds: dict[str, type[Effect]], declared: Collection[Place]) -> Fit | None:
    """The model with all that it lacks, as far as it is possible; None where it lacks nothing."""
    if fit.body.outputs != 'effort':
        return None
    missing = min(_missing(fit, kinds), key=lambda added: _loss(fit, added), default=[])
    return without_impossible(declare(fit, missing), declared) if missing else None


def _missing(fit: Fit, kinds: dict[str, type[Effect]]) -> list[list[Effect]]:
    """The effects that the model lacks, for each speed within which dry friction may turn over."""
    known = held(fit.effects)
    top_speed = np.abs(fit.samples.velocity[fit.train_mask][:, fit.body.output_index]).max(axis=0)
    joints = list(zip(fit.body.output_names, top_speed.tolist(), strict=True))
    everywhere = [[effect for joint, fastest in joints for effect in (
        ViscousFriction(joint), CoulombFriction(joint, {'turn_speed': share * max(fastest, 1e-6)}),
        EffortOffset(joint))] for share in SPEED_SHARES]
    return [[effect for effect in effects if effect.kind in kinds and (effect.kind, effect.where) not in known]
            for effects in everywhere]


def _loss(fit: Fit, effects: list[Effect]) -> float:
    if not effects:
        return fit.loss
    return fit.loss_with(np.concatenate([added_columns(fit, effect) for effect in effects], axis=2))[0]


def _is_widespread(fit: Fit, least: float) -> bool:
    """Whether friction is worth more than ``least`` [nat] at more than half of the joints, and at three at least."""
    worth = worth_at_once(fit)
    rubbing = {effect.where for index, effect in enumerate(fit.effects)
               if effect.kind in FRICTION and worth[index] > least}
    return len(rubbing) > max(2, fit.body.n_outputs // 2)


def _pruned(fit: Fit, kinds: Collection[str], declared: Collection[Place]) -> Fit:
    """The model without the least credible effects of these kinds, as many as the score on unseen blocks allows."""
    worth = worth_at_once(fit)
    order = [int(index) for index in np.argsort(worth) if -np.inf < worth[index] < fit.config.least_evidence
             and fit.effects[index].kind in kinds
             and (fit.effects[index].kind, fit.effects[index].where) not in declared]
    best, fewest, most = fit, 0, len(order)
    allowed = unseen_score(fit) + fit.config.needless_score
    while fewest < most:
        count = (fewest + most + 1) // 2
        gone = set(order[:count])
        kept = [effect for index, effect in enumerate(fit.effects) if index not in gone]
        fewer = declare(with_effects(fit, kept), [])
        if unseen_score(fewer) < allowed:
            best, fewest = fewer, count
        else:
            most = count - 1
    return best
