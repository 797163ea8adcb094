"""The arm, the model and the motion that `semiparam bench` times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semiparam_ros.core.hyperparameters import Hyperparameters
from semiparam_ros.core.model import Estimator, ModelOptions
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body

PERIOD_NS = 1_000_000
NOISE = 0.05


def arm(urdf: str | Path, frame: str) -> RigidBody:
    """The wrench regressor of an arm whose joints all move."""
    return build_rigid_body(Settings(robot_description_file=str(urdf), sensor_frame=frame))


def estimator(body: RigidBody, count: int) -> Estimator:
    """SPK with D = ``count`` that is past its initial window: hyperparameters do not change what a sample costs."""
    size = 3 * body.n_joints
    given = Hyperparameters(gamma=1.0, rho=1.0, tau=(1.0, 3.0, 6.0), sigma=0.1, output_scale=(1.0,) * body.n_outputs)
    return Estimator(body, ModelOptions(variant='SPK-ML', features_count=count, length_scales='kind',
                                        hyperparameters=given, input_mean=(0.0,) * size, input_scale=(1.0,) * size))


def motion(body: RigidBody, length: int, seed: int = 0) -> list[Sample]:
    """Sinusoids on every joint at 1 kHz, and the wrenches of the URDF's inertias with white noise."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(2.0, 6.0, body.n_joints), rng.uniform(0.0, 2.0 * np.pi, body.n_joints)
    samples = []
    for index in range(length):
        angle = frequency * index * PERIOD_NS * 1e-9 + phase
        position, velocity, acceleration = np.sin(angle), frequency * np.cos(angle), -(frequency**2) * np.sin(angle)
        outputs = body.regressor(position, velocity, acceleration) @ body.base_parameters
        noise = NOISE * rng.standard_normal(body.n_outputs)
        samples.append(Sample(index * PERIOD_NS, position, velocity, acceleration, outputs + noise))
    return samples
