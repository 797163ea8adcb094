"""Pinocchio models from URDF trees: built, with joints locked, and with the sensor's frame marked."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pinocchio as pin

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

GRAVITY = np.array([0.0, 0.0, -9.81])
SENSOR = 'semiparam_sensor'
ROOT = 'semiparam_root'


def build(robot: ElementTree.Element, root: pin.JointModel | None = None) -> pin.Model:
    """The model of a whole tree, on a fixed base unless ``root`` is the joint that carries it."""
    text = ElementTree.tostring(robot, encoding='unicode')
    try:
        model = pin.buildModelFromXML(text) if root is None else pin.buildModelFromXML(text, root, ROOT)
    except Exception as error:
        reason = ' '.join(str(error).split())
        raise SemiparamError(f'the robot description cannot be read as a robot: {reason}') from error
    model.gravity.linear = GRAVITY
    return model


def check_locked(joints: Sequence[str], locked: Mapping[str, float]) -> None:
    """Raise SemiparamError when a joint is to move and to be locked at once."""
    for name in joints:
        if name in locked:
            raise SemiparamError(f"joint '{name}' is named both among the moving and the locked joints.")


def with_gravity(model: pin.Model, gravity: Array) -> tuple[pin.Model, pin.Data]:
    """A copy of the model under another gravity (3,) [m/s^2], and data for it."""
    model = model.copy()
    model.gravity.linear = gravity
    return model, model.createData()


def _posture(model: pin.Model, locked: Mapping[str, float]) -> Array:
    posture = pin.neutral(model)
    for name, value in locked.items():
        if not model.existJointName(name):
            raise SemiparamError(f"locked joint '{name}' is not a moving joint of the robot description.")
        joint = model.joints[model.getJointId(name)]
        if joint.nq != 1 or not np.isfinite(value):
            raise SemiparamError(f"locked joint '{name}' is held at {value}; expected one finite number for a joint "
                                 'that is revolute, continuous or prismatic.')
        posture[joint.idx_q] = value
    return np.asarray(posture)


def reduced(model: pin.Model, joints: Collection[str], locked: Mapping[str, float],
            keep_root: bool = False) -> pin.Model:
    """The model with all but the named joints held where ``locked`` says, 0 unless given."""
    moving = set(joints) | ({model.names[1]} if keep_root else set())
    frozen = [model.getJointId(name) for name in list(model.names)[1:] if name not in moving]
    return pin.buildReducedModel(model, frozen, _posture(model, locked))


def mark_sensor(arm: pin.Model, full: pin.Model, joints: Sequence[str], locked: Mapping[str, float],
                link: str) -> None:
    """Add a frame ``SENSOR`` to the arm, where the sensor's link is (fixed to its nearest moving joint)."""
    posture = _posture(full, locked)
    data = full.createData()
    pin.framesForwardKinematics(full, data, posture)
    placement = data.oMf[full.getFrameId(link, pin.FrameType.BODY)]
    joint = full.frames[full.getFrameId(link, pin.FrameType.BODY)].parentJoint
    while joint and full.names[joint] not in joints:
        joint = full.parents[joint]
    carrier = arm.getJointId(full.names[joint]) if joint else 0
    arm.addFrame(pin.Frame(SENSOR, carrier, 0, data.oMi[joint].actInv(placement), pin.FrameType.OP_FRAME))
