"""Weighted least squares of the declared model, and of further columns on its residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.hyperparameters.window import residual_scale
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.residual.noise import correlation_times
from semiparam_ros.effects import Effect


class Explained(NamedTuple):
    """What columns explain beyond the declared ones."""

    coefficients: Array  # (c,)
    covariance: Array  # (c, c) of the coefficients over the noise's variance in scaled units
    rank: int  # directions that the declared columns do not hold already
    residual: Array  # (N, n) left afterwards, in the outputs' units


@dataclass(frozen=True)
class Fit:
    """The declared model fitted to the samples where ``train_mask`` is true.

    :param train_mask: (N,) samples that fit. :param scale: (n,) weight of channel k is 1 / scale[k]^2.
    :param columns: C (N, n, p). :param theta: (p,). :param residual: (N, n) of all samples, in the outputs' units.
    """

    body: RigidBody
    samples: Samples
    effects: tuple[Effect, ...]
    train_mask: Mask
    scale: Array
    columns: Array
    theta: Array
    residual: Array
    config: DiagnosisConfig = DEFAULTS

    @cached_property
    def scaled(self) -> Array:
        """(M n, p) columns of the samples in use, each channel divided by its scale."""
        return np.asarray((self.columns[self.train_mask] / self.scale[:, None]).reshape(-1, self.columns.shape[2]))

    @cached_property
    def factor(self) -> tuple[Array, bool]:
        """Cholesky factor of the regularised normal matrix."""
        return cho_factor(self.scaled.T @ self.scaled + np.diag(self._precision()))  # type: ignore[no-any-return]

    @property
    def rigid_part(self) -> Array:
        """(p_psi,) base parameters."""
        return self.theta[:self.body.n_parameters]

    @cached_property
    def correlation(self) -> Array:
        """(n,) correlation time [samples] of each channel of the residual of the samples in use."""
        return correlation_times(self.residual[self.train_mask], self.config)

    @property
    def squares(self) -> Array:
        """(n,) sum of squared residuals of the samples in use."""
        return np.asarray((self.residual[self.train_mask] ** 2).sum(axis=0))

    def explain(self, columns: Array) -> Explained:
        """Regress the residual on columns (N, n, c), the declared ones refitted along."""
        used = (columns[self.train_mask] / self.scale[:, None]).reshape(-1, columns.shape[2])
        left = (self.residual[self.train_mask] / self.scale).ravel()
        cross = cho_solve(self.factor, self.scaled.T @ used)
        inner = used.T @ used - (used.T @ self.scaled) @ cross
        coefficients, covariance, rank = _solve(inner, used.T @ left, np.einsum('ij,ij->j', used, used),
                                                self.config.absorbed_share)
        contribution = columns @ coefficients - self.columns @ (cross @ coefficients)
        return Explained(coefficients, covariance, rank, self.residual - contribution)

    def theta_covariance(self) -> Array:
        """(p, p) of theta over the noise's variance in scaled units."""
        return np.asarray(cho_solve(self.factor, np.eye(len(self.theta))))

    def _precision(self) -> Array:
        return 1.0 / CoupledColumns(self.body, self.effects).prior_scale ** 2


def fit_model(body: RigidBody, samples: Samples, effects: Sequence[Effect], train_mask: Mask, scale: Array,
              config: DiagnosisConfig = DEFAULTS) -> Fit:
    """Fit the rigid body, the offset and the effects by least squares, with a weak prior about the description."""
    assembly = CoupledColumns(body, effects)
    columns, _ = assembly.batch(samples)
    start = assembly.prior_mean
    return _least_squares(Fit(body, samples, tuple(effects), train_mask, scale, columns, start,
                              samples.outputs - columns @ start, config))


def with_effects(fit: Fit, effects: Sequence[Effect]) -> Fit:
    """The same samples and weights fitted with these effects in place of those declared."""
    return fit_model(fit.body, fit.samples, effects, fit.train_mask, fit.scale, fit.config)


def reweighted(fit: Fit, scale: Array) -> Fit:
    """The same model fitted with other weights."""
    start = CoupledColumns(fit.body, fit.effects).prior_mean
    return _least_squares(replace(fit, scale=scale, theta=start,
                                  residual=fit.samples.outputs - fit.columns @ start))


def refit_weights(first: Fit) -> Fit:
    """The same fit with each channel weighed by its own residual."""
    return reweighted(first, residual_scale(first.residual[first.train_mask], first.samples.outputs[first.train_mask]))


def _least_squares(start: Fit) -> Fit:
    """The fit from a start at the prior mean."""
    right = start.scaled.T @ (start.residual[start.train_mask] / start.scale).ravel()
    change = cho_solve(start.factor, right)
    fitted = replace(start, theta=start.theta + change, residual=start.residual - start.columns @ change)
    fitted.__dict__.update(scaled=start.scaled, factor=start.factor)  # they depend on columns and weights alone
    return fitted


def _solve(inner: Array, right: Array, power: Array, absorbed: float) -> tuple[Array, Array, int]:
    """Least squares from normal equations, leaving out directions absorbed by others (``power``: squared columns)."""
    size = np.sqrt(np.maximum(power, 1e-300))
    values, vectors = eigh(inner / np.outer(size, size))
    keep = values > absorbed
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T / np.outer(size, size)
    return inverse @ right, inverse, int(keep.sum())
