"""The arm of a scenario: the package's own iCub arm, or any URDF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation import inverse_kinematics, urdf_edit
from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.scenario import Scenario

ICUB_JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
ICUB_SENSOR = 'r_arm_ft_sensor'
# The elbow reaches over ten centimetres only: circles must lie across the line from the shoulder to the hand.
ICUB_HOMES = {'circle_xy': (-0.3, 0.75, 1.4, 1.29), 'circle_xz': (-0.68, 1.8, 1.35, 1.3)}


def arm_of(scenario: Scenario) -> Arm:
    """The arm as the URDF describes it; the package's own iCub arm when no URDF is given."""
    if scenario.urdf is None:
        joints, frame = scenario.joints or ICUB_JOINTS, scenario.sensor_frame or ICUB_SENSOR
        return Arm.from_urdf(bundled_urdf().read_text(), joints, scenario.outputs, frame, scenario.convention)
    joints = scenario.joints or urdf_edit.turning_joints(urdf_edit.parse(scenario.urdf))
    return Arm.from_urdf(scenario.urdf, joints, scenario.outputs, scenario.sensor_frame,
                         scenario.convention)


def homes_of(scenario: Scenario, arm: Arm) -> dict[str, Array]:
    """The posture that circles in each plane go around."""
    if scenario.home is not None and len(scenario.home) != arm.n_joints:
        raise SemiparamError(f'home has {len(scenario.home)} values; expected one for each of {arm.n_joints} joints.')
    if scenario.home is None and scenario.urdf is None and arm.joints == ICUB_JOINTS:
        return {plane: np.array(home) for plane, home in ICUB_HOMES.items()}
    home = inverse_kinematics.home(arm) if scenario.home is None else np.array(scenario.home, dtype=float)
    return dict.fromkeys(ICUB_HOMES, home)


def bundled_urdf() -> Path:
    """config/icub_right_arm.urdf of the checkout, or of the installation's share folder."""
    inside = Path('config') / 'icub_right_arm.urdf'
    folders = Path(__file__).resolve().parents[2:]
    candidates = [folders[0] / inside, *(folder / 'share' / 'semiparam_ros' / inside for folder in folders)]
    for path in candidates:
        if path.is_file():
            return path
    raise SemiparamError('the robot description config/icub_right_arm.urdf of this package is not installed.')
