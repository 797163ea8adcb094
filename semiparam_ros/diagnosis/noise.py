"""How much of a residual is noise, and how many independent samples it is worth."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.types import Array

LONGEST_SHARE = 0.1


def noise_floor(residual: Array) -> Array:
    """(n,) standard deviation of what changes from sample to sample without any pattern.

    Third differences cancel whatever varies slowly and keep white noise with a gain of sqrt(20) (von Neumann 1941).
    """
    differences = np.diff(residual, 3, axis=0)
    return np.asarray(np.sqrt(np.mean(differences**2, axis=0) / 20.0))


def correlation_times(residual: Array) -> Array:
    """(n,) integrated autocorrelation time of each channel in samples, at least 1.

    Sums pairs of neighbouring autocorrelations while they stay positive (Geyer 1992).
    """
    return np.array([_channel_time(column) for column in residual.T])


def _channel_time(values: Array) -> float:
    count = len(values)
    centred = values - values.mean()
    spectrum = np.abs(np.fft.rfft(centred, 2 * count)) ** 2
    covariance = np.fft.irfft(spectrum)[:max(int(LONGEST_SHARE * count), 2)]
    if covariance[0] <= 0.0:
        return 1.0
    correlation = covariance / covariance[0]
    pairs = correlation[:len(correlation) // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    return float(max(1.0, 2.0 * pairs[:negative[0] if len(negative) else None].sum() - 1.0))
