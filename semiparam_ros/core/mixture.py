"""Hypotheses mixed by their evidence, which is forgotten slowly.

Dynamic model averaging (Raftery, Karny and Ettler 2010). For every output k by itself, hypothesis h
has a log weight l_hk and a weight w_hk, which follow the log density log p_h(y_k) of each sample:

    l_hk <- (1 - 1 / memory) l_hk + log p_h(y_k),  less the largest over h,  no less than ``least``
    w_hk  = exp(l_hk) / sum_h exp(l_hk)

The floor lets a hypothesis that was poor for long take over within a few samples of a change.
Densities are Student's t where a spike must decide nothing.
"""

from __future__ import annotations

from math import log1p

import numpy as np

from semiparam_ros.core.compiled import Matrix, compiled

DEGREES = 5.0
"""Of freedom of Student's t."""


@compiled
def student(standardised: float) -> float:
    """Log density of Student's t, up to a constant."""
    return -0.5 * (DEGREES + 1.0) * log1p(standardised * standardised / DEGREES)


@compiled
def shares(log_weights: Matrix) -> Matrix:
    """(H, n) weights, one in sum over the hypotheses."""
    weights = np.exp(log_weights)
    for k in range(weights.shape[1]):
        weights[:, k] /= weights[:, k].sum()
    return weights


@compiled
def weigh(log_weights: Matrix, evidence: Matrix, memory: float, least: float) -> Matrix:
    """Let the log weights (H, n) take in a sample, by the log densities (H, n) that the hypotheses
    gave it; the weights (H, n).

    :param memory: of the evidence, in samples.
    """
    count, n = evidence.shape
    for k in range(n):
        best = -np.inf
        for h in range(count):
            log_weights[h, k] = (1.0 - 1.0 / memory) * log_weights[h, k] + evidence[h, k]
            best = max(best, log_weights[h, k])
        for h in range(count):
            log_weights[h, k] = max(log_weights[h, k] - best, least)
    return shares(log_weights)
