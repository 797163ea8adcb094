"""The measured iCub arm: the figures that a plain dense reference reached on the same files."""

import json

import pytest

from semiparam_ros.cli.main import main

pytestmark = pytest.mark.slow

PARAMS = """
estimator:
  ros__parameters:
    joints: [r_shoulder_pitch, r_shoulder_roll, r_shoulder_yaw, r_elbow]
    sensor_frame: r_arm_ft_sensor
    wrench_convention: reaction
    robot_description_file: {urdf}
"""


@pytest.fixture(scope='module')
def variants(shared_data, repository, tmp_path_factory):
    """Both tables converted; learnt on the first, predicted on the second without learning."""
    folder, source = tmp_path_factory.mktemp('icub'), shared_data / 'icub_arm'
    for name in ('train', 'test'):
        assert main(['convert', str(source / f'icubdyn_{name}.dat'), str(folder / f'{name}.mcap'),
                     '--columns', str(repository / 'config/icub_table.yaml')]) == 0
    (folder / 'icub.yaml').write_text(PARAMS.format(urdf=source / 'iCubGenova01.urdf'))
    chosen = [word for variant in ('P', 'NP-ML', 'SPK-ML') for word in ('--variant', variant)]
    assert main(['evaluate', str(folder / 'test.mcap'), '--train', str(folder / 'train.mcap'), '--frozen', *chosen,
                 '--params', str(folder / 'icub.yaml'), '--json', str(folder / 'result.json')]) == 0
    return json.loads((folder / 'result.json').read_text())['variants']


def test_every_sample_is_predicted(variants):
    assert {name: result['samples'] for name, result in variants.items()} == {'P': 3000, 'NP-ML': 3000, 'SPK-ML': 3000}


def test_the_rigid_body_reaches_the_reference(variants):
    assert variants['P']['nmse_mean'] == pytest.approx(0.0193, rel=0.02)


def test_the_joint_model_is_the_best(variants):
    assert variants['SPK-ML']['nmse_mean'] <= 0.0120
    assert variants['NP-ML']['nmse_mean'] > variants['SPK-ML']['nmse_mean']
