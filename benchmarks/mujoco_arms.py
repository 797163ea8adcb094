"""Diagnoses of simulated arms that resemble measured ones, beside the plain least-squares model.

``python benchmarks/mujoco_arms.py ROBOTS``: ROBOTS is the folder ``robots`` of example-robot-data (on PyPI, package
example-robot-data). MuJoCo moves the arms: true masses that differ from the description's, friction and rotors at
every joint, motion with rests and stops, velocities filtered as drivers do, coloured noise, and in some settings a
further cause.
"""

from __future__ import annotations

import argparse
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from scipy.signal import butter, lfilter, lfilter_zi

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from measured_arms import Case, compared, report
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from support.mujoco_arm import STEP_S, Robot, built

STIFFNESS, DAMPING = 100.0, 20.0
ENCODER = 2e-5
TURN_SPEED = 0.01
INERTIA = ('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz')
STRIBECK_SPEED, SOFT_SPEED = 0.1, 0.03
RIGID_FRICTION = 2.0 * STEP_S, 1.0
"""Time constant and damping ratio of MuJoCo's friction constraint. Its usual 20 ms makes the dry friction of every
joint turn over 9 ms before the joint does, which no gear does and which looks like efforts that come early."""


@dataclass(frozen=True)
class Setting:
    """One simulated robot and how it is moved and recorded.

    ``friction``: dry [N m] at each joint; viscous follows. ``stiffness``: of a cable along each joint [N m/rad], slack
    at home. ``gains``: by how much of itself each effort is read too large. ``rest_s``: the arm stops for so long after
    a third of the motion and after two thirds.

    ``masses``: true over described, smallest and largest. ``encoder``: resolution [rad, m]; velocities are then its
    filtered differences. ``effort_step``: resolution of efforts, over their standard deviation. ``stribeck``: by how
    much of itself dry friction is larger near rest. ``rubbing``: dry friction over effort. ``mounted``: roll and pitch
    [rad] of the base. ``heavier``: the whole robot, described too. ``reach``: size of each joint's motion.
    """

    name: str
    urdf: str
    joints: tuple[str, ...]
    home: tuple[float, ...]
    friction: tuple[float, ...]
    motion: str = 'sines'
    rate_hz: int = 200
    seconds: float = 60.0
    viscous_share: float = 0.5
    armature: float = 0.05
    velocity_filter_hz: float = 0.0
    noise: float = 0.01
    noise_colour: float = 0.0
    late_s: float = 0.0
    asymmetry: float = 0.0
    payload_kg: float = 0.0
    carrier: str = 'panda_hand'
    zeros: tuple[float, ...] = ()
    stiffness: tuple[float, ...] = ()
    gains: tuple[float, ...] = ()
    rest_s: float = 0.0
    sensor: tuple[str, str] | None = None
    seed: int = 0
    masses: tuple[float, float] = (0.8, 1.25)
    encoder: float = 0.0
    effort_step: float = 0.0
    stribeck: float = 0.0
    rubbing: float = 0.0
    mounted: tuple[float, float] = (0.0, 0.0)
    heavier: float = 1.0
    reach: tuple[float, ...] = ()


UR = tuple(f'{name}_joint' for name in ('shoulder_pan', 'shoulder_lift', 'elbow', 'wrist_1', 'wrist_2', 'wrist_3'))
UR_HOME = (0.0, -1.3, 1.2, -0.8, -1.2, 0.3)
XARM = tuple(f'joint{number}' for number in range(1, 8))
XARM_HOME = (0.0, -0.4, 0.2, 0.9, 0.1, 1.2, 0.3)
PANDA = tuple(f'panda_joint{number}' for number in range(1, 8))
PANDA_HOME = (0.0, -0.3, 0.0, -1.8, 0.0, 1.8, 0.6)
KINOVA = tuple(f'j2s6s200_joint_{number}' for number in range(1, 7))
TALOS = tuple(f'arm_left_{number}_joint' for number in range(2, 8))
PR2 = tuple(f'r_{name}_joint' for name in ('shoulder_pan', 'shoulder_lift', 'upper_arm_roll', 'elbow_flex',
                                           'forearm_roll', 'wrist_flex', 'wrist_roll'))
SO100 = ('shoulder_pan', 'shoulder_lift', 'elbow_flex', 'wrist_flex', 'wrist_roll')
UR5, UR10 = 'ur_description/urdf/ur5_robot.urdf', 'ur_description/urdf/ur10_robot.urdf'
XARM7, TALOS_URDF = 'xarm_description/urdf/xarm7.urdf', 'talos_data/robots/talos_left_arm.urdf'
PANDA_URDF = 'panda_description/urdf/panda.urdf'
SETTINGS = (
    Setting('xArm7, sines', XARM7, XARM, XARM_HOME, (3.0, 3.0, 2.0, 2.0, 1.0, 0.8, 0.5)),
    Setting('xArm7, the same motion twice, rests', XARM7, XARM, XARM_HOME, (3.0, 3.0, 2.0, 2.0, 1.0, 0.8, 0.5), 'twice',
            250, velocity_filter_hz=8.0, noise_colour=0.9, noise=0.02, seed=1),
    Setting('UR5 at 125 Hz, from point to point', UR5, UR, UR_HOME, (8.0, 8.0, 6.0, 2.0, 2.0, 1.5), 'points', 125,
            velocity_filter_hz=20.0, seed=2),
    Setting('UR10 at 500 Hz, a joint at a time', UR10, UR, UR_HOME, (12.0, 12.0, 8.0, 3.0, 3.0, 2.0), 'in turn', 500,
            seed=3),
    Setting('Panda, efforts late', PANDA_URDF, PANDA, PANDA_HOME, (0.5, 0.6, 0.4, 0.5, 0.3, 0.3, 0.2), 'sines', 200,
            late_s=0.02, noise_colour=0.5, seed=4),
    Setting('Panda, stops and load from half time on', PANDA_URDF, PANDA, PANDA_HOME,
            (0.5, 0.6, 0.4, 0.5, 0.3, 0.3, 0.2), 'points', 100, payload_kg=1.0, seed=5),
    Setting('Kinova, filtered velocities', 'kinova_description/robots/kinova.urdf', KINOVA,
            (0.0, 2.6, 1.3, 0.5, 1.0, 0.2), (2.0, 3.0, 2.0, 0.7, 0.7, 0.5), 'points', 100, velocity_filter_hz=3.0,
            noise=0.03, seed=6),
    Setting('Talos arm, filtered velocities, rests', TALOS_URDF, TALOS, (0.3, -0.4, -1.2, 0.2, 0.1, 0.1),
            (2.0, 1.5, 1.5, 0.5, 0.5, 0.5), 'in turn', 100, velocity_filter_hz=2.0, noise=0.02, noise_colour=0.9,
            seed=7),
    Setting('UR5, friction differs between directions', UR5, UR, UR_HOME, (8.0, 8.0, 6.0, 2.0, 2.0, 1.5), 'sines', 125,
            asymmetry=0.3, seed=8),
    Setting('Panda, sensor at the wrist, two zeros off', PANDA_URDF, PANDA, PANDA_HOME,
            (0.5, 0.6, 0.4, 0.5, 0.3, 0.3, 0.2), 'points', 200, zeros=(0.0, 0.04, 0.0, -0.03, 0.0, 0.0, 0.0),
            sensor=('panda_joint8', 'panda_link8'), noise_colour=0.8, seed=9),
    Setting('PR2 at 1 kHz, the same motion twice, load from half time on', 'pr2_description/urdf/pr2.urdf', PR2,
            (-0.3, 0.2, -0.4, -1.0, 0.3, -0.6, 0.2), (3.0, 3.0, 2.0, 2.0, 0.5, 0.5, 0.4), 'twice', 1000, noise=0.02,
            noise_colour=0.95, payload_kg=0.8, carrier='r_gripper_palm_link', seed=10),
    Setting('SO-100 at 50 Hz, from point to point', 'so_arm_description/urdf/so100.urdf', SO100,
            (0.0, 1.6, -1.5, 0.5, 0.0), (0.15, 0.15, 0.12, 0.08, 0.05), 'points', 50, armature=0.01, noise=0.02,
            seed=11),
)


def robot_of(setting: Setting, robots: Path) -> Robot:
    """The robot as described, on its mount."""
    tree = ElementTree.fromstring((robots / setting.urdf).read_text())
    if setting.heavier != 1.0:
        for part in [*tree.iter('mass'), *tree.iter('inertia'), *tree.iter('limit')]:
            for name in {'value', 'effort', *INERTIA} & set(part.keys()):
                part.set(name, repr(setting.heavier * float(part.get(name, ''))))
    for inertia in tree.iter('inertia'):
        tensor = np.zeros((3, 3))
        tensor[np.triu_indices(3)] = [float(inertia.get(name, '0')) for name in INERTIA]
        if np.linalg.eigvalsh(tensor, 'U')[0] <= 0.0:  # MuJoCo wants bodies that can be
            for name in INERTIA:
                inertia.set(name, repr(1e-6 * (name[1] == name[2])))
    if any(setting.mounted):
        children = {str(child.get('link')) for child in tree.iter('child')}
        root = next(str(link.get('name')) for link in tree.findall('link') if link.get('name') not in children)
        ElementTree.SubElement(tree, 'link', name='mount')
        joint = ElementTree.SubElement(tree, 'joint', name='mounting', type='fixed')
        ElementTree.SubElement(joint, 'parent', link='mount')
        ElementTree.SubElement(joint, 'child', link=root)
        ElementTree.SubElement(joint, 'origin', rpy='{} {} 0'.format(*setting.mounted), xyz='0 0 1')
    urdf = ElementTree.tostring(tree, encoding='unicode')
    return Robot(urdf, setting.joints, setting.home, *(setting.sensor or (None, None)))


def case(setting: Setting, robots: Path) -> Case:
    """The setting's recording with the package's model of the described robot."""
    robot = robot_of(setting, robots)
    return Case(setting.name, robot.body, recorded(setting, robot))


def recorded(setting: Setting, robot: Robot, take: int = 0) -> Samples:
    """What the robot's driver reports. ``take``: another one has the same robot, and motion and noise of its own."""
    rng = np.random.default_rng(setting.seed)
    model = built(robot, lambda spec: _as_it_is(spec, setting, rng))
    if take:
        rng = np.random.default_rng((setting.seed, take))
    data = mujoco.MjData(model)
    dofs = [model.joint(name).dofadr[0] for name in setting.joints]
    wanted = MOTIONS[setting.motion](setting, rng) * np.array(setting.reach or 1.0) + np.array(setting.home)
    wanted = _with_rests(wanted, setting.rest_s) if setting.rest_s else wanted
    speed = np.gradient(wanted, STEP_S, axis=0)
    change = np.gradient(speed, STEP_S, axis=0)
    data.qpos[dofs], data.qvel[dofs] = wanted[0], speed[0]
    mujoco.mj_forward(model, data)
    inertia, rows = np.zeros((model.nv, model.nv)), []
    dry, friction = setting.asymmetry, np.array(setting.friction)
    for number, (q, dq, ddq) in enumerate(zip(wanted, speed, change, strict=True)):
        if setting.payload_kg and number == len(wanted) // 2:
            model.body('load').mass, model.body('load').inertia = setting.payload_kg, [2e-3] * 3
            mujoco.mj_setConst(model, mujoco.MjData(model))
        mujoco.mj_step1(model, data)
        mujoco.mj_fullM(model, data, inertia)
        aim = ddq + STIFFNESS * (q - data.qpos[dofs]) + DAMPING * (dq - data.qvel[dofs])
        sliding = friction * np.tanh(dq / TURN_SPEED)
        torque = inertia[np.ix_(dofs, dofs)] @ aim + data.qfrc_bias[dofs] + sliding
        more = _rubbing(setting, torque, dq, sliding)
        torque = torque + more
        data.qfrc_applied[dofs] = (torque - _rubbing(setting, torque, data.qvel[dofs], sliding)
                                   - dry * friction * np.maximum(np.tanh(data.qvel[dofs] / TURN_SPEED), 0.0))
        seen = data.qpos[dofs].copy(), data.qvel[dofs].copy()
        mujoco.mj_step2(model, data)
        rows.append((*seen, data.sensordata.copy() if setting.sensor else torque))
    return _reported(setting, *(np.array(part) for part in zip(*rows, strict=True)), rng)


def _rubbing(setting: Setting, torque: Array, speed: Array, sliding: Array) -> Array:
    """(n_joints,) dry friction beside that of MuJoCo: more near rest, and with the load."""
    if not setting.stribeck and not setting.rubbing:
        return np.zeros_like(speed)
    near_rest = setting.stribeck * np.array(setting.friction) * np.exp(-(speed / STRIBECK_SPEED)**2)
    return np.asarray((near_rest + setting.rubbing * np.abs(torque - sliding)) * np.tanh(speed / SOFT_SPEED))


def _as_it_is(spec: mujoco.MjSpec, setting: Setting, rng: np.random.Generator) -> None:
    """Masses other than the description's; friction, rotors, and a load that weighs nothing yet."""
    for body in spec.bodies:
        if body.mass > 1e-6:
            body.mass *= rng.uniform(*setting.masses)
            body.ipos = np.array(body.ipos) + rng.uniform(-0.01, 0.01, 3)
    for name, dry in zip(setting.joints, setting.friction, strict=True):
        joint = spec.joint(name)
        joint.frictionloss, joint.damping = dry, [dry * setting.viscous_share, 0.0, 0.0]
        joint.armature, joint.solref_friction = setting.armature, RIGID_FRICTION
    for name, stiffness, home in zip(setting.joints, setting.stiffness, setting.home, strict=False):
        spec.joint(name).stiffness, spec.joint(name).springref = [stiffness, 0.0, 0.0], home
    if setting.payload_kg:
        load = spec.body(setting.carrier).add_body(name='load', pos=[0.0, 0.02, 0.1])
        load.mass, load.inertia, load.explicitinertial = 1e-6, [1e-9] * 3, True


def _reported(setting: Setting, position: Array, velocity: Array, outputs: Array, rng: np.random.Generator) -> Samples:
    """Sampled at the driver's rate with its filters and noise."""
    if setting.encoder:
        position = setting.encoder * np.round(position / setting.encoder)
        velocity = np.gradient(position, STEP_S, axis=0)
    if setting.velocity_filter_hz:
        below = butter(2, setting.velocity_filter_hz, fs=1.0 / STEP_S)
        running = lfilter_zi(*below)[:, None] * velocity[:1]  # before the recording begins
        velocity, _ = lfilter(*below, velocity, axis=0, zi=running)
    if setting.gains:
        outputs = outputs * (1.0 + np.array(setting.gains))
    late = round(setting.late_s / STEP_S)
    outputs = outputs[np.clip(np.arange(len(outputs)) - late, 0, len(outputs) - 1)]
    every = round(1.0 / STEP_S / setting.rate_hz)
    position, velocity, outputs = position[::every], velocity[::every], outputs[::every]
    noise = rng.standard_normal(outputs.shape)
    colour = setting.noise_colour
    noise = lfilter([np.sqrt(1.0 - colour**2)], [1.0, -colour], noise, axis=0)
    outputs = outputs + setting.noise * outputs.std(axis=0) * noise
    if setting.effort_step:
        step = setting.effort_step * outputs.std(axis=0)
        outputs = step * np.round(outputs / step)
    position = position + (not setting.encoder) * ENCODER * rng.standard_normal(position.shape)
    if setting.zeros:
        position = position - np.array(setting.zeros)
    velocity = velocity + (not setting.encoder) * 1e-3 * rng.standard_normal(velocity.shape)
    stamps = np.arange(len(position)) * (10**9 // setting.rate_hz)
    return Samples(stamps, position, velocity, np.zeros_like(velocity), outputs, 0)


def _sines(setting: Setting, rng: np.random.Generator) -> Array:
    count = len(setting.joints)
    time = np.arange(round(setting.seconds / STEP_S))[:, None] * STEP_S
    path = sum(rng.uniform(0.07, 0.25, count) * np.sin(2 * np.pi * rng.uniform(0.04, 0.4, count) * time
                                                        + rng.uniform(0, 2 * np.pi, count)) for _ in range(4))
    return np.asarray(path)


def _with_rests(path: Array, rest_s: float) -> Array:
    """The path (N, n_joints) with two rests: its own clock stops within a second, and starts again as smoothly."""
    pace = np.ones(len(path))
    slowing = 0.5 + 0.5 * np.cos(np.linspace(0.0, np.pi, round(1.0 / STEP_S)))
    stop = np.concatenate([slowing, np.zeros(round(rest_s / STEP_S)), slowing[::-1]])
    for third in (2, 1):
        pace = np.insert(pace, third * len(path) // 3, stop)
    clock = np.cumsum(pace)
    clock = clock[clock < len(path) - 1]
    return np.column_stack([np.interp(clock, np.arange(len(path)), joint) for joint in path.T])


def _slow(setting: Setting, rng: np.random.Generator) -> Array:
    """Wide and slow: a tenth of a radian in a second."""
    return _waves(setting, rng, (0.1, 0.35), (0.01, 0.06))


def _quick(setting: Setting, rng: np.random.Generator) -> Array:
    """Small and fast, about one pose."""
    return _waves(setting, rng, (0.02, 0.06), (0.4, 1.5)) + rng.uniform(-0.2, 0.2, len(setting.joints))


def _part(setting: Setting, rng: np.random.Generator) -> Array:
    """On one side of home alone."""
    return 0.4 * _sines(setting, rng) + rng.choice([-0.3, 0.3], len(setting.joints))


def _waves(setting: Setting, rng: np.random.Generator, size: tuple[float, float],
           frequencies: tuple[float, float]) -> Array:
    count = len(setting.joints)
    time = np.arange(round(setting.seconds / STEP_S))[:, None] * STEP_S
    path = sum(rng.uniform(*size, count) * np.sin(2 * np.pi * rng.uniform(*frequencies, count) * time
                                                  + rng.uniform(0, 2 * np.pi, count)) for _ in range(3))
    return np.asarray(path)


def _spiral(setting: Setting, rng: np.random.Generator) -> Array:
    """Pairs of joints go outwards and back, each at a pace of its own."""
    count = len(setting.joints)
    time = np.arange(round(setting.seconds / STEP_S))[:, None] * STEP_S
    pace = np.repeat(rng.uniform(0.1, 0.35, count), 2)[:count]
    radius = np.abs(np.sin(np.pi * rng.uniform(0.02, 0.05) * time)) * rng.uniform(0.3, 0.6, count)
    return np.asarray(radius * np.sin(2.0 * np.pi * pace * time + np.pi / 2.0 * np.arange(count)))


def _circles(setting: Setting, rng: np.random.Generator) -> Array:
    """Each joint and the next one draw a circle in their plane, which drifts; the pace changes slowly."""
    count = len(setting.joints)
    time = np.arange(round(setting.seconds / STEP_S))[:, None] * STEP_S
    pace = rng.uniform(0.15, 0.35)
    angle = 2.0 * np.pi * (pace * time + 0.3 * pace / 0.06 / np.pi * np.sin(np.pi * 0.06 * time))
    turned = angle + np.pi / 2.0 * np.arange(count) + rng.uniform(0.0, 0.5, count)
    drift = 0.15 * np.sin(2.0 * np.pi * rng.uniform(0.02, 0.05, count) * time + rng.uniform(0.0, 2.0 * np.pi, count))
    return np.asarray(rng.uniform(0.15, 0.4, count) * np.sin(turned) + drift)


def _twice(setting: Setting, rng: np.random.Generator) -> Array:
    """The same sines twice, faded in and out, at rest for two seconds before, between and after."""
    rest = round(2.0 / STEP_S)
    once = _sines(setting, rng)[:(round(setting.seconds / STEP_S) - 3 * rest) // 2]
    ends = np.minimum(np.arange(len(once)), np.arange(len(once))[::-1]) * STEP_S
    once = once * (0.5 - 0.5 * np.cos(np.pi * np.clip(ends / 3.0, 0.0, 1.0)))[:, None]
    still = np.zeros((rest, once.shape[1]))
    return np.concatenate([still, once, still, once, still])


def _points(setting: Setting, rng: np.random.Generator) -> Array:
    """All joints from point to point, some of them resting on some ways, with stops of up to a second."""
    return _moves(setting, rng, lambda count: rng.random(count) < 0.7)


def _in_turn(setting: Setting, rng: np.random.Generator) -> Array:
    """One or two joints at a time while the others rest."""
    def moving(count: int) -> Array:
        chosen = np.zeros(count, dtype=bool)
        chosen[rng.choice(count, rng.integers(1, 3), replace=False)] = True
        return chosen
    return _moves(setting, rng, moving)


def _moves(setting: Setting, rng: np.random.Generator, moving: Callable[[int], Array]) -> Array:
    count, place, parts, total = len(setting.joints), np.zeros(len(setting.joints)), [], 0
    length = round(setting.seconds / STEP_S)
    while total < length:
        aim = np.where(moving(count), rng.uniform(-0.6, 0.6, count), place)
        steps = round(rng.uniform(1.0, 3.0) / STEP_S)
        s = np.linspace(0.0, 1.0, steps)[:, None]
        parts += [place + (aim - place) * (10 * s**3 - 15 * s**4 + 6 * s**5),
                  np.repeat(aim[None], round(rng.uniform(0.1, 1.0) / STEP_S), axis=0)]
        total += len(parts[-1]) + len(parts[-2])
        place = aim
    return np.concatenate(parts)[:length]


MOTIONS = {'sines': _sines, 'circles': _circles, 'twice': _twice, 'points': _points, 'in turn': _in_turn,
           'slow': _slow, 'quick': _quick, 'part': _part, 'spiral': _spiral}


def cases(robots: Path) -> Iterator[Case]:
    """All settings."""
    return (case(setting, robots) for setting in SETTINGS)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('robots', type=Path)
    parser.add_argument('--only', default='', help='settings whose names hold this')
    parser.add_argument('--seconds', type=float, help='length of each recording, 60 unless given')
    parser.add_argument('--json', type=Path, metavar='FILE')
    arguments = parser.parse_args()
    chosen = [setting for setting in SETTINGS if arguments.only in setting.name]
    if arguments.seconds:
        chosen = [replace(setting, seconds=arguments.seconds) for setting in chosen]
    report(((setting.name, compared(case(setting, arguments.robots))) for setting in chosen),
           'mujoco_arms', arguments.json)
