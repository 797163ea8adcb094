"""How likely declared effects are, by what comes: a model with them beside the same model without.

What a model leaves of a real robot drifts for seconds. The recursion takes it for white, so it is sure that a load
which begins late explains whatever drifts just then. Whether an effect is there is therefore uncertain as well (a spike
and slab prior; Mitchell and Beauchamp 1988). Both answers are averaged by their evidence, which is forgotten slowly
(Raftery, Karny and Ettler 2010), with Student's t for the densities of all outputs, so that a spike decides nothing:

    evidence <- 0.998 evidence + sum_k log (t_5(error / std) / std) with effects - the same without
    p = 1 / (1 + exp(-log 9 - evidence)),      answer = p (answer with effects) + (1 - p) (answer without)

Each of the two is followed by a wandering offset of its own. The model without effects costs no second recursion: their
columns stand last, so it is a corner of the same factor R.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from semiparam_ros.core.compiled import AVAILABLE, MATRIX, NUMBER, VECTOR, compiled
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.core.wandering_offset import WanderingOffset
from semiparam_ros.errors import SemiparamError

PRIOR_LOG_ODDS = float(np.log(9.0))
"""[nat] Whoever declares an effect has a reason."""
KEEP = 1.0 - 1.0 / 500.0
MOST_EVIDENCE = 10.0
"""[nat] Either way: what comes late is believed within a few samples."""
DEGREES = 5.0


class EffectDoubt:
    """The evidence (1,) [nat] for the effects, and the wandering offset of the model without them.

    :param wandering: whether the model has a wandering offset.
    """

    def __init__(self, n_outputs: int, wandering: bool) -> None:
        self.evidence = np.zeros(1)
        self.wandering = WanderingOffset(n_outputs) if wandering else None

    @property
    def probability(self) -> float:
        """That the effects are there."""
        return float(belief(self.evidence))

    def between(self, with_effects: Array, without: Array) -> Array:
        """The average of what the two say."""
        p = self.probability
        return np.asarray(p * with_effects + (1.0 - p) * without)

    def learn(self, errors: Array, std: Array) -> None:
        """Take in the errors (2, n) with and without effects, and the standard deviations (2, n) given to them."""
        if AVAILABLE:
            believe(np.ascontiguousarray(errors), np.ascontiguousarray(std), self.evidence)
        else:
            self._learn(errors, std)

    def _learn(self, errors: Array, std: Array) -> None:
        ratio = errors / std
        with_effects, without = (-np.log(std) - 0.5 * (DEGREES + 1.0) * np.log1p(ratio * ratio / DEGREES)).sum(axis=1)
        self.evidence[:] = np.clip(KEEP * self.evidence + with_effects - without, -MOST_EVIDENCE, MOST_EVIDENCE)

    def state(self) -> dict[str, Array]:
        """Copies; :meth:`restore` takes them back bit for bit."""
        without = {} if self.wandering is None else {'without_effects': self.wandering.table.copy()}
        return {'evidence_of_effects': self.evidence.copy(), **without}

    def restore(self, state: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, when it cannot be one."""
        evidence = np.array(state.get('evidence_of_effects', np.nan), dtype=float)
        if evidence.shape != (1,) or not abs(float(evidence[0])) <= MOST_EVIDENCE:
            raise SemiparamError(f'the saved evidence of the effects is {evidence.tolist()}; expected one number of at '
                                 f'most {MOST_EVIDENCE:g}.')
        if self.wandering is not None:
            self.wandering.restore({'table': np.asarray(state.get('without_effects', np.zeros(0)))})
        self.evidence[:] = evidence


@compiled(VECTOR, returns=NUMBER)
def belief(evidence: Array) -> float:
    """See :attr:`EffectDoubt.probability`."""
    return float(1.0 / (1.0 + np.exp(-PRIOR_LOG_ODDS - evidence[0])))


@compiled(MATRIX, MATRIX, VECTOR)
def believe(errors: Array, std: Array, evidence: Array) -> None:
    """See :meth:`EffectDoubt.learn`."""
    gain = 0.0
    for k in range(errors.shape[1]):
        for side in range(2):
            ratio = errors[side, k] / std[side, k]
            doubt = np.log(std[side, k]) + 0.5 * (DEGREES + 1.0) * np.log1p(ratio * ratio / DEGREES)
            gain += doubt if side else -doubt
    evidence[0] = min(max(KEEP * evidence[0] + gain, -MOST_EVIDENCE), MOST_EVIDENCE)
