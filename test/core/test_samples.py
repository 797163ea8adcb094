"""Samples: a number gives one, a slice or an array of numbers some of them."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.samples import Sample, Samples
from support.arms import smooth_motion

MOTION = smooth_motion(3, 12)


@pytest.mark.parametrize('index', [0, 3, -1, np.int64(3)])
def test_a_number_gives_one_sample(index):
    sample = MOTION[index]
    assert isinstance(sample, Sample)
    assert type(sample.stamp) is int
    for mine, expected in zip(sample, list(MOTION)[index], strict=True):
        np.testing.assert_array_equal(mine, expected)


@pytest.mark.parametrize('index', [slice(2, 5), np.array([2, 3, 4]), (np.arange(12) >= 2) & (np.arange(12) < 5)])
def test_anything_else_gives_samples_of_the_same_origin(index):
    part = MOTION[index]
    assert isinstance(part, Samples)
    assert part.origin == MOTION.origin
    np.testing.assert_array_equal(part.stamps, MOTION.stamps[2:5])
    np.testing.assert_array_equal(part.outputs, MOTION.outputs[2:5])


@pytest.mark.parametrize('given', [np.asfortranarray, np.ndarray.tolist, lambda values: values[:, ::-1][:, ::-1]])
def test_rows_have_no_gaps_however_the_arrays_lie(given):
    """Columns in another order, as ``outputs[:, order]`` has them, ended in a compiled loop."""
    arrays = {name: given(getattr(MOTION, name)) for name in Sample._fields[1:5]}
    for mine, expected in zip(replace(MOTION, **arrays), MOTION, strict=True):
        assert all(value.flags.c_contiguous for value in mine[1:])
        np.testing.assert_array_equal(np.hstack(mine), np.hstack(expected))


def test_a_number_beyond_the_end_is_refused():
    with pytest.raises(IndexError):
        MOTION[12]
