"""Objects from process to process, and what of them is inside the pickle."""

import pickle
from multiprocessing import Pipe

import numpy as np
import pytest

from semiparam_ros.online import transport

FIXED = np.arange(3.0)
FIXED.flags.writeable = False
ARRAYS = {'large': np.arange(5000.0).reshape(100, 50), 'transposed': np.arange(6.0).reshape(2, 3).T,
          'some': np.arange(12.0)[::2], 'none': np.zeros((0, 4)), 'fixed': FIXED}


def test_arrays_arrive_as_they_were_and_are_not_copied_into_the_pickle():
    ours, theirs = Pipe()
    transport.send(ours, (ARRAYS, 'words'))
    found, words = transport.receive(theirs)
    assert words == 'words'
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].flags.writeable == array.flags.writeable
    assert found['transposed'].flags.f_contiguous
    transport.send(ours, ARRAYS['large'])
    packed, array = theirs.recv()
    assert array == ARRAYS['large'].nbytes and packed < 200


def test_half_an_object_is_none_and_of_what_cannot_be_pickled_nothing_is_sent():
    ours, theirs = Pipe()
    with pytest.raises((pickle.PicklingError, AttributeError)):
        transport.send(ours, lambda: None)
    assert not theirs.poll()
    ours.send([10])
    ours.close()
    with pytest.raises(EOFError):
        transport.receive(theirs)
