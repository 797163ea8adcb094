"""A client that changes the model of a live node in every way that once ended it: each call gets an answer."""

from dataclasses import replace

import pytest
from diagnostic_msgs.msg import DiagnosticArray

from semiparam_ros.effects import kinds
from semiparam_ros.settings import dump_params
from support.node_client import Client, NodeProcess, Robot
from support.node_helpers import JOINTS, PERIOD_NS, SETTINGS, motion

LIVE = replace(SETTINGS, acceleration_source='measured', features_count=10, initial_samples=50,
               horizon_length=5)
BETWEEN = 10
"""Samples from one change to the next."""


def change(robot, **values):
    """Set parameters one by one, wait for the model they ask for, and go on."""
    results = robot.client.set(**values)
    for result in results:
        assert not result.reason or result.reason.endswith('.'), result.reason
        assert '\n' not in result.reason and 'internal' not in result.reason
    if any(result.successful for result in results):
        robot.client.wait_report('learning', lambda level, message, values: 'built' not in message)
    robot.move(BETWEEN)
    return results


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_an_outside_client_gets_an_answer_to_every_call_and_cannot_end_the_node(ros_domain, tmp_path, long):
    dump_params(replace(LIVE, state_folder=str(tmp_path)), tmp_path / 'p.yaml')
    later = (60 if long else 10) * 10**9 // PERIOD_NS
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        robot = Robot(client, motion(150 + later + 60 * BETWEEN), JOINTS)
        robot.move(150)
        for kind in kinds('wrench'):
            change(robot, effects=[kind])
        change(robot, effects=['periodic_disturbance'])
        (unknown,) = change(robot, effects=['no_such_kind'])
        assert not unknown.successful and 'names no known kind' in unknown.reason
        assert change(robot, effects=[], variant='P', forgetting=0.9)[2].successful
        robot.move(later)
        for name in ('reset', 'tare', 'save_state', 'load_state', 'apply_diagnosis', 'diagnose'):
            assert client.trigger(name).message.endswith('.')
        robot.move(BETWEEN)
        assert client.get('variant')[0].string_value == 'P'
        code = node.stop()
    assert code == 0
    assert 'Traceback' not in node.output and 'internal error' not in node.output, node.output


def test_a_node_starts_with_an_effect_that_leaves_its_values_out_or_says_why_not(ros_domain, tmp_path):
    dump_params(replace(LIVE, effects=('periodic_disturbance',)), tmp_path / 'p.yaml')
    with NodeProcess(tmp_path, tmp_path / 'p.yaml') as node, Client() as client:
        client.subscribe(DiagnosticArray, '/diagnostics')
        client.wait(lambda: node.process.poll() is not None or client.heard['/diagnostics'],
                    'a node that works, or its end')
        if node.process.poll() is None:
            client.connect()
            client.offer('joint_states', 'joint_accelerations', 'wrench')
            Robot(client, motion(150), JOINTS).move(150)
            node.stop()
    refused = node.process.returncode == 2 and node.output.strip().splitlines()[-1].startswith('semiparam: ')
    assert node.process.returncode == 0 or refused, node.output
    assert 'Traceback' not in node.output and 'internal error' not in node.output, node.output
