"""Causes that the simulator can hide, by their kind.

A class has the kind of the effect in ``semiparam_ros.effects`` that a diagnosis should find for it, seen from the
world's side.
"""

from __future__ import annotations

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.causes import cables, drive, forces, friction, geometry, sensor, temperature, unlisted
from semiparam_ros.simulation.causes.base import HiddenCause, Site, TrueValue

__all__ = ['CAUSES', 'LISTED_KINDS', 'UNLISTED_KINDS', 'HiddenCause', 'Site', 'TrueValue', 'cause_of', 'kinds']

_LISTED: tuple[type[HiddenCause], ...] = (
    forces.HiddenPayload, sensor.HiddenSensorOffset, sensor.HiddenSensorDrift,
    sensor.HiddenThermalDrift, sensor.HiddenSensorGain, sensor.HiddenSensorCrosstalk,
    sensor.HiddenSensorMisalignment, geometry.HiddenTimeDelay, geometry.HiddenJointOffset,
    geometry.HiddenGravityTilt, forces.HiddenExternalForce, forces.HiddenViscousDrag,
    forces.HiddenQuadraticDrag, cables.HiddenCableSpring, cables.HiddenCableHysteresis,
    forces.HiddenPeriodicDisturbance, friction.HiddenViscousFriction,
    friction.HiddenCoulombFriction, friction.HiddenStribeckFriction,
    friction.HiddenAsymmetricFriction, friction.HiddenLoadFriction, drive.HiddenRotorInertia,
    drive.HiddenJointSpring, drive.HiddenEffortOffset, drive.HiddenEffortGain,
    drive.HiddenTransmissionRipple, drive.HiddenBacklash, temperature.HiddenTemperatureDrift,
    temperature.HiddenTemperatureFriction)
_UNLISTED: tuple[type[HiddenCause], ...] = (unlisted.Bump, unlisted.DriftingFriction, unlisted.TwoMassFlexibility)

LISTED_KINDS = tuple(cause.kind for cause in _LISTED)
UNLISTED_KINDS = tuple(cause.kind for cause in _UNLISTED)
CAUSES: dict[str, type[HiddenCause]] = {cause.kind: cause for cause in (*_LISTED, *_UNLISTED)}


def kinds(outputs: str) -> tuple[str, ...]:
    """The kinds that can be simulated for ``wrench`` or ``effort``."""
    return tuple(kind for kind, cause in CAUSES.items() if outputs in cause.acts_on)


def cause_of(kind: str, outputs: str) -> type[HiddenCause]:
    """The class of a kind; an unknown one, or one that does not act on these outputs, raises SemiparamError."""
    if kind not in CAUSES:
        raise SemiparamError(f"there is no effect '{kind}' to simulate; expected one of {', '.join(kinds(outputs))}.")
    if outputs not in CAUSES[kind].acts_on:
        raise SemiparamError(f"effect '{kind}' does not act on {outputs}; expected one of {', '.join(kinds(outputs))}.")
    return CAUSES[kind]
