"""Friction of a joint that changes within a recording, of which the search has one value for all of it.

Columns of all that rubs at a joint are added once more, from the likeliest time on. They are judged as any move is: by
left-out blocks, at odds that count the joints and the times that were tried. What changes may have hidden viscous or
dry friction, so every joint has both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.recordings import own_time
from semiparam_ros.diagnosis.regression import Fit, refit_weights, with_effects
from semiparam_ros.diagnosis.search.candidates import held
from semiparam_ros.diagnosis.search.score import gain
from semiparam_ros.diagnosis.search.spans import best_edge
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import ALWAYS, Span
from semiparam_ros.effects.friction import plain_friction


class FrictionChange(NamedTuple):
    """All that rubs at a joint, once more from a time on: the model without and with it, and what it gains."""

    joint: str
    effects: list[Effect]
    span: Span
    before: Fit
    after: Fit
    net: float

    def sentence(self, names: Sequence[str]) -> str:
        """Sentence with the time, in the recording of that name, and the values."""
        fit = self.before
        numbers, last = [fit.effects.index(effect) for effect in self.effects], len(fit.effects)
        values = [words for place, (number, effect) in enumerate(zip(numbers, self.effects, strict=True)) for words in
                  _values(fit, effect, *map(self.after.coefficients_of, (number, last + place)))]
        time_s, of = own_time(fit.samples, names, float(self.span.start_s or 0.0))
        channel = fit.body.output_names.index(self.joint)
        usual, less = (each.scale[channel] for each in (fit, self.after))
        unit = fit.body.output_units[channel]
        return (f'The friction of {self.joint} changes at {time_s:.1f} s{of}: {", ".join(values)}. The findings have '
                f'one value for all of the recording; with both, errors of {usual:.2g} {unit} fall to {less:.2g}.')


def friction_changes(fit: Fit, names: Sequence[str]) -> list[str]:
    """A sentence for each joint whose friction changes, the surest first, each beside those before it.

    :param fit: the final model. :param names: of the recordings.
    """
    if fit.body.outputs != 'effort':
        return []
    known, sentences = held(fit.effects), list[str]()
    lacking = [effect for joint in fit.body.output_names for effect in plain_friction(fit.body, joint)
               if (effect.kind, joint) not in known]
    fit = refit_weights(with_effects(fit, [*fit.effects, *lacking]))
    # what is declared with a start rubs in its own way
    joints = [joint for joint in fit.body.output_names if _rubbing(fit, joint)]
    while joints:
        best = max((_change(fit, joint) for joint in joints), key=lambda change: change.net)
        if best.net <= 0.0:
            break
        sentences.append(best.sentence(names))
        joints.remove(best.joint)
        fit = best.after
    return sentences


def _rubbing(fit: Fit, joint: str) -> list[int]:
    """Numbers of the effects that rub at a joint, and always did."""
    return [number for number, effect in enumerate(fit.effects) if effect.where == joint and effect.span == ALWAYS
            and effect.resists and effect.shows_against == 'velocity']


def _change(fit: Fit, joint: str) -> FrictionChange:
    config, numbers = fit.config, _rubbing(fit, joint)
    effects = [fit.effects[number] for number in numbers]
    columns = np.concatenate([fit.assembly.of_effect(number, *fit.corrected) for number in numbers], axis=2)
    inside = np.quantile(fit.samples.time[fit.train_mask], [config.start_margin, 1.0 - config.start_margin])
    span = best_edge(fit, columns, ALWAYS, 'start_s', (float(inside[0]), float(inside[1])))
    after = refit_weights(with_effects(fit, [*fit.effects, *(replace(effect, span=span) for effect in effects)]))
    price = math.log(config.odds * len(fit.body.output_names) * config.start_grid)
    gained = gain(fit, after, span.values.values())
    return FrictionChange(joint, effects, span, fit, after, gained.total - max(price, config.sure * gained.error))


def _values(fit: Fit, effect: Effect, before: Array, change: Array) -> list[str]:
    """Each coefficient, before and since."""
    return [f'{name} {old:.3g} {unit} before and {old + more:.3g} since' for (name, unit), old, more in
            zip(effect.coefficients(fit.body), before.tolist(), change.tolist(), strict=True)]
