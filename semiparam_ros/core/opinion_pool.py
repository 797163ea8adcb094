"""Answers of several models to one sample, made one: a logarithmic opinion pool (Genest and Zidek
1986).

The pool of Gaussian answers with weights w_m is the product of their densities, each to the power
w_m; of each output:

    v_m ~ w_m / std_m^2,      mean = sum_m v_m mean_m,      var = sum_m v_m (std_m^2 + (mean_m - mean)^2)

The first part of the variance is that product's, 1 / sum_m (w_m / std_m^2); what the models
disagree is added. A model that is less sure of this sample than the others counts less for it.
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.compiled import Matrix, Stack, Vector, compiled
from semiparam_ros.core.types import Array


def pool_weights(weights: Array, std: Array) -> Array:
    """(..., K, n) v, one in sum over the K models; w is (..., K, n) and the standard deviations are
    (K, n)."""
    shares = weights * (std.min(axis=0) / std) ** 2
    return np.asarray(shares / shares.sum(axis=-2, keepdims=True))


def pool_together(weights: Array, means: Array, covariances: Array,
                  disagreeing: Array | None = None) -> tuple[Array, Array]:
    """(n,) mean and (n, n) covariance of the pool, from (K, n), (K, n) and (K, n, n); its diagonal
    has the variances.

    Between outputs that weigh differently the geometric mean weighs, which keeps the matrix
    positive definite.

    :param disagreeing: (K, n) weights by which the models' disagreement counts; ``weights`` unless given.
    """
    std = np.sqrt(covariances.diagonal(axis1=1, axis2=2))
    shares = pool_weights(weights, std)
    roots, mean = np.sqrt(shares), (shares * means).sum(axis=0)
    apart = (roots if disagreeing is None else np.sqrt(pool_weights(disagreeing, std))) * (means - mean)
    return mean, np.einsum('mk,mkj,mj->kj', roots, covariances, roots) + apart.T @ apart


def pool_both(weights: Array, means: Array, std: Array, model_means: Array,
              covariances: Array) -> tuple[Array, Array, Array, Array]:
    """(n,) mean and standard deviation of what is published, and :func:`pool_together` of the
    models alone."""
    mean, spread, model_mean, covariance = *np.empty((3, means.shape[1])), np.empty(covariances.shape[1:])
    _pool_both(weights, means, std, model_means, covariances, mean, spread, model_mean, covariance)
    return mean, spread, model_mean, covariance


@compiled
def _pool_both(weights: Matrix, means: Matrix, std: Matrix, model_means: Matrix, covariances: Stack,
               mean: Vector, spread: Vector, model_mean: Vector, covariance: Matrix) -> None:
    """See :func:`pool_both`."""
    members, n = means.shape
    roots = np.empty((members, n))
    for k in range(n):
        least, least_variance = std[:, k].min(), covariances[:, k, k].min()
        total = model_total = mean[k] = spread[k] = model_mean[k] = 0.0
        for m in range(members):
            share = weights[m, k] * (least / std[m, k]) ** 2
            total += share
            mean[k] += share * means[m, k]
            roots[m, k] = weights[m, k] * (least_variance / covariances[m, k, k])
            model_total += roots[m, k]
            model_mean[k] += roots[m, k] * model_means[m, k]
        mean[k] /= total
        model_mean[k] /= model_total
        for m in range(members):
            share, apart = weights[m, k] * (least / std[m, k]) ** 2 / total, means[m, k] - mean[k]
            spread[k] += share * (std[m, k] * std[m, k] + apart * apart)
            roots[m, k] = np.sqrt(roots[m, k] / model_total)
        spread[k] = np.sqrt(spread[k])
    for k in range(n):
        for j in range(n):
            covariance[k, j] = 0.0
            for m in range(members):
                apart = (model_means[m, k] - model_mean[k]) * (model_means[m, j] - model_mean[j])
                covariance[k, j] += roots[m, k] * roots[m, j] * (covariances[m, k, j] + apart)
