"""An arm over many samples at once, joint after joint: a loop over samples takes ten times as long.

Arrays hold the samples along their last axis, so that each operation runs over all of them in one go.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.core.compiled import Matrix, Stack, compiled
from semiparam_ros.core.types import Array

FEW = 30
"""Up to so many samples, a loop over them is faster than arithmetic on all at once."""


class ArmMotion(NamedTuple):
    """Motion of every joint of a model over N samples, in the base: placements after its turn, and
    its own motion.

    Of a joint with several degrees of freedom, a free one that stays at zero, each is a column of its own.
    """

    model: pin.Model
    rotation: list[Array]  # (3, 3, N) of each joint
    position: list[Array]  # (3, N)
    slides: list[list[Array]]  # (3, N) of each of a joint's columns: velocity of all behind it at a unit speed
    turns: list[list[Array]]  # (3, N) the same, angular

    def placement(self, frame: int) -> tuple[Array, Array]:
        """Rotation (3, 3, N) and position (3, N) of a frame."""
        carrier, inside = self.model.frames[frame].parentJoint, self.model.frames[frame].placement
        rotation = self.rotation[carrier]
        return inside.rotation.T @ rotation, self.position[carrier] + inside.translation @ rotation

    def jacobian(self, frame: int, position: Array) -> tuple[Array, Array]:
        """(3, nv, N) velocity and angular velocity of a frame at positions (3, N), for a unit speed of each column."""
        linear, angular = np.zeros((2, 3, self.model.nv, position.shape[1]))
        for joint in list(self.model.supports[self.model.frames[frame].parentJoint])[1:]:
            for column, slide, turn in self.columns(joint):
                angular[:, column] = turn
                linear[:, column] = slide + cross(turn, position - self.position[joint])
        return linear, angular

    def columns(self, joint: int) -> list[tuple[int, Array, Array]]:
        """Number, slide and turn of each column of a joint."""
        first = self.model.joints[joint].idx_v
        return [(first + number, *axes) for number, axes in enumerate(zip(self.slides[joint], self.turns[joint],
                                                                         strict=True))]


def arm_motion(model: pin.Model, travel: Array) -> ArmMotion:
    """:param travel: (nv, N) [rad or m] of each joint of the model."""
    count = travel.shape[1]
    motion = ArmMotion(model, [np.broadcast_to(np.eye(3)[:, :, None], (3, 3, count))], [np.zeros((3, count))], [[]],
                       [[]])
    for number in range(1, model.njoints):
        joint, parent, before = model.joints[number], model.parents[number], model.jointPlacements[number]
        own = joint.createData()
        joint.calc(own, pin.neutral(model))
        axes = np.array(own.S).reshape(6, joint.nv)
        base = before.rotation.T @ motion.rotation[parent]
        place = motion.position[parent] + before.translation @ motion.rotation[parent]
        if joint.nv == 1:
            angle, about = travel[joint.idx_v], pin.skew(axes[3:, 0])
            place = place + (axes[:3, 0] @ base) * angle
            base = base + np.sin(angle) * (about.T @ base) + (1.0 - np.cos(angle)) * ((about @ about).T @ base)
        motion.position.append(place)
        motion.rotation.append(base)
        motion.slides.append([axis @ base for axis in axes[:3].T])
        motion.turns.append([axis @ base for axis in axes[3:].T])
    return motion


def effort_regressors(model: pin.Model, travel: Array, velocity: Array, acceleration: Array, rows: Sequence[int],
                      first_body: int = 1) -> Array:
    """(len(rows), 10 bodies, N) by which the efforts of some columns follow from the bodies' inertial parameters.

    In the axes of each body, with its angular velocity w and acceleration dw and the acceleration a of its origin less
    gravity, its force is m a + (dw x + w x w x) mc and its moment I dw + w x I w + mc x a (Atkeson et al. 1986).

    :param travel: and its derivatives (nv, N) of each joint of the model. :param rows: the columns whose efforts.
    :param first_body: the joint of the first body; those of all after it are meant too.
    """
    motion, count = arm_motion(model, travel), travel.shape[1]
    result = np.zeros((len(rows), 10 * (model.njoints - first_body), count))
    moving = _accelerations(motion, velocity, acceleration)
    for body in range(first_body, model.njoints):
        rotation = motion.rotation[body]
        turning, change, gain = (_seen_from(rotation, values) for values in moving[body])
        entries = slice(10 * (body - first_body), 10 * (body - first_body) + 10)
        for joint in list(model.supports[body])[1:]:
            for column, slide, turn in motion.columns(joint):
                if column in rows:
                    lever = motion.position[body] - motion.position[joint]
                    _write(rotation, slide, turn, lever, turning, change, gain, result[rows.index(column), entries])
    return result


@compiled
def _write(rotation: Stack, slide: Matrix, turn: Matrix, lever: Matrix, turning: Matrix, change: Matrix, gain: Matrix,
           effort: Matrix) -> None:
    """Into ``effort`` (10, N) that of one column by m, mc, and inertias xx, xy, yy, xz, yz, zz of a body.

    :param slide: and ``turn`` (3, N) of the column, in the base. :param lever: (3, N) from its joint to the body's.
    :param turning: and ``change``, ``gain`` (3, N) of the body in its own axes ``rotation`` (3, 3, N).
    """
    for t in range(effort.shape[1]):
        tx, ty, tz = turn[0, t], turn[1, t], turn[2, t]
        lx, ly, lz = lever[0, t], lever[1, t], lever[2, t]
        mx, my, mz = slide[0, t] + ty * lz - tz * ly, slide[1, t] + tz * lx - tx * lz, slide[2, t] + tx * ly - ty * lx
        a = rotation[0, 0, t] * mx + rotation[1, 0, t] * my + rotation[2, 0, t] * mz
        b = rotation[0, 1, t] * mx + rotation[1, 1, t] * my + rotation[2, 1, t] * mz
        c = rotation[0, 2, t] * mx + rotation[1, 2, t] * my + rotation[2, 2, t] * mz
        x = rotation[0, 0, t] * tx + rotation[1, 0, t] * ty + rotation[2, 0, t] * tz
        y = rotation[0, 1, t] * tx + rotation[1, 1, t] * ty + rotation[2, 1, t] * tz
        z = rotation[0, 2, t] * tx + rotation[1, 2, t] * ty + rotation[2, 2, t] * tz
        p, q, r = turning[0, t], turning[1, t], turning[2, t]
        dp, dq, dr = change[0, t], change[1, t], change[2, t]
        gx, gy, gz = gain[0, t], gain[1, t], gain[2, t]
        u, v, w = y * r - z * q, z * p - x * r, x * q - y * p
        i, j, k = q * c - r * b, r * a - p * c, p * b - q * a
        effort[0, t] = a * gx + b * gy + c * gz
        effort[1, t] = b * dr - c * dq + q * k - r * j + gy * z - gz * y
        effort[2, t] = c * dp - a * dr + r * i - p * k + gz * x - gx * z
        effort[3, t] = a * dq - b * dp + p * j - q * i + gx * y - gy * x
        effort[4, t] = x * dp + u * p
        effort[5, t] = x * dq + y * dp + u * q + v * p
        effort[6, t] = y * dq + v * q
        effort[7, t] = x * dr + z * dp + u * r + w * p
        effort[8, t] = y * dr + z * dq + v * r + w * q
        effort[9, t] = z * dr + w * r


def _accelerations(motion: ArmMotion, velocity: Array, acceleration: Array) -> list[tuple[Array, Array, Array]]:
    """Angular velocity of each joint's body, its change, and the acceleration less gravity (3, N),
    in the base."""
    still = np.zeros_like(motion.position[0])
    found = [(still, still, still - np.array(motion.model.gravity.linear)[:, None])]
    for joint in range(1, motion.model.njoints):
        parent = motion.model.parents[joint]
        turning, change, gain = found[parent]
        arm = motion.position[joint] - motion.position[parent]
        gain = gain + cross(change, arm) + cross(turning, cross(turning, arm))
        for column, slide, turn in motion.columns(joint):
            gain = gain + slide * acceleration[column] + 2.0 * cross(turning, slide * velocity[column])
            change = change + turn * acceleration[column] + cross(turning, turn * velocity[column])
            turning = turning + turn * velocity[column]
        found.append((turning, change, gain))
    return found


def _seen_from(rotation: Array, values: Array) -> Array:
    """Vectors (3, N) of the base in axes turned by ``rotation`` (3, 3, N)."""
    return np.asarray((rotation * values[:, None]).sum(axis=0))


def cross(left: Array, right: Array) -> Array:
    """(3, N) of vectors (3, N)."""
    (a, b, c), (x, y, z) = left, right
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])
