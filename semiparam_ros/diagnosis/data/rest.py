"""Joints at rest and joints that slide: what their efforts tell.

Static friction holds any effort up to its own, so the effort of a joint at rest tells nothing. Where a
joint is slow or turns back, the form of its dry friction decides what its effort is; where it slides,
dry friction is constant.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter1d, minimum_filter1d

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import typical_step


def resting(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N, n_joints) true where a joint stays where it is for ``config.rest_s``.

    Looks at positions, for the noise of recorded velocities hides a rest. A joint that turns back moves on both sides.
    """
    step = typical_step(samples.time)
    size = 2 * max(round(0.5 * config.rest_s / step), 1) + 1
    window = (size - 1) * step
    position = samples.position
    travel = maximum_filter1d(position, size, axis=0) - minimum_filter1d(position, size, axis=0)
    still = travel < config.rest_speed_share * np.abs(samples.velocity).max(axis=0) * window
    return np.asarray(binary_dilation(still, np.ones((size, 1))))


def sliding(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N, n_joints) true where a joint goes one way, and faster than ``config.friction_turn_share`` of
    its highest speed, for ``config.sliding_s`` before and after."""
    size = 2 * max(round(config.sliding_s / typical_step(samples.time)), 1) + 1
    velocity = samples.velocity
    slow = config.friction_turn_share * np.abs(velocity).max(axis=0)
    return np.asarray((minimum_filter1d(velocity, size, axis=0) > slow)
                      | (maximum_filter1d(velocity, size, axis=0) < -slow))


def counted_outputs(body: RigidBody, samples: Samples, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N, n) outputs that tell something: of efforts, those of joints that move.

    Those of a joint that hardly ever moves stay, for nothing would be left of it.
    """
    counted = np.ones(samples.outputs.shape, dtype=bool)
    if body.outputs == 'effort':
        moving = ~resting(samples, config)[:, body.output_index]
        counted = moving | (moving.sum(axis=0) < config.least_working_samples)
    return counted
