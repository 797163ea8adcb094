"""What follows a recorded temperature is found, from the bag to the parameter file; without one nobody looks for it."""

import json

import numpy as np
import pytest

from semiparam_ros.cli.main import main
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.regression import fit_model
from semiparam_ros.diagnosis.search.candidates import candidates
from semiparam_ros.diagnosis.search.scoring import coarse
from semiparam_ros.effects import effect_from_text
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.settings import load_params
from semiparam_ros.simulation import EffectRequest, Scenario, simulate
from support.arms import ICUB_JOINTS, ICUB_SENSOR

PARAMS = """
estimator:
  ros__parameters:
    joints: [{joints}]
    {outputs}
    temperatures: [{temperatures}]
"""
LIKE = {'effort': ('viscous_friction', 'coulomb_friction', 'load_friction', 'effort_offset'),
        'wrench': ('thermal_drift', 'sensor_drift', 'sensor_offset')}


@pytest.mark.parametrize(('outputs', 'kind', 'samples'), [
    ('effort', 'temperature_friction', '1500'),
    pytest.param('wrench', 'temperature_drift', '3000', marks=pytest.mark.long)])
def test_a_bag_tells_what_follows_its_temperature(tmp_path, outputs, kind, samples, long):
    """Found, and nothing beside it; the parameter file declares it with the temperature that it counts from."""
    bag, params, found = tmp_path / 'a.mcap', tmp_path / 'p.yaml', tmp_path / 'found.yaml'
    where = '@r_elbow' if outputs == 'effort' else ''
    assert main(['simulate', str(bag), '--outputs', outputs, '--effect', kind + where, '--samples', samples,
                 '--seed', '5', '--truth', str(tmp_path / 'truth.json')]) == 0
    params.write_text(PARAMS.format(
        joints=', '.join(ICUB_JOINTS), temperatures='r_elbow' if outputs == 'effort' else ICUB_SENSOR,
        outputs='outputs: effort' if outputs == 'effort' else
        f'sensor_frame: {ICUB_SENSOR}\n    wrench_convention: reaction'))
    among = [] if long else ['--kinds', kind, *LIKE[outputs]]
    assert main(['diagnose', str(bag), '--params', str(params), '-o', str(found),
                 '--json', str(tmp_path / 'd.json'), *among]) == 0
    told = json.loads((tmp_path / 'd.json').read_text())
    assert [(each['kind'], each['where']) for each in told['effects']] == [(kind, 'r_elbow' if where else None)]
    truth = json.loads((tmp_path / 'truth.json').read_text())['effects'][0]['parameters']
    effect = effect_from_text(load_params(found).effects[0])
    assert effect.value('reference_c') == pytest.approx(truth['reference_c']['value'], abs=1.5)
    if outputs == 'effort':
        values = {name: entry['value'] for name, entry in told['effects'][0]['parameters'].items()}
        for name, entry in values.items():
            assert entry == pytest.approx(truth[name]['value'], rel=0.1), name
    assert main(['evaluate', str(bag), '--params', str(found), '--variant', 'P']) == 0


def test_temperatures_alone_are_no_finding():
    recording = simulate(Scenario(samples=1500, seed=6, temperatures=True))
    found = diagnose(body_of(recording), samples_of(recording))
    assert found.verdict == 'nothing_missing'


def test_friction_without_warming_is_plain_although_temperatures_are_recorded(long):
    recording = simulate(Scenario(samples=1500, outputs='effort', seed=7, temperatures=True,
                                  effects=(EffectRequest('viscous_friction', 'r_elbow'),)))
    among = () if long else ('temperature_friction', *LIKE['effort'])
    found = diagnose(body_of(recording), samples_of(recording), only=among)
    assert [finding.effect.kind for finding in found.findings] == ['viscous_friction']


def test_drift_in_time_is_told_from_what_follows_the_temperature(long):
    recording = simulate(Scenario(samples=1500, seed=8, temperatures=True, effects=(EffectRequest('thermal_drift'),)))
    among = () if long else ('temperature_drift', *LIKE['wrench'])
    found = diagnose(body_of(recording), samples_of(recording), only=among)
    assert [finding.effect.kind for finding in found.findings] == ['thermal_drift']


@pytest.mark.parametrize('change', ['none recorded', 'constant', 'not known'])
def test_nobody_looks_for_it_where_no_temperature_changes(change):
    recording = simulate(Scenario(samples=300, outputs='effort', seed=9, temperatures=change != 'none recorded'))
    samples = samples_of(recording)
    if change != 'none recorded':
        samples.temperature[:] = 30.0 if change == 'constant' else np.nan
    fit = fit_model(body_of(recording), samples, [], np.ones(300, dtype=bool), np.ones(4))
    tried = {trial.effect.kind for trial in coarse(fit, candidates(fit), lambda words, share: None)}
    assert 'viscous_friction' in tried and 'temperature_friction' not in tried
