"""Causes that follow the temperature of a joint or of the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import HiddenCause, Site, TrueValue
from semiparam_ros.simulation.causes.friction import JointTorque
from semiparam_ros.simulation.causes.sensor import Bias
from semiparam_ros.simulation.trajectory import Instants
from semiparam_ros.simulation.world import World


def at_start(world: World, number: int) -> float:
    """Temperature of one part at the start of the recording [deg C]."""
    assert world.temperature is not None
    return float(world.temperature(np.zeros(1))[0, number])


def warmer(world: World, time: Array, number: int) -> Array:
    """Temperature (N,) of one part over that at the start of the recording [K]."""
    assert world.temperature is not None
    return np.asarray(world.temperature(time)[:, number] - at_start(world, number))


@dataclass(frozen=True)
class HiddenTemperatureFriction(JointTorque):
    """Oil that thins as it warms: torque = b (1 + c dT) dq, at the end 0.4 to 0.7 less than at the start."""

    kind = 'temperature_friction'
    can_start = False
    by_temperature = True
    change: float
    reference_c: float

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        world = site.world
        change = -float(site.rng.uniform(0.4, 0.7)) / float(np.abs(warmer(world, world.times, joint)).max())
        return change, at_start(world, joint)

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        thinner = 1.0 + self.change * warmer(world, motion.time, self.joint)
        return np.asarray(thinner * motion.velocity[:, self.joint])

    def parameters(self, magnitude: float) -> dict[str, TrueValue]:
        return {'viscous': TrueValue(magnitude, 'N m s/rad'),
                'viscous_per_kelvin': TrueValue(self.change * magnitude, 'N m s/(rad K)'),
                'reference_c': TrueValue(self.reference_c, 'deg C')}


@dataclass(frozen=True)
class HiddenTemperatureDrift(Bias):
    """The strain gauges' bias follows the sensor's temperature."""

    kind = 'temperature_drift'
    quantity, beside = ('drift', 'N/K, N m/K'), {'reference_c': 'deg C'}
    can_start = False
    by_temperature = True
    typical = 0.01
    reference_c: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(None, None, cls.random_direction(site), at_start(site.world, 0))

    def course(self, world: World) -> Array:
        return warmer(world, world.times, 0)[:, None]
