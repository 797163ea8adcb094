"""Geometry and timing: a joint's zero, the level of the base, the time of the outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, NamedTuple, cast

import numpy as np
import pinocchio as pin

from semiparam_ros.core.columns import Absent, Memory
from semiparam_ros.core.robot.rigid_body import GRAVITY, RigidBody
from semiparam_ros.core.robot.size import reach_of
from semiparam_ros.core.robot.small_turns import small_turns
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.effects.base import CALIBRATED, Axis, Coefficient, Effect, joint_index

MOST_TURN = 0.8
"""Angle [rad] beyond which a zero or a base is not off but another one: half a right angle."""
LONGEST_DELAY_S = 1e6
"""Nothing is remembered for a longer one."""
POINTS, DEGREE = 11, 4
"""Samples, and degree of the polynomial, from which an acceleration between them is told in a whole recording."""
HALF_WIDTH = 4.8
"""Of the kernel [samples]: with this one noise is averaged as much between two samples as at one of them, to 3 %."""


class JointOffset(Effect):
    """The true angle is the encoder's plus ``offset``."""

    kind: ClassVar[str] = 'joint_offset'
    group: ClassVar[str] = 'zeros'
    of_joint: ClassVar[bool] = True
    shows_against: ClassVar[Axis] = 'position'
    sentence: ClassVar[str] = "the joint's zero is off"
    mistaken_for: ClassVar[tuple[str, ...]] = ('gravity_tilt', 'sensor_misalignment', 'sensor_crosstalk')
    separated_by: ClassVar[str] = ('motion of the joints before it, which turns a tilt of the base against '
                                   'the joint, and of those after it')
    calibrations: ClassVar[tuple[Coefficient, ...]] = (Coefficient('offset', 'rad'),)

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return body.joints

    @property
    def possible(self) -> bool:
        return abs(self.value('offset')) < MOST_TURN

    def correct(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[RigidBody, Samples, Memory]:
        position = samples.position.copy()
        position[:, joint_index(body, self.where)] += self.value('offset')
        return body, replace(samples, position=position), None


class GravityTilt(Effect):
    """The base is turned by a small rotation about its horizontal axes, so gravity points elsewhere."""

    kind: ClassVar[str] = 'gravity_tilt'
    shows_against: ClassVar[Axis] = 'position'
    sentence: ClassVar[str] = 'the base is not level'
    mistaken_for: ClassVar[tuple[str, ...]] = ('joint_offset', 'sensor_misalignment')
    separated_by: ClassVar[str] = 'a turn of the arm about a vertical axis, or a spirit level on the base'
    calibrations: ClassVar[tuple[Coefficient, ...]] = (Coefficient('tilt_x', 'rad'), Coefficient('tilt_y', 'rad'))

    @property
    def possible(self) -> bool:
        return max(abs(self.value('tilt_x')), abs(self.value('tilt_y'))) < MOST_TURN

    def correct(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[RigidBody, Samples, Memory]:
        turn = pin.exp3(np.array([self.value('tilt_x'), self.value('tilt_y'), 0.0]))
        return body.with_gravity(turn.T @ GRAVITY), samples, None


class _SmallTurn(Effect):
    """A turn that came while the robot worked: what it adds to the reference model's outputs, to first order."""

    may_come: ClassVar[bool] = True
    needs_reference: ClassVar[bool] = True
    shows_against: ClassVar[Axis] = 'position'

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        """Return no place: in a whole recording the calibration of the same cause is searched."""
        return ()

    def on_links(self, body: RigidBody) -> bool:
        return True

    def conceivable(self, body: RigidBody, coefficients: Array) -> bool:
        return float(np.abs(coefficients).max()) < MOST_TURN

    def prior_scale(self, body: RigidBody) -> Array:
        return np.full(len(self.coefficients(body)), CALIBRATED['rad'])


class BaseShift(_SmallTurn):
    """A base that was knocked: a small turn about its horizontal axes."""

    kind: ClassVar[str] = 'base_shift'
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('tilt_x', 'rad'), Coefficient('tilt_y', 'rad'))
    sentence: ClassVar[str] = 'the base was turned'
    mistaken_for: ClassVar[tuple[str, ...]] = ('zero_slip', 'external_force')
    separated_by: ClassVar[str] = 'a turn of the arm about a vertical axis, or a spirit level on the base'

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return (None,)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        return small_turns(body).of_base(samples, self.reference_model(body)), None


class ZeroSlip(_SmallTurn):
    """A joint's zero that slipped: from then on the true angle is the encoder's plus ``offset``."""

    kind: ClassVar[str] = 'zero_slip'
    of_joint: ClassVar[bool] = True
    names: ClassVar[tuple[Coefficient, ...]] = (Coefficient('offset', 'rad'),)
    sentence: ClassVar[str] = "the joint's zero has slipped"
    mistaken_for: ClassVar[tuple[str, ...]] = ('base_shift', 'effort_offset', 'payload')
    separated_by: ClassVar[str] = JointOffset.separated_by

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return body.joints

    def conceivable(self, body: RigidBody, coefficients: Array) -> bool:
        return float(np.abs(coefficients).max()) < (reach_of(body) if self.where in body.prismatic else MOST_TURN)

    def prior_scale(self, body: RigidBody) -> Array:
        """Prior (1,) of the calibration of the same cause, of the arm's size where the joint slides."""
        return JointOffset(self.where).calibration_scale(body)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        joint = joint_index(body, self.where)
        return small_turns(body).of_zero(samples, self.reference_model(body), joint)[:, :, None], None


class _Past(NamedTuple):
    """Newest inputs, enough to interpolate: stamps (k,) [ns], and motion (k, joints)."""

    stamps: Stamps
    position: Array
    velocity: Array
    acceleration: Array


class TimeDelay(Effect):
    """The outputs lag the joint states by ``delay_s`` (lead, when negative)."""

    kind: ClassVar[str] = 'time_delay'
    shows_against: ClassVar[Axis] = 'output_rate'
    sentence: ClassVar[str] = 'the outputs and the joint states are stamped at different times'
    mistaken_for: ClassVar[tuple[str, ...]] = ('viscous_drag', 'viscous_friction')
    separated_by: ClassVar[str] = 'faster motion: a delay grows with speed, a friction does not'
    calibrations: ClassVar[tuple[Coefficient, ...]] = (Coefficient('delay_s', 's'),)
    moves_friction: ClassVar[bool] = True
    averages: ClassVar[bool] = True
    kept: ClassVar[int] = 64
    most_kept: ClassVar[int] = 4096
    """So many samples are remembered at most, of a long delay: four seconds at 1 kHz."""

    @property
    def late_s(self) -> float:
        return self.value('delay_s')

    def desired(self) -> Absent:
        """A delay lies between two measurements; a desired state is not one."""
        return Absent(self)

    def correct(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[RigidBody, Samples, Memory]:
        past = _Past(samples.stamps, samples.position, samples.velocity, samples.acceleration)
        if memory is not None:
            past = _joined(cast('_Past', memory), past)
        wanted = samples.stamps - round(self.value('delay_s') * 1e9)
        centred = samples.whole and memory is None
        fresh = np.diff(past.stamps, prepend=past.stamps[:1] - 1) > 0  # of two samples with one stamp, the first
        newest = (np.cumsum(fresh) - 1)[len(fresh) - len(samples):]
        if centred:
            newest = np.full(len(samples), newest[-1])
        past = _Past(*(values[fresh] for values in past))  # type: ignore[arg-type]
        inputs = _interpolated(past, wanted, newest, centred)
        delayed = replace(samples, position=inputs[0], velocity=inputs[1], acceleration=inputs[2])
        needed = self._needed(past.stamps)
        return body, delayed, _Past(*(values[-needed:] for values in past))  # type: ignore[arg-type]

    def _needed(self, stamps: Stamps) -> int:
        """Number of the newest samples between which the next ones are interpolated."""
        reach_s = min(max(self.value('delay_s'), -3.0 * self.value('delay_s')), LONGEST_DELAY_S)
        first = int(np.searchsorted(stamps, stamps[-1] - round(reach_s * 1e9), side='right')) - 2
        return min(max(len(stamps) - first, self.kept), self.most_kept)


class VelocityFilter(Effect):
    """The driver filters velocities: the true one is the recorded one plus ``time_constant_s`` times its change.

    Not in a whole recording: its positions have put the velocities right.
    """

    kind: ClassVar[str] = 'velocity_filter'
    shows_against: ClassVar[Axis] = 'acceleration'
    sentence: ClassVar[str] = 'the recorded velocities are filtered, so they come late'
    mistaken_for: ClassVar[tuple[str, ...]] = ('time_delay', 'rotor_inertia')
    separated_by: ClassVar[str] = 'the positions: their change tells how late the velocities are'
    calibrations: ClassVar[tuple[Coefficient, ...]] = (Coefficient('time_constant_s', 's'),)
    moves_friction: ClassVar[bool] = True

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        """Return no place: the positions tell it without a model, and a diagnosis then says so."""
        return ()

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return (None,)

    def desired(self) -> Absent:
        """A desired velocity is exact."""
        return Absent(self)

    def correct(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[RigidBody, Samples, Memory]:
        if samples.whole:
            return body, samples, None
        velocity = samples.velocity + self.value('time_constant_s') * samples.acceleration
        return body, replace(samples, velocity=velocity), None


def _joined(before: _Past, after: _Past) -> _Past:
    stamps, *motion = (np.concatenate(pair) for pair in zip(before, after, strict=True))
    return _Past(stamps, *motion)  # type: ignore[arg-type]


def _interpolated(past: _Past, wanted: Stamps, newest: Stamps, centred: bool) -> tuple[Array, Array, Array]:
    """Inputs at ``wanted`` [ns] by pieces that end no later than the sample numbered ``newest``.

    Positions and velocities by cubics through values and slopes, accelerations from values alone: the derivative of the
    cubics would take in the velocities' noise, least where a delay is a whole number of samples, and so draw it there.
    What comes after the newest sample is extrapolated from a piece as long as the way to it, so that one sample at a
    time gives what the whole recording gives. Where there is none so long, nor one that begins so early, the nearest
    sample alone tells it: beyond its length, a piece gives its noise times the cube of the lengths.
    """
    last = past.stamps[newest]
    begin = wanted if centred else np.minimum(wanted, last - (wanted - last))
    left = np.clip(np.searchsorted(past.stamps, begin, side='right') - 1, 0, np.maximum(newest - 1, 0))
    right = np.where(begin < wanted, newest, np.minimum(left + 1, len(past.stamps) - 1))
    step = np.maximum(past.stamps[right] - past.stamps[left], 1)[:, None] * 1e-9
    ahead = np.asarray((wanted - past.stamps[left])[:, None] * 1e-9, dtype=float)
    position = _hermite(past.position, past.velocity, left, right, step, ahead / step)
    velocity = _hermite(past.velocity, past.acceleration, left, right, step, ahead / step)
    far = (newest == 0) | ((ahead > 2.0 * step) | (ahead < -step))[:, 0]
    if centred:
        acceleration = np.empty_like(position)
        acceleration[~far] = _centred(past, wanted[~far])
    else:
        acceleration = _parabola(past.acceleration, past.stamps, left, right, ahead)
    if far.any():
        near = np.where(ahead[:, 0] > 0.0, right, left)[far]
        after = (wanted[far] - past.stamps[near])[:, None] * 1e-9
        acceleration[far] = past.acceleration[near]
        velocity[far] = past.velocity[near] + after * past.acceleration[near]
        position[far] = past.position[near] + after * (past.velocity[near] + 0.5 * after * past.acceleration[near])
    return position, velocity, acceleration


def _centred(past: _Past, wanted: Stamps) -> Array:
    """Accelerations at ``wanted`` [ns] by local polynomial regression with the tricube kernel (Cleveland 1979, Journal
    of the American Statistical Association 74).

    It averages noise alike wherever between the samples. A polynomial through these keeps all noise at them, and three
    quarters between them: that lowers the error though there is no delay, most with half a sample's.
    """
    stamps, values = past.stamps, past.acceleration
    if len(stamps) < POINTS:
        return np.column_stack([np.interp(wanted, stamps, column) for column in values.T])
    nearest = np.clip(np.searchsorted(stamps, wanted), 1, len(stamps) - 1)
    nearest -= wanted - stamps[nearest - 1] < stamps[nearest] - wanted
    rows = np.clip(nearest - POINTS // 2, 0, len(stamps) - POINTS)[:, None] + np.arange(POINTS)
    away = np.asarray((stamps[rows] - wanted[:, None]) * 1e-9, dtype=float)
    enough = np.partition(np.abs(away), DEGREE + 1, axis=1)[:, [DEGREE + 1]]  # of samples that count, in a gap too
    away /= np.maximum(HALF_WIDTH * np.median(np.diff(stamps)) * 1e-9, enough)
    weights = np.maximum(1.0 - np.abs(away * away * away), 0.0)
    weights *= weights * weights
    powers = np.ones((*away.shape, DEGREE + 1))
    np.multiply.accumulate(np.broadcast_to(away[:, :, None], (*away.shape, DEGREE)), axis=2, out=powers[:, :, 1:])
    weighted = powers * weights[:, :, None]
    first = np.broadcast_to(np.eye(DEGREE + 1)[:, :1], (len(rows), DEGREE + 1, 1))
    shares = weighted @ np.linalg.solve(powers.transpose(0, 2, 1) @ weighted, first)
    return np.asarray((shares.transpose(0, 2, 1) @ values[rows])[:, 0])


def _parabola(values: Array, stamps: Stamps, left: Stamps, right: Stamps, ahead: Array) -> Array:
    """Value, ``ahead`` [s] of ``left``, of the parabola through left, right and the one as long before; else of a
    line."""
    earliest = np.searchsorted(stamps, stamps[left] - (stamps[right] - stamps[left]), side='right') - 1
    known = np.where(right > left + 1, earliest, left - 1)
    before = np.maximum(known, 0)

    def slope(start: Stamps, end: Stamps) -> tuple[Array, Array]:
        step = np.where(end > start, stamps[end] - stamps[start], 1)[:, None] * 1e-9
        return (values[end] - values[start]) / step, step

    (rise, step), (earlier, step_before) = slope(left, right), slope(before, left)
    bend = np.where((known >= 0)[:, None], (rise - earlier) / (step + step_before), 0.0)
    return np.asarray(values[left] + ahead * (rise + (ahead - step) * bend))


def _hermite(values: Array, slopes: Array, left: Stamps, right: Stamps, step: Array, u: Array) -> Array:
    """Value of the cubic through two values with two slopes, at the share u of the step."""
    start, end = values[left], values[right]
    rise, fall = slopes[left] * step, slopes[right] * step
    square, cube = 3 * (end - start) - 2 * rise - fall, 2 * (start - end) + rise + fall
    return np.asarray(start + u * (rise + u * (square + u * cube)))
