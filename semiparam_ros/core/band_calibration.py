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

from collections.abc import Mapping

import numpy as np

from semiparam_ros.core.compiled import AVAILABLE, MATRIX, VECTOR, compiled
from semiparam_ros.core.types import Array
from semiparam_ros.core.wandering_offset import like
from semiparam_ros.errors import SemiparamError

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


class BandCalibration:
    """The scales c^2 of every memory, (K, n), and their log weights."""

    def __init__(self, n_outputs: int) -> None:
        shares = np.full((len(MEMORIES), 1), (1.0 - SHARE_OF_OWN) / (len(MEMORIES) - 1))
        shares[0] = SHARE_OF_OWN
        self.table: Array = np.ones((2 * len(MEMORIES) + 1, n_outputs))
        """All of it, one below the other: scales, log weights and :attr:`factor`."""
        self._log_weights[:] = np.log(shares)
        self._mix()

    @property
    def factor(self) -> Array:
        """(n,) c, of the standard deviation of each output."""
        factor: Array = self.table[-1]
        return factor

    @property
    def _scales(self) -> Array:
        return self.table[:len(MEMORIES)]

    @property
    def _log_weights(self) -> Array:
        return self.table[len(MEMORIES):-1]

    def learn(self, innovation: Array, std: Array) -> None:
        """Take in the innovation (n,) of a sample, and the standard deviation (n,) that the model gave it."""
        if AVAILABLE:
            calibrate(innovation, std, self.table)
        else:
            self._learn(innovation, std)

    def _learn(self, innovation: Array, std: Array) -> None:
        standardised = innovation / std
        ratio = np.minimum(standardised * standardised, LARGEST_STEP * self._scales.max(axis=0))
        wide = _WIDENING * self._scales
        log_weights = _KEEP * self._log_weights - 0.5 * (np.log(wide) + ratio / wide)
        log_weights -= log_weights.max(axis=0)
        self._log_weights[:] = np.maximum(log_weights, LEAST_LOG_WEIGHT)
        step = np.minimum(ratio, LARGEST_STEP * self._scales) - self._scales
        self._scales[:] = np.maximum(self._scales + _RATE * step, LEAST_SCALE)
        self._mix()

    def state(self) -> dict[str, Array]:
        """A copy; :meth:`restore` takes it back bit for bit."""
        return {'table': self.table.copy()}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, for another size."""
        table = like(self.table, state.get('table'), 'the calibration of the bands')
        if (table[:len(MEMORIES)] < LEAST_SCALE).any() or (table[-1] <= 0.0).any():
            raise SemiparamError('the saved calibration of the bands has scales that are not positive.')
        self.table[:] = table

    def _mix(self) -> None:
        weights = np.exp(self._log_weights)
        self.factor[:] = np.sqrt((weights * _WIDENING * self._scales).sum(axis=0) / weights.sum(axis=0))


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
