"""How late answers are, and how late an empty loop would be on the same machine."""

from __future__ import annotations

import time

import numpy as np

from semiparam_ros.core.types import Array


def empty_loop(rate_hz: float, share: float, seconds: float) -> Array:
    """How late [ms] this machine is with nothing but a loop that is busy for ``share`` of every period.

    Each value is the end of a period's work after its beginning, as a node's answer: no program that works as much is
    earlier here.
    """
    period = 1.0 / rate_hz
    late, start = [], time.perf_counter()
    for index in range(round(rate_hz * seconds)):
        due = start + index * period
        time.sleep(max(0.0, due - time.perf_counter()))
        end = time.perf_counter() + share * period
        while time.perf_counter() < end:
            pass
        late.append(1e3 * (time.perf_counter() - due))
    return np.array(late)


def quantiles(milliseconds: Array) -> dict[str, float]:
    """Median, 99 % quantile and maximum; NaN of nothing."""
    values = np.quantile(milliseconds, (0.5, 0.99, 1.0)) if len(milliseconds) else (np.nan,) * 3
    return dict(zip(('median', 'p99', 'max'), map(float, values), strict=True))
