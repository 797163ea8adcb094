"""Causes of no listed kind: effects that only resemble one are taken back.

Such a cause resembles several listed ones a little, and a search adds one after the other. The laws of causes that are
there hold on unseen blocks, and leave less than a smooth function of the motion and of time does. Where they do not,
an effect stays that is worth its price beside such a function: what it only resembles the function takes over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.splits import block_sums, correlation_times
from semiparam_ros.diagnosis.findings import places_in
from semiparam_ros.diagnosis.named_change import Gain
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.residual.flexible import StandardisedInputs, explained
from semiparam_ros.diagnosis.residual.structure import samples_to_look_at
from semiparam_ros.diagnosis.search.candidates import others
from semiparam_ros.diagnosis.search.refit import remaining
from semiparam_ros.diagnosis.search.revision import pruned
from semiparam_ros.diagnosis.search.score import coarsened, summed
from semiparam_ros.diagnosis.search.stepwise import Step


def function_explains_more(first: Fit, final: Fit) -> bool:
    """Return whether a smooth function of the motion and of time beside the first model predicts unseen blocks
    better than the final model does."""
    config, rows = final.config, samples_to_look_at(final.train_mask, final.config)
    if final is first or len(rows) < config.structure_least_samples:
        return False
    (beside,), alone = _beside_function([first]), (final.residual * final.counted)[rows]
    gains = summed(block_sums((alone**2 - beside**2) / final.scale**2, config.blocks).sum(axis=1))
    return gains.total > gains.error


def worth_beside_function(fit: Fit) -> list[Gain]:
    """Gain [nat] of each effect over the model without it, with a smooth function beside both."""
    config = fit.config
    left, *without = _beside_function([fit, *(remaining(fit, others(fit, effect)) for effect in fit.effects)])
    counts = fit.counted[samples_to_look_at(fit.train_mask, config)].sum(axis=0)
    repeated = coarsened(correlation_times(left, config), counts, config)
    doubled = 2.0 * (left**2).mean(axis=0) * repeated
    return [summed(block_sums((each**2 - left**2) / doubled, config.blocks).sum(axis=1)) for each in without]


def holding(steps: list[Step]) -> list[Step]:
    """The steps with those effects alone that are worth their prices beside a smooth function."""
    before, kept = steps[0].before, list[Step]()
    final = pruned(steps[-1].after, worth_beside_function)
    rounds = dict(places_in(final, steps))
    for number, step in enumerate(steps, start=1):
        if number in rounds.values():
            after = with_effects(final, [effect for index, effect in enumerate(final.effects)
                                         if rounds.get(index, 0) <= number])
            kept.append(replace(step, before=before, after=after, dropped=()))
            before = after
    return kept


def _beside_function(fits: Sequence[Fit]) -> list[Array]:
    """(M, n) each, what a smooth function leaves on unseen blocks of what models of the same samples leave: of those to
    look at, zero where an output does not count."""
    fit = fits[0]
    rows = samples_to_look_at(fit.train_mask, fit.config)
    counted, motion = fit.counted[rows], StandardisedInputs(fit.body.joints, fit.samples[rows], fit.config)
    residuals = [each.residual[rows] * counted for each in fits]
    found, _ = explained(motion, np.hstack(residuals), counted=np.tile(counted, len(fits)))
    return [residual - part for residual, part in zip(residuals, np.split(found, len(fits), axis=1), strict=True)]
