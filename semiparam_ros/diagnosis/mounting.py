"""A base that is mounted otherwise than the robot description says: on its head, or on a wall."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.setup_problem import SetupProblem

NEARLY = 0.9
"""Cosine from where on two directions of gravity count as one."""


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
