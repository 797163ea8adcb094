"""Of a recording that is too long, stretches are read: they hold the samples that the whole recording has there."""

import numpy as np
import pytest

from semiparam_ros.bags import loading
from semiparam_ros.bags.loading import STRETCHES, load_samples
from semiparam_ros.diagnosis.config import DEFAULTS
from semiparam_ros.diagnosis.data.outliers import excluded, gaps, working_factor
from semiparam_ros.diagnosis.data.recordings import whole_groups
from semiparam_ros.diagnosis.preparation import most_samples
from semiparam_ros.settings import load_params

MOST = 1000


@pytest.fixture(scope='module', params=['measured', 'filter'])
def settings(request, repository):
    return load_params(repository / 'config/icub_right_arm.yaml').changed({'acceleration.source': request.param})


@pytest.fixture(scope='module')
def bag(repository):
    return repository / 'bags/icub_xy.mcap'


def test_stretches_are_spread_over_the_recording_and_hold_its_samples(settings, bag):
    whole, few = load_samples(bag, settings), load_samples(bag, settings, most=lambda rate: MOST)
    assert whole.stretches == (len(whole.samples),) and len(few.stretches) == STRETCHES
    assert sum(few.stretches) == len(few.samples) and 0.95 * MOST < len(few.samples) <= MOST + STRETCHES
    at = np.searchsorted(whole.samples.stamps, few.samples.stamps)
    np.testing.assert_array_equal(whole.samples.stamps[at], few.samples.stamps)
    assert at[0] < 3 and at[-1] > len(whole.samples) - 3
    edges = np.flatnonzero(np.diff(at) > 1)
    np.testing.assert_array_equal(edges + 1, np.cumsum(few.stretches)[:-1])
    assert np.ptp(np.diff(at)[edges]) <= 2, 'evenly'
    for name in ('position', 'velocity', 'outputs'):
        np.testing.assert_array_equal(getattr(whole.samples[at], name), getattr(few.samples, name))
    reached = whole.samples.acceleration.std(axis=0)
    assert (np.abs(whole.samples.acceleration[at] - few.samples.acceleration) < 1e-3 * reached).all(), 'filters settle'
    assert few.samples.origin == whole.samples.origin and few.joints == whole.joints


def test_what_is_not_too_long_is_read_as_before(settings, bag):
    whole, same = load_samples(bag, settings), load_samples(bag, settings, most=most_samples)
    assert same.stretches == whole.stretches
    np.testing.assert_array_equal(same.samples.acceleration, whole.samples.acceleration)
    assert whole_groups(same.samples, 3, same.stretches) is same.samples


def test_no_working_sample_averages_over_two_stretches_and_their_ends_are_left_out(settings, bag, monkeypatch):
    monkeypatch.setattr(loading, 'STRETCHES', 4)
    few = load_samples(bag, settings, most=lambda rate: MOST)
    fast = DEFAULTS.__class__(working_rate_hz=3.0)
    factor = working_factor(few.samples, fast)
    samples = whole_groups(few.samples, factor, few.stretches)
    found = [gap.before + 1 for gap in gaps(samples, fast)]
    assert factor == 6 and len(found) == 3 and not np.any(np.array(found) % factor)
    left_out = excluded(samples, fast)
    for edge in found:
        assert left_out[edge - factor * fast.smoothing_ends:edge + factor * fast.smoothing_ends].all()


def test_how_many_samples_are_looked_at_depends_on_their_rate():
    assert most_samples(20.0) == DEFAULTS.most_working_samples
    assert most_samples(500.0) == 12 * DEFAULTS.most_working_samples
