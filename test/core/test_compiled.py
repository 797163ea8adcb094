"""What numba compiles is what the readable forms in numpy say."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from semiparam_ros.core import (
    band_calibration,
    compiled,
    ensemble,
    horizon_error,
    input_range,
    online_model,
    opinion_pool,
    recursion,
    square_root_filter,
    wandering_offset,
)
from semiparam_ros.core.horizon_error import HorizonIndex
from semiparam_ros.core.hyperparameters import noise_covariance
from semiparam_ros.core.random_features import RandomFeatures
from semiparam_ros.core.recursion import SemiParametricRecursion
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.signals import smoothing
from semiparam_ros.core.square_root_filter import SquareRootFilter
from semiparam_ros.core.wandering_offset import DECAY
from semiparam_ros.effects import hysteresis
from semiparam_ros.experiments import benchmark
from support.node_helpers import BODY, motion

pytestmark = pytest.mark.skipif(not compiled.AVAILABLE, reason='numba is not installed')
N, TOLERANCE = 6, {'rtol': 1e-12, 'atol': 1e-12}


@pytest.fixture(params=[band_calibration.BandCalibration, wandering_offset.WanderingOffset])
def follower(request):
    return request.param


def test_what_follows_the_errors(follower):
    rng = np.random.default_rng(0)
    fast, readable = follower(N), follower(N)
    for index in range(3000):
        size = 30.0 if index % 700 == 3 else 1.0 + index // 1000
        innovation, std = size * rng.standard_normal(N) + 0.3, rng.uniform(0.5, 2.0, N)
        fast.learn(innovation, std)
        readable._learn(innovation, std)
        for name, values in fast.state().items():
            np.testing.assert_allclose(values, readable.state()[name], **TOLERANCE)
    shown = ('factor',) if hasattr(fast, 'factor') else ('parts', 'offset')
    for name in shown:
        np.testing.assert_allclose(getattr(fast, name), getattr(readable, name), **TOLERANCE)


def test_an_estimator_follows_what_is_learnt_as_its_parts_do(monkeypatch):
    fast, readable = (online_model.OnlineModel.__new__(online_model.OnlineModel) for _ in range(2))
    for each in (fast, readable):
        each.calibration, each.wandering = band_calibration.BandCalibration(N), wandering_offset.WanderingOffset(N)
    rng = np.random.default_rng(7)
    for index in range(200):
        outputs, mean, std = rng.standard_normal(N), 0.3 * rng.standard_normal(N), rng.uniform(0.5, 2.0, N)
        said = outputs, SimpleNamespace(mean=mean, std=std), index % 7 > 0
        fast._follow(*said)
        with monkeypatch.context() as without:
            for module in (online_model, band_calibration, wandering_offset):
                without.setattr(module, 'AVAILABLE', False)
            readable._follow(*said)
    for follower in ('calibration', 'wandering'):
        for name, values in getattr(fast, follower).state().items():
            np.testing.assert_allclose(values, getattr(readable, follower).state()[name], **TOLERANCE)


@pytest.mark.parametrize('members', [1, 2, 6])
def test_an_average(monkeypatch, members):
    rng = np.random.default_rng(9)
    fast, readable = (ensemble.MemberWeights(members, N) for _ in range(2))
    for _ in range(50):
        means, model_means = rng.standard_normal((2, members, N))
        std, roots = rng.uniform(0.5, 2.0, (members, N)), rng.standard_normal((members, N, N))
        fast.learn(means, std)
        readable._learn(means, std)
        np.testing.assert_allclose(fast.weights, readable.weights, **TOLERANCE)
        said = fast.weights, means, std, model_means, roots @ roots.swapaxes(1, 2)
        found = opinion_pool.pool_both(*said)
        with monkeypatch.context() as without:
            without.setattr(opinion_pool, 'AVAILABLE', False)
            expected = opinion_pool.pool_both(*said)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, **TOLERANCE)


@pytest.mark.parametrize(('features', 'columns', 'decay'), [(20, 9, DECAY), (20, 0, None), (0, 9, DECAY)])
def test_the_horizon(monkeypatch, features, columns, decay):
    rng = np.random.default_rng(1)
    model = SemiParametricRecursion(N, features, np.ones(columns), 1.0, 0.1)
    fast, readable = (HorizonIndex(7, N, features, columns, decay) for _ in range(2))
    for stamp in range(60):
        prior = model.predict(rng.standard_normal(features), rng.standard_normal((N, columns)), rng.standard_normal(N))
        outputs = rng.standard_normal(N)
        innovations = model.learn(prior, outputs) if stamp % 5 else None
        parts = None if decay is None else rng.standard_normal((len(decay), N))
        charged, expected_charged = np.zeros((2, 7, N))
        said = stamp, prior, outputs, model.theta, innovations, parts
        errors = fast.advance(*said, charged)
        with monkeypatch.context() as without:
            without.setattr(horizon_error, 'AVAILABLE', False)
            expected = readable.advance(*said, expected_charged)
        np.testing.assert_allclose(charged, expected_charged, rtol=1e-11, atol=1e-12)
        if errors is not None:
            np.testing.assert_allclose(errors.eps_centred, expected.eps_centred, rtol=1e-11)
            np.testing.assert_allclose(errors.eps, expected.eps, rtol=1e-11)
    assert errors is not None


@pytest.mark.parametrize('step', [1, 4])
@pytest.mark.parametrize('steps', [2, 90])
def test_noise_that_drifts(monkeypatch, steps, step):
    left, right = np.random.default_rng(8).standard_normal((2, steps, 7))
    drift = noise_covariance.Drift(steps, 0.3, 20.0, step)
    lags = step * np.abs(np.subtract.outer(np.arange(steps), np.arange(steps)))
    correlation = np.exp(-lags / 20.0)
    dense = [np.sum(left * (weights @ right)) for weights in (correlation, lags / 20.0 * correlation)]
    for _ in ('compiled', 'readable'):
        np.testing.assert_allclose(drift.whiten(left), np.linalg.solve(np.eye(steps) + 0.3 * correlation, left),
                                   rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(drift.correlation(left, right), dense, rtol=1e-10, atol=1e-10)
        monkeypatch.setattr(noise_covariance, 'AVAILABLE', False)


@pytest.mark.parametrize('width', [2, 8])
def test_a_block_tridiagonal_system(monkeypatch, width):
    rng = np.random.default_rng(4)
    block = np.arange(30) // (width // 2)
    full = np.triu(rng.standard_normal((30, 30))) * (block <= block[:, None] + 1) + 3.0 * np.eye(30)
    full = full.T @ full
    diagonals = np.array([[full[row, row + k] if row + k < 30 else 0.0 for k in range(width)] for row in range(30)])
    right = rng.standard_normal(30)
    upper = np.linalg.cholesky(full).T
    for _ in ('compiled', 'readable'):
        factor, solution = smoothing._solved(diagonals.copy(), right.copy())
        np.testing.assert_allclose(solution, np.linalg.solve(full, right), **TOLERANCE)
        np.testing.assert_allclose([factor[row, k] for row in range(30) for k in range(min(width, 30 - row))],
                                   [upper[row, row + k] for row in range(30) for k in range(min(width, 30 - row))],
                                   **TOLERANCE)
        with pytest.raises(np.linalg.LinAlgError):
            smoothing._solved(diagonals - 100.0 * (np.arange(width) == 0), right.copy())
        monkeypatch.setattr(smoothing, 'AVAILABLE', False)


def test_how_far_states_leave_their_transitions(monkeypatch):
    rng = np.random.default_rng(6)
    states, transition = rng.standard_normal((20, 4)), np.triu(rng.standard_normal((19, 4, 4)))
    precision = rng.standard_normal((19, 4, 4))
    told = smoothing._jumps(states, transition, precision)
    monkeypatch.setattr(smoothing, 'AVAILABLE', False)
    np.testing.assert_allclose(told, smoothing._jumps(states, transition, precision), **TOLERANCE)


@pytest.mark.parametrize('count', [2, 30])
def test_one_input_has_the_features_that_a_batch_gives_it(count):
    rng = np.random.default_rng(5)
    features = RandomFeatures(9, count, 0, (0.5, 1.0, 2.0), rng.standard_normal(9), rng.uniform(0.5, 2.0, 9))
    inputs = 3.0 * rng.standard_normal((20, 9))
    np.testing.assert_allclose([features(x) for x in inputs], features.batch(inputs), **TOLERANCE)


def test_the_range_of_the_inputs():
    rng = np.random.default_rng(6)
    known, joints = np.zeros((0, 9)), 3
    for size in [*np.full(20, 0.1), *np.full(20, 1.0), 0.0, 0.1]:
        x = size * rng.standard_normal(9)
        x[2::3] *= 0.01  # a joint that hardly moves
        sample = Sample(0, *x.reshape(3, joints), np.zeros(N))
        collected, lies = input_range.beyond(known, sample)
        np.testing.assert_array_equal(collected, x)
        assert lies == pytest.approx(input_range._beyond_readable(known, x, joints), rel=1e-12)
        assert np.isnan(input_range.beyond(known, sample._replace(velocity=np.array([0.0, np.inf, 0.0])))[1])
        wider = input_range.widened(known, x)
        np.testing.assert_array_equal(wider, np.array([np.vstack([known[:1], x]).min(axis=0),
                                                       np.vstack([known[1:], x]).max(axis=0)]))
        assert input_range.beyond(wider, sample)[1] == 0.0
        known = wider
    assert lies == 0.0


@pytest.mark.parametrize('features', [1, 2, 7, 40])
@pytest.mark.parametrize('estimates', [0, 1, 6])
def test_the_features(features, estimates):
    rng = np.random.default_rng(2)
    weights = SquareRootFilter(features, 0.7, estimates)
    for _ in range(30):
        phi = rng.standard_normal(features)
        found, expected = weights.project(phi), weights._project(phi)
        for mine, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, **TOLERANCE)
        weights.learn(found, 0.1, rng.standard_normal(estimates))
        weights.inflate(1.02)


@pytest.mark.parametrize('columns', [0, 1, 5, 22])
def test_the_columns(monkeypatch, columns):
    rng = np.random.default_rng(3)
    fast, readable = (SemiParametricRecursion(N, 12, np.ones(columns), 1.0, 0.1, forgetting=0.999,
                                              scale=np.linspace(0.5, 2.0, N)) for _ in range(2))
    for index in range(60):
        phi, coupled, outputs = rng.standard_normal(12), rng.standard_normal((N, columns)), rng.standard_normal(N)
        coupled[:, :1] *= index % 3  # a column of zeros at times
        known = rng.standard_normal(N)
        found = fast.predict(phi, coupled, known)
        fast.learn(found, outputs)
        with monkeypatch.context() as without:
            for module in (recursion, square_root_filter):
                without.setattr(module, 'AVAILABLE', False)
            expected = readable.predict(phi, coupled, known)
            readable.learn(expected, outputs)
        for name in ('mean', 'covariance', 'std', 'regressed', 'columns_left'):
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(fast.theta, readable.theta, rtol=1e-10, atol=1e-11)


def test_a_sample_learnt_in_one_call_is_one_learnt_in_several(monkeypatch):
    at_once, apart = (benchmark.estimator(BODY, 20) for _ in range(2))
    for sample in motion(120):
        found = at_once.step(sample)
        with monkeypatch.context() as without:
            without.setattr(online_model, 'AVAILABLE', False)
            expected = apart.step(sample)
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(found.std, expected.std, rtol=1e-11)
        assert (found.horizon is None) == (expected.horizon is None)
        if found.horizon is not None:
            assert found.horizon.origin == expected.horizon.origin
            np.testing.assert_allclose(found.horizon.eps, expected.horizon.eps, rtol=1e-10)
            np.testing.assert_allclose(found.horizon.eps_centred, expected.horizon.eps_centred, rtol=1e-10)
    assert found.horizon is not None and found.motion.is_news


@pytest.mark.parametrize('follow', [
    lambda travel, way, memory: hysteresis.dahl_state(travel, 0.05, memory),
    lambda travel, way, memory: hysteresis.bouc_wen_state(travel[:, 0], 0.05, 0.1, memory),
    lambda travel, way, memory: hysteresis.bristle(way, 0.02, memory),
    lambda travel, way, memory: hysteresis.sticking_bristle(way, 0.02, 0.05, 0.1, memory),
    lambda travel, way, memory: hysteresis.play_place(way, 0.1, memory)],
    ids=['dahl', 'bouc-wen', 'bristle', 'sticking', 'play'])
def test_what_remembers_the_way_travelled(monkeypatch, follow):
    travel = np.cumsum(0.02 * np.random.default_rng(4).standard_normal((200, 3)), axis=0)
    travel[50:60] = travel[50]
    way = hysteresis.Way(np.arange(200) * 10**8, travel[:, 1], np.gradient(travel[:, 1], 0.1))
    fast, remembered = follow(travel, way, None)
    halves = [follow(travel[:80], hysteresis.Way(*(part[:80] for part in way)), None)]
    halves.append(follow(travel[80:], hysteresis.Way(*(part[80:] for part in way)), halves[0][1]))
    with monkeypatch.context() as without:
        without.setattr(hysteresis, 'AVAILABLE', False)
        readable, expected = follow(travel, way, None)
    np.testing.assert_allclose(fast, readable, **TOLERANCE)
    np.testing.assert_array_equal(np.concatenate([states for states, _ in halves]), fast)
    np.testing.assert_allclose(remembered[0], expected[0], **TOLERANCE)


def test_friction_turns_over_where_the_joint_does_between_two_samples():
    """A bristle along a fine path, and along every fiftieth sample of it."""
    time = np.arange(0.0, 20.0, 1e-3)
    position, velocity = 0.3 * np.sin(3.1 * time), 0.93 * np.cos(3.1 * time)
    fine = hysteresis.Way((time * 1e9).astype(np.int64), position, velocity)
    coarse = hysteresis.Way(*(part[::50] for part in fine))
    true, seen = (hysteresis.bristle(way, 2e-3, None)[0] for way in (fine, coarse))
    straight = hysteresis.dahl_state(coarse.position[:, None], 2e-3, None)[0][:, 0]
    assert np.abs(seen - true[::50]).max() < 1e-3 < 0.5 < np.abs(straight - true[::50]).max()
    true, seen = (hysteresis.sticking_bristle(way, 2e-3, 5e-3, 0.1, None)[0] for way in (fine, coarse))
    assert np.abs(seen - true[::50]).max() < 0.02


def test_without_numba_the_forms_in_numpy_run():
    text = ('from semiparam_ros.core import compiled, estimator; from semiparam_ros.core.band_calibration import '
            'BandCalibration as B; import numpy as np; b = B(2); b.learn(np.ones(2), np.ones(2)); '
            'print(compiled.AVAILABLE, b.factor.shape)')
    done = subprocess.run([sys.executable, '-c', text], env={**os.environ, 'SEMIPARAM_COMPILED': '0'}, check=True,
                          capture_output=True, text=True)
    assert done.stdout == 'False (2,)\n'
