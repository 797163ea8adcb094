"""Signs, units, orders and axes: what would the recording say if it had been labelled otherwise?

An alternative is reported only if the recording as declared fits badly (J of ``plausibility`` beyond BAD_FIT) and the
alternative fits far better (FAR_BETTER).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.plausibility import channel_scale, equations, misfit, nuisances
from semiparam_ros.diagnosis.setup_problem import SetupProblem

BAD_FIT = 0.03
FAR_BETTER = 0.6
UNEXPLAINED = 0.5
OPPOSITE = -0.7
LIKE = 0.7
UNIT_TOLERANCE = 2.0
UNITS = {1.0 / 9.81: 'kilograms-force', 9.81: 'newtons counted as kilograms-force', 1e3: 'thousandths (mN, N mm)',
         1e-3: 'thousands (kN)', 1e2: 'hundredths (N cm)'}
MOST_ROUNDS = 2
DEGREES_BEYOND = 3.2
"""Positions beyond this [rad] may be degrees."""


class Alternative(NamedTuple):
    """The samples as they would be, and what to say if that is how they are."""

    samples: Samples
    problem: SetupProblem


def layout_problems(body: RigidBody, samples: Samples) -> list[SetupProblem]:
    """Everything that a relabelling of the samples would put right, the plainest first."""
    found, samples = _scale_problems(body, samples)
    for _ in range(MOST_ROUNDS):
        best = _best_alternative(body, samples)
        if best is None:
            break
        found.append(best.problem)
        samples = best.samples
    left = misfit(equations(body, samples), samples.outputs, body.outputs == 'wrench').left
    return found or ([_no_match(body, left)] if left > UNEXPLAINED else [])


def _best_alternative(body: RigidBody, samples: Samples) -> Alternative | None:
    """The alternative that fits far better than the samples as they are, if these fit badly."""
    wrench = body.outputs == 'wrench'
    equal = equations(body, samples)
    declared = misfit(equal, samples.outputs, wrench).total
    if declared < BAD_FIT:
        return None
    best, least = None, FAR_BETTER * declared
    for alternative in _alternatives(body, samples):
        same = alternative.samples.position is samples.position
        total = misfit(equal if same else equations(body, alternative.samples), alternative.samples.outputs,
                       wrench).total
        if total < least:
            best, least = alternative, total
    return best


def _alternatives(body: RigidBody, samples: Samples) -> Iterator[Alternative]:
    if body.outputs == 'wrench':
        yield from _other_axes(body, samples)
    else:
        yield from _other_effort_signs(body, samples)
    yield from _other_directions(body, samples)
    yield from _other_orders(body, samples)
    if np.abs(samples.position).max() > DEGREES_BEYOND:
        yield _radians(samples)


def _other_axes(body: RigidBody, samples: Samples) -> Iterator[Alternative]:
    """The other 47 signed permutations of the sensor's axes, and force and torque exchanged."""
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
            "sensor's axes.")))
    yield Alternative(replace(samples, outputs=np.hstack([torque, force])), SetupProblem('force_torque', frame, (
        f"The wrench of '{frame}' fits far better with force and torque exchanged: the driver (or the columns of the "
        'text table) gives them in the wrong order.')))


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


def _scale_problems(body: RigidBody, samples: Samples) -> tuple[list[SetupProblem], Samples]:
    """Sign and unit of all outputs against what the description itself predicts, and the samples put right."""
    wrench = body.outputs == 'wrench'
    slopes, likeness = _slopes(body, samples)
    found, factors = [], np.ones(body.n_outputs)
    blocks = [('force', slice(0, 3)), ('torque', slice(3, 6))] if wrench else [('effort', slice(None))]
    if likeness[-1] < OPPOSITE:
        found.append(_sign(body))
        factors *= -1.0
    for (name, channels), slope, like in zip(blocks, slopes, likeness, strict=False):
        unit = next((known for known in UNITS if 1.0 / UNIT_TOLERANCE < abs(slope) / known < UNIT_TOLERANCE), None)
        if abs(like) > LIKE and unit is not None:
            found.append(_unit(body, name, unit))
            factors[channels] /= unit
    return found, replace(samples, outputs=samples.outputs * factors)


def _slopes(body: RigidBody, samples: Samples) -> tuple[Array, Array]:
    """Slope of the outputs against the description's own prediction, and their correlation, for force and torque or
    for efforts; the last correlation is over all channels."""
    predicted = body.regressors(samples) @ body.base_parameters
    measured, predicted = (_without(nuisances(body, samples), values) for values in (samples.outputs, predicted))
    parts = [slice(0, 3), slice(3, 6)] if body.outputs == 'wrench' else []
    pairs = [(measured[:, part], predicted[:, part]) for part in parts] + [
        (measured / channel_scale(measured, bool(parts)), predicted / channel_scale(predicted, bool(parts)))
        if parts else (measured, predicted)]
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
        f'The {name} is {unit:.3g} times what the robot description predicts, as if it were in {UNITS[unit]}: publish '
        f'it in {right}.'))


def _no_match(body: RigidBody, left: float) -> SetupProblem:
    there = f" or the parameter sensor_frame ('{body.sensor_frame}')" if body.outputs == 'wrench' else ''
    return SetupProblem('robot_description', body.sensor_frame, (
        f'No inertias explain the outputs: {100 * min(left, 1.0):.0f} % of their variance stay with the best ones, '
        'and no other order, sign or unit helps; check that the robot description is that of this robot, the parameter '
        f'joints{there}, and that the outputs are not compensated for gravity.'))
