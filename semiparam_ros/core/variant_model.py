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


class Model:
    """One variant with its hyperparameters: scaled outputs, features, a fixed mean where pi is fixed, the recursion."""

    def __init__(self, variant: Variant, hyperparameters: Hyperparameters, features: RandomFeatures | None,
                 prior_scale: Array, prior_mean: Array | None = None, forgetting: float = 1.0) -> None:
        self.variant, self.hyperparameters, self.features = variant, hyperparameters, features
        self.output_scale = np.asarray(hyperparameters.output_scale, dtype=float)
        learnt = variant.pi == 'learnt'
        self.pi = np.asarray(hyperparameters.pi, dtype=float) if variant.pi == 'fixed' else None
        self.recursion = SemiParametricRecursion(
            len(self.output_scale), features.count if features else 0,
            hyperparameters.gamma * prior_scale if learnt else np.zeros(0), hyperparameters.rho,
            hyperparameters.sigma, prior_mean if learnt else None, forgetting)

    @property
    def theta(self) -> Array:
        """(p,) coefficients of the coupled columns, learnt or fixed; empty for a non-parametric model."""
        return self.recursion.theta if self.pi is None else self.pi

    def theta_std(self) -> Array:
        """(p,) their posterior standard deviations; zero where pi is fixed."""
        if self.pi is not None:
            return np.zeros_like(self.pi)
        return np.asarray(np.sqrt(np.diag(self.recursion.theta_covariance())))

    def predict(self, x: Array, columns: Array) -> tuple[Prior, Array, Array]:
        """The recursion's prior, its columns (n, p) and the fixed mean (n,), all in units of ``output_scale``."""
        scaled = columns / self.output_scale[:, None]
        fixed = np.zeros(len(self.output_scale)) if self.pi is None else scaled @ self.pi
        learnt = scaled if self.variant.pi == 'learnt' else scaled[:, :0]
        phi = self.features(x) if self.features else np.zeros(0)
        return self.recursion.predict(phi, learnt), learnt, fixed


def log_density(innovation: Array, covariance: Array) -> float:
    """Log of N(innovation; 0, covariance), for (n,) and (n, n) [nat]."""
    lower, _ = dpotrf(covariance, lower=1)
    white, _ = dtrtrs(lower, innovation, lower=1)
    return float(-0.5 * white @ white - np.log(lower.diagonal()).sum() - len(white) * HALF_LOG_2PI)
