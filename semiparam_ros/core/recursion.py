"""Recursive regularised least squares for y = C theta + (phi' (x) I_n) alpha + e, exact and with square roots.

Every output shares the features, so the estimate needs one D x D root and one p x p root, not a (p + D n)^2 one. The
features regress the outputs and the coupled columns together; what they cannot explain of the columns carries theta:

    Theta : D x (1 + p) n     coefficients of [y | C] on phi
    S     : D x D             P = S S', covariance of each column of Theta over sigma^2-free noise
    f = S' phi,  s = sigma^2 + f'f,  E = [y | C] - phi' Theta
    Theta += (S f / s) E',   S -= S f f' / (s + sigma sqrt(s))           (Potter 1963)
    R     : (p + 1) square    R'R = prior + sum [E_C | E_y]'[E_C | E_y] / s   (triangular; updated by QR)
    theta = R_CC^-1 R_Cy,     alpha = Theta_y - Theta_C theta
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dgemv, dger
from scipy.linalg.lapack import dtpqrt, dtrtrs

from semiparam_ros.core.types import Array

RENORMALISE_ABOVE = 1e3


class Prior(NamedTuple):
    """What the model says of one sample before seeing its output, with the parts that learning reuses."""

    mean: Array  # (n,) predicted outputs
    covariance: Array  # (n, n) of the outputs, noise included
    phi: Array  # (D,)
    f: Array  # (D,) S' phi
    s: float  # sigma^2 + f'f
    regressed: Array  # (1 + p, n) phi' Theta
    columns_left: Array  # (n, p) E_C, what the features leave of the coupled columns


class SemiParametricRecursion:
    """One linear-Gaussian model, updated a sample at a time.

    :param n_features: D, 0 for a purely parametric model.
    :param prior_std: (p,) standard deviations of theta, empty for a purely non-parametric model.
    :param rho: standard deviation of every feature weight.
    :param sigma: standard deviation of the noise of every output (scale outputs beforehand when they differ).
    :param prior_mean: (p,) mean of theta, zero unless given.
    :param forgetting: weight of the past after each sample, in (0, 1]; 1 never forgets.
    """

    def __init__(self, n_outputs: int, n_features: int, prior_std: Array, rho: float, sigma: float,
                 prior_mean: Array | None = None, forgetting: float = 1.0) -> None:
        self.n_outputs, self.n_features, self.n_columns = n_outputs, n_features, len(prior_std)
        self.sigma, self.forgetting = float(sigma), float(forgetting)
        self.theta = np.zeros(self.n_columns) if prior_mean is None else np.array(prior_mean, dtype=float)
        self._root = np.asfortranarray(rho * np.eye(n_features))
        self._inflation = 1.0  # S is stored as S / inflation, so that forgetting costs nothing
        self._coefficients = np.zeros((1 + self.n_columns, n_outputs, n_features))
        self._information = np.zeros((self.n_columns + 1, self.n_columns + 1), order='F')
        diagonal = np.arange(self.n_columns)
        self._information[diagonal, diagonal] = 1.0 / np.asarray(prior_std)
        self._information[:-1, -1] = self.theta / np.asarray(prior_std)

    def predict(self, phi: Array, columns: Array) -> Prior:
        """Mean and covariance of the outputs at features (D,) and coupled columns (n, p)."""
        f, s, regressed = self._project(phi)
        left = columns - regressed[1:].T
        mean = regressed[0] + left @ self.theta
        covariance = s * np.eye(self.n_outputs)
        if self.n_columns:
            half, _ = dtrtrs(self._information[:-1, :-1], left.T, trans=1)
            covariance += half.T @ half
        return Prior(mean, covariance, phi, f, s, regressed, left)

    def learn(self, prior: Prior, outputs: Array) -> None:
        """Learn the outputs (n,) of the sample that ``prior`` was computed for, by this model as it stands."""
        innovations = np.vstack([outputs - prior.regressed[0], prior.columns_left.T])
        if self.n_features:
            self._update_features(prior, innovations)
        if self.n_columns:
            self._update_information(innovations / np.sqrt(prior.s))
        if self.forgetting < 1.0:
            self._forget()

    def weights(self, out: Array | None = None) -> Array:
        """(n, D) feature weights alpha' of each output, written into ``out`` when given."""
        flat = self._coefficients.reshape(1 + self.n_columns, -1)
        signs = np.concatenate([[1.0], -self.theta])
        target = np.empty((self.n_outputs, self.n_features)) if out is None else out
        np.dot(signs, flat, out=target.reshape(-1))
        return target

    def theta_covariance(self) -> Array:
        """(p, p) covariance of theta given the features' prior and all samples learnt."""
        inverse, _ = dtrtrs(self._information[:-1, :-1], np.eye(self.n_columns))
        return np.asarray(inverse @ inverse.T)

    def state(self) -> dict[str, Array]:
        """Everything learnt, as arrays; :meth:`restore` takes them back bit for bit."""
        return {'root': self._root.copy(order='F'), 'inflation': np.array(self._inflation),
                'coefficients': self._coefficients.copy(), 'information': self._information.copy(order='F'),
                'theta': self.theta.copy()}

    def restore(self, state: dict[str, Array]) -> None:
        """Return to a saved :meth:`state` of a recursion of the same sizes."""
        self._root = np.array(state['root'], order='F')
        self._inflation = float(state['inflation'])
        self._coefficients = np.array(state['coefficients'], order='C')
        self._information = np.array(state['information'], order='F')
        self.theta = np.array(state['theta'])

    def _project(self, phi: Array) -> tuple[Array, float, Array]:
        if not self.n_features:
            return phi, self.sigma**2, np.zeros((1 + self.n_columns, self.n_outputs))
        f = dgemv(self._inflation, self._root, phi, trans=1)
        regressed = dgemv(1.0, self._coefficients.reshape(-1, self.n_features).T, phi, trans=1)
        return f, self.sigma**2 + float(f @ f), regressed.reshape(1 + self.n_columns, self.n_outputs)

    def _update_features(self, prior: Prior, innovations: Array) -> None:
        f, s = prior.f, prior.s
        gain = dgemv(self._inflation / s, self._root, f)
        flat = self._coefficients.reshape(-1, self.n_features).T
        dger(1.0, gain, innovations.ravel(), a=flat, overwrite_a=1)
        shrink = s / (self._inflation * (s + self.sigma * np.sqrt(s)))
        self._root = dger(-shrink, gain, f, a=self._root, overwrite_a=1)

    def _update_information(self, innovations: Array) -> None:
        rows = np.asfortranarray(np.vstack([innovations[1:], innovations[:1]]).T)
        size = self.n_columns + 1
        self._information, _, _, _ = dtpqrt(0, min(size, 8), self._information, rows, overwrite_a=1, overwrite_b=1)
        self.theta, _ = dtrtrs(self._information[:-1, :-1], self._information[:-1, -1])

    def _forget(self) -> None:
        self._inflation /= np.sqrt(self.forgetting)
        self._information *= np.sqrt(self.forgetting)
        if self._inflation > RENORMALISE_ABOVE:
            self._root *= self._inflation
            self._inflation = 1.0
