"""`make demo` on a short recording: three processes on real DDS, and what it says when something is wrong."""

import json
import subprocess
import sys

import pytest

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.cli import demo, demo_run
from semiparam_ros.cli.demo_run import Program, isolated
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings import Settings
from support.commands import document
from support.recordings import FRAME, INITIAL, JOINTS

LENGTH = 400  # of the recording in conftest.py


def run_demo(*arguments):
    words = [str(word) for word in arguments]
    return subprocess.run([sys.executable, '-m', 'semiparam_ros.cli.demo', *words], capture_output=True, text=True,
                          timeout=240, check=False)


@pytest.mark.slow
def test_demo_answers_every_sample_and_reports(recording, params, tmp_path, ros_domain):
    result = run_demo('--bag', recording, '--params', params, '--undeclared', tmp_path / 'none',
                      '--output', tmp_path, '--domain', ros_domain)
    assert result.returncode == 0, result.stderr
    assert f'all {LENGTH} samples answered' in result.stderr
    assert str(tmp_path / 'indices.png') in result.stderr
    assert (tmp_path / 'indices.png').read_bytes().startswith(b'\x89PNG')
    variants = json.loads((tmp_path / 'demo.json').read_text())['variants']
    assert list(variants) == ['SPK-ML live', 'P', 'NP-ML']
    assert all(variant in result.stdout for variant in variants)
    assert variants['SPK-ML live']['samples'] == variants['P']['samples'] == LENGTH - INITIAL
    assert variants['SPK-ML live']['update_ms']['median'] > 0.0
    # Live equals offline: what the demo shows is what `semiparam evaluate` reports.
    offline = document(tmp_path / 'offline.json', 'evaluate', recording, '--params', params)['variants']['SPK-ML']
    for name in ('rmse', 'nmse'):
        assert variants['SPK-ML live'][name] == pytest.approx(offline[name], rel=1e-9)
    for name in ('eps_force', 'eps_torque'):
        assert variants['SPK-ML live'][name]['mean'] == pytest.approx(offline[name]['mean'], rel=1e-9)


def test_a_lost_sample_is_named(recording, params, tmp_path, monkeypatch):
    settings = Settings(sensor_frame=FRAME, joints=JOINTS, initial_samples=INITIAL)
    bag = load_samples(recording, settings)
    residuals = {stamp: None for stamp in bag.samples.stamps.tolist()}
    del residuals[int(bag.samples.stamps[140])]
    monkeypatch.setattr(demo_run, 'published', lambda path: (residuals, []))
    with pytest.raises(SemiparamError, match=rf'1 of {LENGTH} samples were lost: no prediction .* at 7\.000 s'):
        demo_run.live_scores(tmp_path / 'live.mcap', bag, settings)


def test_a_node_that_cannot_start_is_a_sentence(tmp_path, ros_domain):
    (tmp_path / 'wrong.yaml').write_text("estimator: {ros__parameters: {sensor_frame: tool, varriant: P}}")
    with (Program(['run', '--params', tmp_path / 'wrong.yaml'], isolated(ros_domain), tmp_path / 'log') as node,
          pytest.raises(SemiparamError, match=r"run ended \(exit code 2\) before it was ready: .*'varriant'")):
        node.wait_for(lambda: False, 'it was ready', 60.0)


def test_a_missing_recording_is_a_sentence(params, tmp_path, capsys):
    assert demo.main(['--bag', str(tmp_path / 'none.mcap'), '--params', str(params), '--output', str(tmp_path)]) == 1
    assert 'none.mcap' in capsys.readouterr().err


def test_a_program_that_fails_tells_its_last_words(tmp_path):
    with (Program(['evaluate', 'a', '--params', 'none.yaml'], isolated(99), tmp_path / 'log') as program,
          pytest.raises(SemiparamError, match=r'evaluate failed with exit code 2: .*none\.yaml')):
        program.finish(60.0)


def test_a_program_is_stopped_when_its_block_ends(recording, tmp_path, ros_domain):
    arguments = ['replay', recording, '--rate', '0.01', '--quiet', '--disable-keyboard-controls']
    with Program(arguments, isolated(ros_domain), tmp_path / 'log') as program:
        program.check_running()
    with pytest.raises(SemiparamError, match='ended early'):
        program.check_running()
