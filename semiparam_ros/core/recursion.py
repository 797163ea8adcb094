"""Recursive regularised least squares for y = C theta + (phi' (x) I_n) alpha + e, exact and with
square roots.

Every output shares the features, so the estimate needs one D x D root and one p x p root, not a (p
+ D n)^2 one. The features regress the outputs and the coupled columns together; what they cannot
explain of the columns carries theta (docs/mathematics.md derives it):

    Theta : D x n (p + 1)     coefficients of [C | y] on phi, output by output
    S     : D x D             P = S S', covariance of the feature weights given theta
    f = S' phi,  s = sigma^2 + f'f,  E = [C | y] - phi' Theta
    Theta += g E  with g = S f / s,   S -= S f f' / (s + sigma sqrt(s))           (Potter 1963)
    R     : (p + 1) square    R'R = prior + sum E' N^-2 E / s   (triangular; updated by QR; the last column of C first)
    theta = R_CC^-1 R_Cy,     alpha = Theta_y - Theta_C theta

with N = diag(scale): outputs whose noise differs share S too, when sigma and rho are told in units
of each output's own. A part of y that is known beforehand counts as one that phi' Theta says.

A sample may be noisier than others in some outputs, by a variance d: then s scale^2 + d stands for s scale^2 in R and
in the predictions. S, which is shared, does not know it.

R has the columns of C in reverse. Those of friction and offset stand last in C and each acts on one
output alone: taken first, a row has zeros for all but its own, which cost nothing.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from copy import deepcopy
from itertools import count
from math import ceil, log, sqrt
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dtrtrs

from semiparam_ros.core.alternative import BETTER_TOLD, Alternative
from semiparam_ros.core.compiled import Integers, Matrix, Vector, compiled, direct
from semiparam_ros.core.square_root_filter import (
    Projection,
    Root,
    SquareRootFilter,
    project,
    variance,
    wait,
)
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.errors import SemiparamError

TOGETHER = 3
"""Rows that a reflection takes in at a time."""

REVISIONS = count(secrets.randbits(60))
"""Numbers the states of all models. It starts at random, so that no two processes give the same
number."""

LARGEST_LOSS = log(1e4)
"""Of the information of a weight that is not excited, what may be forgotten before its prior is
renewed [nat]."""

_LEARNT = ('theta', '_weights', '_regression', '_prior_information', '_renewed')
"""What changes places with that of :attr:`SemiParametricRecursion.before`."""


class Prior(NamedTuple):
    """Prediction of one sample before its output is seen, with the parts that learning reuses."""

    mean: Vector  # (n,) predicted outputs
    covariance: Matrix  # (n, n) of the outputs, noise included
    std: Vector  # (n,) of each output, noise included
    phi: Vector  # (D,) features
    projection: Projection  # with phi' Theta (n, p + 1), of y with what is known of it, row by row
    extra_variance: Vector  # (n,) variance of each output's noise in this sample alone, beyond that of all
    columns: Matrix  # (n, p) the coupled columns
    revision: int  # of the model that it was computed from


class Regression(NamedTuple):
    """Regression of what the features leave of the outputs on what they leave of the columns; R is
    changed in place."""

    information: Matrix  # (p + 1, p + 1) R
    scale: Vector  # (n,) of each output
    sigma: float
    tempered_sigma: float  # sigma of a sample that is learnt, which tells less where noise is correlated


class Update(NamedTuple):
    """Change by one sample."""

    theta: Vector  # (p,)
    innovations: Matrix  # (n, p + 1) E, y last
    gain: Vector  # (D,) g


class SemiParametricRecursion:
    """One linear-Gaussian model, updated a sample at a time.

    :param n_features: D, 0 for a purely parametric model.
    :param prior_std: (p,) standard deviations of theta, empty for a purely non-parametric model.
    :param rho: standard deviation of every feature weight, in units of its output's scale.
    :param sigma: standard deviation of the noise of every output, in the same units.
    :param prior_mean: (p,) mean of theta, zero unless given.
    :param forgetting: weight of the past after each sample, in (0, 1]; 1 never forgets.
    :param scale: (n,) scale of each output, in its unit; 1 unless given.
    :param autocorrelation_time: r, samples of this noise that together tell as much as one of white noise.
    :raises SemiparamError: a standard deviation that is not positive and finite, or forgetting
        outside (0, 1].
    """

    def __init__(self, n_outputs: int, n_features: int, prior_std: Array, rho: float, sigma: float,
                 prior_mean: Array | None = None, forgetting: float = 1.0, scale: Array | None = None,
                 autocorrelation_time: float = 1.0) -> None:
        self.n_outputs, self.n_features, self.n_columns = n_outputs, n_features, len(prior_std)
        self.sigma, self.rho, self.forgetting = float(sigma), float(rho), float(forgetting)
        self._prior_std = np.array(prior_std, dtype=float)
        self.scale = np.ones(n_outputs) if scale is None else np.array(scale, dtype=float)
        self._check()
        self.theta = np.zeros(self.n_columns) if prior_mean is None else np.array(prior_mean, dtype=float)
        self._weights = SquareRootFilter(n_features, rho, (self.n_columns + 1) * n_outputs)
        self._renewed = 0
        self.before: SemiParametricRecursion | None = None
        """As it was before the robot last changed, with its own :attr:`before`, which has none."""
        self.alternative = Alternative()
        """Evidence of :attr:`before` over this model."""
        self._of_any_kind = False
        """Whether the last change left everything in doubt."""
        self._prior_information: Array = np.diag(self._prior_std**-2)
        """(p, p) of R'R, what is the prior's and not the samples': it is forgotten and renewed."""
        self._regression = Regression(self._prior_root(), self.scale, self.sigma,
                                      self.sigma * sqrt(autocorrelation_time))
        self._nothing_known = np.zeros(n_outputs)
        self.revise()

    def _prior_root(self) -> Array:
        """(p + 1, p + 1) R of the prior about theta."""
        root = np.zeros((self.n_columns + 1, self.n_columns + 1))
        diagonal = np.arange(self.n_columns)
        root[diagonal, diagonal] = 1.0 / self._prior_std[::-1]
        root[:-1, -1] = (self.theta / self._prior_std)[::-1]
        return root

    def predict(self, phi: Array, columns: Array, known: Array | None = None,
                extra_variance: Array | None = None) -> Prior:
        """Mean and covariance of the outputs at features (D,) and coupled columns (n, p).

        :param known: (n,) part of the outputs that the model does not have to learn.
        :param extra_variance: (n,) variance of each output's noise in this sample, beyond sigma^2 scale^2; 0 unless
            given.
        """
        n, known = self.n_outputs, self._nothing_known if known is None else known
        extra_variance = self._nothing_known if extra_variance is None else extra_variance
        size, n_estimates = self.n_features, n * (self.n_columns + 1)
        projection = Projection(np.empty(size), np.empty(size), np.empty(n_estimates))
        prior = Prior(np.empty(n), np.empty((n, n)), np.empty(n), np.ascontiguousarray(phi),
                      projection, extra_variance, np.ascontiguousarray(columns), self.revision)
        _predict(self._weights.root, self._regression, self.theta, known, prior)
        return prior

    def learn(self, prior: Prior, outputs: Array) -> Update:
        """Learn the outputs (n,) of the sample that ``prior`` was computed for; what it changed.

        Raises SemiparamError, with nothing changed, when the model has changed since.
        """
        self.require_current(prior)
        update = Update(np.empty(self.n_columns), np.empty((self.n_outputs, self.n_columns + 1)),
                        np.empty(self.n_features))
        self.take_over(update.theta, learn(*self.arrays, prior, outputs, update))
        return update

    def follow_change(self, directions: Array | None = None) -> None:
        """The robot has changed: theta and the weights stay what they are, their covariance grows, and
        what was known is kept :attr:`before`.

        :param directions: (p, k) L, theta has become theta + L delta with delta ~ N(0, I); None: by as
            much as the prior expects of any robot, the weights too.
        """
        known, self.before = self.before, None
        self.alternative.clear()
        self.before = deepcopy(self)
        self.before.before = known
        if known is not None:
            known.before = None
        self._of_any_kind = directions is None
        if directions is None:
            self._prior_information = np.diag(self._prior_std**-2)
            self._go_on(self._prior_root(), np.zeros((self.n_columns, self.n_columns)), self.rho)
            return
        white = self.theta_covariance(white=True) + directions @ directions.T
        self._go_on(*self._moved(directions))
        r = (self._regression.tempered_sigma / self.sigma) ** 2
        if r > 1.0:  # L L' holds for the covariance under white noise too
            root = self.theta_root()
            self._prior_information = (r * root.T @ root - np.linalg.inv(white)) / (r - 1.0)

    def _go_on(self, information: Array, kept: Array, deviation: float | None = None) -> None:
        """Go on with R of theta; the weights to expect follow theta by G (p, p) of what they did."""
        estimates = self._weights.estimates().reshape(self.n_outputs, self.n_columns + 1, self.n_features)
        of_columns = estimates[:, :-1].copy()
        estimates[:, :-1] = np.einsum('cd,ncf->ndf', kept, of_columns)
        estimates[:, -1] += self.theta @ (estimates[:, :-1] - of_columns)
        self._weights.begin(deviation, estimates.reshape(len(self._weights.root.places), -1))
        self._regression = self._regression._replace(information=information)
        self.revise()

    def _moved(self, directions: Array) -> tuple[Array, Array]:
        """(p + 1, p + 1) R of theta + L delta, and (p, p) G = P (P + L L')^-1 with P = (R'R)^-1, for L (p, k).

        Of what is known of theta G (theta' - theta) goes on. With R L = U s V' the new R'R is
        R' (I - U s^2 / (1 + s^2) U') R, and G = I - L V s / (1 + s^2) U' R.
        """
        root, along = self._regression.information[:-1, :-1], directions[::-1]
        left, s, right = np.linalg.svd(root @ along, full_matrices=False)
        shrunk = root - left @ ((1.0 - 1.0 / np.sqrt(1.0 + s**2))[:, None] * (left.T @ root))
        kept = np.eye(self.n_columns) - along @ right.T @ ((s / (1.0 + s**2))[:, None] * (left.T @ root))
        information = np.zeros_like(self._regression.information)
        information[:-1, :-1] = np.linalg.qr(shrunk, mode='r')
        information[:-1, -1] = information[:-1, :-1] @ self.theta[::-1]
        return information, kept[::-1, ::-1]

    @property
    def as_before_s(self) -> float:
        """[s] How long the robot is as it was before, where it is told to have changed; 0 where it is not."""
        return self.alternative.seconds if self.alternative.nats > BETTER_TOLD else 0.0

    def go_back(self) -> None:
        """Change places with the model from before; where there is none, the robot has changed.

        Where everything was in doubt, the change is forgotten if one before it is known: it was none.
        """
        before = self.before
        self.alternative.clear()
        if before is None:
            self.follow_change()
            return
        for name in _LEARNT:
            mine, its = getattr(self, name), getattr(before, name)
            setattr(self, name, its)
            setattr(before, name, mine)
        if self._of_any_kind and before.before is not None:
            self.before, self._of_any_kind = before.before, before._of_any_kind
        self.revise()

    @property
    def arrays(self) -> tuple[Root, Regression]:
        """Arrays that :func:`learn` changes in place; :meth:`take_over` follows it."""
        return self._weights.root, self._regression

    def take_over(self, theta: Array, placed: int) -> None:
        """Go on with what :func:`learn` has found."""
        self.revise()
        self.theta = theta
        if self.n_features:
            self._weights.has_changed(placed)
        if self.forgetting < 1.0:
            self._forget(self.forgetting)

    def revise(self) -> None:
        """Make every prior computed so far stale; each change of the model does."""
        self.revision = next(REVISIONS)

    def require_current(self, prior: Prior) -> None:
        """Raise SemiparamError unless ``prior`` was computed by this model as it stands."""
        if prior.revision != self.revision:
            raise SemiparamError('the prediction is stale: the model has changed since it was made, or it is that of '
                                 'another model; expected a prediction by the model as it stands.')

    def weights(self) -> Array:
        """(n, D) feature weights alpha' of each output."""
        estimates = self._weights.estimates().reshape(self.n_outputs, self.n_columns + 1, self.n_features)
        return np.asarray(np.append(-self.theta, 1.0) @ estimates)

    def theta_covariance(self, white: bool = False) -> Array:
        """(p, p) covariance of theta given the features' prior and all samples learnt.

        :param white: as if each sample told as much as one of white noise: R'R then holds r times what it
            has of the samples, and the same of the prior.
        """
        inverse, _ = dtrtrs(self._regression.information[:-1, :-1], np.eye(self.n_columns))
        if white:
            more = (self._regression.tempered_sigma / self.sigma) ** 2 - 1.0
            of_prior = inverse.T @ self._prior_information[::-1, ::-1] @ inverse
            shares, directions = np.linalg.eigh(of_prior)  # of the prior in R'R
            inverse = inverse @ directions / np.sqrt(1.0 + more * (1.0 - np.clip(shares, 0.0, 1.0)))
        return np.asarray((inverse @ inverse.T)[::-1, ::-1])

    def theta_root(self) -> Array:
        """(p, p) R of the information R'R, which is the inverse of :meth:`theta_covariance`."""
        return np.asarray(self._regression.information[:-1, :-1][:, ::-1])

    def state(self) -> dict[str, Array | Indices]:
        """Everything learnt, as arrays; :meth:`restore` takes them back bit for bit."""
        before = {} if self.before is None else self.before.state()
        return {**self._weights.state(), 'renewed': np.array([self._renewed, self.alternative.stamp]),
                'back': np.array([self.alternative.nats, self.alternative.seconds, self._of_any_kind]),
                'information': self._regression.information.copy(),
                'prior_information': self._prior_information.copy(), 'theta': self.theta.copy(),
                **{f'before.{name}': values for name, values in before.items()}}

    def restore(self, state: Mapping[str, Array | Indices]) -> None:
        """Return to a saved :meth:`state`; every prior computed before is then stale.

        Raises SemiparamError when it is that of other sizes or not finite.
        """
        if any(name.startswith(3 * 'before.') for name in state):
            raise SemiparamError('the saved model knows what was before three changes; expected two at most.')
        then = {name.removeprefix('before.'): values for name, values in state.items() if name.startswith('before.')}
        for name, mine in self.state().items():
            if name.startswith('before.'):
                continue
            given = np.asarray(state.get(name, np.nan))
            if given.shape != mine.shape or not np.isfinite(given).all():
                raise SemiparamError(f"the saved '{name}' has shape {given.shape}; expected finite values of shape "
                                     f'{mine.shape} for {self.n_outputs} outputs, {self.n_features} features and '
                                     f'{self.n_columns} columns.')
        self.revise()
        self._weights.restore(state)
        alternative = self.alternative = Alternative()
        self._renewed, alternative.stamp = np.asarray(state['renewed']).tolist()
        alternative.nats, alternative.seconds, of_any_kind = np.asarray(state['back']).tolist()
        self._of_any_kind = bool(of_any_kind)
        self._regression = self._regression._replace(
            information=np.array(state['information'], dtype=float, order='C'))
        self._prior_information = np.array(state['prior_information'], dtype=float)
        self.theta = np.array(state['theta'], dtype=float)
        self.before = None
        if then:
            before = deepcopy(self)
            before.restore(then)
            self.before = before

    def _check(self) -> None:
        deviations = [self.sigma, *self._prior_std, *self.scale, *([self.rho] if self.n_features else [])]
        if not all(np.isfinite(value) and value > 0.0 for value in deviations):
            raise SemiparamError(f'the model has standard deviations sigma {self.sigma}, rho {self.rho} and for theta '
                                 f'{self._prior_std.tolist()}, and scales {self.scale.tolist()}; expected positive '
                                 'finite ones.')
        if not 0.0 < self.forgetting <= 1.0:
            raise SemiparamError(f'forgetting is {self.forgetting}; expected a value above 0 and at most 1.')

    def _forget(self, factor: float) -> None:
        """Weigh the past less, and renew what of the prior is forgotten so."""
        self._regression.information[:] *= np.sqrt(factor)
        self._prior_information *= factor
        if self.n_features:
            self._weights.inflate(1.0 / np.sqrt(factor))
        self._renew(factor)

    def _renew(self, factor: float) -> None:
        """Renew the prior of one feature weight and one coefficient in turn, of which each round
        forgets by ``factor`` for each sample.

        What the motion no longer excites would otherwise lose all information, the prior's
        included: its variance would grow without bound while the robot stands still, and the model
        would burst when it moves again. Each renewal says, with the prior's standard deviation,
        that a weight stays what it is; no estimate moves. Where much is forgotten within a round,
        several are renewed for each sample: what waits for its turn keeps its digits.
        """
        for size, renew in ((self.n_features, self._renew_weight), (self.n_columns, self._renew_coefficient)):
            times = max(1, ceil(size * log(1.0 / factor) / LARGEST_LOSS))
            for number in range(times if size else 0):
                renew((self._renewed * times + number) % size, factor**ceil(size / times))
        self._renewed += 1

    def _renew_weight(self, index: int, kept: float) -> None:
        unit = np.zeros(self.n_features)
        unit[index] = 1.0
        self._weights.learn(self._weights.project(unit), self.rho / np.sqrt(1.0 - kept))

    def _renew_coefficient(self, index: int, kept: float) -> None:
        row = np.zeros((1, self.n_columns + 1))
        weight = np.sqrt(1.0 - kept) / self._prior_std[index]
        row[0, self.n_columns - 1 - index], row[0, -1] = weight, weight * self.theta[index]
        triangular(self._regression.information, row, 1)
        self._prior_information[index, index] += weight**2


@compiled
def predict(root: Root, regression: Regression, theta: Vector, known: Vector, prior: Prior) -> None:
    """Fill the arrays of a prior, but for features and columns."""
    columns, mean, covariance, std = prior.columns, prior.mean, prior.covariance, prior.std
    information, scale = regression.information, regression.scale
    n, p = columns.shape
    regressed = prior.projection.regressed.reshape((n, p + 1))
    project(root, prior.phi, prior.projection)
    s = variance(prior.projection.f, regression.sigma)
    half = np.empty((n, p))  # E_C R^-1
    for k in range(n):
        regressed[k, p] += known[k]
        value = regressed[k, p]
        for c in range(p):
            value += (columns[k, c] - regressed[k, c]) * theta[c]
        for c in range(p):  # apart: beside a store, where arrays lie in memory decides in which order the sum is taken
            half[k, p - 1 - c] = columns[k, c] - regressed[k, c]
        mean[k] = value
    for c in range(p):
        below = information[c]
        for k in range(n):
            own = half[k]
            own[c] /= below[c]
            factor = own[c]
            if factor != 0.0:
                for later in range(c + 1, p):
                    own[later] -= factor * below[later]
    for k in range(n):
        for j in range(k, n):
            value = 0.0
            for c in range(p):
                value += half[k, c] * half[j, c]
            covariance[k, j] = covariance[j, k] = value
        covariance[k, k] += s * scale[k] * scale[k] + prior.extra_variance[k]
        std[k] = np.sqrt(covariance[k, k])


_predict = direct(predict)


@compiled
def reflect(pivot: Vector, rows: Matrix, used: Integers, count: int, c: int, share: float,
            unit: float, along: Vector) -> None:
    """One reflection of a row of R and the ``used`` rows, ``TOGETHER`` of them at a time, beyond
    column ``c``."""
    size = len(pivot)
    for j in range(c + 1, size):
        along[j] = pivot[j]
    for g in range(0, count, TOGETHER):
        one, two, three = rows[used[g]], rows[used[g + 1]], rows[used[g + 2]]
        first, second, third = one[c] * unit, two[c] * unit, three[c] * unit
        for j in range(c + 1, size):
            along[j] += first * one[j] + second * two[j] + third * three[j]
    for j in range(c + 1, size):
        along[j] *= share
        pivot[j] -= along[j]
    for g in range(0, count, TOGETHER):
        one, two, three = rows[used[g]], rows[used[g + 1]], rows[used[g + 2]]
        first, second, third = one[c] * unit, two[c] * unit, three[c] * unit
        for j in range(c + 1, size):
            one[j] -= first * along[j]
            two[j] -= second * along[j]
            three[j] -= third * along[j]


@compiled
def triangular(information: Matrix, rows: Matrix, n: int) -> None:
    """R as ``information`` with ``n`` further rows: one, or several after which ``TOGETHER - 1`` of
    zeros stand.

    A reflection takes only the rows that are not zero in its column.
    """
    size = len(information)
    along, used = np.empty(size), np.empty(len(rows), dtype=np.int64)
    for c in range(size):
        below, count = 0.0, 0
        for k in range(n):
            if rows[k, c] != 0.0:
                below += rows[k, c] * rows[k, c]
                used[count] = k
                count += 1
        if below == 0.0:
            continue
        pivot = information[c]
        corner = pivot[c]
        radius = -np.copysign(np.sqrt(corner * corner + below), corner)
        share, unit = (radius - corner) / radius, 1.0 / (corner - radius)
        pivot[c] = radius
        if count == 1:
            row = rows[used[0]]
            factor = row[c] * unit
            for j in range(c + 1, size):
                step = (pivot[j] + factor * row[j]) * share
                pivot[j] -= step
                row[j] -= factor * step
        else:
            used[count], used[count + 1] = n, n + 1
            reflect(pivot, rows, used, count, c, share, unit, along)


@compiled
def learn(root: Root, regression: Regression, prior: Prior, outputs: Vector, update: Update) -> int:
    """Fill an update, and take it in: [S | Theta] changes, and R gets further rows, after which
    reflections make it triangular again (Householder). How many estimates have a place now."""
    columns, information = prior.columns, regression.information
    theta, innovations, gain = update
    n, size = innovations.shape
    regressed = prior.projection.regressed.reshape((n, size))
    s = variance(prior.projection.f, regression.tempered_sigma)
    for i in range(len(gain)):
        gain[i] = prior.projection.reach[i] / s
    for k in range(n):
        for c in range(size - 1):
            innovations[k, c] = columns[k, c] - regressed[k, c]
        innovations[k, size - 1] = outputs[k] - regressed[k, size - 1]
    placed = wait(root, prior.projection, innovations.reshape(n * size), regression.tempered_sigma)
    if size == 1:
        return placed
    rows = np.zeros((n + TOGETHER - 1, size))  # those beyond n stay zero
    r = (regression.tempered_sigma / regression.sigma) ** 2
    for k in range(n):
        weight = 1.0 / np.sqrt(s * regression.scale[k] * regression.scale[k] + r * prior.extra_variance[k])
        for c in range(size - 1):
            rows[k, size - 2 - c] = weight * innovations[k, c]
        rows[k, size - 1] = weight * innovations[k, size - 1]
    triangular(information, rows, n)
    backward = np.empty(size - 1)
    for c in range(size - 2, -1, -1):
        value = information[c, size - 1]
        for j in range(c + 1, size - 1):
            value -= information[c, j] * backward[j]
        backward[c] = theta[size - 2 - c] = value / information[c, c]
    return placed
