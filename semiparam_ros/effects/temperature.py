"""Effects of a measured temperature: friction that falls as a gearbox warms, a sensor whose bias
moves.

Both act by T - T0. T0 is ``reference_c``, which a diagnosis sets to the first temperature of its
recording; a fixed number, so that it is the same after a restart and in every other recording.
Where T is not known it counts as T0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.effects.base import Axis, Coefficient, Effect, Values, joint_index, on_joint
from semiparam_ros.effects.friction import JointEffect, ViscousFriction
from semiparam_ros.effects.sensor import N_CHANNELS, ChannelEffect

REFERENCE_C = 25.0
"""Reference T0 [deg C] where none is given."""
LEAST_CHANGE_K = 1.0
"""Change of a temperature [K] over a recording below which no search asks what follows it."""


def temperature_of(body: RigidBody, samples: Samples, where: str | None) -> Array:
    """Temperature (N,) [deg C] of a joint, or of a wrench's sensor; NaN where not known."""
    if not samples.temperature.shape[1]:
        return np.full(len(samples), np.nan)
    return samples.temperature[:, 0 if where is None else joint_index(body, where)]


class _ByTemperature(Effect):
    """Effect that depends on how far a temperature is from its reference."""

    option_names: ClassVar[tuple[str, ...]] = ('reference_c',)

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None, residual: Array) -> Sequence[Values]:
        temperature = temperature_of(body, samples, where)
        known = temperature[~np.isnan(temperature)]
        if not len(known) or np.ptp(known) < LEAST_CHANGE_K:
            return ()
        return ({'reference_c': float(known[0])},)

    def above(self, body: RigidBody, samples: Samples) -> Array:
        """Temperature (N,) over its reference, T - T0 [K]; 0 where T is not known."""
        above = temperature_of(body, samples, self.where) - self.value('reference_c', REFERENCE_C)
        return np.where(np.isnan(above), 0.0, above)


class TemperatureFriction(_ByTemperature, JointEffect):
    """Viscous friction in proportion to b + c (T - `reference_c`): the oil of a gearbox thins as it warms."""

    kind: ClassVar[str] = 'temperature_friction'
    shows_against: ClassVar[Axis] = 'velocity'
    sentence: ClassVar[str] = "the joint's viscous friction changes with its temperature"
    mistaken_for: ClassVar[tuple[str, ...]] = ('viscous_friction', 'asymmetric_friction')
    separated_by: ClassVar[str] = 'the same motion with the joint cold and warm'
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('viscous', 'N m s/rad'),
                                                Coefficient('viscous_per_kelvin', 'N m s/(rad K)'))

    def physical(self, coefficients: Array) -> bool:
        """Tell whether the friction resists at the reference temperature."""
        return bool(coefficients[0] > 0.0)

    def plainer(self) -> tuple[Effect, ...]:
        return (ViscousFriction(self.where, span=self.span),)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        velocity = samples.velocity[:, joint_index(body, self.where)]
        return on_joint(body, self.where, np.column_stack([velocity, velocity * self.above(body, samples)])), None


class TemperatureDrift(_ByTemperature, ChannelEffect):
    """A bias in proportion to the sensor's measured temperature."""

    kind: ClassVar[str] = 'temperature_drift'
    shows_against: ClassVar[Axis] = 'temperature'
    sentence: ClassVar[str] = "the sensor's bias follows its temperature"
    mistaken_for: ClassVar[tuple[str, ...]] = ('thermal_drift', 'sensor_drift')
    separated_by: ClassVar[str] = 'warming and cooling in one recording: what depends on time alone does not come back'
    per: ClassVar[str] = 'K'

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        return self.above(body, samples)[:, None, None] * np.eye(N_CHANNELS), None
