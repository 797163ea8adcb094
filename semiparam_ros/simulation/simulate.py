"""From a scenario to a recording and the truth behind it."""

from __future__ import annotations

from typing import Any

import numpy as np

from semiparam_ros.simulation import noise
from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.baseline import REFERENCE_HZ, REFERENCE_MOTION, REFERENCE_S, with_baseline
from semiparam_ros.simulation.checking import check
from semiparam_ros.simulation.hiding import add_effects, output_scale
from semiparam_ros.simulation.motions import Homes, trajectory
from semiparam_ros.simulation.robot_variation import varied
from semiparam_ros.simulation.robots import arm_of, homes_of
from semiparam_ros.simulation.scenario import Scenario, SimulatedRecording
from semiparam_ros.simulation.world import World

START_NS = 1_700_000_000_000_000_000


def simulate(scenario: Scenario) -> SimulatedRecording:
    """Simulate a recording; the same scenario gives the same numbers. Raises SemiparamError for a wrong scenario.

    Motion, measurement noise, requested effects and what the baseline adds take children of one generator each, so
    that adding an effect changes neither the motion nor the noise.
    """
    check(scenario)
    moving, measuring, causing, warming = np.random.default_rng(scenario.seed).spawn(4)
    building, inheriting, mounting = robot_generators(scenario)
    arm = varied(arm_of(scenario), building)
    homes = homes_of(scenario, arm)
    bare = moved(arm, scenario.motion, scenario.samples, scenario.rate_hz, homes, moving)
    scale = output_scale(bare)
    world, extra = bare, list[dict[str, Any]]()
    if scenario.baseline == 'bundled':
        reference = moved(arm, REFERENCE_MOTION, round(REFERENCE_S * REFERENCE_HZ), REFERENCE_HZ, homes, inheriting)
        world, extra = with_baseline(bare, reference, scale, inheriting, warming)
    world, truth = add_effects(world, scenario.effects, scale, causing)
    offset = noise.constant_offset(mounting) if arm.outputs == 'wrench' else np.zeros(arm.n_joints)
    return measured(scenario, world, offset, scale, measuring, truth, extra)


def robot_generators(scenario: Scenario) -> list[np.random.Generator]:
    """For the inertias, the other peculiarities and the sensor's constant offset of one robot."""
    seed = scenario.seed if scenario.robot_seed is None else scenario.robot_seed
    return np.random.default_rng(seed).spawn(7)[4:]


def moved(arm: Arm, motion: str, samples: int, rate_hz: float, homes: Homes, rng: np.random.Generator) -> World:
    """The rigid arm on its way, nothing hidden."""
    times = np.arange(samples) / rate_hz
    return World(arm, trajectory(arm, motion, float(times[-1]), homes, rng), times, np.zeros(arm.n_joints))


def measured(scenario: Scenario, world: World, offset: Array, scale: Array, rng: np.random.Generator,
             truth: list[dict[str, Any]], extra: list[dict[str, Any]]) -> SimulatedRecording:
    """What encoders and sensors report of the world: noise on everything, and the sensor's constant ``offset``."""
    noise_std = scenario.noise * noise.OUTPUT_NOISE_SHARE * scale
    position, velocity, acceleration = noise.joint_readings(world.trajectory.at(world.times), scenario.encoder_noise,
                                                            rng)
    return SimulatedRecording(
        stamps=START_NS + np.round(world.times * 1e9).astype(np.int64), joint_names=world.arm.joints,
        position=position, velocity=velocity, acceleration=acceleration if scenario.accelerations else None,
        outputs=noise.output_readings(world.outputs + offset, noise_std, rng), outputs_kind=world.arm.outputs,
        convention=scenario.convention, frame_id=world.arm.sensor_frame or '', urdf=world.arm.urdf,
        noise_std=noise_std, truth=tuple(truth), baseline_truth=tuple(extra))
