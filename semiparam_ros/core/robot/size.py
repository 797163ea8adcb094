"""Size of a robot, and the size that a quantity of it may have: the ground of priors that are wide,
yet not absurd."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.core.robot.rigid_body import GRAVITY, RigidBody, remembered
from semiparam_ros.core.types import Array

LEAST_MASS, LEAST_LENGTH = 0.5, 0.1
"""[kg], [m] of a robot at least, as where its joints all meet in one point."""
MASS_PER_LENGTH = 20.0
"""[kg/m] of an arm whose description holds no masses. Of those that do, an iCub has 5, a UR3 and a Panda 20."""
SHARE = 0.2
"""Of its own mass, what an arm may carry, and of its own weight, what its gears may rub with."""
LEAST_PART = 0.3
"""Of the whole arm, what counts beyond a joint at least: friction of a wrist does not come from the hand's weight."""
WARMING = 10.0
"""[K] over which what depends on a temperature may change by as much as it is."""
PUSH_N = 100.0
"""[N] of a person's push."""
LEAST_PUSH, MOST_PUSH = SHARE, 2.0
"""Of the arm's weight, what a push is at least and at most: a toy is pushed by a finger, a press by no hand."""
_PART = re.compile(r'(kg|N|m|s|rad|Hz|K)(?:\^(\d))?')


class Size(NamedTuple):
    """Mass [kg] of what the outputs feel, and its length [m] when stretched out."""

    mass: float
    length: float

    @property
    def weight(self) -> float:
        """[N]."""
        return self.mass * float(np.linalg.norm(GRAVITY))


@remembered
def size_of(body: RigidBody) -> Size:
    """The size of the bodies that the outputs feel, as the robot description has them."""
    return _size(body.arm if body.distal is None else body.distal)


@remembered
def arm_size(body: RigidBody) -> Size:
    """The size of the whole arm, whatever of it the outputs feel: it says how much a wrist's sensor may carry."""
    return _size(body.arm)


def _size(model: pin.Model) -> Size:
    branches = [_beyond(model, joint) for joint in range(1, model.njoints) if not model.parents[joint]]
    length = max(*(branch.length for branch in branches), LEAST_LENGTH)
    return Size(max(sum(branch.mass for branch in branches) or MASS_PER_LENGTH * length, LEAST_MASS), length)


def push_force(body: RigidBody) -> float:
    """[N] standard deviation along each axis of the forces that a contact is expected to have."""
    weight = arm_size(body).weight
    return float(np.clip(PUSH_N, LEAST_PUSH * weight, MOST_PUSH * weight))


@remembered
def reach_of(body: RigidBody) -> float:
    """[m] how long the whole arm is when stretched out, whatever of it the outputs feel."""
    return max(*(_way(body.arm, joint) for joint in range(1, body.arm.njoints)), LEAST_LENGTH)


@remembered
def size_beyond(body: RigidBody, joint: str) -> Size:
    """The size of what a joint carries, and ``LEAST_PART`` of the whole arm at least."""
    whole, part = size_of(body), _beyond(body.arm, body.arm.getJointId(joint))
    return Size(max(part.mass, LEAST_PART * whole.mass), max(part.length, LEAST_PART * whole.length))


@remembered
def radians(body: RigidBody) -> Array:
    """(n_joints,) what of each joint's unit is as much as a radian: where it slides, as far as the end of what it
    carries goes when that turns by one [m]."""
    return np.array([size_beyond(body, joint).length if joint in body.prismatic else 1.0 for joint in body.joints])


def _beyond(model: pin.Model, first: int) -> Size:
    carried = [index for index in range(first, model.njoints) if first in model.supports[index]]
    ends = set(carried) - {model.parents[index] for index in carried}
    lasts = {end: max((float(np.linalg.norm(frame.placement.translation)) for frame in model.frames
                       if frame.parentJoint == end), default=0.0) for end in ends}
    return Size(sum(float(model.inertias[index].mass) for index in carried),
                max(_way(model, end, first) + last for end, last in lasts.items()))


def _way(model: pin.Model, last: int, first: int = 0) -> float:
    """[m] from a joint to the last of those that it carries."""
    between = [joint for joint in model.supports[last] if joint > first]
    return sum(float(np.linalg.norm(model.jointPlacements[joint].translation)) for joint in between)


@lru_cache(maxsize=1024)
def plausible(unit: str, size: Size) -> float:
    """Largest plausible value of this unit for a robot of this size: ``SHARE`` of its mass, of its
    weight, of the torque that holds it stretched out, and as much in a second or a radian."""
    above, _, below = unit.partition('/')
    return _of(above, size) / _of(below.strip('()'), size)


def _of(product: str, size: Size) -> float:
    basis = {'kg': SHARE * size.mass, 'N': SHARE * size.weight, 'm': size.length, 'K': WARMING}
    value = 1.0
    for name, power in _PART.findall(product):
        value *= basis.get(name, 1.0) ** int(power or 1)
    return value


def output_scale(body: RigidBody) -> Array:
    """(n,) what an output may be beside the described rigid body, in its unit: ``SHARE`` of the weight, or of the
    torque that holds what a joint carries stretched out."""
    sizes = [size_of(body)] * 6
    if body.outputs == 'effort':
        sizes = [size_beyond(body, joint) for joint in body.output_names]
    return np.array([plausible(unit, size) for unit, size in zip(body.output_units, sizes, strict=True)])


BIAS = 100.0
"""[N, N m] of a wrench sensor."""


def bias_scale(body: RigidBody) -> Array:
    """(n,) what the offset of an output may be, in its unit: ``BIAS``, or more on a robot that is heavy."""
    return np.maximum(BIAS, output_scale(body))


LEAST_MASS_SHARE, LEAST_LENGTH_SHARE = 0.05, 0.1
"""Of the whole arm's mass and length, what a body has at least: a description may know nothing of a body."""


def inertial_scale(body: RigidBody) -> Array:
    """(10 n_bodies,) how far the inertial parameters may be from the description's: as far as they are large.

    Of mass m, first moment m l and inertia m l^2, with l the larger of the body's centre's distance from its joint and
    its radius of gyration. Descriptions err by tens of per cent, and a body may carry another as heavy as itself.
    """
    whole = size_of(body)
    bodies = body.inertial_parameters.reshape(-1, 10)
    share = LEAST_MASS_SHARE if bodies[:, 0].any() else 1.0
    mass = np.maximum(bodies[:, 0], share * whole.mass)
    centre = np.linalg.norm(bodies[:, 1:4], axis=1) / mass
    gyration = np.sqrt(np.maximum(bodies[:, [4, 6, 9]].max(axis=1), 0.0) / mass)
    length = np.maximum(np.maximum(centre, gyration), LEAST_LENGTH_SHARE * whole.length)
    sizes = np.column_stack([mass, mass * length, mass * length**2])
    return np.repeat(sizes, (1, 3, 6), axis=1).ravel()


def base_scale(body: RigidBody) -> Array:
    """(p,) the same of the base parameters."""
    return np.asarray(np.sqrt((body.basis ** 2).T @ inertial_scale(body) ** 2))
