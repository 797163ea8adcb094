"""Postures of a redundant arm for a path of its tip."""

from __future__ import annotations

import numpy as np

from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.arrays import Array

ITERATIONS = 30
POSTURE_WEIGHT = 3e-4
LIMIT_MARGIN = 0.05


def follow(arm: Arm, frame: str, path: Array, posture: Array) -> Array:
    """Joint positions (N, n_joints) whose ``frame`` runs along ``path`` (N, 3) [m], as near as may be to ``posture``.

    Damped least squares on |x(q) - path|^2 + w^2 |q - posture|^2, for all instants at once. The redundancy is settled
    by the posture and not by history, so the result is a smooth function of the path and never drifts.
    """
    low, high = (limit + sign * LIMIT_MARGIN for limit, sign in zip(arm.limits, (1, -1), strict=True))
    position = np.clip(np.array(np.broadcast_to(posture, (len(path), arm.n_joints))), low, high)
    eye = POSTURE_WEIGHT * np.eye(arm.n_joints)
    for _ in range(ITERATIONS):
        pose = arm.pose(frame, position)
        jacobian = pose.jacobian[:, :3]
        gradient = np.einsum('nkj,nk->nj', jacobian, path - pose.place) + POSTURE_WEIGHT * (posture - position)
        hessian = np.einsum('nki,nkj->nij', jacobian, jacobian) + eye
        step = np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
        position = np.clip(position + np.clip(step, -0.2, 0.2), low, high)
        if np.abs(step).max() < 1e-9:
            break
    return position


def home(arm: Arm) -> Array:
    """A posture with room to move, (n_joints,): the best of many random ones by manipulability, limits kept away."""
    rng = np.random.default_rng(0)
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in arm.limits)
    candidates = low + (high - low) * rng.uniform(0.25, 0.75, (400, arm.n_joints))
    jacobian = arm.pose(arm.tip, candidates).jacobian[:, :3]
    dexterity = np.sqrt(np.maximum(np.linalg.det(jacobian @ jacobian.transpose(0, 2, 1)), 0.0))
    return np.asarray(candidates[np.argmax(dexterity)])
