"""Faults of the force/torque sensor itself, applied to its reading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import HiddenCause, Site
from semiparam_ros.simulation.trajectory import Instants, unit_vector
from semiparam_ros.simulation.world import World


@dataclass(frozen=True)
class Bias(HiddenCause):
    """A wrench ``direction`` (6,), in units of the outputs' standard deviation, comes on top of the reading."""

    acts_on = ('wrench',)
    takes_place = False
    can_start = True
    linear = True
    typical = 0.1
    along = 'direction'
    direction: Array

    def course(self, world: World) -> Array:
        """Factor (N, 1) of the wrench along the recording."""
        raise NotImplementedError

    def apply(self, world: World, magnitude: float) -> World:
        def biased(world: World, motion: Instants, outputs: Array) -> Array:
            return outputs + magnitude * self.course(world) * self.direction
        return world.with_sensing(biased)

    @staticmethod
    def random_direction(site: Site) -> Array:
        """Direction (6,) in which all channels take part, each within a factor of three of others.
        """
        signs = site.rng.choice([-1.0, 1.0], 6)
        return np.asarray(site.scale * signs * site.rng.uniform(0.5, 1.5, 6))


@dataclass(frozen=True)
class HiddenSensorOffset(Bias):
    """The sensor is overloaded or zeroed again: its offset jumps."""

    kind = 'sensor_offset'
    quantity = ('offset', 'N, N m')
    can_end = True

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(None, site.random_start(), cls.random_direction(site))

    def course(self, world: World) -> Array:
        return self.acting(world.times)


@dataclass(frozen=True)
class HiddenSensorDrift(Bias):
    """The offset creeps at a constant rate."""

    kind = 'sensor_drift'
    quantity = ('rate', 'N/s, N m/s')
    typical = 1e-3

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(None, site.start_s, cls.random_direction(site))

    def course(self, world: World) -> Array:
        return np.maximum(world.times - (self.start_s or 0.0), 0.0)[:, None]


@dataclass(frozen=True)
class HiddenThermalDrift(Bias):
    """The electronics warm up: a first-order thermal state T' = (1 - T) / time constant moves the offset."""

    kind = 'thermal_drift'
    quantity, beside = ('drift', 'N, N m'), {'time_constant_s': 's'}
    time_constant_s: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        time_constant = float(site.rng.uniform(0.08, 0.3)) * site.world.duration
        return cls(None, site.start_s, cls.random_direction(site), time_constant)

    def course(self, world: World) -> Array:
        warm = np.maximum(world.times - (self.start_s or 0.0), 0.0) / self.time_constant_s
        return np.asarray(-np.expm1(-warm))[:, None]


@dataclass(frozen=True)
class ReadingMatrix(HiddenCause):
    """The reading is multiplied by a matrix near the identity."""

    acts_on = ('wrench',)
    typical = 0.05
    linear = True

    def matrix(self, magnitude: float) -> Array:
        """Reading over true wrench, (6, 6), at a magnitude."""
        raise NotImplementedError

    def apply(self, world: World, magnitude: float) -> World:
        def distorted(world: World, motion: Instants, outputs: Array) -> Array:
            return outputs @ self.matrix(magnitude).T
        return world.with_sensing(distorted)


@dataclass(frozen=True)
class HiddenSensorGain(ReadingMatrix):
    """One channel's amplifier is off."""

    kind = 'sensor_gain'
    quantity, along = ('gain', '1'), 'sign'
    channel: int
    sign: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        channel = site.channel()
        return cls(site.world.arm.channels[channel], None, channel, site.sign())

    def matrix(self, magnitude: float) -> Array:
        matrix = np.eye(6)
        matrix[self.channel, self.channel] += self.sign * magnitude
        return matrix


@dataclass(frozen=True)
class HiddenSensorCrosstalk(ReadingMatrix):
    """The calibration matrix is wrong off its diagonal: every channel hears the others."""

    kind = 'sensor_crosstalk'
    quantity, along = ('crosstalk', 'rows and columns N, N m'), 'pattern'
    takes_place = False
    pattern: Array

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        pattern = site.rng.uniform(-1, 1, (6, 6)) * np.outer(site.scale, 1 / site.scale)
        np.fill_diagonal(pattern, 0.0)
        return cls(None, None, pattern)

    def matrix(self, magnitude: float) -> Array:
        return np.asarray(np.eye(6) + magnitude * self.pattern)


@dataclass(frozen=True)
class HiddenSensorMisalignment(ReadingMatrix):
    """The sensor is mounted turned about an axis; force and torque arrive in turned axes."""

    kind = 'sensor_misalignment'
    quantity, along = ('rotation_vector', 'rad'), 'axis'
    takes_place = False
    linear = False
    axis: Array

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(None, None, unit_vector(site.rng))

    def matrix(self, magnitude: float) -> Array:
        turn = Rotation.from_rotvec(magnitude * self.axis).as_matrix()
        return np.asarray(np.kron(np.eye(2), turn.T))
