"""The structured log evidence against the dense formula, and its gradient against finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semiparam_ros.core.hyperparameters.marginal_likelihood import Point, Window, evidence, harmonics
from semiparam_ros.core.hyperparameters.noise_covariance import SharedFactor
from semiparam_ros.errors import SemiparamError

STEP = 1e-5


def random_window(seed, steps, outputs, columns, frequencies, profiled=False, effects=0, inputs=6, groups=3):
    rng = np.random.default_rng(seed)
    return Window(rng.normal(size=(steps, outputs)), rng.normal(size=(steps, outputs, columns)),
                  rng.normal(size=(steps, inputs)), rng.normal(size=(frequencies, inputs)),
                  np.arange(inputs) % groups, np.exp(rng.normal(size=columns)), profiled, n_effects=effects)


def random_point(seed, outputs, groups=3, drifting=False):
    rng = np.random.default_rng(seed + 1000)
    gamma, rho, sigma = np.exp(rng.normal(size=3) * 0.5)
    drift = (float(np.exp(rng.normal())), float(np.exp(1.5 + rng.normal()))) if drifting else (0.0, 1.0)
    return Point(gamma, rho, np.exp(rng.normal(size=groups) * 0.5), sigma, np.exp(rng.normal(size=outputs)), *drift)


def dense_log_evidence(window, at):
    """The textbook formula with the tn x tn covariance V of all outputs, stacked sample after sample."""
    steps, outputs, columns = window.coupled.shape
    phi = harmonics((window.inputs / at.tau[window.groups]) @ window.spectrum.T)
    lags = np.abs(np.subtract.outer(np.arange(steps), np.arange(steps))) * window.step
    noise = np.eye(steps) + at.kappa * np.exp(-lags / at.memory)
    shared = at.sigma**2 * noise + at.rho**2 * phi @ phi.T
    v = np.kron(shared, np.diag(at.output_scale**2))
    c, y = window.coupled.reshape(steps * outputs, columns), window.outputs.ravel()
    if window.profiled:
        mean, effects = np.split(c, [columns - window.n_effects], axis=1)
        v = v + (effects * window.prior_scale[columns - window.n_effects:] ** 2) @ effects.T
        white = np.linalg.inv(np.linalg.cholesky(v))
        y = y - mean @ np.linalg.lstsq(white @ mean, white @ y, rcond=None)[0]
    else:
        v = v + (c * (at.gamma * window.prior_scale) ** 2) @ c.T
    return -0.5 * (np.linalg.slogdet(v)[1] + y @ np.linalg.solve(v, y) + y.size * np.log(2 * np.pi))


def flat(values):
    return np.hstack([values.gamma, values.rho, values.tau, values.sigma, values.kappa, values.memory,
                      values.output_scale])


def moved(at, logarithms):
    groups = len(at.tau)
    values = flat(at) * np.exp(logarithms)
    return Point(values[0], values[1], values[2:2 + groups], values[2 + groups], values[5 + groups:],
                 values[3 + groups], values[4 + groups])


# fewer features than samples, more, none; few columns, none; theta under a prior, profiled, or profiled but for effects
SHAPES = [(30, 3, 4, 5, False), (12, 3, 4, 15, False), (30, 3, 4, 5, True), (12, 2, 3, 15, True), (30, 3, 0, 5, False),
          (12, 2, 0, 15, False), (30, 2, 4, 0, False), (30, 2, 4, 0, True),
          (30, 3, 5, 5, True, 2), (12, 2, 3, 15, True, 1), (30, 2, 3, 5, True, 3)]


@pytest.mark.parametrize('drifting', [False, True])
@pytest.mark.parametrize('shape', SHAPES)
def test_the_value_is_that_of_the_dense_formula_and_the_gradient_that_of_differences(shape, drifting):
    window, at = random_window(2, *shape), random_point(2, shape[1], drifting=drifting)
    found = evidence(window, at)
    assert found.value == pytest.approx(dense_log_evidence(window, at), rel=1e-8, abs=1e-8)
    assert evidence(window, at, gradient=False).value == found.value
    slope = flat(found.slope)
    for axis, direction in enumerate(np.eye(len(slope)) * STEP):
        difference = evidence(window, moved(at, direction)).value - evidence(window, moved(at, -direction)).value
        assert slope[axis] == pytest.approx(difference / (2 * STEP), rel=1e-5, abs=1e-4), axis


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), steps=st.integers(2, 25), outputs=st.integers(1, 4), columns=st.integers(0, 5),
       frequencies=st.integers(0, 20), profiled=st.booleans(), drifting=st.booleans())
def test_any_shape_equals_the_dense_formula(seed, steps, outputs, columns, frequencies, profiled, drifting):
    if profiled:
        columns = min(columns, steps * outputs // 4)  # more columns than data leave nothing to explain
    window = random_window(seed, steps, outputs, columns, frequencies, profiled and columns > 0)
    at = random_point(seed, outputs, drifting=drifting)
    assert evidence(window, at).value == pytest.approx(dense_log_evidence(window, at), rel=1e-7, abs=1e-7)


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), common=st.floats(-2, 2))
def test_one_factor_on_all_outputs_is_a_change_of_unit(seed, common):
    """output_scale times c, sigma and rho over c: the same model of the same data."""
    window, at = random_window(seed, 15, 3, 0, 4), random_point(seed, 3)
    c = float(np.exp(common))
    same = at._replace(sigma=at.sigma / c, rho=at.rho / c, output_scale=at.output_scale * c)
    assert evidence(window, same).value == pytest.approx(evidence(window, at).value, rel=1e-9)


def test_profiled_theta_is_the_limit_of_a_wide_prior():
    shape = (40, 3, 4, 6)
    at = random_point(3, 3)._replace(gamma=1e6)
    assert evidence(random_window(3, *shape, profiled=True), at).theta == pytest.approx(
        evidence(random_window(3, *shape), at).theta, rel=1e-6)


@pytest.mark.parametrize('extreme', [{'sigma': 1e-9}, {'sigma': 1e9}, {'gamma': 1e-30}, {'gamma': 1e30},
                                     {'rho': 1e-30}, {'rho': 1e6}, {'tau': np.full(3, 1e-6)},
                                     {'tau': np.full(3, 1e12)}, {'kappa': 1e-9, 'memory': 1e3},
                                     {'kappa': 1e9, 'memory': 1e6}, {'kappa': 1.0, 'memory': 0.01}])
@pytest.mark.parametrize('frequencies', [4, 40])
def test_value_and_gradient_stay_finite_at_the_edges(extreme, frequencies):
    window, at = random_window(4, 30, 2, 3, frequencies), random_point(4, 2)._replace(**extreme)
    result = evidence(window, at)
    assert np.isfinite(result.value)
    assert np.isfinite(flat(result.slope)).all()
    assert np.isfinite(result.theta).all()


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('frequencies', [4, 40])
def test_columns_that_the_features_make_up_stay_finite_where_the_covariance_is_all_but_singular(frequencies, seed):
    window = random_window(seed, 30, 2, 3, frequencies, profiled=True)
    at = random_point(seed, 2)._replace(rho=1e4, sigma=1e-9)
    phi = harmonics((window.inputs / at.tau[window.groups]) @ window.spectrum.T)
    window = replace(window, coupled=np.einsum('td,dnp->tnp', phi, np.random.default_rng(seed).normal(
        size=(phi.shape[1], 2, 3))))
    result = evidence(window, at)
    assert np.isfinite([result.value, *result.theta, *flat(result.slope)]).all()


def test_columns_that_the_window_does_not_excite_keep_a_zero_estimate():
    window, at = random_window(5, 30, 2, 4, 5, profiled=True), random_point(5, 2)
    window.coupled[:, :, 2] = 0.0
    assert evidence(window, at).theta[2] == 0.0


@pytest.mark.parametrize('other', [0.0, 1.0], ids=['unexcited', 'the-same-as-another'])
def test_an_effect_that_nothing_tells_keeps_its_prior(other):
    window, at = random_window(5, 30, 2, 4, 5, profiled=True, effects=1), random_point(5, 2)
    window.coupled[:, :, 3] = other * window.coupled[:, :, 1]
    result = evidence(window, at)
    without = evidence(replace(window, coupled=window.coupled[:, :, :3], prior_scale=window.prior_scale[:3],
                               n_effects=0), at)
    assert result.theta == pytest.approx([*without.theta, 0.0], abs=1e-6)
    if not other:
        assert result.value == pytest.approx(without.value, abs=1e-6)


@pytest.mark.parametrize('count', [0, 3, 40])
def test_shared_factor_is_the_covariance_it_stands_for(count):
    rng = np.random.default_rng(6)
    features, columns = rng.normal(size=(20, count)), rng.normal(size=(20, 5))
    factor, covariance = SharedFactor(features, 0.3), 0.09 * np.eye(20) + features @ features.T
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1])
    assert factor.solve(columns) == pytest.approx(np.linalg.solve(covariance, columns))
    assert factor.solved_features() == pytest.approx(np.linalg.solve(covariance, features))


def test_features_that_are_not_finite_are_refused():
    with pytest.raises(SemiparamError, match='not finite'):
        SharedFactor(np.full((5, 3), np.nan), 1.0)


def test_a_thinned_window_keeps_the_time_of_the_drift():
    window, at = random_window(7, 40, 2, 3, 5), random_point(7, 2, drifting=True)
    thin = window.thinned(20, 5)
    assert (len(thin.outputs), thin.step) == (20, 2)
    assert evidence(thin, at).value == pytest.approx(dense_log_evidence(thin, at), rel=1e-9)
