"""Arms and motions for the tests of the core, and two other libraries' answers to the same questions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array

ICUB_JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
ICUB_SENSOR = 'r_arm_ft_sensor'
ICUB_OWN = Path(__file__).resolve().parents[2] / 'config' / 'icub_right_arm.urdf'


def link(name: str, mass: float = 1.0, com: str = '0.02 -0.03 0.1') -> str:
    """A link whose inertia has no symmetry to hide a mistake."""
    inertia = 'ixx="0.02" ixy="0.001" ixz="-0.002" iyy="0.03" iyz="0.0015" izz="0.025"'
    return (f'<link name="{name}"><inertial><origin xyz="{com}" rpy="0.3 -0.2 0.5"/><mass value="{mass}"/>'
            f'<inertia {inertia}/></inertial><visual><geometry><mesh filename="package://nowhere/{name}.stl"/>'
            '</geometry></visual></link>')


def joint(name: str, kind: str, parent: str, child: str, xyz: str = '0 0 0.3', rpy: str = '0 0 0', axis: str = '0 0 1',
          extra: str = '') -> str:
    """A joint with the limits that URDF demands of revolute and prismatic ones."""
    limit = '<limit lower="-3" upper="3" effort="9" velocity="9"/>' if kind in ('revolute', 'prismatic') else ''
    return (f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}{extra}</joint>')


ODD_ARM = '<robot name="odd">' + ''.join([
    link('base'), link('carriage', 2.0), link('turret', 1.5), link('upper_end', 0.7, '0 0.02 0.05'),
    link('forearm', 0.9), link('finger', 0.2, '0.03 0 0.01'), link('tool', 0.3), link('thumb', 0.1),
    joint('lift', 'prismatic', 'base', 'carriage', '0.1 0 0', '0.2 0 0.1'),
    joint('turn', 'continuous', 'carriage', 'turret', '0 0.1 0.2', '0 1.2 0', '0 0.6 0.8'),
    joint('mid_link_ft', 'fixed', 'turret', 'upper_end', '0.01 0.02 0.15', '0.4 -0.3 1.1'),
    joint('elbow', 'revolute', 'upper_end', 'forearm', '0 0 0.2', '1.5 0 0', '0 1 0'),
    joint('grip', 'revolute', 'forearm', 'finger', '0 0.03 0.25', '0 0.2 0', '1 0 0'),
    joint('grip_mimic', 'revolute', 'forearm', 'thumb', '0 -0.03 0.25', axis='1 0 0',
          extra='<mimic joint="grip" multiplier="-1"/>'),
    joint('tool_joint', 'fixed', 'forearm', 'tool', '0 0 0.3', '0 0 0.7'),
]) + '</robot>'
ODD_JOINTS = ('lift', 'turn', 'elbow', 'grip')
ODD_BODY = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'effort')
TWO_ARMS = '<robot name="two">' + ''.join([
    link('base'), link('torso', 4.0), joint('waist', 'revolute', 'base', 'torso'),
    *(link(f'{side}_upper', 2.0) + link(f'{side}_fore')
      + joint(f'{side}_shoulder', 'revolute', 'torso', f'{side}_upper', f'0 {y} 0.3', axis='0 1 0')
      + joint(f'{side}_elbow', 'revolute', f'{side}_upper', f'{side}_fore', axis='0 1 0')
      for side, y in (('a', 0.2), ('b', -0.2)))]) + '</robot>'
TWO_ARMS_JOINTS = ('waist', 'a_shoulder', 'a_elbow', 'b_shoulder', 'b_elbow')


def icub(outputs: str = 'wrench', **options: object) -> RigidBody:
    """The four-joint iCub arm of config/, with its wrench sensor or with efforts."""
    sensor = ICUB_SENSOR if outputs == 'wrench' else None
    return RigidBody.from_urdf(ICUB_OWN.read_text(), ICUB_JOINTS, outputs, sensor, **options)  # type: ignore


def icub_table(path: Path) -> Samples:
    """A measured table of the iCub arm: angles, their rates and accelerations in degrees, the reaction; 29 Hz."""
    rows = np.loadtxt(path)
    motion = np.split(np.radians(rows[:, :12]), 3, axis=1)
    return Samples((np.arange(len(rows)) * 34_500_000).astype(np.int64), *motion, rows[:, 12:], 0)


def smooth_motion(n_joints: int, count: int, rate: float = 20.0, seed: int = 0, speed: float = 1.0) -> Samples:
    """Sums of sines with exact derivatives; the outputs (N, 1) are zero, for the test to fill."""
    rng = np.random.default_rng(seed)
    time = np.arange(count)[:, None, None] / rate
    frequency = speed * rng.uniform(0.5, 5.0, (1, n_joints, 3))
    phase, size = rng.uniform(0, 2 * np.pi, (1, n_joints, 3)), rng.uniform(0.1, 0.4, (1, n_joints, 3))
    sine, cosine = np.sin(frequency * time + phase), np.cos(frequency * time + phase)
    return Samples((np.arange(count) * round(1e9 / rate)).astype(np.int64), (size * sine).sum(2),
                   (size * frequency * cosine).sum(2), -(size * frequency**2 * sine).sum(2), np.zeros((count, 1)), 0)


def noisy(outputs: Array, share: float = 0.01, seed: int = 0) -> Array:
    """Outputs (N, n) with white noise, a share of the deviation of each."""
    white = np.random.default_rng(seed).standard_normal(outputs.shape)
    return np.asarray(outputs + share * outputs.std(axis=0) * white)


def as_recorded(body: RigidBody, motion: Samples, seed: int = 0, noise: float = 0.01) -> Samples:
    """The motion as encoders and tachometers show it, without accelerations, and the outputs of an arm a little heavier
    than its description, with a share of noise."""
    rng = np.random.default_rng(seed)
    exact = body.regressors(motion) @ (1.15 * body.base_parameters)
    return replace(motion, position=motion.position + 5e-5 * rng.standard_normal(motion.position.shape),
                   velocity=motion.velocity + 2e-3 * rng.standard_normal(motion.velocity.shape),
                   acceleration=np.zeros_like(motion.acceleration),
                   outputs=exact + noise * exact.std(axis=0) * rng.standard_normal(exact.shape))


def pinocchio_link_wrench(urdf: str, joints: Sequence[str], sensor_joint: str, locked: Mapping[str, float], q: Array,
                          dq: Array, ddq: Array) -> Array:
    """(6,) action on what is after ``sensor_joint``, in its frame: rnea with a floating joint put where it is fixed."""
    opened = urdf.replace(f'name="{sensor_joint}" type="fixed"', f'name="{sensor_joint}" type="floating"')
    assert opened != urdf
    model = pin.buildModelFromXML(opened)
    tau = pin.rnea(model, model.createData(), *_model_vectors(model, joints, locked, q, dq, ddq))
    start = model.joints[model.getJointId(sensor_joint)].idx_v
    return np.asarray(tau[start:start + 6])


def pinocchio_efforts(urdf: str, joints: Sequence[str], locked: Mapping[str, float], q: Array, dq: Array,
                      ddq: Array, gravity: Sequence[float] = (0.0, 0.0, -9.81)) -> Array:
    """(n_joints,) efforts by rnea on the whole robot."""
    model = pin.buildModelFromXML(urdf)
    model.gravity.linear = np.array(gravity)
    tau = pin.rnea(model, model.createData(), *_model_vectors(model, joints, locked, q, dq, ddq))
    return np.array([tau[model.joints[model.getJointId(name)].idx_v] for name in joints])


def _model_vectors(model: pin.Model, joints: Sequence[str], locked: Mapping[str, float], q: Array, dq: Array,
                   ddq: Array) -> tuple[Array, Array, Array]:
    position, velocity, acceleration = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
    for name, angle in [*locked.items(), *zip(joints, q, strict=True)]:
        at = model.joints[model.getJointId(name)]
        unlimited = at.nq == 2  # a continuous joint is stored as cosine and sine
        position[at.idx_q:at.idx_q + at.nq] = [np.cos(angle), np.sin(angle)] if unlimited else [angle]
    for name, speed, change in zip(joints, dq, ddq, strict=True):
        index = model.joints[model.getJointId(name)].idx_v
        velocity[index], acceleration[index] = speed, change
    return position, velocity, acceleration


def idyntree_wrench_and_efforts(urdf: str, joints: Sequence[str], link_name: str, locked: Mapping[str, float],
                                q: Array, dq: Array, ddq: Array) -> tuple[Array, Array]:
    """(6,) action of the parent on ``link_name`` in that link's frame, and the efforts of the joints, by iDynTree."""
    import idyntree.bindings as idyn

    loader = idyn.ModelLoader()
    assert loader.loadModelFromString(urdf)
    model, kinematics = loader.model(), idyn.KinDynComputations()
    assert kinematics.loadRobotModel(model)
    kinematics.setFrameVelocityRepresentation(idyn.BODY_FIXED_REPRESENTATION)
    where = {name: model.getJoint(model.getJointIndex(name)).getDOFsOffset() for name in (*joints, *locked)}
    position, velocity, acceleration = np.zeros((3, model.getNrOfDOFs()))
    for name, angle in [*locked.items(), *zip(joints, q, strict=True)]:
        position[where[name]] = angle
    for name, speed, change in zip(joints, dq, ddq, strict=True):
        velocity[where[name]], acceleration[where[name]] = speed, change
    # without an inertia the root is no link to iDynTree, which then stands on the next one
    still = pin.buildModelFromXML(urdf)
    at_rest = still.createData()
    pin.framesForwardKinematics(still, at_rest, pin.neutral(still))
    stand = at_rest.oMf[still.getFrameId(kinematics.getFloatingBase())].homogeneous
    assert kinematics.setRobotState(stand, position, np.zeros(6), velocity, np.array([0.0, 0.0, -9.81]))
    external, internal = idyn.LinkWrenches(model), idyn.LinkWrenches(model)
    external.zero()
    efforts, base = idyn.FreeFloatingGeneralizedTorques(model), idyn.Vector6()
    base.zero()
    change_vector = idyn.VectorDynSize(model.getNrOfDOFs())
    for index, value in enumerate(acceleration):
        change_vector.setVal(index, float(value))
    assert kinematics.inverseDynamicsWithInternalJointForceTorques(base, change_vector, external, efforts, internal)
    wrench = internal(model.getLinkIndex(link_name)).asVector().toNumPy()
    return np.array(wrench), np.array([efforts.jointTorques().getVal(where[name]) for name in joints])
