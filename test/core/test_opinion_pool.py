"""The answers of several models in a logarithmic opinion pool."""

import numpy as np
import pytest

from semiparam_ros.core.opinion_pool import pool_both, pool_desired
from support.plain_forms import pool, pool_together, pool_weights


def alike(weights, means, covariances):
    """Mean and covariance of a desired state, where the disagreement counts by the same weights."""
    mean, _, covariance, _ = pool_desired(weights, weights, means, means, covariances, np.zeros(len(means)))
    return mean, covariance


@pytest.mark.parametrize('scale', [1e-140, 1.0, 1e140])
def test_the_pool_is_the_product_of_the_densities_and_what_they_disagree(scale):
    weights, means, std = np.array([[[0.7], [0.2], [0.1]], [[0.3], [-0.4], [1.0]], [[0.5], [0.2], [2.0]]])
    axis = np.linspace(-12.0, 12.0, 200001)
    density = np.exp(-0.5 * (weights * ((axis - means) / std) ** 2).sum(axis=0))
    density /= density.sum()
    expected = density @ axis
    variance = density @ axis**2 - expected**2 + float((pool_weights(weights, std) * (means - expected) ** 2).sum())
    means, std = scale * means, scale * std
    for mean, found in (pool(weights, means, std), pool_both(weights, means, std, means, std[:, :, None] ** 2)[:2]):
        np.testing.assert_allclose(mean / scale, expected, rtol=1e-9)
        np.testing.assert_allclose((found / scale) ** 2, variance, rtol=1e-9)


def test_the_diagonal_of_the_covariance_holds_the_variances():
    rng = np.random.default_rng(1)
    weights, means = np.ascontiguousarray(rng.dirichlet(np.ones(3), 4).T), rng.standard_normal((3, 4))
    roots = rng.standard_normal((3, 4, 4))
    covariances = roots @ roots.swapaxes(1, 2)
    std = np.sqrt(covariances.diagonal(axis1=1, axis2=2))
    for together in (pool_together, alike):
        mean, covariance = together(weights, means, covariances)
        np.testing.assert_allclose((mean, np.sqrt(covariance.diagonal())), pool(weights, means, std))
        assert np.linalg.eigvalsh(covariance).min() > 0.0
        np.testing.assert_allclose(together(weights, means, 4.0 * covariances)[0], mean)


def test_covariances_of_models_that_are_alike_but_for_their_means_hold_what_these_disagree():
    means, covariances = np.array([[1.0, 2.0], [3.0, -2.0]]), np.array([[[2.0, 0.5], [0.5, 1.0]]] * 2)
    _, covariance = alike(np.array([[0.25] * 2, [0.75] * 2]), means, covariances)
    np.testing.assert_allclose(covariance, covariances[0] + 0.25 * 0.75 * np.outer([2.0, -4.0], [2.0, -4.0]))


def test_disagreement_may_count_by_weights_of_its_own():
    means, covariances = np.array([[1.0], [3.0]]), np.array([[[2.0]]] * 2)
    weights, ratios = np.array([[0.0], [1.0]]), np.array([1.0, 2.0])
    mean, own, covariance, ratio = pool_desired(weights, np.array([[0.5], [0.5]]), means, -means, covariances, ratios)
    np.testing.assert_allclose((mean[0], own[0], covariance[0, 0], ratio), (3.0, -3.0, 2.0 + 0.5 * 2.0**2, 1.5))


def test_who_is_not_sure_of_a_sample_hardly_counts():
    mean, std = pool(np.array([[0.9], [0.1]]), np.array([[50.0], [1.0]]), np.array([[100.0], [0.1]]))
    assert abs(mean[0] - 1.0) < 0.001 and std[0] < 0.4
