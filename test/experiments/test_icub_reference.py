"""The measured iCub arm: the figures that a plain dense reference reached on the same files."""

from dataclasses import replace

import pytest

from semiparam_ros.settings import dump_params, load_params
from support.commands import document

pytestmark = pytest.mark.slow

@pytest.fixture(scope='module')
def variants(measured_icub, tmp_path_factory):
    """Learnt on the training file, predicted on the test file without learning; a hundred features are enough."""
    folder = tmp_path_factory.mktemp('evaluated')
    params = folder / 'icub.yaml'
    dump_params(replace(load_params(measured_icub / 'icub.yaml'), features_count=100), params)
    chosen = [word for variant in ('P', 'NP-ML', 'SPK-ML') for word in ('--variant', variant)]
    return document(folder / 'result.json', 'evaluate', measured_icub / 'test.mcap', '--train',
                    measured_icub / 'train.mcap', '--frozen', *chosen, '--params', params)['variants']


def test_every_sample_is_predicted(variants):
    assert {name: result['samples'] for name, result in variants.items()} == {'P': 3000, 'NP-ML': 3000, 'SPK-ML': 3000}


def test_the_rigid_body_reaches_the_reference(variants):
    assert variants['P']['nmse_mean'] == pytest.approx(0.0193, rel=0.02)


def test_the_joint_model_is_the_best(variants):
    assert variants['SPK-ML']['nmse_mean'] <= 0.0120
    assert variants['NP-ML']['nmse_mean'] > variants['SPK-ML']['nmse_mean']
