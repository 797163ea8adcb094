"""The arm of a scenario, the package's own iCub arm or any URDF, and how it differs from its description, as every
real one does.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation import urdf_edit
from semiparam_ros.simulation.arm import Arm, home_posture
from semiparam_ros.simulation.scenario import Scenario

MASS_ERROR = (0.10, 0.30)
STRETCH = 0.06
SHIFT_M = 0.006

ICUB_JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
ICUB_SENSOR = 'r_arm_ft_sensor'
# The elbow reaches over ten centimetres only: circles must lie across the line from the shoulder to the hand.
ICUB_HOMES = {'circle_xy': (-0.3, 0.75, 1.4, 1.29), 'circle_xz': (-0.68, 1.8, 1.35, 1.3)}


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


def arm_of(scenario: Scenario) -> Arm:
    """The arm as the URDF describes it; the package's own iCub arm when no URDF is given."""
    urdf, frame = scenario.urdf, scenario.sensor_frame
    every: Sequence[str] = ICUB_JOINTS
    if urdf is None:
        urdf, frame = bundled_urdf().read_text(), frame or ICUB_SENSOR
    else:
        every = urdf_edit.turning_joints(urdf_edit.parse(urdf))
    joints = scenario.joints or tuple(name for name in every if name not in dict(scenario.locked))
    return Arm.from_urdf(urdf, joints, scenario.outputs, frame, scenario.convention, scenario.locked)


def homes_of(scenario: Scenario, arm: Arm) -> dict[str, Array]:
    """The posture that circles in each plane go around."""
    if scenario.home is not None and len(scenario.home) != arm.n_joints:
        raise SemiparamError(f'home has {len(scenario.home)} values; expected one for each of {arm.n_joints} joints.')
    if scenario.home is None and scenario.urdf is None and arm.joints == ICUB_JOINTS:
        return {plane: np.array(home) for plane, home in ICUB_HOMES.items()}
    home = home_posture(arm) if scenario.home is None else np.array(scenario.home, dtype=float)
    return dict.fromkeys(ICUB_HOMES, home)


def bundled_urdf() -> Path:
    """Path of config/icub_right_arm.urdf in the checkout, or in the installation's share folder."""
    inside = Path('config') / 'icub_right_arm.urdf'
    folders = Path(__file__).resolve().parents[2:]
    candidates = [folders[0] / inside, *(folder / 'share' / 'semiparam_ros' / inside for folder in folders)]
    for path in candidates:
        if path.is_file():
            return path
    raise SemiparamError('the robot description config/icub_right_arm.urdf of this package is not installed.')
