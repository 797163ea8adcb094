"""The fuzzers, for a few seconds or for ten minutes."""

import threading

import pytest

from support import node_fuzz, node_settings
from support.node_helpers import SETTINGS


@pytest.mark.long
def test_a_fuzz_that_fails_leaves_no_thread_that_spins(tmp_path, ros_domain):
    """The interpreter ends such a thread within C++, which ends the process: "terminate called without ..."."""
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError), node_fuzz.Pair(tmp_path, SETTINGS):
        assert threading.active_count() == before + 2
        raise ZeroDivisionError
    assert threading.active_count() == before


@pytest.fixture
def all_free_memory_returned(monkeypatch):
    """Thresholds of glibc, which keeps tens of MB otherwise that would look like memory in use."""
    for name in ('MALLOC_MMAP_THRESHOLD_', 'MALLOC_TRIM_THRESHOLD_'):
        monkeypatch.setenv(name, '65536')


@pytest.mark.slow
@pytest.mark.usefixtures('all_free_memory_returned')
def test_a_node_under_fire_equals_one_that_gets_only_the_good_samples(ros_domain, tmp_path, long):
    options = node_fuzz.Options(600.0, 500, 1000) if long else node_fuzz.Options(3.0, 40, 150)
    assert node_fuzz.tell(node_fuzz.fuzz(tmp_path, options))


@pytest.mark.slow
@pytest.mark.usefixtures('all_free_memory_returned')
def test_a_node_whose_settings_are_changed_at_random_answers_every_good_sample(ros_domain, tmp_path, long):
    options = node_fuzz.Options(600.0, 100, 300) if long else node_fuzz.Options(5.0, 20, 60)
    assert node_settings.tell(node_settings.fuzz(tmp_path, options, node_fuzz.settings_of(options)))
