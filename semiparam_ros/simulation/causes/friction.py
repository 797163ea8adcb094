"""Friction in the joints, as the motors feel it. What slides is carried by bristles, integrated along the motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import HiddenCause, Site, TrueValue
from semiparam_ros.simulation.fine_states import STEP_S, bristle, fine_motion, sampled
from semiparam_ros.simulation.trajectory import Instants
from semiparam_ros.simulation.world import World

PRESLIDING_RAD = 1e-3


@dataclass(frozen=True)
class JointTorque(HiddenCause):
    """A torque that one motor must hold against."""

    acts_on = ('effort',)
    can_start = can_end = True
    linear = of_joint = True
    joint: int

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        joint = site.joint()
        return cls(site.world.arm.joints[joint], site.start_s, joint, *cls.drawn(site, joint))

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        """Values that the kind has beyond the joint, in the order of its fields."""
        return ()

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        """Torque (N,) at magnitude 1; ``efforts`` (N, n) are those without it."""
        raise NotImplementedError

    def apply(self, world: World, magnitude: float) -> World:
        def loaded(world: World, motion: Instants, outputs: Array) -> Array:
            added = np.zeros_like(outputs)
            added[:, self.joint] = magnitude * self.torque(world, motion, outputs)
            return outputs + self.acting(motion.time) * added
        return world.with_mechanical(loaded)

    def slide(self, world: World, motion: Instants) -> Array:
        """Direction of sliding (N,), -1 to 1, from a bristle along the fine motion."""
        fine = fine_motion(world.trajectory)
        return sampled(fine.time, bristle(fine.position[:, self.joint], PRESLIDING_RAD), motion.time)


@dataclass(frozen=True)
class HiddenViscousFriction(JointTorque):
    """Oil: torque = b dq."""

    kind = 'viscous_friction'
    quantity = ('viscous', 'N m s/rad')

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return motion.velocity[:, self.joint]


@dataclass(frozen=True)
class HiddenCoulombFriction(JointTorque):
    """Dry friction: a torque of constant size against the direction of sliding."""

    kind = 'coulomb_friction'
    quantity = ('coulomb', 'N m')

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return self.slide(world, motion)


@dataclass(frozen=True)
class HiddenStribeckFriction(JointTorque):
    """Dry friction that is larger near standstill: sliding level c (1 + r exp(-(dq / vs)^2)) of a LuGre bristle."""

    kind = 'stribeck_friction'
    excess: float
    velocity: float

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        speed = float(site.world.now.velocity[:, joint].std())
        return float(site.rng.uniform(1.0, 2.0)), float(site.rng.uniform(0.1, 0.4)) * speed

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        def level(steps: Array) -> Array:
            return np.asarray(1.0 + self.excess * np.exp(-(steps / STEP_S / self.velocity) ** 2))
        fine = fine_motion(world.trajectory)
        return sampled(fine.time, bristle(fine.position[:, self.joint], PRESLIDING_RAD, level), motion.time)

    def parameters(self, magnitude: float) -> dict[str, TrueValue]:
        return {'coulomb': TrueValue(magnitude, 'N m'), 'stiction': TrueValue(self.excess * magnitude, 'N m'),
                'stribeck_velocity': TrueValue(self.velocity, 'rad/s')}


@dataclass(frozen=True)
class HiddenAsymmetricFriction(JointTorque):
    """Dry and viscous friction, each of another size in either direction."""

    kind = 'asymmetric_friction'
    backward: float
    viscous: tuple[float, float]

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        speed = float(site.world.now.velocity[:, joint].std())
        forward, ratio = site.rng.uniform(0.3, 1.0) / speed, float(site.rng.uniform(0.2, 0.6))
        return ratio, (float(forward), float(forward * site.rng.uniform(0.2, 0.6)))

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        slide, velocity = self.slide(world, motion), motion.velocity[:, self.joint]
        dry = np.where(slide > 0, slide, self.backward * slide)
        return np.asarray(dry + np.where(velocity > 0, *self.viscous) * velocity)

    def parameters(self, magnitude: float) -> dict[str, TrueValue]:
        forward, backward = self.viscous
        return {'coulomb_forward': TrueValue(magnitude, 'N m'),
                'coulomb_backward': TrueValue(self.backward * magnitude, 'N m'),
                'viscous_forward': TrueValue(forward * magnitude, 'N m s/rad'),
                'viscous_backward': TrueValue(backward * magnitude, 'N m s/rad')}


@dataclass(frozen=True)
class HiddenLoadFriction(JointTorque):
    """Teeth under load rub: a share of the transmitted torque against the direction of sliding."""

    kind = 'load_friction'
    quantity = ('load_coefficient', '1')
    typical = 0.1

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.asarray(np.abs(efforts[:, self.joint]) * self.slide(world, motion))
