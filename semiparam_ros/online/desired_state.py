"""From desired motion to the efforts that it takes: what the paper's model is for.

A wrench model knows what crosses the sensor, measured or learnt, so the joint torques follow (Ivaldi et al. 2011): let
w be the wrench that the sensor exerts on the links distal of it, in the sensor frame, and w_0 what the robot
description alone would need for the motion. Cutting the arm at the sensor, the torques of the whole arm are those of
the proximal links plus J'w, where J is the Jacobian of the sensor frame; the description's own torques are those of
the same proximal links plus J'w_0. Hence

    tau = rnea(q, dq, ddq) + J(q)' (w - w_0).

What is the sensor's own (its offset, a drift, gains) is no part of w: motors must not follow it.
Joints distal of the sensor have no column in J: their torques stay those of the description, and of known tools.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.finite import require_finite
from semiparam_ros.core.prediction import DesiredOutputs
from semiparam_ros.core.robot.frames import as_matrix
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import base_scale
from semiparam_ros.core.types import Array

RANGE_MARGIN = 0.05
"""How far beyond the inputs learnt still counts as within them, as a share of their range."""
DESCRIBED_TO = 0.3
"""Inertial parameters of a description are taken for known to this share of their size."""


class Desired(NamedTuple):
    """Outputs (n,) and ``efforts`` [N m] for the motors, of the body's ``effort_joints``, that one
    desired state takes now.

    A wrench is what the sensor will show, but for a bias that a tare took off. Efforts are what has to be commanded,
    cut to the limits of the URDF; the outputs of an effort model are these. Standard deviations hold the noise; those
    of efforts from a wrench also the uncertainty of the sensor's offset, and nothing of joints distal of the sensor.
    """

    outputs: Array
    outputs_std: Array
    efforts: Array
    efforts_std: Array
    limited: Array  # like efforts, where one was cut
    outside: tuple[str, ...]  # inputs outside of those learnt
    variance_ratio: float  # see DesiredOutputs
    distance: float  # from the inputs learnt, see DesiredOutputs
    described: bool  # by the robot description alone


def desired(estimator: Estimator, position: Array, velocity: Array, acceleration: Array,
            added: tuple[Array, Array] | None = None, beyond: Array | None = None) -> Desired:
    """Answer of the model to a desired state (n_joints,) each. Nothing is learnt.

    :param added: (n,) what known bodies add that the model has not learnt, as the sensor shows it, and as the arm
        needs it. :param beyond: (n_joints,) torques that they take of joints beyond the sensor, which it does not show.

    Raises SemiparamError when a value, or what follows from it, is not finite.
    """
    row = position, velocity, acceleration
    return _answer(estimator, row, estimator.predict_desired(*row), False, added, beyond)


def described(estimator: Estimator, position: Array, velocity: Array, acceleration: Array,
              added: tuple[Array, Array] | None = None, beyond: Array | None = None) -> Desired:
    """Answer of the robot description alone; its inertial parameters are taken for known to ``DESCRIBED_TO``.

    Raises SemiparamError when a value, or what follows from it, is not finite.
    """
    body, row = estimator.body, (position, velocity, acceleration)
    require_finite('desired positions, velocities and accelerations', np.concatenate(row))
    regressor = body.regressor(*row)
    outputs = regressor @ body.base_parameters
    uncertain = DESCRIBED_TO * regressor * base_scale(body)
    covariance = uncertain @ uncertain.T
    require_finite('described outputs of a desired state', np.concatenate([outputs, covariance.diagonal()]))
    return _answer(estimator, row, DesiredOutputs(outputs, outputs, covariance, 0.0), True, added, beyond)


def outside_of_the_learnt(estimator: Estimator, row: tuple[Array, Array, Array]) -> tuple[str, ...]:
    """Names of the inputs that lie outside of those learnt, such as ``velocity of elbow``."""
    names = [f'{kind} of {joint}' for kind in ('position', 'velocity', 'acceleration')
             for joint in estimator.body.joints]
    if not len(estimator.inputs_learnt):
        return tuple(names)
    lowest, highest = estimator.inputs_learnt
    margin, x = RANGE_MARGIN * (highest - lowest), np.concatenate(row)
    return tuple(names[index] for index in np.flatnonzero((x < lowest - margin) | (x > highest + margin)))


def _answer(estimator: Estimator, row: tuple[Array, Array, Array], found: DesiredOutputs, described: bool,
            added: tuple[Array, Array] | None, beyond: Array | None) -> Desired:
    body, outside = estimator.body, outside_of_the_learnt(estimator, row)
    if added is not None:
        shown, needed = added
        found = found._replace(shown=found.shown + shown, needed=found.needed + needed)
    std = np.sqrt(found.covariance.diagonal())
    if body.outputs == 'effort':
        wanted, wanted_std = found.needed, std
    else:
        wanted, jacobian = joint_torques(body, *row, found.needed)
        if not described:
            wanted, jacobian = _corrected(estimator, row, found.needed, wanted, jacobian)
        if beyond is not None:
            wanted = wanted + beyond
        wanted_std = np.sqrt(np.einsum('ij,ik,kj->j', jacobian, found.covariance, jacobian).clip(0.0))
        require_finite('efforts of a desired state', np.concatenate([wanted, wanted_std]))
    efforts = wanted.clip(-body.effort_limits, body.effort_limits)
    outputs = efforts if body.outputs == 'effort' else found.shown
    return Desired(outputs, std, efforts, wanted_std, efforts != wanted, outside, found.variance_ratio,
                   found.distance, described)


def _corrected(estimator: Estimator, row: tuple[Array, Array, Array], wrench: Array, torques: Array,
               jacobian: Array) -> tuple[Array, Array]:
    """The torques of :func:`joint_torques` and their derivative where effects say that joints stand elsewhere, or that
    gravity points elsewhere, as in the wrench: as far as these effects are believed."""
    found = estimator.columns.as_it_is(row)
    if found is None:
        return torques, jacobian
    body, row, moved = found
    true_torques, true_jacobian = joint_torques(body, *row, wrench)
    probability = estimator.effects_probability
    share = 1.0 if probability is None else float(probability.mean())
    return (torques + share * (moved @ true_torques - torques),
            jacobian + share * (true_jacobian @ moved.T - jacobian))


def joint_torques(body: RigidBody, position: Array, velocity: Array, acceleration: Array,
                  wrench: Array) -> tuple[Array, Array]:
    """Torques [N m] of a motion in which the sensor, free of offset, shows ``wrench`` (6,), and d torque / d wrench.

    Shapes (n_joints,) and (6, n_joints).
    """
    data = body.arm.createData()
    q, dq, ddq = (body.arm_vector(values) for values in (position, velocity, acceleration))
    described = np.array(pin.rnea(body.arm, data, q, dq, ddq))
    jacobian = body.sign * as_matrix(pin.computeFrameJacobian(body.arm, data, q, body.sensor_index, pin.LOCAL))
    expected = body.full_regressor(position, velocity, acceleration) @ body.inertial_parameters
    torques = described + jacobian.T @ (wrench - expected)
    return np.asarray(torques[body.arm_columns]), np.asarray(jacobian[:, body.arm_columns])
