"""What an effect costs before the samples are asked: minus the log of its prior probability."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

from semiparam_ros.diagnosis.data.recordings import breaks_s
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.effects import Effect


def price(effect: Effect, others: Sequence[Effect], fit: Fit, kinds: Collection[str]) -> float:
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
    odds = (places + 2) / (same + 1) if same else config.odds * places * max(len(kinds), 1)
    return math.log(choices * times * odds)


def prices(added: Sequence[Effect], fit: Fit, kinds: Collection[str]) -> float:
    """[nat] the same of effects that come one after the other."""
    known = list(fit.effects)
    total = 0.0
    for effect in added:
        total += price(effect, known, fit, kinds)
        known.append(effect)
    return total


def usual(effect: Effect, fit: Fit) -> bool:
    """Whether the model holds a kind of a group at half of its other places or more."""
    others = sum(known.kind == effect.kind for known in fit.effects if known is not effect)
    return bool(effect.group) and 2 * others >= max(len(effect.places(fit.body)) - 1, 1)
