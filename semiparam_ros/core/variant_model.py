"""One variant of the model with its hyperparameters, in units of its outputs' scale."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from semiparam_ros.core.hyperparameters import Hyperparameters
from semiparam_ros.core.random_features import RandomFeatures
from semiparam_ros.core.recursion import Prior, SemiParametricRecursion
from semiparam_ros.core.types import Array
from semiparam_ros.core.variants import Variant

HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)


EFFECT_GAMMA = 1.0
"""Standard deviation of effects over their prior scale, in the variants that have no gamma."""


class Model:
    """One variant with its hyperparameters: scaled outputs, features, a fixed mean where pi is fixed, the recursion.

    Of the columns of C, those of the rigid body and the offset are learnt, fixed or absent, as the variant has it;
    those of effects, which stand last, are learnt in every variant.

    :param prior_scale: (p,) prior standard deviations of theta over gamma. :param prior_mean: (p,), zero unless given.
    :param n_effects: how many of the columns are effects'.
    """

    def __init__(self, variant: Variant, hyperparameters: Hyperparameters, features: RandomFeatures | None,
                 prior_scale: Array, prior_mean: Array | None = None, forgetting: float = 1.0,
                 n_effects: int = 0) -> None:
        self.variant, self.hyperparameters, self.features = variant, hyperparameters, features
        self.output_scale = np.asarray(hyperparameters.output_scale, dtype=float)
        own, everything = len(prior_scale) - n_effects, len(prior_scale)
        learnt = variant.pi == 'learnt'
        self.gamma = hyperparameters.gamma if learnt else EFFECT_GAMMA
        self.learnt = slice(0 if learnt else own, everything)
        """Columns of C that the recursion learns."""
        self.covered = slice(own if variant.pi == 'absent' else 0, everything)
        """Columns of C that ``theta`` has coefficients for."""
        self.pi = np.asarray(hyperparameters.pi, dtype=float) if variant.pi == 'fixed' else None
        self.recursion = SemiParametricRecursion(
            len(self.output_scale), features.count if features else 0, self.gamma * prior_scale[self.learnt],
            hyperparameters.rho, hyperparameters.sigma, None if prior_mean is None else prior_mean[self.learnt],
            forgetting)

    @property
    def theta(self) -> Array:
        """Coefficients, learnt or fixed, of the ``covered`` columns: of all, or of the effects where pi is absent."""
        return self.recursion.theta if self.pi is None else np.concatenate([self.pi, self.recursion.theta])

    def theta_std(self) -> Array:
        """Their posterior standard deviations; zero where pi is fixed."""
        std = np.zeros(len(self.theta))
        if self.recursion.n_columns:
            std[-self.recursion.n_columns:] = np.sqrt(np.diag(self.recursion.theta_covariance()))
        return std

    def part(self, block: slice) -> Array:
        """Coefficients of a block of columns; empty where the model has none for it."""
        start = self.covered.start
        return self.theta[block.start - start:block.stop - start] if block.start >= start else np.zeros(0)

    def contribution(self, columns: Array) -> Array:
        """(n,) what columns (n, p) in N and N m bring about."""
        return np.asarray(columns[:, self.covered] @ self.theta)

    def predict(self, x: Array, columns: Array) -> tuple[Prior, Array, Array]:
        """The recursion's prior, its columns (n, p) and the fixed mean (n,), all in units of ``output_scale``."""
        scaled = columns / self.output_scale[:, None]
        fixed = np.zeros(len(self.output_scale)) if self.pi is None else scaled[:, :len(self.pi)] @ self.pi
        learnt = scaled[:, self.learnt]
        phi = self.features(x) if self.features else np.zeros(0)
        return self.recursion.predict(phi, learnt), learnt, fixed


def log_density(innovation: Array, covariance: Array) -> float:
    """Log of N(innovation; 0, covariance), for (n,) and (n, n) [nat]."""
    lower, _ = dpotrf(covariance, lower=1)
    white, _ = dtrtrs(lower, innovation, lower=1)
    return float(-0.5 * white @ white - np.log(lower.diagonal()).sum() - len(white) * HALF_LOG_2PI)
