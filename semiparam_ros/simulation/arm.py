"""The simulated arm: a pinocchio model whose force/torque sensor is a joint that does not move, its kinematics, and
postures for a path of its tip.

Recursive Newton-Euler gives the spatial force that each joint transmits. When the sensor's fixed joint is turned into a
joint held at zero, the force that it transmits is the measured wrench, wherever in the chain the sensor sits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation import urdf_edit

CONVENTIONS = {'action': 1.0, 'reaction': -1.0}
OUTPUTS = ('wrench', 'effort')
CHANNELS = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')
JOINT = 'joint '
"""Before the names of joints while pinocchio locks some of them."""

ITERATIONS = 40
DAMPING_M = 1e-2
LIMIT_MARGIN = 0.03
TOLERANCE_RAD = 1e-7


class Poses(NamedTuple):
    """A frame along a motion, in base axes: ``rotation`` (N, 3, 3), ``place`` (N, 3) [m], ``jacobian``
    (N, 6, n_joints), linear rows first, of the frame's origin."""

    rotation: Array
    place: Array
    jacobian: Array

    def velocity(self, joint_velocity: Array) -> Array:
        """Velocity (N, 6) of the frame, linear [m/s] before angular [rad/s]."""
        return np.asarray(np.einsum('nkj,nj->nk', self.jacobian, joint_velocity))


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
    """Rotations (N, 3, 3) by ``angle`` (N,) [rad] about a unit or zero ``axis`` (3,)."""
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
    jacobian = pin.getJointJacobian(model, data, index, pin.ReferenceFrame.LOCAL)
    column = jacobian.reshape(6, model.nv)[:, model.joints[index].idx_v]  # of one joint it is a vector
    return column[:3], column[3:]


@dataclass(frozen=True)
class Arm:
    """The moving joints of one robot and what is measured on it. Build it with :meth:`from_urdf`."""

    model: pin.Model
    joints: tuple[str, ...]
    sensor_frame: str | None
    sign: float
    urdf: str

    @classmethod
    def from_urdf(cls, urdf: str, joints: Sequence[str], outputs: str = 'wrench', sensor_frame: str | None = None,
                  convention: str = 'reaction', locked: Sequence[tuple[str, float]] = ()) -> Arm:
        """Read an arm from URDF text; joints not named stay at zero.

        :param outputs: ``wrench`` at ``sensor_frame`` (a link or a fixed joint), or joint ``effort``.
        :param locked: positions [rad, m] of joints that stay elsewhere.
        Raises SemiparamError for an unknown joint, frame, output or convention.
        """
        _check_choice('outputs', outputs, OUTPUTS)
        _check_choice('wrench_convention', convention, tuple(CONVENTIONS))
        edited = urdf_edit.single_turn(urdf_edit.parse(urdf))
        urdf_edit.check_joints(edited, [*joints, *(name for name, _ in locked)])
        if outputs == 'effort':
            return cls(_reduced(edited, joints, locked), tuple(joints), None, 1.0, urdf)
        if not sensor_frame:
            raise SemiparamError('sensor_frame is empty; a simulated wrench needs the link or joint of the sensor.')
        sensor_joint = urdf_edit.free_sensor_joint(edited, sensor_frame)
        model = _reduced(edited, [*joints, sensor_joint], locked)
        arm = cls(model, tuple(joints), sensor_joint, CONVENTIONS[convention], urdf)
        if sum(model.inertias[j].mass for j in arm.distal_joints) <= 0.0:
            raise SemiparamError(f'sensor_frame {sensor_frame} carries no mass: there is no wrench to simulate.')
        return arm

    @property
    def outputs(self) -> str:
        """Name of what is measured: ``wrench`` or ``effort``."""
        return 'wrench' if self.sensor_frame else 'effort'

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the n outputs: six wrench components, or the joints."""
        return CHANNELS if self.sensor_frame else self.joints

    @property
    def n_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joints)

    @property
    def columns(self) -> list[int]:
        """Place of each named joint in the model's configuration vector."""
        return [int(self.model.joints[self.model.getJointId(name)].idx_q) for name in self.joints]

    def slides(self, joint: str) -> bool:
        """Tell whether a moving joint is prismatic."""
        return str(self.model.joints[self.model.getJointId(joint)].shortname()).startswith('JointModelP')

    @property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper joint limits [rad], each (n_joints,)."""
        return self.model.lowerPositionLimit[self.columns], self.model.upperPositionLimit[self.columns]

    @property
    def speed_limits(self) -> Array:
        """Largest speeds (n_joints,) [rad/s]; of a URDF that says 0, which stands for not known, no limit."""
        limits = self.model.velocityLimit[self.columns]
        return np.where(limits > 0.0, limits, np.inf)

    @property
    def distal_joints(self) -> list[int]:
        """pinocchio indices of the joints whose bodies load the outputs: beyond the sensor, or all."""
        if self.sensor_frame is None:
            return list(range(1, self.model.njoints))
        return list(self.model.subtrees[self.model.getJointId(self.sensor_frame)])

    def distal_frames(self) -> list[str]:
        """Links with mass that load the outputs, nearest first; for efforts only those that every joint moves."""
        names = urdf_edit.massive_links(urdf_edit.parse(self.urdf))
        last = self.model.getJointId(self.joints[-1])
        inside = set(self.distal_joints if self.sensor_frame else self.model.subtrees[last])
        frames = [frame for frame in self.model.frames if frame.parentJoint in inside]
        return [frame.name for frame in frames if frame.name in names and frame.type == pin.FrameType.BODY]

    @property
    def tip(self) -> str:
        """The last link of the chain: the end effector."""
        return str([frame.name for frame in self.model.frames if frame.type == pin.FrameType.BODY][-1])

    def frame_id(self, name: str) -> int:
        """Index of a link, or of the joint of that name; an unknown one raises SemiparamError."""
        for kind in (pin.FrameType.BODY, pin.FrameType.FIXED_JOINT, pin.FrameType.JOINT):
            if self.model.existFrame(name, kind):
                return int(self.model.getFrameId(name, kind))
        raise SemiparamError(f"the URDF has no frame '{name}'; expected one of {', '.join(self.distal_frames())}.")

    def configuration(self, values: Array) -> Array:
        """Convert (N, n_joints), as ``joints``, to the model's (N, nq), its sensor joint at zero.
        """
        full = np.zeros((len(values), self.model.nq))
        full[:, self.columns] = values
        return full

    def evaluate(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Rigid-body outputs (N, n) [N, N m] in the sensor's sign convention, by recursive Newton-Euler."""
        model, data = self.model, self.model.createData()
        states = zip(*(self.configuration(x) for x in (position, velocity, acceleration)), strict=True)
        if self.sensor_frame is None:
            return np.array([pin.rnea(model, data, *state) for state in states])[:, self.columns]
        sensor = model.getJointId(self.sensor_frame)
        wrench = np.empty((len(position), 6))
        for row, state in enumerate(states):
            pin.rnea(model, data, *state)
            wrench[row] = data.f[sensor].vector
        return self.sign * wrench

    def pose(self, frame: str, position: Array) -> Poses:
        """Rotation, place and Jacobian of a frame along the motion, in base axes."""
        item = self.model.frames[self.frame_id(frame)]
        return poses(self.model, item.parentJoint, item.placement, self.columns, position)

    def load_of_force(self, pose: Poses, force: Array, position: Array) -> Array:
        """Change of the outputs (N, n) when a force (N, 3) [N], base axes, pushes on the body at ``pose``.

        The arm must hold against it: efforts change by -J'f. The action of the sensor on the distal bodies changes by
        the opposite wrench, moved to the sensor (only for frames distal of the sensor).
        """
        if self.sensor_frame is None:
            return np.asarray(-np.einsum('nkj,nk->nj', pose.jacobian[:, :3], force))
        sensor = self.pose(self.sensor_frame, position)
        about = np.cross(pose.place - sensor.place, force)
        local = [np.einsum('nij,ni->nj', sensor.rotation, vector) for vector in (force, about)]
        return np.asarray(-self.sign * np.hstack(local))

    def with_body(self, frame: str, inertia: pin.Inertia) -> Arm:
        """The same arm with one more body fixed to ``frame``."""
        item, model = self.model.frames[self.frame_id(frame)], self.model.copy()
        model.appendBodyToJoint(item.parentJoint, inertia, item.placement)
        return replace(self, model=model)

    def with_gravity(self, gravity: Array) -> Arm:
        """The same arm under another gravity vector (3,) [m/s^2] in base axes."""
        model = self.model.copy()
        model.gravity = pin.Motion(np.asarray(gravity, float), np.zeros(3))
        return replace(self, model=model)

    def with_inertias(self, inertias: dict[int, pin.Inertia]) -> Arm:
        """The same arm with other bodies; ``inertias`` is keyed by pinocchio's joint index."""
        model = self.model.copy()
        for joint, inertia in inertias.items():
            model.inertias[joint] = inertia
        return replace(self, model=model)


def _reduced(robot: urdf_edit.Element, joints: Sequence[str], locked: Sequence[tuple[str, float]]) -> pin.Model:
    """The model with all but ``joints`` locked, at zero unless given."""
    model = urdf_edit.build(robot)
    posture = pin.neutral(model)
    for name, value in locked:
        posture[model.joints[model.getJointId(name)].idx_q] = value
    frozen = [model.getJointId(name) for name in list(model.names)[1:] if name not in joints]
    _name_joints(model, lambda name: JOINT + name)
    left = pin.buildReducedModel(model, frozen, posture)
    _name_joints(left, lambda name: name.removeprefix(JOINT))
    return left


def _name_joints(model: pin.Model, new_name: Callable[[str], str]) -> None:
    """Rename joints: pinocchio looks for them among all frames, and a link may have the name of one."""
    for frame in model.frames:
        if frame.type != pin.FrameType.BODY:
            frame.name = new_name(frame.name)
    for number, name in enumerate(model.names):
        model.names[number] = new_name(name)


def _check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise SemiparamError(f"{name} '{value}' is unknown; expected one of {', '.join(choices)}.")


def follow(arm: Arm, frame: str, path: Array, posture: Array) -> Array:
    """Joint positions (N, n_joints) whose ``frame`` runs along ``path`` (N, 3) [m], as near as may be to ``posture``.

    Damped Newton steps J# (path - x) + (1 - J# J) (posture - q), for all instants at once. The redundancy is settled
    by the posture and not by history, so the result is a smooth function of the path and never drifts.
    """
    low, high = (limit + sign * LIMIT_MARGIN for limit, sign in zip(arm.limits, (1, -1), strict=True))
    posture = np.broadcast_to(posture, (len(path), arm.n_joints))
    position, open_rows = np.clip(posture, low, high), np.arange(len(path))
    for _ in range(ITERATIONS):
        step = _step(arm.pose(frame, position[open_rows]), path[open_rows], (posture - position)[open_rows])
        position[open_rows] = np.clip(position[open_rows] + np.clip(step, -0.2, 0.2), low, high)
        open_rows = open_rows[np.abs(step).max(axis=1) > TOLERANCE_RAD]
        if not len(open_rows):
            break
    return position


def _step(pose: Poses, path: Array, wish: Array) -> Array:
    """The damped Newton step (N, n_joints); ``wish`` is the way to the posture."""
    jacobian = pose.jacobian[:, :3]
    inner = jacobian @ jacobian.transpose(0, 2, 1) + DAMPING_M**2 * np.eye(3)
    missing = path - pose.place - np.einsum('nkj,nj->nk', jacobian, wish)
    return np.asarray(wish + np.einsum('nkj,nk->nj', jacobian, np.linalg.solve(inner, missing[:, :, None])[:, :, 0]))


def home_posture(arm: Arm) -> Array:
    """A posture with room to move, (n_joints,): the best of many random ones by manipulability, limits kept away."""
    rng = np.random.default_rng(0)
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in arm.limits)
    candidates = low + (high - low) * rng.uniform(0.25, 0.75, (400, arm.n_joints))
    jacobian = arm.pose(arm.tip, candidates).jacobian[:, :3]
    dexterity = np.sqrt(np.maximum(np.linalg.det(jacobian @ jacobian.transpose(0, 2, 1)), 0.0))
    return np.asarray(candidates[np.argmax(dexterity)])
