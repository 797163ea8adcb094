"""Splits a recording into contiguous blocks, because neighbouring samples repeat each other, and says
how many do."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.signals.correlation import correlation_time
from semiparam_ros.core.types import Array, Indices, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig


def interleaved_split(count: int, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N,) true for samples that fit: of fifteen blocks every third is held out, so both parts span the recording."""
    block = np.minimum(np.arange(count) * config.split_blocks // count, config.split_blocks - 1)
    return np.asarray(block % config.held_out_every != 1)


def leading_split(count: int, share: float) -> Mask:
    """(N,) true for the first ``share`` of the samples; the rest is held out."""
    return np.arange(count) < round(count * share)


def evenly(count: int, most: int) -> Indices:
    """(k,) at most so many of the numbers up to a count, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, most).astype(int))


def ranges(mask: Mask) -> list[tuple[int, int]]:
    """Half-open index ranges where a mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]


def block_sums(values: Array, blocks: int) -> Array:
    """(blocks, ...) sums of values (N, ...) over contiguous blocks of about as many samples each."""
    return np.array([block.sum(axis=0) for block in np.array_split(values, blocks)])


def correlation_times(residual: Array, config: DiagnosisConfig = DEFAULTS) -> Array:
    """(n,) integrated autocorrelation time of each channel in samples, at least 1."""
    return np.array([correlation_time(column, config.longest_correlation_share) for column in residual.T])
