"""The calibrations that an engineer tries by hand on an arm with a force/torque sensor, all of them at once.

The zeros of all joints, a tilt of the base, the sensor's crosstalk, all base parameters, and each recording's bias.
Their cut-off is the one that the data which judge like best: no choice by the fit could be better.
"""

from dataclasses import replace

import numpy as np
import pinocchio as pin

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.diagnose import Diagnosis
from support.plain_model import CUT_OFFS, least_squares, nmse

GRAVITY = np.array([0.0, 0.0, -9.81])
ROUNDS, STEP = 3, 1e-4
EVERY_CUT_OFF = 3


def calibrated_error(found: Diagnosis) -> float:
    """Mean held-out error of these calibrations in place of the effects found."""
    samples = found.first.samples
    return _least_error(found, samples.outputs, np.zeros(found.first.body.n_joints))


def further_calibrated_error(found: Diagnosis) -> float:
    """Mean held-out error of these calibrations on top of the effects found, the rigid body fitted anew with them."""
    body, samples, used = found.first.body, found.first.samples, found.first.train_mask
    zeros = np.zeros(body.n_joints)
    for effect in found.final.effects:
        if effect.kind == 'joint_offset':
            zeros[body.joints.index(effect.where)] = effect.value('offset')
    predicted = samples.outputs - found.final.residual
    table = _rigid(body, samples, zeros, np.zeros(2))
    theta = least_squares(table[used], predicted[used], np.ones_like(predicted[used], dtype=bool))[-1]
    return _least_error(found, samples.outputs - (predicted - table @ theta), zeros)


def _least_error(found: Diagnosis, outputs: np.ndarray, zeros: np.ndarray) -> float:
    samples, judged = found.first.samples, found.held_out
    counted = np.ones(judged.sum(), dtype=bool)
    errors = [nmse(_residual(found, outputs, zeros, index)[judged], samples.outputs[judged], counted)
              for index in range(0, len(CUT_OFFS), EVERY_CUT_OFF)]
    return float(min(error.mean() for error in errors))


def _residual(found: Diagnosis, outputs: np.ndarray, zeros: np.ndarray, cut_off: int) -> np.ndarray:
    """(N, 6) left by Gauss and Newton's steps from zeros (n_joints,), in the outputs' units."""
    body, samples, used = found.first.body, found.first.samples, found.first.train_mask
    counted = np.ones((used.sum(), 6), dtype=bool)
    turned, count, size = np.concatenate([zeros, np.zeros(2)]), body.n_joints, body.n_parameters
    table = _rigid(body, samples, zeros, np.zeros(2))
    theta, crosstalk = least_squares(table[used], outputs[used], counted)[-1], np.zeros(36)
    for _ in range(ROUNDS):
        moved = [(_rigid(body, samples, there[:count], there[count:]) - table) @ theta / STEP
                 for there in turned + STEP * np.eye(len(turned))]
        mixed = np.einsum('ij,tk->tijk', np.eye(6), table[:, :, :size] @ theta[:size]).reshape(len(samples), 6, 36)
        left = outputs - table @ theta - mixed @ crosstalk
        columns = np.concatenate([table, np.stack(moved, axis=2), mixed], axis=2)
        change = least_squares(columns[used], left[used], counted)[cut_off]
        theta, crosstalk = theta + change[:len(theta)], crosstalk + change[-36:]
        turned = turned + change[len(theta):-36]
        table = _rigid(body, samples, turned[:count], turned[count:])
    return np.asarray(left - columns @ change)


def _rigid(body: RigidBody, samples: Samples, zeros: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """(N, 6, p): the rigid body with its joints' zeros off and its base tilted, and each recording's bias."""
    tilted = body.with_gravity(pin.exp3(np.append(tilt, 0.0)).T @ GRAVITY)
    biases = np.zeros((len(samples), 6, 6 * len(samples.recordings)))
    for number, part in enumerate(samples.recordings):
        biases[part, :, 6 * number:6 * number + 6] = np.eye(6)
    return np.concatenate([tilted.regressors(replace(samples, position=samples.position + zeros)), biases], axis=2)
