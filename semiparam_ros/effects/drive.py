"""Drives: additions of motors, gears and torque sensors to a joint's effort."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from semiparam_ros.core.columns import ColumnBlock, Memory
from semiparam_ros.core.robot.joint_friction import rotor_prior
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.effects.base import ALWAYS, Axis, Coefficient, Effect, Values, channel_index, joint_index, on_joint
from semiparam_ros.effects.friction import JointEffect
from semiparam_ros.effects.hysteresis import Way, play_place
from semiparam_ros.effects.periodic import kept_of_a_sine, strongest_peaks

ORDER_STEP, ORDER_BINS = 0.1, 2**18
ORDERS = ORDER_STEP * np.arange(20, 2400)
"""Of what turns [1/rad]. A slide has no turn of its own, so its reach counts as one."""
ORDER_REACH = 0.15
"""A line search looks at least so far [1/rad] on either side of an order: past its neighbours among ORDERS."""
PEAKS = 3
LEAST_GAIN = -0.9
"""Gain below which an effort would hardly be measured, or with the wrong sign."""
FLANK = 0.075
"""Share of the gap over which a flank usually takes the load: teeth give."""


class RotorInertia(JointEffect):
    """The motor's own inertia, seen through the gear."""

    kind: ClassVar[str] = 'rotor_inertia'
    group: ClassVar[str] = 'rotors'
    shows_against: ClassVar[Axis] = 'acceleration'
    resists: ClassVar[bool] = True
    sentence: ClassVar[str] = "the motor's rotor resists acceleration"
    mistaken_for: ClassVar[tuple[str, ...]] = ('payload',)
    separated_by: ClassVar[str] = "fast motion of this joint in several postures: a link's inertia changes with them"
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('inertia', 'kg m^2'),)

    def prior_scale(self, body: RigidBody) -> Array:
        """Prior standard deviation (1,) as in every model of efforts (``core.robot.joint_friction``)."""
        return rotor_prior(body)[[channel_index(body, self.where)]]

    def functions(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        return acceleration[:, None]


class JointSpring(JointEffect):
    """A spring across the joint, as a balancer or a stiff cable is."""

    kind: ClassVar[str] = 'joint_spring'
    shows_against: ClassVar[Axis] = 'position'
    sentence: ClassVar[str] = 'a spring acts across the joint'
    mistaken_for: ClassVar[tuple[str, ...]] = ('effort_offset', 'gravity_tilt', 'joint_offset')
    separated_by: ClassVar[str] = "the joint's whole range in several postures of the others"
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('stiffness', 'N m/rad'), Coefficient('rest_torque', 'N m'))

    def physical(self, coefficients: Array) -> bool:
        """Tell whether the spring pulls back: one that pushes makes up for a wrong mass."""
        return float(coefficients[0]) > 0.0

    def functions(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        return np.column_stack([position, np.ones_like(position)])


class EffortOffset(JointEffect):
    """A constant added to the measured effort."""

    kind: ClassVar[str] = 'effort_offset'
    group: ClassVar[str] = 'plain friction'
    shows_against: ClassVar[Axis] = 'time'
    sentence: ClassVar[str] = "the joint's measured effort has a constant offset"
    mistaken_for: ClassVar[tuple[str, ...]] = ('asymmetric_friction', 'joint_spring', 'external_force')
    separated_by: ClassVar[str] = 'motion through the whole range in both directions'
    may_start: ClassVar[bool] = True
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('offset', 'N m'),)

    def functions(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        return np.ones((len(position), 1))


class EffortGain(Effect):
    """The measured effort of one joint is too large or too small by a factor."""

    kind: ClassVar[str] = 'effort_gain'
    shows_against: ClassVar[Axis] = 'output'
    outputs: ClassVar[tuple[str, ...]] = ('effort',)
    sentence: ClassVar[str] = "the joint's effort is measured with a wrong gain (torque constant, gear ratio)"
    mistaken_for: ClassVar[tuple[str, ...]] = ('load_friction',)
    separated_by: ClassVar[str] = 'a known load, or motion in which several joints carry the same links'
    calibrations: ClassVar[tuple[Coefficient, ...]] = (Coefficient('gain', ''),)

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return body.output_names

    @property
    def possible(self) -> bool:
        return self.value('gain') > LEAST_GAIN

    def transform(self, body: RigidBody, regressors: Array) -> Array:
        gains = np.ones((body.n_outputs, 1))
        gains[channel_index(body, self.where)] += self.value('gain')
        return np.asarray(gains * regressors)


class CommonGain(Effect):
    """The measured efforts of all joints are too large or too small by one factor, as by the unit of a current."""

    kind: ClassVar[str] = 'common_gain'
    shows_against: ClassVar[Axis] = 'output'
    outputs: ClassVar[tuple[str, ...]] = ('effort',)
    sentence: ClassVar[str] = 'all efforts are measured with one wrong gain'
    mistaken_for: ClassVar[tuple[str, ...]] = ('payload', 'effort_gain')
    separated_by: ClassVar[str] = 'a load of known mass: without one a common gain and every mass are one freedom'
    calibrations: ClassVar[tuple[Coefficient, ...]] = (Coefficient('gain', ''),)

    def transform(self, body: RigidBody, regressors: Array) -> Array:
        return np.asarray((1.0 + self.value('gain')) * regressors)


def gains(effects: Sequence[ColumnBlock], body: RigidBody) -> dict[str, float]:
    """Factor by which the effort of each joint is read, one without a gain among the effects."""
    read = np.ones((1, body.n_outputs, 1))
    for effect in effects:
        if isinstance(effect, (EffortGain, CommonGain)):
            read = effect.transform(body, read)
    return dict(zip(body.output_names, read.ravel().tolist(), strict=True))


class GearCoupling(Effect):
    """A joint moves with the motor of the joint that carries it: its true angle is the recorded one plus ``ratio``
    times that joint's, and that motor carries ``ratio`` of its torque."""

    kind: ClassVar[str] = 'gear_coupling'
    shows_against: ClassVar[Axis] = 'position'
    sentence: ClassVar[str] = 'the joint moves with the one before it: their gears are coupled'
    mistaken_for: ClassVar[tuple[str, ...]] = ('joint_offset', 'gravity_tilt')
    separated_by: ClassVar[str] = 'motion of either joint while the other stands still'
    moves_friction: ClassVar[bool] = True
    calibrations: ClassVar[tuple[Coefficient, ...]] = (Coefficient('ratio', ''),)

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        outputs = body.output_names
        return [name for name in body.joints if (before := _carrier(body, name)) is not None
                and (before not in outputs or name in outputs)]

    def correct(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[RigidBody, Samples, Memory]:
        joint, before = joint_index(body, self.where), joint_index(body, _carrier(body, self.where))
        moved = {role: getattr(samples, role).copy() for role in ('position', 'velocity', 'acceleration')}
        for values in moved.values():
            values[:, joint] += self.value('ratio') * values[:, before]
        return body, replace(samples, **moved), None

    def transform(self, body: RigidBody, regressors: Array) -> Array:
        before = _carrier(body, self.where)
        if before not in body.output_names:  # nor are they of a wrench
            return regressors
        shaped = regressors.copy()
        shaped[:, channel_index(body, before)] += self.value('ratio') * regressors[:, channel_index(body, self.where)]
        return shaped


class TransmissionRipple(JointEffect):
    """A torque that repeats with the joint's angle, as gears and cogging make it."""

    kind: ClassVar[str] = 'transmission_ripple'
    shows_against: ClassVar[Axis] = 'position'
    sentence: ClassVar[str] = "the gear's torque ripples with the joint's angle"
    mistaken_for: ClassVar[tuple[str, ...]] = ('periodic_disturbance', 'joint_spring')
    separated_by: ClassVar[str] = 'the same path at two speeds: a ripple follows the angle, not the clock'
    parameter_units: ClassVar[dict[str, str]] = {'order': '1/rad'}
    values_by_row: ClassVar[bool] = True
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('sin', 'N m'), Coefficient('cos', 'N m'))

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None, residual: Array) -> Sequence[Values]:
        joint, channel = joint_index(body, where), channel_index(body, where)
        position, left = samples.position[:, joint], residual[:, channel] - residual[:, channel].mean()
        reach = max(float(np.ptp(position)), 1e-6)
        turned = position * (2.0 * np.pi / reach if where in body.prismatic else 1.0)
        orders = ORDERS[ORDERS * np.ptp(turned) > 2.0 * np.pi]
        if not len(orders):
            return ()
        power = _order_spectrum(turned, left)[len(ORDERS) - len(orders):]
        scale = float(np.ptp(turned)) / reach
        return [{'order': scale * float(orders[index])} for index in strongest_peaks(power, PEAKS)]

    def bounds(self, name: str, body: RigidBody, samples: Samples, residual: Array) -> tuple[float, float]:
        reach = float(np.ptp(samples.position[:, joint_index(body, self.where)]))
        width = max(ORDER_REACH, np.pi / max(reach, 1e-6))  # a peak of the spectrum is about twice as wide
        return max(self.value(name) - width, ORDER_STEP), self.value(name) + width

    def functions(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        angle = self.value('order', 1.0) * position
        return np.column_stack([np.sin(angle), np.cos(angle)])

    @property
    def of_motion_alone(self) -> bool:
        return self.span == ALWAYS  # of one sample, which averages nothing

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        columns, memory = super().basis(body, samples, memory)
        passed_hz = self.value('order', 1.0) * samples.velocity[:, joint_index(body, self.where)] / (2.0 * np.pi)
        return columns * kept_of_a_sine(passed_hz, samples)[:, None, None], memory


class Backlash(JointEffect):
    """Play in the gear: what rubs behind it is felt on either flank, and not while the gap is crossed."""

    kind: ClassVar[str] = 'backlash'
    shows_against: ClassVar[Axis] = 'position'
    resists: ClassVar[bool] = True
    sentence: ClassVar[str] = 'the gear has play: after each reversal its torque is gone until the gap is crossed'
    mistaken_for: ClassVar[tuple[str, ...]] = ('coulomb_friction',)
    separated_by: ClassVar[str] = 'small reversals, within and beyond the play'
    parameter_units: ClassVar[dict[str, str]] = {'gap': 'rad', 'flank': 'rad'}
    positive: ClassVar[tuple[str, ...]] = ('gap', 'flank')
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('torque', 'N m'),)

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None, residual: Array) -> Sequence[Values]:
        reach = max(float(np.ptp(samples.position[:, joint_index(body, where)])), 1e-6)
        return [{'gap': reach * share} for share in (0.03, 0.06, 0.1, 0.16, 0.3)]

    def finer(self) -> Backlash:
        return self.with_values(flank=FLANK * self.value('gap'))

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        joint = joint_index(body, self.where)
        way = Way(samples.stamps, samples.position[:, joint], samples.velocity[:, joint])
        gap = self.value('gap', 0.01)
        place, memory = play_place(way, gap, memory)
        flank = min(self.value('flank', FLANK * gap) / (0.5 * gap), 1.0)
        contact = np.sign(place) * np.maximum(np.abs(place) - 1.0 + flank, 0.0) / flank
        return on_joint(body, self.where, contact[:, None]), memory


def _carrier(body: RigidBody, joint: str | None) -> str | None:
    """Name of the moving joint that carries a joint, in whichever order joints are named; None of a first one."""
    name = body.arm.names[body.arm.parents[body.arm.getJointId(joint)]]
    return str(name) if name in body.joints else None


def _order_spectrum(position: Array, signal: Array) -> Array:
    """Sizes (orders,) of what repeats in a signal (N,) with a position (N,) [rad], at ORDERS.

    Sums the signal in bins so fine that no order turns by more than 0.03 rad in half of one, then
    transforms them.
    """
    width = 2.0 * np.pi / (ORDER_STEP * ORDER_BINS)
    bins = ((position - position.min()) / width).astype(int) % ORDER_BINS
    sums = np.bincount(bins, signal, ORDER_BINS)
    return np.asarray(np.abs(np.fft.rfft(sums))[20:2400])
