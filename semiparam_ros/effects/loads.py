"""Forces from outside the arm: a load that is carried, a push, a fluid, a cable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.robot.frames import load_regressor, loaded_links, nearest_link, observed_links
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import reach_of
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.effects.application_point import AtPoint
from semiparam_ros.effects.base import Axis, Coefficient, Effect

INERTIAL = (Coefficient('mass', 'kg'), *(Coefficient(f'first_moment_{axis}', 'kg m') for axis in 'xyz'),
            *(Coefficient(f'inertia_{axes}', 'kg m^2') for axes in ('xx', 'xy', 'yy', 'xz', 'yz', 'zz')))
KNOWN_SHARE = 1e-6
"""Prior standard deviation of a value that was declared, over that of one that was not."""


class Payload(Effect):
    """A body picked up: mass, first moment and inertia in the link's frame; what is known of them may be declared."""

    kind: ClassVar[str] = 'payload'
    shows_against: ClassVar[Axis] = 'time'
    sentence: ClassVar[str] = 'the arm carries a load that the model does not know'
    mistaken_for: ClassVar[tuple[str, ...]] = ('external_force', 'sensor_offset')
    separated_by: ClassVar[str] = 'fast motion that turns the load about every axis: weight alone is only a force'
    must_start: ClassVar[bool] = True
    is_load: ClassVar[bool] = True
    is_body: ClassVar[bool] = True
    bounded_by_weight: ClassVar[bool] = True
    names: ClassVar[tuple[Coefficient, ...]] = INERTIAL
    parameter_units: ClassVar[Mapping[str, str]] = dict(INERTIAL)
    positive: ClassVar[tuple[str, ...]] = ('mass',)

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return tuple(loaded_links(body))

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return observed_links(body)

    @property
    def searched(self) -> tuple[str, ...]:
        """Return no name: a declared value of a load is known, not searched."""
        return ()

    def prior_mean(self, body: RigidBody) -> Array:
        return np.array([self.value(name) for name, _ in INERTIAL])

    def prior_scale(self, body: RigidBody) -> Array:
        known = np.array([name in self.parameters for name, _ in INERTIAL])
        return np.asarray(super().prior_scale(body) * np.where(known, KNOWN_SHARE, 1.0))

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        return load_regressor(body, samples, str(self.where)), None

    def physical(self, coefficients: Array) -> bool:
        return bool(coefficients[0] > 0.0)

    def conceivable(self, body: RigidBody, coefficients: Array) -> bool:
        """Tell whether it may be so, the centre no farther from the link than the arm is long."""
        reach = float(np.linalg.norm(coefficients[1:4])) <= reach_of(body) * float(coefficients[0])
        return reach and super().conceivable(body, coefficients)

    def relocated(self, body: RigidBody, coefficients: Array) -> Effect:
        """The same load at the link nearest to its centre, unless it was declared at this one."""
        if self.parameters:
            return self
        mass, *moment = coefficients[:4]
        return replace(self, where=nearest_link(body, str(self.where), np.array(moment) / mass)[0]) \
            if mass > 0.0 else self


class ToolExchange(Payload):
    """Another tool in place of one that the model has learnt: the difference of the two bodies, which is none."""

    kind: ClassVar[str] = 'tool_exchange'
    sentence: ClassVar[str] = 'the arm carries another tool than the one that the model knows'
    mistaken_for: ClassVar[tuple[str, ...]] = ('payload', 'external_force', 'sensor_offset')
    must_start: ClassVar[bool] = False
    may_come: ClassVar[bool] = True
    is_body: ClassVar[bool] = False
    positive: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        """Return no place: a whole recording holds both tools, and one of them is sought."""
        return ()

    def physical(self, coefficients: Array) -> bool:
        return True

    def conceivable(self, body: RigidBody, coefficients: Array) -> bool:
        """Tell whether its mass and its moments are no larger than those of a load may be."""
        return Effect.conceivable(self, body, coefficients)

    def relocated(self, body: RigidBody, coefficients: Array) -> Effect:
        return self


class ExternalForce(AtPoint):
    """A constant force along the base's axes, at a point of the link."""

    kind: ClassVar[str] = 'external_force'
    shows_against: ClassVar[Axis] = 'position'
    sentence: ClassVar[str] = 'something pulls or pushes the link with a constant force'
    mistaken_for: ClassVar[tuple[str, ...]] = ('payload', 'gravity_tilt', 'sensor_offset')
    separated_by: ClassVar[str] = 'faster motion: a load has inertia, a constant force has none'
    from_outside: ClassVar[bool] = True
    bounded_by_weight: ClassVar[bool] = True
    may_start: ClassVar[bool] = True
    names: ClassVar[tuple[Coefficient, ...]] = tuple(Coefficient(f'force_{axis}', 'N') for axis in 'xyz')

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        return self.motion(body, samples).force_map, None


class _Drag(AtPoint):
    """A force against the velocity of a link's point."""

    outputs: ClassVar[tuple[str, ...]] = ('wrench',)

    def physical(self, coefficients: Array) -> bool:
        return bool(coefficients[0] > 0.0)

    def resistance(self, velocity: Array) -> Array:
        """Force (N, 3) for a unit coefficient, from velocities (N, 3) [m/s]."""
        raise NotImplementedError

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        motion = self.motion(body, samples)
        return motion.force_map @ self.resistance(motion.velocity)[:, :, None], None


class ViscousDrag(_Drag):
    """Resistance in proportion to speed."""

    kind: ClassVar[str] = 'viscous_drag'
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('drag', 'N s/m'),)
    shows_against: ClassVar[Axis] = 'link_velocity'
    sentence: ClassVar[str] = 'the link moves through something viscous'
    mistaken_for: ClassVar[tuple[str, ...]] = ('quadratic_drag', 'time_delay')
    separated_by: ClassVar[str] = 'motion at clearly different speeds'

    def resistance(self, velocity: Array) -> Array:
        return -velocity


class QuadraticDrag(_Drag):
    """Resistance in proportion to the square of the speed."""

    kind: ClassVar[str] = 'quadratic_drag'
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('drag', 'N s^2/m^2'),)
    shows_against: ClassVar[Axis] = 'link_velocity'
    sentence: ClassVar[str] = 'the link moves through a fluid that resists with the square of the speed'
    mistaken_for: ClassVar[tuple[str, ...]] = ('viscous_drag', 'time_delay')
    separated_by: ClassVar[str] = 'motion at clearly different speeds'

    def resistance(self, velocity: Array) -> Array:
        return -np.linalg.norm(velocity, axis=1, keepdims=True) * velocity
