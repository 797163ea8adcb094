"""Causes of no listed kind: effects that only resemble one are taken back.

Such a cause resembles several listed ones a little, and a search adds one after the other. The laws of causes that are
there hold on unseen blocks, and leave less than a smooth function of the motion and of time does. Where they do not,
an effect stays that is worth its price beside such a function: what it only resembles the function takes over.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.splits import block_sums, correlation_times
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.residual.flexible import StandardisedInputs, explained
from semiparam_ros.diagnosis.residual.structure import samples_to_look_at
from semiparam_ros.diagnosis.search.candidates import identity, others
from semiparam_ros.diagnosis.search.refit import declare, following
from semiparam_ros.diagnosis.search.revision import pruned
from semiparam_ros.diagnosis.search.score import Gain, coarsened, summed
from semiparam_ros.diagnosis.search.stepwise import Step


def function_explains_more(first: Fit, final: Fit) -> bool:
    """Whether a smooth function of the motion and of time beside the first model predicts unseen blocks better than
    the final model does."""
    config = final.config
    if final is first or len(samples_to_look_at(final.train_mask, config)) < config.structure_least_samples:
        return False
    beside, alone = _beside_function(first)[0], _looked_at(final)
    gains = summed(block_sums((alone**2 - beside**2) / final.scale**2, config.blocks).sum(axis=1))
    return gains.total > gains.error


def worth_beside_function(fit: Fit) -> list[Gain]:
    """Of each effect: what it gains [nat] over the model without it, with a smooth function beside both."""
    left, repeated = _beside_function(fit)
    doubled, gains = 2.0 * (left**2).mean(axis=0) * repeated, []
    for effect in fit.effects:
        rest = following(others(fit, effect), fit.effects)
        without, _ = _beside_function(declare(with_effects(fit, rest), []))
        gains.append(summed(block_sums((without**2 - left**2) / doubled, fit.config.blocks).sum(axis=1)))
    return gains


def holding(steps: list[Step], kinds: Collection[str]) -> list[Step]:
    """The steps with those effects alone that are worth their prices beside a smooth function."""
    fixed = {identity(effect) for effect in steps[0].before.effects}
    final = pruned(steps[-1].after, fixed, kinds, worth_beside_function)
    before, kept = steps[0].before, list[Step]()
    for step in steps:
        known = {identity(effect) for effect in (*before.effects, *step.added)}
        effects = [effect for effect in final.effects if identity(effect) in known or step is steps[-1]]
        if len(effects) > len(before.effects):
            after = with_effects(final, effects)
            kept.append(replace(step, before=before, after=after, dropped=()))
            before = after
    return kept


def _looked_at(fit: Fit) -> Array:
    """(M, n) residual of the samples to look at, zero where an output does not count."""
    return np.asarray((fit.residual * fit.counted)[samples_to_look_at(fit.train_mask, fit.config)])


def _beside_function(fit: Fit) -> tuple[Array, Array]:
    """(M, n) what a smooth function leaves of these on unseen blocks, and (n,) how many of them count as one."""
    residual, rows = _looked_at(fit), samples_to_look_at(fit.train_mask, fit.config)
    left = residual - explained(StandardisedInputs(fit.body.joints, fit.samples[rows], fit.config), residual)[0]
    return left, coarsened(correlation_times(left, fit.config), fit)
