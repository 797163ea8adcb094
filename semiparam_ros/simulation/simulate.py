"""From a scenario to a recording and the truth behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation import inverse_kinematics, noise
from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.causes import Cause, Site, cause_of
from semiparam_ros.simulation.motions import trajectory
from semiparam_ros.simulation.robot_variation import varied
from semiparam_ros.simulation.scenario import EffectRequest, Scenario, SimulatedRecording
from semiparam_ros.simulation.sizing import SHARE_OF_SIZE, RigidBodyFit, share, solve_magnitude
from semiparam_ros.simulation.world import World

ICUB_JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
ICUB_SENSOR = 'r_arm_ft_sensor'
# The elbow reaches over ten centimetres only: circles must lie across the line from the shoulder to the hand.
ICUB_HOMES = {'circle_xy': (-0.3, 0.75, 1.4, 1.29), 'circle_xz': (-0.68, 1.8, 1.35, 1.3)}
START_NS = 1_700_000_000_000_000_000
MIN_SAMPLES = 10
DRAWS = 8
VISIBLE = 0.3
BASELINES: dict[str, tuple[EffectRequest, ...]] = {'none': (), 'bundled': ()}


@dataclass(frozen=True)
class Hidden:
    """One cause with its magnitude: the world with it, and its entry in the truth."""

    world: World
    truth: dict[str, Any]


def simulate(scenario: Scenario) -> SimulatedRecording:
    """Simulate a recording; the same scenario gives the same numbers. Raises SemiparamError for a wrong scenario."""
    check(scenario)
    root = np.random.default_rng(scenario.seed)
    moving, measuring, causing, missing = root.spawn(4)
    robot = np.random.default_rng(scenario.seed if scenario.robot_seed is None else scenario.robot_seed)
    arm = varied(arm_of(scenario), robot)
    times = np.arange(scenario.samples) / scenario.rate_hz
    path = trajectory(arm, scenario.motion, float(times[-1]), homes_of(scenario, arm), moving)
    bare = World(arm, path, times, np.zeros(arm.n_joints))
    scale = output_scale(bare)
    world, extra = add_effects(bare, BASELINES[scenario.baseline], scale, missing)
    world, truth = add_effects(world, scenario.effects, scale, causing)
    noise_std = scenario.noise * noise.OUTPUT_NOISE_SHARE * scale
    joints = noise.joint_readings(path.at(times), scenario.encoder_noise, measuring)
    offset = noise.constant_offset(measuring) if arm.outputs == 'wrench' else np.zeros(arm.n_joints)
    return SimulatedRecording(
        stamps=START_NS + np.round(times * 1e9).astype(np.int64), joint_names=arm.joints, position=joints[0],
        velocity=joints[1], acceleration=joints[2] if scenario.accelerations else None,
        outputs=noise.output_readings(world.outputs() + offset, noise_std, measuring), outputs_kind=arm.outputs,
        convention=scenario.convention, frame_id=arm.sensor_frame or '', urdf=arm.urdf, noise_std=noise_std,
        truth=tuple(truth), baseline_truth=tuple(extra))


def check(scenario: Scenario) -> None:
    """Refuse what cannot be simulated, each with its sentence."""
    if scenario.samples < MIN_SAMPLES:
        raise SemiparamError(f'{scenario.samples} samples are too few; expected at least {MIN_SAMPLES}.')
    if not (np.isfinite(scenario.rate_hz) and 0 < scenario.rate_hz <= 1000):
        raise SemiparamError(f'rate {scenario.rate_hz} Hz is out of range; expected more than 0 and at most 1000.')
    if scenario.seed < 0 or (scenario.robot_seed or 0) < 0:
        raise SemiparamError('a seed is negative; expected a whole number from 0 on.')
    for name in ('noise', 'encoder_noise'):
        if not (np.isfinite(getattr(scenario, name)) and getattr(scenario, name) >= 0):
            raise SemiparamError(f'{name} {getattr(scenario, name)} is out of range; expected 0 or more.')
    if scenario.baseline not in BASELINES:
        raise SemiparamError(f"baseline '{scenario.baseline}' is unknown; expected one of {', '.join(BASELINES)}.")
    for effect in scenario.effects:
        check_effect(effect, scenario)


def check_effect(effect: EffectRequest, scenario: Scenario) -> None:
    """Size and start of one requested effect."""
    cause = cause_of(effect.kind, scenario.outputs)
    if not (np.isfinite(effect.size) and effect.size > 0):
        raise SemiparamError(f"size {effect.size} of effect '{effect.kind}' is out of range; expected more than 0.")
    if effect.where is not None and not cause.takes_place:
        raise SemiparamError(f"effect '{effect.kind}' has no place; leave out '@{effect.where}'.")
    if effect.start_s is not None and not cause.can_start:
        raise SemiparamError(f"effect '{effect.kind}' is there all the time; it cannot have a start.")
    if effect.start_s is not None and not 0 <= effect.start_s < scenario.samples / scenario.rate_hz:
        raise SemiparamError(f"start {effect.start_s} s of effect '{effect.kind}' lies outside the recording of "
                             f'{scenario.samples / scenario.rate_hz:g} s.')


def arm_of(scenario: Scenario) -> Arm:
    """The arm as the URDF describes it; the package's own iCub arm when no URDF is given."""
    if scenario.urdf is None:
        joints, frame = scenario.joints or ICUB_JOINTS, scenario.sensor_frame or ICUB_SENSOR
        return Arm.from_urdf(bundled_urdf().read_text(), joints, scenario.outputs, frame, scenario.convention)
    return Arm.from_urdf(scenario.urdf, scenario.joints or (), scenario.outputs, scenario.sensor_frame,
                         scenario.convention)


def homes_of(scenario: Scenario, arm: Arm) -> dict[str, Array]:
    """The posture that circles in each plane go around."""
    if scenario.home is not None and len(scenario.home) != arm.n_joints:
        raise SemiparamError(f'home has {len(scenario.home)} values; expected one for each of {arm.n_joints} joints.')
    if scenario.home is None and scenario.urdf is None and arm.joints == ICUB_JOINTS:
        return {plane: np.array(home) for plane, home in ICUB_HOMES.items()}
    home = inverse_kinematics.home(arm) if scenario.home is None else np.array(scenario.home, dtype=float)
    return dict.fromkeys(ICUB_HOMES, home)


def bundled_urdf() -> Path:
    """config/icub_right_arm.urdf of the checkout, or of the installation's share folder."""
    inside = Path('config') / 'icub_right_arm.urdf'
    folders = Path(__file__).resolve().parents[2:]
    candidates = [folders[0] / inside, *(folder / 'share' / 'semiparam_ros' / inside for folder in folders)]
    for path in candidates:
        if path.is_file():
            return path
    raise SemiparamError('the robot description config/icub_right_arm.urdf of this package is not installed.')


def output_scale(world: World) -> Array:
    """Standard deviation (n,) of the rigid body's outputs; a channel that never changes raises SemiparamError."""
    scale = world.outputs().std(axis=0)
    still = [name for name, value in zip(world.arm.channels, scale, strict=True) if value < 1e-9]
    if still:
        raise SemiparamError(f'this motion never changes the output of {", ".join(still)}: nothing can be scaled to '
                             'it; choose other joints or another motion.')
    return np.asarray(scale)


def add_effects(world: World, effects: Sequence[EffectRequest], scale: Array,
                rng: np.random.Generator) -> tuple[World, list[dict[str, Any]]]:
    """Put the effects into the world one after the other."""
    truth = []
    fit = RigidBodyFit(world, scale) if effects else None
    for effect in effects:
        assert fit is not None
        hidden = hide(world, effect, scale, fit, rng)
        world = hidden.world
        truth.append(hidden.truth)
    return world, truth


def hide(world: World, effect: EffectRequest, scale: Array, fit: RigidBodyFit, rng: np.random.Generator) -> Hidden:
    """Draw one effect and size it.

    Some draws are nothing but another inertia (a force that hangs straight down, the rotor of the first joint): draw
    again while the rigid body could explain most of it, and keep the plainest.
    """
    drawn = []
    for _ in range(DRAWS):
        site = Site(world, scale, effect.where, effect.start_s, rng)
        drawn.append(sized(cause_of(effect.kind, world.arm.outputs).draw(site), world, effect.size, scale, fit))
        if drawn[-1].truth['unexplained_share'] >= VISIBLE * drawn[-1].truth['rms_share']:
            break
    return max(drawn, key=lambda hidden: float(hidden.truth['unexplained_share']))


def sized(cause: Cause, world: World, size: float, scale: Array, fit: RigidBodyFit) -> Hidden:
    """The cause at the magnitude that gives the asked size."""
    without = world.outputs()

    def share_at(magnitude: float) -> float:
        return share(cause.apply(world, magnitude).outputs() - without, scale)

    magnitude = solve_magnitude(share_at, SHARE_OF_SIZE * size, cause.typical, cause.kind)
    after = cause.apply(world, magnitude)
    change = after.outputs() - without
    quantities = {name: {'value': np.asarray(entry.value).tolist(), 'unit': entry.unit}
                  for name, entry in cause.parameters(magnitude).items()}
    return Hidden(after, {'kind': cause.kind, 'where': cause.where, 'start_s': cause.start_s, 'size': size,
                          'rms_share': share(change, scale), 'unexplained_share': fit.unexplained(change),
                          'parameters': quantities})
