"""Prior knowledge of effects: the values that they can have, as positive masses and forces
that this robot could bear, and what each costs, minus the log of its prior probability."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from semiparam_ros.core.robot.consistency import pseudo_inertia
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.recordings import breaks_s
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.search.candidates import fixed, identity
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import ALWAYS


def all_plausible(before: Fit, after: Fit) -> bool:
    """Return whether no effect has impossible values in the second model that had none in the first."""
    wrong = {identity(effect) for index, effect in enumerate(before.effects)
             if not plausible(before, index)}
    return all(plausible(after, index) or identity(effect) in wrong
               for index, effect in enumerate(after.effects))


def without_impossible(fit: Fit) -> Fit:
    """The model without effects whose coefficients their causes cannot have, but for those that were declared."""
    while True:
        kept = [effect for index, effect in enumerate(fit.effects) if identity(effect) in fixed(fit)
                or effect.is_calibration or effect.physical(fit.coefficients_of(index))]
        if len(kept) == len(fit.effects):
            return fit
        fit = declare(with_effects(fit, kept), [])


def plausible(fit: Fit, index: int) -> bool:
    """Return whether the effect with this number has values that its cause can have on this robot."""
    effect = fit.effects[index]
    block = fit.assembly.blocks[str(index)]
    theta = fit.theta[block]
    if not effect.is_load:
        return effect.conceivable(fit.body, theta)
    covariance = fit.theta_covariance()[block, block] * float(fit.correlation.mean())
    if effect.must_start and effect.span == ALWAYS:  # declared: no motion tells what it weighs from what its link does
        return _is_a_body(fit, theta, covariance)
    return effect.conceivable(fit.body, theta) and _weighs(fit, theta, covariance) and not (
        effect.is_body and not _is_a_body(fit, theta, covariance))


def _weighs(fit: Fit, theta: Array, covariance: Array) -> bool:
    """Return whether the mass and the first moments of a load are more than chance: what has none is no load,
    however much inertia it seems to have."""
    distance = theta[:4] @ np.linalg.lstsq(covariance[:4, :4], theta[:4], rcond=1e-12)[0]
    return float(distance) > fit.config.weight_shows


def _is_a_body(fit: Fit, theta: Array, covariance: Array) -> bool:
    """Return whether ten inertial parameters are, within their uncertainty, those of a body: its pseudo-inertia has no
    negative eigenvalue (Wensing, Kim and Slotine 2018)."""
    values, vectors = np.linalg.eigh(pseudo_inertia(theta))
    slopes = np.einsum('ik,pij,jk->kp', vectors, OF_PSEUDO_INERTIA, vectors)  # of each eigenvalue
    deviations = np.sqrt(np.einsum('kp,pq,kq->k', slopes, covariance, slopes))
    return bool(np.all(values > -fit.config.unlike_a_body * deviations))


OF_PSEUDO_INERTIA = pseudo_inertia(np.eye(10))
"""(10, 4, 4): the pseudo-inertia is linear in the inertial parameters."""


def price(effect: Effect, others: Sequence[Effect], fit: Fit) -> float:
    """[nat] minus the log of an effect's prior probability beside others.

    Each kind is as unlikely as any other, at each of its places. One of a group, such as friction, that is at k of n
    places already is there too with probability (k + 1) / (n + 2) (Laplace's rule of succession). One of several forms
    is as likely as any other, and one that begins or ends may do so at any time, or
    with any recording.
    """
    config, places = fit.config, max(len(effect.places(fit.body)), 1)
    same = sum(other.kind == effect.kind for other in others) if effect.group else 0
    choices = effect.choices(fit.body, fit.samples, effect.where) if effect.searched else 1
    breaks = breaks_s(fit.samples)
    times = math.prod(len(breaks) + 1 if time_s in breaks else config.start_grid
                      for time_s in effect.span.values.values())
    odds = (places + 2) / (same + 1) if same else config.odds * places * max(len(fit.considered), 1)
    return math.log(choices * times * odds)


def prices(added: Sequence[Effect], fit: Fit) -> float:
    """[nat] the same of effects that come one after the other."""
    known = list(fit.effects)
    total = 0.0
    for effect in added:
        total += price(effect, known, fit)
        known.append(effect)
    return total


def usual(effect: Effect, others: Sequence[Effect], fit: Fit) -> bool:
    """Return whether others have an effect's kind, one of a group, at half of its other places or more.

    What begins or ends is a change, which what the others always had makes no likelier.
    """
    if not effect.group or effect.span.values:
        return False
    same = sum(other.kind == effect.kind for other in others)
    return 2 * same >= max(len(effect.places(fit.body)) - 1, 1)


def needed_errors(effect: Effect, others: Sequence[Effect], fit: Fit) -> float:
    """Standard errors that an effect's gain must exceed: one where it is :func:`usual` beside others."""
    return 1.0 if usual(effect, others, fit) else fit.config.sure
