"""Cables and hoses between the room and a link: springs, and springs that rub."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.causes.base import HiddenCause, Site
from semiparam_ros.simulation.causes.forces import FrameForce
from semiparam_ros.simulation.fine_states import bouc_wen, fine_motion, sampled
from semiparam_ros.simulation.trajectory import Instants, unit_vector
from semiparam_ros.simulation.world import World

CABLE_STEP_S = 4e-3


@dataclass(frozen=True)
class HiddenCableSpring(FrameForce):
    """An elastic cable runs from a point in the room to a link: f = k (length - rest length) towards the point."""

    kind = 'cable_spring'
    quantity, beside = ('stiffness', 'N/m'), {'rest_length': 'm', 'anchor': 'm'}
    anchor: Array
    rest_length: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        frame = site.frame()
        anchor, lengths = drawn_anchor(site, frame)
        rest = float(site.rng.uniform(0.3, 0.8) * lengths.min())
        return cls(frame, site.start_s, anchor, rest)

    def force(self, world: World, motion: Instants) -> Array:
        rope = self.anchor - world.arm.pose(str(self.where), motion.position).place
        length = np.linalg.norm(rope, axis=1)[:, None]
        return np.asarray(np.maximum(length - self.rest_length, 0.0) * rope / length)


@dataclass(frozen=True)
class HiddenCableHysteresis(FrameForce):
    """A cable whose strands rub: its tension follows a Bouc-Wen state of the elongation."""

    kind = 'cable_hysteresis'
    quantity, beside = ('stiffness', 'N/m'), {'yield_length': 'm', 'anchor': 'm'}
    anchor: Array
    yield_length: float
    beta: float

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        frame = site.frame()
        anchor, lengths = drawn_anchor(site, frame)
        yield_length = float(site.rng.uniform(0.15, 0.4) * lengths.std())
        return cls(frame, site.start_s, anchor, yield_length, float(site.rng.uniform(0.5, 0.9)))

    def force(self, world: World, motion: Instants) -> Array:
        fine = fine_motion(world.trajectory, CABLE_STEP_S)
        lengths = np.linalg.norm(self.anchor - world.arm.pose(str(self.where), fine.position).place, axis=1)
        tension = sampled(fine.time, bouc_wen(lengths, self.yield_length, self.beta), motion.time)
        rope = self.anchor - world.arm.pose(str(self.where), motion.position).place
        return np.asarray(tension[:, None] * rope / np.linalg.norm(rope, axis=1)[:, None])


def drawn_anchor(site: Site, frame: str) -> tuple[Array, Array]:
    """A point [m] some decimetres off the frame's path, and the distances (N,) to it along the motion."""
    path = site.world.arm.pose(frame, site.world.now.position).place
    spread = float(np.linalg.norm(path.std(axis=0)))
    anchor = path.mean(axis=0) + (2.0 * spread + site.rng.uniform(0.2, 0.4)) * unit_vector(site.rng)
    return anchor, np.asarray(np.linalg.norm(anchor - path, axis=1))
