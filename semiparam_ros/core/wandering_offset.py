"""An offset of each output that wanders, at a pace that is found while samples come.

What a model leaves of a real robot's outputs stays alike for seconds: offsets wander, cables
settle, joints warm up. A forgetting factor follows that by forgetting inertias too. Here the model
forgets nothing, and what it leaves, r, is followed beside it by a few filters, one for each pace g,
of every output by itself:

    b_{t+1} = a (b_t + g (r_t - b_t)),      a = 1 - g / 50

the steady state of the Kalman filter of an offset that wanders and slowly returns to zero
(exponential smoothing). g = 0 is the model alone. The filters are mixed by their evidence
(:mod:`semiparam_ros.core.mixture`), with Student's t for the densities.

Only samples that are learnt are followed. While others go by, as in a contact, the offsets return to
zero; at rest they stay.
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.compiled import Matrix, Vector, compiled
from semiparam_ros.core.filter_bank import FilterBank
from semiparam_ros.core.mixture import shares, student, weigh
from semiparam_ros.core.types import Array

PACES = np.array([0.0, 0.003, 0.01, 0.03, 0.1])
"""g; a pace has a memory of 1 / g samples."""
DECAY = 1.0 - PACES / 50.0
SHARE_OF_NONE = 0.5
"""Probability of g = 0 before anything is seen; the others share the rest."""
EVIDENCE_MEMORY = 500.0
"""[samples]"""
LEAST_LOG_WEIGHT = -30.0
LARGEST_STEP = 6.0
"""[standard deviations] A spike moves an offset no further than this times the pace."""


class WanderingOffset(FilterBank):
    """The offsets b of every pace, (K, n), and their log weights; then their parts in the mean (K,
    n)."""

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
        return np.asarray(PACES @ shares(self._log_weights))

    def learn(self, residual: Array, std: Array) -> None:
        """Follow what the model left of a sample, (n,), whose predictive standard deviation was
        ``std`` (n,)."""
        follow(residual, std, self.table)

    def rest(self) -> None:
        """Let the offsets shrink at a sample that is not learnt."""
        self._values[:] *= DECAY[:, None]
        mix(self.table, shares(self._log_weights))

    def forget(self) -> None:
        """Begin at zero, where nobody knows how long ago the last sample was; the paces stay."""
        self._values[:] = 0.0
        mix(self.table, shares(self._log_weights))


@compiled
def mix(table: Matrix, weights: Matrix) -> None:
    """Parts and mean of the offsets."""
    paces, n = weights.shape
    for k in range(n):
        table[-1, k] = 0.0
        for g in range(paces):
            table[2 * paces + g, k] = weights[g, k] * table[g, k]
            table[-1, k] += table[2 * paces + g, k]


@compiled
def follow(residual: Vector, std: Vector, table: Matrix) -> None:
    """See :meth:`WanderingOffset.learn`."""
    paces, n = len(PACES), len(residual)
    offsets, evidence = table[:paces], np.empty((paces, n))
    for g in range(paces):
        for k in range(n):
            standardised = (residual[k] - offsets[g, k]) / std[k]
            evidence[g, k] = student(standardised)
            step = std[k] * min(max(standardised, -LARGEST_STEP), LARGEST_STEP)
            offsets[g, k] = DECAY[g] * (offsets[g, k] + PACES[g] * step)
    mix(table, weigh(table[paces:2 * paces], evidence, EVIDENCE_MEMORY, LEAST_LOG_WEIGHT))
