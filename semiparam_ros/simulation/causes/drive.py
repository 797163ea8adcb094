"""Motors and gears: what the drive train adds to the efforts of the links, or takes from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.causes.base import Cause, Quantity, Site, known_start
from semiparam_ros.simulation.causes.friction import JointTorque
from semiparam_ros.simulation.fine_states import fine_motion, play, sampled
from semiparam_ros.simulation.trajectory import Instants
from semiparam_ros.simulation.world import World

CONTACT_SHARE = 0.2


@dataclass(frozen=True)
class RotorInertia(JointTorque):
    """The rotor behind the gear is accelerated too: torque = I ddq."""

    kind = 'rotor_inertia'
    typical = 0.01

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return motion.acceleration[:, self.joint]

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'inertia': Quantity(magnitude, 'kg m^2')}


@dataclass(frozen=True)
class JointSpring(JointTorque):
    """A spring pulls the joint to a rest position: the motor holds k (q - rest)."""

    kind = 'joint_spring'
    rest: float

    @classmethod
    def draw(cls, site: Site) -> Cause:
        joint, world = site.joint(), site.world
        angle = world.motion().position[:, joint]
        rest = float(angle.mean() + site.rng.uniform(-1.5, 1.5) * angle.std())
        return cls(world.arm.joints[joint], known_start(site.from_beginning()), joint, rest)

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.asarray(motion.position[:, self.joint] - self.rest)

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'stiffness': Quantity(magnitude, 'N m/rad'), 'rest_position': Quantity(self.rest, 'rad')}


@dataclass(frozen=True)
class EffortOffset(JointTorque):
    """The current sensor of one motor has a bias."""

    kind = 'effort_offset'
    sign: float

    @classmethod
    def draw(cls, site: Site) -> Cause:
        joint = site.joint()
        return cls(site.world.arm.joints[joint], known_start(site.from_beginning()), joint,
                   float(site.rng.choice([-1.0, 1.0])))

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.full(len(motion.time), self.sign)

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'offset': Quantity(self.sign * magnitude, 'N m')}


@dataclass(frozen=True)
class EffortGain(JointTorque):
    """The torque constant of one motor is off."""

    kind = 'effort_gain'
    typical = 0.1
    sign: float

    @classmethod
    def draw(cls, site: Site) -> Cause:
        joint = site.joint()
        return cls(site.world.arm.joints[joint], known_start(site.from_beginning()), joint,
                   float(site.rng.choice([-1.0, 1.0])))

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.asarray(self.sign * efforts[:, self.joint])

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'gain': Quantity(self.sign * magnitude, '1')}


@dataclass(frozen=True)
class TransmissionRipple(JointTorque):
    """A gear runs unevenly: a torque periodic in the joint's angle."""

    kind = 'transmission_ripple'
    order: int
    phase: float

    @classmethod
    def draw(cls, site: Site) -> Cause:
        joint = site.joint()
        return cls(site.world.arm.joints[joint], known_start(site.from_beginning()), joint,
                   int(site.rng.integers(8, 41)), float(site.rng.uniform(0, 2 * np.pi)))

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.asarray(np.sin(self.order * motion.position[:, self.joint] + self.phase))

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'amplitude': Quantity(magnitude, 'N m'), 'order': Quantity(self.order, '1/revolution'),
                'phase': Quantity(self.phase, 'rad')}


@dataclass(frozen=True)
class Backlash(JointTorque):
    """Play in a gear: after each reversal the motor crosses a gap, and carries nothing until the teeth meet again.

    Friction of the link holds it meanwhile. The magnitude is the width of the gap [rad].
    """

    kind = 'backlash'
    can_start = False
    typical = 1e-3

    def apply(self, world: World, magnitude: float) -> World:
        def loosened(world: World, motion: Instants, outputs: Array) -> Array:
            carried = outputs.copy()
            carried[:, self.joint] *= self.contact(world, motion, magnitude)
            return carried
        return world.with_mechanical(loosened)

    def contact(self, world: World, motion: Instants, gap: float) -> Array:
        """Share of the torque (N,) that the teeth transmit: 1 on either flank, 0 inside the gap."""
        fine = fine_motion(world.trajectory)
        inside = play(fine.position[:, self.joint], gap)
        to_flank = sampled(fine.time, np.minimum(inside, gap - inside), motion.time)
        return np.asarray(np.maximum(1.0 - to_flank / (CONTACT_SHARE * gap), 0.0))

    def parameters(self, magnitude: float) -> dict[str, Quantity]:
        return {'gap': Quantity(magnitude, 'rad')}
