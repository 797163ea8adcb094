"""Naming of a change at a time that is known: the likeliest effect that began, or was over, near it.

A diagnosis asks what is missing, anywhere in a recording. Here the time is known, and what the
model holds before it too, so that few samples after it are enough, and few seconds of a processor.
The score is that of a diagnosis: the log predictive density of blocks that did not fit, as many
before the change as after it (``search.score``), less minus the log of the effect's prior
probability. Loads come first by that: a robot picks up and puts down.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semiparam_ros.core.robot.frames import last_links
from semiparam_ros.core.robot.joint_friction import turn_speeds
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import untouched
from semiparam_ros.diagnosis.data.splits import block_sums
from semiparam_ros.diagnosis.evaluation import evaluate_here
from semiparam_ros.diagnosis.findings import quantities
from semiparam_ros.diagnosis.named_change import ChangeRival, Gain, NamedChange, Quantity
from semiparam_ros.diagnosis.preparation import Inputs, prepared, require_enough
from semiparam_ros.diagnosis.regression import Fit, refit_weights, with_effects
from semiparam_ros.diagnosis.search.moves import Move
from semiparam_ros.diagnosis.search.plausibility import plausible
from semiparam_ros.diagnosis.search.score import gain, repetition, summed
from semiparam_ros.diagnosis.search.spans import with_best_edge
from semiparam_ros.diagnosis.search.stepwise import starting_fit
from semiparam_ros.diagnosis.uncertainty import estimates
from semiparam_ros.effects import Effect, kinds
from semiparam_ros.effects.base import Span
from semiparam_ros.effects.drive import EffortOffset, RotorInertia
from semiparam_ros.effects.friction import CoulombFriction, ViscousFriction, plain_friction


def name_change(body: RigidBody, samples: Samples, effects: Sequence[Effect], since_s: float,
                ended_s: float | None = None, inputs: bytes | None = None,
                config: DiagnosisConfig = DEFAULTS, touched_s: float | None = None,
                contacts: Sequence[tuple[float, float]] = ()) -> NamedChange:
    """Find what began near ``since_s`` [s since the origin], and was over near ``ended_s``.

    :param effects: those that the model holds, declared or named before.
    :param inputs: how the samples are prepared, of the name before; chosen anew, which takes most of the
        time, unless given.
    :param touched_s: since when a contact stood out that it may have been.
    :param contacts: [s] between which the robot was touched, which is left out.

    Raises SemiparamError when too few samples are left to work with.
    """
    touched_s = since_s if touched_s is None else min(touched_s, since_s)
    clean = untouched(samples, contacts, config)
    known = None if inputs is None else pickle.loads(inputs)
    fit, chosen, changed = _first_fit(body, samples, effects, touched_s, known, config, clean)
    tried = _ranked(fit, fit.effects[: len(effects)], (touched_s, since_s), ended_s)
    best = _likeliest(tried)
    foremost = best or (tried[0] if tried else None)
    used = fit.train_mask
    rest = changed if ended_s is None else changed & (fit.samples.time < ended_s)
    require_enough(config, used & rest)
    step = float(np.median(np.diff(fit.samples.time)))
    return NamedChange(
        effect=best.added[0] if best else None,
        gain=foremost.gain if foremost else Gain(0.0, 0.0),
        price=foremost.price if foremost else 0.0,
        rivals=tuple(
            ChangeRival(other.added[0].kind, other.added[0].where, best.net - other.net)
            for other in [other for other in tried if other is not best][:3]) if best else (),
        parameters=_parameters(best, chosen, samples) if best else {},
        before=evaluate_here(fit, used & ~changed).as_dict(),
        without=evaluate_here(fit, used & rest).as_dict(),
        after=evaluate_here(best.after if best else fit, used & rest).as_dict(),
        seconds=float(rest.sum()) * step, inputs=pickle.dumps(chosen))


def _ranked(fit: Fit, known: Sequence[Effect], since_s: tuple[float, float],
            ended_s: float | None) -> list[Move]:
    """Every effect that may have begun, and every one that is known and may be over, the likeliest
    first."""
    begun = (_tried(fit, effect, since_s, ended_s) for effect in _candidates(fit))
    over = (_over(fit, effect, since_s) for effect in known
            if (effect.changes or effect.may_come) and not effect.ends and ended_s is None
            and (effect.span.start_s or -math.inf) < since_s[1])
    return sorted(filter(None, (*begun, *over)), key=lambda trial: -trial.net)


def _likeliest(tried: Sequence[Move]) -> Move | None:
    """The foremost, unless one that is likelier beforehand is surpassed by chance; None where it is
    not worth its price."""
    if not tried or not tried[0].good:
        return None
    best = tried[0]
    return next((other for other in tried if other.good and not _surpasses(best, other)), best)


def _surpasses(best: Move, other: Move) -> bool:
    """Return whether a move is better than another one by more than what is against it beforehand, and by
    more than chance."""
    if other is best or other.price >= best.price:
        return True
    times = set(best.added[0].span.values.values()) ^ set(other.added[0].span.values.values())
    beyond = gain(other.after, best.after, times)
    return beyond.exceeds(best.price - other.price, best.after.config.sure)


def gain_since(body: RigidBody, samples: Samples, since_s: float, before: Sequence[Effect],
               after: Sequence[Effect], config: DiagnosisConfig = DEFAULTS,
               contacts: Sequence[tuple[float, float]] = ()) -> Gain:
    """By how much [nat] a model with the effects ``after`` predicts samples from ``since_s`` [s
    since their origin] on better than one with the effects ``before``, both fitted to those before
    it.

    :param contacts: [s] between which the robot was touched, which is left out.

    Raises SemiparamError when there are too few of either.
    """
    models = [[effect.in_recording(samples.origin) for effect in effects]
              for effects in (before, after)]
    old = samples.time < since_s
    clean = untouched(samples, contacts, config)
    inputs, chosen, used, counted = prepared(body, samples, models[0], old, config, clean=clean)
    fitting, judging = used & inputs.mask(old), used & inputs.mask(~old)
    require_enough(config, fitting, judging)
    fits = [starting_fit(body, chosen, effects, fitting, config, counted) for effects in models]
    repeated = repetition(fits[1])
    densities = [
        -0.5 * counted * (fit.residual**2 / fit.scale**2 + 2.0 * np.log(fit.scale)) / repeated
        for fit in fits]
    gained = (densities[1] - densities[0]).sum(axis=1)[judging]
    return summed(block_sums(gained, config.blocks))


def _first_fit(body: RigidBody, samples: Samples, effects: Sequence[Effect], since_s: float,
               inputs: Inputs | None, config: DiagnosisConfig,
               clean: Mask) -> tuple[Fit, Inputs, Mask]:
    """The model that is declared, how its samples were prepared, and which (N,) came after the
    change.

    :param clean: (N,) the samples that may be used.
    """
    effects = [*(effect.in_recording(samples.origin) for effect in effects), *_of_joints(body)]
    everything = np.ones(len(samples), dtype=bool)
    inputs, chosen, used, counted = prepared(body, samples, effects, everything, config, inputs,
                                             clean)
    changed = np.asarray(chosen.time >= since_s)
    require_enough(config, used & ~changed, used)
    return starting_fit(body, chosen, effects, used, config, counted), inputs, changed


def _of_joints(body: RigidBody) -> list[Effect]:
    """Columns that the model of an arm with joint efforts has of each joint
    (``core.robot.joint_friction``)."""
    found: list[Effect] = []
    if body.outputs != 'effort':
        return found
    for joint, speeds in zip(body.output_names, turn_speeds(body).T.tolist(), strict=True):
        found += [ViscousFriction(joint), RotorInertia(joint), EffortOffset(joint), *(
            CoulombFriction(joint, {'turn_speed': speed}) for speed in speeds)]
    return found


def _candidates(fit: Fit) -> list[Effect]:
    """Every effect that may begin."""
    body, reference = fit.body, tuple(fit.rigid_part.tolist())
    found: list[Effect] = [
        kind.from_values(where, kind.searches(body, fit.samples, where, fit.residual)[0], reference)
        for kind in kinds(body.outputs).values()
        if kind.may_start or kind.must_start or kind.may_come for where in _places(kind, body)]
    for joint in body.output_names if body.outputs == 'effort' else ():
        found += plain_friction(body, joint)
    return found


def _places(kind: type[Effect], body: RigidBody) -> Sequence[str | None]:
    """Places where an effect may begin; at links the last one of each branch alone. A joint may have a link's name."""
    places = kind.permitted(body) if kind.may_come else kind.places(body)
    if kind.of_joint:
        return places
    return [link for link in last_links(body) if link in places] or places


def _tried(fit: Fit, effect: Effect, since_s: tuple[float, float],
           ended_s: float | None) -> Move | None:
    """The effect with its best times near those given, in the model; None where it has values that
    it cannot have."""
    spans = [Span(start_s=since_s[1], end_s=ended_s)]
    known = any(each.is_load and not each.ends for each in fit.effects)
    if effect.is_body and ended_s is None and not known:
        spans.append(Span(end_s=since_s[1]))  # what was in the hand before, and the model has learnt
    best: Move | None = None
    for span in spans:
        acting = replace(effect, span=span)
        for name, time_s in span.values.items():
            between = (time_s, time_s) if time_s == ended_s else since_s
            acting = with_best_edge(fit, acting, name, _near(fit, between))
        after = refit_weights(with_effects(fit, [*fit.effects, acting]))
        if not (plausible(after, len(fit.effects)) if effect.is_load else _resists(after, acting)):
            continue
        times = acting.span.values.values()
        trial = Move.of((acting,), fit, after, _price(acting, fit), times)
        best = trial if best is None or trial.net > best.net else best
    return best


def _resists(fit: Fit, effect: Effect) -> bool:
    """Return whether what resists does so still: less friction is a change, friction that drives is none."""
    alike = [number for number, known in enumerate(fit.effects)
             if known.kind == effect.kind and known.where == effect.where and not known.ends]
    return not effect.resists or sum(fit.coefficients_of(number).sum() for number in alike) > 0.0


def _near(fit: Fit, between_s: tuple[float, float]) -> tuple[float, float]:
    """[s] between which something began, or was over, that seemed to begin between two times."""
    first, last = between_s
    return first - fit.config.change_before_s, last + fit.config.change_after_s


def _over(fit: Fit, effect: Effect, since_s: tuple[float, float]) -> Move | None:
    """An effect that the model holds, with its end near a time; None of a body that would weigh less than nothing, for
    then another was picked up."""
    kept = [known for known in fit.effects if known is not effect]
    over = with_best_edge(with_effects(fit, kept), effect, 'end_s', _near(fit, since_s))
    after = refit_weights(
        with_effects(fit, [over if known is effect else known for known in fit.effects]))
    if effect.is_body and not over.physical(after.coefficients_of(after.effects.index(over))):
        return None
    return Move.of((over,), fit, after, math.log(fit.config.start_grid), [float(over.end_s or since_s[1])])


def _price(effect: Effect, fit: Fit) -> float:
    """[nat] minus the log of its prior probability: a load may have come or gone at any time near;
    the rest is as unlikely as a diagnosis takes it to be (``search.plausibility``)."""
    times = math.log(fit.config.start_grid) * len(effect.span.values)
    if effect.is_body:
        return times
    return times + math.log(fit.config.odds * len(_places(type(effect), fit.body)))


def _parameters(best: Move, inputs: Inputs, samples: Samples) -> dict[str, Quantity]:
    """The values of the effect, with their standard deviations."""
    (effect,), fit = best.added, best.after
    number = fit.effects.index(effect)
    block = fit.assembly.blocks[str(number)]
    told = estimates(fit, [number], inputs.disturbed(samples)).coefficients[:, block]
    return quantities(effect.coefficients(fit.body), told)
