"""The recursion against the dense textbook form on all p + D n unknowns, and against the batch solution."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semiparam_ros.core.recursion import SemiParametricRecursion
from semiparam_ros.core.robot.joint_friction import turning_variance
from semiparam_ros.errors import SemiparamError

SAME = {'rtol': 1e-8, 'atol': 1e-8}


class Dense:
    """Textbook recursive least squares in covariance form on u = [theta, alpha of output 1, alpha of output 2, ...]."""

    def __init__(self, n, d, prior_std, rho, sigma, prior_mean, forgetting):
        self.n, self.d, self.p = n, d, len(prior_std)
        self.noise, self.forgetting = sigma**2 * np.eye(n), forgetting
        self.mean = np.concatenate([prior_mean, np.zeros(n * d)])
        self.covariance = np.diag(np.concatenate([np.square(prior_std), np.full(n * d, rho**2)]))
        self.prior_variance = np.diag(self.covariance).copy()
        self.renewed = 0

    def rows(self, phi, columns):
        return np.hstack([columns, np.kron(np.eye(self.n), phi)])

    def predict(self, phi, columns):
        rows = self.rows(phi, columns)
        return rows @ self.mean, rows @ self.covariance @ rows.T + self.noise

    def learn(self, phi, columns, outputs):
        rows = self.rows(phi, columns)
        mean, innovation_covariance = self.predict(phi, columns)
        gain = np.linalg.solve(innovation_covariance, rows @ self.covariance).T
        self.mean = self.mean + gain @ (outputs - mean)
        self.covariance = self.covariance - gain @ rows @ self.covariance
        self.covariance = self.covariance / self.forgetting
        if self.forgetting < 1.0:
            self.renew()
        self.covariance = 0.5 * (self.covariance + self.covariance.T)

    def renew(self):
        """What the recursion says of its renewals: a weight given theta, and a coefficient, stay what they are."""
        if self.d:
            index = self.renewed % self.d
            covariance = self.covariance
            to_theta = np.linalg.solve(covariance[:self.p, :self.p], covariance[:self.p, self.p:]).T
            rows = np.array([np.eye(self.n * self.d)[k * self.d + index] for k in range(self.n)])
            self.observe(np.hstack([-rows @ to_theta, rows]), self.prior_variance[-1] / (1 - self.forgetting**self.d))
        if self.p:
            index = self.renewed % self.p
            self.observe(np.eye(self.p + self.n * self.d)[[index]],
                         self.prior_variance[index] / (1 - self.forgetting**self.p))
        self.renewed += 1

    def observe(self, rows, variance):
        gain = np.linalg.solve(rows @ self.covariance @ rows.T + variance * np.eye(len(rows)), rows @ self.covariance)
        self.covariance = self.covariance - self.covariance @ rows.T @ gain


def batch(phi, columns, outputs, prior_std, rho, sigma, prior_mean, forgetting=1.0):
    """Mean of u by one least-squares problem: weighted data rows, then the prior's rows."""
    count, n = outputs.shape
    age = np.arange(count)[::-1]
    weight = forgetting ** (0.5 * age) / sigma
    rows = np.concatenate([columns, np.einsum('ij,td->tijd', np.eye(n), phi).reshape(count, n, -1)], axis=2)
    deviation = np.concatenate([prior_std, np.full(n * phi.shape[1], rho)])
    stacked = np.vstack([(weight[:, None, None] * rows).reshape(count * n, -1), np.diag(1 / deviation)])
    right = np.concatenate([(weight[:, None] * outputs).ravel(), prior_mean / prior_std,
                            np.zeros(n * phi.shape[1])])
    return np.linalg.lstsq(stacked, right, rcond=None)[0]


def problem(seed, count, n, d, p):
    rng = np.random.default_rng(seed)
    phi, columns = rng.normal(size=(count, d)) / np.sqrt(max(d, 1)), rng.normal(size=(count, n, p))
    outputs = columns @ rng.normal(size=p) + phi @ rng.normal(size=(d, n)) + 0.1 * rng.normal(size=(count, n))
    return phi, columns, outputs


def run(recursion, phi, columns, outputs):
    for row in zip(phi, columns, outputs, strict=True):
        recursion.learn(recursion.predict(*row[:2]), row[2])
    return recursion


def unknowns(recursion):
    return np.concatenate([recursion.theta, recursion.weights().ravel()])


sizes = st.fixed_dictionaries({
    'n': st.integers(1, 4), 'd': st.sampled_from([0, 1, 2, 7]), 'p': st.sampled_from([0, 1, 3, 5]),
    'seed': st.integers(0, 10_000), 'rho': st.floats(0.01, 10), 'sigma': st.floats(0.03, 3),
    'gamma': st.floats(0.01, 100), 'forgetting': st.sampled_from([1.0, 0.999, 0.95]), 'centred': st.booleans(),
    'changes': st.lists(st.integers(0, 29), max_size=2)})


@given(sizes)
@settings(max_examples=60)
def test_it_equals_the_dense_recursion(case):
    """Also when the robot changes: what is known is then the mean of a new prior."""
    n, d, p = case['n'], case['d'], case['p']
    phi, columns, outputs = problem(case['seed'], 30, n, d, p)
    std = case['gamma'] * np.linspace(0.5, 2, p)
    mean = np.linspace(-1, 1, p) * case['centred']
    ours = SemiParametricRecursion(n, d, std, case['rho'], case['sigma'], mean, case['forgetting'])
    dense = Dense(n, d, std, case['rho'], case['sigma'], mean, case['forgetting'])
    for index, row in enumerate(zip(phi, columns, outputs, strict=True)):
        if index in case['changes']:
            ours.follow_change()
            dense.covariance = np.diag(dense.prior_variance)
        prior = ours.predict(*row[:2])
        expected_mean, expected_covariance = dense.predict(*row[:2])
        np.testing.assert_allclose(prior.mean, expected_mean, **SAME)
        np.testing.assert_allclose(prior.covariance, expected_covariance, **SAME)
        ours.learn(prior, row[2])
        dense.learn(*row)
    np.testing.assert_allclose(unknowns(ours), dense.mean, **SAME)
    np.testing.assert_allclose(ours.theta_covariance(), dense.covariance[:p, :p], **SAME)


@given(sizes, st.integers(1, 4))
@settings(max_examples=60)
def test_a_change_along_directions_adds_their_covariance(case, rank):
    """No answer moves; of features, what is known of them together with theta goes on as far as it can."""
    n, d, p = case['n'], case['d'], case['p']
    phi, columns, outputs = problem(case['seed'], 30, n, d, p)
    std = case['gamma'] * np.linspace(0.5, 2, p)
    ours = SemiParametricRecursion(n, d, std, case['rho'], case['sigma'], None, case['forgetting'])
    dense = Dense(n, d, std, case['rho'], case['sigma'], np.zeros(p), case['forgetting'])
    directions, changed = np.random.default_rng(case['seed']).standard_normal((p, rank)), False
    for index, row in enumerate(zip(phi, columns, outputs, strict=True)):
        if index in case['changes']:
            known, before = unknowns(ours), ours.predict(*row[:2])
            ours.follow_change(directions)
            dense.covariance[:p, :p] += directions @ directions.T
            np.testing.assert_allclose(unknowns(ours), known, **SAME)
            np.testing.assert_allclose(ours.predict(*row[:2]).mean, before.mean, **SAME)
            if d and p and not changed:  # how the weights to expect follow theta
                along = np.linalg.solve(dense.covariance[:p, :p], dense.covariance[:p, p:]).reshape(p, n, d)
                slopes = ours._weights.estimates().reshape(n, p + 1, d)[:, :-1]
                np.testing.assert_allclose(-slopes.swapaxes(0, 1), along, rtol=1e-6, atol=1e-6 * np.abs(along).max())
            changed = True
        prior = ours.predict(*row[:2])
        if not d:
            np.testing.assert_allclose(prior.covariance, dense.predict(*row[:2])[1], **SAME)
        ours.learn(prior, row[2])
        dense.learn(*row)
    if not d:
        np.testing.assert_allclose(unknowns(ours), dense.mean, **SAME)
        np.testing.assert_allclose(ours.theta_covariance(), dense.covariance[:p, :p], **SAME)


@pytest.mark.parametrize('d', [0, 7])
def test_what_returns_is_as_it_was(d):
    (phi, columns, outputs), directions = problem(3, 60, 2, d, 5), np.random.default_rng(0).standard_normal((5, 2))
    model, left = SemiParametricRecursion(2, d, np.ones(5), 1.0, 0.1), []
    for part in range(3):
        for row in zip(phi[20 * part:][:20], columns[20 * part:][:20], outputs[20 * part:][:20], strict=True):
            model.learn(model.predict(*row[:2]), row[2] + part)
        left.append((unknowns(model), model.theta_covariance(), model.predict(phi[0], columns[0])))
        if part:
            model.go_back()
            known, covariance, prior = left[part - 1]
            np.testing.assert_allclose(unknowns(model), known, **SAME)
            np.testing.assert_allclose(model.theta_covariance(), covariance, **SAME)
            now = model.predict(phi[0], columns[0])
            np.testing.assert_allclose(now.mean, prior.mean, **SAME)
            np.testing.assert_allclose(now.std, prior.std, **SAME)
        else:
            model.follow_change(directions)


@pytest.mark.parametrize('period', [0.01, 0.05])
def test_a_model_returns_within_a_tenth_of_a_second_where_it_is_far_better_and_not_for_a_spike(period):
    model, rng = SemiParametricRecursion(2, 0, np.ones(4), 1.0, 0.1), np.random.default_rng(0)
    std = np.array([0.1, 0.3])
    model.follow_change()

    def better(now, then, times):
        """How many samples it takes, None where so many are not enough."""
        noise = std * rng.standard_normal((times, 2))
        return next((number for number, each in enumerate(noise, 1)
                     if model.alternative.charge(period, each + now, each * rng.choice([-1.0, 1.0]) + then, std)), None)

    load = np.array([8.0, 0.0])
    assert better(0.0, 0.0, 20_000) is None, 'neither is better'
    assert better(-load, -2.0 * load, 1) is None and not model.as_before_s, 'the one in force is'
    assert better(2.0 * load, load, 1) is None, 'a spike'
    assert better(0.0, load, 1000) is None and not model.as_before_s
    assert 3 <= better(load, 0.0, 100) <= max(3, 0.1 / period)
    model.go_back()
    assert better(load, 0.0, 2) is None, 'it begins anew'
    model.go_back()
    assert not model.alternative.charge(0.01, 3.0 * std, 0.0 * std, std) and not model.as_before_s, 'chance'
    assert not model.alternative.charge(0.5, 3.0 * std, 0.0 * std, std) and model.as_before_s == pytest.approx(0.51)
    saved = SemiParametricRecursion(2, 0, np.ones(4), 1.0, 0.1)
    saved.restore(model.state())
    assert saved.as_before_s == model.as_before_s
    assert saved.alternative.charge(0.5, 3.0 * std, 0.0 * std, std)


def test_a_change_upon_another_one_is_forgotten_and_what_was_before_both_is_known_yet():
    """A load, and then something of no kind that was none: put down, the model returned to what that had left."""
    rng, directions = np.random.default_rng(0), np.random.default_rng(1).standard_normal((4, 2))
    model, left = SemiParametricRecursion(2, 0, np.ones(4), 1.0, 0.1), []

    def learn(theta):
        for columns in rng.standard_normal((30, 2, 4)):
            model.learn(model.predict(np.zeros(0), columns), columns @ theta)
        left.append(model.theta.copy())

    learn(np.ones(4))
    model.follow_change(directions)
    learn(np.ones(4) + directions.sum(axis=1))
    model.follow_change()
    learn(np.zeros(4))
    restored = SemiParametricRecursion(2, 0, np.ones(4), 1.0, 0.1)
    restored.restore(model.state())
    for each in (model, restored):
        each.go_back()
        np.testing.assert_array_equal(each.theta, left[1])
        each.go_back()
        np.testing.assert_array_equal(each.theta, left[0])
        each.go_back()
        np.testing.assert_array_equal(each.theta, left[1])
    for _ in range(3):
        model.follow_change()
    assert model.before.before is not None and model.before.before.before is None
    known = model.state()
    known.update({f'before.{name}': values for name, values in known.items() if name.startswith(2 * 'before.')})
    with pytest.raises(SemiparamError, match='before three changes; expected two at most'):
        model.restore(known)


def test_a_load_upon_another_one_comes_and_goes():
    directions = np.random.default_rng(1).standard_normal((4, 2))
    model, left = SemiParametricRecursion(2, 0, np.ones(4), 1.0, 0.1), []
    for columns in np.random.default_rng(0).standard_normal((3, 30, 2, 4)):
        for row in columns:
            model.learn(model.predict(np.zeros(0), row), row @ np.full(4, len(left)))
        left.append(model.theta.copy())
        if len(left) < 3:
            model.follow_change(directions)
    for expected in (1, 2, 1):
        model.go_back()
        np.testing.assert_array_equal(model.theta, left[expected])


def test_outputs_of_different_scales_are_those_of_one_scale_in_other_units():
    phi, columns, outputs = problem(6, 40, 3, 5, 4)
    scale, known = np.array([0.01, 3.0, 200.0]), np.random.default_rng(0).normal(size=(40, 3))
    one, scaled = (SemiParametricRecursion(3, 5, np.ones(4), 0.7, 0.2, scale=each) for each in (None, scale))
    for row, coupled, y, beforehand in zip(phi, columns, outputs, known, strict=True):
        prior = one.predict(row, coupled)
        found = scaled.predict(row, scale[:, None] * coupled, scale * beforehand)
        np.testing.assert_allclose(found.mean, scale * (prior.mean + beforehand), **SAME)
        np.testing.assert_allclose(found.covariance, np.outer(scale, scale) * prior.covariance, **SAME)
        np.testing.assert_allclose(found.std, np.sqrt(np.diag(found.covariance)), **SAME)
        one.learn(prior, y)
        scaled.learn(found, scale * (y + beforehand))
    np.testing.assert_allclose(scaled.theta, one.theta, **SAME)
    np.testing.assert_allclose(scaled.weights(), scale[:, None] * one.weights(), **SAME)


def test_samples_that_repeat_each_other_are_learnt_as_fewer_and_predicted_with_all_their_noise():
    n, d, p, sigma, r = 2, 4, 3, 0.1, 25.0
    phi, columns, outputs = problem(3, 40, n, d, p)
    fewer = SemiParametricRecursion(n, d, np.ones(p), 1.0, sigma, autocorrelation_time=r)
    noisier = SemiParametricRecursion(n, d, np.ones(p), 1.0, sigma * np.sqrt(r))
    said = [run(each, phi, columns, outputs).predict(phi[0], columns[0]) for each in (fewer, noisier)]
    np.testing.assert_allclose(fewer.theta, noisier.theta, **SAME)
    np.testing.assert_allclose(fewer.theta_covariance(), noisier.theta_covariance(), **SAME)
    wider = (r - 1.0) * sigma**2 * np.eye(n)
    np.testing.assert_allclose(said[0].covariance + wider, said[1].covariance, **SAME)
    white = SemiParametricRecursion(n, 0, np.ones(p), 1.0, sigma)
    tempered = SemiParametricRecursion(n, 0, np.ones(p), 1.0, sigma, autocorrelation_time=r)
    for each in (white, tempered):
        run(each, phi[:, :0], columns, outputs)
    np.testing.assert_allclose(tempered.theta_covariance(white=True), white.theta_covariance(), **SAME)


def test_forgetting_weighs_the_past_as_the_batch_solution_does():
    phi, columns, outputs = problem(3, 400, 3, 6, 4)
    wide = 1e4  # so that the prior, which the recursion renews and the batch solution forgets, does not matter
    ours = run(SemiParametricRecursion(3, 6, np.full(4, wide), wide, 0.1, forgetting=0.98), phi, columns, outputs)
    expected = batch(phi, columns, outputs, np.full(4, wide), wide, 0.1, np.zeros(4), forgetting=0.98)
    np.testing.assert_allclose(unknowns(ours), expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize('forgetting', [0.999, 0.98])
def test_standing_still_while_forgetting_does_not_wind_up(forgetting):
    """Without renewal, 40 s at 1 kHz left errors of hundreds of newtons, and at 0.98 NaN."""
    phi, columns, outputs = problem(5, 2000, 3, 12, 4)
    model = run(SemiParametricRecursion(3, 12, np.ones(4), 1.0, 0.1, forgetting=forgetting), phi[:1000],
                columns[:1000], outputs[:1000])
    for _ in range(40_000):
        model.learn(model.predict(phi[1000], columns[1000]), outputs[1000])
    worst_std = np.sqrt(max(np.diag(model.predict(*row).covariance).max() for row in zip(phi, columns, strict=True)))
    widest = SemiParametricRecursion(3, 12, np.ones(4), 1.0, 0.1)
    assert worst_std < 1.5 * np.sqrt(max(np.diag(widest.predict(*row).covariance).max()
                                         for row in zip(phi, columns, strict=True)))
    errors = []
    for row in zip(phi[1001:], columns[1001:], outputs[1001:], strict=True):
        prior = model.predict(*row[:2])
        errors.append(row[2] - prior.mean)
        model.learn(prior, row[2])
    assert np.abs(errors).max() < 10.0
    assert np.sqrt(np.mean(np.square(errors[-500:]))) < 0.13


@pytest.mark.slow
def test_many_updates_at_a_regularisation_of_1e_minus_10(long):
    count, n, d, p = 200_000 if long else 20_000, 2, 20, 4
    rng = np.random.default_rng(0)
    frequency, phase = rng.normal(size=(10, 3)), 0.0015 * np.arange(count)[:, None] * [1.0, 1.37, 1.91]
    angle = np.sin(phase) @ frequency.T
    phi = np.hstack([np.cos(angle), np.sin(angle)]) / np.sqrt(10)
    columns = np.stack([np.sin(phase @ rng.normal(size=(3, p))), np.cos(phase @ rng.normal(size=(3, p)))], axis=1)
    outputs = np.sin(2 * phase[:, :2]) + 0.05 * rng.normal(size=(count, n))
    rho, sigma = 1.0, 1e-5
    ours = run(SemiParametricRecursion(n, d, np.full(p, 0.3), rho, sigma), phi, columns, outputs)
    expected = batch(phi, columns, outputs, np.full(p, 0.3), rho, sigma, np.zeros(p))
    np.testing.assert_allclose(unknowns(ours), expected, rtol=1e-6, atol=1e-6)


def test_without_features_it_forgets_for_as_long_as_it_runs():
    """Nothing is inflated where nothing is: the weight array of no features once ended after 1374 samples at 0.99."""
    phi, columns, outputs = problem(4, 3000, 2, 0, 3)
    model = run(SemiParametricRecursion(2, 0, np.ones(3), 1.0, 0.1, forgetting=0.99), phi, columns, outputs)
    weights = 0.99 ** np.arange(len(outputs) - 1, -1, -1)[:, None]
    rows, right = (weights[:, None]**0.5 * columns).reshape(-1, 3), (weights**0.5 * outputs).ravel()
    np.testing.assert_allclose(model.theta, np.linalg.lstsq(rows, right, rcond=None)[0], atol=5e-3)


def test_a_saved_state_continues_bit_for_bit():
    phi, columns, outputs = problem(4, 80, 3, 6, 4)
    one = SemiParametricRecursion(3, 6, np.ones(4), 1.0, 0.2, forgetting=0.97)
    run(one, phi[:40], columns[:40], outputs[:40])
    saved = {name: value.copy() for name, value in one.state().items()}
    run(one, phi[40:], columns[40:], outputs[40:])
    other = SemiParametricRecursion(3, 6, np.ones(4), 1.0, 0.2, forgetting=0.97)
    other.restore(saved)
    run(other, phi[40:], columns[40:], outputs[40:])
    for name, value in one.state().items():
        np.testing.assert_array_equal(value, other.state()[name])
    np.testing.assert_array_equal(one.predict(phi[0], columns[0]).covariance,
                                  other.predict(phi[0], columns[0]).covariance)


@pytest.mark.parametrize('spoil', [
    lambda state: state.pop('array'),
    lambda state: state.update(array=np.eye(5)),
    lambda state: state.update(waiting=np.array(8)),
    lambda state: state.update(theta=np.array([1.0, np.nan])),
])
def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(spoil):
    model = SemiParametricRecursion(2, 4, np.ones(2), 1.0, 0.1)
    before = model.state()
    given = model.state()
    spoil(given)
    with pytest.raises(SemiparamError, match='saved'):
        model.restore(given)
    assert all(np.array_equal(before[name], value) for name, value in model.state().items())


def test_a_state_does_not_share_memory_with_the_model():
    phi, columns, outputs = problem(4, 10, 2, 4, 2)
    model = SemiParametricRecursion(2, 4, np.ones(2), 1.0, 0.1)
    state = model.state()
    copies = {name: value.copy() for name, value in state.items()}
    run(model, phi, columns, outputs)
    model.restore(state)
    run(model, phi, columns, outputs)
    assert all(np.array_equal(copies[name], value) for name, value in state.items())


CHANGES = st.lists(st.sampled_from(['learn', 'restore', 'pickle', 'nothing']), max_size=4)


@given(CHANGES, st.sampled_from([0, 4]), st.sampled_from([1.0, 0.98]))
@settings(max_examples=40)
def test_a_prior_is_learnt_only_by_the_model_as_it_stood(changes, d, forgetting):
    phi, columns, outputs = problem(4, 10, 2, d, 2)
    model = run(SemiParametricRecursion(2, d, np.ones(2), 1.0, 0.1, forgetting=forgetting), phi, columns, outputs)
    saved, kept = model.state(), model.predict(phi[0], columns[0])
    for change in changes:
        if change == 'learn':
            run(model, phi[1:2], columns[1:2], outputs[1:2])
        elif change == 'restore':
            model.restore(saved)
        elif change == 'pickle':
            model, kept = pickle.loads(pickle.dumps((model, kept)))
    before = model.state()
    if {'learn', 'restore'}.isdisjoint(changes):
        model.learn(kept, outputs[0])
        before = model.state()
    with pytest.raises(SemiparamError, match='stale'):
        model.learn(kept, outputs[0])
    assert all(np.array_equal(before[name], value) for name, value in model.state().items())


def test_a_prior_of_another_model_is_refused_also_after_as_many_samples():
    phi, columns, outputs = problem(4, 10, 2, 4, 2)
    one, other = (run(SemiParametricRecursion(2, 4, np.ones(2), 1.0, 0.1), phi, columns, outputs) for _ in range(2))
    twin = pickle.loads(pickle.dumps(one))
    run(one, phi[:1], columns[:1], outputs[:1])
    run(twin, phi[1:2], columns[1:2], outputs[1:2])
    for stranger in (other, twin):
        with pytest.raises(SemiparamError, match='stale'):
            one.learn(stranger.predict(phi[0], columns[0]), outputs[0])


@pytest.mark.parametrize(('options', 'sentence'), [
    ({'sigma': 0.0}, 'sigma 0.0'), ({'rho': np.nan}, 'rho nan'), ({'prior_std': np.array([1.0, -1.0])}, 'theta'),
    ({'forgetting': 0.0}, 'forgetting is 0.0'), ({'forgetting': 1.1}, 'forgetting is 1.1')])
def test_impossible_deviations_are_refused(options, sentence):
    with pytest.raises(SemiparamError, match=sentence):
        SemiParametricRecursion(**({'n_outputs': 2, 'n_features': 4, 'prior_std': np.ones(2), 'rho': 1.0,
                                    'sigma': 0.1} | options))


@pytest.mark.parametrize('forgetting', [0.5, 0.8, 0.95])
def test_much_forgetting_keeps_the_digits_of_many_features(forgetting):
    """With 200 of them the errors grew to 1e10 times the outputs: what waited for its renewal had lost all digits."""
    rng, count, n = np.random.default_rng(0), 200, 3
    model = SemiParametricRecursion(n, count, np.ones(4), 1.0, 0.05, forgetting=forgetting)
    omega, weights = rng.standard_normal((2, count // 2)), 0.3 * rng.standard_normal((n, count))
    worst = 0.0
    for step in range(1500):
        z = np.array([np.sin(0.02 * step), np.cos(0.031 * step)]) @ omega
        phi = np.concatenate([np.cos(z), np.sin(z)]) / np.sqrt(count // 2)
        columns = rng.standard_normal((n, 4)) * (step < 700)
        outputs = weights @ phi + columns.sum(axis=1) + 0.05 * rng.standard_normal(n)
        prior = model.predict(phi, columns)
        worst = max(worst, float(np.abs(outputs - prior.mean).max())) if step > 1000 else worst
        model.learn(prior, outputs)
    assert worst < 1.0 and np.isfinite(model.theta_covariance()).all()


def turning(seconds=20.0, rate=100, lag=3):
    """Columns (N, 1, 2) of a mass and of dry friction, a joint that turns back, and the effort of a friction that does
    so ``lag`` samples later."""
    time = np.arange(round(seconds * rate)) / rate
    velocity = np.cos(3.0 * time)
    direction = np.sign(np.roll(velocity, lag))
    columns = np.stack([-3.0 * np.sin(3.0 * time), np.tanh(velocity / 0.03)], axis=1)[:, None]
    return columns, (0.5 * columns[:, 0, 0] + 2.0 * direction)[:, None]


def learnt(columns, outputs, of_turning):
    model = SemiParametricRecursion(1, 0, np.array([1.0, 3.0]), 1.0, 0.1)
    for rows, output in zip(columns, outputs, strict=True):
        extra_variance = turning_variance(np.array([1]), model.theta, rows) if of_turning else None
        model.learn(model.predict(np.zeros(0), rows, extra_variance=extra_variance), output)
    return model.theta


@pytest.mark.parametrize('r', [1.0, 25.0])
def test_noise_of_one_sample_is_that_of_weighted_least_squares(r):
    columns, outputs = turning()
    variances = np.random.default_rng(0).uniform(0.0, 1.0, outputs.shape)
    model = SemiParametricRecursion(1, 0, np.array([1.0, 3.0]), 1.0, 0.1, autocorrelation_time=r)
    information, right = np.diag([1.0, 1.0 / 9.0]), np.zeros(2)
    for rows, output, extra_variance in zip(columns, outputs, variances, strict=True):
        prior, noise = model.predict(np.zeros(0), rows, extra_variance=extra_variance), 0.1**2 + extra_variance
        np.testing.assert_allclose(prior.covariance, rows @ np.linalg.solve(information, rows.T) + noise)
        model.learn(prior, output)
        information += rows.T @ rows / (r * noise)
        right += rows[0] * output / (r * noise)
    np.testing.assert_allclose(model.theta, np.linalg.solve(information, right))


def test_friction_that_turns_over_late_does_not_bend_the_mass():
    columns, outputs = turning()
    off, ours = (np.abs(learnt(columns, outputs, of_turning) - [0.5, 2.0]) for of_turning in (False, True))
    assert off[0] > 0.05 and (ours < 0.2 * off).all()


@pytest.mark.parametrize(('forgetting', 'changes'), [
    (1.0, None), (0.97, None), (1.0, ()), (1.0, [[1.0], [0.0], [-0.5]]), (0.97, np.eye(3))])
def test_what_is_forgotten_and_renewed_of_the_prior_does_not_count_as_samples(forgetting, changes):
    """The third coefficient is never excited: whatever r is, no more is known of it than by one model's prior."""
    rng = np.random.default_rng(0)
    models = [SemiParametricRecursion(2, 0, np.ones(3), 1.0, 0.1, forgetting=forgetting, autocorrelation_time=r)
              for r in (1.0, 100.0)]
    for number in range(1500):
        columns = rng.standard_normal((2, 3)) * [1.0, 1.0, 0.0]
        for model in models:
            if changes is not None and number == 1200:
                model.follow_change(np.array(changes) if len(changes) else None)
            model.learn(model.predict(np.zeros(0), columns), columns.sum(axis=1))
    white, fewer = (model.theta_covariance(white=True) for model in models)
    np.testing.assert_allclose(white, models[0].theta_covariance(), rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(fewer[2, 2], white[2, 2])
    assert np.linalg.eigvalsh(fewer).min() > 0.0


def test_after_a_change_little_that_comes_outvotes_the_past_and_what_was_known_returns():
    """A body of 2 kg takes a load of 1 kg: after 5000 samples of it alone, 20 with the load tell it, as few without."""
    rng, body, load = np.random.default_rng(0), np.array([2.0, 0.5]), np.array([1.0, -0.3])
    model = SemiParametricRecursion(2, 0, np.ones(2), 1.0, 0.1)

    def learn(theta, count):
        for _ in range(count):
            columns = rng.standard_normal((2, 2))
            model.learn(model.predict(np.zeros(0), columns), columns @ theta + 0.1 * rng.standard_normal(2))
        return np.abs(model.theta - theta).max()

    assert learn(body, 5000) < 0.01
    known = model.theta.copy()
    model.follow_change()
    np.testing.assert_array_equal(model.theta, known)
    assert learn(body + load, 20) < 0.1
    assert model.before is not None
    for _ in range(200):
        columns = rng.standard_normal((2, 2))
        outputs, std = columns @ body, model.predict(np.zeros(0), columns).std
        if model.alternative.charge(0.01, outputs - columns @ model.theta, outputs - columns @ model.before.theta, std):
            break
    model.go_back()
    np.testing.assert_array_equal(model.theta, known)
