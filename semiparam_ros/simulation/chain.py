"""Kinematics of a frame for a whole motion at once: (N, ...) arrays instead of a loop over samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.simulation.arrays import Array


class Poses(NamedTuple):
    """A frame along a motion, in base axes: ``rotation`` (N, 3, 3), ``place`` (N, 3) [m], ``jacobian``
    (N, 6, n_joints), linear rows first, of the frame's origin."""

    rotation: Array
    place: Array
    jacobian: Array

    def velocity(self, joint_velocity: Array) -> Array:
        """(N, 6) linear [m/s] and angular [rad/s] velocity of the frame."""
        return np.asarray(np.einsum('nkj,nj->nk', self.jacobian, joint_velocity))

    def shifted(self, offset: Array) -> Poses:
        """The frame moved by ``offset`` (3,) [m] in its own axes."""
        arm = self.rotation @ offset
        linear = self.jacobian[:, :3] + np.cross(self.jacobian[:, 3:], arm[:, :, None], axisa=1, axisb=1, axisc=1)
        return Poses(self.rotation, self.place + arm, np.concatenate([linear, self.jacobian[:, 3:]], axis=1))


def poses(model: pin.Model, joint: int, placement: pin.SE3, columns: Sequence[int], position: Array) -> Poses:
    """Poses of a frame fixed to ``joint`` by ``placement``; ``columns`` places the joints in the model."""
    count = len(position)
    rotation, place = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
    moving = []
    for index in list(model.supports[joint])[1:]:
        rotation, place = _fixed_step(rotation, place, model.jointPlacements[index])
        column = _column(model, index, columns)
        if column is not None:
            linear, angular = _axis(model, index)
            moving.append((column, rotation @ linear, rotation @ angular, place))
            place = place + position[:, column, None] * (rotation @ linear)
            rotation = rotation @ rotation_about(angular, position[:, column])
    rotation, place = _fixed_step(rotation, place, placement)
    jacobian = np.zeros((count, 6, position.shape[1]))
    for column, linear, angular, origin in moving:
        jacobian[:, :3, column] = linear + np.cross(angular, place - origin)
        jacobian[:, 3:, column] = angular
    return Poses(np.asarray(rotation), place, jacobian)


def rotation_about(axis: Array, angle: Array) -> Array:
    """(N, 3, 3) rotations by ``angle`` (N,) [rad] about a unit ``axis`` (3,); the identity for a zero axis."""
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * skew + (1 - cosine) * (skew @ skew))


def _fixed_step(rotation: Array, place: Array, step: pin.SE3) -> tuple[Array, Array]:
    return rotation @ step.rotation, place + rotation @ step.translation


def _column(model: pin.Model, index: int, columns: Sequence[int]) -> int | None:
    place = int(model.joints[index].idx_q)
    return list(columns).index(place) if place in columns else None


def _axis(model: pin.Model, index: int) -> tuple[Array, Array]:
    """Motion subspace of a one-degree joint in its own frame: linear and angular part, each (3,)."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    column = pin.getJointJacobian(model, data, index, pin.ReferenceFrame.LOCAL)[:, model.joints[index].idx_v]
    return column[:3], column[3:]
