"""The fuzzer of docs/robustness.md for a few seconds."""

import threading

import pytest

from support import node_fuzz
from support.node_helpers import SETTINGS


def test_a_fuzz_that_fails_leaves_no_thread_that_spins(tmp_path, ros_domain):
    """The interpreter ends such a thread within C++, which ends the process: "terminate called without ..."."""
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError), node_fuzz.Pair(tmp_path, SETTINGS):
        assert threading.active_count() == before + 2
        raise ZeroDivisionError
    assert threading.active_count() == before


@pytest.mark.slow
def test_a_node_under_fire_equals_one_that_gets_only_the_good_samples(ros_domain):
    assert node_fuzz.main(['--seconds', '5', '--seed', '2', '--features', '100', '--window', '300']) == 0


@pytest.mark.slow
def test_a_node_whose_settings_are_changed_at_random_answers_every_good_sample(ros_domain):
    assert node_fuzz.main(['--settings', '--seconds', '10', '--seed', '2', '--features', '20', '--window', '60']) == 0
