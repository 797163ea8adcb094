"""Random Fourier features: the kernel they approximate, their seeds and their scales."""

import numpy as np
import pytest

from semiparam_ros.core.random_features import RandomFeatures, input_scaling, spectrum, spread
from semiparam_ros.core.variants import FREQUENCIES
from semiparam_ros.errors import SemiparamError

M = 6
X = np.random.default_rng(0).normal(size=(30, M))


def features(count=400, seed=0, tau=(2.0,), mean=(0.0,) * M, scale=(1.0,) * M, frequencies='orthogonal'):
    return RandomFeatures(M, count, seed, tau, np.array(mean), np.array(scale), frequencies)


def gaussian_kernel(x, tau):
    distance = (x[:, None] - x) / tau
    return np.exp(-0.5 * np.sum(distance**2, axis=2))


@pytest.mark.parametrize('frequencies', FREQUENCIES)
@pytest.mark.parametrize('tau', [(2.0,), (1.0, 2.0, 4.0), (1.0, 1.5, 2.0, 2.5, 3.0, 9.0)])
def test_inner_products_tend_to_the_gaussian_kernel(tau, frequencies):
    expected = gaussian_kernel(X, spread(tau, M))
    worst = []
    for count in (200, 20_000):
        phi = features(count, tau=tau, frequencies=frequencies).batch(X)
        worst.append(np.abs(phi @ phi.T - expected).max())
    assert worst[1] < 5 / np.sqrt(20_000) < worst[0]  # five standard deviations of the mean of 10 000 cosines
    scaled = features(tau=tau, mean=X[0], scale=np.full(M, 3.0)).kernel(3.0 * X[:5], 3.0 * X)
    np.testing.assert_allclose(scaled, expected[:5], atol=1e-12)


def test_orthogonal_frequencies_have_the_same_mean_and_less_variance():
    """Yu et al. 2016: about the kernel at points that are near each other most of all."""
    expected, squares = gaussian_kernel(X, 2.0), {}
    for frequencies in FREQUENCIES:
        draws = [features(60, seed, frequencies=frequencies).batch(X) for seed in range(200)]
        errors = np.array([phi @ phi.T - expected for phi in draws])
        assert np.abs(errors.mean(axis=0)).max() < 5 * np.sqrt(0.5 / 30 / 200)
        squares[frequencies] = np.mean(errors**2)
    assert squares['orthogonal'] < 0.8 * squares['independent']


@pytest.mark.parametrize('frequencies', FREQUENCIES)
def test_fewer_features_have_the_first_frequencies_of_more(frequencies):
    more = spectrum(M, 50, 3, frequencies)
    np.testing.assert_array_equal(spectrum(M, 22, 3, frequencies), more[:11])
    assert more.shape == (25, M)


def test_blocks_of_frequencies_are_orthogonal():
    for block in spectrum(M, 6 * M, 1).reshape(-1, M, M):
        gram = block @ block.T
        np.testing.assert_allclose(gram, np.diag(gram.diagonal()), atol=1e-12)


def test_the_features_of_one_input_have_norm_one():
    np.testing.assert_allclose(np.sum(features(10).batch(X) ** 2, axis=1), 1.0, rtol=1e-14)


def test_batch_equals_one_by_one():
    phi = features(mean=X.mean(axis=0), scale=X.std(axis=0))
    np.testing.assert_allclose(phi.batch(X), [phi(x) for x in X], rtol=0, atol=1e-13)


def test_inputs_are_scaled_by_mean_and_deviation():
    mean, scale = np.arange(M, dtype=float), np.linspace(0.1, 3, M)
    np.testing.assert_allclose(features(mean=mean, scale=scale).batch(X * scale + mean), features().batch(X),
                               atol=1e-12)


def test_a_seed_gives_the_same_features_and_another_seed_others():
    np.testing.assert_array_equal(features(seed=3)(X[0]), features(seed=3)(X[0]))
    assert not np.allclose(features(seed=3)(X[0]), features(seed=4)(X[0]))
    assert spectrum(M, 20, 3).shape == (10, M)


def test_one_length_scale_for_each_kind_covers_that_kinds_joints():
    np.testing.assert_array_equal(spread((1.0, 3.0, 6.0), M), [1, 1, 3, 3, 6, 6])


@pytest.mark.parametrize(('options', 'sentence'), [
    ({'count': 7}, r'features\.count is 7'), ({'count': 0}, r'features\.count is 0'),
    ({'tau': (1.0, 2.0)}, '2 length scales for 6 inputs'), ({'tau': (0.0,)}, 'length scales'),
    ({'tau': (np.nan,)}, 'length scales'), ({'scale': np.zeros(M)}, 'scale'),
    ({'mean': np.full(M, np.nan)}, 'mean'), ({'scale': np.ones(M - 1)}, '6 inputs')])
def test_impossible_features_are_refused(options, sentence):
    with pytest.raises(SemiparamError, match=sentence):
        features(**options)


def test_scaling_of_a_window():
    mean, scale = input_scaling(X * 5 + 2)
    np.testing.assert_allclose(mean, (X * 5 + 2).mean(axis=0))
    np.testing.assert_allclose(scale, 5 * X.std(axis=0))


def test_a_joint_with_nothing_but_noise_is_scaled_by_the_others_motion():
    """Scaled by its own noise, such a joint tripled the error of NP, and its first motion was answered by nonsense."""
    still = X.copy()
    still[:, 1] = 0.7 + 1e-4 * X[:, 1]
    scale = input_scaling(still)[1]
    assert scale[1] == pytest.approx(0.2 * scale[0])
    np.testing.assert_array_equal(np.delete(scale, 1), np.delete(input_scaling(X)[1], 1))


def test_a_joint_that_slides_is_compared_by_the_length_of_what_it_carries():
    """By metres beside radians, a lift of three centimetres was scaled by five times its motion."""
    slides = X.copy()
    slides[:, ::2] *= 0.1
    scale = input_scaling(slides, np.array([0.4, 1.0]))[1]
    np.testing.assert_allclose(scale, slides.std(axis=0))
    slides[:, ::2] *= 0.1
    shorter = input_scaling(slides, np.array([0.4, 1.0]))[1]
    np.testing.assert_allclose(shorter[::2], 0.4 * 0.2 * shorter[1::2])


def test_inputs_that_stand_still_keep_their_unit():
    still = X.copy()
    still[:, 2:4] = 0.7
    np.testing.assert_array_equal(input_scaling(still)[1][2:4], 1.0)
