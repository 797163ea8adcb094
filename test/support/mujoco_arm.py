"""Recordings by MuJoCo, which shares no code with the package: a controlled arm, its sensors, and hidden causes."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples

STEP_S, RATE_HZ = 1e-3, 100
STIFFNESS, DAMPING = 144.0, 24.0
ENCODER, TACHO, NOISE = 5e-5, 2e-3, 0.01
GRAVITY = 9.81


class Robot(NamedTuple):
    """A robot description, its moving joints about a posture, and the link behind a wrench sensor."""

    urdf: str
    joints: Sequence[str]
    home: Sequence[float]
    sensor_joint: str | None = None
    sensor_link: str | None = None

    @property
    def body(self) -> RigidBody:
        """The package's model of it."""
        return RigidBody.from_urdf(self.urdf, self.joints, 'wrench' if self.sensor_joint else 'effort',
                                   self.sensor_joint)


def recording(robot: Robot, seed: int = 0, prepare: Callable[[mujoco.MjSpec], None] = lambda spec: None,
              act: Callable[[mujoco.MjModel, mujoco.MjData], None] = lambda model, data: None,
              zeros: Sequence[float] = (), seconds: float = 30.0) -> Samples:
    """What encoders and sensors report while computed torques follow sums of sines.

    :param prepare: changes the robot before it is built. :param act: called before every step, for outside forces.
    :param zeros: [rad] what the encoders read where the joints are at zero.
    """
    model = built(robot, prepare)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    dofs = np.array([model.joint(name).dofadr[0] for name in robot.joints])
    own = np.ix_(dofs, dofs)
    wanted = _path(len(robot.joints), rng, seconds) + np.array(robot.home)
    speed = np.gradient(wanted, STEP_S, axis=0)
    change = np.gradient(speed, STEP_S, axis=0)
    data.qpos[dofs], data.qvel[dofs] = wanted[0], speed[0]
    mujoco.mj_forward(model, data)
    inertia, rows = np.zeros((model.nv, model.nv)), []
    for q, dq, ddq in zip(wanted, speed, change, strict=True):
        act(model, data)
        mujoco.mj_step1(model, data)
        mujoco.mj_fullM(model, data, inertia)
        position, velocity = data.qpos[dofs], data.qvel[dofs]
        aim = ddq + STIFFNESS * (q - position) + DAMPING * (dq - velocity)
        efforts = inertia[own] @ aim + data.qfrc_bias[dofs]
        data.qfrc_applied[dofs] = efforts
        mujoco.mj_step2(model, data)
        rows.append((position, velocity, data.sensordata.copy() if robot.sensor_joint else efforts))
    position, velocity, outputs = (np.array(part)[::round(1.0 / STEP_S / RATE_HZ)] for part in zip(*rows, strict=True))
    position = position + ENCODER * rng.standard_normal(position.shape) + (np.array(zeros) if len(zeros) else 0.0)
    velocity = velocity + TACHO * rng.standard_normal(velocity.shape)
    outputs = outputs + NOISE * outputs.std(axis=0) * rng.standard_normal(outputs.shape)
    stamps = np.arange(len(position)) * (10**9 // RATE_HZ)
    return Samples(stamps, position, velocity, np.zeros_like(velocity), outputs, 0)


def built(robot: Robot, prepare: Callable[[mujoco.MjSpec], None]) -> mujoco.MjModel:
    """The model in MuJoCo: the description without shapes, limits and friction, and what ``prepare`` changes."""
    tree = ElementTree.fromstring(robot.urdf)
    for link in tree.findall('link'):
        for part in [*link.findall('visual'), *link.findall('collision')]:
            link.remove(part)
    for part in [part for part in tree if part.tag not in ('link', 'joint')]:
        tree.remove(part)
    for joint in tree.findall('joint'):
        if joint.get('name') not in robot.joints:
            joint.set('type', 'fixed')
        for part in [part for part in joint if part.tag in ('dynamics', 'safety_controller', 'mimic')]:
            joint.remove(part)
    options = ElementTree.SubElement(ElementTree.SubElement(tree, 'mujoco'), 'compiler')
    options.attrib |= {'fusestatic': 'false', 'balanceinertia': 'true', 'boundmass': '1e-9', 'boundinertia': '1e-12'}
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(tree, encoding='unicode'))
    spec.option.timestep, spec.option.integrator = STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    for joint in spec.joints:
        joint.limited = False
    if robot.sensor_link:
        spec.body(robot.sensor_link).add_site(name='sensor')
        for kind in (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE):
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname='sensor')
    prepare(spec)
    return spec.compile()


def _path(count: int, rng: np.random.Generator, seconds: float) -> np.ndarray:
    time = np.arange(round(seconds / STEP_S))[:, None] * STEP_S
    return sum(rng.uniform(0.07, 0.25, count) * np.sin(2 * np.pi * rng.uniform(0.04, 0.5, count) * time
                                                        + rng.uniform(0, 2 * np.pi, count)) for _ in range(4))
