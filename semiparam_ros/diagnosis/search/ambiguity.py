"""Ambiguity: takes one of several effects that explain the same about as well, and reports the others as rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.residual.noise import correlation_times
from semiparam_ros.diagnosis.search.scoring import Trial, overlap


class Rival(NamedTuple):
    """An effect that explains the same about as well; ``odds`` are against the one chosen."""

    kind: str
    where: str | None
    odds: float


def simplest(fit: Fit, ranking: list[Trial], order: Sequence[str]) -> Trial:
    """Of the trials that explain what the best does about as well, the one that spends the fewest parameters.

    Of several that spend as few and differ by no more than chance, the kind that comes first in ``order``. Evidence has
    charged for parameters already: what it says with odds of ``better_odds`` counts more than how few they are.
    """
    chance = math.log(fit.config.better_odds)
    alike = [ranking[0], *as_good(fit, ranking[0], ranking, chance)]
    fewest = min(trial.n_parameters for trial in alike)
    cheap = [trial for trial in alike if trial.n_parameters == fewest]
    most = max(trial.evidence for trial in cheap)
    return min((trial for trial in cheap if trial.evidence > most - chance),
               key=lambda trial: (order.index(trial.effect.kind), -trial.evidence))


def tolerance(fit: Fit, chosen: Trial, chance: float | None = None) -> float:
    """Difference of evidence [nat] below which two trials are not told apart.

    What stays correlated after the chosen effect shows that no trial is the whole truth, and widens it; where nothing
    does, they may differ by chance alone.

    :param chance: how much that may be, ``rival_nats`` unless given.
    """
    config = fit.config
    correlated = float(correlation_times(fit.used(chosen.residual), config).mean()) - 1.0
    return max(config.rival_nats if chance is None else chance,
               min(config.rival_share * correlated, config.most_rival_share) * chosen.evidence)


def as_good(fit: Fit, chosen: Trial, ranking: Sequence[Trial], chance: float | None = None) -> list[Trial]:
    """The other trials that explain the same thing about as well as the chosen one, ``chance`` as in tolerance."""
    within = tolerance(fit, chosen, chance)
    return [trial for trial in ranking if trial is not chosen and chosen.evidence - trial.evidence < within
            and overlap(fit, chosen, trial) > fit.config.rival_overlap]


def rivals_of(fit: Fit, chosen: Trial, ranking: Sequence[Trial]) -> tuple[Rival, ...]:
    """Those as good as the chosen one; odds from the evidence, tempered so that the tolerance is ``rival_nats``."""
    most = fit.config.rival_nats
    temper = most / tolerance(fit, chosen)
    return tuple(Rival(trial.effect.kind, trial.effect.where,
                       float(np.exp(np.clip(temper * (trial.evidence - chosen.evidence), -most, most))))
                 for trial in as_good(fit, chosen, ranking))
