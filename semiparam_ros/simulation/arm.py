"""The simulated arm: a pinocchio model whose force/torque sensor is a joint that does not move.

Recursive Newton-Euler gives the spatial force that each joint transmits. When the sensor's fixed joint is turned into a
joint held at zero, the force that it transmits is the measured wrench, wherever in the chain the sensor sits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation import chain, urdf_edit
from semiparam_ros.simulation.arrays import Array

CONVENTIONS = {'action': 1.0, 'reaction': -1.0}
OUTPUTS = ('wrench', 'effort')
CHANNELS = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')


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
                  convention: str = 'reaction') -> Arm:
        """Read an arm from URDF text; joints not named stay at zero.

        :param outputs: ``wrench`` at ``sensor_frame`` (a link or a fixed joint), or joint ``effort``.
        Raises SemiparamError for an unknown joint, frame, output or convention.
        """
        _check_choice('outputs', outputs, OUTPUTS)
        _check_choice('wrench_convention', convention, tuple(CONVENTIONS))
        edited = urdf_edit.single_turn(urdf_edit.parse(urdf))
        urdf_edit.check_joints(edited, joints)
        if outputs == 'effort':
            return cls(_reduced(edited, joints), tuple(joints), None, 1.0, urdf)
        if not sensor_frame:
            raise SemiparamError('sensor_frame is empty; a simulated wrench needs the link or joint of the sensor.')
        sensor_joint = urdf_edit.free_sensor_joint(edited, sensor_frame)
        model = _reduced(edited, [*joints, sensor_joint])
        arm = cls(model, tuple(joints), sensor_joint, CONVENTIONS[convention], urdf)
        if sum(model.inertias[j].mass for j in arm.distal_joints) <= 0.0:
            raise SemiparamError(f'sensor_frame {sensor_frame} carries no mass: there is no wrench to simulate.')
        return arm

    @property
    def outputs(self) -> str:
        """``wrench`` or ``effort``."""
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

    @property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper joint limits [rad], each (n_joints,)."""
        return self.model.lowerPositionLimit[self.columns], self.model.upperPositionLimit[self.columns]

    @property
    def speed_limits(self) -> Array:
        """(n_joints,) [rad/s]."""
        return np.asarray(self.model.velocityLimit[self.columns])

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
        """Index of a frame; an unknown one raises SemiparamError."""
        if not self.model.existFrame(name):
            raise SemiparamError(f"the URDF has no frame '{name}'; expected one of {', '.join(self.distal_frames())}.")
        return int(self.model.getFrameId(name))

    def configuration(self, values: Array) -> Array:
        """(N, n_joints) in the order of ``joints`` -> (N, nq) of the model, the sensor joint at zero."""
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

    def pose(self, frame: str, position: Array) -> chain.Poses:
        """Rotation, place and Jacobian of a frame along the motion, in base axes."""
        item = self.model.frames[self.frame_id(frame)]
        return chain.poses(self.model, item.parentJoint, item.placement, self.columns, position)

    def load_of_force(self, pose: chain.Poses, force: Array, position: Array, torque: Array | None = None) -> Array:
        """Change of the outputs (N, n) when a force (N, 3) [N], base axes, pushes on the body at ``pose``.

        The arm must hold against it: efforts change by -J'f. The action of the sensor on the distal bodies changes by
        the opposite wrench, moved to the sensor (only for frames distal of the sensor).
        """
        moment = np.zeros_like(force) if torque is None else torque
        if self.sensor_frame is None:
            return np.asarray(-np.einsum('nkj,nk->nj', pose.jacobian, np.hstack([force, moment])))
        sensor = self.pose(self.sensor_frame, position)
        about = moment + np.cross(pose.place - sensor.place, force)
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


def _reduced(robot: urdf_edit.Element, joints: Sequence[str]) -> pin.Model:
    """The model with all but ``joints`` locked at zero."""
    model = urdf_edit.build(robot)
    locked = [model.getJointId(name) for name in list(model.names)[1:] if name not in joints]
    return pin.buildReducedModel(model, locked, pin.neutral(model))


def _check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    if value not in choices:
        raise SemiparamError(f"{name} '{value}' is unknown; expected one of {', '.join(choices)}.")
