"""A short recording of the arm and its parameters, for the tests of several commands."""

import pytest

from support.recordings import write_arm, write_params


@pytest.fixture(scope='session')
def recording(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp('bags') / 'a.mcap', 400)


@pytest.fixture(scope='session')
def params(tmp_path_factory):
    return write_params(tmp_path_factory.mktemp('params') / 'arm.yaml')
