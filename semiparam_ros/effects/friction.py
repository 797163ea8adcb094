"""Friction: resistance to a joint's motion in its efforts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from semiparam_ros.core.columns import ColumnBlock, JointColumns, Memory
from semiparam_ros.core.robot.joint_friction import turn_speeds
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import plausible, size_beyond
from semiparam_ros.core.samples import Samples, at_middle
from semiparam_ros.core.types import Array
from semiparam_ros.effects.base import (
    ALWAYS,
    Axis,
    Coefficient,
    Effect,
    Self,
    Values,
    channel_index,
    joint_index,
    on_joint,
)
from semiparam_ros.effects.hysteresis import Way, bristle, sticking_bristle

SPEED_SHARES = (0.003, 0.01, 0.03, 0.1)
PRESLIDING_SHARES, MOST_PRESLIDING = (0.0005, 0.002, 0.008), 0.032
"""Of the joint's reach. A bristle that bends over more of it is no friction, but may seem to be a spring's."""
DRIVING_SHARE = 0.05
"""Share of a friction's coefficients that one of them may be below zero by chance."""
LONGEST_LEAD_S = 0.05
SAME_SPEED = 1e-5
"""Difference of speeds over the turn speed that changes no friction, large against rounding."""
GRADUAL_SHARE = 0.3
"""Turn speed, over a joint's usual speed, from which on friction is hardly dry."""


class JointEffect(Effect):
    """Effect on the effort of one joint, through functions of that joint's motion alone."""

    outputs: ClassVar[tuple[str, ...]] = ('effort',)
    of_joint: ClassVar[bool] = True
    values_by_row: ClassVar[bool] = False
    """Mark of parameters that may be arrays (N,) in :meth:`functions`, one value for each row."""

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return body.output_names

    def prior_scale(self, body: RigidBody) -> Array:
        size = size_beyond(body, str(self.where))
        return np.array([plausible(unit, size) for _, unit in self.coefficients(body)])

    def physical(self, coefficients: Array) -> bool:
        return not self.resists or float(coefficients.sum()) > 0.0

    def functions(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Columns (N, c) of the joint from its position, velocity and acceleration, each (N,)."""
        raise NotImplementedError

    @property
    def of_motion_alone(self) -> bool:
        """Tell whether :meth:`functions` say all: no memory, no start and no end."""
        return type(self).basis is JointEffect.basis and self.span == ALWAYS

    def joint_columns(self, body: RigidBody, blocks: Sequence[ColumnBlock]) -> JointColumns | None:
        alike = [each for each in blocks if isinstance(each, JointEffect) and self._is_like(each)]
        if len(alike) < len(blocks):
            return None
        values: dict[str, Any] = {name: np.array([each.parameters[name] for each in alike])
                                  for name in self.parameters}
        by_row = {name: given for name, given in values.items() if np.ptp(given) > 0.0}
        if by_row and not self.values_by_row:
            return None
        common = replace(self, parameters={**self.parameters, **by_row})
        joints, outputs = (np.array([index(body, each.where) for each in alike])
                           for index in (joint_index, channel_index))
        return JointColumns(joints, outputs, common.functions)

    def _is_like(self, other: JointEffect) -> bool:
        """Tell whether two differ in place and values alone, and need their joint's motion alone.
        """
        return type(self) is type(other) and self.of_motion_alone and other.of_motion_alone and (
            self.parameters.keys() == other.parameters.keys() and self.options == other.options)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        joint = joint_index(body, self.where)
        motion = (samples.position[:, joint], samples.velocity[:, joint], samples.acceleration[:, joint])
        return on_joint(body, self.where, self.functions(*motion)), None


def _reach(samples: Samples, joint: int) -> float:
    """Reach [rad or m] of a joint's motion."""
    return max(float(np.ptp(samples.position[:, joint])), 1e-6)


class _Sliding(JointEffect):
    """Friction by the direction of sliding, which turns over within ``turn_speed`` or a way of
    ``presliding``.

    With ``lead_s`` it turns over so long before the recorded velocity does: where that lags, or
    where friction gives.
    """

    parameter_units: ClassVar[dict[str, str]] = {'turn_speed': 'rad/s', 'presliding': 'rad', 'stribeck_speed': 'rad/s',
                                                 'lead_s': 's'}
    positive: ClassVar[tuple[str, ...]] = ('turn_speed', 'presliding', 'stribeck_speed')
    resists: ClassVar[bool] = True
    values_by_row: ClassVar[bool] = True

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None, residual: Array) -> Sequence[Values]:
        joint = joint_index(body, where)
        fastest = max(float(np.abs(samples.velocity[:, joint]).max()), 1e-6)
        return [*({'turn_speed': fastest * share} for share in SPEED_SHARES),
                *({'presliding': _reach(samples, joint) * share} for share in PRESLIDING_SHARES)]

    def bounds(self, name: str, body: RigidBody, samples: Samples, residual: Array) -> tuple[float, float]:
        if name == 'lead_s':
            return -LONGEST_LEAD_S, LONGEST_LEAD_S
        low, high = super().bounds(name, body, samples, residual)
        most = MOST_PRESLIDING * _reach(samples, joint_index(body, self.where))
        return (min(low, most), min(high, most)) if name in ('presliding', 'presliding_stuck') else (low, high)

    def finer(self: Self) -> Self:
        """The same friction, free to turn over a little before or after the recorded velocity."""
        known = 'turn_speed' not in self.parameters or 'lead_s' in self.parameters
        return self if known else self.with_values(lead_s=0.0)

    def led(self: Self, lead_s: float) -> Self:
        lead = float(np.clip(self.value('lead_s') + lead_s, -LONGEST_LEAD_S, LONGEST_LEAD_S))
        return self.with_values(lead_s=lead) if 'lead_s' in self.parameters else self

    def direction(self, samples: Samples, joint: int, memory: Memory) -> tuple[Array, Memory]:
        """Direction (N,) of sliding in [-1, 1]: the velocity's, or that of a bristle that bends."""
        if 'presliding' in self.parameters:
            return bristle(_way(samples, joint), self.value('presliding'), memory)
        if samples.averaged_s > 0.0:
            return self._averaged(samples, joint), None
        return self._direction_now(samples.velocity[:, joint], samples.acceleration[:, joint]), None

    def _averaged(self, samples: Samples, joint: int, least: float = -np.inf) -> Array:
        """Direction (N,) of the velocities within each averaged sample, those below ``least`` counted as that."""
        velocity, change = samples.velocity[:, joint], samples.acceleration[:, joint]
        ahead, turn = velocity + self.value('lead_s') * change, self.value('turn_speed', 0.01)
        means = _mean_tanh(ahead, 0.5 * samples.averaged_s * np.abs(change), turn, least)
        return at_middle(means, samples.stamps, samples.averaged_s, samples.averaged_of)

    def _direction_now(self, velocity: Array, acceleration: Array) -> Array:
        """Direction (N,) in [-1, 1] of the velocity (N,), ``lead_s`` ahead."""
        ahead = velocity + self.value('lead_s') * acceleration
        return np.asarray(np.tanh(ahead / self.value('turn_speed', 0.01)))

    def doubt(self, body: RigidBody, samples: Samples) -> str:
        if 'presliding' in self.parameters:
            return ''
        speed = np.abs(samples.velocity[:, joint_index(body, self.where)])
        usual, turn = float(np.median(speed)), self.value('turn_speed', 0.01)
        if turn < GRADUAL_SHARE * usual:
            return ''
        unit = self.unit_of('turn_speed', body)
        return (f'It turns over within {turn:.2g} {unit}, while the joint usually moves at {usual:.2g} {unit}, so '
                'it grows with the speed as viscous friction does and may stand in for one. Constant speeds, slow and '
                'fast, would tell.')

    def sliding(self, direction: Array, velocity: Array) -> Array:
        """Columns (N, c) from the direction of sliding and the velocity, each (N,)."""
        raise NotImplementedError

    def functions(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        return self.sliding(self._direction_now(velocity, acceleration), velocity)

    @property
    def of_motion_alone(self) -> bool:
        own = type(self).basis is _Sliding.basis
        return own and self.span == ALWAYS and 'presliding' not in self.parameters

    def _states(self, samples: Samples, joint: int, memory: Memory) -> tuple[Array, Memory]:
        """Columns (N, c) of the joint, and the memory after them."""
        direction, memory = self.direction(samples, joint, memory)
        return self.sliding(direction, samples.velocity[:, joint]), memory

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        states, memory = self._states(samples, joint_index(body, self.where), memory)
        return on_joint(body, self.where, states), memory


def _mean_tanh(velocity: Array, reach: Array, turn: float, least: float) -> Array:
    """Mean (N,) of tanh(v / turn) over the velocities within ``reach`` (N,) of ``velocity`` (N,), where v is no less
    than ``least``, zero or without bound.

    A sample that averages over a time holds the friction of all the speeds that the joint passes
    within it.
    """
    reach = np.maximum(reach / turn, SAME_SPEED)
    fast, slow = (np.maximum(velocity / turn + side, least) for side in (reach, -reach))
    return np.asarray((_log_cosh(fast) - _log_cosh(slow)) / (2.0 * reach))


def _log_cosh(values: Array) -> Array:
    """Function log(2 cosh(x)) (N,) of the values (N,); its derivative is tanh."""
    size = np.abs(values)
    return np.asarray(size + np.log1p(np.exp(-2.0 * size)))


class ViscousFriction(JointEffect):
    """Friction in proportion to speed."""

    kind: ClassVar[str] = 'viscous_friction'
    group: ClassVar[str] = 'plain friction'
    shows_against: ClassVar[Axis] = 'velocity'
    resists: ClassVar[bool] = True
    sentence: ClassVar[str] = 'the joint has viscous friction'
    mistaken_for: ClassVar[tuple[str, ...]] = ('coulomb_friction', 'asymmetric_friction', 'time_delay')
    separated_by: ClassVar[str] = 'constant speeds, slow and fast, in both directions'
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('viscous', 'N m s/rad'),)

    def functions(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        return velocity[:, None]


class CoulombFriction(_Sliding):
    """Dry friction: constant against the direction of motion."""

    kind: ClassVar[str] = 'coulomb_friction'
    group: ClassVar[str] = 'plain friction'
    shows_against: ClassVar[Axis] = 'velocity'
    sentence: ClassVar[str] = 'the joint has dry (Coulomb) friction'
    mistaken_for: ClassVar[tuple[str, ...]] = ('viscous_friction', 'stribeck_friction', 'load_friction', 'backlash')
    separated_by: ClassVar[str] = 'constant speeds, slow and fast, in both directions'
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('coulomb', 'N m'),)

    def sliding(self, direction: Array, velocity: Array) -> Array:
        return direction[:, None]


def plain_friction(body: RigidBody, joint: str) -> list[JointEffect]:
    """Viscous and dry friction of a joint, which turns over within the larger speed of every model's columns."""
    turn_speed = float(turn_speeds(body)[-1, channel_index(body, joint)])
    return [ViscousFriction(joint), CoulombFriction(joint, {'turn_speed': turn_speed})]


class StribeckFriction(_Sliding):
    """Dry friction that is higher near standstill: a part that fades as exp(-(velocity / stribeck_speed)^2)."""

    kind: ClassVar[str] = 'stribeck_friction'
    shows_against: ClassVar[Axis] = 'velocity'
    sentence: ClassVar[str] = 'the joint sticks: its friction is higher near standstill (Stribeck)'
    mistaken_for: ClassVar[tuple[str, ...]] = ('coulomb_friction', 'asymmetric_friction')
    separated_by: ClassVar[str] = 'slow motion, below and above the speed where sticking ends'
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('coulomb', 'N m'), Coefficient('stiction', 'N m'))
    parameter_units: ClassVar[dict[str, str]] = {**_Sliding.parameter_units, 'presliding_stuck': 'rad'}
    positive: ClassVar[tuple[str, ...]] = (*_Sliding.positive, 'presliding_stuck')

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None, residual: Array) -> Sequence[Values]:
        fastest = float(np.abs(samples.velocity[:, joint_index(body, where)]).max())
        coarse = super().searches(body, samples, where, residual)
        bristle = {**coarse[5], 'presliding_stuck': 2.0 * coarse[5]['presliding']}
        return [{**values, 'stribeck_speed': max(fastest, 1e-6) * share}
                for values in (coarse[1], coarse[2], bristle) for share in (0.05, 0.12, 0.3)]

    def physical(self, coefficients: Array) -> bool:
        return bool(np.all(coefficients > 0.0))

    def plainer(self) -> tuple[Effect, ...]:
        sticking = ('stribeck_speed', 'presliding_stuck')
        parameters = {name: value for name, value in self.parameters.items() if name not in sticking}
        return (CoulombFriction(self.where, parameters, span=self.span),)

    def _states(self, samples: Samples, joint: int, memory: Memory) -> tuple[Array, Memory]:
        if 'presliding' not in self.parameters:
            return super()._states(samples, joint, memory)
        slip = self.value('presliding')
        return sticking_bristle(_way(samples, joint), slip, self.value('presliding_stuck', slip),
                                self.value('stribeck_speed', 0.1), memory)

    def sliding(self, direction: Array, velocity: Array) -> Array:
        fading = np.exp(-((velocity / self.value('stribeck_speed', 0.1)) ** 2))
        return np.column_stack([direction, direction * fading])


class AsymmetricFriction(_Sliding):
    """Dry and viscous friction that differ between the two directions."""

    kind: ClassVar[str] = 'asymmetric_friction'
    shows_against: ClassVar[Axis] = 'velocity'
    sentence: ClassVar[str] = "the joint's friction differs between its two directions"
    mistaken_for: ClassVar[tuple[str, ...]] = ('coulomb_friction', 'viscous_friction', 'effort_offset')
    includes: ClassVar[tuple[str, ...]] = ('effort_offset',)
    separated_by: ClassVar[str] = 'equal motion in both directions'
    names: ClassVar[tuple[Coefficient, ...]] = (
        Coefficient('coulomb_forward', 'N m'), Coefficient('coulomb_backward', 'N m'),
        Coefficient('viscous_forward', 'N m s/rad'), Coefficient('viscous_backward', 'N m s/rad'))

    def physical(self, coefficients: Array) -> bool:
        """Tell whether each part resists: a driving one makes up for a wrong shape."""
        return bool(coefficients.min() > -DRIVING_SHARE * np.abs(coefficients).sum())

    def plainer(self) -> tuple[Effect, ...]:
        return (CoulombFriction(self.where, self.parameters, span=self.span),
                ViscousFriction(self.where, span=self.span))

    def sliding(self, direction: Array, velocity: Array) -> Array:
        return np.column_stack([np.maximum(direction, 0.0), np.minimum(direction, 0.0),
                                np.maximum(velocity, 0.0), np.minimum(velocity, 0.0)])

    def _states(self, samples: Samples, joint: int, memory: Memory) -> tuple[Array, Memory]:
        """Columns of which each is averaged by itself: a sample in which the joint turns back holds some of both."""
        states, memory = super()._states(samples, joint, memory)
        if samples.averaged_s > 0.0 and 'presliding' not in self.parameters:
            direction, forward = states[:, 0] + states[:, 1], self._averaged(samples, joint, 0.0)
            states[:, 0], states[:, 1] = forward, direction - forward
        return states, memory


class LoadFriction(_Sliding):
    """Dry friction in proportion to the load that the joint carries, as the rigid body predicts it."""

    kind: ClassVar[str] = 'load_friction'
    needs_reference: ClassVar[bool] = True
    shows_against: ClassVar[Axis] = 'velocity'
    sentence: ClassVar[str] = "the joint's friction grows with the load that it carries"
    mistaken_for: ClassVar[tuple[str, ...]] = ('coulomb_friction', 'effort_gain')
    separated_by: ClassVar[str] = 'the same motion with and without a load'
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('load_coefficient', ''),)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        direction, memory = self.direction(samples, joint_index(body, self.where), memory)
        load = np.abs(self.predicted_load(body, samples))
        return on_joint(body, self.where, (load * direction)[:, None]), memory


def _way(samples: Samples, joint: int) -> Way:
    return _of_recording(samples, joint) if samples.whole else _as_recorded(samples, joint)


def _as_recorded(samples: Samples, joint: int) -> Way:
    return Way(samples.stamps, samples.position[:, joint], samples.velocity[:, joint])


@lru_cache(maxsize=32)
def _of_recording(samples: Samples, joint: int) -> Way:
    """The latest ones are remembered: a search asks for the same with each length of a bristle."""
    return _as_recorded(samples, joint).without_noise_at_rest(samples.time)
