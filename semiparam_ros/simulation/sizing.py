"""How large an effect is, how much of it no rigid body could explain, and the magnitude that makes it so large."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from scipy.optimize import brentq

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.world import World

SHARE_OF_SIZE = 0.10
SUBSET = 400
RANK_TOLERANCE = 1e-9


def share(change: Array, scale: Array) -> float:
    """RMS of a change (N, n) over the outputs' standard deviation ``scale`` (n,), mean over channels."""
    return float(np.mean(np.sqrt(np.mean(change**2, axis=0)) / scale))


def scaled_magnitude(reached: float, target: float, typical: float, name: str) -> float:
    """Magnitude of a cause in proportion, from the share ``reached`` at ``typical``."""
    if not reached > 0.0:
        raise SemiparamError(f"effect '{name}' changes nothing on this motion; ask for another place or motion.")
    return typical * target / reached


def solve_magnitude(share_at: Callable[[float], float], target: float, typical: float, name: str) -> float:
    """Magnitude at which the share is ``target``: bracketed from ``typical`` on, then root finding.

    An effect that cannot grow so large raises SemiparamError.
    """
    upper = typical
    for _ in range(40):
        reached = share_at(upper)
        if reached >= target:
            break
        upper *= 2.0 if reached <= 0.0 else min(max(1.05 * target / reached, 1.05), 4.0)
    else:
        raise SemiparamError(f"effect '{name}' cannot be made as large as asked on this motion; ask for a smaller "
                             'size or another place.')
    return float(brentq(lambda m: share_at(m) - target if m > 0 else -target, 0.0, upper, xtol=1e-14, rtol=1e-11))


class RigidBodyFit:
    """What inertial parameters, and for a wrench a constant offset, could absorb on one motion (a subset of it)."""

    def __init__(self, world: World, scale: Array) -> None:
        self.scale = scale
        self.rows = np.unique(np.linspace(0, len(world.times) - 1, SUBSET).astype(int))
        columns = list(self._inertial_columns(world))
        if world.arm.outputs == 'wrench':
            columns += [np.broadcast_to(unit, (len(self.rows), 6)) for unit in np.eye(6)]
        matrix = np.stack([(column / scale).ravel() for column in columns], axis=1)
        matrix /= np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        left, singular, _ = np.linalg.svd(matrix, full_matrices=False)
        self.basis = left[:, singular > RANK_TOLERANCE * singular[0]]

    def unexplained(self, change: Array) -> float:
        """The share of a change (N, n) that stays when the rigid body has been fitted to it."""
        target = (change[self.rows] / self.scale).ravel()
        rest = target - self.basis @ (self.basis.T @ target)
        return share(rest.reshape(len(self.rows), -1), np.ones(change.shape[1]))

    def _inertial_columns(self, world: World) -> list[Array]:
        """Outputs are linear in the ten parameters of each body, so differences are the regressor's columns."""
        states = [values[self.rows] for values in world.motion(world.times)[1:]]
        columns = []
        for joint in world.arm.distal_joints:
            start = (world.arm.model.inertias[joint] + pin.Inertia.FromSphere(1.0, 0.1)).toDynamicParameters()
            base = world.arm.with_inertias({joint: pin.Inertia.FromDynamicParameters(start)}).evaluate(*states)
            for unit in np.eye(10):
                body = pin.Inertia.FromDynamicParameters(start + unit)
                columns.append(world.arm.with_inertias({joint: body}).evaluate(*states) - base)
        return columns
