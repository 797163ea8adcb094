"""Which variables does the structure in a residual depend on? Forward selection, judged on unseen blocks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.residual.flexible import StandardisedInputs, bells, predictions, random_features


class Dependence(NamedTuple):
    """A variable (q_, dq_, ddq_ and a joint, or time) and the share of the residual that it adds to those before it."""

    name: str
    share: float


def dependences(motion: StandardisedInputs, targets: Array, within_reach: float) -> tuple[Dependence, ...]:
    """Variables of which a smooth function predicts targets (M, k), the most telling first.

    :param within_reach: share of the targets that a function of all variables predicts.
    """
    config, power = motion.config, float(np.sum(targets**2)) + 1e-300
    chosen, found, reached = list[int](), list[Dependence](), 0.0

    def share(added: tuple[int, ...]) -> float:
        """Share of the squared targets that these and those chosen predict on unseen blocks."""
        predicted = predictions(_features(motion, [*chosen, *added]), targets, config)
        return 1.0 - float(np.sum((targets - predicted) ** 2)) / power

    while len(chosen) < config.most_variables:
        others = [index for index in range(len(motion.names)) if index not in chosen]
        shares: dict[tuple[int, ...], float] = {(index,): share((index,)) for index in others}
        if not chosen and max(shares.values()) < config.most * within_reach:
            # A product of two variables with means of zero shows in neither of them.
            shares |= {pair: share(pair) for pair in combinations(others, 2)}
        best = max(shares, key=lambda added: shares[added] * _plainness(motion, added))
        gained = shares[best] - reached
        if gained < config.variable_share * max(within_reach, reached):
            break
        chosen += best
        found += [Dependence(motion.names[index], gained / len(best)) for index in best]
        reached = shares[best]
    return tuple(found)


def _plainness(motion: StandardisedInputs, added: tuple[int, ...]) -> float:
    """Among near equals a position is preferred to a velocity, and that to an acceleration, which noise spoils."""
    order = [('q', 'time', 'dq', 'ddq').index(motion.names[index].split('_')[0]) for index in added]
    return (1.0 - motion.config.variable_share * sum(order)) / (1.0 if len(added) == 1 else motion.config.pair_worth)


def _features(motion: StandardisedInputs, chosen: Sequence[int]) -> Array:
    """Functions of each chosen variable, of all of them together, and of each with a slowly changing coefficient."""
    config, time = motion.config, len(motion.names) - 1
    parts = [bells(motion.values[:, index], config.bells) for index in chosen]
    if len(chosen) > 1:
        parts.append(random_features(motion.values[:, list(chosen)], 3 * config.bells * len(chosen),
                                     config.motion_scales[0], len(chosen)))
    if time in chosen:
        slow = motion.of_time(config.slow_waves)
        parts += [slow, *(motion.values[:, [index]] * slow for index in chosen if index != time)]
    return np.column_stack(parts)
