"""Evidence of a contact: a wrench at the hand, or a force on each output, that wanders.

What acts goes along a line from edge to edge of blocks of motion, and its values at the edges are a
random walk, from the last edge B back, so that one pass tells of every block at which it may have begun:

    w_B ~ N(0, V),    w_b = w_b+1 + N(0, d^2 V),    r = [(1 - t) J, t J] (w_b, w_b+1) + N(0, kappa S^2)
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import log
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.compiled import Integers, Matrix, Part, Stack, Vector, compiled
from semiparam_ros.core.robot.external_wrench import push_wrench
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import push_force, reach_of, size_beyond
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.online.motion_block import BLOCK_S

WANDERS = (0.3, 0.1, 0.03)
"""[shares of its prior's standard deviation] What acts in a contact changes so much from block to
block."""
CONTACT_S = 6.0
"""A contact does not last longer: what does is a change."""
LASTING = round(CONTACT_S / BLOCK_S)
"""[blocks]"""
BREAK = 4
"""[blocks] The next contact begins so much later at least."""


def contact_scale(body: RigidBody) -> Array:
    """(n,) standard deviation of what an output feels of a contact anywhere."""
    if body.outputs == 'wrench':
        return push_force(body) * np.repeat([1.0, reach_of(body)], 3)
    lever = [1.0 if joint in body.prismatic else size_beyond(body, joint).length for joint in body.output_names]
    return push_force(body) * np.array(lever)


class ContactSums(NamedTuple):
    """Sums of B blocks by which contacts are judged: ``own`` (B, 6, n) of each output, and those of a wrench at the
    hand, (B, 12, 12) and (B, 12); see :class:`MotionBlock`."""

    own: Array
    grams: Array
    moments: Array


class ContactEvidence:
    """Log evidence of a contact with an arm over none."""

    def __init__(self, body: RigidBody) -> None:
        self._of_outputs = np.square(contact_scale(body))[:, None]
        self._at_hand = np.square(push_wrench(body))[None]

    def __call__(self, sums: ContactSums, kappa: Array, ends: Sequence[int]) -> Array:
        """(B, E, S) of what acts at the hand, or on each output, since each of the blocks and until some, under noise
        kappa (S,)."""
        kappa, which = np.unique(kappa, return_inverse=True)
        until = np.array(ends, dtype=int)
        each = wandering(*edge_sums(sums.own), self._of_outputs, kappa, until)
        each = (np.logaddexp(each, 0.0) - log(2.0)).sum(axis=-1)  # each output feels it or not
        at_hand = wandering(sums.grams[:, None], sums.moments[:, None], self._at_hand, kappa, until)
        return np.asarray(np.maximum(each, at_hand[..., 0]).max(axis=1))[..., which]


def contacts(before: Array, acting: Array, starts: Indices, ends: Iterable[int]) -> Array:
    """(S,) log evidence over none of the likeliest contact that began at any block since each of
    some starts, was over at one of some, and lasted as long as one may; and of one after a break.

    :param before: (B, E, S) of what acts until one of the ends. :param acting: (B, S) until now.
    """
    found, now = [np.zeros(len(starts))], np.full(len(starts), len(acting))
    for number, end in enumerate(ends):
        ended, began = np.full(len(starts), end), np.maximum(starts, end - LASTING)
        one = likeliest_of(before[:, number], began, ended)
        found.append(one + likeliest_of(acting, ended + BREAK, now))
    return np.max(found, axis=0)


def likeliest_of(acting: Array, first: Indices, last: Indices) -> Array:
    """(S,) the largest of an evidence (B, S) since any block from ``first`` on and before ``last``;
    that of none is 0."""
    block = np.arange(len(acting))[:, None]
    found = np.where((block >= first) & (block < last), acting, 0.0)
    return np.asarray(found.max(axis=0, initial=0.0))


def edge_sums(own: Array) -> tuple[Array, Array]:
    """(..., n, 2, 2) and (..., n, 2) sums of E' w E and E' w r with E = [1 - t, t], of sums (..., 6, n)
    as a block has them."""
    one, first, second, pulled, late = np.moveaxis(own[..., :5, :], -2, 0)
    gram = [[one - 2.0 * first + second, first - second], [first - second, second]]
    return np.moveaxis(np.array(gram), (0, 1), (-2, -1)), np.stack([pulled - late, late], axis=-1)


def wandering(
    grams: Array, moments: Array, variance: Array, kappa: Array, ends: Indices
) -> Array:
    """(B, D, E, S, n) log evidence over none of what wanders through the blocks from each on, until
    one of E blocks in which it is over: a random walk, its steps each of D = ``WANDERS``.

    :param grams: (B, n, 2 k, 2 k) of blocks, for values (k,) when they begin and end.
    :param moments: (B, n, 2 k). :param variance: (n, k) of its prior. :param kappa: (S,) the noise.
    :param ends: (E,) numbers of blocks; from there on there is no evidence of it.
    """
    count, n = moments.shape[:2]
    found = np.zeros((n, len(WANDERS), len(ends), len(kappa), count))
    for output in range(n):
        gram, moment = (np.ascontiguousarray(each[:, output]) for each in (grams, moments))
        for each, share in zip(found[output], WANDERS, strict=True):
            _filter_back(gram, moment, 1.0 / variance[output], share**-2.0, kappa, ends, each)
    return np.moveaxis(found, (0, -1), (-1, 0))


@compiled
def _eliminate(matrix: Matrix, factor: Matrix, right: Part) -> float:
    """Write the Cholesky factor C of a matrix (k, k), and C^-1 right (k, c) in place of right; log|C|."""
    logarithm = 0.0
    for i in range(len(matrix)):
        for j in range(i + 1):
            left = matrix[i, j]
            for inner in range(j):
                left -= factor[i, inner] * factor[j, inner]
            factor[i, j] = np.sqrt(left) if i == j else left / factor[j, j]
        logarithm += np.log(factor[i, i])
        for column in range(right.shape[1]):
            for inner in range(i):
                right[i, column] -= factor[i, inner] * right[inner, column]
            right[i, column] /= factor[i, i]
    return logarithm


@compiled
def _filter_back(
    grams: Stack, moments: Matrix, precision: Vector, slow: float, kappa: Vector, ends: Integers,
    found: Stack,
) -> None:
    """Write the evidence (E, S, B) of one walk: by the information filter from the last block back.

    What the later blocks say of w_b+1 is exp(c + h'w - w'Lw / 2). With A = [[A_00, A_01], [A_10, A_11]]
    and a of the block over kappa, and Q = V d^2, ``slow`` = d^-2, w_b+1 is integrated out:

        S = L + Q^-1 + A_11 = C C',   Y = C^-1 (Q^-1 - A_10),   y = C^-1 (h + a_1)
        L <- Q^-1 + A_00 - Y'Y,   h <- a_0 + Y'y,   c <- c + y'y / 2 + log|Q^-1| / 2 - log|C|
    """
    k = len(precision)
    left, right = np.empty((k, k)), np.empty(k)
    factor, across = np.empty((k, k)), np.empty((k, k + 1))
    begun = 0.5 * np.log(precision).sum()
    stepped = begun + 0.5 * k * np.log(slow)
    for each in range(len(ends)):
        for level in range(len(kappa)):
            scale, constant = 1.0 / kappa[level], begun
            left[:] = np.diag(precision)
            right[:] = 0.0
            for block in range(ends[each] - 1, -1, -1):
                gram, moment = grams[block], moments[block]
                for i in range(k):
                    for j in range(k):
                        left[i, j] += scale * gram[k + i, k + j]
                        across[i, j] = -scale * gram[k + i, j]
                    left[i, i] += slow * precision[i]
                    across[i, i] += slow * precision[i]
                    across[i, k] = right[i] + scale * moment[k + i]
                constant += stepped - _eliminate(left, factor, across)
                for i in range(k):
                    constant += 0.5 * across[i, k] ** 2
                    right[i] = scale * moment[i]
                    for j in range(k):
                        left[i, j] = scale * gram[i, j]
                    left[i, i] += slow * precision[i]
                for inner in range(k):
                    for i in range(k):
                        right[i] += across[inner, i] * across[inner, k]
                        for j in range(k):
                            left[i, j] -= across[inner, i] * across[inner, j]
                across[:, 0] = right
                total = constant - _eliminate(left, factor, across[:, :1])
                for i in range(k):
                    total += 0.5 * across[i, 0] ** 2
                found[each, level, block] = total
