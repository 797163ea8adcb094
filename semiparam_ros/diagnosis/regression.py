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
from semiparam_ros.core.types import Array, Indices, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.residual.noise import correlation_times
from semiparam_ros.effects import Effect

LARGE = ('columns', 'corrected', 'in_use', 'rows')
"""What a fit computes when it is asked for: far more than the rest of it, where samples are many."""
OF_COLUMNS = (*LARGE, 'felt', 'grams', 'at_prior')
"""What neither its weights nor its outputs change."""


class Explained(NamedTuple):
    """What columns explain beyond the declared ones."""

    coefficients: Array  # (c,)
    covariance: Array  # (c, c) of the coefficients over the noise's variance in scaled units
    rank: int  # directions that the declared columns do not hold already
    residual: Array  # (N, n) left afterwards, in the outputs' units


@dataclass(frozen=True, eq=False)
class Fit:
    """The declared model fitted to the samples where ``train_mask`` is true.

    :param train_mask: (N,) samples that fit. :param counted: (N, n) outputs that tell something, in use or not.
    :param scale: (n,) weight of channel k is 1 / scale[k]^2. :param theta: (p,).
    :param residual: (N, n) of all samples, in the outputs' units.
    :param nuisance: (N, n, k) further columns, the last ones of C, that stand for no effect: what errors of the inputs
        may do. Their coefficients have a standard deviation of 1; None where there are none.
    """

    body: RigidBody
    samples: Samples
    effects: tuple[Effect, ...]
    train_mask: Mask
    counted: Mask
    scale: Array
    theta: Array
    residual: Array
    config: DiagnosisConfig = DEFAULTS
    nuisance: Array | None = None

    @cached_property
    def columns(self) -> Array:
        """C (N, n, p): those of the rigid body, the offset and the effects, then the nuisance columns."""
        further = () if self.nuisance is None else (self.nuisance,)
        return CoupledColumns(self.body, self.effects).of_corrected(*self.corrected, further=further)[0]

    @cached_property
    def corrected(self) -> tuple[RigidBody, Samples]:
        """The body and the inputs as the declared effects correct them."""
        body, inputs, _ = CoupledColumns(self.body, self.effects).corrected(self.samples)
        return body, inputs

    @cached_property
    def in_use(self) -> list[Indices]:
        """(M_k,) of each channel k the numbers of the samples in use whose output counts."""
        return [np.flatnonzero(self.train_mask & counted) for counted in self.counted.T]

    @cached_property
    def felt(self) -> list[Indices]:
        """(p_k,) of each channel k the numbers of the columns that are not zero there: a joint feels few bodies of a
        robot with limbs, and nothing of what rubs in other joints."""
        return [np.flatnonzero(acting) for acting in np.asarray(self.columns.any(axis=0))]

    @cached_property
    def rows(self) -> list[Array]:
        """(M_k, p_k) of each channel k the columns in use that it feels, not divided by its scale."""
        return [self.columns[used, channel][:, felt]
                for channel, (used, felt) in enumerate(zip(self.in_use, self.felt, strict=True))]

    @cached_property
    def grams(self) -> Array:
        """(n, p, p) of each channel the products of these columns: what another weight leaves as it is."""
        grams = np.zeros((len(self.scale), *2 * self.columns.shape[2:]))
        for gram, rows, felt in zip(grams, self.rows, self.felt, strict=True):
            gram[np.ix_(felt, felt)] = rows.T @ rows
        return grams

    @cached_property
    def at_prior(self) -> Array:
        """(N, n) outputs less those of the prior mean, in the outputs' units."""
        return self.samples.outputs - predicted(self.columns, self.prior_mean())

    @cached_property
    def factor(self) -> tuple[Array, bool]:
        """Cholesky factor of the regularised normal matrix."""
        normal = np.tensordot(self.scale**-2.0, self.grams, axes=1)
        return cho_factor(normal + np.diag(self._precision()))  # type: ignore[no-any-return]

    @property
    def rigid_part(self) -> Array:
        """(p_psi,) base parameters."""
        return self.theta[:self.body.n_parameters]

    @cached_property
    def correlation(self) -> Array:
        """(n,) correlation time [samples] of each channel of the residual of the samples in use."""
        return correlation_times(self.used(self.residual), self.config)

    @cached_property
    def squares(self) -> Array:
        """(n,) sum of squared residuals of the samples in use."""
        return np.asarray((self.used(self.residual) ** 2).sum(axis=0))

    @cached_property
    def loss(self) -> float:
        """Sum of squared residuals of the samples in use, in scaled units."""
        return float((self.squares / self.scale**2).sum())

    @cached_property
    def counts(self) -> Array:
        """(n,) number of outputs in use of each channel."""
        return np.asarray(self.counted[self.train_mask].sum(axis=0), dtype=float)

    def forget(self) -> None:
        """Let go of the arrays that are large and can be computed anew from the samples and the effects."""
        for name in LARGE:
            self.__dict__.pop(name, None)

    def used(self, values: Array) -> Array:
        """(M, n, ...) of values (N, n, ...) those of the samples in use, zero where an output does not count."""
        counted = self.counted[self.train_mask]
        return np.asarray(values[self.train_mask] * counted.reshape(*counted.shape, *[1] * (values.ndim - 2)))

    def weighed(self, values: Array) -> Array:
        """(M, n, ...) the same, each channel divided by its scale."""
        return np.asarray(self.used(values) / self.scale.reshape(-1, *[1] * (values.ndim - 2)))

    def scale_of(self, residual: Array) -> Array:
        """(n,) root mean square of a residual (N, n) over the outputs in use."""
        grow = np.sqrt(self.train_mask.sum() / self.counts)
        return residual_scale(self.used(residual) * grow, self.used(self.samples.outputs) * grow)

    def explain(self, columns: Array) -> Explained:
        """Regress the residual on columns (N, n, c), the declared ones refitted along."""
        coefficients, covariance, rank, cross, _ = self._regressed(columns)
        contribution = predicted(columns, coefficients) - predicted(self.columns, cross @ coefficients)
        return Explained(coefficients, covariance, rank, self.residual - contribution)

    def loss_with(self, columns: Array) -> tuple[float, Array]:
        """What :meth:`explain` would leave of the loss, and the coefficients (c,); much faster."""
        coefficients, _, _, _, right = self._regressed(columns)
        return self.loss - float(right @ coefficients), coefficients

    def _regressed(self, columns: Array) -> tuple[Array, Array, int, Array, Array]:
        """Coefficients (c,), their covariance, rank, the refit (p, c) of the declared columns, and the right side."""
        count = columns.shape[2]
        inner, right = np.zeros((count, count)), np.zeros(count)
        shared = np.zeros((self.columns.shape[2], count))
        for channel, (rows, acts) in enumerate(zip(self.rows, np.asarray(columns.any(axis=0)), strict=True)):
            acting = np.flatnonzero(acts)
            if len(acting):
                used, weight = columns[self.in_use[channel], channel][:, acting], self.scale[channel] ** -2.0
                inner[np.ix_(acting, acting)] += weight * (used.T @ used)
                right[acting] += weight * (used.T @ self.residual[self.in_use[channel], channel])
                shared[np.ix_(self.felt[channel], acting)] += weight * (rows.T @ used)
        cross = cho_solve(self.factor, shared)
        power = np.diag(inner).copy()
        solved = _solve(inner - shared.T @ cross, right, power, self.config.absorbed_share)
        return *solved, cross, right

    def theta_covariance(self) -> Array:
        """(p, p) of theta over the noise's variance in scaled units."""
        return np.asarray(cho_solve(self.factor, np.eye(len(self.theta))))

    def covariance_with(self, columns: Array) -> Array:
        """(p + c, p + c) of theta and of the coefficients of further columns (N, n, c), over the noise's variance in
        scaled units. Directions of these that theta's columns hold already count as known."""
        _, covariance, _, cross, _ = self._regressed(columns)
        across = cross @ covariance
        return np.asarray(np.block([[self.theta_covariance() + across @ cross.T, -across], [-across.T, covariance]]))

    def known_precision(self) -> tuple[Array, Array]:
        """(p,) precision of coefficients whose values or sizes are known, zero elsewhere; and its pull on theta."""
        mean, assembly = self.prior_mean(), CoupledColumns(self.body, self.effects)
        known = np.where(mean != 0.0, self._precision(), 0.0)
        known[:assembly.n_own] = 0.0
        known[assembly.n_columns:] = 1.0
        return known, known * (self.theta - mean)

    def prior_mean(self) -> Array:
        """(p,) of theta; zero for the nuisance columns."""
        return self._with_nuisance(CoupledColumns(self.body, self.effects).prior_mean, 0.0)

    def _precision(self) -> Array:
        return self._with_nuisance(CoupledColumns(self.body, self.effects).prior_scale ** -2.0, 1.0)

    def _with_nuisance(self, values: Array, each: float) -> Array:
        """Values of the coupled columns, followed by the same for each of the nuisance columns."""
        return values if self.nuisance is None else np.append(values, np.full(self.nuisance.shape[2], each))


def fit_model(body: RigidBody, samples: Samples, effects: Sequence[Effect], train_mask: Mask, scale: Array,
              config: DiagnosisConfig = DEFAULTS, counted: Mask | None = None, nuisance: Array | None = None,
              corrected: tuple[RigidBody, Samples] | None = None) -> Fit:
    """Fit the rigid body, the offset and the effects by least squares, with a weak prior about the description.

    :param counted: (N, n) outputs that tell something; all unless given. :param nuisance: as :class:`Fit` has it.
    :param corrected: the body and the inputs as these effects correct them, where they are known.
    """
    counted = np.ones(samples.outputs.shape, dtype=bool) if counted is None else counted
    unfitted = Fit(body, samples, tuple(effects), train_mask, counted, scale, np.zeros(0), samples.outputs, config,
                   nuisance)
    if corrected is not None:
        unfitted.__dict__['corrected'] = corrected
    return reweighted(unfitted, scale)


def with_effects(fit: Fit, effects: Sequence[Effect]) -> Fit:
    """The same samples and weights fitted with these effects in place of those declared."""
    return with_nuisance(fit, fit.nuisance, effects)


def with_nuisance(fit: Fit, nuisance: Array | None, effects: Sequence[Effect] | None = None) -> Fit:
    """The same samples and weights fitted with these nuisance columns, and other effects where some are given."""
    effects = fit.effects if effects is None else effects
    same = correcting(effects) == correcting(fit.effects)
    return fit_model(fit.body, fit.samples, effects, fit.train_mask, fit.scale, fit.config, fit.counted, nuisance,
                     fit.corrected if same else None)


def correcting(effects: Sequence[Effect]) -> list[Effect]:
    """Those of the effects that correct the body or the inputs."""
    return [effect for effect in effects if type(effect).correct is not Effect.correct]


def predicted(columns: Array, coefficients: Array) -> Array:
    """(N, n) ``columns @ coefficients`` of columns (N, n, c) as one product; one for each sample is much slower."""
    return np.asarray((columns.reshape(-1, columns.shape[2]) @ coefficients).reshape(columns.shape[:2]))


def reweighted(fit: Fit, scale: Array) -> Fit:
    """The same model fitted with other weights."""
    return _least_squares(_with_columns(fit, scale=scale, theta=fit.prior_mean(), residual=fit.at_prior))


def refit_weights(first: Fit) -> Fit:
    """The same fit with each channel weighed by its own residual."""
    return reweighted(first, first.scale_of(first.residual))


def _least_squares(start: Fit) -> Fit:
    """The fit from a start at the prior mean."""
    right = np.zeros(start.columns.shape[2])
    for channel, (rows, felt) in enumerate(zip(start.rows, start.felt, strict=True)):
        right[felt] += rows.T @ start.residual[start.in_use[channel], channel] / start.scale[channel]**2
    change = cho_solve(start.factor, right)
    residual = start.residual - predicted(start.columns, change)
    fitted = _with_columns(start, theta=start.theta + change, residual=residual)
    fitted.__dict__['factor'] = start.factor  # it depends on columns and weights alone
    return fitted


def _with_columns(fit: Fit, *, theta: Array, residual: Array, scale: Array | None = None) -> Fit:
    """The same samples and effects, and so the same columns, with other values."""
    other = replace(fit, scale=fit.scale if scale is None else scale, theta=theta, residual=residual)
    other.__dict__.update({name: fit.__dict__[name] for name in OF_COLUMNS if name in fit.__dict__})
    return other


def _solve(inner: Array, right: Array, power: Array, absorbed: float) -> tuple[Array, Array, int]:
    """Least squares from normal equations, leaving out directions absorbed by others (``power``: squared columns)."""
    size = np.sqrt(np.maximum(power, 1e-300))
    values, vectors = eigh(inner / np.outer(size, size))
    keep = values > absorbed
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T / np.outer(size, size)
    return inverse @ right, inverse, int(keep.sum())
