"""Weighted least squares of the declared model, and of further columns on its residual."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.hyperparameters.window import residual_scale
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Indices, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import sliding
from semiparam_ros.diagnosis.data.splits import correlation_times
from semiparam_ros.diagnosis.design import Design, Part, PartInUse, SamplesInUse, flat
from semiparam_ros.effects import Effect, kinds

LARGE = ('corrected', 'samples_in_use', 'design', 'residual_in_use', 'asked', 'sums', 'sliding')
"""What a fit computes when it is asked for: far more than the rest of it, where samples are many."""
OF_COLUMNS = ('assembly', 'prior_deviation', 'corrected', 'samples_in_use', 'design', 'at_prior', 'prior_moments')
"""What neither its weights nor its outputs change."""
ROUNDED = 1e-9
"""Share of the squares from which on a difference of their sums keeps enough digits."""


class Products(NamedTuple):
    """Products of further columns in one channel: their numbers (a,), products with one another (a, a), with the
    residual (a,) and with the declared columns that the channel feels (p_k, a), of the samples in use."""

    channel: int
    acting: Indices
    inner: Array
    right: Array
    shared: Array


@dataclass(frozen=True, eq=False)
class Explained:
    """Part that columns (N, n, c) explain beyond the declared ones of a fit.

    :param products: those of the columns. :param coefficients: (c,).
    :param rank: directions that the declared columns do not hold already; a share of each that the prior tells too.
    :param refit: (p,) by which the coefficients of the declared columns change.
    :param loss: what is left of the fit's, where nothing is known of the coefficients.
    """

    fit: Fit
    columns: Array
    products: list[Products]
    coefficients: Array
    rank: float
    refit: Array
    loss: float

    @cached_property
    def residual(self) -> Array:
        """(N, n) left afterwards, in the outputs' units."""
        return self.fit.residual - predicted(self.columns, self.coefficients) - self.fit.design.predicted(self.refit)

    @cached_property
    def squares(self) -> Array:
        """(n,) sum of squares that is left of the samples in use."""
        fit, left = self.fit, self.fit.squares.copy()
        refit = [self.refit[support] for support in fit.design.support]
        for channel, (gram, moment) in enumerate(zip(fit.design.grams, fit.moments, strict=True)):
            left[channel] += refit[channel] @ (gram @ refit[channel] - 2.0 * moment)
        for channel, acting, inner, right, shared in self.products:
            own = self.coefficients[acting]
            left[channel] += own @ (inner @ own + 2.0 * (shared.T @ refit[channel] - right))
        if (left < ROUNDED * fit.squares).any():  # too small a difference of large sums
            return np.asarray((fit.used(self.residual) ** 2).sum(axis=0))
        return left


@dataclass(frozen=True, eq=False)
class Fit:
    """The declared model fitted to the samples where ``train_mask`` is true.

    :param train_mask: (N,) samples that fit. :param counted: (N, n) outputs that tell something, in use or not.
    :param scale: (n,) weight of channel k is 1 / scale[k]^2. :param theta: (p,).
    :param residual: (N, n) of all samples, in the outputs' units. :param declared: the effects as they were declared.
    :param considered: the kinds of effects among which a search chooses, by name.
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
    declared: tuple[Effect, ...] = ()
    considered: Mapping[str, type[Effect]] = field(default_factory=dict)

    @cached_property
    def assembly(self) -> CoupledColumns:
        """The rigid body's columns, the offset's and those of the effects."""
        return CoupledColumns(self.body, self.effects, physical=True)

    @cached_property
    def corrected(self) -> tuple[RigidBody, Samples]:
        """The body and the inputs as the declared effects correct them."""
        body, inputs, _ = self.assembly.corrected(self.samples)
        return body, inputs

    @cached_property
    def samples_in_use(self) -> SamplesInUse:
        """Samples that fit and count."""
        return SamplesInUse(self.train_mask, self.counted, self.config.blocks)

    @cached_property
    def design(self) -> Design:
        """C in parts: those of the rigid body, the offset and the effects, then the nuisance columns."""
        return self._designed(())

    def _designed(self, known: Sequence[tuple[Effect | str, PartInUse]]) -> Design:
        """The design with parts of another one that are ``known`` to be the same, by their effect or their name."""
        parts, samples = [], self.samples_in_use
        for name, columns in self._columns():
            found = next((part for each, part in known if each == name), None)
            if found is None or found.samples is not samples:
                found = PartInUse(Part(columns()) if found is None else found.part, samples)
            parts.append(found)
        return Design(parts, samples)

    def _columns(self) -> Iterator[tuple[Effect | str, Callable[[], Array]]]:
        """The effect or the name of each part of C, and what computes its columns (N, n, c)."""
        assembly, (body, inputs) = self.assembly, self.corrected
        yield 'rigid_body', partial(assembly.rigid, body, inputs)
        yield 'offset', partial(assembly.offset, len(inputs))
        for index, effect in enumerate(self.effects):
            yield effect, partial(assembly.of_effect, index, body, inputs)
        if (nuisance := self.nuisance) is not None:
            yield 'nuisance', lambda: nuisance

    @property
    def n_columns(self) -> int:
        """p."""
        return self.design.n_columns

    @cached_property
    def asked(self) -> dict[object, Any]:
        """Derivatives of the prediction that were asked for, by what of."""
        return {}

    @cached_property
    def sums(self) -> dict[object, Any]:
        """Sums of blocks that were asked for, by what of."""
        return {}

    @cached_property
    def at_prior(self) -> Array:
        """(N, n) outputs less those of the prior mean, in the outputs' units."""
        return self.samples.outputs - self.design.predicted(self.prior_mean())

    @cached_property
    def factor(self) -> tuple[Array, bool]:
        """Cholesky factor of the regularised normal matrix."""
        normal = np.diag(self.prior_deviation ** -2.0)
        for gram, support, scale in zip(self.design.grams, self.design.support, self.scale, strict=True):
            normal[np.ix_(support, support)] += gram / scale**2
        try:
            return cho_factor(normal)  # type: ignore[no-any-return]
        except np.linalg.LinAlgError:
            size = np.sqrt((self.used(self.samples.outputs) ** 2).sum(axis=0) / self.counts)
            if np.all(self.scale**2 > ROUNDED * size**2):  # no wonder where there is next to no noise
                raise
            return cho_factor(normal + ROUNDED * np.diag(np.diag(normal)))  # type: ignore[no-any-return]

    @property
    def rigid_part(self) -> Array:
        """(p_psi,) base parameters."""
        return self.theta[:self.body.n_parameters]

    def coefficients_of(self, number: int) -> Array:
        """(c,) those of the effect with this number."""
        return self.theta[self.assembly.blocks[str(number)]]

    @property
    def knows_mass(self) -> bool:
        """Return whether a mass is known that tells the gains of the outputs from all other masses."""
        return any(effect.is_load and 'mass' in effect.parameters for effect in self.effects)

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

    @cached_property
    def sliding(self) -> Fit:
        """The same effects fitted to the outputs of joints that slide, with weights of their own; to all of
        a joint that hardly ever does."""
        slides = self.counted & sliding(self.samples, self.config)[:, self.body.output_index]
        few = slides[self.train_mask].sum(axis=0) < self.config.least_working_samples
        counted = np.where(few, self.counted, slides)
        return refit_weights(refitted(self, self.effects, self.nuisance, counted))

    def forget(self, *kept: str) -> None:
        """Let go of the arrays that are large and can be computed anew from the samples and the effects, but for some
        by their names in ``LARGE``."""
        for name in LARGE:
            if name not in kept:
                self.__dict__.pop(name, None)

    def used(self, values: Array) -> Array:
        """(M, n) of values (N, n) those of samples in use, zero where an output does not count."""
        return np.asarray(values[self.train_mask] * self.counted[self.train_mask])

    def scale_of(self, squares: Array) -> Array:
        """(n,) root mean square of a residual, from its sums of squares (n,) over outputs in use."""
        power = (self.used(self.samples.outputs) ** 2).sum(axis=0)
        return residual_scale(*(np.sqrt(each / self.counts)[None] for each in (squares, power)))

    def explain(self, columns: Array, prior: tuple[Array, Array] | None = None) -> Explained:
        """Regress the residual on columns (N, n, c), the declared ones refitted along.

        :param prior: (c,) means and precisions of the coefficients beforehand, in scaled units.
        """
        products = self._products(columns)
        coefficients, _, rank, cross, right = self._regressed(products, columns.shape[2], prior)
        loss = self.loss - float(right @ coefficients)
        return Explained(self, columns, products, coefficients, rank, -cross @ coefficients, loss)

    @cached_property
    def residual_in_use(self) -> list[Array]:
        """(B L,) of each channel, see :meth:`SamplesInUse.of`."""
        return [flat(self.samples_in_use.of(channel, left[None]))[0] for channel, left in enumerate(self.residual.T)]

    @cached_property
    def moments(self) -> list[Array]:
        """(p_k,) of each channel k the products of what it feels with the residual, of the samples in use."""
        return self._moments(self.residual)

    @cached_property
    def prior_moments(self) -> list[Array]:
        """The same with what the prior mean leaves."""
        return self._moments(self.at_prior)

    def _moments(self, values: Array) -> list[Array]:
        return [moment.sum(axis=0) for moment in self.design.moments(values)]

    def _products(self, columns: Array) -> list[Products]:
        """Products of further columns (N, n, c), of each channel in which they act."""
        samples, further, found = self.samples_in_use, Part(columns), []
        for channel, values in further.values.items():
            rows, acting = flat(samples.of(channel, values)), further.acting[channel]
            inner, right = rows @ rows.T, rows @ self.residual_in_use[channel]
            found.append(Products(channel, acting, inner, right, self.design.cross(channel, rows)))
        return found

    def _regressed(
            self, products: list[Products], count: int, prior: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array, float, Array, Array]:
        """Coefficients (c,), their covariance, rank, the refit (p, c) of the declared columns, and the right side."""
        inner, right = np.zeros((count, count)), np.zeros(count)
        shared = np.zeros((self.n_columns, count))
        for each in products:
            weight = self.scale[each.channel] ** -2.0
            inner[np.ix_(each.acting, each.acting)] += weight * each.inner
            right[each.acting] += weight * each.right
            shared[np.ix_(self.design.support[each.channel], each.acting)] += weight * each.shared
        cross = cho_solve(self.factor, shared)
        if prior is not None:
            right = right + prior[1] * prior[0]
            if np.all(prior[1] > 0.0):
                return *_solve_beside(inner - shared.T @ cross, right, prior[1] ** -0.5), cross, right
            inner = inner + np.diag(prior[1])
        power = np.diag(inner).copy()
        solved = _solve(inner - shared.T @ cross, right, power, self.config.negligible)
        return *solved, cross, right

    def theta_covariance(self) -> Array:
        """(p, p) of theta over the noise's variance in scaled units."""
        return np.asarray(cho_solve(self.factor, np.eye(len(self.theta))))

    def theta_beside(self, base_parameters: Array) -> Array:
        """(p,) theta with these base parameters (p_psi,), and everything else at its best beside them."""
        own, root = len(base_parameters), np.triu(self.factor[0])
        moved = root[:own, :own] @ (base_parameters - self.rigid_part)
        across = root[:own, own:].T @ moved
        inner = root[:, own:].T @ root[:, own:]
        return np.append(base_parameters, self.theta[own:] - np.linalg.solve(inner, across))

    def covariance_with(self, columns: Array) -> Array:
        """(p + c, p + c) of theta and of the coefficients of further columns (N, n, c), over the noise's variance in
        scaled units. Directions of these that theta's columns hold already count as known."""
        _, covariance, _, cross, _ = self._regressed(self._products(columns), columns.shape[2])
        across = cross @ covariance
        return np.asarray(np.block([[self.theta_covariance() + across @ cross.T, -across], [-across.T, covariance]]))

    def prior_mean(self) -> Array:
        """(p,) of theta; zero for the nuisance columns."""
        return self._with_nuisance(self.assembly.prior_mean, 0.0)

    @cached_property
    def prior_deviation(self) -> Array:
        """(p,) prior standard deviations of theta about its prior mean."""
        return self._with_nuisance(self.assembly.prior_scale, 1.0)

    def _with_nuisance(self, values: Array, each: float) -> Array:
        """Values of the coupled columns, followed by the same for each of the nuisance columns."""
        return values if self.nuisance is None else np.append(values, np.full(self.nuisance.shape[2], each))


def fit_model(body: RigidBody, samples: Samples, effects: Sequence[Effect], train_mask: Mask, scale: Array,
              config: DiagnosisConfig = DEFAULTS, counted: Mask | None = None,
              considered: Mapping[str, type[Effect]] | None = None) -> Fit:
    """Fit the rigid body, the offset and the effects by least squares, with a weak prior about the description.

    :param counted: (N, n) outputs that tell something; all unless given, and of a joint that hardly moves in the
        samples that fit.
    :param considered: the kinds among which a search chooses; all of such outputs unless given.
    """
    counted = np.ones(samples.outputs.shape, dtype=bool) if counted is None else counted
    counted = counted | (counted[train_mask].sum(axis=0) < config.least_working_samples)
    unfitted = Fit(body, samples, tuple(effects), train_mask, counted, scale, np.zeros(0), samples.outputs, config,
                   declared=tuple(effects), considered=kinds(body.outputs) if considered is None else considered)
    return reweighted(unfitted, scale)


def with_effects(fit: Fit, effects: Sequence[Effect]) -> Fit:
    """The same samples and weights fitted with these effects in place of those declared."""
    return refitted(fit, effects, fit.nuisance, fit.counted)


def refitted(fit: Fit, effects: Sequence[Effect], nuisance: Array | None, counted: Mask) -> Fit:
    """The same samples and weights with other effects, nuisance columns or outputs that count."""
    other = replace(fit, effects=tuple(effects), nuisance=nuisance, counted=counted)
    if counted is fit.counted:
        other.__dict__['samples_in_use'] = fit.samples_in_use
    if _moving(effects) == _moving(fit.effects):
        other.__dict__['corrected'] = fit.corrected
        names = [name for name, _ in fit._columns()]
        other.__dict__['design'] = other._designed([
            known for known in zip(names, fit.design.parts, strict=True)
            if known[0] != 'nuisance' or nuisance is fit.nuisance])
    return reweighted(other, fit.scale)


def _moving(effects: Sequence[Effect]) -> list[Effect]:
    """Effects that correct the body or the inputs, or shape other columns."""
    return [effect for effect in effects if not effect.only_adds]


def predicted(columns: Array, coefficients: Array) -> Array:
    """(N, n) ``columns @ coefficients`` of columns (N, n, c), in products over all samples: much faster."""
    return np.asarray((coefficients @ columns.transpose(1, 2, 0)).T)


def reweighted(fit: Fit, scale: Array) -> Fit:
    """The same model fitted with other weights."""
    start = _with_values(fit, fit.theta, fit.residual, scale, OF_COLUMNS)
    right = np.zeros(start.n_columns)
    for support, moment, each in zip(start.design.support, start.prior_moments, scale, strict=True):
        right[support] += moment / each**2
    change = cho_solve(start.factor, right)
    residual = start.at_prior - start.design.predicted(change)
    return _with_values(start, start.prior_mean() + change, residual, scale, (*OF_COLUMNS, 'factor'))


def refit_weights(first: Fit) -> Fit:
    """The same fit with each channel weighed by its own residual."""
    return reweighted(first, first.scale_of(first.squares))


def _with_values(fit: Fit, theta: Array, residual: Array, scale: Array, same: Sequence[str]) -> Fit:
    """The same samples and effects with other values, and what these leave the ``same``."""
    other = replace(fit, scale=scale, theta=theta, residual=residual)
    other.__dict__.update({name: fit.__dict__[name] for name in same if name in fit.__dict__})
    return other


def _solve(inner: Array, right: Array, power: Array, absorbed: float) -> tuple[Array, Array, int]:
    """Least squares from normal equations, leaving out directions absorbed by others (``power``: squared columns)."""
    size = np.sqrt(np.maximum(power, 1e-300))
    values, vectors = np.linalg.eigh(inner / np.outer(size, size))
    keep = values > absorbed
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T / np.outer(size, size)
    return inverse @ right, inverse, int(keep.sum())


def _solve_beside(inner: Array, right: Array, deviation: Array) -> tuple[Array, Array, float]:
    """Least squares from normal equations beside prior standard deviations (c,): as many directions count as the
    samples tell, each by the share of its variance that they take away."""
    values, vectors = np.linalg.eigh(inner * np.outer(deviation, deviation))
    values, vectors = np.maximum(values, 0.0), deviation[:, None] * vectors
    inverse = (vectors / (1.0 + values)) @ vectors.T
    return inverse @ right, inverse, float(np.sum(values / (1.0 + values)))
