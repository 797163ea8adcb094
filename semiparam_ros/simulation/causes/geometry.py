"""Geometry and timing that the model has wrong: zeros, gravity, the time of the outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import HiddenCause, Site, TrueValue
from semiparam_ros.simulation.world import World


@dataclass(frozen=True)
class HiddenJointOffset(HiddenCause):
    """An encoder's zero is wrong: the joint stands elsewhere than reported."""

    kind = 'joint_offset'
    quantity, along = ('offset', 'rad'), 'sign'
    typical = 0.03
    of_joint = True
    joint: int
    sign: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        joint = site.joint()
        return cls(site.world.arm.joints[joint], None, joint, site.sign())

    def apply(self, world: World, magnitude: float) -> World:
        shift = world.joint_shift.copy()
        shift[self.joint] += self.sign * magnitude
        return world.changed(joint_shift=shift)


@dataclass(frozen=True)
class HiddenGravityTilt(HiddenCause):
    """The base is not level: gravity comes from another direction in its axes."""

    kind = 'gravity_tilt'
    takes_place = False
    typical = 0.03
    axis: Array

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        angle = site.rng.uniform(0, 2 * np.pi)
        return cls(None, None, np.array([np.cos(angle), np.sin(angle), 0.0]))

    def apply(self, world: World, magnitude: float) -> World:
        gravity = Rotation.from_rotvec(magnitude * self.axis).inv().apply(world.arm.model.gravity.linear)
        return world.changed(arm=world.arm.with_gravity(gravity))

    def parameters(self, magnitude: float) -> dict[str, TrueValue]:
        tilt = magnitude * self.axis
        return {'tilt_x': TrueValue(tilt[0], 'rad'), 'tilt_y': TrueValue(tilt[1], 'rad')}


@dataclass(frozen=True)
class HiddenTimeDelay(HiddenCause):
    """The outputs come later than their stamps say: the sensor shows the continuous motion a while ago."""

    kind = 'time_delay'
    quantity = ('delay_s', 's')
    takes_place = False
    typical = 0.01

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(None, None)

    def apply(self, world: World, magnitude: float) -> World:
        return world.changed(delay_s=world.delay_s + magnitude)
