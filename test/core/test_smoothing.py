"""The smoother against motions whose derivatives are known, at the rates and noises of real recordings."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.samples import Samples
from semiparam_ros.core.signals.smoothing import acceleration_errors, smoothed
from semiparam_ros.diagnosis.config import DEFAULTS
from semiparam_ros.diagnosis.preparation import Inputs, averaged, measured_lags
from support.arms import smooth_motion
from support.node_helpers import motion

ENCODER, TACHO = 5e-5, 2e-3


def recorded(rate, seconds=30.0, speed=0.6, seed=0, joints=3):
    """True motion, and what an encoder and its filtered differences show of it."""
    truth = smooth_motion(joints, int(rate * seconds), rate=rate, seed=seed, speed=speed)
    rng = np.random.default_rng(seed + 100)
    noise = rng.normal(size=(2, *truth.position.shape))
    return truth, replace(truth, position=truth.position + ENCODER * noise[0],
                          velocity=truth.velocity + TACHO * noise[1], acceleration=np.zeros_like(truth.velocity))


def relative_error(found, true):
    return np.sqrt(np.mean((found - true) ** 2, axis=0)) / true.std(axis=0)


@pytest.mark.parametrize('motion', ['smoothed', 'smoothed from positions'])
@pytest.mark.parametrize('rate', [20.0, 50.0, 100.0, 250.0, 1000.0])
@pytest.mark.parametrize('speed', [0.2, 1.0])
def test_derivatives_of_slow_and_fast_motion_at_every_rate(rate, speed, motion):
    truth, seen = recorded(rate, speed=speed)
    factor = max(int(rate / DEFAULTS.working_rate_hz), 1)
    found, true = Inputs(motion, factor).prepare(seen), Inputs('recorded', factor).prepare(truth)
    assert relative_error(found.position, true.position).max() < 1e-3
    assert relative_error(found.velocity, true.velocity).max() < 5e-3
    assert relative_error(found.acceleration, true.acceleration).max() < 0.05


def test_a_working_sample_is_what_the_recording_says_of_its_middle():
    truth = smooth_motion(3, 4000, rate=200.0, speed=2.0)
    truth = replace(truth, outputs=np.sin(3.0 * truth.position) * truth.velocity)
    coarse, middle, mean = averaged(truth, 5), truth.outputs[2::5], truth.outputs.reshape(-1, 5, 3).mean(axis=1)
    errors = [relative_error(values[2:-2], middle[2:-2]) for values in (coarse.outputs, mean)]
    assert (errors[0] < 0.15 * errors[1]).all()
    apart = Samples.joined([truth[:2000], truth[1000:]])  # what comes after a break says nothing of what was before it
    means = apart.outputs.reshape(-1, 5, 3).mean(axis=1)
    np.testing.assert_allclose(averaged(apart, 5).outputs[398:402], means[398:402], rtol=1e-3)


@pytest.mark.parametrize('rate', [20.0, 125.0])
@pytest.mark.parametrize('late_s', [0.0, 0.004, 0.03])
def test_late_derivatives_are_measured_and_taken_as_early_as_the_positions(rate, late_s):
    truth, seen = recorded(rate)
    later = [np.column_stack([np.interp(truth.time - lag, truth.time, values) for values in derivative.T])
             for derivative, lag in ((seen.velocity, late_s), (truth.acceleration, 1.5 * late_s))]
    late = replace(seen, velocity=later[0], acceleration=later[1])
    inputs = Inputs('smoothed', max(int(rate / DEFAULTS.working_rate_hz), 1))
    lags = measured_lags(late, inputs)
    assert lags == pytest.approx((late_s, 1.5 * late_s), abs=1e-3)
    true = inputs._replace(motion='recorded').prepare(truth)
    for name in ('velocity', 'acceleration'):
        as_it_is, aligned = (relative_error(getattr(each.working(late), name)[5:-5], getattr(true, name)[5:-5]).max()
                             for each in (inputs._replace(lags=(0.0, 0.0)), inputs._replace(lags=lags)))
        assert aligned < 0.03 and (late_s < 0.01 or as_it_is > 3.0 * aligned)


def test_a_rest_at_the_beginning_does_not_smooth_the_motion_away():
    truth, seen = recorded(100.0, seconds=40.0)
    still = np.arange(len(truth)) < 1500
    rest = truth.position[1500]

    def held(samples, noise):
        position = np.where(still[:, None], rest, samples.position) + noise * still[:, None]
        return replace(samples, position=position, velocity=np.where(still[:, None], 0.0, samples.velocity))

    rng = np.random.default_rng(5)
    found = smoothed(held(seen, ENCODER * rng.normal(size=truth.position.shape)))
    moving = slice(1600, None)
    assert relative_error(found.acceleration[moving], truth.acceleration[moving]).max() < 0.05


def test_the_ends_of_a_smoothed_recording_take_no_part():
    usable = np.ones(100, dtype=bool)
    inner = Inputs('smoothed', 2).mask(usable)
    assert np.flatnonzero(inner).tolist() == list(range(5, 45))
    assert Inputs('recorded', 2).mask(usable).all()


def test_errors_of_accelerations_that_rounding_hides_are_not_known():
    """A factor that fails must not end a diagnosis: with absurd effects declared, the fuzzer met one."""
    _, samples = recorded(100.0, seconds=3.0)
    samples = replace(samples, position=samples.position.round(3), velocity=samples.velocity.round(3))
    assert np.all(acceleration_errors(samples) > 0.0)
    assert np.isnan(acceleration_errors(samples, times=(1e5,))).all()


def test_errors_of_accelerations_in_several_recordings_are_those_of_each():
    one, other = recorded(40.0)[1], recorded(40.0)[1][:200]
    each = [acceleration_errors(samples, times=(1.0, 2.0)) for samples in (one, other)]
    joined = acceleration_errors(Samples.joined([one, other, other[:3]]), times=(1.0, 2.0))
    assert joined**2 == pytest.approx(np.average(np.square(each), axis=0, weights=[len(one), len(other)]))


def test_stretches_of_a_long_recording_are_smoothed_as_well_as_a_whole_one():
    """What lies between them is no motion: a jump of the arm from one to the next must not count as a lively one."""
    truth, seen = recorded(40.0, seconds=90.0, joints=2)
    inside = np.arange(len(truth)) % 600 < 240
    found, true = smoothed(seen[inside]), truth[inside]
    inner = np.isin(np.arange(inside.sum()) % 240, range(5, 235))
    error = (found.acceleration - true.acceleration)[inner].std(axis=0)
    assert error == pytest.approx((smoothed(seen).acceleration - truth.acceleration).std(axis=0), rel=0.3)
    assert np.all(acceleration_errors(seen[inside])[0] < 3.0 * error)


def test_measured_accelerations_and_a_smoother_motion_make_accelerations_better():
    """Of motion that is fast for 20 Hz each is better than what is measured and than the smoother before."""
    truth, seen = recorded(20.0, joints=2, speed=0.8)
    noise = 0.02 * np.random.default_rng(3).normal(size=truth.position.shape)
    seen = replace(seen, acceleration=truth.acceleration + noise)

    def error(found):
        return float((found.acceleration - truth.acceleration)[10:-10].std())

    plain, more, both = (error(smoothed(seen, *how)) for how in ((2, 4), (2, 6), (3, 6)))
    assert both < 0.95 * more < 0.95 * 0.75 * plain < noise.std()


def test_a_motion_that_jumps_is_no_error():
    """As of a bag that is cut together: rounding spoiled the factor. Velocities contradict the jumps, so that nothing
    follows from both; positions alone are followed."""
    jumping = Samples.from_list([sample._replace(position=sample.position + 100.0 * (index // 400 % 2))
                                 for index, sample in enumerate(motion(1500))])
    found = smoothed(jumping)
    assert np.isfinite(found.position).all() and np.isfinite(found.acceleration).all()
    alone = smoothed(jumping, measured=1)
    np.testing.assert_allclose(alone.position[200], jumping.position[200], atol=0.1)
