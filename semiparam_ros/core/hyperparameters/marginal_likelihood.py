"""The log marginal likelihood of a window, and its gradient by the hyperparameters.

The model is y = C theta + (phi' x I) alpha + e. All outputs share phi, so after whitening by ``output_scale`` the
covariance of the stacked outputs is V = I_n x A + C Gamma C' with A = sigma^2 N + rho^2 Phi Phi'. Only A (through
min(t, D)) and a p x p matrix are ever factored. The gradient runs backwards: dL/dA once, and from it every length scale
(docs/mathematics.md, Evidence). N = I is the paper's white noise; with a drift, N = I + kappa R (see
``noise_covariance``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.hyperparameters.noise_covariance import Drift, SharedFactor
from semiparam_ros.core.types import Array, Stamps

LOG_2PI = float(np.log(2.0 * np.pi))
RANK_TOLERANCE = 1e-12
"""Directions of theta that the window excites less than this (relative, columns scaled) keep a zero estimate."""


class Slope(NamedTuple):
    """Derivatives of the log evidence by the logarithm of each hyperparameter; ``tau`` (groups,), scales (n,)."""

    gamma: float
    rho: float
    tau: Array
    sigma: float
    output_scale: Array
    kappa: float = 0.0
    memory: float = 0.0


class Evidence(NamedTuple):
    """``value`` [nat]; ``theta`` (p,): posterior mean, or the generalised least squares estimate if profiled."""

    value: float
    theta: Array
    slope: Slope | None


@dataclass(frozen=True)
class Window:
    """The data of one evidence: t samples, n outputs, p coupled columns, m scaled inputs, d frequencies.

    :param outputs: Y (t, n), in N and N m.
    :param coupled: C (t, n, p); p = 0 for a purely non-parametric model.
    :param inputs: (x - mean) / scale, (t, m).
    :param spectrum: omega (d, m), standard normal; d = 0 for a purely parametric model.
    :param groups: (m,) index of the length scale of each input.
    :param prior_scale: (p,) prior standard deviations of theta in units of gamma.
    :param step: distance of neighbouring samples in the recording, for the drift.
    :param profiled: theta is a hyperparameter maximised in closed form (SP), not a Gaussian variable (P, SPK).
    :param n_effects: of the columns, the last so many stay Gaussian beside a profiled mean, with ``prior_scale`` for
        standard deviations whatever gamma: what the window does not excite keeps its prior.
    :param physical: ``prior_scale`` is in the units of theta, gamma is 1. And a window of one smooth motion cannot tell
        a rigid body from a smooth function: so the features explain no more than the coupled columns leave.
    """

    outputs: Array
    coupled: Array
    inputs: Array
    spectrum: Array
    groups: Stamps
    prior_scale: Array
    profiled: bool = False
    step: int = 1
    n_effects: int = 0
    physical: bool = False

    @property
    def n_profiled(self) -> int:
        """So many columns, the first ones, are profiled."""
        return self.coupled.shape[2] - self.n_effects if self.profiled else 0

    def thinned(self, rows: int, frequencies: int) -> Window:
        """The same problem on at most ``rows`` evenly spaced samples and the first ``frequencies`` of omega."""
        step = max(1, -(-len(self.outputs) // rows))
        return replace(self, outputs=self.outputs[::step], coupled=self.coupled[::step], inputs=self.inputs[::step],
                       spectrum=self.spectrum[:frequencies], step=self.step * step)


class Point(NamedTuple):
    """Point where the evidence is taken: ``tau`` (groups,), ``output_scale`` (n,); kappa 0 is white
    noise."""

    gamma: float
    rho: float
    tau: Array
    sigma: float
    output_scale: Array
    kappa: float = 0.0
    memory: float = 1.0


class _Coupled(NamedTuple):
    """The estimate of theta and what the gradient needs of it; ``root`` (p, p) has root root' = M^-1."""

    theta: Array
    root: Array
    log_determinant: float
    penalty: float
    gamma_slope: float


def evidence(window: Window, at: Point, gradient: bool = True) -> Evidence:
    """Log marginal likelihood of the window, O(t D min(t, D)) with or without the gradient."""
    steps, n, p = window.coupled.shape
    y = window.outputs / at.output_scale
    c = (window.coupled / at.output_scale[:, None]).reshape(steps * n, p)
    scaled_inputs = window.inputs / at.tau[window.groups]
    phi = harmonics(scaled_inputs @ window.spectrum.T)
    drift = Drift(steps, at.kappa, at.memory, window.step) if at.kappa > 0.0 else None
    factor = SharedFactor(at.rho * phi, at.sigma, drift)
    solved = factor.solve(np.hstack([y, c.reshape(steps, n * p)]))
    ay, ac = solved[:, :n], np.ascontiguousarray(solved[:, n:]).reshape(steps * n, p)
    prior_std = window.prior_scale if window.profiled else at.gamma * window.prior_scale
    of_outputs = c.reshape(steps, n, p).transpose(1, 2, 0) @ ac.reshape(steps, n, p).transpose(1, 0, 2)
    coupled = _estimate(of_outputs.sum(axis=0), ac.T @ y.ravel(), prior_std, window.n_profiled)
    errors = y - (c @ coupled.theta).reshape(steps, n)
    weighted = ay - (ac @ coupled.theta).reshape(steps, n)
    value = -0.5 * (n * factor.log_determinant + coupled.log_determinant + float(np.sum(errors * weighted))
                    + coupled.penalty + steps * n * LOG_2PI) - steps * float(np.log(at.output_scale).sum())
    if not gradient:
        return Evidence(value, coupled.theta, None)
    z = np.hstack([weighted, (ac @ coupled.root).reshape(steps, -1)])
    slopes = factor.slopes(z, n)
    scale_slope = np.sum(errors * weighted, axis=0) - steps
    scale_slope += np.sum((of_outputs @ coupled.root) * coupled.root, axis=(1, 2))
    tau_slope = _length_scale_slopes(at.rho * slopes.features, phi, scaled_inputs, window, len(at.tau))
    gamma_slope = 0.0 if window.profiled else coupled.gamma_slope
    return Evidence(value, coupled.theta, Slope(gamma_slope, slopes.rho, tau_slope, slopes.sigma, scale_slope,
                                                slopes.kappa, slopes.memory))


def harmonics(phase: Array) -> Array:
    """Phi = [cos z | sin z] / sqrt(d) for z (t, d), so that each row has norm one."""
    frequencies = phase.shape[1]
    phi = np.empty((len(phase), 2 * frequencies))
    np.cos(phase, out=phi[:, :frequencies])
    np.sin(phase, out=phi[:, frequencies:])
    return np.asarray(phi / np.sqrt(max(frequencies, 1)))


def _estimate(information: Array, right: Array, prior_std: Array, n_profiled: int) -> _Coupled:
    """theta from N = C'A^-1 C and h = C'A^-1 y: its first part by generalised least squares, the rest by its prior."""
    if not len(right):
        return _Coupled(right, information, 0.0, 0.0, 0.0)
    if n_profiled == len(right):
        return _least_squares(information, right)
    if not n_profiled:
        return _posterior(information, right, prior_std)
    return _beside_mean(information, right, prior_std, n_profiled)


def _beside_mean(information: Array, right: Array, prior_std: Array, k: int) -> _Coupled:
    """The first k by least squares with the others' prior in the covariance, which are then eliminated; then those."""
    inner, across = information[k:, k:], information[k:, :k]
    root = _posterior(inner, right[k:], prior_std[k:]).root
    half = root.T @ across
    mean = _least_squares(information[:k, :k] - half.T @ half, right[:k] - half.T @ (root.T @ right[k:])).theta
    others = _posterior(inner, right[k:] - across @ mean, prior_std[k:])
    return others._replace(theta=np.concatenate([mean, others.theta]),
                           root=np.vstack([np.zeros((k, root.shape[1])), root]))


def _least_squares(information: Array, right: Array) -> _Coupled:
    """Maximum likelihood: by the envelope theorem the gradient sees no change of theta, hence no root."""
    diagonal = np.diag(information)
    # cancellation can leave a diagonal below zero where A is all but singular: nothing is known of that column
    excited = diagonal > np.finfo(float).tiny
    scale = np.where(excited, 1.0 / np.sqrt(np.where(excited, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    kept = values > RANK_TOLERANCE * values[-1]
    basis = scale[:, None] * vectors[:, kept]
    theta = basis @ ((basis.T @ right) / values[kept])
    return _Coupled(theta, np.zeros((len(right), 0)), 0.0, 0.0, 0.0)


def _posterior(information: Array, right: Array, prior_std: Array) -> _Coupled:
    """M = Gamma^-1 + N through W = I + Gamma^1/2 N Gamma^1/2, which stays finite for gamma to 0 and to infinity."""
    values, vectors = np.linalg.eigh(prior_std[:, None] * information * prior_std)
    eigenvalues = 1.0 + np.maximum(values, 0.0)
    root = prior_std[:, None] * vectors / np.sqrt(eigenvalues)
    white = vectors @ ((vectors.T @ (prior_std * right)) / eigenvalues)
    penalty = float(white @ white)
    slope = penalty - float(np.sum(1.0 - 1.0 / eigenvalues))
    return _Coupled(prior_std * white, root, float(np.log(eigenvalues).sum()), penalty, slope)


def _length_scale_slopes(by_phi: Array, phi: Array, scaled: Array, window: Window, groups: int) -> Array:
    """dL/dlog tau (groups,) from dL/dPhi: back through cos and sin to z = omega' x / tau."""
    d = len(window.spectrum)
    by_phase = by_phi[:, d:] * phi[:, :d] - by_phi[:, :d] * phi[:, d:]
    by_input = -np.sum((by_phase.T @ scaled) * window.spectrum, axis=0)
    return np.bincount(window.groups, weights=by_input, minlength=groups).astype(np.float64)
