"""Evidence of a contact: a wrench at the hand, or a force on each output, that wanders.

What acts goes along a line from edge to edge of blocks of motion, and its values at the edges are a
random walk:

    w_0 ~ N(0, V),    w_b+1 = w_b + N(0, d^2 V),    r = [(1 - t) J, t J] (w_b, w_b+1) + N(0, kappa S^2)
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.robot.external_wrench import FORCE_N, LEVER_M
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import reach_of, size_beyond
from semiparam_ros.core.types import Array, Indices

WANDERS = (0.3, 0.1, 0.03)
"""[shares of its prior's standard deviation] What acts in a contact changes so much from block to
block."""
WRENCH = np.repeat([FORCE_N, FORCE_N * LEVER_M], 3)
"""[N, N m] (6,) standard deviation of what acts at the hand in a contact."""


def contact_scale(body: RigidBody) -> Array:
    """(n,) standard deviation of what an output feels of a contact anywhere."""
    if body.outputs == 'wrench':
        return FORCE_N * np.repeat([1.0, reach_of(body)], 3)
    return FORCE_N * np.array([size_beyond(body, joint).length for joint in body.output_names])


def edge_sums(own: Array) -> tuple[Array, Array]:
    """(..., n, 2, 2) and (..., n, 2) sums of E' w E and E' w r with E = [1 - t, t], of sums (..., 6, n)
    as a block has them."""
    one, first, second, pulled, late = np.moveaxis(own[..., :5, :], -2, 0)
    gram = [[one - 2.0 * first + second, first - second], [first - second, second]]
    return np.moveaxis(np.array(gram), (0, 1), (-2, -1)), np.stack([pulled - late, late], axis=-1)


def wandering(
    grams: Array, moments: Array, variance: Array, kappa: Array, ends: Indices
) -> Array:
    """(B, D, E, ...) log evidence over none of what wanders through the blocks from each on, until
    one of E blocks in which it is over: a random walk, its steps each of D = ``WANDERS``, by the
    Kalman filter from the last block back.

    :param grams: (B, ..., 2 k, 2 k) of blocks, for values (k,) when they begin and end.
    :param moments: (B, ..., 2 k). :param variance: (..., k) of its prior. :param kappa: (S, ...)
        the noise. :param ends: (E,) numbers of blocks; from there on there is no evidence of it.
    """
    k = variance.shape[-1]
    prior = variance[..., None] * np.eye(k)
    step = np.square(WANDERS).reshape(-1, 1, *np.ones(kappa.ndim + 2, dtype=int)) * prior
    shape = np.broadcast_shapes(step.shape[:-2], (len(ends), *kappa.shape), moments.shape[1:-1])
    end, mean = np.empty((*shape, k, k)), np.zeros((*shape, k, 1))
    found, total = np.zeros((len(grams), *shape)), np.zeros(shape)
    for block in reversed(range(max(ends, default=0))):
        acts = ends > block
        end[:, ends == block + 1] = prior
        gram = grams[block] / kappa[..., None, None]
        moment = (moments[block] / kappa[..., None])[..., None]
        one, then = end[:, acts], mean[:, acts]
        begins = np.concatenate([one + step, one], axis=-1)
        covariance = np.concatenate([begins, np.concatenate([one, one], axis=-1)], axis=-2)
        old = np.concatenate([then, then], axis=-2)
        whole = np.eye(2 * k) + covariance @ gram
        solved = np.linalg.solve(
            whole, np.concatenate([covariance, old + covariance @ moment, old], axis=-1)
        )
        now, before = solved[..., -2:-1], solved[..., -1:]
        gained = moment * now + before * (moment - gram @ old)
        total[:, acts] += 0.5 * (gained.sum(axis=(-2, -1)) - np.linalg.slogdet(whole)[1])
        found[block] = np.where(acts.reshape(-1, *np.ones(len(shape) - 2, dtype=int)), total, 0.0)
        mean[:, acts], end[:, acts] = now[..., :k, :], solved[..., :k, :k]
    return found
