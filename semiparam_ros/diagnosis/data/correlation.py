"""How long a residual stays alike: neighbouring samples repeat each other."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig


def correlation_times(residual: Array, config: DiagnosisConfig = DEFAULTS) -> Array:
    """(n,) integrated autocorrelation time of each channel in samples, at least 1.

    Sums pairs of neighbouring autocorrelations while they stay positive (Geyer 1992).
    """
    return np.array([_channel_time(column, config.longest_correlation_share) for column in residual.T])


def _channel_time(values: Array, longest_share: float) -> float:
    count = len(values)
    centred = values - values.mean()
    spectrum = np.abs(np.fft.rfft(centred, 2 * count)) ** 2
    covariance = np.fft.irfft(spectrum)[:max(int(longest_share * count), 2)]
    if covariance[0] <= 0.0:
        return 1.0
    correlation = covariance / covariance[0]
    pairs = correlation[:len(correlation) // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    return float(max(1.0, 2.0 * pairs[:negative[0] if len(negative) else None].sum() - 1.0))
