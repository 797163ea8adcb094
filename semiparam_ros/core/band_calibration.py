"""How wide the bands must be: the innovations as they are, against what the model thinks they are.

The model's standard deviation knows the noise of the initial window and what an unknown model of its class would do.
It does not know that another motion shows effects of another size. So every output has a scale c^2, the recent mean
of innovation^2 / variance, and the published standard deviation is c times the model's:

    c_m^2 <- c_m^2 + (q - c_m^2) / m,      q = innovation^2 / variance

for a few memories m; m without end is the model's own scale, c = 1. They are mixed by their evidence, which is
forgotten fast: a short memory takes over within a few samples of a change, a long one when all is calm. With a memory
of m samples the prediction is Student's t with 2 m - 1 degrees of freedom, whose variance is wider than c^2; that
factor is included.
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.compiled import AVAILABLE, MATRIX, VECTOR, compiled
from semiparam_ros.core.filter_bank import FilterBank
from semiparam_ros.core.types import Array

MEMORIES = np.array([[np.inf], [10.0], [30.0], [100.0], [500.0]])
"""[samples]"""
SHARE_OF_OWN = 0.5
"""Probability of the model's own scale before anything is seen; the others share the rest."""
EVIDENCE_MEMORY = 100.0
"""[samples]"""
LARGEST_STEP = 100.0
"""Of q over c^2: one spike widens the band of the shortest memory by a factor of 3.3, not by its own size."""
LEAST_SCALE = 1e-6
"""Of c^2: an output without any noise still has a band."""
LEAST_LOG_WEIGHT = -30.0

_RATE = 1.0 / MEMORIES
_WIDENING = 1.0 + 2.0 / (2.0 * MEMORIES - 3.0)
_KEEP = 1.0 - 1.0 / EVIDENCE_MEMORY


class BandCalibration(FilterBank):
    """The scales c^2 of every memory, (K, n), and their log weights."""

    def __init__(self, n_outputs: int) -> None:
        super().__init__('the calibration of the bands', len(MEMORIES), np.ones((2 * len(MEMORIES) + 1, n_outputs)),
                         SHARE_OF_OWN)
        self._mix()

    @property
    def factor(self) -> Array:
        """(n,) c, of the standard deviation of each output."""
        return self._mixture

    def learn(self, innovation: Array, std: Array) -> None:
        """Take in the innovation (n,) of a sample, and the standard deviation (n,) that the model gave it."""
        if AVAILABLE:
            calibrate(innovation, std, self.table)
        else:
            self._learn(innovation, std)

    def _learn(self, innovation: Array, std: Array) -> None:
        standardised = innovation / std
        ratio = np.minimum(standardised * standardised, LARGEST_STEP * self._values.max(axis=0))
        wide = _WIDENING * self._values
        log_weights = _KEEP * self._log_weights - 0.5 * (np.log(wide) + ratio / wide)
        log_weights -= log_weights.max(axis=0)
        self._log_weights[:] = np.maximum(log_weights, LEAST_LOG_WEIGHT)
        step = np.minimum(ratio, LARGEST_STEP * self._values) - self._values
        self._values[:] = np.maximum(self._values + _RATE * step, LEAST_SCALE)
        self._mix()

    def _possible(self, table: Array) -> bool:
        positive = (table[:len(MEMORIES)] >= LEAST_SCALE).all() and (table[-1] > 0.0).all()
        return super()._possible(table) and bool(positive)

    def _mix(self) -> None:
        weights = np.exp(self._log_weights)
        self.factor[:] = np.sqrt((weights * _WIDENING * self._values).sum(axis=0) / weights.sum(axis=0))


@compiled(VECTOR, VECTOR, MATRIX)
def calibrate(innovation: Array, std: Array, table: Array) -> None:
    """See :meth:`BandCalibration.learn`."""
    memories = len(MEMORIES)
    scales, log_weights, factor = table[:memories], table[memories:2 * memories], table[-1]
    for k in range(len(innovation)):
        standardised = innovation[k] / std[k]
        ratio = min(standardised * standardised, LARGEST_STEP * scales[:, k].max())
        for m in range(len(scales)):
            wide = _WIDENING[m, 0] * scales[m, k]
            log_weights[m, k] = _KEEP * log_weights[m, k] - 0.5 * (np.log(wide) + ratio / wide)
        best = log_weights[:, k].max()
        total = weighted = 0.0
        for m in range(len(scales)):
            log_weights[m, k] = max(log_weights[m, k] - best, LEAST_LOG_WEIGHT)
            step = min(ratio, LARGEST_STEP * scales[m, k]) - scales[m, k]
            scales[m, k] = max(scales[m, k] + _RATE[m, 0] * step, LEAST_SCALE)
            weight = np.exp(log_weights[m, k])
            total += weight
            weighted += weight * _WIDENING[m, 0] * scales[m, k]
        factor[k] = np.sqrt(weighted / total)
