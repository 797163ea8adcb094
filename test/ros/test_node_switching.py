"""Variants one after the other while a bag plays at ten times real time: one of each kind, all in the long form.

`pytest -s --long test/ros/test_node_switching.py` prints how long the node took to answer each switch, and to
have the model.
"""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from std_srvs.srv import Trigger

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.core.variants import AVERAGED, CHOICES
from semiparam_ros.ros.estimator.subscriptions import ACCELERATIONS, JOINT_STATES, WRENCH
from semiparam_ros.settings import dump_params, load_params
from semiparam_ros.settings.build import build_estimator
from support.node_client import Client, NodeProcess
from support.node_helpers import write_bag
from support.replay_peers import Tool

COMPARED, SLOW_MACHINE_S = 20, 4.0
ORDER = [*(variant for variant in CHOICES if variant != 'SPK-ML'), 'SPK-ML']
FEW = ['P', 'SP2-VS', AVERAGED, 'SPK-ML']


def in_turn(*recordings):
    """Their samples as one motion at 20 Hz, one recording after the other."""
    samples, start = [], 0
    for recording in recordings:
        shift = start - recording.samples.stamps[0]
        samples += [sample._replace(stamp=int(sample.stamp + shift)) for sample in recording.samples]
        start = samples[-1].stamp + 50_000_000
    return samples


def wait_for_model(client, variant):
    """How many samples were answered when the model was there.

    The bag plays meanwhile; on a machine so slow that it would end before the last switch it waits.
    """
    late = time.monotonic() + SLOW_MACHINE_S

    def answers(level, message, values):
        return message == f'learning with {variant}.'

    report = client.wait_report('learning', lambda *said: answers(*said) or time.monotonic() > late)
    if not answers(*report):
        assert client.call(Trigger, '/bag_replay/pause', Trigger.Request()).success
        report = client.wait_report('learning', answers)
        assert client.call(Trigger, '/bag_replay/resume', Trigger.Request()).success
    return int(report[2]['samples answered'])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_variants_and_back_while_a_bag_plays_at_ten_times_real_time(tmp_path, ros_domain, repository, long):
    """No sample lost, no prediction missing, each model as if it had been there from the start."""
    settings = replace(load_params(repository / 'config/icub_right_arm.yaml'), features_count=40, initial_samples=100)
    dump_params(settings, tmp_path / 'p.yaml')
    circles = load_samples(repository / 'bags/icub_xy.mcap', settings)
    # Longer than a busy machine needs, and all in one plane: in another one hyperparameters are estimated again.
    samples = in_turn(*[circles] * (4 if long else 1))
    bag = write_bag(tmp_path / 'circles.mcap', samples, settings.joints, circles.robot_description,
                    settings.sensor_frame)
    # The ten messages that a recorder's profile keeps are lost where the node does not run for a twentieth of a second.
    kept = ''.join(f'/{topic}: {{history: keep_all}}\n' for topic in (JOINT_STATES, WRENCH, ACCELERATIONS))
    (tmp_path / 'kept.yaml').write_text(kept)
    switched = []
    with NodeProcess(tmp_path, tmp_path / 'p.yaml'), Client() as client:
        client.connect()  # before the first sample
        with Tool(tmp_path, 'replay', bag, '--rate', 10, '--wait-for-subscribers', '--quiet', '--json',
                  tmp_path / 'played.json', '--qos-profile-overrides-path', tmp_path / 'kept.yaml') as player:
            client.wait(lambda: len(client.heard['residual']) > settings.initial_samples + 50, 'the first model')
            for variant in ORDER if long else FEW:
                start = time.monotonic()
                answer, = client.set(variant=variant)
                replied = time.monotonic() - start
                assert answer.successful
                since = wait_for_model(client, variant)
                took = time.monotonic() - start
                print(f'{variant}: answered after {1e3 * replied:.0f} ms, takes over within {took:.1f} s')
                switched.append((variant, since))
                client.wait(lambda: len(client.heard['residual']) > switched[-1][1] + COMPARED, 'more data')
                assert player.process.poll() is None, 'the bag ended before the last switch'
            assert client.call(Trigger, '/bag_replay/pause', Trigger.Request()).success
            client.wait_report('inputs', lambda level, message, values: message.startswith('nothing received'))
            player.interrupt()
            assert player.wait() == 0, player.output
            played = json.loads((tmp_path / 'played.json').read_text())['published']['/wrench']
            client.wait(lambda: len(client.heard['residual']) >= played, 'the last answers')
            found, stamps = np.array(client.values('predicted_wrench')), client.stamps('residual')
    assert len(stamps) == played and stamps == [sample.stamp for sample in samples[:len(stamps)]]
    for variant, since in switched:
        estimator = build_estimator(replace(settings, variant=variant), circles.robot_description)
        wanted = [estimator.step(sample).mean for sample in samples[:since + COMPARED]]
        np.testing.assert_allclose(found[since:since + COMPARED], wanted[since:], rtol=0, atol=1e-6)
