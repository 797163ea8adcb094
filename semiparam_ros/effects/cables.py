"""Cables and hoses that run along the arm: springs, and springs that slip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.robot.frames import frame_motion, observed_links
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.effects.application_point import POINT, AtPoint
from semiparam_ros.effects.base import CHANNELS, Axis, Coefficient, Values, joint_index
from semiparam_ros.effects.hysteresis import bouc_wen_state, dahl_state
from semiparam_ros.errors import SemiparamError

SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
SLIP_SHARES = (0.02, 0.05, 0.12, 0.3, 0.7)
DIRECTION: Mapping[str, str] = {'azimuth': 'rad', 'elevation': 'rad'}
ANCHOR: Mapping[str, str] = {**DIRECTION, 'nearness': '1/m'}
STEEP = float(np.arctan(0.5 * (1.0 + np.sqrt(5.0))))
ALONG = tuple((azimuth, elevation) for azimuths, elevation in (
    ((STEEP, -STEEP), 0.0), ((0.0, np.pi), 0.5 * np.pi - STEEP), ((0.5 * np.pi, -0.5 * np.pi), STEEP))
              for azimuth in azimuths)
"""Azimuth and elevation of the six axes of an icosahedron [rad], none of them upright: no direction is further than 37
degrees from one."""
BESIDE = 0.65
"""Angle [rad] to either side of a direction within which a line search looks."""
NEARER = 2.0
"""Nearness [1/m] to either side of an anchor's within which a line search looks."""


class _Cable(AtPoint):
    """Cable that acts at a link through its position, or on the sensor through a joint's angle."""

    outputs: ClassVar[tuple[str, ...]] = ('wrench',)

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return (*super().places(body), *body.joints)

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return (*super().permitted(body), *body.joints)

    def at_joint(self, body: RigidBody) -> bool:
        return body.outputs == 'wrench' and self.where in body.joints


class CableSpring(_Cable):
    """A spring: at a link its force is affine in position, along a joint its wrench is linear in the angle. In joint
    efforts it is sought where it comes while the robot works, not in a whole recording.

    Springs of joints explain much of that to an arm of joint efforts.
    """

    kind: ClassVar[str] = 'cable_spring'
    shows_against: ClassVar[Axis] = 'position'
    sentence: ClassVar[str] = 'a cable or hose pulls like a spring'
    may_come: ClassVar[bool] = True
    mistaken_for: ClassVar[tuple[str, ...]] = ('cable_hysteresis', 'external_force', 'gravity_tilt')
    separated_by: ClassVar[str] = 'slow motion over the whole workspace, where inertia plays no part'
    outputs: ClassVar[tuple[str, ...]] = ('wrench', 'effort')

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return super().places(body) if body.outputs == 'wrench' else ()

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return super().permitted(body) if body.outputs == 'wrench' else observed_links(body)

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        if self.at_joint(body):
            angle = body.joint_unit(self.where, 'rad')
            return tuple(Coefficient(f'stiffness_{name}', f'{unit}/{angle}')
                         for name, unit in zip(CHANNELS, body.output_units, strict=True))
        stiffnesses = tuple(Coefficient(f'stiffness_{"xyz"[i]}{"xyz"[j]}', 'N/m') for i, j in SYMMETRIC)
        return (*(Coefficient(f'force_{axis}', 'N') for axis in 'xyz'), *stiffnesses)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        if self.at_joint(body):
            return samples.position[:, joint_index(body, self.where), None, None] * np.eye(len(CHANNELS)), None
        motion = self.motion(body, samples)
        forces = np.zeros((len(samples), 3, 9))
        forces[:, :, :3] = np.eye(3)
        for column, (i, j) in enumerate(SYMMETRIC, start=3):
            forces[:, i, column] = -motion.position[:, j]
            forces[:, j, column] = -motion.position[:, i]
        return motion.force_map @ forces, None


class CableHysteresis(_Cable):
    """Dahl's model: the cable pulls back over ``slip`` of travel, then slips (z' = dx - |dx| z / slip). At a link it
    drags in whichever direction the link moves, or towards an anchor: ``azimuth`` and ``elevation`` of it seen from the
    robot's base, and ``nearness``, one over its distance from there; zero is a fixed direction. Another ``unloading``
    makes it Bouc's and Wen's."""

    kind: ClassVar[str] = 'cable_hysteresis'
    shows_against: ClassVar[Axis] = 'position'
    refine_link: ClassVar[bool] = True
    sentence: ClassVar[str] = 'a cable or hose drags with hysteresis: it pulls back, then slips'
    mistaken_for: ClassVar[tuple[str, ...]] = ('cable_spring', 'viscous_drag')
    separated_by: ClassVar[str] = 'reversals after long and after short travels'
    parameter_units: ClassVar[Mapping[str, str]] = {'slip': 'rad or m', 'unloading': 'm', **ANCHOR, **POINT}
    positive: ClassVar[tuple[str, ...]] = ('slip', 'unloading')

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None, residual: Array) -> Sequence[Values]:
        if where in body.joints:
            reach = float(np.ptp(samples.position[:, joint_index(body, where)]))
        else:
            reach = float(np.ptp(frame_motion(body, samples, str(where)).position, axis=0).max())
        slips: list[Values] = [{'slip': max(reach, 1e-6) * share} for share in SLIP_SHARES]
        if where in body.joints:
            return slips
        return slips + [{**slip, 'unloading': slip['slip'], **dict(zip(ANCHOR, (*along, 0.0), strict=True))}
                        for slip in slips for along in ALONG]

    def bounds(self, name: str, body: RigidBody, samples: Samples, residual: Array) -> tuple[float, float]:
        if name in DIRECTION:
            return self.value(name) - BESIDE, self.value(name) + BESIDE
        if name == 'nearness':
            return self.value(name) - NEARER, self.value(name) + NEARER
        return super().bounds(name, body, samples, residual)

    def check(self, body: RigidBody) -> None:
        super().check(body)
        if self.at_joint(body) and not self.parameters.keys().isdisjoint(ANCHOR):
            raise SemiparamError(f"effect '{self.kind}' has a direction at the joint {self.where}; expected one at a "
                                 'link alone.')

    def unit_of(self, name: str, body: RigidBody | None = None) -> str:
        if body is None or name != 'slip':
            return super().unit_of(name, body)
        return body.joint_unit(self.where, 'rad') if self.at_joint(body) else 'm'

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        if self.at_joint(body):
            return tuple(Coefficient(name, unit) for name, unit in zip(CHANNELS, body.output_units, strict=True))
        return (Coefficient('force', 'N'),)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        slip = self.value('slip', 0.1)
        if self.at_joint(body):
            travel = samples.position[:, joint_index(body, self.where), None]
            state, memory = dahl_state(travel, slip, memory)
            return state[:, :, None] * np.eye(len(CHANNELS)), memory
        motion = self.motion(body, samples)
        if self.parameters.keys().isdisjoint(ANCHOR):
            state, memory = dahl_state(motion.position, slip, memory)
            return motion.force_map @ -state[:, :, None], memory
        shortened, towards = self._cable(motion.position)
        state, memory = bouc_wen_state(shortened, slip, self.value('unloading', slip), memory)
        return motion.force_map @ -(state[:, None] * towards)[:, :, None], memory

    def _cable(self, position: Array) -> tuple[Array, Array]:
        """Shortening (N,) [m] of the cable and its direction (N, 3), at positions (N, 3) [m]."""
        azimuth, elevation, nearness = (self.value(name) for name in ANCHOR)
        along = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        towards = along - nearness * position
        length = np.linalg.norm(towards, axis=1)  # over the anchor's distance
        shortened = (position * (along + towards)).sum(axis=1) / (1.0 + length)  # (1 - length) / nearness, or its limit
        return shortened, towards / np.maximum(length, 1e-12)[:, None]
