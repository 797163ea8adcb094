"""`semiparam fit` and `semiparam compare` on recordings of a simulated arm: figures, places to run, and mistakes."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semiparam_ros.cli.evaluate import load_bags
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.variants import VARIANTS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments import parallel
from semiparam_ros.experiments.comparison import (
    Spread,
    Trace,
    VariantFigures,
    findings_of,
    follow,
    index_figures,
    learn,
    mode_figures,
    scenario_from,
    verdict,
)
from semiparam_ros.settings import Settings, dump_params, load_params
from support import recordings
from support.commands import document, refusal, semiparam
from support.recordings import FRAME, JOINTS, write_arm

INITIAL = 150
PARAMETERS = {'sensor_frame': FRAME, 'joints': list(JOINTS), 'features.count': 20, 'features.length_scales': 'one',
              'initial.samples': INITIAL, 'horizon.length': 5}
QUICK = ['--variant', 'P', '--variant', 'SPK-ML', '--variant', 'SP2-VS', '--subsets', '2', '--seeds', '2',
         '--starts', '1']


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Two recordings and a parameter file."""
    folder = tmp_path_factory.mktemp('compare')
    write_arm(folder / 'train.mcap', 300, seed=1)
    write_arm(folder / 'test.mcap', 160, seed=2)
    dump_params(Settings.from_mapping(PARAMETERS), folder / 'arm.yaml')
    return folder


@pytest.fixture(scope='module')
def compare(folder):
    """Runs the command and returns its JSON document and its page."""
    def run(*options, jobs=1):
        found = document(folder / 'result.json', 'compare', folder / 'train.mcap', folder / 'test.mcap',
                         '--params', folder / 'arm.yaml', '--jobs', jobs, '-o', folder / 'page.html', *options)
        return found, (folder / 'page.html').read_text()
    return run


@pytest.fixture(scope='module')
def quick(compare):
    return compare(*QUICK)


def without_times(found):
    """Everything that must not depend on where and how fast it ran."""
    variants = {name: {key: value for key, value in variant.items() if key != 'fit_seconds'}
                for name, variant in found['variants'].items()}
    return {**found, 'variants': variants}


def test_the_document_holds_every_figure(quick):
    found, text = quick
    assert (found['schema'], found['command']) == (1, 'compare')
    assert found['subsets'] == [[0, 80], [80, 160]]
    assert list(found['variants']) == ['P', 'SPK-ML', 'SP2-VS']
    for name, variant in found['variants'].items():
        assert variant['seeds'] == ([0] if name == 'P' else [0, 1])
        for mode in ('learning', 'frozen'):
            figures = variant[mode]
            assert len(figures['nmse']['values']) == len(variant['seeds'])
            assert (figures['nmse']['std'] is None) == (name == 'P')
            assert figures['nmse']['mean'] == pytest.approx(np.mean(figures['nmse_by_output']))
            assert 0.5 < figures['coverage']['mean'] <= 1.0
        assert 0.0 < variant['eps_force']['first_60_s']['mean'] < 0.1
        # four seconds a subset: nothing is steady
        assert variant['eps_torque']['steady_state'] is None
    assert 'in time</h2>' in text and 'in steady state</h2>' not in text


def test_it_is_the_estimator_of_evaluate(compare, folder):
    """With one subset, the same samples in the same order: the same figures."""
    found, _ = compare('--variant', 'SPK-ML', '--subsets', '1', '--seeds', '1')
    # compare keeps to the paper's models, which have no wandering offset.
    dump_params(replace(load_params(folder / 'arm.yaml'), forgetting=1.0, priors='paper',
                        features_frequencies='independent'), folder / 'paper.yaml')
    for mode, option in (('learning', []), ('frozen', ['--frozen'])):
        evaluated = document(folder / 'evaluate.json', 'evaluate', folder / 'test.mcap', '--train',
                             folder / 'train.mcap', '--params', folder / 'paper.yaml', *option)['variants']['SPK-ML']
        compared = found['variants']['SPK-ML']
        assert compared[mode]['nmse_by_output'] == pytest.approx(evaluated['nmse'], rel=1e-9)
        if mode == 'learning':
            early = compared['eps_force']['first_30_s']['mean']
            assert early == pytest.approx(evaluated['eps_force']['mean'], rel=1e-9)


def test_the_time_of_an_effect_counts_from_the_recordings_start_in_every_part(folder):
    """What begins after 3 s is there in the second part, which begins after 4 s, from its first sample on."""
    scenarios = {}
    for start, effect in ((3.0, 'external_force@r_hand{"start_s": 3}'), (0.0, 'external_force@r_hand')):
        settings = Settings.from_mapping({**PARAMETERS, 'variant': 'P', 'effects': [effect]})
        train, test = load_bags([folder / 'train.mcap', folder / 'test.mcap'], settings)
        scenarios[start] = scenario_from(settings, train, test, subsets=2, variants=['P'], seeds=[0])
    model = learn(scenarios[3.0], 'P', 0).model
    always = model._replace(settings=replace(model.settings, effects=scenarios[0.0].settings.effects))
    for subset, same in ((0, False), (1, True)):
        late = follow(scenarios[3.0], model, subset).frozen.errors
        assert np.array_equal(late, follow(scenarios[0.0], always, subset).frozen.errors) == same


def test_joints_that_only_the_description_names_are_told_by_name(folder):
    """A page of efforts called them joint 1, joint 2 ..."""
    settings = Settings.from_mapping(PARAMETERS)
    train, test = load_bags([folder / 'train.mcap', folder / 'test.mcap'], settings)
    assert scenario_from(replace(settings, joints=()), train, test).settings.joints == JOINTS


def test_several_processes_change_nothing(quick, compare):
    assert without_times(compare(*QUICK, jobs=2)[0]) == without_times(quick[0])


def test_a_dask_cluster_of_two_processes_changes_nothing(quick, compare):
    if os.environ.get('CI', '').lower() != 'true':
        pytest.importorskip('distributed')
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None,
                      host='127.0.0.1') as cluster:
        found, _ = compare(*QUICK, '--scheduler', cluster.scheduler_address)
        tasks = cluster.scheduler.transition_counter
    assert tasks > 0
    assert without_times(found) == without_times(quick[0])


def test_an_interrupt_of_a_terminal_ends_it_without_a_traceback_of_its_workers(folder, tmp_path):
    """It goes to the whole group of processes: workers that were still loading told where."""
    words = ['compare', folder / 'train.mcap', folder / 'test.mcap', '--params', folder / 'arm.yaml', '--starts', 500,
             '-o', tmp_path / 'page.html']
    with subprocess.Popen([sys.executable, '-m', 'semiparam_ros.cli.main', *map(str, words)], stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, text=True, start_new_session=True) as process:
        children = Path(f'/proc/{process.pid}/task/{process.pid}/children')
        deadline = time.monotonic() + 60
        workers = []
        while not workers and time.monotonic() < deadline:
            workers = [pid for pid in children.read_text().split()
                       if 'LokyProcess' in told_of(pid, 'cmdline') and '_multiarray_umath' in told_of(pid, 'maps')]
        assert workers
        os.killpg(process.pid, signal.SIGINT)
        assert process.communicate(timeout=60)[0] == '' and process.returncode == 130
    assert not list(tmp_path.iterdir()) and not any(told_of(pid, 'cmdline') for pid in workers)


def told_of(pid, what):
    """What the system tells of a process, nothing of one that has ended."""
    with contextlib.suppress(OSError):
        return Path(f'/proc/{pid}/{what}').read_text()
    return ''


def test_all_seven_models_are_compared_unless_told(compare, folder):
    found, page = compare('--subsets', '1', '--seeds', '1', '--starts', '1', '--grid-tau', '1', '4')
    assert list(found['variants']) == list(VARIANTS)
    assert [finding['name'] for finding in found['findings']] == [
        'parametric_is_worst', 'likelihood_beats_validation', 'semi_parametric_is_best_average',
        'semi_parametric_is_best_spread', 'others_are_close']
    assert found['findings'][0]['holds'] is None  # too short to have a steady state
    assert all(variant in page for variant in VARIANTS)
    assert found['verdict'] in page


def test_one_recording_serves_as_both(folder, capsys):
    """Of the part that was learnt, a sentence says so."""
    bag, link = folder / 'train.mcap', folder / 'link.mcap'
    link.symlink_to(bag)
    cut = ['--train-samples', 200, '--params', folder / 'arm.yaml', '--variant', 'P', '--subsets', 2, '--seeds', 1,
           '-o', folder / 'p.html']
    found = document(folder / 'both.json', 'compare', bag, bag, '--test-from', 200, *cut)
    assert found['subsets'] == [[200, 250], [250, 300]]
    assert capsys.readouterr().err == ''  # neither of what was learnt, nor of the features that P has not
    assert semiparam('compare', bag, link, '--test-from', 199, *cut) == 0
    assert capsys.readouterr().err == f'{link} is judged after it was learnt: its errors say nothing of another ' \
                                      'recording.\n'


def test_the_fitted_file_gives_what_was_fitted(folder):
    fitted = folder / 'fitted.yaml'
    found = document(folder / 'fit.json', 'fit', folder / 'train.mcap', '--params', folder / 'arm.yaml', '-o', fitted,
                     '--jobs', 1)['hyperparameters']
    settings = load_params(fitted)
    assert settings.hyperparameters_sigma == (found['sigma'],)
    assert settings.hyperparameters_tau == tuple(found['tau'])
    assert len(settings.hyperparameters_input_mean) == 12

    results = [document(folder / 'out.json', 'evaluate', folder / 'test.mcap', '--train', folder / 'train.mcap',
                        '--frozen', '--params', folder / params)['variants']['SPK-ML']['nmse']
               for params in ('arm.yaml', 'fitted.yaml')]
    # What it gives the variant is the same; the rigid body beside it had a noise of its own.
    assert results[0] == pytest.approx(results[1], rel=0.05)


@pytest.mark.parametrize('variant', VARIANTS)
def test_a_file_of_every_variant_loads(folder, variant):
    fitted = folder / f'{variant}.yaml'
    quick = ['--grid-tau', 1, 4] if VARIANTS[variant].selection == 'vs' else ['--starts', 1]
    assert semiparam('fit', folder / 'train.mcap', '--params', folder / 'arm.yaml', '-o', fitted, '--jobs', 1,
                     '--variant', variant, *quick) == 0
    assert load_params(fitted).variant == variant
    assert semiparam('evaluate', folder / 'test.mcap', '--params', fitted) == 0


@pytest.mark.parametrize(('options', 'sentence'), [
    (['--subsets', '0'], '0 subsets'), (['--subsets', '40'], 'more than the horizon of 5'),
    (['--subset-samples', '100'], 'more than the 160'), (['--subset-samples', '0'], 'has 0 samples'),
    (['--train-samples', '100'], 'initial window'), (['--train-samples', '-5'], '-5 samples of the first'),
    (['--test-from', '160'], 'start at sample 160'), (['--seeds', '0'], '--seeds is 0'),
    (['--jobs', '0'], '--jobs is 0'), (['--starts', '0'], '--starts is 0'),
    (['--grid-tau', '1', '--grid-ratio', '0.1'], 'one point'),
    (['--grid-tau', '1', '1', '--grid-ratio', '0.1'], 'one point'),
    (['--grid-tau', 'nan', '1'], 'grid holds nan'), (['--variant', 'SPX'], "'SPX' is unknown"),
    (['-o', '/nowhere/page.html'], 'no folder /nowhere'), (['--json', '/'], 'it is a folder')])
def test_a_senseless_request_is_refused_in_one_sentence(folder, capsys, options, sentence):
    page = folder / 'refused.html'
    assert sentence in refusal(capsys, 'compare', folder / 'train.mcap', folder / 'test.mcap', '--params',
                                 folder / 'arm.yaml', '-o', page, *options)
    assert not page.exists()


@pytest.mark.parametrize(('options', 'sentence'), [
    (['-o', '/nowhere/fitted.yaml'], 'no folder /nowhere'), (['-o', '/'], 'it is a folder'),
    (['--grid-tau', '1', '--grid-ratio', '0.1'], 'one point'), (['--grid-ratio', '-1', '1'], 'grid holds -1'),
    (['--starts', '0'], '--starts is 0'), (['--variant', 'SPX'], "'SPX' is unknown"),
    (['--variant', 'all'], '--variant is all; expected one of P, ')])
def test_a_senseless_fit_is_refused_in_one_sentence(folder, capsys, options, sentence):
    written = folder / 'refused.yaml'
    assert sentence in refusal(capsys, 'fit', folder / 'train.mcap', '--params', folder / 'arm.yaml', '-o', written,
                                 '--variant', 'NP-VS', *options)
    assert not written.exists()


def test_a_recording_too_short_for_a_fit_is_refused(folder, capsys, tmp_path):
    short = write_arm(tmp_path / 'short.mcap', 10)
    assert semiparam('fit', short, '--params', folder / 'arm.yaml', '-o', tmp_path / 'p.yaml') == 2
    assert 'holds 10 samples; expected at least 20' in capsys.readouterr().err  # after a remark
    assert not (tmp_path / 'p.yaml').exists()


def test_recordings_of_different_robots_are_refused(folder, capsys, tmp_path, monkeypatch):
    (tmp_path / 'other.urdf').write_text(recordings.URDF.read_text().replace('<mass value="', '<mass value="1'))
    monkeypatch.setattr(recordings, 'URDF', tmp_path / 'other.urdf')
    other = write_arm(tmp_path / 'other.mcap', 200, seed=3)
    train, params = folder / 'train.mcap', ('--params', folder / 'arm.yaml')
    for command in (('compare', train, other, *params, '-o', tmp_path / 'p.html'), ('evaluate', train, other, *params),
                    ('evaluate', train, '--train', other, *params), ('diagnose', train, other, *params),
                    ('diagnose', train, '--judge', other, *params)):
        assert 'different robot descriptions' in refusal(capsys, *command)


@pytest.fixture(scope='module')
def still(tmp_path_factory):
    """Recordings of noise in which one output stands still, and all of them, with a parameter file."""
    folder = tmp_path_factory.mktemp('still')
    table = np.random.default_rng(0).normal(size=(300, 18))
    for name, constant in (('one', slice(14, 15)), ('all', slice(12, 18))):
        fixed = table.copy()
        fixed[:, constant] = 3.0
        np.savetxt(folder / f'{name}.dat', fixed)
        assert semiparam('convert', folder / f'{name}.dat', folder / f'{name}.mcap', '--columns',
                         recordings.URDF.with_name('icub_table.yaml')) == 0
    settings = Settings.from_mapping(PARAMETERS | {'robot_description_file': str(recordings.URDF)})
    dump_params(settings, folder / 'arm.yaml')
    return folder


def test_a_channel_that_stands_still_is_named(still, capsys, tmp_path):
    result, params = tmp_path / 'result', ['--params', still / 'arm.yaml']
    sentence = 'output 2 (counted from 0) is constant'
    assert sentence in refusal(capsys, 'fit', still / 'one.mcap', *params, '-o', result)
    assert sentence in refusal(capsys, 'compare', still / 'one.mcap', still / 'one.mcap', *params, '--variant', 'P',
                                 '--subsets', '1', '--jobs', '1', '-o', result)
    assert not result.exists()


def test_outputs_without_any_variance_are_refused_before_the_work(still, folder, capsys, tmp_path):
    assert 'every output of the second recording is constant' in refusal(
        capsys, 'compare', folder / 'train.mcap', still / 'all.mcap', '--params', still / 'arm.yaml', '-o',
        tmp_path / 'p.html')
    assert not (tmp_path / 'p.html').exists()


@contextlib.contextmanager
def silent_listener():
    """The address of something that takes connections and never says a word."""
    with socket.create_server(('127.0.0.1', 0)) as listener:
        yield f'tcp://127.0.0.1:{listener.getsockname()[1]}'


@pytest.mark.parametrize('address', ['tcp://127.0.0.1:9', 'nonsense', 'silent'])
def test_a_cluster_that_does_not_answer_is_named(folder, capsys, monkeypatch, address):
    pytest.importorskip('distributed')
    monkeypatch.setattr(parallel, 'ANSWER_S', 0.5)
    with silent_listener() if address == 'silent' else contextlib.nullcontext(address) as asked:
        assert f"no Dask scheduler answers at '{asked}'" in refusal(
            capsys, 'compare', folder / 'train.mcap', folder / 'test.mcap', '--params', folder / 'arm.yaml',
            '--scheduler', asked, '-o', folder / 'unanswered.html')
    assert not (folder / 'unanswered.html').exists()


def test_a_cluster_without_workers_is_named(folder, capsys):
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(n_workers=0, dashboard_address=None, host='127.0.0.1') as cluster:
        assert 'has no worker' in refusal(
            capsys, 'compare', folder / 'train.mcap', folder / 'test.mcap', '--params', folder / 'arm.yaml',
            '--scheduler', cluster.scheduler_address, '-o', folder / 'idle.html')
    assert not (folder / 'idle.html').exists()


def test_a_cluster_that_goes_away_is_named():
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None,
                                  host='127.0.0.1') as cluster:
        leave = threading.Timer(1.0, cluster.close)
        with pytest.raises(SemiparamError, match='went away before the work was done'), \
                parallel.workers(1, cluster.scheduler_address):
            leave.start()
            parallel.run_all(time.sleep, [(20.0,), (20.0,)])
        leave.join()


def trace(eps, errors=None, std=1.0, dt=0.1):
    """A trace of two subsets' worth of samples with a given horizon index."""
    eps = np.asarray(eps, dtype=float)
    outputs = np.random.default_rng(0).normal(size=(len(eps), 6))
    errors = np.full_like(outputs, 0.1) if errors is None else errors
    return Trace(errors, outputs, np.full_like(outputs, std), np.zeros(len(eps)), dt * np.arange(len(eps)),
                 np.repeat(eps[:, None], 6, axis=1))


def test_indices_are_averaged_over_subsets_and_told_apart_by_phase():
    falling = np.where(np.arange(1000) < 300, 3.0, 1.0)  # 30 s of 3, then 70 s of 1
    found = index_figures([[trace(falling), trace(falling + 2.0)]], slice(0, 3))
    assert found.first_30_s.mean == pytest.approx(4.0)
    assert found.first_60_s.mean == pytest.approx(3.0)
    assert found.steady_state == Spread(pytest.approx(2.0), None, (pytest.approx(2.0),))
    assert found.spread.mean == 0.0


def test_bands_are_counted():
    rng = np.random.default_rng(1)
    draws = [[trace(np.ones(4000), rng.normal(size=(4000, 6)), std)] for std in (1.0, 1.0)]
    found = mode_figures(draws)
    assert found.coverage.mean == pytest.approx(0.95, abs=0.01)
    assert found.coverage_by_level[0] == pytest.approx(0.5, abs=0.02)
    narrow = mode_figures([[trace(np.ones(4000), rng.normal(size=(4000, 6)), 0.5)]])
    assert narrow.coverage.mean == pytest.approx(0.673, abs=0.02)


def invented(**levels):
    """Figures of variants whose index settles on a given level."""
    found = {}
    for variant, level in levels.items():
        name = variant.replace('_', '-')
        traces = [[trace(level * (1.0 + 0.1 * np.sin(np.arange(1000))))]]
        indices = {'eps_force': index_figures(traces, slice(0, 3)), 'eps_torque': index_figures(traces, slice(3, 6))}
        mode = mode_figures(traces)._replace(nmse=Spread(level, None, (level,)))
        found[name] = VariantFigures(name, (0,), mode, mode, mode, indices,
                                     (Hyperparameters(1.0, 1.0, (1.0,), 1.0, (1.0,) * 6),), 0.0)
    return found


AS_IN_THE_PAPER = {'P': 1.0, 'NP_ML': 0.12, 'SP_ML': 0.1, 'SP2_ML': 0.11, 'SPK_ML': 0.1, 'NP_VS': 0.14, 'SP2_VS': 0.13}


def test_the_papers_findings_hold_where_the_figures_say_so():
    findings = findings_of(invented(**AS_IN_THE_PAPER))
    assert [finding.holds for finding in findings] == [True] * 5


@pytest.mark.parametrize(('change', 'fails'), [
    ({'P': 0.13}, {'parametric_is_worst'}), ({'SP2_VS': 0.105}, {'likelihood_beats_validation'}),
    ({'SPK_ML': 0.12}, {'semi_parametric_is_best_average', 'semi_parametric_is_best_spread'}),
    ({'NP_VS': 0.2}, {'others_are_close'})])
def test_a_finding_that_does_not_hold_is_said_not_to(change, fails):
    figures = invented(**AS_IN_THE_PAPER | change)
    findings = findings_of(figures)
    assert {finding.name for finding in findings if not finding.holds} == fails
    assert f'{5 - len(fails)} of 5 findings' in verdict(figures, findings)


@pytest.mark.long
def test_findings_on_the_bundled_recordings(repository, tmp_path):
    """All seven models over two feature draws, with fewer features and shorter parts than the default: the paper's
    findings hold, P's error is a multiple of the others', and the bands hold what they promise on the known motion."""
    bags = [repository / 'bags' / name for name in ('icub_xy.mcap', 'icub_xz.mcap')]
    params = tmp_path / 'arm.yaml'
    settings = load_params(repository / 'config/icub_right_arm.yaml')
    dump_params(replace(settings, features_count=100, initial_samples=500), params)
    found = document(tmp_path / 'result.json', 'compare', *bags, '--params', params, '--seeds', 2, '--starts', 1,
                     '--jobs', 1, '--train-samples', 1500, '--subsets', 2, '--subset-samples', 900,
                     '-o', tmp_path / 'p.html')
    assert found['seeds'] == [0, 1]
    assert {finding['name']: finding['holds'] for finding in found['findings']} == {
        'parametric_is_worst': True, 'likelihood_beats_validation': True, 'semi_parametric_is_best_average': True,
        'semi_parametric_is_best_spread': True, 'others_are_close': True}
    variants = found['variants']
    assert variants['P']['learning']['nmse']['mean'] > 3.0 * variants['SPK-ML']['learning']['nmse']['mean']
    for name in ('P', 'NP-ML', 'SP-ML', 'SP2-ML', 'SPK-ML'):
        assert 0.93 <= variants[name]['first_recording']['coverage']['mean'] <= 0.97, name
