"""`semiparam simulate` and the bundled recordings that it made."""

import argparse
import json
import shlex
from dataclasses import replace

import numpy as np
import pytest
import zstandard

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.cli.main import main
from semiparam_ros.cli.simulate import add_arguments, scenario_of
from semiparam_ros.core.samples import Samples
from semiparam_ros.settings import Settings, dump_params, load_params
from semiparam_ros.settings.build import build_rigid_body
from semiparam_ros.simulation.robots import ICUB_JOINTS, arm_of
from semiparam_ros.simulation.scenario import Scenario
from support.arms import ODD_ARM, ODD_JOINTS
from support.commands import refusal

BUNDLED_WITH_ZSTD = (1, 5, 7)
BUNDLED = ('icub_xy', 'icub_xz', 'icub_undeclared')


def raw(path):
    return [(message.topic, message.log_time, message.raw) for message in open_bag(path).messages(decode=False)]


def commands(repository):
    """The line of bags/README.md that makes each bundled recording: name -> arguments behind the output."""
    lines = [shlex.split(line) for line in (repository / 'bags' / 'README.md').read_text().splitlines()
             if line.strip().startswith('semiparam simulate')]
    return {words[2].removeprefix('bags/').removesuffix('.mcap'): words[3:] for words in lines}


@pytest.mark.parametrize('name', [pytest.param('icub_xy', marks=pytest.mark.long),
                                  pytest.param('icub_xz', marks=pytest.mark.long), 'icub_undeclared'])
def test_bundled_recordings_are_made_again(repository, tmp_path, name):
    bundled, again = repository / 'bags' / f'{name}.mcap', tmp_path / 'again.mcap'
    assert main(['simulate', str(again), *commands(repository)[name]]) == 0
    assert raw(again) == raw(bundled)
    # Another zstd library may compress the same messages to other bytes.
    if zstandard.ZSTD_VERSION == BUNDLED_WITH_ZSTD:
        assert again.read_bytes() == bundled.read_bytes()


def test_bundled_recordings_are_small_and_complete(repository):
    paths = [repository / 'bags' / f'{name}.mcap' for name in BUNDLED]
    assert sum(path.stat().st_size for path in paths) < 12_000_000
    for path, samples in zip(paths, (10000, 10000, 4000), strict=True):
        counts = {topic: info.count for topic, info in open_bag(path).topics.items()}
        assert counts == {'/robot_description': 1, '/joint_states': samples, '/joint_accelerations': samples,
                          '/wrench': samples}


def test_a_recording_holds_what_a_robot_publishes(repository, tmp_path):
    bag, truth = tmp_path / 'out.mcap', tmp_path / 'truth.json'
    assert main(['simulate', str(bag), '--seconds', '20', '--effect', 'payload@r_hand', '--effect', 'time_delay',
                 '--size', '1', '--size', '0.5', '--truth', str(truth)]) == 0
    first = {message.topic: message.data for message in reversed(list(open_bag(bag).messages()))}
    assert first['/robot_description'].data == (repository / 'config' / 'icub_right_arm.urdf').read_text()
    assert list(first['/joint_states'].name)[3] == 'r_elbow'
    assert len(first['/joint_states'].position) == len(first['/joint_states'].velocity) == 4
    assert len(first['/joint_accelerations'].points[0].accelerations) == 4
    assert first['/wrench'].header.frame_id == 'r_arm_ft_sensor'
    told = json.loads(truth.read_text())
    assert [(effect['kind'], effect['where']) for effect in told['effects']] == [('payload', 'r_hand'),
                                                                                 ('time_delay', None)]
    assert [effect['size'] for effect in told['effects']] == [pytest.approx(1.0), pytest.approx(0.5)]
    assert told['effects'][0]['parameters']['mass']['unit'] == 'kg'
    assert told['samples'] == 400


def test_efforts_travel_in_the_joint_states(tmp_path):
    bag = tmp_path / 'out.mcap'
    assert main(['simulate', str(bag), '--samples', '50', '--outputs', 'effort', '--no-accelerations']) == 0
    assert set(open_bag(bag).topics) == {'/robot_description', '/joint_states'}
    last = list(open_bag(bag).messages(['/joint_states']))[-1].data
    assert len(last.effort) == 4


def test_a_sliding_joint_moves_when_it_is_named_as_the_help_says():
    scenario = Scenario(outputs='effort', urdf=ODD_ARM)
    assert 'lift' not in arm_of(scenario).joints
    assert 'lift' in arm_of(replace(scenario, joints=ODD_JOINTS)).joints
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    assert 'default: all that turn' in ' '.join(parser.format_help().split())


def test_joints_that_no_joint_state_follows_are_named(tmp_path, capsys):
    arm = tmp_path / 'arm.urdf'
    arm.write_text(ODD_ARM.replace('<robot name="odd">', '<robot name="odd"><link name="cart"/><joint name="wheels" '
                                   'type="planar"><parent link="cart"/><child link="base"/></joint>'))
    assert main(['simulate', str(tmp_path / 'out.mcap'), '--urdf', str(arm), '--outputs', 'effort', '--samples', '100',
                 '--joints', *ODD_JOINTS]) == 0
    assert 'Held at zero, as no joint state follows what is floating or planar: wheels.' in capsys.readouterr().out


def test_parameters_of_the_bundled_arm(repository):
    settings = load_params(repository / 'config' / 'icub_right_arm.yaml')
    assert settings.sensor_frame == 'r_arm_ft_sensor'
    assert settings.wrench_convention == 'reaction'


def test_a_parameter_file_names_the_robot(repository, tmp_path):
    params = tmp_path / 'p.yaml'
    params.write_text('/**:\n  ros__parameters:\n    joints: [r_shoulder_roll, r_elbow]\n    outputs: effort\n'
                      f'    robot_description_file: {repository / "config" / "icub_right_arm.urdf"}\n')
    bag = tmp_path / 'out.mcap'
    assert main(['simulate', str(bag), '--samples', '50', '--motion', 'fourier', '--params', str(params)]) == 0
    state = next(iter(open_bag(bag).messages(['/joint_states']))).data
    assert list(state.name) == ['r_shoulder_roll', 'r_elbow']


@pytest.mark.parametrize(('values', 'moving'), [
    ({'outputs': 'effort', 'locked_joints_names': ('r_elbow',), 'locked_joints_positions': (1.4,)}, ICUB_JOINTS[:3]),
    ({'outputs': 'wrench', 'sensor_frame': 'r_upper_arm'}, ICUB_JOINTS)], ids=['locked', 'frame'])
def test_the_recording_is_read_with_the_parameter_file_that_it_was_simulated_with(values, moving, repository, tmp_path):
    """Where that names no joints: "joints names one joint twice"; and the wrench had the name of the link's joint, and
    every command refused the recording with the same parameters."""
    settings = Settings(robot_description_file=str(repository / 'config' / 'icub_right_arm.urdf'), **values)
    dump_params(settings, tmp_path / 'p.yaml')
    bag = tmp_path / 'out.mcap'
    assert main(['simulate', str(bag), '--samples', '20', '--params', str(tmp_path / 'p.yaml')]) == 0
    found = load_samples(bag, settings)
    assert (found.joints, len(found.samples)) == (moving, 20)


@pytest.mark.parametrize('described', ['file', 'text'])
def test_the_robot_of_a_parameter_file_has_its_locked_joints_and_its_description(described, repository, tmp_path):
    """Another arm was simulated than the file's: the elbow at zero, or the package's own."""
    urdf = repository / 'config' / 'icub_right_arm.urdf'
    elbow = 'r_elbow' if described == 'file' else 'my_elbow'
    settings = Settings(outputs='effort', joints=ICUB_JOINTS[:3], locked_joints_names=(elbow,),
                        locked_joints_positions=(1.4,))
    settings = replace(settings, robot_description_file=str(urdf)) if described == 'file' else replace(
        settings, robot_description=urdf.read_text().replace('r_elbow"', 'my_elbow"'))
    dump_params(settings, tmp_path / 'p.yaml')
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    arm = arm_of(scenario_of(parser.parse_args(['--params', str(tmp_path / 'p.yaml')])))
    body = build_rigid_body(settings, None)
    motion = np.random.default_rng(0).standard_normal((3, 5, 3))
    samples = Samples(np.arange(5), *motion, np.zeros((5, 3)), 0)
    np.testing.assert_allclose(arm.evaluate(*motion), body.outputs_of(samples, body.base_parameters), atol=1e-9)


@pytest.mark.parametrize(('arguments', 'words'), [
    ([], 'name of the recording to write is missing'),
    (['OUT.mcap', '--effect', 'payloa'], "no effect 'payloa'"),
    (['OUT.mcap', '--size', '1'], '--size needs an effect'),
    (['OUT.mcap', '--effect', 'payload', '--effect', 'time_delay', '--size', '1', '--size', '2', '--size', '3'],
     '--size is given 3 times for 2 effects'),
    (['OUT.mcap', '--seconds', '-3'], '--seconds -3.0'),
    (['OUT.mcap', '--outputs', 'effort', '--convention', 'action'], 'those of a wrench; expected neither'),
    (['OUT.mcap', '--outputs', 'effort', '--sensor-frame', 'ft'], 'those of a wrench; expected neither'),
    (['OUT.mcap', '--effect', 'payload', '--end', 'inf', '--truth', 't.json'], 'end inf s of effect'),
    (['OUT.mcap', '--urdf', 'no.urdf'], 'no.urdf cannot be read'),
    (['NOWHERE/out.mcap', '--samples', '20'], 'NOWHERE'),
])
def test_bad_arguments_are_one_sentence(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert words in refusal(capsys, 'simulate', *arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(('old', 'new', 'words'), [
    ('mass value="', 'mass value="-', 'negative mass'), ('"r_hand"', '"universe"', 'a name that is taken')])
def test_what_other_commands_refuse_makes_no_recording(tmp_path, repository, capsys, old, new, words):
    urdf = tmp_path / 'a.urdf'
    urdf.write_text((repository / 'config' / 'icub_right_arm.urdf').read_text().replace(old, new))
    assert words in refusal(capsys, 'simulate', tmp_path / 'a.mcap', '--urdf', urdf, '--samples', 20)
    assert list(tmp_path.iterdir()) == [urdf]


def test_kinds_are_listed(capsys):
    assert main(['simulate', '--effect', 'list', '--outputs', 'effort']) == 0
    listed = capsys.readouterr().out
    assert 'stribeck_friction' in listed
    assert 'drifting_friction (of no listed kind)' in listed
