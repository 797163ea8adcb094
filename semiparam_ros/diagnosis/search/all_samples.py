"""After the judgement: the model found, fitted once more to all samples, its times searched to the sample.

What judges must not fit. But a time inside a block that was held out is known to that block only, and what is declared
from then on should rest on everything that was recorded.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from semiparam_ros.core.types import Mask
from semiparam_ros.diagnosis.data.recordings import breaks_s
from semiparam_ros.diagnosis.regression import Fit, refit_weights, with_effects
from semiparam_ros.diagnosis.search.refit import declare, settled
from semiparam_ros.diagnosis.search.spans import around, with_best_edge
from semiparam_ros.effects import Effect


def fitted_to_all(fit: Fit, usable: Mask, found: Collection[int]) -> Fit:
    """The same effects in the same order, fitted to all usable samples (N,).

    :param found: numbers of the effects that were found, whose times are searched again near where they are, and whose
        nonlinear values are settled.
    """
    everything = replace(fit, train_mask=usable)
    effects = list(fit.effects)
    for number in found:
        effects[number] = _timed_anew(everything, effects, number)
    return _without_common_gain(settled(declare(with_effects(everything, effects), []), found))


def _without_common_gain(fit: Fit) -> Fit:
    """The same model with gains as :meth:`Effect.without_common_gain` has them, unless a known mass tells them."""
    effects = [effect.without_common_gain() for effect in fit.effects]
    return fit if fit.knows_mass or effects == list(fit.effects) else refit_weights(with_effects(fit, effects))


def _timed_anew(fit: Fit, effects: list[Effect], number: int) -> Effect:
    effect = effects[number]
    rest = with_effects(fit, [*effects[:number], *effects[number + 1:]])
    for name, time_s in effect.span.values.items():
        if time_s not in breaks_s(fit.samples):
            effect = with_best_edge(rest, effect, name, around(fit, time_s))
    return effect
