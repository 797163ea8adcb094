"""Hyperparameters by a validation set (NP-VS, SP2-VS): fit on the window's first part, score on its last."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack

from semiparam_ros.core.hyperparameters.feature_count import fewer_features
from semiparam_ros.core.hyperparameters.marginal_likelihood import Window, harmonics
from semiparam_ros.core.hyperparameters.noise_covariance import cholesky_with_noise
from semiparam_ros.core.hyperparameters.window import least_squares_beside, normalised, residual_scale
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

ENOUGH = 1.01
"""Fewer features may leave so many times the squared error that all leave."""


@dataclass(frozen=True)
class Grid:
    """The points tried: length scales (crossed between kinds), ratios sigma / rho, and the part that fits."""

    tau: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
    ratio: tuple[float, ...] = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
    fitting_share: float = 0.7

    def __post_init__(self) -> None:
        if len(set(self.tau)) * len(set(self.ratio)) < 2:
            raise SemiparamError('the validation grid holds one point; expected at least two to choose from.')
        for value in (*self.tau, *self.ratio):
            if not 0.0 < value < np.inf:
                raise SemiparamError(f'the validation grid holds {value:g}; expected positive finite values.')
        if not 0.1 <= self.fitting_share <= 0.9:
            raise SemiparamError(f'{self.fitting_share} of the window would fit; expected 0.1 to 0.9.')


class Choice(NamedTuple):
    """The best point; ``score`` is its mean squared error on the last part, in units of each output's variance.

    ``features``: D.
    """

    rho: float
    tau: tuple[float, ...]
    sigma: float
    output_scale: tuple[float, ...]
    score: float
    features: int


class _Split(NamedTuple):
    fit: slice
    score: slice


class _Found(NamedTuple):
    score: float
    tau: tuple[float, ...]
    ratio: float
    errors: Array
    features: int


def select_by_validation(window: Window, mean_first: bool, noise: str, grid: Grid,
                         progress: Callable[[int, int], None] | None = None, fewest: bool = False) -> Choice:
    """Try every grid point.

    :param fewest: take the fewest features that are, at the best length scales, hardly worse than all.
    :param mean_first: subtract a least squares rigid body first (SP2). What effects do beside it is always subtracted.
    """
    fitting = int(grid.fitting_share * len(window.outputs))
    split = _Split(slice(0, fitting), slice(fitting, None))
    targets = window.outputs
    if mean_first or window.n_effects:
        own = window.coupled.shape[2] - window.n_effects
        theta = least_squares_beside(targets[split.fit], window.coupled[split.fit], window.prior_scale[own:])
        theta[:own] *= mean_first
        targets = targets - window.coupled @ theta
    groups = int(window.groups.max()) + 1
    total, best = len(grid.tau) ** groups, None
    for done, tau in enumerate(product(grid.tau, repeat=groups), start=1):
        found = _best_ratio(window, targets, split, tau, grid.ratio)
        if best is None or found.score < best.score:
            best = found
        if progress is not None:
            progress(done, total)
    assert best is not None
    few = (_best_ratio(few, targets, split, best.tau, grid.ratio) for few in fewer_features(window) if fewest)
    return _choice(next((found for found in few if found.score <= ENOUGH * best.score), best), window.outputs, noise)


def _best_ratio(window: Window, targets: Array, split: _Split, tau: tuple[float, ...],
                ratios: tuple[float, ...]) -> _Found:
    variance = window.outputs.var(axis=0)
    phi = harmonics((window.inputs / np.array(tau)[window.groups]) @ window.spectrum.T)
    scored = ((float(np.mean(np.mean(errors**2, axis=0) / variance)), ratio, errors)
              for ratio, errors in _errors(phi, targets, split, ratios))
    score, ratio, errors = min(scored, key=lambda each: each[0])
    return _Found(score, tau, ratio, errors, phi.shape[1])


def _errors(phi: Array, targets: Array, split: _Split, ratios: tuple[float, ...]) -> Iterator[tuple[float, Array]]:
    """Errors on the last part (t_v, n) for each ratio sigma / rho; ridge regression needs no more than the ratio."""
    features, fitted = phi[split.fit], targets[split.fit]
    narrow = features.shape[1] < len(features)
    gram = features.T @ features if narrow else features @ features.T  # once for all ratios
    for ratio in ratios:
        root = cholesky_with_noise(gram, ratio * ratio)
        solved, _ = lapack.dpotrs(root, features.T @ fitted if narrow else fitted, lower=1)
        yield ratio, targets[split.score] - phi[split.score] @ (solved if narrow else features.T @ solved)


def _choice(best: _Found, outputs: Array, noise: str) -> Choice:
    """The noise is what the held-out part left: validation has no other word on the uncertainty."""
    score, tau, ratio, errors, features = best
    scale = residual_scale(errors, outputs)
    output_scale = np.ones_like(scale) if noise == 'one' else normalised(scale)
    sigma = float(np.sqrt(np.mean((errors / output_scale) ** 2)))
    return Choice(sigma / ratio, tau, sigma, tuple(output_scale.tolist()), score, features)
