"""Checkpoints of real processes: one that is killed, and a node that goes on from its own."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.settings import dump_params
from support import checkpoint_kills, node_restarts
from support.node_client import Client, NodeProcess
from support.node_helpers import SETTINGS, InlineBackground, motion


@pytest.mark.slow
def test_a_learner_killed_at_any_moment_leaves_a_good_checkpoint(tmp_path, long):
    features, period, kills = (500, 0.5, 100) if long else (100, 0.1, 2)
    assert checkpoint_kills.kill(checkpoint_kills.Options(tmp_path, features, period), kills)


def test_a_node_goes_on_from_its_checkpoint(tmp_path, ros_domain):
    settings = replace(SETTINGS, acceleration_source='measured', state_folder=str(tmp_path / 'states'),
                       checkpoint_period=0.2, checkpoint_resume=True)
    dump_params(settings, tmp_path / 'p.yaml', node='/**')
    samples, means = motion(300), []
    path = tmp_path / 'states' / 'left.estimator.checkpoint.npz'
    for first, part in ((True, samples[:150]), (False, samples[150:])):
        with (NodeProcess(tmp_path, tmp_path / 'p.yaml', '-r', '__ns:=/left') as node,
              Client(namespace='/left') as client):
            client.offer('joint_states', 'joint_accelerations', 'wrench')
            client.connect()
            if first:
                part = client.play_window(part, SETTINGS.joints, SETTINGS.initial_samples)
            client.play(part, SETTINGS.joints)
            means += client.values('predicted_wrench')
            client.wait(path.exists, 'a checkpoint')
            assert 'Traceback' not in node.output
            if first:
                assert 'there is no checkpoint to go on from' in node.output
            else:
                assert 'the checkpoint is loaded: SPK-ML with 150 samples' in node.output
            assert node.stop() == 0
    whole = checkpoint_kills.Stage(settings, InlineBackground())
    whole.offer(samples)
    np.testing.assert_array_equal(means, whole.means)


def test_a_folder_that_cannot_be_written_is_told_once_and_the_node_goes_on(tmp_path, ros_domain):
    (tmp_path / 'states').write_text('no folder')
    dump_params(replace(SETTINGS, acceleration_source='measured', state_folder=str(tmp_path / 'states'),
                        checkpoint_period=0.1, checkpoint_resume=True), tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        client.connect()
        client.play(motion(150), SETTINGS.joints)
        client.wait_report('inputs', lambda level, message, values: values.get('refused: checkpoints') == '1')
        client.wait_report('checkpoints', lambda level, message, _: level == b'\2' and 'there is no folder' in message)
        reply = client.trigger('save_state')
        assert not reply.success and 'there is no folder' in reply.message and reply.message.endswith('.')
        assert client.trigger('load_state').success is False
        client.play([sample._replace(stamp=sample.stamp + 10**11) for sample in motion(50)], SETTINGS.joints)
        assert node.stop() == 0
        assert 'Traceback' not in node.output


def test_a_second_node_of_the_same_name_says_so_and_does_not_write(tmp_path, ros_domain):
    states = tmp_path / 'states'
    dump_params(replace(SETTINGS, acceleration_source='measured', state_folder=str(states),
                        checkpoint_period=0.2, checkpoint_resume=True), tmp_path / 'p.yaml')
    (tmp_path / 'second').mkdir()
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as first, Client() as client:
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        client.connect()
        client.play(motion(50), SETTINGS.joints)
        path = states / 'estimator.checkpoint.npz'
        client.wait(path.exists, 'a checkpoint')
        client.wait_report('checkpoints', lambda level, message, values: 'was written' in message)
        with NodeProcess(tmp_path / 'second', tmp_path / 'p.yaml') as second:
            client.wait_report('checkpoints', lambda level, message, _: level == b'\2' and 'not written' in message)
            client.wait_report('errors', lambda level, message, _: level == b'\2' and 'another node' in message)
            assert f'process {first.process.pid}, another node of the name /estimator' in second.output
            assert 'is loaded' not in second.output
            client.wait(lambda: '2 publish on /estimator/answer' in first.output, 'the first one says so too')
            assert second.stop() == 0
        assert first.stop() == 0
        assert first.process.pid == int((states / 'estimator.lock').read_text())
        assert not any('aside' in found.name for found in states.iterdir())


@pytest.mark.slow
def test_restarts_with_random_configurations_lose_no_state_of_another(tmp_path, ros_domain, long):
    restarts = node_restarts.Restarts(tmp_path, 1)
    restarts.number = 3  # the fifth has another node of its name beside it
    for _ in range(100 if long else 2):
        restarts.start()
    assert restarts.tell() and restarts.done['another node of the same name beside it'] >= 1
