"""Outputs caused by a force at a link, and motion of a link: the ground that many effects stand
on."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from semiparam_ros.core.robot.arm_motion import FEW, ArmMotion, arm_motion
from semiparam_ros.core.robot.rigid_body import RigidBody, remembered
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

LINKS_APART = 0.005
MOST_LINKS = 6


def as_matrix(jacobian: Array) -> Array:
    """(6, n), also of a single joint, of which pinocchio gives a vector (6,)."""
    return jacobian.reshape(6, -1)


class FrameMotion(NamedTuple):
    """A link's frame over N samples, in the base."""

    position: Array  # (N, 3) [m]
    velocity: Array  # (N, 3) [m/s]
    turning: Array  # (N, 3) angular velocity [rad/s]
    rotation: Array  # (N, 3, 3) link to base
    force_map: Array  # (N, n, 3) outputs caused by an external unit force at the frame's origin, along base axes
    couple_map: Array  # (N, n, 3) outputs caused by an external unit couple on the link, about base axes

    def at(self, point: Array) -> FrameMotion:
        """The same of a frame beside it, at a point (3,) [m] of the link."""
        arm = self.rotation @ point
        return self._replace(position=self.position + arm, velocity=self.velocity + np.cross(self.turning, arm),
                             force_map=self.force_map + self.couple_map @ _levers(arm))


@remembered
def _felt_joints(body: RigidBody) -> frozenset[int]:
    """Joints, by their numbers in the model, that carry what the outputs feel: of efforts, those that a joint whose
    effort is an output carries, and this joint itself."""
    if body.distal is not None:
        return frozenset(range(1, body.distal.njoints))
    model, measured = body.arm, {body.arm.getJointId(name) for name in body.output_names}
    return frozenset(joint for joint in range(1, model.njoints) if measured.intersection(model.supports[joint]))


def loaded_links(body: RigidBody) -> dict[str, int]:
    """For each body that the outputs feel, the farthest of its links, and the body's number.

    These are the places where a load or an outside force can be told from another body's. None is beyond a locked
    joint: what is carried there would move with a finger.
    """
    model, felt = body.arm if body.distal is None else body.distal, _felt_joints(body)
    links: dict[int, tuple[float, str]] = {}
    for frame in model.frames:
        joint = frame.parentJoint
        if frame.type != pin.FrameType.BODY or joint not in felt or frame.name in body.held:
            continue
        reach = float(np.linalg.norm(frame.placement.translation))
        if joint not in links or reach > links[joint][0] + 1e-9:
            links[joint] = (reach, frame.name)
    return {name: joint - 1 for joint, (_, name) in sorted(links.items())}


def last_link(body: RigidBody) -> str:
    """The last of :func:`loaded_links`, where a hand is."""
    return list(loaded_links(body))[-1]


def last_links(body: RigidBody) -> list[str]:
    """The last of :func:`loaded_links` of each branch."""
    parents = set((body.arm if body.distal is None else body.distal).parents)
    return [link for link, number in loaded_links(body).items() if number + 1 not in parents]


@remembered
def observed_links(body: RigidBody) -> tuple[str, ...]:
    """Every link that the outputs feel, by name."""
    model, felt = body.arm if body.distal is None else body.distal, _felt_joints(body)
    return tuple(frame.name for frame in model.frames
                 if frame.type == pin.FrameType.BODY and frame.parentJoint in felt)


def links_beside(body: RigidBody, link: str) -> list[str]:
    """The links fixed to the same body as ``link``, itself first, that stand at clearly different places."""
    model = body.arm if body.distal is None else body.distal
    own = model.frames[_frame(model, link, body)]
    chosen = [own]
    for frame in model.frames:
        apart = [float(np.linalg.norm(frame.placement.translation - other.placement.translation)) for other in chosen]
        if frame.type == pin.FrameType.BODY and frame.parentJoint == own.parentJoint and min(apart) > LINKS_APART:
            chosen.append(frame)
    return [frame.name for frame in chosen[:MOST_LINKS]]


@remembered
def _loaded_points(body: RigidBody) -> tuple[tuple[int, ...], Array]:
    """Joints that move the places of :func:`force_maps`, and the places (P, 3) in their frames."""
    model = body.arm
    frames = [model.frames[_frame(model, link, body)] for link in loaded_links(body)]
    joints = [frame.parentJoint for frame in frames]
    points = [frame.placement.translation for frame in frames] + [model.inertias[joint].lever for joint in joints]
    return (*joints, *joints), np.array(points)


def force_maps(body: RigidBody, position: Array) -> Array:
    """(2 n_links, n, 3) outputs caused by an external unit force along base axes, at joint positions (n_joints,).

    At the origin of each of the links of :func:`loaded_links`, then at the centres of mass of what moves with each.

    A link without another one fixed to it, such as a flange, has its origin on its joint's axis.
    """
    return unit_maps(body, position, *_loaded_points(body))[0]


def unit_maps(body: RigidBody, position: Array, joints: Sequence[int], points: Array) -> tuple[Array, Array]:
    """(P, n, 3) outputs caused by external unit forces, and by unit couples, along base axes.

    :param position: (n_joints,). :param joints: (P,) that move the points. :param points: (P, 3) [m] in their frames.
    """
    model, data = body.arm, body.arm.createData()
    pin.computeJointJacobians(model, data, body.arm_vector(position))
    joints = [int(joint) for joint in joints]
    places = np.array([data.oMi[joint].act(point) for joint, point in zip(joints, points, strict=True)])
    if body.distal is not None:
        sensor = pin.updateFramePlacement(model, data, body.sensor_index)
        return _on_sensor(body, places, np.broadcast_to(sensor.rotation, (len(places), 3, 3)), sensor.translation)
    found = {joint: as_matrix(pin.getJointJacobian(model, data, joint, pin.LOCAL_WORLD_ALIGNED))[:, body.output_rows]
             for joint in set(joints)}
    motions = np.array([found[joint] for joint in joints])
    arms = places - np.array([data.oMi[joint].translation for joint in joints])
    linear, angular = motions[:, :3].swapaxes(1, 2), motions[:, 3:].swapaxes(1, 2)
    return np.cross(arms[:, None], angular) - linear, -angular


@lru_cache(maxsize=24)
def frame_motion(body: RigidBody, samples: Samples, link: str) -> FrameMotion:
    """Motion of a link and the outputs' response to a force on it. An unknown link raises SemiparamError."""
    frame = _frame(body.arm, link, body)
    arm = _arm_motion(body, samples) if len(samples) > FEW else None
    rotation, position, linear, angular = _one_by_one(body, samples, frame) if arm is None else _together(arm, frame)
    moved = body.arm_vector(samples.velocity)[:, None]
    velocity, turning = ((columns * moved).sum(axis=2) for columns in (linear, angular))
    if body.distal is None:
        force, couple = (-np.swapaxes(part[:, :, body.output_rows], 1, 2) for part in (linear, angular))
    else:
        sensor = (_one_by_one(body, samples, body.sensor_index) if arm is None
                  else _together(arm, body.sensor_index))[:2]
        force, couple = _on_sensor(body, position, *sensor)
    return FrameMotion(position, velocity, turning, rotation, force, couple)


def _one_by_one(body: RigidBody, samples: Samples, frame: int) -> tuple[Array, Array, Array, Array]:
    """Rotation, position, and Jacobians (N, 3, n) of few samples."""
    model, data, rows = body.arm, body.arm.createData(), []
    for q in body.arm_vector(samples.position):
        pin.computeJointJacobians(model, data, q)
        placement = pin.updateFramePlacement(model, data, frame)
        rows.append((placement.rotation.copy(), placement.translation.copy(),
                     as_matrix(pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED))))
    rotation, position, jacobian = (np.array(column) for column in zip(*rows, strict=True))
    return rotation, position, jacobian[:, :3], jacobian[:, 3:]


def _together(arm: ArmMotion, frame: int) -> tuple[Array, Array, Array, Array]:
    """The same of many samples."""
    rotation, position = arm.placement(frame)
    linear, angular = arm.jacobian(frame, position)
    return _by_sample(rotation), _by_sample(position), _by_sample(linear), _by_sample(angular)


def _by_sample(values: Array) -> Array:
    """Values (..., N) as (N, ...)."""
    return np.ascontiguousarray(np.moveaxis(values, -1, 0))


@lru_cache(maxsize=4)
def _arm_motion(body: RigidBody, samples: Samples) -> ArmMotion:
    return arm_motion(body.arm, body.arm_vector(samples.position).T)


def _on_sensor(body: RigidBody, position: Array, rotation: Array, sensor: Array) -> tuple[Array, Array]:
    """(N, 6, 3) what forces at positions (N, 3), and couples, do to a wrench sensor there (N, 3, 3), (N, 3)."""
    to_sensor = -body.sign * np.swapaxes(rotation, 1, 2)
    return (np.concatenate([to_sensor, to_sensor @ _levers(position - sensor)], axis=1),
            np.concatenate([np.zeros_like(to_sensor), to_sensor], axis=1))


def nearest_link(body: RigidBody, link: str, point: Array) -> tuple[str, Array]:
    """Return the link, of those beside ``link`` and not beyond a locked joint, whose origin is
    nearest to a point (3,) [m], and the point in its frame.

    :param point: in the frame of ``link``.
    """
    model = body.arm if body.distal is None else body.distal
    place = model.frames[_frame(model, link, body)].placement.act(point)
    inside = {name: model.frames[_frame(model, name, body)].placement.actInv(place)
              for name in links_beside(body, link) if name == link or name not in body.held}
    nearest = min(inside, key=lambda name: float(np.linalg.norm(inside[name])))
    return nearest, inside[nearest]


@remembered
def load_transform(body: RigidBody, link: str) -> tuple[int, Array]:
    """Number of the body that carries ``link``, and the (10, 10) map of inertial parameters from link to body, which
    is not to be written to; raises SemiparamError where the outputs feel none there."""
    model = body.arm if body.distal is None else body.distal
    if model.frames[_frame(model, link, body)].parentJoint not in _felt_joints(body):
        raise unfelt(link, body)
    return _carried_by(model, body, link)


def _carried_by(model: pin.Model, body: RigidBody, link: str) -> tuple[int, Array]:
    """The same of one of the body's models, without asking what the outputs feel."""
    frame = model.frames[_frame(model, link, body)]
    placement = frame.placement
    rotation, shift = placement.rotation, placement.translation
    return frame.parentJoint - 1, np.column_stack([_moved(unit, rotation, shift) for unit in np.eye(10)])


def load_in_arm(body: RigidBody, link: str, parameters: Array) -> Array:
    """(10 n,) what a body with inertial parameters (10,) in the frame of ``link`` adds to those of all n bodies."""
    index, transform = _carried_by(body.arm, body, link)
    added = np.zeros((body.arm.njoints - 1, 10))
    added[index] = transform @ parameters
    return added.ravel()


def load_seen_from(body: RigidBody, link: str, carrier: str) -> Array | None:
    """(10, 10) map of inertial parameters from ``carrier`` to another link of the same body; None
    where one moves against the other."""
    (index, to_body), (other, from_body) = load_transform(body, link), load_transform(body, carrier)
    return np.asarray(np.linalg.solve(to_body, from_body), dtype=float) if index == other else None


def load_in_base(body: RigidBody, link: str, parameters: Array) -> Array:
    """(p,) what a body with inertial parameters (10,) in the frame of ``link`` adds to the base parameters."""
    index, transform = load_transform(body, link)
    return np.asarray(body.basis[10 * index:10 * index + 10].T @ (transform @ parameters))


def load_regressor(body: RigidBody, samples: Samples, link: str) -> Array:
    """(N, n, 10) outputs caused by a load on ``link``: mass, first moment and inertia in the link's frame."""
    index, transform = load_transform(body, link)
    columns = slice(10 * index, 10 * index + 10)
    return np.asarray(body.full_regressors(samples)[:, :, columns] @ transform)


def _moved(parameters: Array, rotation: Array, shift: Array) -> Array:
    """Inertial parameters (m, m c, Ixx Ixy Iyy Ixz Iyz Izz) of a frame, seen from its parent."""
    mass, moment = parameters[0], rotation @ parameters[1:4]
    xx, xy, yy, xz, yz, zz = parameters[4:]
    inertia = rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ rotation.T
    outer = np.outer(shift, moment)
    second = mass * np.outer(shift, shift) + outer + outer.T
    inertia = inertia + np.trace(second) * np.eye(3) - second
    return np.array([mass, *(moment + mass * shift), inertia[0, 0], inertia[0, 1], inertia[1, 1], inertia[0, 2],
                     inertia[1, 2], inertia[2, 2]])


def _levers(arms: Array) -> Array:
    """(N, 3, 3) couples about an origin of unit forces at arms (N, 3) from it."""
    return np.swapaxes(np.cross(arms[:, None], np.eye(3)), 1, 2)


def frame_index(body: RigidBody, link: str) -> int:
    """Number of a link's frame in the arm; raises SemiparamError where there is no such link."""
    return _frame(body.arm, link, body)


def _frame(model: pin.Model, link: str, body: RigidBody) -> int:
    if not model.existFrame(link, pin.FrameType.BODY):
        raise unfelt(link, body)
    return int(model.getFrameId(link, pin.FrameType.BODY))


def unfelt(link: str, body: RigidBody) -> SemiparamError:
    """Error of a link where nothing is felt."""
    return SemiparamError(f"link '{link}' is not a link of the robot description that the outputs feel; "
                          f'expected one of {", ".join(observed_links(body))}.')
