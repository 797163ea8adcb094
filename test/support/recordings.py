"""Recordings of the iCub arm that tests make for themselves."""

import itertools
from pathlib import Path

import numpy as np

from semiparam_ros.bags import sample_messages
from semiparam_ros.bags.conversion import write_description
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.settings import Settings, dump_params

URDF = Path(__file__).resolve().parents[2] / 'config/icub_right_arm.urdf'
FRAME, JOINTS = 'r_arm_ft_sensor', ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
PERIOD_NS = 50_000_000
INITIAL = 100


def write_params(path: Path) -> Path:
    """Parameters for :func:`write_arm`: few features, a window of INITIAL samples, a short horizon."""
    dump_params(Settings.from_mapping({'sensor_frame': FRAME, 'joints': list(JOINTS), 'features.count': 20,
                                       'initial.samples': INITIAL, 'horizon.length': 5}), path)
    return path


def write_arm(path: Path, length: int, seed: int = 1, start: int = 0, bias: float = 1.0) -> Path:
    """Smooth motion of the arm at 20 Hz, the wrench of its inertias 1.2 times, an offset (``bias``) and noise."""
    urdf = URDF.read_text()
    body = RigidBody.from_urdf(urdf, JOINTS, 'wrench', FRAME)
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.5, 3.0, 4), rng.uniform(0.0, 6.0, 4)
    with BagWriter(path) as bag:
        write_description(bag, urdf, start)
        for stamp in itertools.islice(itertools.count(start, PERIOD_NS), length):
            angle = frequency * (stamp - start) * 1e-9 + phase
            position, velocity = np.sin(angle), frequency * np.cos(angle)
            wrench = body.regressor(position, velocity, -(frequency**2) * np.sin(angle)) @ (1.2 * body.base_parameters)
            wrench = wrench + bias + 0.05 * rng.standard_normal(6)
            sample_messages.joint_state(bag, stamp, JOINTS, position.tolist(), velocity.tolist())
            sample_messages.wrench(bag, stamp, FRAME, wrench.tolist())
    return path
