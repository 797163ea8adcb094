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


def pool_both(weights: Array, means: Array, std: Array, model_means: Array,
              covariances: Array) -> tuple[Array, Array, Array, Array]:
    """(n,) mean and standard deviation of what is published, and (n,) mean and (n, n) covariance of the models alone.

    The diagonal of the covariance has the variances. Between outputs that weigh differently the geometric mean weighs,
    which keeps it positive definite.

    :param weights: (K, n); means and standard deviations are (K, n), covariances (K, n, n).
    """
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


def pool_desired(weights: Array, disagreeing: Array, shown: Array, needed: Array, covariances: Array,
                 ratios: Array) -> tuple[Array, Array, Array, float]:
    """(n,) means of what is shown and of what is needed, (n, n) covariance of the former, and mean of the ratios (K,).

    :param disagreeing: (K, n) weights by which the models' disagreement counts, and their ratios.
    """
    mean, own, covariance = *np.empty((2, shown.shape[1])), np.empty(covariances.shape[1:])
    ratio = _pool_desired(weights, disagreeing, shown, needed, covariances, ratios, mean, own, covariance)
    return mean, own, covariance, ratio


@compiled
def _pool_desired(weights: Matrix, disagreeing: Matrix, shown: Matrix, needed: Matrix, covariances: Stack,
                  ratios: Vector, mean: Vector, own: Vector, covariance: Matrix) -> float:
    """See :func:`pool_desired`."""
    members, n = shown.shape
    roots, apart, ratio = np.empty((members, n)), np.empty((members, n)), 0.0
    for k in range(n):
        least, total, total_apart = covariances[:, k, k].min(), 0.0, 0.0
        for m in range(members):
            certainty = least / covariances[m, k, k]
            roots[m, k], apart[m, k] = weights[m, k] * certainty, disagreeing[m, k] * certainty
            total += roots[m, k]
            total_apart += apart[m, k]
        mean[k] = own[k] = 0.0
        for m in range(members):
            roots[m, k] /= total
            mean[k] += roots[m, k] * shown[m, k]
            own[k] += roots[m, k] * needed[m, k]
            roots[m, k] = np.sqrt(roots[m, k])
        for m in range(members):
            apart[m, k] /= total_apart
            ratio += apart[m, k] * ratios[m] / n
            apart[m, k] = np.sqrt(apart[m, k]) * (shown[m, k] - mean[k])
    for k in range(n):
        for j in range(n):
            covariance[k, j] = 0.0
            for m in range(members):
                covariance[k, j] += roots[m, k] * roots[m, j] * covariances[m, k, j] + apart[m, k] * apart[m, j]
    return ratio
