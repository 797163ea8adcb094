"""Sums of a quarter of a second of motion, by which ``changes`` judges what happened in it.

Of each sample come in the columns C (n, P) of the model and of small turns, the map J (n, 6) of a wrench at the hand,
the innovation r (n,) and the weights w (n,) = 1 / s, at the time t of the block.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semiparam_ros.core.compiled import Matrix, Stack, Vector, compiled, direct
from semiparam_ros.core.types import Array

BLOCK_S = 0.25
"""[s of motion]"""
EDGES = 12
"""A wrench at the hand when a block begins, and when it ends."""


class MotionBlock(NamedTuple):
    """Products of a quarter of a second of motion from ``start`` to ``end`` [ns]."""

    start: int
    end: int
    gram: Array  # (K, K) A
    moment: Array  # (K,) h
    innovation: tuple[Array, float]
    """(K,) h, and weighed squares, of the model as it was when the block began."""
    live: float  # weighed squares that the model leaves as it stands
    own: Array
    """(6, n) of each output the sums of w (1, t, t^2, r, r t, r^2), with weights w and time t in
    blocks."""
    along: Array
    """(2, n, K) of each output the sums of w C L and w t C L."""
    wrench: tuple[Array, Array, Array]
    """(12, 12), (12,) and (12, K) sums of E' W E, E' W r and E' W C L with E = [(1 - t) J, t J], of a wrench at the
    hand when the block begins and ends."""
    added: Array
    """(m, 2, n) of each output the sums of w r k and w k^2, of what known effects add, k."""
    unlike: float = 0.0
    """Share of it that is unlike all that was learnt."""
    carried: float = 0.0
    """Weighed squares of what the model predicts of the robot's bodies."""


class BlockSums(NamedTuple):
    """Sums of the samples of a block so far, of the columns themselves: see :class:`MotionBlock`."""

    gram: Matrix  # (P, P)
    moment: Vector  # (P,)
    own: Matrix  # (6, n)
    along: Stack  # (2, n, P)
    wrench_gram: Matrix  # (12, 12)
    wrench_moment: Vector  # (12,)
    wrench_along: Matrix  # (12, P)

    @classmethod
    def none(cls, n_outputs: int, n_columns: int) -> BlockSums:
        """Return sums of no sample."""
        n, p = n_outputs, n_columns
        return cls(np.zeros((p, p)), np.zeros(p), np.zeros((6, n)), np.zeros((2, n, p)), np.zeros((EDGES, EDGES)),
                   np.zeros(EDGES), np.zeros((EDGES, p)))


@compiled
def add_to_block(sums: BlockSums, columns: Matrix, turned: Matrix, felt: Matrix, weight: Vector, left: Vector,
                 time: float) -> None:
    """Add a sample, which left so much (n,).

    :param columns: (n, p) of the model, of which the first count. :param turned: (n, t) of small turns, the last of P.
    :param felt: (n, 6) J. :param weight: (n,) w.
    """
    gram, moment, own, along, wrench_gram, wrench_moment, wrench_along = sums
    size, n_own = len(moment), len(moment) - turned.shape[1]
    row, edges = np.empty(size), np.empty(EDGES)
    for k in range(len(weight)):
        w = weight[k]
        residual = w * left[k]
        for j in range(size):
            row[j] = w * (columns[k, j] if j < n_own else turned[k, j - n_own])
        for j in range(size):
            moment[j] += residual * row[j]
            along[0, k, j] += w * row[j]
            along[1, k, j] += time * w * row[j]
        for i in range(size):
            value = row[i]
            if value != 0.0:  # many are: of other joints' friction
                for j in range(size):
                    gram[i, j] += value * row[j]
        for i in range(6):
            edges[i], edges[6 + i] = (1.0 - time) * w * felt[k, i], time * w * felt[k, i]
        for i in range(EDGES):
            value = edges[i]
            wrench_moment[i] += value * residual
            for j in range(EDGES):
                wrench_gram[i, j] += value * edges[j]
            for j in range(size):
                wrench_along[i, j] += value * row[j]
        own[0, k] += w * w
        own[1, k] += time * w * w
        own[2, k] += time * time * w * w
        own[3, k] += w * residual
        own[4, k] += time * w * residual
        own[5, k] += residual * residual


add_sample = direct(add_to_block)


def gained(added: Array, came: bool) -> Array:
    """(..., n) squares of each output that known effects explain which ``came``, or went, by the
    sums (..., 2, n) that a block has of them."""
    along, own = np.moveaxis(added, -2, 0)
    return np.asarray((2.0 if came else -2.0) * along - own)
