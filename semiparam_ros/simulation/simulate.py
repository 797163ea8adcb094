"""Simulation of a recording from a scenario, with the truth behind it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.causes import CAUSES, cause_of
from semiparam_ros.simulation.hiding import (
    REFERENCE_HZ,
    REFERENCE_MOTION,
    REFERENCE_S,
    add_effects,
    check_baseline,
    output_scale,
    with_baseline,
)
from semiparam_ros.simulation.motions import Homes, trajectory
from semiparam_ros.simulation.robots import arm_of, homes_of, varied
from semiparam_ros.simulation.scenario import EffectRequest, Scenario, SimulatedRecording
from semiparam_ros.simulation.trajectory import Instants
from semiparam_ros.simulation.warming import readings, warming
from semiparam_ros.simulation.world import World

MIN_SAMPLES = 10
LONGEST_S = 1e5
"""Of a recording: it is made of steps of a millisecond."""

OUTPUT_NOISE_SHARE = 0.02
POSITION_NOISE = 1e-4
VELOCITY_NOISE = 2e-3
ACCELERATION_NOISE = 2e-2
ENCODER_STEP = 2 * np.pi / 2**16
# Converters' steps, powers of two: bags compress well, and the last bits of a processor's arithmetic do not show.
VELOCITY_STEP, ACCELERATION_STEP = 2.0**-14, 2.0**-11
OUTPUT_STEP = 2.0**-15
FORCE_OFFSET, TORQUE_OFFSET = 4.0, 0.3

START_NS = 1_700_000_000_000_000_000


def check(scenario: Scenario) -> None:
    """Refuse what cannot be simulated, each with its sentence."""
    if scenario.samples < MIN_SAMPLES:
        raise SemiparamError(f'{scenario.samples} samples are too few; expected at least {MIN_SAMPLES}.')
    if not (np.isfinite(scenario.rate_hz) and 0 < scenario.rate_hz <= 1000):
        raise SemiparamError(f'rate {scenario.rate_hz} Hz is out of range; expected more than 0 and at most 1000.')
    if scenario.samples / scenario.rate_hz > LONGEST_S:
        raise SemiparamError(f'{scenario.samples} samples at {scenario.rate_hz:g} Hz last '
                             f'{scenario.samples / scenario.rate_hz:.3g} s; expected at most {LONGEST_S:g} s.')
    if scenario.seed < 0 or (scenario.robot_seed or 0) < 0:
        raise SemiparamError('a seed is negative; expected a whole number from 0 on.')
    for name in ('noise', 'noise_correlation_s', 'encoder_noise'):
        if not (np.isfinite(getattr(scenario, name)) and getattr(scenario, name) >= 0):
            raise SemiparamError(f'{name} {getattr(scenario, name)} is out of range; expected 0 or more.')
    check_baseline(scenario.baseline)
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
    if effect.end_s is not None and not cause.can_end:
        raise SemiparamError(f"effect '{effect.kind}' stays; it cannot have an end.")
    if effect.end_s is not None and not (np.isfinite(effect.end_s) and effect.end_s > (effect.start_s or 0.0)):
        raise SemiparamError(f"end {effect.end_s} s of effect '{effect.kind}' is out of range; expected more than its "
                             'start, and a finite number.')
    if effect.start_s is not None and not 0 <= effect.start_s < scenario.samples / scenario.rate_hz:
        raise SemiparamError(f"start {effect.start_s} s of effect '{effect.kind}' lies outside the recording of "
                             f'{scenario.samples / scenario.rate_hz:g} s.')


def joint_readings(motion: Instants, scale: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration (N, n_joints) as measured; the position in steps of a 16-bit encoder."""
    levels = (POSITION_NOISE, VELOCITY_NOISE, ACCELERATION_NOISE)
    noisy = [values + scale * level * rng.standard_normal(values.shape)
             for values, level in zip(motion[1:], levels, strict=True)]
    steps = (ENCODER_STEP, VELOCITY_STEP, ACCELERATION_STEP)
    position, velocity, acceleration = (in_steps(values, step) for values, step in zip(noisy, steps, strict=True))
    return position, velocity, acceleration


def output_readings(outputs: Array, std: Array, rng: np.random.Generator, correlation: float = 0.0) -> Array:
    """Outputs (N, n) as converted, with noise of ``std`` (n,) that is correlated over ``correlation`` samples; the
    converter's step suits the largest value."""
    noisy = outputs + std * correlated(rng.standard_normal(outputs.shape), correlation)
    return in_steps(noisy, OUTPUT_STEP * 2.0 ** np.ceil(np.log2(np.abs(noisy).max(axis=0) + 1e-6)))


def correlated(white: Array, samples: float) -> Array:
    """White noise (N, n) filtered to an autoregression that forgets within so many samples, as large as before."""
    if not samples > 0.0:
        return white
    keeps = float(np.exp(-1.0 / samples))
    adds = float(np.sqrt(1.0 - keeps**2))
    return np.asarray(lfilter([adds], [1.0, -keeps], white, axis=0, zi=(1.0 - adds) * white[:1])[0])


def constant_offset(rng: np.random.Generator) -> Array:
    """Offset of a wrench sensor, (6,) [N, N m]."""
    return np.asarray(rng.standard_normal(6) * np.repeat([FORCE_OFFSET, TORQUE_OFFSET], 3))


def in_steps(values: Array, step: float | Array) -> Array:
    """Rounded to multiples of ``step``, one for all columns or one for each."""
    return np.asarray(np.round(values / step) * step)


def simulate(scenario: Scenario) -> SimulatedRecording:
    """Simulate a recording; the same scenario gives the same numbers. Raises SemiparamError for a wrong scenario.

    Motion, measurement noise, requested effects and what the baseline adds take children of one generator each, so
    that adding an effect changes neither the motion nor the noise.
    """
    check(scenario)
    moving, measuring, causing, inside, heating = np.random.default_rng(scenario.seed).spawn(5)
    _, inheriting, mounting = robot_generators(scenario)
    arm = true_arm(scenario)
    homes = homes_of(scenario, arm)
    plain = moved(arm, scenario.motion, scenario.samples, scenario.rate_hz, homes, moving)
    scale = output_scale(plain)
    if scenario.temperatures or any(CAUSES[effect.kind].by_temperature for effect in scenario.effects):
        sources = arm.n_joints if arm.outputs == 'effort' else 1
        plain = plain.changed(temperature=warming(sources, plain.duration, heating))
    world, extra = plain, list[dict[str, Any]]()
    if scenario.baseline == 'bundled':
        reference = moved(arm, REFERENCE_MOTION, round(REFERENCE_S * REFERENCE_HZ), REFERENCE_HZ, homes, inheriting)
        world, extra = with_baseline(plain, reference, scale, inheriting, inside)
    world, truth = add_effects(world, scenario.effects, scale, causing)
    offset = constant_offset(mounting) if arm.outputs == 'wrench' else np.zeros(arm.n_joints)
    found = measured(scenario, world, offset, scale, measuring, truth, extra)
    return found if world.temperature is None else replace(
        found, temperature=readings(world.temperature, world.times, scenario.encoder_noise, heating))


def true_arm(scenario: Scenario) -> Arm:
    """The arm as it is, whose bodies are not those of its description."""
    return varied(arm_of(scenario), robot_generators(scenario)[0])


def robot_generators(scenario: Scenario) -> list[np.random.Generator]:
    """Generators of the inertias, the other peculiarities and the sensor's offset of one robot."""
    seed = scenario.seed if scenario.robot_seed is None else scenario.robot_seed
    return np.random.default_rng(seed).spawn(7)[4:]


def moved(arm: Arm, motion: str, samples: int, rate_hz: float, homes: Homes, rng: np.random.Generator) -> World:
    """The rigid arm on its way, nothing hidden."""
    times = np.arange(samples) / rate_hz
    return World(arm, trajectory(arm, motion, float(times[-1]), homes, rng), times, np.zeros(arm.n_joints))


def measured(scenario: Scenario, world: World, offset: Array, scale: Array, rng: np.random.Generator,
             truth: list[dict[str, Any]], extra: list[dict[str, Any]]) -> SimulatedRecording:
    """Measure the world: noise on everything, and the sensor's constant ``offset`` (n,)."""
    noise_std = scenario.noise * OUTPUT_NOISE_SHARE * scale
    position, velocity, acceleration = joint_readings(world.trajectory.at(world.times), scenario.encoder_noise,
                                                      rng)
    return SimulatedRecording(
        stamps=START_NS + np.round(world.times * 1e9).astype(np.int64), joint_names=world.arm.joints,
        position=position, velocity=velocity, acceleration=acceleration if scenario.accelerations else None,
        outputs=output_readings(world.outputs + offset, noise_std, rng,
                                scenario.noise_correlation_s * scenario.rate_hz),
        outputs_kind=world.arm.outputs, convention=scenario.convention,
        frame_id=(scenario.sensor_frame or world.arm.sensor_frame) if world.arm.sensor_frame else '',
        urdf=world.arm.urdf,
        noise_std=noise_std, truth=tuple(truth), baseline_truth=tuple(extra))
