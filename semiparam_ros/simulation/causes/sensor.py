"""Faults of the force/torque sensor itself, applied to its reading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import Cause, Quantity, Site, since
from semiparam_ros.simulation.trajectory import Instants, unit_vector
from semiparam_ros.simulation.world import World


@dataclass(frozen=True)
class Bias(Cause):
    """A wrench ``direction`` (6,), in units of the outputs' standard deviation, comes on top of the reading."""

    acts_on = ('wrench',)
    takes_place = False
    can_start = True
    linear = True
    typical = 0.1
    direction: Array

    def course(self, time: Array) -> Array:
        """Factor of the wrench along time, (N, 1)."""
        raise NotImplementedError

    def apply(self, world: World, magnitude: float) -> World:
        def biased(world: World, motion: Instants, outputs: Array) -> Array:
            return outputs + magnitude * self.course(world.times) * self.direction
        return world.with_sensing(biased)

    @staticmethod
    def random_direction(site: Site) -> Array:
        """All channels take part, each within a factor of three of the others."""
        signs = site.rng.choice([-1.0, 1.0], 6)
        return np.asarray(site.scale * signs * site.rng.uniform(0.5, 1.5, 6))


@dataclass(frozen=True)
class SensorOffset(Bias):
    """The sensor is overloaded or zeroed again: its offset jumps."""

    kind = 'sensor_offset'

    @classmethod
    def draw(cls, site: Site) -> Cause:
        return cls(None, site.random_start(), cls.random_direction(site))

    def course(self, time: Array) -> Array:
        return since(time, self.start_s)

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'offset': Quantity(magnitude * self.direction, 'N, N m')}


@dataclass(frozen=True)
class SensorDrift(Bias):
    """The offset creeps at a constant rate."""

    kind = 'sensor_drift'
    typical = 1e-3

    @classmethod
    def draw(cls, site: Site) -> Cause:
        return cls(None, site.start_s, cls.random_direction(site))

    def course(self, time: Array) -> Array:
        return np.maximum(time - (self.start_s or 0.0), 0.0)[:, None]

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'rate': Quantity(magnitude * self.direction, 'N/s, N m/s')}


@dataclass(frozen=True)
class ThermalDrift(Bias):
    """The electronics warm up: a first-order thermal state T' = (1 - T) / time constant moves the offset."""

    kind = 'thermal_drift'
    time_constant: float

    @classmethod
    def draw(cls, site: Site) -> Cause:
        time_constant = float(site.rng.uniform(0.08, 0.3)) * site.world.duration
        return cls(None, site.start_s, cls.random_direction(site), time_constant)

    def course(self, time: Array) -> Array:
        warm = np.maximum(time - (self.start_s or 0.0), 0.0) / self.time_constant
        return np.asarray(-np.expm1(-warm))[:, None]

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'drift': Quantity(magnitude * self.direction, 'N, N m'),
                'time_constant_s': Quantity(self.time_constant, 's')}


@dataclass(frozen=True)
class ReadingMatrix(Cause):
    """The reading is multiplied by a matrix near the identity."""

    acts_on = ('wrench',)
    typical = 0.05
    linear = True

    def matrix(self, magnitude: float) -> Array:
        """(6, 6)."""
        raise NotImplementedError

    def apply(self, world: World, magnitude: float) -> World:
        def distorted(world: World, motion: Instants, outputs: Array) -> Array:
            return outputs @ self.matrix(magnitude).T
        return world.with_sensing(distorted)


@dataclass(frozen=True)
class SensorGain(ReadingMatrix):
    """One channel's amplifier is off."""

    kind = 'sensor_gain'
    channel: int
    sign: float

    @classmethod
    def draw(cls, site: Site) -> Cause:
        channel = site.channel()
        return cls(site.world.arm.channels[channel], None, channel, site.sign())

    def matrix(self, magnitude: float) -> Array:
        matrix = np.eye(6)
        matrix[self.channel, self.channel] += self.sign * magnitude
        return matrix

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'gain': Quantity(self.sign * magnitude, '1')}


@dataclass(frozen=True)
class SensorCrosstalk(ReadingMatrix):
    """The calibration matrix is wrong off its diagonal: every channel hears the others."""

    kind = 'sensor_crosstalk'
    takes_place = False
    pattern: Array

    @classmethod
    def draw(cls, site: Site) -> Cause:
        pattern = site.rng.uniform(-1, 1, (6, 6)) * np.outer(site.scale, 1 / site.scale)
        np.fill_diagonal(pattern, 0.0)
        return cls(None, None, pattern)

    def matrix(self, magnitude: float) -> Array:
        return np.asarray(np.eye(6) + magnitude * self.pattern)

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'crosstalk': Quantity(magnitude * self.pattern, 'rows and columns N, N m')}


@dataclass(frozen=True)
class SensorMisalignment(ReadingMatrix):
    """The sensor is mounted turned about an axis; force and torque arrive in turned axes."""

    kind = 'sensor_misalignment'
    takes_place = False
    linear = False
    axis: Array

    @classmethod
    def draw(cls, site: Site) -> Cause:
        return cls(None, None, unit_vector(site.rng))

    def matrix(self, magnitude: float) -> Array:
        turn = Rotation.from_rotvec(magnitude * self.axis).as_matrix()
        return np.asarray(np.kron(np.eye(2), turn.T))

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'rotation_vector': Quantity(magnitude * self.axis, 'rad')}
