"""A robot that stands, before it first moves or in an emergency stop, or is disconnected. Nothing is learnt of it."""

import pickle
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.tools import Tools
from semiparam_ros.settings.build import build_rigid_body
from support.declared_effects import panda, ur3
from support.learner_stage import Stage
from support.node_helpers import PERIOD_NS, SETTINGS, InlineBackground, motion

REST_S = 20.0


@pytest.mark.parametrize(('recorded', 'count'), [pytest.param(panda, 1100, marks=pytest.mark.long, id='Franka'),
                                                 pytest.param(lambda: ur3('id1'), 900, id='UR3')])
def test_twenty_seconds_of_rest_before_a_measured_motion_change_nothing(recorded, count, shared_data):
    """The first moving sample held, with its noise. The error is that of the later moving samples, for two draws of
    features."""
    recording = recorded()
    samples = list(recording.samples)
    first = next(index for index, sample in enumerate(samples) if np.abs(sample.velocity).max() > 0.05)
    samples = samples[first:first + count]
    held, period, rng = samples[0], samples[1].stamp - samples[0].stamp, np.random.default_rng(1)
    noise = {name: np.std(np.diff([getattr(sample, name) for sample in samples], axis=0, n=2), axis=0) / np.sqrt(6)
             for name in ('velocity', 'acceleration', 'outputs')}
    rest = [held._replace(stamp=held.stamp + (index - steps) * period,
                          position=held.position + 1e-4 * rng.uniform(-1.0, 1.0, len(held.position)),
                          velocity=noise['velocity'] * rng.standard_normal(len(held.velocity)),
                          acceleration=noise['acceleration'] * rng.standard_normal(len(held.velocity)),
                          outputs=held.outputs + noise['outputs'] * rng.standard_normal(len(held.outputs)))
            for steps in [round(REST_S * 1e9 / period)] for index in range(steps)]
    errors = dict.fromkeys(('with', 'without'), 0.0)
    for seed, (name, before) in product(range(2), (('with', rest), ('without', []))):
        model = Estimator(recording.body, ModelOptions(features_count=40, features_seed=seed, initial_samples=300))
        steps = [model.step(sample) for sample in [*before, *samples]][-count // 3:]
        errors[name] += np.mean([((step.sample.outputs - step.mean) / np.std(
            [sample.outputs for sample in samples], axis=0)) ** 2 for step in steps]) / 2
    assert errors['with'] < 1.1 * errors['without'] < 0.2, errors


EFFORTS = replace(SETTINGS, outputs='effort', sensor_frame='', features_count=20)
BODY = build_rigid_body(EFFORTS)
STOP_NS = 12 * 10**9


@pytest.mark.parametrize(('forgetting', 'gate'), [('auto', False), ('auto', True), (1.0, False), (0.998, False)])
def test_a_stop_teaches_nothing_and_no_error_bursts_after_it(forgetting, gate):
    """Brakes hold the arm, and efforts mean nothing: zero, with or without noise, or the last one. Or it is gone."""
    samples = motion(300, body=BODY)
    before, after = samples[:180], samples[180:]
    stage = Stage(replace(EFFORTS, forgetting=forgetting, gate_enabled=gate), InlineBackground(), BODY)
    stage.offer(before)
    state, learnt = pickle.dumps(stage.learner.state()), stage.learner.learnt
    stage.offer(after)
    wanted = residuals(stage, len(after))
    held, zeros = before[-1], np.zeros(BODY.n_joints)
    noise = 0.01 * np.std([sample.outputs for sample in before], axis=0)
    rng = np.random.default_rng(2)
    later = [sample._replace(stamp=sample.stamp + STOP_NS) for sample in after]
    for outputs, jitter in ((zeros, 0.0), (zeros, noise), (held.outputs, 0.0), (None, 0.0)):
        standing = [] if outputs is None else [
            held._replace(stamp=held.stamp + (index + 1) * PERIOD_NS, velocity=zeros, acceleration=zeros,
                          outputs=outputs + jitter * rng.standard_normal(len(zeros)))
            for index in range(STOP_NS // PERIOD_NS)]
        stage.learner.restore(pickle.loads(state))
        stage.learner.learnt = learnt
        stage.offer(standing)
        assert stage.learner.learnt == learnt, 'nothing is learnt of what carries no information'
        stage.offer(later)
        found = residuals(stage, len(after))
        for start in range(0, len(after), 20):
            rows = slice(start, start + 20)
            assert np.sqrt(np.mean(found[rows] ** 2)) < 1.5 * np.sqrt(np.mean(wanted[rows] ** 2)), (outputs, start)


@pytest.mark.parametrize('noise', [0.0, 1e-3])
def test_motors_that_are_off_are_known_whatever_tool_is_declared(noise):
    """What a tool adds is taken off: of no efforts at all that leaves some."""
    tool = 'ft {"mass": 0.3, "centre": [0, 0.02, 0.1], "inertia": [3e-3, 0, 0, 3e-3, 0, 1e-3]}'
    stage, tools = Stage(replace(EFFORTS, variant='P', tools=(tool,)), InlineBackground(), BODY), Tools(BODY, [tool])
    samples = [sample._replace(outputs=sample.outputs + tools.outputs(*sample[1:4]))
               for sample in motion(200, body=BODY)]
    stage.offer(samples)
    held, rng = samples[-1]._replace(velocity=np.zeros(2), acceleration=np.zeros(2)), np.random.default_rng(0)
    stage.offer([held._replace(stamp=held.stamp + number * PERIOD_NS, outputs=noise * rng.standard_normal(2),
                               position=held.position + 1e-4 * rng.standard_normal(2)) for number in range(1, 20)])
    assert all(answer.prediction.off and not answer.learnt for answer in stage.answers[201:])


def residuals(stage, count):
    return np.array([answer.residual for answer in stage.answers[-count:]])
