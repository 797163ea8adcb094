"""Contact is not dynamics: which samples are too implausible to be learnt."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from semiparam_ros.core.estimator import Prediction
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.settings.parameter_table import Table


class GateState(NamedTuple):
    """A gate as it stands; times in ns."""

    closed: bool
    refused: int
    closed_since: int
    calm_since: int | None
    armed: bool


class ContactGate:
    """A gate on the standardised innovation, with hysteresis.

    It closes when the innovation exceeds ``gate.threshold``, and opens when it has stayed below ``gate.release`` for
    ``gate.hold`` seconds. A gate closed for longer than ``gate.timeout`` opens too, for a robot that is touched is let
    go again: the model must follow a robot that has changed. It closes anew only after the innovation was small once.
    """

    def __init__(self) -> None:
        self.closed = False
        self.refused = 0
        self._closed_since = 0
        self._calm_since: int | None = None
        self._armed = True

    def judge(self, stamp: int, innovation: float, settings: Table) -> bool:
        """True when the sample of ``stamp`` [ns] must not be learnt.

        :param innovation: see :func:`standardised_innovation`.
        """
        if not settings.gate_enabled:
            self.reset()
            return False
        calm = innovation <= settings.gate_release
        self._armed = self._armed or calm
        if self.closed:
            self._perhaps_open(stamp, calm, settings)
        elif self._armed and innovation > settings.gate_threshold:
            self.closed, self._closed_since, self._calm_since = True, stamp, None
        self.refused += self.closed
        return self.closed

    def reset(self) -> None:
        """Open it, as after a jump of the clock; the count stays."""
        self.closed, self._calm_since, self._armed = False, None, True

    def state(self) -> GateState:
        """For a file; :meth:`restore` takes it back."""
        return GateState(self.closed, self.refused, self._closed_since, self._calm_since, self._armed)

    def restore(self, state: GateState) -> None:
        """Go on as the gate that was saved."""
        self.closed, self.refused, self._closed_since, self._calm_since, self._armed = state

    def _perhaps_open(self, stamp: int, calm: bool, settings: Table) -> None:
        self._calm_since = (stamp if self._calm_since is None else self._calm_since) if calm else None
        if self._calm_since is not None and stamp - self._calm_since >= settings.gate_hold * NANOSECONDS:
            self.closed = False
        elif settings.gate_timeout and stamp - self._closed_since > settings.gate_timeout * NANOSECONDS:
            self.closed = self._armed = False


def standardised_innovation(prediction: Prediction) -> float:
    """Root mean square over the outputs of (y - mean) / std; 0 while the model is provisional."""
    if not prediction.ready:
        return 0.0
    ratio = (prediction.sample.outputs - prediction.mean) / prediction.std
    return sqrt(float(ratio @ ratio) / len(ratio))
