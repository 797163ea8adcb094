"""What goes wrong most in practice, checked before any effect: units, signs, orders, axes, clocks, mounting, and too
little motion.

Do positions, velocities, accelerations and stamps tell the same story? No model is needed to see it. The change of a
signal over a fraction of a second is compared with the integral of its declared rate; their ratio is 1 when units,
signs, order and clock are right. Measured: 0.92 to 0.97 on a real iCub (its velocities lag), 1.00 on a UR3, 1.02 on a
Franka arm.

Orders, directions and axes: what would the recording say if it had been labelled otherwise? An alternative is reported
only if the recording as declared fits badly (J of ``prior_misfit`` beyond BAD_FIT) and the alternative fits far better
(FAR_BETTER times J) and well (GOOD_FIT).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.outliers import GAP_STEPS, excluded, typical_step
from semiparam_ros.diagnosis.setup.prior_misfit import channel_scale, dissipation, equations, misfit, nuisances

SPAN_S = 0.2
"""Seconds over which a change is compared with an integral: long against noise, short against the motion."""
LEAST_SPANS, MOST_SPANS = 50, 4000
"""The spans are shortened where stamps in a wrong unit would leave too few of them."""
LEAST_MOTION = 0.01
"""A joint that moves less than this in all [rad, or m] says nothing about units."""
TOLERANCE = 1.25
"""A ratio within this factor of a known one is that one; within it of 1, all is well."""
AGREEING = 0.6
"""Share of the spans that must agree with the median ratio, to a third of it, before anything is said."""
THEIRS, OWN = 0.9, 0.5
"""Least correlation with another joint's velocity, and most with the own one, before their order is doubted."""
STILL = 1e-3
DEGREE = float(np.pi / 180.0)
MOTION_UNITS = {1.0 / DEGREE: ('position', 'degrees', DEGREE), DEGREE: ('velocity', 'degrees per second', DEGREE),
                0.5 / np.pi: ('position', 'revolutions', 2.0 * np.pi),
                np.pi / 30.0: ('velocity', 'revolutions per minute', np.pi / 30.0)}
RATE_UNITS = {DEGREE: 'degrees per second squared'}

NEARLY = 0.9
"""Cosine from where on two directions of gravity count as one."""

OPPOSITE, LIKE = -0.7, 0.7
"""Correlation of the outputs with the description's prediction that speaks for the other sign, or lets their ratio
speak for a unit. As declared it is 0.83 or more on the real recordings (iCub 0.99, UR3 0.83 and 0.96, Franka 0.99)."""
UNIT_TOLERANCE = 2.0
"""A ratio within this factor of a unit's is that unit; the real UR3's efforts are 1.7 times the description's."""
OUTPUT_UNITS = {1.0 / 9.81: 'kilograms-force', 9.81: 'newtons taken for kilograms-force', 1e3: 'thousandths (mN, N mm)',
                1e-3: 'thousands (kN, kN m)', 1e2: 'hundredths (N cm)'}
PUSHING, BRAKING = -0.85, 0.3
"""Share of a joint's effort that goes against all friction, and the other joints' median, before its sign is doubted.
A delay or a resonance of size 3 can push as much, but then it brakes no other joint; a real UR3's joints brake by 0.42
to 0.98."""


FRICTION_SPEAKS = 0.5
"""Sum over the joints of the effort's share that is friction, from where on its direction settles a sign."""

BAD_FIT, FAR_BETTER, GOOD_FIT = 0.03, 0.6, 0.25
"""With any effect of three times the usual size on any simulated motion the best wrong alternative reaches 1.04 J or
more (117 recordings), on the real iCub, UR3 and Franka arms 0.98 J; mistakes put into these make J grow twice to
seventy times."""
UNEXPLAINED = 0.4
"""Share of variance that the best inertias leave when the description is not this robot's. The worst effect of three
times the usual size leaves 0.32, other arms' descriptions and sensor frames 0.43 to 1."""
NO_MATCH = 'robot_description'
MOST_ROUNDS = 2
DEGREES_BEYOND = 3.2
"""Positions beyond this [rad] may be degrees."""

MOST_SAMPLES = 250
LEAST_SAMPLES = 50


class SetupProblem(NamedTuple):
    """Something that is wrong before any physics: a unit, a sign, an order.

    ``what`` is a word for programs (``joint_order``), ``where`` the joint or frame concerned, ``sentence`` what a user
    reads.
    """

    what: str
    where: str | None
    sentence: str


class Ratio(NamedTuple):
    """Change of a signal over the integral of its declared rate: the median, and the share of spans that agree."""

    value: float
    agreement: float

    @property
    def is_telling(self) -> bool:
        """Whether the spans agree at all."""
        return self.agreement > AGREEING

    def near(self, value: float) -> bool:
        """Whether it is ``value``, sign included, beyond doubt."""
        share = self.value / value
        return self.is_telling and 1.0 / TOLERANCE < share < TOLERANCE


def motion_problems(joints: Sequence[str], samples: Samples) -> tuple[list[SetupProblem], Samples]:
    """Contradictions between positions, velocities, accelerations and stamps, and the samples put right."""
    moving = np.ptp(samples.position, axis=0) > LEAST_MOTION
    changes, integrals = _spans(samples.time, samples.position, samples.velocity)
    order = _velocity_order(joints, changes, integrals, moving)
    if order:
        return order, samples
    ratios = [_ratio(changes[:, joint], integrals[:, joint]) if moving[joint] else Ratio(1.0, 0.0)
              for joint in range(len(joints))]
    clock = _clock(samples, ratios)
    if clock:
        return clock, samples
    problems, right = [], samples
    for joint, (name, ratio) in enumerate(zip(joints, ratios, strict=True)):
        silent = moving[joint] and np.std(integrals[:, joint]) < STILL * np.std(changes[:, joint])
        found = _silent(name) if silent else _velocity(name, ratio)
        if found is not None:
            problem, role, factor = found
            problems.append(problem)
            right = _scaled(right, role, joint, factor)
    return problems + _accelerations(joints, samples, right, moving), right


def _spans(time: Array, values: Array, rates: Array) -> tuple[Array, Array]:
    """(M, k) changes of values (N, k) over SPAN_S, and the integrals of their rates over the same spans."""
    steps = np.diff(time)
    typical = typical_step(time)
    width = int(np.clip(round(SPAN_S / typical), 1, max(len(time) // LEAST_SPANS, 1)))
    pieces = 0.5 * (rates[1:] + rates[:-1]) * steps[:, None]
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(pieces, axis=0)])
    starts = np.unique(np.linspace(0, max(len(time) - 1 - width, 0), MOST_SPANS).astype(int))
    ends = np.minimum(starts + width, len(time) - 1)
    whole = time[ends] - time[starts] < (width + GAP_STEPS) * typical
    starts, ends = starts[whole], ends[whole]
    return values[ends] - values[starts], total[ends] - total[starts]


def _ratio(changes: Array, integrals: Array) -> Ratio:
    """Of one joint, from the faster half of its spans."""
    fast = np.abs(integrals) > np.median(np.abs(integrals))
    if not fast.any():
        return Ratio(1.0, 0.0)
    shares = changes[fast] / integrals[fast]
    middle = float(np.median(shares))
    return Ratio(middle, float(np.mean(np.abs(shares - middle) < abs(middle) / 3.0)))


def _velocity_order(joints: Sequence[str], changes: Array, integrals: Array, moving: Array) -> list[SetupProblem]:
    """Pairs of joints whose velocities belong to each other's positions."""
    likeness = _correlation(changes, integrals)
    own = np.diag(likeness)
    found = []
    for one in range(len(joints)):
        for other in range(one + 1, len(joints)):
            crossed = min(likeness[one, other], likeness[other, one])
            if moving[one] and moving[other] and crossed > THEIRS and max(own[one], own[other]) < OWN:
                found.append(SetupProblem('velocity_order', joints[one], (
                    f"The velocities of '{joints[one]}' and '{joints[other]}' belong to each other's positions: they "
                    'are swapped in the joint states; put them in the order of the names.')))
    return found


def _correlation(left: Array, right: Array) -> Array:
    """(k, k) correlations between columns about zero; 0 where one stands still."""
    size = np.outer(np.linalg.norm(left, axis=0), np.linalg.norm(right, axis=0))
    return np.divide(left.T @ right, size, out=np.zeros_like(size), where=size > 0.0)


def _clock(samples: Samples, ratios: list[Ratio]) -> list[SetupProblem]:
    """Stamps that run too fast or too slow for every joint alike."""
    telling = np.array([ratio.value for ratio in ratios if ratio.is_telling])
    if len(telling) < 2 or telling.min() <= 0.0 or telling.max() > TOLERANCE * telling.min():
        return []
    factor = float(np.median(telling))
    if 1.0 / TOLERANCE < factor < TOLERANCE or any(Ratio(factor, 1.0).near(known) for known in MOTION_UNITS):
        return []
    step = typical_step(samples.time)
    return [SetupProblem('clock', None, (
        f'The stamps are {step:.4g} s apart, but positions and velocities agree with {factor * step:.4g} s: correct '
        f'the stamps (for a text table: semiparam convert --period {factor * step:.4g}, or --time-unit).'))]


def _silent(name: str) -> tuple[SetupProblem, str, float]:
    return SetupProblem('velocity_missing', name, (
        f"The position of '{name}' changes while its velocity stays zero: have the driver publish velocities.")), \
        'velocity', 1.0


def _velocity(name: str, ratio: Ratio) -> tuple[SetupProblem, str, float] | None:
    """What a joint's ratio says, and which role times which factor puts it right."""
    if not ratio.is_telling or ratio.near(1.0):
        return None
    if ratio.near(-1.0):
        return SetupProblem('velocity_sign', name, (
            f"The velocity of '{name}' has the opposite sign of its change of position: negate one of them in the "
            'driver.')), 'velocity', -1.0
    for known, (role, unit, factor) in MOTION_UNITS.items():
        if ratio.near(known):
            right = 'rad' if role == 'position' else 'rad/s'
            return SetupProblem(f'{role}_units', name, (
                f"The {role} of '{name}' is in {unit}, its {'velocity' if role == 'position' else 'position'} is not: "
                f'publish it in {right} (for a text table with degrees throughout: semiparam convert --degrees).')), \
                role, factor
    return SetupProblem('velocity_scale', name, (
        f"The position of '{name}' changes {ratio.value:.3g} times as fast as its velocity says: check the gear ratio "
        'and the units in the driver.')), 'velocity', ratio.value


def _accelerations(joints: Sequence[str], samples: Samples, right: Samples, moving: Array) -> list[SetupProblem]:
    """Accelerations that contradict the velocities as they are recorded and as they should be."""
    recorded = _spans(samples.time, samples.velocity, samples.acceleration)
    corrected = _spans(samples.time, right.velocity, samples.acceleration)
    found = []
    for joint, name in enumerate(joints):
        if not moving[joint] or _ratio(recorded[0][:, joint], recorded[1][:, joint]).near(1.0):
            continue
        ratio = _ratio(corrected[0][:, joint], corrected[1][:, joint])
        units = [unit for known, unit in RATE_UNITS.items() if ratio.near(known)]
        if ratio.near(-1.0):
            found.append(SetupProblem('acceleration_sign', name, (
                f"The measured acceleration of '{name}' has the opposite sign of its change of velocity: negate it, or "
                'set acceleration.source to filter.')))
        elif units:
            found.append(SetupProblem('acceleration_units', name, (
                f"The measured acceleration of '{name}' is in {units[0]}: publish it in rad/s^2, or set "
                'acceleration.source to filter.')))
    return found


def _scaled(samples: Samples, role: str, joint: int, factor: float) -> Samples:
    """The samples with one joint's position, or its velocity, times a factor."""
    values = getattr(samples, role).copy()
    values[:, joint] *= factor
    return replace(samples, **{role: values})


def turned_over(body: RigidBody) -> RigidBody:
    """The body as it hangs from a ceiling."""
    return body.with_gravity(-_gravity(body))


def other_mountings(body: RigidBody) -> Iterator[tuple[RigidBody, SetupProblem]]:
    """The body with gravity along each other axis of its base, and what to say if that is how it is."""
    present = _gravity(body)
    strength = float(np.linalg.norm(present))
    for sign, (axis, name) in product((1.0, -1.0), enumerate('xyz')):
        gravity = sign * strength * np.eye(3)[axis]
        if gravity @ present < NEARLY * strength**2:
            along = f"with gravity along its {'-' if sign < 0 else ''}{name} axis"
            hanging = gravity @ present < -NEARLY * strength**2
            yield body.with_gravity(gravity), mounting_problem('upside down' if hanging else f'on its side, {along}')


def _gravity(body: RigidBody) -> Array:
    return np.array(body.arm.gravity.linear)


def mounting_problem(how: str) -> SetupProblem:
    """The base is mounted in another way."""
    return SetupProblem('base_mounting', None, (
        f'The recording fits the robot description far better when the base is mounted {how}: turn the first link in '
        'the robot description as the robot is mounted.'))


def output_problems(body: RigidBody, samples: Samples) -> tuple[list[SetupProblem], RigidBody, Samples]:
    """Signs and units of the outputs that are wrong, and the body and the samples put right."""
    wrench = body.outputs == 'wrench'
    slopes, likeness = _slopes(body, samples)
    found, factors = [], np.ones(body.n_outputs)
    blocks = [('force', slice(0, 3)), ('torque', slice(3, 6))] if wrench else [('effort', slice(None))]
    if likeness[-1] < OPPOSITE and _is_turned_over(body, samples):
        body = turned_over(body)
        found.append(mounting_problem('upside down'))
    elif likeness[-1] < OPPOSITE:
        found.append(_sign(body))
        factors *= -1.0
    for (name, channels), slope, like in zip(blocks, slopes, likeness, strict=False):
        unit = next((known for known in OUTPUT_UNITS if 1.0 / UNIT_TOLERANCE < abs(slope) / known < UNIT_TOLERANCE),
                    None)
        if abs(like) > LIKE and unit is not None:
            found.append(_unit(body, name, unit))
            factors[channels] /= unit
    return found, body, replace(samples, outputs=samples.outputs * factors)


def _is_turned_over(body: RigidBody, samples: Samples) -> bool:
    """Whether opposite outputs come from a base that hangs rather than from a sign: inertia and friction do not turn
    over with gravity."""
    if body.outputs == 'effort':
        friction = float(dissipation(body, samples).sum())
        if abs(friction) > FRICTION_SPEAKS:
            return friction > 0.0
    negated = misfit(equations(body, samples), -samples.outputs, body.outputs == 'wrench')
    hanging = misfit(equations(turned_over(body), samples), samples.outputs, body.outputs == 'wrench')
    return hanging.total < negated.total


def friction_problems(body: RigidBody, samples: Samples) -> list[SetupProblem]:
    """Joints whose effort would drive them where friction holds them back."""
    share = dissipation(body, samples)
    others = np.array([np.median(np.delete(share, joint)) if len(share) > 1 else 0.0 for joint in range(len(share))])
    wrong = (share < PUSHING) & (others > BRAKING)
    return [SetupProblem('effort_sign', name, (
        f"The effort of '{name}' goes with its motion as no friction can: it has the opposite sign of its velocity's; "
        'negate it in the driver.')) for name, flag in zip(body.joints, wrong, strict=True) if flag]


def _slopes(body: RigidBody, samples: Samples) -> tuple[Array, Array]:
    """Slope of the outputs against the description's prediction, and their correlation, for force and torque or for
    efforts; the last correlation is over all channels."""
    predicted = body.regressors(samples) @ body.base_parameters
    measured, predicted = (_without(nuisances(body, samples), values) for values in (samples.outputs, predicted))
    pairs = [(measured, predicted)]
    if body.outputs == 'wrench':
        parts = [(measured[:, part], predicted[:, part]) for part in (slice(0, 3), slice(3, 6))]
        pairs = [*parts, (measured / channel_scale(measured, True), predicted / channel_scale(predicted, True))]
    inner = np.array([[np.sum(y * p), np.sum(p * p), np.sum(y * y)] for y, p in pairs])
    return inner[:, 0] / (inner[:, 1] + 1e-300), inner[:, 0] / np.sqrt(inner[:, 1] * inner[:, 2] + 1e-300)


def _without(columns: Array, values: Array) -> Array:
    """Values (N, n) less what the nuisances explain of each channel."""
    left = np.empty_like(values)
    for channel in range(values.shape[1]):
        own = columns[:, channel, np.any(columns[:, channel] != 0.0, axis=0)]
        left[:, channel] = values[:, channel] - own @ np.linalg.lstsq(own, values[:, channel], rcond=1e-9)[0]
    return left


def _sign(body: RigidBody) -> SetupProblem:
    if body.outputs == 'effort':
        return SetupProblem('effort_sign', None, (
            'The efforts have the opposite sign of what the robot description predicts: negate them (semiparam convert '
            '--effort-sign -1).'))
    other = 'action' if body.sign < 0 else 'reaction'
    return SetupProblem('wrench_sign', body.sensor_frame, (
        'The wrench has the opposite sign of what the robot description predicts: set the parameter wrench_convention '
        f'to {other}.'))


def _unit(body: RigidBody, name: str, unit: float) -> SetupProblem:
    right = {'force': 'N', 'torque': 'N m', 'effort': 'N m'}[name]
    return SetupProblem('output_units', body.sensor_frame, (
        f'The {name} is {unit:.3g} times what the robot description predicts, as if it were in {OUTPUT_UNITS[unit]}: '
        'publish '
        f'it in {right}.'))


class Alternative(NamedTuple):
    """The samples as they would be, and what to say if that is how they are; the body where it is another one."""

    samples: Samples
    problem: SetupProblem
    body: RigidBody | None = None


def layout_problems(body: RigidBody, samples: Samples) -> list[SetupProblem]:
    """Everything that a relabelling of the samples would put right, the plainest first."""
    found, body, samples = output_problems(body, samples)
    for _ in range(MOST_ROUNDS):
        best = _best_alternative(body, samples)
        if best is None:
            break
        found.append(best.problem)
        body, samples = best.body or body, best.samples
    left = misfit(equations(body, samples), samples.outputs, body.outputs == 'wrench').left
    if left > UNEXPLAINED:
        return [_no_match(body, left)]
    return found + (friction_problems(body, samples) if body.outputs == 'effort' and left < GOOD_FIT else [])


def _best_alternative(body: RigidBody, samples: Samples) -> Alternative | None:
    """The alternative that fits far better than the samples as they are, if these fit badly."""
    wrench = body.outputs == 'wrench'
    equal = equations(body, samples)
    declared = misfit(equal, samples.outputs, wrench).total
    if declared < BAD_FIT:
        return None
    best, least = None, min(FAR_BETTER * declared, GOOD_FIT)
    for alternative in _alternatives(body, samples):
        same = alternative.samples.position is samples.position and alternative.body is None
        there = equal if same else equations(alternative.body or body, alternative.samples)
        total = misfit(there, alternative.samples.outputs, wrench).total
        if total < least:
            best, least = alternative, total
    return best


def _alternatives(body: RigidBody, samples: Samples) -> Iterator[Alternative]:
    if body.outputs == 'wrench':
        yield from _other_axes(body, samples)
    else:
        yield from _other_effort_signs(body, samples)
    for mounted, problem in other_mountings(body):
        yield Alternative(samples, problem, mounted)
    yield from _other_directions(body, samples)
    yield from _other_orders(body, samples)
    if np.abs(samples.position).max() > DEGREES_BEYOND:
        yield _radians(samples)


def _other_axes(body: RigidBody, samples: Samples) -> Iterator[Alternative]:
    """The other 47 signed permutations of the sensor's axes, one channel negated, force and torque exchanged."""
    frame = body.sensor_frame
    force, torque = samples.outputs[:, :3], samples.outputs[:, 3:]
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        if (order, signs) == ((0, 1, 2), (1.0, 1.0, 1.0)):
            continue
        outputs = np.hstack([force[:, order] * signs, torque[:, order] * signs])
        names = ', '.join(('-' if sign < 0 else '') + 'xyz'[axis] for axis, sign in zip(order, signs, strict=True))
        yield Alternative(replace(samples, outputs=outputs), SetupProblem('wrench_axes', frame, (
            f"The wrench fits the robot description far better when the sensor's axes ({names}) are taken for x, y, z "
            f"of '{frame}': turn that frame in the robot description, or set sensor_frame to one that has the "
            f"sensor's axes.{_mirrored(order, signs)}")))
    for channel, name in enumerate(body.output_names):
        negated = replace(samples, outputs=_negated(samples.outputs, channel))
        yield Alternative(negated, SetupProblem('wrench_sign', name, (
            f"The channel {name} of '{frame}' fits the robot description far better with the opposite sign: negate it "
            "in the sensor's driver or calibration.")))
    yield Alternative(replace(samples, outputs=np.hstack([torque, force])), SetupProblem('force_torque', frame, (
        f"The wrench of '{frame}' fits far better with force and torque exchanged: the driver (or the columns of the "
        'text table) gives them in the wrong order.')))


def _mirrored(order: tuple[int, ...], signs: tuple[float, ...]) -> str:
    """A hint where no turn makes these axes."""
    hand = float(np.linalg.det(np.eye(3)[list(order)])) * float(np.prod(signs))
    return ' No turn does that: an axis of the sensor is mirrored, or the robot (a left arm for a right one).' \
        if hand < 0.0 else ''


def _other_effort_signs(body: RigidBody, samples: Samples) -> Iterator[Alternative]:
    for joint, name in enumerate(body.joints):
        negated = replace(samples, outputs=_negated(samples.outputs, joint))
        yield Alternative(negated, SetupProblem('effort_sign', name, (
            f"The effort of '{name}' fits the robot description far better with the opposite sign: negate it in the "
            'driver.')))


def _other_directions(body: RigidBody, samples: Samples) -> Iterator[Alternative]:
    for joint, name in enumerate(body.joints):
        mirrored = replace(samples, position=_negated(samples.position, joint),
                           velocity=_negated(samples.velocity, joint),
                           acceleration=_negated(samples.acceleration, joint))
        if body.outputs == 'effort':
            mirrored = replace(mirrored, outputs=_negated(samples.outputs, joint))
        yield Alternative(mirrored, SetupProblem('joint_direction', name, (
            f"The recording fits the robot description far better when '{name}' turns the other way: negate its "
            'position, velocity (and effort) in the driver, or its axis in the robot description.')))


def _other_orders(body: RigidBody, samples: Samples) -> Iterator[Alternative]:
    for one, other in combinations(range(body.n_joints), 2):
        order = np.arange(body.n_joints)
        order[[one, other]] = other, one
        swapped = replace(samples, position=samples.position[:, order], velocity=samples.velocity[:, order],
                          acceleration=samples.acceleration[:, order])
        if body.outputs == 'effort':
            swapped = replace(swapped, outputs=samples.outputs[:, order])
        yield Alternative(swapped, SetupProblem('joint_order', body.joints[one], (
            f"The recording fits the robot description far better with '{body.joints[one]}' and "
            f"'{body.joints[other]}' exchanged: correct the names in the joint states (for a bag: semiparam convert "
            '--joint NAME=NEW) or the parameter joints.')))


def _radians(samples: Samples) -> Alternative:
    turn = np.pi / 180.0
    right = replace(samples, position=samples.position * turn, velocity=samples.velocity * turn,
                    acceleration=samples.acceleration * turn)
    return Alternative(right, SetupProblem('position_units', None, (
        'Positions and velocities are in degrees: publish them in rad and rad/s (for a text table: semiparam convert '
        '--degrees).')))


def _negated(values: Array, column: int) -> Array:
    values = values.copy()
    values[:, column] *= -1.0
    return values


def _no_match(body: RigidBody, left: float) -> SetupProblem:
    there = f" or the parameter sensor_frame ('{body.sensor_frame}')" if body.outputs == 'wrench' else ''
    return SetupProblem(NO_MATCH, body.sensor_frame, (
        f'No inertias explain the outputs: {100 * min(left, 1.0):.0f} % of their variance stay with the best ones, '
        'and no other order, sign or unit helps; check that the robot description is that of this robot, the parameter '
        f'joints{there}, and that the outputs are not compensated for gravity.'))


def setup_problems(body: RigidBody, samples: Samples) -> list[SetupProblem]:
    """What is wrong with the recording or with its declaration, each with its remedy; empty when nothing is.

    :param samples: as recorded. A quarter of a thousand of them, spread over the recording, are looked at.
    """
    if len(samples) < LEAST_SAMPLES or np.all(np.ptp(samples.position, axis=0) < LEAST_MOTION):
        return []
    if not np.ptp(samples.outputs, axis=0).any():
        return [_constant(body)]
    found, right = motion_problems(body.joints, samples)
    if any(problem.what in ('clock', 'velocity_order') for problem in found):
        return found
    usable = np.flatnonzero(~excluded(samples))
    if len(usable) < LEAST_SAMPLES:
        return found
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, MOST_SAMPLES).astype(int))]
    return found + layout_problems(body, right[chosen])


def _constant(body: RigidBody) -> SetupProblem:
    what = 'wrench' if body.outputs == 'wrench' else 'efforts'
    return SetupProblem('outputs_constant', body.sensor_frame, (
        f'The {what} never change{"s" if what == "wrench" else ""} while the robot moves: check that the sensor is '
        'switched on and that its driver publishes what it measures.'))
