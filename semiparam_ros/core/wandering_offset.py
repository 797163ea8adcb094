"""An offset of each output that wanders, at a pace that is found while samples come.

What a model leaves of a real robot's outputs stays alike for seconds: offsets wander, cables settle, joints warm up. A
forgetting factor follows that by forgetting inertias too. Here the model forgets nothing, and what it leaves, r, is
followed beside it by a few filters, one for each pace g, of every output by itself:

    b_{t+1} = a (b_t + g (r_t - b_t)),      a = 1 - g / 50

the steady state of the Kalman filter of an offset that wanders and slowly returns to zero (exponential smoothing).
g = 0 is the model alone. The filters are mixed by their evidence, which is forgotten slowly (dynamic model averaging;
Raftery, Karny and Ettler 2010), with Student's t for the densities, so that a spike decides nothing.

Only samples that are learnt are followed. While others go by, as in a contact or at rest, the offsets return to zero.
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.compiled import AVAILABLE, MATRIX, VECTOR, compiled
from semiparam_ros.core.filter_bank import FilterBank
from semiparam_ros.core.types import Array

PACES = np.array([[0.0], [0.003], [0.01], [0.03], [0.1]])
"""g; a pace has a memory of 1 / g samples."""
DECAY = 1.0 - PACES / 50.0
SHARE_OF_NONE = 0.5
"""Probability of g = 0 before anything is seen; the others share the rest."""
EVIDENCE_MEMORY = 500.0
"""[samples]"""
_KEEP = 1.0 - 1.0 / EVIDENCE_MEMORY
DEGREES = 5.0
LEAST_LOG_WEIGHT = -30.0
LARGEST_STEP = 6.0
"""[standard deviations] A spike moves an offset no further than this times the pace."""


class WanderingOffset(FilterBank):
    """The offsets b of every pace, (K, n), and their log weights."""

    def __init__(self, n_outputs: int) -> None:
        super().__init__('the wandering offset', len(PACES), np.zeros((3 * len(PACES) + 1, n_outputs)), SHARE_OF_NONE)

    @property
    def parts(self) -> Array:
        """(K, n) what each pace adds to the next prediction."""
        return self.table[2 * len(PACES):-1]

    @property
    def offset(self) -> Array:
        """(n,) all of them together."""
        return self._mixture

    def pace(self) -> Array:
        """(n,) the mean pace of each output; its inverse is the memory [samples]."""
        weights = np.exp(self._log_weights)
        return np.asarray((weights * PACES).sum(axis=0) / weights.sum(axis=0))

    def learn(self, residual: Array, std: Array) -> None:
        """Follow what the model left of a sample, (n,), whose predictive standard deviation was ``std`` (n,)."""
        if AVAILABLE:
            follow(residual, std, self.table)
        else:
            self._learn(residual, std)

    def _learn(self, residual: Array, std: Array) -> None:
        standardised = (residual - self._values) / std
        log_weights = _KEEP * self._log_weights
        log_weights -= 0.5 * (DEGREES + 1.0) * np.log1p(standardised * standardised / DEGREES)
        log_weights -= log_weights.max(axis=0)
        self._log_weights[:] = np.maximum(log_weights, LEAST_LOG_WEIGHT)
        step = std * np.minimum(np.maximum(standardised, -LARGEST_STEP), LARGEST_STEP)
        self._values[:] = DECAY * (self._values + PACES * step)
        self._mix()

    def rest(self) -> None:
        """A sample went by that is not learnt."""
        self._values[:] *= DECAY
        self._mix()

    def forget(self) -> None:
        """Nobody knows how long ago the last sample was: the offsets are those of no moment; their paces stay."""
        self._values[:] = 0.0
        self._mix()

    def _mix(self) -> None:
        weights = np.exp(self._log_weights)
        self.parts[:] = weights / weights.sum(axis=0) * self._values
        self.offset[:] = self.parts.sum(axis=0)


@compiled(VECTOR, VECTOR, MATRIX)
def follow(residual: Array, std: Array, table: Array) -> None:
    """See :meth:`WanderingOffset.learn`."""
    paces = len(PACES)
    offsets, log_weights, parts, offset = table[:paces], table[paces:2 * paces], table[2 * paces:3 * paces], table[-1]
    for k in range(len(residual)):
        for g in range(len(offsets)):
            standardised = (residual[k] - offsets[g, k]) / std[k]
            spread = np.log1p(standardised * standardised / DEGREES)
            log_weights[g, k] = _KEEP * log_weights[g, k] - 0.5 * (DEGREES + 1.0) * spread
            step = std[k] * min(max(standardised, -LARGEST_STEP), LARGEST_STEP)
            offsets[g, k] = DECAY[g, 0] * (offsets[g, k] + PACES[g, 0] * step)
        best = log_weights[:, k].max()
        total = 0.0
        for g in range(len(offsets)):
            log_weights[g, k] = max(log_weights[g, k] - best, LEAST_LOG_WEIGHT)
            parts[g, k] = np.exp(log_weights[g, k])
            total += parts[g, k]
        offset[k] = 0.0
        for g in range(len(offsets)):
            parts[g, k] *= offsets[g, k] / total
            offset[k] += parts[g, k]
