"""Checks of what the recording says it is, before any effect: units, signs, orders, axes, clocks and mounting.

Do positions, velocities, accelerations and stamps agree? That needs no model. The change of a
signal over a fraction of a second is compared with the integral of its declared rate; their ratio is 1 when units,
signs, order and clock are right. Measured: 0.92 to 0.97 on a real iCub (its velocities lag), 1.00 on a UR3, 1.02 on a
Franka arm.

Orders, directions and axes: what would the recording say if it had been labelled otherwise? The likeliest remedy
is reported if the evidence of ``prior_misfit`` is far larger with it than as declared.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

from semiparam_ros.core.columns import CoupledColumns, Memories
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.signals.rests import typical_step
from semiparam_ros.core.types import Array, Mask, Stamps
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import untouched, working_factor
from semiparam_ros.diagnosis.data.splits import evenly
from semiparam_ros.diagnosis.preparation import Inputs
from semiparam_ros.diagnosis.setup.prior_misfit import (
    Equations,
    equations,
    evidence,
    independent,
    nuisances,
    share_left,
)
from semiparam_ros.effects import Effect
from semiparam_ros.errors import listed

MOTION = ('position', 'velocity', 'acceleration')
DEGREE = float(np.pi / 180.0)
MOTION_UNITS = {1.0 / DEGREE: ('position', 'degrees', DEGREE), DEGREE: ('velocity', 'degrees per second', DEGREE),
                0.5 / np.pi: ('position', 'revolutions', 2.0 * np.pi),
                np.pi / 30.0: ('velocity', 'revolutions per minute', np.pi / 30.0)}
OUTPUT_UNITS = {1.0 / 9.81: 'kilograms-force', 9.81: 'newtons taken for kilograms-force', 1e3: 'thousandths (mN, N mm)',
                1e-3: 'thousands (kN, kN m)', 1e2: 'hundredths (N cm)'}
ACCELERATIONS = (
    (-1.0, 'acceleration_sign', 'has the opposite sign of its change of velocity: negate it'),
    (DEGREE, 'acceleration_units', 'is in degrees per second squared: publish it in rad/s^2'))
NO_MATCH, CONSTANT = 'robot_description', 'outputs_constant'


class SetupProblem(NamedTuple):
    """Something that is wrong before any physics: a unit, a sign, an order.

    ``what`` is a word for programs (``joint_order``), ``where`` the joint or frame concerned, ``sentence`` what a user
    reads.
    """

    what: str
    where: str | None
    sentence: str


def setup_problems(body: RigidBody, samples: Samples, config: DiagnosisConfig = DEFAULTS,
                   touched: Sequence[tuple[float, float]] = (),
                   effects: Sequence[Effect] = ()) -> list[SetupProblem]:
    """Faults of the recording or of its declaration, each with its remedy; empty when all is well.

    :param samples: as recorded; ``config.setup_samples`` of them, spread over the recording, are looked at.
    :param touched: [s] between which the robot is known to have been touched: outputs then tell nothing.
    :param effects: those that are declared; what their values do to the described robot is no mistake.
    """
    if len(samples) < config.least_working_samples or np.all(
            np.ptp(samples.position, axis=0) < config.slow_range):
        return []
    missing = _constant(body, samples) or _mostly_zero(body, samples, config)
    if missing:
        return missing
    usable, samples = untouched(samples, touched, config), _without_declared(body, samples, effects, config)
    found, right = motion_problems(body, samples, usable, config)
    if any(problem.what == 'clock' for problem in found):
        return found
    if usable.sum() < config.least_working_samples:
        return found
    at_hand = (right[_spread(np.flatnonzero(usable), config)] if samples.acceleration.any()
               else _smoothed(usable, right, config))
    layout = layout_problems(body, at_hand, config)
    return found + (_confirmed(body, usable, right, layout, config) if layout else [])


def _without_declared(body: RigidBody, samples: Samples, effects: Sequence[Effect],
                      config: DiagnosisConfig) -> Samples:
    """The samples with outputs less what declared values change about those of the described robot."""
    coupled, changes = CoupledColumns(body, effects), list[Array]()
    if coupled.only_add and not coupled.known.any():
        return samples
    memory: Memories = None
    for start in range(0, len(samples), config.most_working_samples):  # all columns of more take too much room
        part = samples[start:start + config.most_working_samples]
        columns, memory = coupled.batch(part, memory)
        changes.append(columns @ coupled.prior_mean - body.outputs_of(part, body.base_parameters))
    return replace(samples, outputs=samples.outputs - np.concatenate(changes))


def _spread(usable: Stamps, config: DiagnosisConfig) -> Stamps:
    """Some of these sample numbers, evenly spread."""
    return usable[evenly(len(usable), config.setup_samples)]


def _smoothed(usable: Mask, right: Samples, config: DiagnosisConfig) -> Samples:
    """Some of the corrected samples ``right``, where those as recorded are usable (N,), with accelerations out of the
    whole recording."""
    inputs = Inputs('smoothed', working_factor(right, config), config.smoothing_ends)
    chosen = np.flatnonzero(inputs.mask(usable))
    return inputs.prepare(right)[_spread(chosen, config)] if len(chosen) else right[:0]


def _confirmed(body: RigidBody, usable: Mask, right: Samples, layout: list[SetupProblem],
               config: DiagnosisConfig) -> list[SetupProblem]:
    """The problems that stay with accelerations out of the whole recording.

    Those at hand may be filtered as samples came: of fast motion at a low rate, neither says what the arm did.
    """
    smoothed = _smoothed(usable, right, config)
    if len(smoothed) < config.least_working_samples or not right.acceleration.any():
        return layout
    again = layout_problems(body, smoothed, config)
    return layout if any(problem.what == NO_MATCH for problem in again) else again


def _constant(body: RigidBody, samples: Samples) -> list[SetupProblem]:
    """Outputs that never change: a model that holds them to be measured fits nothing else."""
    reach = np.ptp(samples.outputs, axis=0)
    dead = [name for name, value in zip(body.output_names, reach, strict=True) if value == 0.0]
    if not dead:
        return []
    remedy = ', or name the other joints in the parameter output_joints' if body.outputs == 'effort' else ''
    return [SetupProblem(CONSTANT, body.sensor_frame or dead[0], (
        f'No change was measured in {listed(dead)} while the robot moves: check that the sensor is switched on and '
        f'that its driver publishes what it measures{remedy}.'))]


def _mostly_zero(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> list[SetupProblem]:
    """Outputs that are exactly zero most of the time, and clearly not between: no sensor measures that."""
    zero = samples.outputs == 0.0
    share = zero.mean(axis=0)
    found = []
    for channel, name in enumerate(body.output_names):
        values = np.abs(samples.outputs[~zero[:, channel], channel])
        leaps = zero[1:, channel] != zero[:-1, channel]
        across = np.abs(np.diff(samples.outputs[:, channel]))[leaps]
        if config.most < share[channel] < 1.0 and np.median(across) > config.zero_leap * np.median(values):
            found.append((name, float(share[channel])))
    if not found:
        return []
    shares = ', '.join(f'{name} {100 * part:.0f} %' for name, part in found)
    return [SetupProblem('outputs_zero', found[0][0], (
        f'Outputs are exactly zero in most samples ({shares}) and leap from there to full values: the driver writes 0 '
        'where it has no new reading; have it publish measured values alone, or convert the recording without these '
        'rows.'))]


# --- do positions, velocities, accelerations and stamps agree? ---


def motion_problems(body: RigidBody, samples: Samples, usable: Mask,
                    config: DiagnosisConfig) -> tuple[list[SetupProblem], Samples]:
    """Contradictions between positions, velocities, accelerations and stamps, and the corrected samples.

    :param usable: (N,) samples whose outputs tell something.
    """
    joints, moving = body.joints, np.ptp(samples.position, axis=0) > config.slow_range
    problems, right = _put_right(body, usable, samples, _other_belongings(joints, samples, moving, config), config)
    changes, integrals = _spans(right.time, right.position, right.velocity, config)
    if not len(changes):  # no stretch without gaps, as where two drivers stamp in turn
        return problems, right
    ratios = [_ratio(changes[:, joint], integrals[:, joint], config) if moving[joint] else math.nan
              for joint in range(len(joints))]
    clock = _clock(samples, ratios, config)
    if clock:
        return clock, samples
    opposite = [_opposite(joints, joint) for joint, ratio in enumerate(ratios) if _agrees(ratio, -1.0, config)]
    signs, right = _put_right(body, usable, right, opposite, config)
    problems += signs
    for joint, (name, ratio) in enumerate(zip(joints, ratios, strict=True)):
        little = np.std(integrals[:, joint]) < config.little * np.std(changes[:, joint])
        silent = moving[joint] and little and math.isnan(ratio)  # else it is in another unit
        if silent:
            problems.append(SetupProblem('velocity_missing', name, (
                f"The position of '{name}' changes far more than its velocity says: have the driver "
                'publish velocities.')))
        elif (found := _velocity(name, ratio, name in body.prismatic, config)) is not None:
            problem, role, factor = found
            problems.append(problem)
            right = relabelled(right, (role,), factors=_factors(len(joints), joint, factor))
    return problems + _accelerations(body, samples, right, moving, config), right


def relabelled(samples: Samples, roles: Sequence[str], order: Stamps | slice = slice(None),
               factors: Array | float = 1.0) -> Samples:
    """The samples with the columns of some roles in another order, times a factor each."""
    return replace(samples, **{role: getattr(samples, role)[:, order] * factors for role in roles})


def _factors(count: int, column: int, factor: float = -1.0) -> Array:
    """(count,) one, but a factor at one column."""
    return np.where(np.arange(count) == column, factor, 1.0)


def _exchange(count: int, one: int, other: int) -> Stamps:
    """(count,) column numbers, two of them exchanged."""
    order = np.arange(count)
    order[[one, other]] = other, one
    return order


class Belonging(NamedTuple):
    """Velocities that belong to positions in another order, or with another sign, and what to say when the velocities
    are wrong, and when the positions are."""

    order: Stamps
    signs: Array
    said: tuple[SetupProblem, ...]


def _put_right(body: RigidBody, usable: Mask, right: Samples, belongings: Iterable[Belonging],
               config: DiagnosisConfig) -> tuple[list[SetupProblem], Samples]:
    """Return whether the velocities are wrong, or the positions, by which of them makes the outputs likelier."""
    problems = []
    for order, signs, said in belongings:
        back = np.argsort(order)
        ways = (_with_velocities(right, order, signs, config),
                relabelled(right, ('position',), back, signs[back]))
        ready = [_smoothed(usable, one, config) for one in ways]
        wrong = 0
        if len(ready[0]) >= config.least_working_samples:
            likely = [evidence(equations(body, one, config), one.outputs).log for one in ready]
            wrong = int(np.argmax(likely))
        right = ways[wrong]
        problems.append(said[wrong])
    return problems, right


def _with_velocities(samples: Samples, order: Stamps, signs: Array,
                     config: DiagnosisConfig) -> Samples:
    """The samples with other velocities, and accelerations if those are derivatives of the ones
    recorded."""
    changes, integrals = _spans(samples.time, samples.velocity, samples.acceleration, config)
    derived = np.sum(changes * integrals) > np.sum(changes[:, order] * signs * integrals)
    roles = ('velocity', 'acceleration') if derived else ('velocity',)
    return relabelled(samples, roles, order, signs)


def _other_belongings(joints: Sequence[str], samples: Samples, moving: Array,
                      config: DiagnosisConfig) -> Iterator[Belonging]:
    """Joints whose velocities belong to each other's positions, by the likelihood of all orders.

    What a velocity leaves of the change of a position counts once for each span that shares no sample with another,
    and not below what velocities filtered by their driver leave. A sign or a unit would be another mistake.
    """
    changes, integrals = _spans(samples.time, samples.position, samples.velocity, config)
    number = min((samples.time[-1] - samples.time[0]) / config.span_s, len(changes))
    sizes, likeness = np.linalg.norm(changes, axis=0), _correlation(changes, integrals)
    ratio = np.linalg.norm(integrals, axis=0) / np.maximum(sizes, 1e-100)[:, None]
    as_declared, least = 1.0 + ratio**2 - 2.0 * ratio * likeness, 1.0 - config.own_correlation**2
    cost = np.minimum(0.5 * number * np.log(np.maximum(as_declared, least)),
                      0.5 * number * np.log(np.maximum(1.0 - likeness**2, least)) + math.log(config.odds))
    cost = cost[np.ix_(moving, moving)]
    chosen = linear_sum_assignment(cost)[1]
    if np.trace(cost) - cost[range(len(chosen)), chosen].sum() < math.log(config.odds):
        return
    order = np.arange(len(joints))
    order[moving] = order[moving][chosen]
    _, labels = connected_components(np.eye(len(order))[order])
    for cycle in (np.flatnonzero(labels == label).tolist() for label in np.unique(labels)):
        if len(cycle) == 1:  # the others change places among themselves
            continue
        own = np.arange(len(joints))
        own[cycle] = order[cycle]
        names = listed([f"'{joints[joint]}'" for joint in cycle])
        yield Belonging(own, np.ones(len(joints)), tuple(SetupProblem(f'{role}_order', joints[cycle[0]], (
            f"The {those} of {names} belong to each other's {others}: they are swapped in the joint states; put them "
            'in the order of the names.')) for role, those, others in (('velocity', 'velocities', 'positions'),
                                                                      ('position', 'positions', 'velocities'))))


def _opposite(joints: Sequence[str], joint: int) -> Belonging:
    """A velocity that has the opposite sign of its change of position."""
    said = tuple(SetupProblem(f'{role}_sign', joints[joint], (
        f"The {role} of '{joints[joint]}' has the opposite sign of its {other}: negate the {role} in the driver."))
        for role, other in (('velocity', 'change of position'), ('position', 'velocity')))
    return Belonging(np.arange(len(joints)), _factors(len(joints), joint), said)


def _ratio(changes: Array, integrals: Array, config: DiagnosisConfig) -> float:
    """Change of a joint's signal over the integral of its declared rate, median of the faster half of its spans; nan
    where the spans do not agree on it."""
    fast = np.abs(integrals) > np.median(np.abs(integrals))
    if not fast.any():
        return math.nan
    shares = changes[fast] / integrals[fast]
    middle = float(np.median(shares))
    agreeing = np.mean([_agrees(share, middle, config) for share in shares.tolist()]) if middle else 0.0
    return middle if agreeing > config.most else math.nan


def _agrees(ratio: float, known: float, config: DiagnosisConfig) -> bool:
    """Return whether a ratio is the known one, sign included."""
    return 1.0 / config.ratio_tolerance < ratio / known < config.ratio_tolerance


def _spans(time: Array, values: Array, rates: Array, config: DiagnosisConfig) -> tuple[Array, Array]:
    """(M, k) changes of values (N, k) over ``config.span_s``, and the integrals of their rates over the same spans."""
    steps = np.diff(time)
    typical = typical_step(time)
    width = int(np.clip(round(config.span_s / typical), 1, max(len(time) // config.least_working_samples, 1)))
    pieces = 0.5 * (rates[1:] + rates[:-1]) * steps[:, None]
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(pieces, axis=0)])
    starts = evenly(max(len(time) - width, 1), config.most_samples)
    ends = np.minimum(starts + width, len(time) - 1)
    whole = time[ends] - time[starts] < (width + config.gap_steps) * typical
    starts, ends = starts[whole], ends[whole]
    return values[ends] - values[starts], total[ends] - total[starts]


def _correlation(left: Array, right: Array) -> Array:
    """(k, k) correlations between columns about zero; 0 where one stands still."""
    size = np.outer(np.linalg.norm(left, axis=0), np.linalg.norm(right, axis=0))
    return np.divide(left.T @ right, size, out=np.zeros_like(size), where=size > 0.0)


def _clock(samples: Samples, ratios: list[float], config: DiagnosisConfig) -> list[SetupProblem]:
    """Stamps that run too fast or too slow for every joint alike."""
    telling = np.array([ratio for ratio in ratios if math.isfinite(ratio)])
    if len(telling) < 2 or telling.min() <= 0.0 or telling.max() > config.ratio_tolerance * telling.min():
        return []
    factor = float(np.median(telling))
    if any(_agrees(factor, known, config) for known in (1.0, *MOTION_UNITS)):
        return []
    step = typical_step(samples.time) / samples.every
    return [SetupProblem('clock', None, (
        f'The stamps are {step:.4g} s apart, but positions and velocities agree with {factor * step:.4g} s: correct '
        f'the stamps (for a text table: semiparam convert --period {factor * step:.4g}, or --time-unit).'))]


def _velocity(name: str, ratio: float, slides: bool,
              config: DiagnosisConfig) -> tuple[SetupProblem, str, float] | None:
    """Problem that a joint's ratio shows, and the role and factor that put it right; what slides is in no degrees."""
    if math.isnan(ratio) or _agrees(ratio, 1.0, config) or _agrees(ratio, -1.0, config):
        return None
    for known, (role, unit, factor) in {} if slides else MOTION_UNITS.items():
        if _agrees(ratio, known, config):
            right = 'rad' if role == 'position' else 'rad/s'
            return SetupProblem(f'{role}_units', name, (
                f"The {role} of '{name}' is in {unit}, its {'velocity' if role == 'position' else 'position'} is not: "
                f'publish it in {right} (for a text table with degrees throughout: semiparam convert --degrees).')), \
                role, factor
    return SetupProblem('velocity_scale', name, (
        f"The position of '{name}' changes {ratio:.3g} times as fast as its velocity says: check the gear ratio "
        'and the units in the driver.')), 'velocity', ratio


def _accelerations(body: RigidBody, samples: Samples, right: Samples, moving: Array,
                   config: DiagnosisConfig) -> list[SetupProblem]:
    """Accelerations that contradict the velocities as they are recorded and as they should be."""
    recorded = _spans(samples.time, samples.velocity, samples.acceleration, config)
    corrected = _spans(samples.time, right.velocity, samples.acceleration, config)
    found = []
    for joint, name in enumerate(body.joints):
        if not moving[joint] or _agrees(_ratio(recorded[0][:, joint], recorded[1][:, joint], config), 1.0, config):
            continue
        ratio = _ratio(corrected[0][:, joint], corrected[1][:, joint], config)
        found += [SetupProblem(what, name, (
            f"The measured acceleration of '{name}' {said}, or set acceleration.source to filter."))
            for known, what, said in ACCELERATIONS[:1 if name in body.prismatic else None]
            if _agrees(ratio, known, config)]
    return found


# --- what would the recording say under other labels? ---


def layout_problems(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> list[SetupProblem]:
    """Everything that other labels of the samples would correct, the plainest first."""
    found, samples = unit_problems(body, samples, config)
    for _ in range(config.most_relabellings):
        best = _best_remedy(body, samples, config)
        if best is None or best.problem in found:
            break
        found.append(best.problem)
        body, samples = best.body or body, best.samples
    left = _share_left(body, samples, config)
    return [_no_match(body, left)] if left > config.no_match_share else found


def _share_left(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> float:
    """Share of the variance that the best inertias leave of the half that they explain better: what changes once, or a
    push, leaves the other half as it is."""
    middle = len(samples) // 2
    return min(share_left(equations(body, half, config), half.outputs)
               for half in (samples[:middle], samples[middle:]))


def _no_match(body: RigidBody, left: float) -> SetupProblem:
    there = f" or the parameter sensor_frame ('{body.sensor_frame}')" if body.outputs == 'wrench' else ''
    return SetupProblem(NO_MATCH, body.sensor_frame, (
        f'No inertias explain the outputs: {100 * min(left, 1.0):.0f} % of their variance stay with the best ones, '
        'and no other order, sign or unit helps; check that the robot description is that of this robot, the parameter '
        f'joints{there}, and that the outputs are not compensated for gravity.'))


class Remedy(NamedTuple):
    """The samples as they would be, and what to say if that is how they are; the body where it is another one."""

    samples: Samples
    problem: SetupProblem
    body: RigidBody | None = None


def _best_remedy(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Remedy | None:
    """The likeliest remedy, where the recording is far likelier with it than as declared. Odds are against a kind
    of mistake, so against each of its places as many times more.
    """
    equal = equations(body, samples, config)
    remedies = list(_remedies(body, samples, config))

    def of(remedy: Remedy) -> tuple[Equations, Array]:
        same = remedy.samples.position is samples.position and remedy.body is None
        return (equal if same else equations(remedy.body or body, remedy.samples, config),
                remedy.samples.outputs)

    best = max(remedies, key=lambda remedy: evidence(*of(remedy)).log)
    share = independent(*of(best), evidence(*of(best)).change)
    gain = evidence(*of(best), share).log - evidence(equal, samples.outputs, share).log
    places = sum(remedy.problem.what == best.problem.what for remedy in remedies)
    return best if gain > math.log(config.odds * places) else None


def _remedies(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Iterator[Remedy]:
    yield from _other_signs(body, samples)
    if body.outputs == 'wrench':
        yield from _other_axes(body, samples)
    yield from _other_mountings(body, samples, config)
    yield from _other_directions(body, samples)
    yield from _other_orders(body, samples)
    yield from _exchanged_outputs(body, samples)
    yield from _other_units(body, samples)


def _other_units(body: RigidBody, samples: Samples) -> Iterator[Remedy]:
    """The joints that turn in degrees, and those that slide in millimetres: none slides in degrees."""
    slides = np.array([name in body.prismatic for name in body.joints])
    both = slides.any() and not slides.all()
    remedy = '' if slides.any() else ' (for a text table: semiparam convert --degrees)'  # it converts all columns
    for chosen, factor, unit, right, move in ((~slides, DEGREE, 'degrees', f'rad and rad/s{remedy}', 'turn'),
                                              (slides, 1e-3, 'millimetres', 'm and m/s', 'slide')):
        if chosen.any():
            whose = f' of the joints that {move}' if both else ''
            yield Remedy(relabelled(samples, MOTION, factors=np.where(chosen, factor, 1.0)), SetupProblem(
                'position_units', None, f'Positions and velocities{whose} are in {unit}: publish them in {right}.'))


def _other_signs(body: RigidBody, samples: Samples) -> Iterator[Remedy]:
    """All outputs negated, then each of them."""
    wrench = body.outputs == 'wrench'
    what = 'wrench_sign' if wrench else 'effort_sign'
    sentence = ('The wrench has the opposite sign of what the robot description predicts: set the parameter '
                f'wrench_convention to {"action" if body.sign < 0 else "reaction"}.') if wrench else (
        'The efforts have the opposite sign of what the robot description predicts: negate them (semiparam convert '
        '--effort-sign -1).')
    yield Remedy(relabelled(samples, ('outputs',), factors=-1.0), SetupProblem(what, body.sensor_frame, sentence))
    for channel, name in enumerate(body.output_names):
        said = f"The channel {name} of '{body.sensor_frame}'" if wrench else f"The effort of '{name}'"
        where = "the sensor's driver or calibration" if wrench else 'the driver'
        negated = relabelled(samples, ('outputs',), factors=_factors(body.n_outputs, channel))
        yield Remedy(negated, SetupProblem(what, name, (
            f'{said} fits the robot description far better with the opposite sign: negate it in {where}.')))


def _other_axes(body: RigidBody, samples: Samples) -> Iterator[Remedy]:
    """Signed permutations of the sensor's axes, force and torque exchanged."""
    frame = body.sensor_frame
    force, torque = samples.outputs[:, :3], samples.outputs[:, 3:]
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        if order == (0, 1, 2) and len(set(signs)) == 1:
            continue  # as declared, or the wrench's sign
        outputs = np.hstack([force[:, order] * signs, torque[:, order] * signs])
        names = ', '.join(('-' if sign < 0 else '') + 'xyz'[axis] for axis, sign in zip(order, signs, strict=True))
        yield Remedy(replace(samples, outputs=outputs), SetupProblem('wrench_axes', frame, (
            f"The wrench fits the robot description far better when the sensor's axes ({names}) are taken for x, y, z "
            f"of '{frame}': turn that frame in the robot description, or set sensor_frame to one that has the "
            f"sensor's axes.{_mirrored(order, signs)}")))
    yield Remedy(replace(samples, outputs=np.hstack([torque, force])), SetupProblem('force_torque', frame, (
        f"The wrench of '{frame}' fits far better with force and torque exchanged: the driver (or the columns of the "
        'text table) gives them in the wrong order.')))


def _mirrored(order: tuple[int, ...], signs: tuple[float, ...]) -> str:
    """A hint where no turn makes these axes."""
    hand = float(np.linalg.det(np.eye(3)[list(order)])) * float(np.prod(signs))
    return ' No turn does that: an axis of the sensor is mirrored, or the robot (a left arm for a right one).' \
        if hand < 0.0 else ''


def _other_mountings(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Iterator[Remedy]:
    """Gravity along each other axis of the base."""
    present = np.array(body.arm.gravity.linear)
    strength = float(np.linalg.norm(present))
    for sign, (axis, name) in product((1.0, -1.0), enumerate('xyz')):
        cosine = sign * float(present[axis]) / max(strength, 1e-12)
        if cosine < config.same_gravity_cosine:
            how = 'upside down' if cosine < -config.same_gravity_cosine else \
                f'on its side, with gravity along its {"-" if sign < 0 else ""}{name} axis'
            yield Remedy(samples, SetupProblem('base_mounting', None, (
                f'The recording fits the robot description far better when the base is mounted {how}: turn the first '
                'link in the robot description as the robot is mounted.')),
                body.with_gravity(sign * strength * np.eye(3)[axis]))


def _other_directions(body: RigidBody, samples: Samples) -> Iterator[Remedy]:
    for joint, name in enumerate(body.joints):
        mirrored = relabelled(samples, MOTION, factors=_factors(body.n_joints, joint))
        if name in body.output_names:
            mirrored = relabelled(mirrored, ('outputs',), factors=_factors(
                body.n_outputs, body.output_names.index(name)))
        moves = 'slides' if name in body.prismatic else 'turns'
        yield Remedy(mirrored, SetupProblem('joint_direction', name, (
            f"The recording fits the robot description far better when '{name}' {moves} the other way: negate its "
            'position, velocity (and effort) in the driver, or its axis in the robot description.')))


def _other_orders(body: RigidBody, samples: Samples) -> Iterator[Remedy]:
    for one, other in combinations(range(body.n_joints), 2):
        order = _exchange(body.n_joints, one, other)
        swapped = relabelled(samples, MOTION, order)
        if body.outputs == 'effort':
            if (one in body.output_index) != (other in body.output_index):
                continue  # the effort of one of them is not known
            channels = np.searchsorted(body.output_index, order[body.output_index])
            swapped = relabelled(swapped, ('outputs',), channels)
        yield Remedy(swapped, SetupProblem('joint_order', body.joints[one], (
            f"The recording fits the robot description far better with '{body.joints[one]}' and "
            f"'{body.joints[other]}' exchanged: correct the names in the joint states (for a bag: semiparam convert "
            '--joint NAME=NEW) or the parameter joints.')))


def _exchanged_outputs(body: RigidBody, samples: Samples) -> Iterator[Remedy]:
    """Any two efforts, or channels of the wrench, in each other's place."""
    wrench = body.outputs == 'wrench'
    for one, other in combinations(range(body.n_outputs), 2):
        first, second = body.output_names[one], body.output_names[other]
        what = f"The channels {first} and {second} of '{body.sensor_frame}' are" if wrench else \
            f"The efforts of '{first}' and '{second}' are"
        where = "the sensor's driver (or in the columns of the text table)" if wrench else 'the driver'
        yield Remedy(relabelled(samples, ('outputs',), _exchange(body.n_outputs, one, other)), SetupProblem(
            'wrench_order' if wrench else 'effort_order', first, (
                f"{what} swapped: the recording fits the robot description far better with them in each other's place; "
                f'correct their order in {where}.')))


# --- units of the outputs ---


def unit_problems(body: RigidBody, samples: Samples,
                  config: DiagnosisConfig) -> tuple[list[SetupProblem], Samples]:
    """Units of the outputs that are wrong, by their slope against the description's prediction, and the corrected
    samples."""
    parts = {'force': slice(0, 3), 'torque': slice(3, 6)} if body.outputs == 'wrench' else {'effort': slice(None)}
    free = nuisances(body, samples, config)
    measured, predicted = (_without(free, values) for values in (
        samples.outputs, body.regressors(samples) @ body.base_parameters))
    found, factors = [], np.ones(body.n_outputs)
    for name, channels in parts.items():
        left, right = measured[:, channels].ravel(), predicted[:, channels].ravel()
        slope = abs(float(left @ right)) / (float(right @ right) + 1e-300)
        alike = abs(float(left @ right)) / (float(np.linalg.norm(left) * np.linalg.norm(right)) + 1e-300)
        unit = next((known for known in OUTPUT_UNITS
                     if 1.0 / config.unit_tolerance < slope / known < config.unit_tolerance), None)
        if alike > config.alike and unit is not None:
            found.append(SetupProblem('output_units', body.sensor_frame, (
                f'The {name} is {unit:.3g} times what the robot description predicts, as if it '
                f'were in {OUTPUT_UNITS[unit]}: publish it in '
                f'{" or ".join(dict.fromkeys(body.output_units[channels]))}.')))
            factors[channels] /= unit
    return found, relabelled(samples, ('outputs',), factors=factors)


def _without(columns: Array, values: Array) -> Array:
    """Values (N, n) less what the nuisances explain of each channel."""
    return np.column_stack([each - own @ np.linalg.lstsq(own, each, rcond=1e-9)[0]
                            for own, each in zip(columns.transpose(1, 0, 2), values.T, strict=True)])
