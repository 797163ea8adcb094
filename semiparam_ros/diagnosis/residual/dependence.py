"""Which variables does the structure in a residual depend on? Forward selection, judged on unseen blocks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.config import DiagnosisConfig
from semiparam_ros.diagnosis.residual.flexible import StandardisedInputs, bells, predictions, random_features


class Dependence(NamedTuple):
    """A variable (q_, dq_, ddq_ and a joint, or time) and the share of the residual that it adds to those before it."""

    name: str
    share: float


def dependences(motion: StandardisedInputs, targets: Array, within_reach: float) -> tuple[Dependence, ...]:
    """Variables of which a smooth function predicts targets (M, k), the most telling first.

    :param within_reach: share of the targets that a function of all variables predicts.
    """
    config = motion.config
    rows = slice(None, None, max(-(-len(targets) // config.dependence_samples), 1))
    search = _Search(motion.names, motion.values[rows], targets[rows], config)
    chosen: list[int] = []
    found: list[Dependence] = []
    reached = 0.0
    while len(chosen) < config.most_variables:
        best, share = search.best([(index,) for index in range(len(motion.names)) if index not in chosen], chosen)
        if not chosen and share < config.weak_single * within_reach:
            # A product of two variables with means of zero shows in neither of them.
            best, share = search.best([*combinations(range(len(motion.names)), 2), best], chosen)
        if share - reached < max(config.variable_share, config.variable_part * reached):
            break
        chosen += best
        found += [Dependence(motion.names[index], (share - reached) / len(best)) for index in best]
        reached = share
    return tuple(found)


class _Search:
    """Shares of targets (M, k) that sets of variables predict."""

    def __init__(self, names: tuple[str, ...], values: Array, targets: Array, config: DiagnosisConfig) -> None:
        self.names, self.values, self.targets, self.config = names, values, targets, config
        self.power = float(np.sum(targets**2)) + 1e-300

    def best(self, candidates: Sequence[tuple[int, ...]], chosen: list[int]) -> tuple[tuple[int, ...], float]:
        """The candidate that, added to those chosen, predicts most, and what all of them predict."""
        shares = {added: self.share([*chosen, *added]) for added in candidates}
        best = max(shares, key=lambda added: shares[added] * self.plainness(added))
        return best, shares[best]

    def share(self, variables: list[int]) -> float:
        """Share of the squared targets that these variables predict on unseen blocks."""
        found = predictions(_features(self.values, variables, self.config), self.targets, self.config)
        return 1.0 - float(np.sum((self.targets - found) ** 2)) / self.power

    def plainness(self, added: tuple[int, ...]) -> float:
        """Among near equals a position is preferred to a velocity, and that to an acceleration, which noise spoils."""
        order = [('q', 'time', 'dq', 'ddq').index(self.names[index].split('_')[0]) for index in added]
        return (1.0 - self.config.plainer_share * sum(order)) / (1.0 if len(added) == 1 else self.config.pair_worth)


def _features(values: Array, chosen: Sequence[int], config: DiagnosisConfig) -> Array:
    """Functions of each chosen variable, and of all of them together."""
    parts = [bells(values[:, index], config.bells) for index in chosen]
    if len(chosen) > 1:
        parts.append(random_features(values[:, list(chosen)], config.dependence_features,
                                     config.motion_scales[0], len(chosen)))
    time = values.shape[1] - 1
    if time in chosen:
        moving = [bells(values[:, index], config.bells) for index in chosen if index != time]
        angles = np.pi * 0.8 * np.outer(values[:, time], np.arange(1, config.slow_waves + 1))
        slow = np.column_stack([values[:, time], np.cos(angles), np.sin(angles)])
        parts += [slow, *((each[:, :1] * slow) for each in moving)]
    return np.column_stack(parts)
