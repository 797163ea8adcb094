"""The motion of the live benchmark, as numbers and as messages."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.types import Array
from semiparam_ros.ros.serialised import joint_state_layout, wrench_layout

CYCLE = 4000
JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
SENSOR = 'r_arm_ft_sensor'


class Motion:
    """A smooth, never quite repeating motion and the wrench that a rigid body with some noise would measure."""

    def __init__(self, body: RigidBody, rate_hz: float) -> None:
        rng = np.random.default_rng(0)
        time_s = np.arange(CYCLE)[:, None] / rate_hz
        turns = np.arange(1, 5) / (CYCLE / rate_hz) * 2.0 * np.pi
        amplitude, phase = rng.uniform(0.1, 0.3, (4, body.n_joints)), rng.uniform(0, 2 * np.pi, (4, body.n_joints))
        angle = turns[:, None] * time_s[:, :, None] + phase
        self.position = np.sum(amplitude * np.sin(angle), axis=1)
        self.velocity = np.sum(amplitude * turns[:, None] * np.cos(angle), axis=1)
        acceleration = -np.sum(amplitude * turns[:, None]**2 * np.sin(angle), axis=1)
        rows = zip(self.position, self.velocity, acceleration, strict=True)
        wrench = np.array([body.regressor(*row) @ body.base_parameters for row in rows])
        self.wrench: Array = wrench + 0.01 * rng.standard_normal(wrench.shape)

    def serialised(self) -> list[tuple[bytes, bytes]]:
        """Joint state and wrench of each instant as they go over the wire, to be stamped.

        The two processors of a virtual machine may share one core: this process must not slow the node down.
        """
        states, wrenches = joint_state_layout('', JOINTS, len(JOINTS), len(JOINTS), 0), wrench_layout(SENSOR)
        return [(states.write(0, position.tolist(), velocity.tolist()), wrenches.write(0, wrench.tolist()))
                for position, velocity, wrench in zip(self.position, self.velocity, self.wrench, strict=True)]
