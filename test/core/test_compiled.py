"""What is compiled is what the plain forms in numpy say."""

from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest

from semiparam_ros.core import ensemble, input_range, online_model, opinion_pool
from semiparam_ros.core.band_calibration import BandCalibration
from semiparam_ros.core.horizon_error import NO_OFFSETS, HorizonIndex
from semiparam_ros.core.hyperparameters import noise_covariance
from semiparam_ros.core.random_features import RandomFeatures
from semiparam_ros.core.recursion import SemiParametricRecursion, Update
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.signals import smoothing
from semiparam_ros.core.square_root_filter import SquareRootFilter
from semiparam_ros.core.wandering_offset import DECAY, WanderingOffset
from semiparam_ros.effects import hysteresis
from support import plain_forms as plain

N, TOLERANCE = 6, {'rtol': 1e-12, 'atol': 1e-12}


def errors_of_any_size(seed):
    rng = np.random.default_rng(seed)
    for index in range(3000):
        size = 30.0 if index % 700 == 3 else 1.0 + index // 1000
        yield size * rng.standard_normal(N) + 0.3, rng.uniform(0.5, 2.0, N)


@pytest.mark.parametrize(('follower', 'form'), [(WanderingOffset, plain.follow), (BandCalibration, plain.calibrate)])
def test_what_follows_the_errors(follower, form):
    filters = follower(N)
    for innovation, std in errors_of_any_size(0):
        expected = form(innovation, std, filters.table)
        filters.learn(innovation, std)
        np.testing.assert_allclose(filters.table, expected, **TOLERANCE)


def test_a_model_follows_what_is_learnt_as_its_parts_do():
    model = online_model.OnlineModel.__new__(online_model.OnlineModel)
    model.calibration, model.wandering = BandCalibration(N), WanderingOffset(N)
    calibration, wandering = BandCalibration(N), WanderingOffset(N)
    rng = np.random.default_rng(7)
    for index in range(200):
        outputs, mean, std = rng.standard_normal(N), 0.3 * rng.standard_normal(N), rng.uniform(0.5, 2.0, N)
        model._follow(outputs, SimpleNamespace(mean=mean, std=std), index % 7 > 0)
        innovation = outputs - mean - wandering.offset
        if index % 7 > 0:
            wandering.learn(outputs - mean, calibration.factor * std)
        else:
            wandering.rest()
        calibration.learn(innovation, std)
    for found, expected in ((model.calibration, calibration), (model.wandering, wandering)):
        np.testing.assert_allclose(found.table, expected.table, **TOLERANCE)


@pytest.mark.parametrize('members', [1, 2, 6])
def test_an_average(members):
    rng = np.random.default_rng(9)
    log_weights = np.zeros((members, N))
    for _ in range(50):
        means, model_means = rng.standard_normal((2, members, N))
        std, roots = rng.uniform(0.5, 2.0, (members, N)), rng.standard_normal((members, N, N))
        density = np.exp(plain.student(means / std)) / std
        evidence = np.log(density / density.max(axis=0) + ensemble.OUTLIER_DENSITY)
        expected = plain.weigh(log_weights, evidence, ensemble.EVIDENCE_MEMORY, ensemble.LEAST_LOG_WEIGHT)
        weights = ensemble.weigh_models(log_weights, means, std)
        for found, theirs in zip((log_weights, weights), expected, strict=True):
            np.testing.assert_allclose(found, theirs, **TOLERANCE)
        given = weights, means, std, model_means, roots @ roots.swapaxes(1, 2)
        desired = (weights, np.ascontiguousarray(rng.dirichlet(np.ones(members), N).T), means, model_means, given[-1],
                   rng.uniform(0.0, 3.0, members))
        for name, arrays in (('pool_both', given), ('pool_desired', desired)):
            for found, theirs in zip(getattr(opinion_pool, name)(*arrays), getattr(plain, name)(*arrays), strict=True):
                np.testing.assert_allclose(found, theirs, **TOLERANCE)
        known = rng.uniform(0.0, 1.0, members)
        known[0] = 1.0
        np.testing.assert_allclose(ensemble.weigh_elsewhere(log_weights, known, np.array([0])),
                                   plain.weigh_elsewhere(log_weights, known, np.array([0])), **TOLERANCE)


@pytest.mark.parametrize(('features', 'columns', 'decay'), [(20, 9, DECAY), (20, 0, NO_OFFSETS), (0, 9, DECAY)])
def test_the_errors_that_models_of_the_past_are_charged_with(features, columns, decay):
    rng, length = np.random.default_rng(1), 7
    model = SemiParametricRecursion(N, features, np.ones(columns), 1.0, 0.1)
    index, past = HorizonIndex(length, N, features, columns, decay), []
    for stamp in range(60):
        phi, coupled, known = rng.standard_normal(features), rng.standard_normal((N, columns)), rng.standard_normal(N)
        prior, outputs = model.predict(phi, coupled, known), rng.standard_normal(N)
        expected = [outputs - before.predict(phi, coupled, known).mean - (decay[:, None]**age * parts).sum(axis=0)
                    for age, (before, parts) in enumerate(past)]
        update = model.learn(prior, outputs) if stamp % 5 else Update(model.theta, np.zeros((0, N)), np.zeros(0))
        parts, charged = rng.standard_normal((len(decay), N)), np.zeros((length, N))
        index.advance(stamp, prior, outputs, update, parts, charged)
        np.testing.assert_allclose(charged[:len(past)], np.reshape(expected, (-1, N)), rtol=1e-9, atol=1e-10)
        past = [(deepcopy(model), parts), *past][:length]


@pytest.mark.parametrize('step', [1, 4])
@pytest.mark.parametrize('steps', [2, 90])
def test_noise_that_drifts(steps, step):
    left, right = np.random.default_rng(8).standard_normal((2, steps, 7))
    drift = noise_covariance.Drift(steps, 0.3, 20.0, step)
    lags = step * np.abs(np.subtract.outer(np.arange(steps), np.arange(steps)))
    correlation = np.exp(-lags / 20.0)
    dense = [np.sum(left * (weights @ right)) for weights in (correlation, lags / 20.0 * correlation)]
    np.testing.assert_allclose(drift.whiten(left), np.linalg.solve(np.eye(steps) + 0.3 * correlation, left),
                               rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(drift.correlation(left, right), dense, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(noise_covariance._correlated(left, right, drift.decay),
                               plain.correlated(left, right, drift.decay), rtol=1e-10)


@pytest.mark.parametrize('width', [2, 8])
def test_a_block_tridiagonal_system(width):
    rng = np.random.default_rng(4)
    block = np.arange(30) // (width // 2)
    full = np.triu(rng.standard_normal((30, 30))) * (block <= block[:, None] + 1) + 3.0 * np.eye(30)
    full = full.T @ full
    diagonals = np.array([[full[row, row + k] if row + k < 30 else 0.0 for k in range(width)] for row in range(30)])
    right = rng.standard_normal(30)
    factor, solution = smoothing._solved(diagonals.copy(), right.copy())
    expected, _ = plain.solved(diagonals, right)
    np.testing.assert_allclose(solution, np.linalg.solve(full, right), **TOLERANCE)
    inside = [(row, k) for row in range(30) for k in range(min(width, 30 - row))]
    np.testing.assert_allclose([factor[at] for at in inside], [expected[at] for at in inside], **TOLERANCE)
    with pytest.raises(np.linalg.LinAlgError):
        smoothing._solved(diagonals - 100.0 * (np.arange(width) == 0), right.copy())


def test_how_far_states_leave_their_transitions():
    rng = np.random.default_rng(6)
    given = (rng.standard_normal((20, 4)), np.triu(rng.standard_normal((19, 4, 4))), rng.standard_normal((19, 4, 4)))
    np.testing.assert_allclose(smoothing._jumps(*given), plain.jumps(*given), **TOLERANCE)


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
        assert lies == pytest.approx(plain.beyond(known, x, joints), rel=1e-12)
        assert np.isnan(input_range.beyond(known, sample._replace(velocity=np.array([0.0, np.inf, 0.0])))[1])
        wider = input_range.widened(known, x)
        np.testing.assert_array_equal(wider, np.array([np.vstack([known[:1], x]).min(axis=0),
                                                       np.vstack([known[1:], x]).max(axis=0)]))
        assert input_range.beyond(wider, sample)[1] == 0.0
        known = wider
    assert lies == 0.0
    lengths = np.array([1.0, 1.0, 0.02])  # of a joint that slides: the same in other units is as far
    x = 2.0 * rng.standard_normal(9)
    one, other = (Sample(0, *(x / unit).reshape(3, joints), np.zeros(N)) for unit in (np.ones(9), np.tile(lengths, 3)))
    far = input_range.beyond(known / np.tile(lengths, 3), other)[1]
    assert input_range.beyond(known, one, lengths)[1] == pytest.approx(far, rel=1e-9)
    assert input_range.beyond(known, one)[1] < 0.5 * far


@pytest.mark.parametrize('features', [1, 2, 7, 40])
@pytest.mark.parametrize('estimates', [0, 1, 6])
def test_the_features(features, estimates):
    rng = np.random.default_rng(2)
    weights = SquareRootFilter(features, 0.7, estimates)
    for _ in range(30):
        phi = rng.standard_normal(features)
        found, expected = weights.project(phi), plain.project(weights.root, phi)
        for mine, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, **TOLERANCE)
        weights.learn(found, 0.1, rng.standard_normal(estimates))
        weights.inflate(1.02)


@pytest.mark.parametrize('columns', [0, 1, 5, 22])
def test_the_columns(columns):
    rng = np.random.default_rng(3)
    model = SemiParametricRecursion(N, 12, np.ones(columns), 1.0, 0.1, forgetting=0.999,
                                    scale=np.linspace(0.5, 2.0, N), autocorrelation_time=4.0)
    for index in range(60):
        phi, coupled, outputs = rng.standard_normal(12), rng.standard_normal((N, columns)), rng.standard_normal(N)
        coupled[:, :1] *= index % 3  # a column of zeros at times
        given = phi, coupled, rng.standard_normal(N), rng.uniform(0.0, 1.0, N)
        prior, (mean, covariance) = model.predict(*given), plain.predict(model, *given)
        for found, expected in ((prior.mean, mean), (prior.covariance, covariance),
                                (prior.std, np.sqrt(covariance.diagonal()))):
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
        theta, innovations = plain.learn(model, prior, outputs)
        update = model.learn(prior, outputs)
        np.testing.assert_allclose(update.theta, theta, rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(update.innovations, innovations)


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
    with monkeypatch.context() as slow:
        slow.setattr(hysteresis, '_follow_all', lambda keep, aims, state: plain.towards(aims, keep, state))
        slow.setattr(hysteresis, '_follow_play', plain.play)
        slow.setattr(hysteresis, '_followed', lambda *way_and_begin: plain.followed(hysteresis.Way(*way_and_begin[:3])))
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
