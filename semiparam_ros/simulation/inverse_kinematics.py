"""Postures of a redundant arm for a path of its tip."""

from __future__ import annotations

import numpy as np

from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.chain import Poses

ITERATIONS = 40
DAMPING_M = 1e-2
LIMIT_MARGIN = 0.03
TOLERANCE_RAD = 1e-7


def follow(arm: Arm, frame: str, path: Array, posture: Array) -> Array:
    """Joint positions (N, n_joints) whose ``frame`` runs along ``path`` (N, 3) [m], as near as may be to ``posture``.

    Damped Newton steps J# (path - x) + (1 - J# J) (posture - q), for all instants at once. The redundancy is settled
    by the posture and not by history, so the result is a smooth function of the path and never drifts.
    """
    low, high = (limit + sign * LIMIT_MARGIN for limit, sign in zip(arm.limits, (1, -1), strict=True))
    posture = np.broadcast_to(posture, (len(path), arm.n_joints))
    position, open_rows = np.clip(posture, low, high), np.arange(len(path))
    for _ in range(ITERATIONS):
        step = _step(arm.pose(frame, position[open_rows]), path[open_rows], (posture - position)[open_rows])
        position[open_rows] = np.clip(position[open_rows] + np.clip(step, -0.2, 0.2), low, high)
        open_rows = open_rows[np.abs(step).max(axis=1) > TOLERANCE_RAD]
        if not len(open_rows):
            break
    return position


def _step(pose: Poses, path: Array, wish: Array) -> Array:
    """The damped Newton step (N, n_joints); ``wish`` is the way to the posture."""
    jacobian = pose.jacobian[:, :3]
    inner = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING_M**2 * np.eye(3)
    missing = path - pose.place - np.einsum('nkj,nj->nk', jacobian, wish)
    return np.asarray(wish + np.einsum('nkj,nk->nj', jacobian, np.linalg.solve(inner, missing[:, :, None])[:, :, 0]))


def home(arm: Arm) -> Array:
    """A posture with room to move, (n_joints,): the best of many random ones by manipulability, limits kept away."""
    rng = np.random.default_rng(0)
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in arm.limits)
    candidates = low + (high - low) * rng.uniform(0.25, 0.75, (400, arm.n_joints))
    jacobian = arm.pose(arm.tip, candidates).jacobian[:, :3]
    dexterity = np.sqrt(np.maximum(np.linalg.det(jacobian @ jacobian.transpose(0, 2, 1)), 0.0))
    return np.asarray(candidates[np.argmax(dexterity)])
