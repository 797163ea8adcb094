"""The rigid-body regressor psi(x): outputs linear in the inertial parameters of the links.

A wrench sensor sees the bodies that hang on it. They hang on the arm by a free joint at the sensor, which stays at
zero: its efforts are the wrench, its six rows of the joint-torque regressor are ours (Atkeson et al. 1986). Joint
efforts take the regressor of the arm. Columns are reduced to the identifiable combinations, an orthonormal
basis of the row space: a prior gamma^2 I on all inertial parameters stays gamma^2 I on the base parameters.

A mimic joint is a joint like any other: it stays where ``locked`` puts it, and ``remark`` says so where its leader does
not.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from functools import cached_property, lru_cache, wraps
from math import ceil
from typing import Concatenate, ParamSpec, TypeVar, cast

import numpy as np
import pinocchio as pin
from scipy.linalg import null_space
from scipy.sparse import csc_array

from semiparam_ros.core.compiled import Integers, Matrix, Part, Vector, compiled
from semiparam_ros.core.robot import urdf as urdf_tree
from semiparam_ros.core.robot.arm_motion import FEW, effort_regressors
from semiparam_ros.core.robot.joint_units import sliding
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.errors import SemiparamError

GRAVITY = np.array([0.0, 0.0, -9.81])
SENSOR, ROOT = urdf_tree.SENSOR, urdf_tree.ROOT
JOINT = 'joint '

OUTPUTS = ('wrench', 'effort')
WRENCH_NAMES = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')
CONVENTIONS = {'action': 1.0, 'reaction': -1.0}
RANK_TOLERANCE = 1e-8
INDEPENDENT = 1e-6
LEAST_MASS = 1e-2
"""Share of the largest mass from which on a body's inertia about its centre keeps its digits."""
MOST_PROBES, LEAST_ROWS, ROWS_EACH = 400, 5000, 4
"""Random states from which it is seen which parameters can be identified; as many as give so many
rows, and so many for each parameter. More, of an arm of 60 joints, are seconds and gigabytes."""
ROUNDING = 1e-12
P = ParamSpec('P')
T = TypeVar('T')


def build(robot: ElementTree.Element, root: pin.JointModel | None = None) -> pin.Model:
    """The model of a whole tree, on a fixed base unless ``root`` is the joint that carries it."""
    text = ElementTree.tostring(robot, encoding='unicode')
    try:
        model = pin.buildModelFromXML(text) if root is None else pin.buildModelFromXML(text, root, ROOT)
    except Exception as error:
        reason = ' '.join(str(error).split())
        raise SemiparamError(f'the robot description cannot be read as a robot: {reason}') from error
    model.gravity.linear = GRAVITY
    for frame in model.frames:  # a link may have the name of a fixed joint, and frames are looked for by name
        if frame.type == pin.FrameType.FIXED_JOINT:
            frame.name = JOINT + frame.name
    return model


def check_locked(joints: Sequence[str], locked: Mapping[str, float]) -> None:
    """Raise SemiparamError when a joint is to move and to be locked at once."""
    for name in joints:
        if name in locked:
            raise SemiparamError(f"joint '{name}' is named both among the moving and the locked joints.")


def hung(arm: pin.Model, distal: pin.Model) -> pin.Model:
    """The distal bodies on the arm, by a free joint where the sensor is; their joints stand after all of the arm's."""
    model, sensor, before = arm.copy(), arm.frames[arm.getFrameId(SENSOR)], arm.njoints - 1
    for number in range(1, distal.njoints):
        parent, placement = distal.parents[number] + before, distal.jointPlacements[number]
        if number == 1:
            parent, placement = sensor.parentJoint, sensor.placement * placement
        joint = model.addJoint(parent, distal.joints[number], placement, f'distal {distal.names[number]}')
        model.appendBodyToJoint(joint, distal.inertias[number], pin.SE3.Identity())
    return model


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
    posture, apart = _posture(model, locked), _joints_apart(model)
    left = pin.buildReducedModel(apart, frozen, posture)
    for number, name in enumerate(left.names):
        left.names[number] = name.removeprefix(JOINT)
    return left


def held_links(model: pin.Model, joints: Collection[str]) -> frozenset[str]:
    """Links of a whole tree that hang on a joint which is none of those named: on the robot they may move."""
    moving = {urdf_tree.UNIVERSE, ROOT, *joints}
    return frozenset(frame.name for frame in model.frames
                     if frame.type == pin.FrameType.BODY and model.names[frame.parentJoint] not in moving)


def _joints_apart(model: pin.Model) -> pin.Model:
    """The model with names of joints that no link has: a URDF may name both alike, but pinocchio looks for either."""
    apart = model.copy()
    for frame in apart.frames:
        if frame.type == pin.FrameType.JOINT:
            frame.name = JOINT + frame.name
    for number in range(1, apart.njoints):
        apart.names[number] = JOINT + apart.names[number]
    return apart


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


class RigidBody:
    """Regressor of ``outputs`` for the named joints of one arm.

    Build it with :meth:`from_urdf`. Inputs are arrays over the named joints in their order, in rad, rad/s and rad/s^2
    (m for prismatic ones).
    """

    def __init__(self, arm: pin.Model, distal: pin.Model | None, frame: str | None, joints: Sequence[str],
                 sign: float, output_joints: Sequence[str] = (), held: Collection[str] = (),
                 remark: str = '') -> None:
        self.joints = tuple(joints)
        self.held = frozenset(held)
        """Links beyond a locked joint: here they are fixed to the body before it."""
        self.remark = remark
        """Sentences about joints that are held where they may not be; '' without any."""
        self.output_index: Indices = np.array([index for index, name in enumerate(joints) if name in output_joints],
                                              dtype=np.int64)
        """(n,) numbers of the joints whose efforts are the outputs; of a wrench (0,)."""
        self.outputs = 'effort' if distal is None else 'wrench'
        self.sensor_frame = frame
        self.sign = sign
        self.arm = arm
        self.distal = distal
        self._make_data()
        self.arm_columns = np.array([arm.joints[arm.getJointId(name)].idx_v for name in joints])
        self._arm_order = self.arm_columns.argsort()
        self._in_order = bool((np.diff(self._arm_order) > 0).all())
        self._all_rows = self._in_order and len(self.output_index) == len(joints)
        if distal is not None:
            self.sensor_index = arm.getFrameId(SENSOR)
            shared = [arm.joints[arm.getJointId(name)].idx_v for name in list(distal.names)[2:] if name in joints]
            self._distal_from = _as_slice(shared)
        self.basis = self._identifiable_basis()
        self._unfelt = null_space(self.basis.T)
        self._reduce_by(self.basis)

    def __getstate__(self) -> dict[str, object]:
        """All but pinocchio's scratch memory, which is nine tenths of it and takes milliseconds to write as text, and
        what is :func:`remembered`."""
        return {name: value for name, value in vars(self).items()
                if not name.endswith('_data') and name != '_remembered'}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._make_data()

    def _make_data(self) -> None:
        self._remembered: dict[Hashable, object] = {}
        self._arm_data = self.arm.createData()
        if self.distal is None:
            return
        whole = self._whole()
        self._whole_data = whole, whole.createData()
        self._motion_data = pin.neutral(whole), np.zeros(whole.nv), np.zeros(whole.nv)

    def _whole(self) -> pin.Model:
        """A model whose efforts are the outputs."""
        return self.arm.copy() if self.distal is None else hung(self.arm, self.distal)

    @classmethod
    def from_urdf(cls, urdf: str, joints: Sequence[str], outputs: str = 'wrench', sensor_frame: str | None = None,
                  convention: str = 'action', locked: Mapping[str, float] | None = None,
                  output_joints: Sequence[str] = ()) -> RigidBody:
        """Read an arm from URDF text.

        :param joints: moving joints, in the order of the inputs; all others stay at ``locked`` [rad] (0 unless given).
        :param outputs: ``wrench`` at ``sensor_frame`` or joint ``effort``.
        :param convention: the wrench is the ``action`` on the distal bodies, or their ``reaction`` on the sensor.
        :param output_joints: of ``joints``, those whose efforts are the outputs; all of them unless given.

        Raises SemiparamError for an unknown joint, frame, output or convention.
        """
        if outputs not in OUTPUTS:
            raise SemiparamError(f"outputs '{outputs}' is unknown; expected one of {', '.join(OUTPUTS)}.")
        if convention not in CONVENTIONS:
            raise SemiparamError(f"wrench_convention '{convention}' is unknown; expected action or reaction.")
        robot = urdf_tree.parse(urdf)
        urdf_tree.check_joints(robot, joints)
        locked = dict(locked or {})
        check_locked(joints, locked)
        whole, remark = build(robot), urdf_tree.remark(robot, joints, locked)
        arm = reduced(whole, joints, locked)
        if outputs == 'effort':
            urdf_tree.check_output_joints(joints, output_joints)
            return cls(arm, None, None, joints, 1.0, output_joints or joints, held_links(whole, joints), remark)
        if not sensor_frame:
            raise SemiparamError('sensor_frame is empty; a wrench needs the link or joint that carries the sensor.')
        link = urdf_tree.sensor_link(robot, sensor_frame)
        mark_sensor(arm, whole, joints, locked, link)
        subtree = ElementTree.fromstring(urdf_tree.distal_subtree(robot, link))
        inside = set(urdf_tree.joint_types(subtree))
        hanging = build(subtree, pin.JointModelFreeFlyer())
        distal = reduced(hanging, inside & set(joints),
                         {name: value for name, value in locked.items() if name in inside}, keep_root=True)
        return cls(arm, distal, sensor_frame, joints, CONVENTIONS[convention], held=held_links(hanging, joints),
                   remark=remark)

    @property
    def n_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joints)

    @property
    def n_outputs(self) -> int:
        """Six for a wrench, one for each joint whose effort is an output."""
        return 6 if self.outputs == 'wrench' else len(self.output_index)

    @property
    def n_parameters(self) -> int:
        """Number p of identifiable base parameters."""
        return int(self.basis.shape[1])

    @cached_property
    def output_names(self) -> tuple[str, ...]:
        """Channel labels: fx..tz, or the joints whose efforts are the outputs, in the order of ``joints``."""
        return WRENCH_NAMES if self.outputs == 'wrench' else tuple(self.joints[index] for index in self.output_index)

    @property
    def output_units(self) -> tuple[str, ...]:
        """Unit of each channel."""
        if self.outputs == 'wrench':
            return ('N',) * 3 + ('N m',) * 3
        return tuple(self.joint_unit(joint, 'N m') for joint in self.output_names)

    @cached_property
    def beyond_sensor(self) -> Indices:
        """Numbers of the joints that move what hangs on a wrench sensor, but not the sensor."""
        beyond = () if self.distal is None else tuple(self.distal.names)
        return np.array([index for index, name in enumerate(self.joints) if name in beyond], dtype=np.int64)

    @cached_property
    def prismatic(self) -> frozenset[str]:
        """Names of the joints that slide."""
        models = ((joint, self.arm.joints[self.arm.getJointId(joint)]) for joint in self.joints)
        return frozenset(joint for joint, model in models if model.shortname().startswith('JointModelP'))

    def joint_unit(self, joint: str | None, unit: str) -> str:
        """Unit of a joint's quantity, from that of a joint that turns: m for rad, N for N m where it slides."""
        return sliding(unit) if joint in self.prismatic else unit

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies whose ten inertial parameters are the columns of :meth:`full_regressor`."""
        model = self.arm if self.distal is None else self.distal
        names = list(model.names)[1:]
        return tuple(names) if self.distal is None else (str(self.sensor_frame), *names[1:])

    @property
    def effort_joints(self) -> tuple[str, ...]:
        """Joints whose efforts follow from the outputs: all of them from a wrench."""
        return self.joints if self.outputs == 'wrench' else self.output_names

    @cached_property
    def effort_limits(self) -> Array:
        """Largest efforts [N m] of the ``effort_joints`` by the URDF; infinite where it names none above 0."""
        columns = self.arm_columns if self.outputs == 'wrench' else self.output_rows
        limits = np.asarray(self.arm.effortLimit)[columns]
        return np.where(limits < float(urdf_tree.NO_LIMIT), limits, np.inf)

    @cached_property
    def inertial_parameters(self) -> Array:
        """(10 n_bodies,) m, m c, and inertia about the body's origin, as the URDF gives them."""
        model = self.arm if self.distal is None else self.distal
        return np.concatenate([inertia.toDynamicParameters() for inertia in list(model.inertias)[1:]])

    @property
    def base_parameters(self) -> Array:
        """(p,) the URDF's inertial parameters in the identifiable basis."""
        return np.asarray(self.basis.T @ self.inertial_parameters)

    def _reduce_by(self, from_base: Array) -> None:
        self._from_base = from_base
        # Few: a base parameter combines those of a body or two.
        by_columns = csc_array(self.sign * from_base)
        self._to_outputs = (by_columns.data, by_columns.indices.astype(np.int64), by_columns.indptr.astype(np.int64))

    def regressor(self, position: Array, velocity: Array, acceleration: Array, out: Array | None = None) -> Array:
        """(n, p) matrix psi with outputs = psi @ base_parameters; in the first columns of ``out`` where it is given."""
        full = self.rows(self.arm_vector(position), self.arm_vector(velocity), self.arm_vector(acceleration))
        psi = np.empty((self.n_outputs, self.n_parameters)) if out is None else out
        _reduce(full, *self._to_outputs, psi)
        return psi

    def outputs_at(self, position: Array, velocity: Array, acceleration: Array, parameters: Array) -> Array:
        """(n,) ``regressor(...) @ parameters`` of one state for base parameters (p,)."""
        return self.full_regressor(position, velocity, acceleration) @ (self._from_base @ parameters)

    def regressors(self, samples: Samples) -> Array:
        """(N, n, p) one regressor for each sample, to read alone: the latest two are remembered."""
        return _regressors(self, samples)

    def outputs_of(self, samples: Samples, parameters: Array) -> Array:
        """(N, n) ``regressors(samples) @ parameters`` for base parameters (p,), several times as fast.

        Recursive Newton-Euler (Featherstone 2008) over all samples at once. Base parameters need not be bodies:
        masses may be zero, which no inertia of pinocchio can have. So masses are spread over the bodies as far as
        the outputs do not feel it; where that is not enough, a ballast is put on every body, and its part is taken off
        again.
        """
        inertial = self._from_base @ parameters
        size = 1.0 + float(np.abs(inertial[0::10]).max())
        inertial = inertial + self._unfelt @ np.linalg.lstsq(self._unfelt[0::10], size - inertial[0::10], rcond=1e-6)[0]
        if np.abs(inertial[0::10]).min() > LEAST_MASS * size:
            return self.sign * self._efforts(samples, inertial)
        ballast = np.zeros_like(inertial)
        ballast[0::10] = 1.0 + 2.0 * np.abs(inertial[0::10]).max()
        return self.sign * (self._efforts(samples, inertial + ballast) - self._efforts(samples, ballast))

    def _efforts(self, samples: Samples, inertial: Array) -> Array:
        """(N, n) outputs of bodies with these inertial parameters (10 n_bodies,), before the sign."""
        model, bodies = self._whole(), inertial.reshape(-1, 10)
        for joint, parameters in enumerate(bodies, start=model.njoints - len(bodies)):
            model.inertias[joint] = pin.Inertia.FromDynamicParameters(parameters)
        still = np.zeros((6, len(samples)))
        ahead = np.vstack([still, np.ones((1, len(samples)))])  # a quaternion of no rotation
        motion = self._whole_motion(samples, ahead, still, still)
        efforts = np.zeros((model.nv, len(samples)), order='F')
        pin.rneaInParallel(1, pin.ModelPool(model, 1), *(np.asfortranarray(values) for values in motion), efforts)
        return np.asarray(efforts[self.output_rows].T)

    @property
    def output_rows(self) -> Indices:
        """(n,) efforts of :meth:`_whole` that are the outputs."""
        return self.arm_columns[self.output_index] if self.distal is None else np.arange(self.arm.nv, self.arm.nv + 6)

    def _whole_motion(self, samples: Samples, *at_sensor: Array) -> list[Array]:
        """Positions, velocities and accelerations (.., N) of :meth:`_whole`, with those (.., N) of the free joint."""
        motion = [self.arm_vector(values).T for values in (samples.position, samples.velocity, samples.acceleration)]
        if self.distal is None:
            return motion
        return [np.vstack([values, rest, values[self._distal_from]])
                for values, rest in zip(motion, at_sensor, strict=True)]

    def full_regressors(self, samples: Samples) -> Array:
        """(N, n, 10 n_bodies) before the reduction to base parameters; the latest one is remembered."""
        return _full_regressors(self, samples)

    def _together(self, samples: Samples) -> Array:
        """The same as (n, 10 n_bodies, N), of many samples."""
        still = np.zeros((6, len(samples)))
        travel, velocity, acceleration = self._whole_motion(samples, still, still, still)
        first = 1 if self.distal is None else self.arm.njoints
        rows = effort_regressors(self._whole(), travel, velocity, acceleration, self.output_rows.tolist(), first)
        return rows if self.sign == 1.0 else self.sign * rows

    def full_regressor(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """(n, 10 n_bodies) matrix before the reduction to base parameters."""
        return self.sign * self.rows(self.arm_vector(position), self.arm_vector(velocity),
                                      self.arm_vector(acceleration))

    def rows(self, q: Array, dq: Array, ddq: Array) -> Array:
        """(n, 10 n_bodies) regressor of the action at vectors of the model, see :meth:`arm_vector`."""
        return self._effort_rows(q, dq, ddq) if self.distal is None else self._sensor_rows(q, dq, ddq)

    def _effort_rows(self, q: Array, dq: Array, ddq: Array) -> Array:
        full = pin.computeJointTorqueRegressor(self.arm, self._arm_data, q, dq, ddq)
        if full.ndim == 1:  # of one joint
            full = full[None]
        return full if self._all_rows else np.asarray(full[self.output_rows])

    def _sensor_rows(self, q: Array, dq: Array, ddq: Array) -> Array:
        (whole, data), joints, take = self._whole_data, self.arm.nv, self._distal_from
        place, speed, gain = self._motion_data
        place[:joints], place[joints + 7:] = q, q[take]
        speed[:joints], speed[joints + 6:] = dq, dq[take]
        gain[:joints], gain[joints + 6:] = ddq, ddq[take]
        full = pin.computeJointTorqueRegressor(whole, data, place, speed, gain)
        return np.asarray(full[joints:joints + 6, 10 * (self.arm.njoints - 1):])

    def with_gravity(self, gravity: Array) -> RigidBody:
        """The same body and base parameters under another gravity (3,) [m/s^2], in the base's axes.

        Where the first axis stands upright, a tilt shows masses that the base parameters do not hold: these follow the
        robot description, in proportion to the base parameters.
        """
        return _with_gravity(self, tuple(np.asarray(gravity, dtype=float).tolist()))

    def arm_vector(self, values: Array) -> Array:
        """Values (..., n_joints) of the named joints in the order of the model."""
        return values if self._in_order else values.take(self._arm_order, -1)

    def _identifiable_basis(self) -> Array:
        rng = np.random.default_rng(0)
        wanted = max(LEAST_ROWS, ROWS_EACH * len(self.inertial_parameters)) / self.n_outputs
        shape = min(MOST_PROBES, ceil(wanted)), self.n_joints
        probes = (rng.uniform(-np.pi, np.pi, shape), rng.normal(0, 2, shape),
                  rng.normal(0, 5, shape))
        stacked = np.vstack([self.full_regressor(*row) for row in zip(*probes, strict=True)])
        scale = 1.0 / np.sqrt(len(stacked))
        _, singular, directions = np.linalg.svd(stacked * scale, full_matrices=False)
        rank = int(np.sum(singular > RANK_TOLERANCE * singular[0]))
        return _canonical(directions[:rank].T)


def remembered(function: Callable[Concatenate[RigidBody, P], T]) -> Callable[Concatenate[RigidBody, P], T]:
    """The function of a body and few names, each result kept with the body: it goes when the body goes, while an
    ``lru_cache`` would keep the robots of models that were replaced long ago."""
    @wraps(function)
    def result(body: RigidBody, /, *names: P.args, **named: P.kwargs) -> T:
        memory, key = body._remembered, (function, *names, *named.items())
        if key not in memory:
            memory[key] = function(body, *names, **named)
        return cast(T, memory[key])
    return result


def _as_slice(indices: Sequence[int]) -> slice | Indices:
    """The same elements of an array, without a copy where they follow one another."""
    first = indices[0] if len(indices) else 0
    consecutive = list(indices) == list(range(first, first + len(indices)))
    return slice(first, first + len(indices)) if consecutive else np.array(indices)


def _canonical(basis: Array) -> Array:
    """The orthonormal basis (q, p) of the same span that does not depend on the machine or on the probes.

    The span's projector is unique, and so is Gram-Schmidt on its columns in their order; the singular vectors are
    not, and coefficients written to a file on one machine would mean other parameters on the next.
    """
    chosen = np.zeros((len(basis), 0))
    for column in basis @ basis.T:
        rest = column - chosen @ (chosen.T @ column)
        rest -= chosen @ (chosen.T @ rest)  # once more, for orthogonality to the last digit
        if np.linalg.norm(rest) > INDEPENDENT:
            chosen = np.column_stack([chosen, rest / np.linalg.norm(rest)])
    chosen = chosen if chosen.shape == basis.shape else basis
    return np.ascontiguousarray(np.where(np.abs(chosen) > ROUNDING, chosen, 0.0))


@compiled
def _reduce(full: Part, entries: Vector, rows: Integers, starts: Integers, psi: Matrix) -> None:
    """Product of full and a sparse matrix, into the first columns of psi; the matrix by its entries, their rows, and
    where each of its columns starts among them."""
    for j in range(len(starts) - 1):
        psi[:, j] = 0.0
        for entry in range(starts[j], starts[j + 1]):
            row, value = rows[entry], entries[entry]
            for k in range(len(full)):
                psi[k, j] += full[k, row] * value


@lru_cache(maxsize=8)
def _with_gravity(body: RigidBody, gravity: tuple[float, ...]) -> RigidBody:
    """The latest ones are remembered: a tilt that is declared asks for the same with every sample, and with each of two
    models' tilts a turn of the base asks for two more (``small_turns``)."""
    described = body.base_parameters
    hidden = body.inertial_parameters - body.basis @ described
    arm = body.arm.copy()
    arm.gravity.linear = np.array(gravity)
    other = RigidBody.__new__(RigidBody)
    other.__setstate__({**body.__getstate__(), 'arm': arm, '_unfelt': body._unfelt[:, :0]})
    other._reduce_by(body.basis + np.outer(hidden, described) / max(float(described @ described), 1e-12))
    return other


@lru_cache(maxsize=2)
def _regressors(body: RigidBody, samples: Samples) -> Array:
    full = np.moveaxis(body.full_regressors(samples), 0, 2)
    reduced = np.moveaxis(body._from_base.T @ full, 2, 0)
    reduced.flags.writeable = False
    return reduced


@lru_cache(maxsize=1)
def _full_regressors(body: RigidBody, samples: Samples) -> Array:
    if samples.position.shape[1] != body.n_joints:
        raise SemiparamError(f'the samples hold {samples.position.shape[1]} joints; the robot description is used with '
                             f'{body.n_joints} joints: {", ".join(body.joints)}.')
    if len(samples) > FEW:
        return np.moveaxis(body._together(samples), 2, 0)
    motion = (body.arm_vector(values) for values in (samples.position, samples.velocity, samples.acceleration))
    full = np.empty((len(samples), body.n_outputs, len(body.basis)))
    for index, (q, dq, ddq) in enumerate(zip(*motion, strict=True)):
        full[index] = body.rows(q, dq, ddq)
    return np.asarray(full if body.sign == 1.0 else body.sign * full)
