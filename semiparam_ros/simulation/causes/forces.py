"""Bodies and forces on the links, carried to the sensor or to the motors by Newton-Euler and Jacobians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import HiddenCause, Site, TrueValue
from semiparam_ros.simulation.causes.friction import JointTorque
from semiparam_ros.simulation.trajectory import Instants, unit_vector
from semiparam_ros.simulation.world import AttachedBody, World

PAYLOAD_RADIUS_M = 0.03


@dataclass(frozen=True)
class HiddenPayload(HiddenCause):
    """A solid ball is picked up: a real body of the multi-body model until it is put down."""

    kind = 'payload'
    quantity, beside = ('mass', 'kg'), {'centre': 'm'}
    can_start = can_end = True
    linear = True
    typical = 0.1
    centre: Array

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(site.hand(), site.random_start(), 0.06 * site.rng.uniform(-1, 1, 3))

    def apply(self, world: World, magnitude: float) -> World:
        ball = pin.Inertia.FromSphere(magnitude, PAYLOAD_RADIUS_M)
        inertia = pin.Inertia(ball.mass, self.centre, ball.inertia)
        end = np.inf if self.end_s is None else self.end_s
        ball_in_hand = AttachedBody(str(self.where), inertia, float(self.start_s or 0.0), end)
        return world.changed(bodies=(*world.bodies, ball_in_hand))


@dataclass(frozen=True)
class FrameForce(HiddenCause):
    """A force on the origin of a frame."""

    can_start = can_end = True
    linear = True

    def force(self, world: World, motion: Instants) -> Array:
        """Force (N, 3) at magnitude 1, in base axes."""
        raise NotImplementedError

    def apply(self, world: World, magnitude: float) -> World:
        def pushed(world: World, motion: Instants, outputs: Array) -> Array:
            force = magnitude * self.acting(motion.time) * self.force(world, motion)
            pose = world.arm.pose(str(self.where), motion.position)
            return outputs + world.arm.load_of_force(pose, force, motion.position)
        return world.with_mechanical(pushed)


@dataclass(frozen=True)
class HiddenExternalForce(FrameForce):
    """Constant force, its direction fixed in the room."""

    kind = 'external_force'
    quantity, along = ('force', 'N'), 'direction'
    direction: Array

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(site.frame(), site.start_s, unit_vector(site.rng))

    def force(self, world: World, motion: Instants) -> Array:
        return np.broadcast_to(self.direction, (len(motion.time), 3))


@dataclass(frozen=True)
class HiddenPeriodicDisturbance(FrameForce):
    """A machine on the link shakes it along an axis of the link, at one frequency."""

    kind = 'periodic_disturbance'
    direction: Array
    frequency: float
    phase: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        rate = 1.0 / float(np.median(np.diff(site.world.times)))
        frequency, phase = float(site.rng.uniform(0.025, 0.4)) * rate, float(site.rng.uniform(0, 2 * np.pi))
        in_joint = site.rng.uniform() < 0.5 if site.where is None else site.where in site.world.arm.joints
        start = site.start_s
        if in_joint and site.world.arm.outputs == 'effort':
            joint = site.joint()
            return JointDisturbance(site.world.arm.joints[joint], start, joint, frequency, phase)
        return cls(site.frame(), start, unit_vector(site.rng), frequency, phase)

    def force(self, world: World, motion: Instants) -> Array:
        axis = world.arm.pose(str(self.where), motion.position).rotation @ self.direction
        return axis * np.sin(2 * np.pi * self.frequency * motion.time + self.phase)[:, None]

    def parameters(self, magnitude: float) -> dict[str, TrueValue]:
        return {'frequency': TrueValue(self.frequency, 'Hz'), 'force': TrueValue(magnitude * self.direction, 'N'),
                'phase': TrueValue(self.phase, 'rad')}


@dataclass(frozen=True)
class JointDisturbance(JointTorque):
    """Disturbance of one drive: a torque at one frequency."""

    kind = HiddenPeriodicDisturbance.kind
    frequency: float
    phase: float

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        return np.asarray(np.sin(2 * np.pi * self.frequency * motion.time + self.phase))

    def parameters(self, magnitude: float) -> dict[str, TrueValue]:
        return {'frequency': TrueValue(self.frequency, 'Hz'), 'torque': TrueValue(magnitude, 'N m'),
                'phase': TrueValue(self.phase, 'rad')}


@dataclass(frozen=True)
class HiddenViscousDrag(FrameForce):
    """A slow fluid holds the link back: f = -c v."""

    kind = 'viscous_drag'
    quantity = ('drag', 'N s/m')

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(site.frame(), site.start_s)

    def force(self, world: World, motion: Instants) -> Array:
        return -world.arm.pose(str(self.where), motion.position).velocity(motion.velocity)[:, :3]


@dataclass(frozen=True)
class HiddenQuadraticDrag(HiddenViscousDrag):
    """A fast fluid holds the link back: f = -c |v| v."""

    kind = 'quadratic_drag'
    quantity = ('drag', 'N s^2/m^2')

    def force(self, world: World, motion: Instants) -> Array:
        against = super().force(world, motion)
        return np.asarray(against * np.linalg.norm(against, axis=1)[:, None])
