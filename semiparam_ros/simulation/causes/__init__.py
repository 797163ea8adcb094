"""Every hidden cause that the simulator knows, by the kind's name."""

from __future__ import annotations

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.causes.base import Cause, Quantity, Site
from semiparam_ros.simulation.causes.cables import CableHysteresis, CableSpring
from semiparam_ros.simulation.causes.drive import (
    Backlash,
    EffortGain,
    EffortOffset,
    JointSpring,
    RotorInertia,
    TransmissionRipple,
)
from semiparam_ros.simulation.causes.forces import (
    ExternalForce,
    Payload,
    PeriodicDisturbance,
    QuadraticDrag,
    ViscousDrag,
)
from semiparam_ros.simulation.causes.friction import (
    AsymmetricFriction,
    CoulombFriction,
    LoadFriction,
    StribeckFriction,
    ViscousFriction,
)
from semiparam_ros.simulation.causes.geometry import GravityTilt, JointOffset, TimeDelay
from semiparam_ros.simulation.causes.sensor import (
    SensorCrosstalk,
    SensorDrift,
    SensorGain,
    SensorMisalignment,
    SensorOffset,
    ThermalDrift,
)
from semiparam_ros.simulation.causes.temperature import TemperatureDrift, TemperatureFriction
from semiparam_ros.simulation.causes.unlisted import Bump, DriftingFriction, TwoMassFlexibility

__all__ = ['CAUSES', 'LISTED_KINDS', 'UNLISTED_KINDS', 'Cause', 'Quantity', 'Site', 'cause_of', 'kinds']

_LISTED: tuple[type[Cause], ...] = (
    Payload, SensorOffset, SensorDrift, ThermalDrift, SensorGain, SensorCrosstalk, SensorMisalignment, TimeDelay,
    JointOffset, GravityTilt, ExternalForce, ViscousDrag, QuadraticDrag, CableSpring, CableHysteresis,
    PeriodicDisturbance, ViscousFriction, CoulombFriction, StribeckFriction, AsymmetricFriction, LoadFriction,
    RotorInertia, JointSpring, EffortOffset, EffortGain, TransmissionRipple, Backlash, TemperatureDrift,
    TemperatureFriction)
_UNLISTED: tuple[type[Cause], ...] = (Bump, DriftingFriction, TwoMassFlexibility)

LISTED_KINDS = tuple(cause.kind for cause in _LISTED)
UNLISTED_KINDS = tuple(cause.kind for cause in _UNLISTED)
CAUSES: dict[str, type[Cause]] = {cause.kind: cause for cause in (*_LISTED, *_UNLISTED)}


def kinds(outputs: str) -> tuple[str, ...]:
    """The kinds that can be simulated for ``wrench`` or ``effort``."""
    return tuple(kind for kind, cause in CAUSES.items() if outputs in cause.acts_on)


def cause_of(kind: str, outputs: str) -> type[Cause]:
    """The class of a kind; an unknown one, or one that does not act on these outputs, raises SemiparamError."""
    if kind not in CAUSES:
        raise SemiparamError(f"there is no effect '{kind}' to simulate; expected one of {', '.join(kinds(outputs))}.")
    if outputs not in CAUSES[kind].acts_on:
        raise SemiparamError(f"effect '{kind}' does not act on {outputs}; expected one of {', '.join(kinds(outputs))}.")
    return CAUSES[kind]
