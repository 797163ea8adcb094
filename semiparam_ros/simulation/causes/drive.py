"""Motors and gears: what the drive train adds to the efforts of the links, or takes from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import Site
from semiparam_ros.simulation.causes.friction import JointTorque
from semiparam_ros.simulation.fine_states import fine_motion, play, sampled
from semiparam_ros.simulation.trajectory import Instants
from semiparam_ros.simulation.world import World

# The teeth give: contact builds up over this share of the gap.
CONTACT_SHARE = 0.1


@dataclass(frozen=True)
class HiddenRotorInertia(JointTorque):
    """The rotor behind the gear is accelerated too: torque = I ddq."""

    kind = 'rotor_inertia'
    quantity = ('inertia', 'kg m^2')
    typical = 0.01

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return motion.acceleration[:, self.joint]


@dataclass(frozen=True)
class HiddenJointSpring(JointTorque):
    """A spring pulls the joint to a rest position: the motor holds k (q - rest)."""

    kind = 'joint_spring'
    quantity, beside = ('stiffness', 'N m/rad'), {'rest_position': 'rad'}
    rest_position: float

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        angle = site.world.now.position[:, joint]
        return (float(angle.mean() + site.rng.uniform(-1.5, 1.5) * angle.std()),)

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.asarray(motion.position[:, self.joint] - self.rest_position)


@dataclass(frozen=True)
class HiddenEffortOffset(JointTorque):
    """The current sensor of one motor has a bias."""

    kind = 'effort_offset'
    quantity, along = ('offset', 'N m'), 'sign'
    sign: float

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        return (site.sign(),)

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.full(len(motion.time), self.sign)


@dataclass(frozen=True)
class HiddenEffortGain(JointTorque):
    """The torque constant of one motor is off."""

    kind = 'effort_gain'
    quantity, along = ('gain', '1'), 'sign'
    typical = 0.1
    sign: float

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        return (site.sign(),)

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.asarray(self.sign * efforts[:, self.joint])


@dataclass(frozen=True)
class HiddenTransmissionRipple(JointTorque):
    """A gear runs unevenly: a torque periodic in the joint's angle."""

    kind = 'transmission_ripple'
    quantity, beside = ('amplitude', 'N m'), {'order': '1/revolution', 'phase': 'rad'}
    order: int
    phase: float

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        return int(site.rng.integers(8, 41)), float(site.rng.uniform(0, 2 * np.pi))

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.asarray(np.sin(self.order * motion.position[:, self.joint] + self.phase))


@dataclass(frozen=True)
class HiddenBacklash(JointTorque):
    """Play in a gear whose output rubs: after each reversal the motor crosses the gap and feels no friction of the
    output until the teeth meet again on the other flank."""

    kind = 'backlash'
    quantity, beside = ('torque', 'N m'), {'gap': 'rad'}
    gap: float

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        return (float(site.rng.uniform(0.03, 0.15) * np.ptp(site.world.now.position[:, joint])),)

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        fine = fine_motion(world.trajectory)
        inside = play(fine.position[:, self.joint], self.gap)
        width = CONTACT_SHARE * self.gap
        upper, lower = np.maximum(1 - (self.gap - inside) / width, 0.0), np.maximum(1 - inside / width, 0.0)
        return sampled(fine.time, upper - lower, motion.time)
