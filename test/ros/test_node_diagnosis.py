"""The loop closed live: the node says what its model lacks, adds it, and the horizon error falls."""

import json
import os
import re
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest
from std_msgs.msg import String
from std_srvs.srv import Trigger

from semiparam_ros.settings import dump_params
from semiparam_ros.settings.build import build_rigid_body
from support.node_client import Client, NodeProcess, children_of
from support.node_helpers import JOINTS, SETTINGS, motion

LIVE = replace(SETTINGS, outputs='effort', sensor_frame='', variant='P', acceleration_source='measured',
               diagnosis_window=1000.0, joint_friction=False)
FRICTION = np.array([0.8, 0.5])
pytestmark = pytest.mark.usefixtures('module_domain')


def rubbing(count):
    """An arm as described but for the viscous friction of its joints."""
    body, rng = build_rigid_body(LIVE), np.random.default_rng(0)
    return [sample._replace(outputs=body.regressor(*sample[1:4]) @ body.base_parameters + FRICTION * sample.velocity
                            + 0.02 * rng.standard_normal(2)) for sample in motion(count, body=body)]


def signal_children(node, number):
    """To the processes beside the node: one that has been stopped is not done before it may go on."""
    for child in children_of(node.process.pid):
        os.kill(child, number)


def test_friction_is_found_named_added_and_the_horizon_error_falls(tmp_path):
    dump_params(LIVE, tmp_path / 'p.yaml')
    samples = rubbing(800)
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.connect('effort')
        client.listen(String, 'diagnosis')
        client.listen(String, 'diagnosis_progress')
        client.offer('joint_states', 'joint_accelerations')
        assert client.trigger('diagnose').message == 'there are no samples to diagnose yet.'
        assert 'no diagnosis yet' in client.trigger('apply_diagnosis').message
        assert 'holds no model yet' in client.trigger('export_model').message
        client.play_at_a_pace(samples[:100], JOINTS, efforts=True)
        assert 'needs at least' in client.trigger('diagnose').message
        client.play_at_a_pace(samples[100:450], JOINTS, efforts=True)
        player = threading.Thread(target=client.play_at_a_pace, args=(samples[450:550], JOINTS, True))
        player.start()
        signal_children(node, signal.SIGSTOP)
        running = client.begin(Trigger, 'diagnose', Trigger.Request())
        client.wait_report('diagnosis', lambda level, message, values: values['running'] == 'True')
        refused = client.trigger('apply_diagnosis')
        assert not refused.success and 'a diagnosis is running' in refused.message
        signal_children(node, signal.SIGCONT)
        player.join()
        client.wait(running.done, 'the diagnosis')
        answer = running.result()
        assert answer.success, answer.message
        assert answer.message.startswith('With no effects declared: ')
        lines = answer.message.splitlines()
        details = lines.index('Details:')
        assert lines[0] == 'With no effects declared: The model lacks 2 effects.' and details == 3
        for line, joint in zip(sorted(lines[1:details]), JOINTS, strict=True):
            assert re.fullmatch(rf'- viscous_friction at {joint}: \w+ 0\.\d+ \+- 0\.\d+ .*', line), line
        assert any(line.startswith('On held-out data') for line in lines[details:])
        progress = [message.data for message in client.heard['diagnosis_progress']]
        assert any(re.match(r'round 1: found .*viscous_friction at a', sentence) for sentence in progress), progress
        report = json.loads(client.heard['diagnosis'][0].data)
        assert report['schema'] == 1 and report['verdict'] == 'effect_found'
        assert re.match(r'(\d+) of \1 samples, evenly spread over \d+ s$', report['looked_at'])
        assert {effect['kind'] for effect in report['effects']} == {'viscous_friction'}
        before = np.mean([message.position[2] for message in client.heard['horizon_error'][-50:]])
        applied = client.trigger('apply_diagnosis')
        assert applied.success and 'effects are now' in applied.message, applied.message
        again = client.trigger('apply_diagnosis')
        assert again.success and 'are declared already' in again.message, again.message
        # Their model may still be being built: a diagnosis looks for what is missing beside them.
        beside = client.trigger('diagnose').message
        assert beside.startswith('With viscous_friction@'), beside
        assert 'nothing to add' in client.trigger('apply_diagnosis').message
        client.wait_report('learning', lambda level, message, values: message == 'learning with P.'
                           and 'viscous_friction@a' in values['effects'])
        client.play_at_a_pace(samples[550:], JOINTS, efforts=True)
        after = np.mean([message.position[2] for message in client.heard['horizon_error'][-50:]])
        assert after < 0.2 * before
        _, _, values = client.wait_report('parameters', lambda level, message, values: 'viscous_friction@a' in ''.join(
            values))
        found = next(value for name, value in values.items() if name.startswith('viscous_friction@a'))
        assert abs(float(found.split()[0]) - FRICTION[0]) < 0.05, found
        assert client.stamps('residual') == [sample.stamp for sample in samples]
        code = node.stop()
    assert code == 0 and 'internal error' not in node.output


def test_one_that_is_cancelled_leaves_no_result_and_what_was_changed_since_is_not_undone(tmp_path):
    dump_params(LIVE, tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.connect('effort')
        client.listen(String, 'diagnosis', 'diagnosis_progress')
        client.offer('joint_states', 'joint_accelerations')
        assert client.trigger('cancel_diagnosis').message == 'no diagnosis is running.'
        samples, told = rubbing(450), client.heard['diagnosis_progress']
        client.play_at_a_pace(samples[:100], JOINTS, efforts=True)
        client.trigger('diagnose')  # of too few samples; the process for it is there from then on
        client.play_at_a_pace(samples[100:], JOINTS, efforts=True)
        signal_children(node, signal.SIGSTOP)
        running = client.begin(Trigger, 'diagnose', Trigger.Request())
        _, message, values = client.wait_report('diagnosis', lambda level, message, values: values['running'] == 'True')
        assert re.search(r'; about \d+ s left\.$', message) and float(values['elapsed [s]']) >= 0.0
        cancelled = client.trigger('cancel_diagnosis')
        assert cancelled.success and cancelled.message == 'the diagnosis is cancelled; there is none.'
        client.wait(running.done, 'whoever waits for it is told')
        assert (running.result().success, running.result().message) == (False, 'the diagnosis was cancelled.')
        assert 'no diagnosis yet' in client.trigger('apply_diagnosis').message
        client.wait_report('diagnosis', lambda level, message, values: message == 'the last one was cancelled.')
        signal_children(node, signal.SIGCONT)
        answer = client.trigger('diagnose')
        assert answer.success and 'It looked at 450 of 450 samples, evenly spread over 9 s.' in answer.message
        client.wait(lambda: client.heard['diagnosis'], 'the report')
        assert len(client.heard['diagnosis']) == 1 and 'cancelled' in ' '.join(message.data for message in told)
        assert client.set(effects=['viscous_friction@b'])[0].successful
        late = client.trigger('apply_diagnosis')
        assert not late.success and late.message.startswith('the effects have changed since the last diagnosis')
        assert node.stop() == 0 and 'internal error' not in node.output
