"""Time for which values stay alike."""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from semiparam_ros.core.types import Array


def autocovariance(values: Array) -> Array:
    """(N,) sums of products of values (N,), less their mean, with those after them, by lag."""
    length = next_fast_len(2 * len(values), real=True)
    spectrum = rfft(values - values.mean(), length)
    return np.asarray(irfft(np.abs(spectrum) ** 2, length)[:len(values)])


def correlation_time(values: Array, longest_share: float = 1.0) -> float:
    """Integrated autocorrelation time of values (N,) in samples, at least 1.

    Sums pairs of neighbouring autocorrelations, up to a share of all lags, while they stay positive
    (Geyer 1992).
    """
    covariance = autocovariance(values)[:max(int(longest_share * len(values)), 2)]
    if not covariance[0] > 0.0:
        return 1.0
    correlation = covariance / covariance[0]
    pairs = correlation[:len(correlation) // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0.0)
    return float(max(1.0, 2.0 * pairs[:negative[0] if len(negative) else None].sum() - 1.0))
