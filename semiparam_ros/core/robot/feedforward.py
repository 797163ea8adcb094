"""From desired motion to the efforts that it takes: what the paper's model is for.

A wrench model knows what crosses the sensor, measured or learnt, so the joint torques follow (Ivaldi et al. 2011): let
w be the wrench that the sensor exerts on the links distal of it, in the sensor frame, and w_0 what the robot
description alone would need for the motion. Cutting the arm at the sensor, the torques of the whole arm are those of
the proximal links plus J'w, where J is the Jacobian of the sensor frame; the description's own torques are those of
the same proximal links plus J'w_0. Hence

    tau = rnea(q, dq, ddq) + J(q)' (w - w_0).

What is the sensor's own (its offset, a drift, gains) is no part of w: motors must not follow it.
Joints distal of the sensor have no column in J: their torques stay those of the description.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.types import Array


class Desired:
    """What one desired state takes, as of now: ``outputs`` (n,), and ``efforts`` (n_joints,) [N m] for the motors.

    A wrench is what the sensor will show, but for a bias that a tare took off. Efforts are what has to be commanded;
    the outputs of an effort model are these.
    """

    def __init__(self, estimator: Estimator, position: Array, velocity: Array, acceleration: Array) -> None:
        """Raises SemiparamError when a value is not finite. Nothing is learnt."""
        body = estimator.body
        predicted = estimator.predict_desired(position, velocity, acceleration)
        if body.outputs == 'effort':
            self.outputs = self.efforts = predicted.needed
        else:
            self.outputs = predicted.shown
            self.efforts = joint_torques(body, position, velocity, acceleration, predicted.needed)


def joint_torques(body: RigidBody, position: Array, velocity: Array, acceleration: Array, wrench: Array) -> Array:
    """(n_joints,) torques [N m] of a motion in which the sensor, free of offset, shows ``wrench`` (6,)."""
    data = body.arm.createData()
    q, dq, ddq = (body.arm_vector(values) for values in (position, velocity, acceleration))
    described = np.array(pin.rnea(body.arm, data, q, dq, ddq))
    jacobian = pin.computeFrameJacobian(body.arm, data, q, body.sensor_index, pin.LOCAL)
    expected = body.full_regressor(position, velocity, acceleration) @ body.inertial_parameters
    difference = body.sign * (wrench - expected)
    return np.asarray((described + jacobian.T @ difference)[body.arm_columns])
