"""Name of a change, in types that load nothing else of a diagnosis: a node that is told one goes on answering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.effects import Effect

if TYPE_CHECKING:
    from semiparam_ros.diagnosis.evaluation import EvaluationFigures


@dataclass(frozen=True)
class Quantity:
    """A fitted number; ``std`` is None where it was searched rather than estimated."""

    value: float
    std: float | None
    unit: str


class Gain(NamedTuple):
    """By how much [nat] one model's log density of unseen blocks exceeds another's, and its standard error."""

    total: float
    error: float

    def exceeds(self, price: float, errors: float) -> bool:
        """Return whether it is more than a price [nat], and than so many of its standard errors."""
        return self.total > max(price, errors * self.error)


class ChangeRival(NamedTuple):
    """Another effect in place of the likeliest: by how much [nat] that one is better."""

    kind: str
    where: str | None
    behind: float


@dataclass(frozen=True, kw_only=True)
class NamedChange:
    """The likeliest effect, None where none is worth its price.

    :param gain: of log density of unseen blocks by it, and its standard error [nat].
    :param price: minus the log of its prior probability.
    :param rivals: the foremost others. :param parameters: its values.
    :param before: errors of the model before the change.
    :param without: of the model without the effect, after it. :param after: of the one with it.
    :param seconds: of motion that was looked at after it.
    :param inputs: how the samples were prepared, for the next one of the same robot, pickled: who keeps it need not
        load it.
    """

    effect: Effect | None
    gain: Gain
    price: float
    rivals: tuple[ChangeRival, ...]
    parameters: dict[str, Quantity]
    before: EvaluationFigures
    without: EvaluationFigures
    after: EvaluationFigures
    seconds: float
    inputs: bytes

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """(c,) values of the effect, and (c,) their standard deviations."""
        found = self.parameters.values()
        return (np.array([each.value for each in found]),
                np.array([each.std or 0.0 for each in found]))

    def as_dict(self) -> dict[str, object]:
        """For a record."""
        effect = self.effect
        named = effect and {
            'kind': effect.kind, 'where': effect.where, **effect.span.values,
            'sentence': effect.sentence,
            'parameters': {name: vars(quantity) for name, quantity in self.parameters.items()}}
        return {'effect': named, 'log_evidence_gain': self.gain.total,
                'log_evidence_error': self.gain.error, 'price': self.price,
                'rivals': [rival._asdict() for rival in self.rivals], 'before': self.before,
                'without': self.without, 'after': self.after, 'seconds_after': self.seconds}
