"""Which samples fit and which judge: contiguous blocks, for neighbouring samples tell the same story."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.types import Mask, Stamps

BLOCKS = 15
HELD_OUT_EVERY = 3
FOLDS = 10


def interleaved_split(count: int) -> Mask:
    """(N,) true for samples that fit: of fifteen blocks every third is held out, so both parts span the recording."""
    block = np.minimum(np.arange(count) * BLOCKS // count, BLOCKS - 1)
    return np.asarray(block % HELD_OUT_EVERY != 1)


def leading_split(count: int, share: float) -> Mask:
    """(N,) true for the first ``share`` of the samples; the rest is held out."""
    return np.arange(count) < round(count * share)


def folds(use: Mask) -> Stamps:
    """(N,) number of the fold of each sample in use, -1 elsewhere; folds are contiguous and equally long."""
    labels = np.full(len(use), -1, dtype=np.int64)
    used = np.flatnonzero(use)
    labels[used] = np.minimum(np.arange(len(used)) * FOLDS // max(len(used), 1), FOLDS - 1)
    return labels


def ranges(mask: Mask) -> list[tuple[int, int]]:
    """Half-open index ranges where a mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]
