"""What is learnt on one motion holds on another one of the same robot: measured arms, nothing chosen by hand."""

import importlib
import sys

import pytest

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.cli.main import main
from semiparam_ros.settings import Settings, load_params

pytestmark = pytest.mark.slow
UR3 = ('Base=shoulder_pan_joint,Shoulder=shoulder_lift_joint,Elbow=elbow_joint,Wrist 1=wrist_1_joint,'
       'Wrist 2=wrist_2_joint,Wrist 3=wrist_3_joint')


@pytest.fixture(scope='module')
def carries_over(repository):
    sys.path.insert(0, str(repository / 'benchmarks'))
    return importlib.import_module('carries_over')


@pytest.fixture(scope='module')
def ur3(shared_data, tmp_path_factory):
    folder, found = tmp_path_factory.mktemp('ur3'), []
    for name in ('id1', 'id2'):
        bag = folder / f'{name}.mcap'
        assert main(['convert', str(shared_data / 'ur3_arm' / f'{name}.bag'), str(bag), '--topic', '/arm=/joint_states',
                     '--joint', UR3, '--effort-sign', '-1', '--robot-description',
                     str(shared_data / 'ur3_arm' / 'ur3.urdf')]) == 0
        found.append(load_samples(bag, Settings(outputs='effort')))
    return found


@pytest.mark.parametrize('back', [False, pytest.param(True, marks=pytest.mark.long)])
def test_efforts_on_another_motion_are_predicted_as_by_the_plain_model(carries_over, ur3, back):
    first, second = ur3[::-1] if back else ur3
    settings = Settings(outputs='effort', robot_description=first.robot_description)
    pair = carries_over.Pair('UR3', settings, first.samples, second.samples)
    beside = carries_over.references(pair, None)
    found = carries_over.judged(pair, settings.variant, 100, None)
    assert found['frozen']['nmse'] < 1.1 * beside['plain'] < 0.1 * beside['description']
    assert 0.90 < found['frozen']['band'] < 0.99
    assert found['feedforward']['nmse'] < 0.1
    assert (found['feedforward']['beyond_three_std_where_valid'] or 0.0) <= 0.01


def test_wrenches_of_another_recording_are_predicted_better_than_by_the_rigid_body(carries_over, measured_icub):
    settings = load_params(measured_icub / 'icub.yaml')
    train, test = (load_samples(measured_icub / f'{name}.mcap', settings) for name in ('train', 'test'))
    pair = carries_over.Pair('iCub', settings, train.samples, test.samples)
    frozen = {variant: carries_over.judged(pair, variant, 100, None)['frozen'] for variant in ('SPK-ML', 'P')}
    assert frozen['SPK-ML']['nmse'] < 0.65 * frozen['P']['nmse']
    assert 0.90 < frozen['SPK-ML']['band'] < 0.98


