"""Changes of the outputs y = psi theta by small turns of a robot, to first order:

    dy / d tilt = d psi(q, dq, ddq; exp(tilt)' g) / d tilt theta     of its base
    dy / d zero = d psi(q + zero, dq, ddq; g) / dq theta             of a joint's zero
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pinocchio as pin

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array

TURN_RAD = 1e-4
"""Of the finite differences."""
TILTS = 2
"""The base's horizontal axes."""


class SmallTurns:
    """Derivatives of the outputs of one robot [per rad]; see the module.

    theta: (p,) base parameters everywhere.
    """

    def __init__(self, body: RigidBody) -> None:
        gravity = body.arm.gravity.linear
        turns = [pin.exp3(TURN_RAD * axis) for axis in np.eye(3)[:TILTS]]
        self._body = body
        self._tilted = [body.with_gravity(turn.T @ gravity) for turn in turns]

    def one(self, position: Array, velocity: Array, acceleration: Array, theta: Array) -> Array:
        """(n, 2 + n_joints) those of the base and of every zero, of one state (n_joints,)."""
        level = self._body.outputs_at(position, velocity, acceleration, theta)
        moved = [(tilted, position) for tilted in self._tilted]
        moved += [(self._body, position + turn) for turn in TURN_RAD * np.eye(len(position))]
        turned = [body.outputs_at(at, velocity, acceleration, theta) for body, at in moved]
        return np.asarray((np.array(turned) - level).T / TURN_RAD)

    def of_base(self, samples: Samples, theta: Array) -> Array:
        """(N, n, 2)"""
        level = self._body.outputs_of(samples, theta)
        turned = [tilted.outputs_of(samples, theta) for tilted in self._tilted]
        return np.asarray((np.stack(turned, axis=-1) - level[..., None]) / TURN_RAD)

    def of_zero(self, samples: Samples, theta: Array, joint: int) -> Array:
        """(N, n) that of the joint with a number."""
        position = samples.position.copy()
        position[:, joint] += TURN_RAD
        moved = replace(samples, position=position)
        level, turned = (self._body.outputs_of(each, theta) for each in (samples, moved))
        return np.asarray((turned - level) / TURN_RAD)


@lru_cache(maxsize=4)
def small_turns(body: RigidBody) -> SmallTurns:
    """Small turns of a robot; the latest ones are remembered."""
    return SmallTurns(body)
