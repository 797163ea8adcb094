"""Causes of no listed kind: a diagnosis should say that something is left, and what it depends on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import BOTH, HiddenCause, Site, TrueValue
from semiparam_ros.simulation.causes.forces import FrameForce
from semiparam_ros.simulation.causes.friction import JointTorque
from semiparam_ros.simulation.fine_states import sampled
from semiparam_ros.simulation.trajectory import Instants, second_order, unit_vector, wander
from semiparam_ros.simulation.world import World

RINGING_STEP_S = 5e-3
WANDER_SEED_LIMIT = 2**31


@dataclass(frozen=True)
class Bump(FrameForce):
    """The link brushes against something soft at one place: a force of Gaussian shape in the link's position."""

    kind = 'bump'
    quantity, along, beside = ('force', 'N'), 'direction', {'centre': 'm', 'width': 'm'}
    direction: Array
    centre: Array
    width: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        frame = site.hand()
        path = site.world.arm.pose(frame, site.world.now.position).place
        width = float(site.rng.uniform(0.25, 0.5) * np.linalg.norm(path.std(axis=0)))
        centre = path[site.rng.integers(len(path))]
        return cls(frame, site.start_s, unit_vector(site.rng), centre, width)

    def force(self, world: World, motion: Instants) -> Array:
        away = world.arm.pose(str(self.where), motion.position).place - self.centre
        touch = np.exp(-0.5 * np.sum(away**2, axis=1) / self.width**2)
        return np.asarray(touch[:, None] * self.direction)


@dataclass(frozen=True)
class DriftingFriction(JointTorque):
    """Viscous friction whose coefficient wanders between nothing and twice its mean, with temperature or dirt."""

    kind = 'drifting_friction'
    quantity = ('mean_viscous', 'N m s/rad')
    course_seed: int

    @classmethod
    def drawn(cls, site: Site, joint: int) -> tuple[Any, ...]:
        return (int(site.rng.integers(WANDER_SEED_LIMIT)),)

    def torque(self, world: World, motion: Instants, efforts: Array) -> Array:
        course = wander(motion.time, world.duration / 3, np.random.default_rng(self.course_seed))
        return np.asarray((1.0 + np.tanh(course)) * motion.velocity[:, self.joint])


@dataclass(frozen=True)
class TwoMassFlexibility(HiddenCause):
    """Spring before the sensor: the outputs ring as a lightly damped second-order system.

    The magnitude is the compliance 1 / w^2 [s^2] of the oscillator, integrated at a fine step along
    the motion.
    """

    kind = 'two_mass_flexibility'
    acts_on = BOTH
    takes_place = False
    typical = 1e-3
    damping: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        return cls(None, None, float(site.rng.uniform(0.1, 0.3)))

    def apply(self, world: World, magnitude: float) -> World:
        time, rigid = world.rigid_on_grid(RINGING_STEP_S)
        rung = np.stack([second_order(column, magnitude**-0.5, self.damping, RINGING_STEP_S) for column in rigid.T], 1)

        def ringing(world: World, motion: Instants, outputs: Array) -> Array:
            extra = [sampled(time, column, motion.time) for column in (rung - rigid).T]
            return outputs + np.stack(extra, axis=1)
        return world.with_mechanical(ringing)

    def parameters(self, magnitude: float) -> dict[str, TrueValue]:
        return {'frequency': TrueValue(magnitude**-0.5 / (2 * np.pi), 'Hz'), 'damping': TrueValue(self.damping, '1')}
