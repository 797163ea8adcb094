"""Sums of a block of motion, against plain numpy over all of its samples at once."""

import numpy as np
import pytest

from semiparam_ros.online.motion_block import BlockSums, add_sample


@pytest.mark.parametrize('n_turns', [0, 3])
def test_the_sums_of_a_block_are_those_of_all_samples_at_once(n_turns):
    rng = np.random.default_rng(n_turns)
    samples, n, p, effects = 30, 4, 9, 2
    columns = rng.normal(size=(samples, n, p + effects)) * (rng.random((n, p + effects)) < 0.6)
    turned, felt = rng.normal(size=(samples, n, n_turns)), rng.normal(size=(samples, n, 6))
    weight, left = rng.random((samples, n)) * [1.0, 1.0, 0.0, 1.0], rng.normal(size=(samples, n))
    time = np.sort(rng.random(samples))
    sums = BlockSums.none(n, p + n_turns)
    for each in zip(columns, turned, felt, weight, left, time.tolist(), strict=True):
        add_sample(sums, *each)
    c = np.concatenate([columns[..., :p], turned], axis=2)
    w, t = weight**2, time[:, None]
    e = np.concatenate([(1.0 - t[..., None]) * felt, t[..., None] * felt], axis=2)
    expected = BlockSums(
        np.einsum('snp,sn,snq->pq', c, w, c), np.einsum('snp,sn,sn->p', c, w, left),
        np.sum([w, t * w, t * t * w, w * left, t * w * left, w * left**2], axis=1),
        np.array([np.einsum('sn,snp->np', w, c), np.einsum('sn,snp->np', t * w, c)]),
        np.einsum('snp,sn,snq->pq', e, w, e), np.einsum('snp,sn,sn->p', e, w, left),
        np.einsum('snp,sn,snq->pq', e, w, c))
    for name, found, plain in zip(BlockSums._fields, sums, expected, strict=True):
        np.testing.assert_allclose(found, plain, rtol=1e-12, atol=1e-12, err_msg=name)
