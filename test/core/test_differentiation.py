"""Causal accelerations: exact on parabolas, accurate on arm-like motion at any rate, and robust to odd stamps."""

import numpy as np
import pytest

from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.errors import SemiparamError


def run(time, velocity, cutoff=10.0):
    filtered = CausalDifferentiator(velocity.shape[1], cutoff)
    return np.array([filtered.update(round(t * 1e9), v) for t, v in zip(time, velocity, strict=True)])


def circle(rate, seconds=30.0, turns=0.8):
    """Velocity and acceleration of a joint while the hand draws circles: a base frequency and two harmonics."""
    time = np.arange(int(seconds * rate)) / rate
    parts = [(harmonic, size, 2 * np.pi * turns * harmonic) for harmonic, size in ((1, 0.3), (2, 0.06), (3, 0.015))]
    velocity = sum(size * w * np.cos(w * time + harmonic) for harmonic, size, w in parts)
    acceleration = sum(-size * w**2 * np.sin(w * time + harmonic) for harmonic, size, w in parts)
    return time, velocity[:, None], acceleration[:, None]


def relative_error(estimate, truth, skip):
    return np.sqrt(np.mean((estimate - truth)[skip:] ** 2) / np.mean(truth[skip:] ** 2))


@pytest.mark.parametrize('rate', [20, 125, 1000])
@pytest.mark.parametrize('cutoff', [1.0, 10.0, 100.0])
def test_no_lag_while_the_acceleration_is_a_ramp(rate, cutoff):
    time = np.arange(3 * rate) / rate
    velocity = np.column_stack([1 + 2 * time + 3 * time**2, -0.5 * time**2])
    acceleration = np.column_stack([2 + 6 * time, -time])
    np.testing.assert_allclose(run(time, velocity, cutoff)[2:], acceleration[2:], atol=1e-7)


def test_no_lag_on_a_ramp_with_uneven_stamps():
    time = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 400)) * 0.02
    estimate = run(time, (time**2)[:, None], 5.0)
    np.testing.assert_allclose(estimate[100:, 0], 2 * time[100:], rtol=0.02)


@pytest.mark.parametrize(('rate', 'bound'), [(20, 0.13), (30, 0.10), (125, 0.09), (1000, 0.09)])
def test_error_on_a_circle_at_the_recommended_cutoff(rate, bound):
    time, velocity, acceleration = circle(rate)
    noisy = velocity + 0.005 * velocity.std() * np.random.default_rng(0).standard_normal(velocity.shape)
    assert relative_error(run(time, noisy), acceleration, rate) < bound


def test_a_cutoff_beyond_the_sample_rate_still_gives_accelerations():
    """Each step was taken for a gap when five memories were shorter than a step: zeros, silently."""
    time, velocity, acceleration = circle(20)
    assert relative_error(run(time, velocity, 40.0), acceleration, 20) < 0.12


def test_the_result_depends_on_the_past_only():
    time, velocity, _ = circle(30)
    changed = velocity.copy()
    changed[500:] += 3.0
    np.testing.assert_array_equal(run(time, velocity)[:500], run(time, changed)[:500])


def test_a_repeated_stamp_changes_nothing():
    time, velocity, _ = circle(20, 5)
    twice, odd = np.repeat(time, 2), np.repeat(velocity, 2, axis=0)
    odd[1::2] += 100.0
    np.testing.assert_array_equal(run(twice, odd)[::2], run(time, velocity))


@pytest.mark.parametrize('jump', [-100.0, 3.0])
def test_after_a_jump_of_the_clock_it_starts_afresh(jump):
    time, velocity, _ = circle(20, 5)
    jumped = np.where(np.arange(len(time)) < 60, time, time + jump)
    np.testing.assert_allclose(run(jumped, velocity)[60:], run(time[60:], velocity[60:]), atol=1e-7)


@pytest.mark.parametrize('lost', [1, 2, 3])
def test_a_few_lost_samples_are_bridged(lost):
    time, velocity, acceleration = circle(20)
    kept = np.ones(len(time), dtype=bool)
    kept[300:300 + lost] = False
    error = np.abs(run(time[kept], velocity[kept]) - acceleration[kept])[:, 0] / acceleration.std()
    assert error[300] < 1.0
    assert error[302:].max() < 0.3


def test_velocities_that_are_not_finite_are_refused_and_leave_the_past():
    time, velocity, _ = circle(20, 5)
    filtered = CausalDifferentiator(1, 10.0)
    expected = run(time, velocity)
    for index, (t, v) in enumerate(zip(time, velocity, strict=True)):
        for bad in (np.nan, np.inf):
            with pytest.raises(SemiparamError, match='expected finite values'):
                filtered.update(round(t * 1e9), np.array([bad]))
        np.testing.assert_array_equal(filtered.update(round(t * 1e9), v), expected[index])


def test_earlier_results_are_not_overwritten():
    time, velocity, _ = circle(20, 2)
    filtered = CausalDifferentiator(1, 10.0)
    first = filtered.update(0, velocity[0])
    filtered.update(round(time[1] * 1e9), velocity[1])
    np.testing.assert_array_equal(first, [0.0])


@pytest.mark.parametrize('cutoff', [0.0, -1.0, float('nan'), float('inf')])
def test_an_impossible_cutoff_is_refused(cutoff):
    with pytest.raises(SemiparamError, match=r'acceleration\.cutoff'):
        CausalDifferentiator(2, cutoff)
