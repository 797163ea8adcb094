"""Random Fourier features of the Gaussian kernel (Rahimi and Recht 2007; Romeres et al. 2016, section IV).

Frequencies that are orthogonal within blocks approximate the kernel with less variance than independent ones, with the
same mean (Yu et al. 2016, Orthogonal Random Features).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semiparam_ros.core.compiled import Matrix, Vector, compiled
from semiparam_ros.core.types import Array
from semiparam_ros.core.variants import FREQUENCIES
from semiparam_ros.errors import SemiparamError

KINDS = 3  # position, velocity, acceleration
LEAST_SHARE = 0.2


class RandomFeatures:
    """phi(x) = [cos z, sin z] / sqrt(d) with z = omega'(x - mean) / (scale tau), omega ~ N(0, I), D = 2 d.

    phi(x)'phi(x') tends to exp(-|x - x'|^2 / (2 tau^2)) on scaled inputs, and phi'phi = 1.
    """

    def __init__(self, n_inputs: int, count: int, seed: int, tau: Sequence[float], input_mean: Array,
                 input_scale: Array, frequencies: str = FREQUENCIES[0]) -> None:
        """``count`` is D (even); ``tau`` holds 1, 3 (position, velocity, acceleration) or n_inputs length scales;
        ``frequencies`` is one of :data:`~semiparam_ros.core.variants.FREQUENCIES`."""
        if count < 2 or count % 2:
            raise SemiparamError(f'features.count is {count}; expected an even number of at least 2.')
        self.count = count
        self.input_mean = np.asarray(input_mean, dtype=float)
        self.input_scale = np.asarray(input_scale, dtype=float)
        self.omega = spectrum(n_inputs, count, seed, frequencies)
        self.tau = tuple(float(value) for value in tau)
        self._check(n_inputs)
        self._divisor = self.input_scale * spread(self.tau, n_inputs)
        self._omega = np.ascontiguousarray((self.omega / self._divisor).T)
        self._phase = self.input_mean @ self._omega
        self._norm = 1.0 / np.sqrt(count // 2)

    def __call__(self, x: Array) -> Array:
        """(D,) features of one input (m,)."""
        phi = np.empty(self.count)
        _features(self._omega, self._phase, self._norm, x, phi)
        return phi

    def batch(self, x: Array) -> Array:
        """(N, D) features of inputs (N, m)."""
        z = x @ self._omega - self._phase
        return np.asarray(np.hstack([np.cos(z), np.sin(z)]) * self._norm)

    def kernel(self, x: Array, others: Array) -> Array:
        """(N, M) what phi(x)'phi(x') tends to with ever more features, of inputs (N, m) and (M, m)."""
        return _kernel(np.ascontiguousarray(x), np.ascontiguousarray(others), 1.0 / self._divisor)

    def _check(self, n_inputs: int) -> None:
        if not len(self.input_mean) == len(self.input_scale) == n_inputs:
            raise SemiparamError(f'the scaling of the inputs holds {len(self.input_mean)} means and '
                                 f'{len(self.input_scale)} scales; expected one of each for {n_inputs} inputs.')
        for name, values in (('length scales', np.array(self.tau)), ('input scale', self.input_scale)):
            if not (np.isfinite(values).all() and (values > 0.0).all()):
                raise SemiparamError(f'the {name} of the features are {values.tolist()}; expected positive numbers.')
        if not np.isfinite(self.input_mean).all():
            raise SemiparamError(f'the input mean of the features is {self.input_mean.tolist()}; expected numbers.')


@compiled
def _kernel(x: Matrix, others: Matrix, factors: Vector) -> Matrix:
    """(N, M) of inputs (N, m) and (M, m), times factors (m,)."""
    squares = np.zeros((len(x), len(others)))
    for i in range(len(x)):
        for j in range(len(others)):
            for c in range(len(factors)):
                apart = (x[i, c] - others[j, c]) * factors[c]
                squares[i, j] += apart * apart
    return np.exp(-0.5 * squares)


@compiled
def _features(omega: Matrix, phase: Vector, norm: float, x: Vector, phi: Vector) -> None:
    """phi of one input, from omega (m, d)."""
    inputs, half = omega.shape
    for i in range(half):
        phi[i] = -phase[i]
    for j in range(inputs):
        for i in range(half):
            phi[i] += omega[j, i] * x[j]
    for i in range(half):
        z = phi[i]
        phi[i] = norm * np.cos(z)
        phi[half + i] = norm * np.sin(z)


def spectrum(n_inputs: int, count: int, seed: int, frequencies: str = FREQUENCIES[0]) -> Array:
    """omega (d, n_inputs), the seeded frequencies of D = ``count`` = 2 d features, each of them standard normal.

    ``orthogonal``: blocks of n_inputs frequencies are the rows of a random rotation, each as long as a standard normal
    vector. Fewer features have the first frequencies of more, either way.
    """
    rng, d = np.random.default_rng(seed), count // 2
    if frequencies == 'independent':
        return rng.standard_normal((d, n_inputs))
    drawn = rng.standard_normal((-(-d // n_inputs), 2, n_inputs, n_inputs))
    rotations, _ = np.linalg.qr(drawn[:, 0])
    lengths = np.linalg.norm(drawn[:, 1], axis=-1, keepdims=True)
    return np.asarray((rotations * lengths).reshape(-1, n_inputs)[:d])


def spread(tau: Sequence[float], n_inputs: int) -> Array:
    """One length scale for each input, from one for all, one for each kind, or one for each input."""
    if len(tau) == 1:
        return np.full(n_inputs, tau[0])
    if len(tau) == KINDS:
        return np.repeat(np.asarray(tau, dtype=float), n_inputs // KINDS)
    if len(tau) == n_inputs:
        return np.asarray(tau, dtype=float)
    raise SemiparamError(f'{len(tau)} length scales for {n_inputs} inputs; expected 1, {KINDS} or {n_inputs}.')


def input_scaling(inputs: Array, radians: Array | float = 1.0) -> tuple[Array, Array]:
    """Mean and scale of a window of inputs (N, m): the standard deviation, kept from that of noise alone.

    A joint that hardly moved in the window would have its noise blown up to the size of the others' motion, and its
    first real motion far beyond what the features have seen. So each scale is at least a fifth of the largest of its
    kind (position, velocity, acceleration), and 1 where no joint moved.

    :param radians: (n_joints,) what of each joint's unit is as much as a radian.
    """
    deviation = inputs.std(axis=0).reshape(KINDS, -1)
    largest = (deviation / radians).max(axis=1)
    scale = np.maximum(deviation, LEAST_SHARE * largest[:, None] * radians).ravel()
    rounding = 1e-9 * max(1.0, float(np.abs(inputs).max()))
    return inputs.mean(axis=0), np.where(scale > rounding, scale, 1.0)
