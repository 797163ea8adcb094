"""A node says that its robot picked something up, what, and since when."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray

from semiparam_ros.core.robot.frames import load_regressor
from semiparam_ros.core.samples import Samples
from semiparam_ros.settings import dump_params
from support.node_client import Client, NodeProcess
from support.node_helpers import BODY, JOINTS, SETTINGS, motion

MASS, CENTRE = 0.4, np.array([0.02, 0.0, 0.05])
LOADED = 1100
pytestmark = pytest.mark.usefixtures('module_domain')


def carrying(count, until, since=LOADED):
    """A motion with a load in the hand from sample number ``since`` on, and not from ``until`` on."""
    samples = Samples.from_list(motion(count))
    inertia = MASS * (CENTRE @ CENTRE * np.eye(3) - np.outer(CENTRE, CENTRE)) + 1e-3 * np.eye(3)
    parameters = np.array(
        [
            MASS,
            *(MASS * CENTRE),
            inertia[0, 0],
            inertia[0, 1],
            inertia[1, 1],
            inertia[0, 2],
            inertia[1, 2],
            inertia[2, 2],
        ]
    )
    on = (np.arange(count) >= since) & (np.arange(count) < until)
    load = load_regressor(BODY, samples, 'ft') @ parameters * on[:, None]
    return [
        sample._replace(outputs=sample.outputs + own)
        for sample, own in zip(samples, load, strict=True)
    ]


def test_a_diagnosis_of_a_load_that_was_put_down_meanwhile_is_not_applied(tmp_path):
    settings = replace(
        SETTINGS,
        variant='P',
        acceleration_source='measured',
        diagnosis_auto='off',
        state_folder=str(tmp_path / 'states'),
    )
    dump_params(settings, tmp_path / 'p.yaml')
    samples, off = carrying(900, 600, 300), 600
    with NodeProcess(tmp_path, tmp_path / 'p.yaml'), Client() as client:
        client.connect()
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        client.play_at_a_pace(samples[:off], JOINTS)
        found = client.trigger('diagnose')
        assert found.success and 'payload at ft' in found.message, found.message
        client.play_at_a_pace(samples[off:], JOINTS)
        refused = client.trigger('apply_diagnosis')
        assert not refused.success
        assert re.match(
            r'what came since the diagnosis is better predicted without the effects that it '
            r'found, by '
            r'\d+ nat: the robot has changed, or they held for the motion before alone; '
            r'~/diagnose looks again\.',
            refused.message,
        ), refused.message


def test_a_load_is_told_applied_and_taken_back_and_nobody_touches_anything(tmp_path):
    """On a topic, in the status and in a file."""
    settings = replace(
        SETTINGS,
        variant='P',
        acceleration_source='measured',
        diagnosis_auto='apply',
        state_folder=str(tmp_path / 'states'),
    )
    dump_params(settings, tmp_path / 'p.yaml')
    off = LOADED + 900
    samples = carrying(off + 500, off)
    with NodeProcess(tmp_path, tmp_path / 'p.yaml'), Client() as client:
        client.connect()
        client.listen(DiagnosticArray, 'change')
        client.offer('joint_states', 'joint_accelerations', 'wrench')

        def records():
            path = tmp_path / 'states' / 'changes.jsonl'
            lines = path.read_text().split('\n')[:-1] if path.exists() else []  # the last one may be half written
            return [json.loads(line) for line in lines]

        def decided(what):
            return [record for record in records() if [last['what'] for last in record['decisions'][-1:]] == [what]]

        # ten times as fast as the robot: it waits until there is a model, which then learns what is
        # usual before the load comes, and until the load has its name
        window, named = settings.initial_samples, LOADED + 450
        client.play_at_a_pace(samples[:window], JOINTS)
        client.take_over()
        client.play_at_a_pace(samples[window:named], JOINTS)
        client.wait(lambda: decided('tried beside the model'), 'the load to be tried')
        record = decided('tried beside the model')[-1]['named']
        client.wait(
            lambda: any('It was tried' in each.status[0].message for each in client.heard['change']),
            'the trial to be told',
        )
        assert record['effect']['kind'] == 'payload'
        assert abs(record['effect']['start_stamp_s'] - samples[LOADED].stamp * 1e-9) < 0.2
        *_, told = (
            message.status[0]
            for message in client.heard['change']
            if message.status[0].message.startswith('payload at ft since ')
        )
        values = {entry.key: entry.value for entry in told.values}
        mass, std = (float(number) for number in values['mass [kg]'].split(' +- '))
        assert abs(mass - MASS) < max(3.0 * std, 0.05 * MASS)
        assert values['state'].startswith('changed')
        client.wait_report('changes', lambda level, message, values: message == told.message)
        exported = client.trigger('export_model')
        assert exported.success and re.search(r', with a load of 0\.\d+ kg at ft\.$', exported.message)
        client.play_at_a_pace(samples[named:], JOINTS)
        client.wait(lambda: decided('taken back'), 'the load to be taken back')
        assumed, tried, applied, over = records()[-1]['decisions']
        assert assumed['what'] == 'taken off until it is named'
        assert (tried['what'], applied['what']) == ('tried beside the model', 'applied')
        assert over['evidence'] > 12.0
        assert over['error_share'] < 0.7
        assert abs(over['stamp_s'] - samples[off].stamp * 1e-9) < 10.0
        states = [
            {entry.key: entry.value for entry in message.status[0].values}['state']
            for message in client.heard['change']
        ]
        assert 'changed, and allowed for' in states
        told = zip(client.stamps('residual'), client.values('residual'), strict=True)
        residual = dict(told)
        sizes = [np.linalg.norm(residual[sample.stamp][:3]) for sample in samples[LOADED - 200 :]]
        floor, loaded = np.mean(sizes[:200]), np.mean(sizes[1000:1100])
        assert loaded < 1.5 * floor, 'the last hundred samples with the load'
