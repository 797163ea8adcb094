"""Whole recordings: rigid body to noise, the same from the same seed, refusals; any URDF."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation import EffectRequest, Scenario, simulate
from semiparam_ros.simulation.robots import arm_of, varied
from semiparam_ros.simulation.simulate import correlated, robot_generators

SHORT = Scenario(motion='mixed', samples=800, seed=7)


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_without_effects_only_noise_is_left(outputs):
    scenario = replace(SHORT, outputs=outputs, encoder_noise=0.0)
    recording = simulate(scenario)
    robot = varied(arm_of(scenario), robot_generators(scenario)[0])
    left = recording.outputs - robot.evaluate(recording.position, recording.velocity, recording.acceleration)
    assert np.allclose(left.std(axis=0), recording.noise_std, rtol=0.1)
    assert np.allclose(recording.noise_std, 0.02 * recording.outputs.std(axis=0), rtol=0.02)
    offset = np.abs(left.mean(axis=0)) / recording.noise_std
    assert offset.max() > 3 if outputs == 'wrench' else offset.max() < 0.2
    white = left - left.mean(axis=0)
    assert np.abs(np.mean(white[1:] * white[:-1], axis=0) / white.var(axis=0)).max() < 0.15
    assert recording.truth == recording.baseline_truth == ()


@pytest.mark.parametrize('steps', [4, 20])
def test_correlated_noise_forgets_within_its_time_and_is_as_large(steps):
    noise = correlated(np.random.default_rng(0).standard_normal((20_000, 6)), steps)
    assert np.allclose(noise.std(axis=0), 1.0, rtol=0.1)
    alike = np.mean(noise[steps:] * noise[:-steps], axis=0) / noise.var(axis=0)
    assert np.allclose(alike, np.exp(-1.0), atol=0.1)


def test_a_recording_s_noise_is_correlated_as_asked():
    scenario = replace(SHORT, encoder_noise=0.0, noise_correlation_s=0.5)
    recording, quiet = simulate(scenario), simulate(replace(scenario, noise=0.0))
    noise = (recording.outputs - quiet.outputs) / recording.noise_std
    steps = round(0.5 * scenario.rate_hz)
    assert np.mean(noise**2) == pytest.approx(1.0, abs=0.3)
    assert np.mean(noise[steps:] * noise[:-steps]) == pytest.approx(np.exp(-1.0), abs=0.2)


def test_joints_are_measured_with_noise():
    noisy, clean = simulate(SHORT), simulate(replace(SHORT, encoder_noise=0.0))
    for name, level in (('position', 1e-4), ('velocity', 2e-3), ('acceleration', 2e-2)):
        error = getattr(noisy, name) - getattr(clean, name)
        assert error.std() == pytest.approx(level, rel=0.15), name
    assert simulate(replace(SHORT, accelerations=False)).acceleration is None


def test_stamps_are_regular():
    recording = simulate(replace(SHORT, rate_hz=30.0, samples=50))
    assert np.all(np.abs(np.diff(recording.stamps) - 1e9 / 30) <= 1)
    assert recording.stamps.dtype == np.int64


def test_the_same_seed_gives_the_same_recording_and_another_another():
    scenario = replace(SHORT, samples=200, effects=(EffectRequest('cable_hysteresis'),), baseline='bundled')
    first, second = simulate(scenario), simulate(scenario)
    other = simulate(replace(scenario, seed=8))
    for name in ('stamps', 'position', 'velocity', 'acceleration', 'outputs'):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    assert first.truth == second.truth
    assert not np.array_equal(first.outputs, other.outputs)
    assert not np.array_equal(first.position, other.position)


def test_the_baseline_belongs_to_the_robot():
    """Another recording of the same robot meets the same cables; only the warming up is its own."""
    xy, xz = (simulate(Scenario(motion=motion, samples=200, seed=seed, robot_seed=6, baseline='bundled'))
              for motion, seed in (('circle_xy', 1), ('circle_xz', 2)))
    assert len(xy.baseline_truth) >= 4
    for mine, yours in zip(xy.baseline_truth, xz.baseline_truth, strict=True):
        assert mine['kind'] == yours['kind']
        assert (mine['parameters'] == yours['parameters']) == (mine['kind'] != 'thermal_drift')


@pytest.mark.parametrize(('change', 'words'), [
    ({'samples': 5}, '5 samples are too few'),
    ({'rate_hz': 0.0}, 'rate 0.0 Hz is out of range'),
    ({'rate_hz': float('nan')}, 'rate nan Hz is out of range'),
    ({'seed': -1}, 'seed is negative'),
    ({'rate_hz': 1e-12}, 'expected at most 100000 s'),
    ({'noise': -1.0}, 'noise -1.0 is out of range'),
    ({'encoder_noise': float('inf')}, 'encoder_noise inf is out of range'),
    ({'motion': 'dance'}, "motion 'dance' is unknown"),
    ({'baseline': 'some'}, "baseline 'some' is unknown"),
    ({'home': (0.0, 1.0)}, 'home has 2 values'),
    ({'effects': (EffectRequest('gremlin'),)}, "no effect 'gremlin' to simulate; expected one of payload"),
    ({'effects': (EffectRequest('coulomb_friction'),)}, "'coulomb_friction' does not act on wrench"),
    ({'effects': (EffectRequest('payload', size=0.0),)}, "size 0.0 of effect 'payload' is out of range"),
    ({'effects': (EffectRequest('payload', start_s=100.0),)}, 'lies outside the recording of 40 s'),
    ({'effects': (EffectRequest('gravity_tilt', start_s=1.0),)}, 'cannot have a start'),
    ({'effects': (EffectRequest('sensor_drift', end_s=1.0),)}, 'cannot have an end'),
    ({'effects': (EffectRequest('payload', start_s=2.0, end_s=1.0),)}, 'end 1.0 s .* more than its start'),
    ({'effects': (EffectRequest('time_delay', 'r_elbow'),)}, "has no place; leave out '@r_elbow'"),
    ({'effects': (EffectRequest('joint_offset', 'elbow'),)}, "there is no joint 'elbow'; expected one of r_shoulder"),
    ({'effects': (EffectRequest('sensor_gain', 'fa'),)}, "there is no channel 'fa'; expected one of fx"),
    ({'effects': (EffectRequest('payload', 'foot'),)}, "the URDF has no frame 'foot'"),
    ({'effects': (EffectRequest('viscous_drag', 'r_shoulder_1'),)}, 'does not load the sensor'),
    ({'effects': (EffectRequest('sensor_misalignment', size=1000.0),)}, 'cannot be made as large as asked'),
])
def test_refusals(change, words):
    with pytest.raises(SemiparamError, match=words):
        simulate(replace(SHORT, **change))


@pytest.mark.parametrize('robot', ['ur3', 'panda'])
def test_other_robots(shared_data, robot):
    urdf = (shared_data / f'{robot}_arm' / f'{robot}.urdf').read_text()
    recording = simulate(Scenario(motion='mixed', samples=400, outputs='effort', urdf=urdf, seed=1,
                                  effects=(EffectRequest('coulomb_friction'), EffectRequest('payload'))))
    assert recording.outputs.shape == (400, {'ur3': 6, 'panda': 7}[robot])
    assert recording.truth[1]['rms_share'] == pytest.approx(0.1, rel=1e-6)
    assert np.all(np.isfinite(recording.outputs))
    assert np.abs(recording.velocity).max() < 3.5
