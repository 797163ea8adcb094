"""Width of the bands: the innovations as they are, against what the model thinks they are.

The model's standard deviation knows the noise of the initial window and what an unknown model of
its class would do. It does not know that another motion shows effects of another size. So every
output has a scale c^2, the recent mean of innovation^2 / variance, and the published standard
deviation is c times the model's:

    c_m^2 <- c_m^2 + (q - c_m^2) / m,      q = innovation^2 / variance

for a few memories m; m without end is the model's own scale, c = 1. They are mixed by their
evidence (:mod:`semiparam_ros.core.mixture`), which is forgotten fast: a short memory takes over
within a few samples of a change, a long one when all is calm. With a memory of m samples the
prediction is Student's t with 2 m - 1 degrees of freedom, whose variance is wider than c^2; that
factor is included.
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.compiled import Matrix, Vector, compiled
from semiparam_ros.core.filter_bank import FilterBank
from semiparam_ros.core.mixture import shares, weigh
from semiparam_ros.core.types import Array

MEMORIES = np.array([np.inf, 10.0, 30.0, 100.0, 500.0])
"""[samples]"""
SHARE_OF_OWN = 0.5
"""Probability of the model's own scale before anything is seen; the others share the rest."""
EVIDENCE_MEMORY = 100.0
"""[samples]"""
LARGEST_STEP = 100.0
"""Of q over c^2: one spike widens the band of the shortest memory by a factor of 3.3, not by its
own size."""
LEAST_SCALE = 1e-6
"""Of c^2: an output without any noise still has a band."""
LEAST_LOG_WEIGHT = -30.0

_RATE = 1.0 / MEMORIES
_WIDENING = 1.0 + 2.0 / (2.0 * MEMORIES - 3.0)


class BandCalibration(FilterBank):
    """The scales c^2 of every memory, (K, n), and their log weights."""

    def __init__(self, n_outputs: int) -> None:
        super().__init__('the calibration of the bands', len(MEMORIES), np.ones((2 * len(MEMORIES) + 1, n_outputs)),
                         SHARE_OF_OWN)
        mix(self.table, shares(self._log_weights))

    @property
    def factor(self) -> Array:
        """(n,) c, of the standard deviation of each output."""
        return self._mixture

    def learn(self, innovation: Array, std: Array) -> None:
        """Take in the innovation (n,) of a sample, and the standard deviation (n,) that the model
        gave it."""
        calibrate(innovation, std, self.table)

    def _possible(self, table: Array) -> bool:
        positive = (table[:len(MEMORIES)] >= LEAST_SCALE).all() and (table[-1] > 0.0).all()
        return super()._possible(table) and bool(positive)


@compiled
def mix(table: Matrix, weights: Matrix) -> None:
    """Factors of the scales."""
    memories, n = weights.shape
    for k in range(n):
        square = 0.0
        for m in range(memories):
            square += weights[m, k] * _WIDENING[m] * table[m, k]
        table[-1, k] = np.sqrt(square)


@compiled
def calibrate(innovation: Vector, std: Vector, table: Matrix) -> None:
    """See :meth:`BandCalibration.learn`."""
    memories, n = len(MEMORIES), len(innovation)
    scales, evidence = table[:memories], np.empty((memories, n))
    for k in range(n):
        standardised = innovation[k] / std[k]
        ratio = min(standardised * standardised, LARGEST_STEP * scales[:, k].max())
        for m in range(memories):
            wide = _WIDENING[m] * scales[m, k]
            evidence[m, k] = -0.5 * (np.log(wide) + ratio / wide)
            step = min(ratio, LARGEST_STEP * scales[m, k]) - scales[m, k]
            scales[m, k] = max(scales[m, k] + _RATE[m] * step, LEAST_SCALE)
    mix(table, weigh(table[memories:2 * memories], evidence, EVIDENCE_MEMORY, LEAST_LOG_WEIGHT))
