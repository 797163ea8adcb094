"""Noise with the colour of a residual: what flexible regression finds in it is chance.

A sensor's noise may be correlated over a second. A function of the motion fitted on some blocks then predicts a little
of their neighbours, though nothing is missing. How much, autoregressive noise with the residual's own autocorrelation
tells: it knows nothing of the motion.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from semiparam_ros.core.types import Array

ORDER = 20
SETTLING = 500
WHITENING = 1e-9
"""Share of the power that keeps the equations of a residual that is nearly periodic solvable."""


def coloured_noise(residual: Array, count: int, seed: int = 0) -> Array:
    """(count, M, n) noise; each channel has the autocorrelation and the power of that of the residual (M, n)."""
    rng = np.random.default_rng(seed)
    drawn = rng.standard_normal((count, SETTLING + len(residual), residual.shape[1]))
    for channel, values in enumerate(residual.T):
        weights, deviation = _autoregression(values)
        drawn[:, :, channel] = lfilter([deviation], np.append(1.0, -weights), drawn[:, :, channel], axis=1)
    return drawn[:, SETTLING:]


def _autoregression(values: Array) -> tuple[Array, float]:
    """(ORDER,) weights of the past values, and the standard deviation of what they do not predict (Yule-Walker)."""
    spectrum = np.abs(np.fft.rfft(values - values.mean(), 2 * len(values))) ** 2
    covariance = np.fft.irfft(spectrum)[:ORDER + 1] / len(values)
    if covariance[0] <= 0.0:
        return np.zeros(ORDER), 0.0
    covariance[0] *= 1.0 + WHITENING
    weights = solve_toeplitz(covariance[:-1], covariance[1:])
    return weights, float(np.sqrt(covariance[0] - weights @ covariance[1:]))
