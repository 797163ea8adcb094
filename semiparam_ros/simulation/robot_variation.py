"""A robot that differs from its URDF, as every real one does."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.arrays import Array

MASS_ERROR = (0.10, 0.30)
STRETCH = 0.06
SHIFT_M = 0.006


def varied(arm: Arm, rng: np.random.Generator) -> Arm:
    """The same arm with masses wrong by 10 to 30 %, and centres of mass and inertias wrong with them.

    Each body is scaled in density and deformed by an affine map near the identity, which acts on its 4 x 4
    pseudo-inertia by congruence: the result is a body that can exist.
    """
    bodies = {}
    for joint in range(1, arm.model.njoints):
        factor = 1 + rng.choice([-1, 1]) * rng.uniform(*MASS_ERROR)
        deformation = np.eye(4)
        deformation[:3, :3] += STRETCH * rng.standard_normal((3, 3))
        deformation[:3, 3] = SHIFT_M * rng.standard_normal(3)
        if arm.model.inertias[joint].mass > 0:
            bodies[joint] = _deformed(arm.model.inertias[joint], factor, deformation)
    return arm.with_inertias(bodies)


def _deformed(body: pin.Inertia, factor: float, deformation: Array) -> pin.Inertia:
    pseudo = pin.PseudoInertia.FromInertia(body).toMatrix()
    return pin.PseudoInertia.FromMatrix(factor * deformation @ pseudo @ deformation.T).toInertia()
