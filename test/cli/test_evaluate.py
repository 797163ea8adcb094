"""`semiparam evaluate` on recordings that the test writes, and on the measured iCub arm."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.cli.evaluate import events_of, print_scores
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.experiments.evaluation import VariantScores, by_phase, normalised_errors, update_times
from semiparam_ros.settings import Settings, dump_params, load_params
from support import node_helpers
from support.commands import document, refusal, semiparam
from support.recordings import FRAME, INITIAL, JOINTS, PERIOD_NS, URDF, write_arm


@pytest.fixture
def evaluate(params, tmp_path):
    """Runs the command and returns its JSON document."""
    return partial(document_of, params, tmp_path / 'result.json')


def document_of(params, path, *arguments):
    return document(path, 'evaluate', *arguments, '--params', params)


@pytest.mark.parametrize('beside', [(), ('--train',)])
def test_a_recording_judged_after_it_was_learnt_is_said(beside, params, recording, tmp_path, capsys):
    link = tmp_path / 'link.mcap'
    link.symlink_to(recording)
    assert semiparam('evaluate', recording, *beside, link, '--params', params, '--variant', 'P') == 0
    judged = recording if beside else link
    assert capsys.readouterr().err.endswith(f'{judged} is judged after it was learnt: its errors say nothing of '
                                            'another recording.\n')


def test_what_is_judged_twice_and_never_learnt_needs_no_remark(params, recording, tmp_path, capsys):
    other = write_arm(tmp_path / 'other.mcap', 400, seed=3)
    assert semiparam('evaluate', recording, recording, '--train', other, '--frozen', '--params', params,
                     '--variant', 'P') == 0
    assert 'after it was learnt' not in capsys.readouterr().err


def test_the_external_wrench_as_a_table(params, recording, tmp_path, capsys):
    """What the model leaves of each sample, as the node tells it; of one variant alone."""
    table = tmp_path / 'external.csv'
    arguments = ['evaluate', recording, '--params', params, '--external-wrench', table, '--variant', 'P']
    assert semiparam(*arguments) == 0
    head, *rows = table.read_text().splitlines()
    assert head.startswith('stamp_ns,fx,') and head.endswith(',tz_std') and len(rows) == 400 - INITIAL
    values = np.array([[float(cell) for cell in row.split(',')] for row in rows])
    assert values.shape[1] == 13 and (np.diff(values[:, 0]) > 0).all() and (values[:, 7:] > 0.0).all()
    assert np.abs(values[:, 1:7]).mean() < 3 * values[:, 7:].mean()
    table.unlink()
    assert 'tells what one variant leaves; 2 are' in refusal(capsys, *arguments, '--variant', 'NP-ML')
    assert not table.exists()


def test_a_load_is_applied_and_taken_back_and_the_plot_marks_it(tmp_path, capsys):
    bag, settings, plot = tmp_path / 'load.mcap', tmp_path / 'p.yaml', tmp_path / 'load.png'
    motion = ['--motion', 'mixed', '--seconds', 75, '--seed', 2]
    load = ['--effect', 'payload', '--start', 45, '--end', 60]
    assert semiparam('simulate', bag, *motion, *load) == 0
    dump_params(
        replace(load_params('config/icub_right_arm.yaml'), variant='P', initial_samples=200), settings
    )
    errors, changes = {}, []
    for auto in ('off', 'report', 'apply'):
        found = document(tmp_path / f'{auto}.json', 'evaluate', bag, '--params', settings, '--auto', auto,
                         *(['--plot', plot] if auto == 'apply' else []))
        errors[auto], changes = found['variants']['P']['nmse_mean'], found['changes']
    assert plot.read_bytes().startswith(b'\x89PNG')
    assert max(errors['apply'], errors['report']) < 0.5 * errors['off']
    (change,) = changes
    decisions = [decision['what'] for decision in change['decisions']]
    assert decisions == ['taken off until it is named', 'tried beside the model', 'applied', 'taken back']
    assert 'It was taken back at' in capsys.readouterr().out.replace('\n', ' ')


def test_figures_of_each_variant(evaluate, recording, capsys):
    found = evaluate(recording, '--variant', 'P', '--variant', 'SPK-ML')
    assert found['schema'] == 1
    assert list(found['variants']) == ['P', 'SPK-ML']
    for result in found['variants'].values():
        assert len(result['nmse']) == len(result['rmse']) == 6
        assert result['nmse_mean'] == pytest.approx(np.mean(result['nmse']))
        assert result['samples'] == 400 - INITIAL
        assert 0.0 < result['update_ms']['median'] <= result['update_ms']['p99']
        assert 0.0 < result['eps_force']['mean'] < 0.1
        # 15 s are scored, so that all of them are the transient.
        assert result['eps_torque']['first_30_s'] == result['eps_torque']['mean']
        assert result['eps_torque']['steady_state'] is None
        assert 'series' not in result
    table = capsys.readouterr().out
    assert 'SPK-ML' in table and '[ms]' in table
    assert max(map(len, table.splitlines())) <= 80


def test_the_number_of_features_is_chosen_and_told(params, tmp_path, recording, capsys):
    auto = tmp_path / 'auto.yaml'
    dump_params(replace(load_params(params), features_count='auto', sensor_frame=FRAME), auto)
    found = document_of(auto, tmp_path / 'a.json', recording, '--variant', 'P', '--variant', 'SPK-ML')
    chosen = found['variants']['SPK-ML']['features']
    assert chosen in (50, 100, 200, 300, 400, 500)
    assert found['variants']['P']['features'] == 0
    assert f'random features: {chosen} (SPK-ML)' in capsys.readouterr().out
    found = document_of(params, tmp_path / 'b.json', recording, '--variant', 'SPK-ML')
    assert found['variants']['SPK-ML']['features'] == 20
    assert 'random features' not in capsys.readouterr().out


def test_figures_are_those_of_the_estimator(evaluate, recording):
    from semiparam_ros.bags.loading import load_samples

    settings = Settings(sensor_frame=FRAME, joints=JOINTS)
    estimator = Estimator(RigidBody.from_urdf(URDF.read_text(), JOINTS, 'wrench', FRAME),
                          ModelOptions(variant='P', initial_samples=INITIAL, horizon=5))
    predictions = [estimator.step(sample) for sample in load_samples(recording, settings).samples]
    ready = [each for each in predictions if each.ready]
    errors = np.array([each.mean - each.sample.outputs for each in ready])
    outputs = np.array([each.sample.outputs for each in ready])
    result = evaluate(recording, '--variant', 'P')['variants']['P']
    np.testing.assert_allclose(result['rmse'], np.sqrt(np.mean(errors**2, axis=0)), rtol=1e-12)
    np.testing.assert_allclose(result['nmse'], np.mean(errors**2, axis=0) / outputs.var(axis=0), rtol=1e-12)
    eps = np.mean([each.horizon.eps[:3] for each in ready if each.horizon])
    assert result['eps_force']['mean'] == pytest.approx(eps, rel=1e-12)


def test_series_and_plot_on_request(evaluate, recording, tmp_path):
    result = evaluate(recording, '--variant', 'P', '--series', '--plot', tmp_path / 'eps.svg')['variants']['P']
    series = result['series']
    assert len(series['time_s']) == len(series['eps_force']) == 400 - INITIAL - 5
    assert np.mean(series['eps_torque']) == pytest.approx(result['eps_torque']['mean'])
    assert series['time_s'][0] == pytest.approx(INITIAL * PERIOD_NS * 1e-9, abs=0.1)
    assert (tmp_path / 'eps.svg').read_text().count('</svg>') == 1


def test_frozen_after_training_scores_every_sample_and_learns_none(params, recording, tmp_path):
    # With forgetting auto the offset of the last moment learnt ebbs away, so a second pass differs a little.
    without = tmp_path / 'without.yaml'
    dump_params(replace(load_params(params), forgetting=1.0), without)
    evaluate = partial(document_of, without, tmp_path / 'result.json')
    test = write_arm(tmp_path / 'b.mcap', 200, seed=5, start=10**18)
    frozen = evaluate(test, '--train', recording, '--frozen', '--variant', 'P')['variants']['P']
    learning = evaluate(test, '--train', recording, '--variant', 'P')['variants']['P']
    untrained = evaluate(test, '--variant', 'P')['variants']['P']
    assert frozen['samples'] == learning['samples'] == 200
    assert untrained['samples'] == 200 - INITIAL
    assert frozen['rmse'] != learning['rmse']
    twice = evaluate(test, test, '--train', recording, '--frozen', '--variant', 'P')['variants']['P']
    np.testing.assert_allclose(twice['rmse'], frozen['rmse'], rtol=1e-12)


def test_contacts_are_scored_but_not_learnt(recording, tmp_path):
    """The gate that the node has: a contact that never ends leaves the model as trained."""
    values = {'sensor_frame': FRAME, 'joints': list(JOINTS), 'initial.samples': INITIAL, 'variant': 'P',
              'gate.enabled': True, 'gate.timeout': 0.0}
    path = tmp_path / 'gate.yaml'
    dump_params(Settings.from_mapping(values), path)
    touched = write_arm(tmp_path / 'touched.mcap', 200, seed=2, start=10**12, bias=50.0)
    learning, frozen = (document_of(path, tmp_path / 'result.json', touched, '--train', recording, *option)
                        for option in ([], ['--frozen']))
    assert learning['variants']['P']['rmse'] == frozen['variants']['P']['rmse']


@pytest.mark.parametrize('arguments, sentence', [
    (['{bag}', '--takeover-after', '130,soon'], '--takeover-after is 130,soon; expected numbers of samples'),
    (['{bag}', '--takeover-after', '130,' + '9' * 5000], '; expected numbers of samples'),
    (['{bag}', '--takeover-after', '100000', '--variant', 'P'], 'the recordings end, after 400 samples, before the '
     'model takes over; expected a smaller --takeover-after than 100000.'),
    (['{bag}', '--frozen'], '--frozen predicts with what was learnt'),
    (['{bag}', '--variant', 'SPQ'], "variant 'SPQ' is unknown"),
    (['{bag}', '--plot', '{folder}/a.xyz', '--variant', 'P'], 'expected a suffix of'),
    (['{folder}/none.mcap'], 'none.mcap'),
    (['{bag}', '--params', '{folder}/none.yaml'], 'none.yaml'),
])
def test_mistakes_are_one_sentence(arguments, sentence, recording, params, tmp_path, capsys):
    words = [word.format(bag=recording, folder=tmp_path) for word in arguments]
    given = [] if '--params' in words else ['--params', params]
    assert sentence in refusal(capsys, 'evaluate', *words, *given)


def test_the_description_is_in_one_of_several_recordings(params, recording, tmp_path, capsys):
    """All was evaluated and shown, and then the first recording refused for having none."""
    bare = tmp_path / 'bare.mcap'
    assert semiparam('convert', recording, bare, '--topic', '/joint_states', '--topic', '/wrench') == 0
    found = document_of(params, tmp_path / 'result.json', bare, recording, '--variant', 'P')
    assert found['variants']['P']['samples'] == 800 - INITIAL


@pytest.mark.parametrize('command', ['evaluate', 'fit', 'export', 'diagnose'])
def test_a_floating_base_that_is_held_still_is_told_once(command, recording, tmp_path, capsys):
    """It was locked at zero without a word."""
    name = ElementTree.fromstring(URDF.read_text()).find('link').get('name')
    on_it = f'<link name="all"/><joint name="loose" type="floating"><parent link="all"/><child link="{name}"/></joint>'
    urdf, params = tmp_path / 'loose.urdf', tmp_path / 'loose.yaml'
    urdf.write_text(URDF.read_text().replace('</robot>', f'{on_it}</robot>'))
    dump_params(Settings.from_mapping({'sensor_frame': FRAME, 'joints': list(JOINTS), 'initial.samples': INITIAL,
                                       'robot_description_file': str(urdf), 'variant': 'P'}), params)
    more = {'fit': ['-o', tmp_path / 'fit.yaml'], 'diagnose': ['--kinds', 'viscous_friction']}.get(command, [])
    capsys.readouterr()
    semiparam(command, recording, '--params', params, *more)
    told = ' '.join(capsys.readouterr().err.split())
    assert told.count('joints that are floating or planar, loose, which are held at zero') == 1


def test_too_short_a_recording_is_refused(params, tmp_path, capsys):
    bag = write_arm(tmp_path / 'short.mcap', 60)
    assert 'the robot moves in 60 of 60 samples, which are too few: the initial window' in refusal(
        capsys, 'evaluate', bag, '--params', params)


def test_windows_without_hyperparameters_are_the_reason_that_is_told(params, tmp_path, capsys):
    """Not that the robot moves too little, which it does in all of them."""
    whole, dead = write_arm(tmp_path / 'whole.mcap', 400), tmp_path / 'dead.mcap'
    with open_bag(whole) as source, BagWriter(dead) as bag:
        for message in source.messages():
            if message.topic == '/wrench':
                message.data.wrench.torque.z = 0.0
            bag.write(message.topic, message.type, message.data, message.log_time)
    told = refusal(capsys, 'evaluate', dead, '--params', params, '--variant', 'P')
    assert 'no initial window gives hyperparameters, the last one because output 5' in told


def test_the_widest_figures_fit_into_a_terminal(capsys):
    indices = {name: {'first_30_s': 1.23e-5, 'steady_state': 0.00123} for name in ('eps_force', 'eps_torque')}
    result = {'nmse_mean': 0.00123, **indices, 'update_ms': {'median': 0.123, 'p99': 12.3}, 'samples': 10000}
    print_scores(Console(width=80, markup=False), {'SP2-ML live': result})
    row = capsys.readouterr().out.splitlines()[-1].split()
    assert row == ['SP2-ML', 'live', '0.00123', *['1.2e-05', '0.00123'] * 2, '0.123', '12.3', '10000']


def test_phases_begin_when_learning_does():
    times, values = np.array([100.0, 129.9, 130.0, 200.0]), np.array([1.0, 3.0, 10.0, 20.0])
    assert by_phase(times, values) == {'mean': 8.5, 'first_30_s': 2.0, 'steady_state': 15.0}
    assert by_phase(times[:0], values[:0]) == {'mean': None, 'first_30_s': None, 'steady_state': None}


def test_a_constant_channel_has_no_normalised_error():
    errors, measured = np.array([[1.0, 2.0], [1.0, -2.0]]), np.array([[5.0, 3.0], [5.0, 7.0]])
    assert normalised_errors(errors, measured) == ([None, 1.0], [1.0, 2.0])
    measured = np.column_stack([np.full(500, 0.3), np.arange(500.0)])  # whose variance is rounding, not 0
    assert normalised_errors(np.ones((500, 2)), measured)[0] == [None, pytest.approx(1.0 / measured[:, 1].var())]


def test_time_goes_on_from_one_recording_to_the_next():
    scores = VariantScores('effort')
    for origin in (0, 10**18):
        scores.start_recording(origin)
        for second in range(3):
            scores.add_horizon(HorizonErrors(origin + second * 10**9, np.array([0.1, 0.3]), np.array([0.2, 0.4])))
    times, values = scores.index_series()
    assert times.tolist() == [0.0, 1.0, 2.0, 2.0, 3.0, 4.0]
    np.testing.assert_allclose(values[0], [0.2, 0.3])
    stamps = [10**9, 10**18, 10**18 + 10**9]  # where a plot marks what happened then
    assert [scores.time_of(stamp) for stamp in stamps] == [1.0, 2.0, 3.0]
    records = [SimpleNamespace(events=[(-10**9, 'while it was trained'), (stamps[1], 'payload begins')])]
    assert events_of(records, scores) == [(2.0, 'payload begins')]


def test_update_times_in_milliseconds():
    assert update_times([0.001, 0.002, 0.003]) == {'median': 2.0, 'p99': pytest.approx(2.98)}
    assert update_times([]) is None


def test_a_robot_whose_sensor_says_nothing_first_is_evaluated_from_its_first_window_that_varies(tmp_path, capsys):
    """Two windows in which nothing varies give no hyperparameters; the command goes on, as the node does."""
    still = node_helpers.SETTINGS.initial_samples * 2
    samples = node_helpers.motion(still + 140)
    samples[:still] = [sample._replace(outputs=np.ones(6)) for sample in samples[:still]]
    bag = node_helpers.write_bag(tmp_path / 'still.mcap', samples)
    dump_params(node_helpers.SETTINGS, tmp_path / 'two.yaml')
    figures = document_of(tmp_path / 'two.yaml', tmp_path / 'result.json', bag)['variants']['SPK-ML']
    assert figures['samples'] == 140 - node_helpers.SETTINGS.initial_samples
    assert capsys.readouterr().err.count('is constant over the initial window') == 2
    never = node_helpers.write_bag(tmp_path / 'never.mcap', samples[:still])
    assert semiparam('evaluate', never, '--params', tmp_path / 'two.yaml') == 2
