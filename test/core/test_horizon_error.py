"""The horizon index against a brute force that keeps a copy of each of the last T models."""

import copy

import numpy as np
import pytest

from semiparam_ros.core.horizon_error import AveragedHorizons, HorizonIndex, force_and_torque
from semiparam_ros.core.recursion import SemiParametricRecursion, Update
from semiparam_ros.errors import SemiparamError
from support.plain_forms import pool_weights

N, D, P = 6, 12, 5


def problem(count, d=D, p=P, seed=0):
    rng = np.random.default_rng(seed)
    phi, columns = rng.normal(size=(count, d)) / np.sqrt(max(d, 1)), rng.normal(size=(count, N, p))
    fixed = rng.normal(size=(count, N))
    outputs = fixed + columns @ rng.normal(size=p) + phi @ rng.normal(size=(d, N)) + 0.1 * rng.normal(size=(count, N))
    return phi, columns, fixed, outputs + np.arange(N)  # an offset, which the centred form must not see


def recursion(d=D, p=P, forgetting=1.0):
    return SemiParametricRecursion(N, d, np.ones(p), 1.0, 0.1, forgetting=forgetting)


def advance(index, stamp, prior, outputs, model, learn=True):
    nothing = np.zeros((0, model.n_outputs))
    update = model.learn(prior, outputs) if learn else Update(model.theta, nothing, np.zeros(0))
    return index.advance(stamp, prior, outputs, update, nothing, nothing)


def running(length, model, rows, learn=lambda index: True):
    index = HorizonIndex(length, N, model.n_features, model.n_columns)
    found = []
    for t, (phi, columns, fixed, outputs) in enumerate(zip(*rows, strict=True)):
        prior = model.predict(phi, columns, fixed)
        found.append(advance(index, 1000 + t, prior, outputs, model, learn(t)))
    return found


def brute_force(length, model, rows, learn=lambda index: True):
    phi, columns, fixed, outputs = rows
    models = []
    for t in range(len(phi)):
        if learn(t):
            model.learn(model.predict(phi[t], columns[t]), outputs[t] - fixed[t])
        models.append(copy.deepcopy(model))
    found = [None] * min(length, len(phi))
    for t in range(len(phi) - length):
        future = slice(t + 1, t + 1 + length)
        predicted = [models[t].predict(*row).mean for row in zip(phi[future], columns[future], strict=True)]
        error = np.sum((outputs[future] - fixed[future] - predicted) ** 2, axis=0)
        y = outputs[future]
        spread = np.sum((y - y.mean(axis=0)) ** 2, axis=0)
        found.append((1000 + t, error / np.sum(y**2, axis=0), error / np.maximum(spread, 1e-18 * length)))
    return found


def assert_same(found, expected):
    assert [each is None for each in found] == [each is None for each in expected]
    for ours, (origin, eps, centred) in zip(filter(None, found), filter(None, expected), strict=True):
        assert ours.origin == origin
        np.testing.assert_allclose(ours.eps, eps, rtol=1e-9)
        np.testing.assert_allclose(ours.eps_centred, centred, rtol=1e-9)


@pytest.mark.parametrize(('d', 'p'), [(D, P), (0, P), (D, 0)])
@pytest.mark.parametrize('length', [1, 2, 25, 33, 70])
def test_it_equals_the_brute_force(length, d, p):
    rows = problem(80, d, p)
    assert_same(running(length, recursion(d, p), rows), brute_force(length, recursion(d, p), rows))


def test_it_equals_the_brute_force_while_forgetting_and_with_pauses_in_learning():
    rows = problem(120)
    learn = lambda t: t % 7 != 3 and not 40 < t < 75  # noqa: E731
    assert_same(running(25, recursion(forgetting=0.97), rows, learn),
                brute_force(25, recursion(forgetting=0.97), rows, learn))


@pytest.mark.parametrize('moment', [3, 24, 25, 26, 40])
def test_after_clear_a_horizon_starts_afresh(moment):
    rows = problem(120)
    model = recursion()
    index = HorizonIndex(25, N, D, P)
    found = []
    for t, (phi, columns, fixed, outputs) in enumerate(zip(*rows, strict=True)):
        if t == moment:
            index.clear()
        prior = model.predict(phi, columns, fixed)
        found.append(advance(index, 1000 + t, prior, outputs, model))
    expected = brute_force(25, recursion(), rows)
    for t in range(120):
        whole = t >= 25 and not t - 25 < moment <= t
        assert (found[t] is None) == (not whole)
        if whole:
            assert_same([found[t]], [expected[t]])


def test_a_perfect_model_has_no_error_and_a_constant_output_a_finite_one():
    model = SemiParametricRecursion(1, 0, np.array([1.0]), 1.0, 0.1, prior_mean=np.array([2.0]))
    index = HorizonIndex(3, 1, 0, 1)
    for t in range(6):
        prior = model.predict(np.zeros(0), np.ones((1, 1)))
        errors = advance(index, t, prior, np.array([2.0 if t < 4 else 0.0]), model, learn=False)
    assert errors is not None
    assert np.isfinite([errors.eps, errors.eps_centred]).all()
    prior = model.predict(np.zeros(0), np.ones((1, 1)))
    assert advance(index, 6, prior, np.zeros(1), model, learn=False).eps[0] > 1e6


def test_an_average_is_charged_with_the_weights_of_its_moment():
    rng, length, count = np.random.default_rng(0), 4, 30
    errors, weights = rng.normal(size=(count, 3, length, N)), rng.dirichlet(np.ones(3), size=(count, N))
    std, outputs = rng.uniform(0.5, 2.0, (count, 3, N)), rng.normal(size=(count, N))
    index = AveragedHorizons(length, N, 3)
    found = [index.advance(t, errors[t], outputs[t], np.ascontiguousarray(weights[t].T), std[t])
             for t in range(count)]
    assert found[:length] == [None] * length
    for t in range(count - length):
        # The model of t is the newest one at t + 1.
        left = [(pool_weights(weights[t].T, std[t + s]) * errors[t + s, :, s - 1]).sum(axis=0)
                for s in range(1, length + 1)]
        y = outputs[t + 1:t + 1 + length]
        assert found[t + length].origin == t
        squared = np.sum(np.square(left), axis=0)
        np.testing.assert_allclose(found[t + length].eps, squared / np.sum(y**2, axis=0))
        np.testing.assert_allclose(found[t + length].eps_centred, squared / np.sum((y - y.mean(axis=0))**2, axis=0))


def test_force_and_torque_are_means_of_three_channels():
    assert force_and_torque(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])) == pytest.approx((2.0, 0.2))


def test_an_empty_horizon_is_refused():
    with pytest.raises(SemiparamError, match=r'horizon\.length is 0'):
        HorizonIndex(0, 6, 10, 5)
