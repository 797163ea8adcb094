"""Orders, directions and axes: what would the recording say if it had been labelled otherwise?

An alternative is reported only if the recording as declared fits badly (J of ``plausibility`` beyond BAD_FIT) and the
alternative fits far better (FAR_BETTER times J) and well (GOOD_FIT).
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
from semiparam_ros.diagnosis.mounting import other_mountings
from semiparam_ros.diagnosis.output_checks import friction_problems, output_problems
from semiparam_ros.diagnosis.plausibility import equations, misfit
from semiparam_ros.diagnosis.setup_problem import SetupProblem

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
