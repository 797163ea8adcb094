"""What is learnt on one motion holds on another one of the same robot: measured arms, nothing chosen by hand."""

import importlib
import sys

import pytest

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.settings import Settings, load_params

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def carries_over(repository):
    sys.path.insert(0, str(repository / 'benchmarks'))
    return importlib.import_module('carries_over')


@pytest.fixture(scope='module')
def ur3(measured_ur3):
    return [load_samples(measured_ur3 / f'{name}.mcap', Settings(outputs='effort')) for name in ('id1', 'id2')]


@pytest.mark.long
@pytest.mark.parametrize('back', [False, True])
def test_efforts_on_another_motion_are_predicted_as_by_the_plain_model(carries_over, ur3, back):
    first, second = ur3[::-1] if back else ur3
    settings = Settings(outputs='effort', robot_description=first.robot_description)
    pair = carries_over.Pair('UR3', settings, first.samples, second.samples)
    beside = carries_over.references(pair, None)
    found = carries_over.judged(pair, settings.variant, 100, None, ['frozen'])
    assert found['frozen']['nmse'] < 1.1 * beside['plain'] < 0.1 * beside['description']
    assert 0.90 < found['frozen']['band'] < 0.99
    assert found['feedforward']['nmse'] < 0.1
    assert (found['feedforward']['beyond_three_std_where_valid'] or 0.0) <= 0.01


def test_wrenches_of_another_recording_are_predicted_better_than_by_the_rigid_body(carries_over, measured_icub):
    settings = load_params(measured_icub / 'icub.yaml')
    train, test = (load_samples(measured_icub / f'{name}.mcap', settings) for name in ('train', 'test'))
    pair = carries_over.Pair('iCub', settings, train.samples, test.samples)
    frozen = {variant: carries_over.judged(pair, variant, 100, None, ['frozen'])['frozen']
              for variant in ('SPK-ML', 'P')}
    assert frozen['SPK-ML']['nmse'] < 0.65 * frozen['P']['nmse']
    assert 0.90 < frozen['SPK-ML']['band'] < 0.98


