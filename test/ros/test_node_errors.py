"""Faults in what the node's callbacks call: every call is answered, every fault counted, and the node goes on."""

import time
from dataclasses import replace
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus

from semiparam_ros.settings import dump_params
from support.faulty_node import UNLUCKY_STAMP_NS
from support.node_client import Client, NodeProcess
from support.node_helpers import JOINTS, PERIOD_NS, SETTINGS, START_NS, motion

FAULT = 'ZeroDivisionError: a fault put there by a test'


def test_an_error_in_any_callback_is_an_answer_and_a_count_and_never_the_end(tmp_path, ros_domain):
    dump_params(replace(SETTINGS, variant='P', acceleration_source='filter'), tmp_path / 'p.yaml')
    program = [str(Path(__file__).resolve().parents[1] / 'support/faulty_node.py')]
    samples = motion(120)
    assert (UNLUCKY_STAMP_NS - START_NS) % PERIOD_NS == 0
    with NodeProcess(tmp_path, tmp_path / 'p.yaml', program=program) as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'wrench')
        client.wait_report('inputs', lambda _, __, values: values['joint_states publishers'] != '0'
                           and values['wrench publishers'] != '0')  # the node sees them, too
        for sample in samples:
            client.state(sample, JOINTS)
            client.wrench(sample)
        client.wait(lambda: len(client.heard['residual']) == len(samples) - 1, 'all but one are published')
        for service in ('tare', 'diagnose'):
            answer = client.trigger(service)
            assert not answer.success and FAULT in answer.message, service
        for value in (0.9, 0.8):
            answer = client.set(forgetting=value)[0]
            assert not answer.successful and FAULT in answer.reason
            assert client.get('forgetting')[0].string_value == 'auto'
        for sample in samples[:8]:  # the clock goes back, which the learner is to hear of
            client.state(sample, JOINTS)
            client.wrench(sample)
        level, message, counts = client.wait_report('errors', lambda _, __, values: any(
            f'internal errors: {topic}' in values for topic in ('wrench', 'joint_states'))
            and 'internal errors: the status of timing' in values)  # each status is told once a second
        assert level == DiagnosticStatus.ERROR and FAULT in message
        assert counts['internal errors: ~/tare'] == counts['internal errors: ~/diagnose'] == '1'
        assert counts['internal errors: the parameters'] == '2' and counts['internal errors: publishing'] == '1'
        assert answers_on(client, samples)
        assert node.stop() == 0
    log = node.output
    kinds = ('tare', 'diagnose', 'parameters', 'publishing', 'jump of the clock', 'status of timing')
    assert log.count('Traceback (most recent call last)') == len(kinds), 'one for each kind, however often it happens'


def answers_on(client, samples):
    """Whether samples later than all before are answered still."""
    before = len(client.heard['residual'])
    for sample in samples:
        later = sample._replace(stamp=sample.stamp + 10**10)
        client.state(later, JOINTS)
        client.wrench(later)
        time.sleep(0.002)
    client.wait(lambda: len(client.heard['residual']) > before + 100, 'answers go on')
    return True

