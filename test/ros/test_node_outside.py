"""What acts from outside, live over real DDS: the same bits as offline, tools at run time, the link that is touched."""

import json
from dataclasses import replace

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

from semiparam_ros.core.robot.external_wrench import ExternalWrench
from semiparam_ros.core.robot.frames import force_maps
from semiparam_ros.core.robot.size import push_force
from semiparam_ros.core.robot.tools import Tools
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.settings.build import build_rigid_body
from support.node_helpers import BODY, JOINTS, PERIOD_NS, SETTINGS, motion

LIVE = replace(SETTINGS, acceleration_source='measured', variant='P', gate_enabled=True)
TOOL = 'ft ' + json.dumps({'mass': 0.8, 'centre': [0.0, 0.02, 0.1]})
PUSH_N = 15.0


def pushed(samples, body=BODY):
    """With a push along the base's x axis at the hand."""
    maps = [force_maps(body, sample.position)[-1] for sample in samples]
    return [sample._replace(outputs=sample.outputs + PUSH_N * each[:, 0])
            for sample, each in zip(samples, maps, strict=True)]


def later(samples, seconds):
    return [sample._replace(stamp=sample.stamp + round(seconds * 1e9)) for sample in samples]


def start(start_node, settings, *topics):
    _, client = start_node(settings)
    client.listen(WrenchStamped, 'external_wrench', 'external_wrench_std', *topics)
    client.listen(JointState, 'contact_place')
    return client


def test_live_as_offline_a_push_has_its_force_and_its_link_and_a_tool_comes_without_a_jump(start_node):
    client = start(start_node, LIVE, 'compensated_wrench')
    client.offer('joint_states', 'joint_accelerations', 'wrench')
    samples = motion(700)
    samples[300:330] = pushed(samples[300:330])
    client.play(client.play_window(samples[:400], JOINTS, 60), JOINTS)
    takeovers = client.take_over()

    learner, external, found = OfflineLearner(LIVE, [], lambda: None, takeovers), ExternalWrench(BODY), []
    learner.on_answer = lambda answer, widening: found.append(
        external.of(answer.prediction, answer.residual, widening, answer.followed))
    for sample in samples[:400]:
        learner.step(sample, True)
    client.wait(lambda: len(client.heard['contact_place']) >= 400, 'the last place')
    np.testing.assert_array_equal(client.values('external_wrench'), [each.wrench for each in found])
    np.testing.assert_array_equal(client.values('external_wrench_std'), [each.std for each in found])
    assert client.stamps('external_wrench') == [sample.stamp for sample in samples[:400]]
    assert {message.header.frame_id for message in client.heard['external_wrench']} == {'ft'}
    force = np.linalg.norm(np.array(client.values('external_wrench'))[:, :3], axis=1)
    std = np.array(client.values('external_wrench_std'))
    assert std[320] == pytest.approx(std[295], rel=0.2), 'a push does not widen what is told of it'
    assert force[310:330] == pytest.approx(PUSH_N, abs=1.0) and force[200:300].max() < 3.0
    places = client.heard['contact_place']
    assert places[320].header.frame_id == 'ft' and list(places[320].name) == ['ft', 'since']
    assert list(places[320].position) == pytest.approx([1.0, 20 * PERIOD_NS * 1e-9])
    assert places[200].header.frame_id == '' and not any(places[200].position)

    tools = Tools(BODY, [TOOL])
    carried = [sample._replace(outputs=sample.outputs + tools.outputs(*sample[1:4])) for sample in samples[400:]]
    client.forget()
    client.play(carried[:100], JOINTS)
    refused = client.set(tools=['hand {"mass": 1.0}'])[0]
    assert not refused.successful and "link 'hand' is not a link" in refused.reason
    refused = client.set(tools=['ft {"mass": -1.0}'])[0]
    assert not refused.successful and 'expected those of a body' in refused.reason
    assert client.set(tools=[TOOL])[0].successful
    client.play(carried[100:], JOINTS)
    client.wait(lambda: len(client.heard['compensated_wrench']) >= 300, 'the last of them')
    compensated = np.array(client.values('compensated_wrench'))
    size = np.linalg.norm(compensated[:, :3], axis=1)
    assert size[50:100].mean() > 5.0 > 5.0 * size[-30:].mean()
    assert np.abs(np.diff(compensated, axis=0))[95:].max() < 0.8, 'the tool comes with a jump'
    assert np.linalg.norm(np.array(client.values('external_wrench'))[101:, :3], axis=1).mean() < 1.0


def test_of_efforts_at_a_frame_of_ones_own_with_what_is_not_felt_told_and_after_a_reset(start_node):
    """Two joints feel a push along x; that along the others' directions keeps the deviation that it had before."""
    settings = replace(LIVE, outputs='effort', sensor_frame='')
    client = start(start_node, settings)
    client.offer('joint_states', 'joint_accelerations')
    body = build_rigid_body(settings)
    samples = motion(260, body=body)
    samples[230:] = pushed(samples[230:], body)

    def play(chosen):
        count = len(client.heard['external_wrench'])
        for sample in chosen:
            client.accelerations(sample, JOINTS)
            client.state(sample, JOINTS, effort=sample.outputs.tolist())
        client.wait(lambda: len(client.heard['external_wrench']) >= count + len(chosen), 'every sample is answered')

    play(samples[:60])
    client.take_over()
    assert client.set(external_wrench__frame='upper')[0].successful
    play(samples[60:100])
    refused = client.set(external_wrench__frame='elbow')[0]
    assert not refused.successful and "link 'elbow' is not a link" in refused.reason
    assert client.set(external_wrench__frame='')[0].successful
    play(samples[100:])
    frames = [message.header.frame_id for message in client.heard['external_wrench']]
    assert frames == ['ft'] * 60 + ['upper'] * 40 + ['ft'] * 160
    std = np.array(client.values('external_wrench_std'))
    assert std[-1].max() > 0.5 * push_force(BODY) > 10 * std[-1, 3:].min()
    wrench = np.array(client.values('external_wrench'))
    assert np.linalg.norm(wrench[235:260], axis=1).min() > 3 * np.linalg.norm(wrench[200:230], axis=1).mean()
    _, _, values = client.wait_report('learning', lambda level, message, values: values['in contact'] == 'True')
    assert values['contact at'].startswith(('ft (', 'upper (')) and ' at ft' in values['external wrench not felt in']
    assert client.trigger('reset').success
    play(later(samples[:30], 100.0))
    assert np.isfinite(client.values('external_wrench')).all()
    assert not any(client.heard['contact_place'][-1].position)
