"""The wrench without its tool follows a tare, a known tool and another model without a jump; models never see tools."""

import json
from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.robot.tools import Tools, tool_from_text
from semiparam_ros.core.samples import Samples
from semiparam_ros.effects.loads import Payload
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online import state_file
from semiparam_ros.online.compensation import Compensation
from semiparam_ros.online.tare import Tare
from support.learner_stage import Stage
from support.node_helpers import BODY, SETTINGS, InlineBackground, motion

TOOL = 'ft ' + json.dumps({'mass': 0.8, 'centre': [0.0, 0.02, 0.1], 'inertia': [3e-3, 0, 0, 3e-3, 0, 1e-3]})
QUIET = 0.15
"""[N], [N m] From sample to sample: noise, the motion's own changes, and a twenty-fifth of a step of 2."""


class Compensated(Stage):
    """Compensates every answer while it is the newest."""

    def __init__(self, settings, time_constant=0.5):
        self.compensation, self.shown = Compensation(time_constant), []
        super().__init__(settings, InlineBackground())

    def answered(self, answer):
        super().answered(answer)
        self.shown.append(self.learner.compensated(answer, self.compensation))

    def steps_since(self, index):
        """(n,) largest change from a sample to the next."""
        return np.abs(np.diff(np.array(self.shown)[index:], axis=0)).max(axis=0)


def settled(variant='P', **options):
    """A model of the arm that no longer learns, after 200 samples; and 300 further ones."""
    stage, samples = Compensated(replace(SETTINGS, variant=variant), **options), motion(500)
    stage.offer(samples[:200])
    stage.learner.change(replace(stage.learner.settings, learning=False))
    return stage, samples[200:]


def biased(samples):
    return [sample._replace(outputs=sample.outputs + 2.0) for sample in samples]


@pytest.mark.parametrize('variant', ['P', 'SPK-ML', 'auto'])
def test_nothing_is_left_of_weight_and_inertia_and_a_tare_takes_the_bias_within_the_time_constant(variant):
    stage, samples = settled(variant)
    stage.offer(samples[:50])
    assert np.abs(np.mean(stage.shown[-50:], axis=0)).max() < 0.3
    stage.offer(biased(samples[50:150]))
    assert np.mean(stage.shown[-50:], axis=0) == pytest.approx(np.full(6, 2.0), abs=0.4)
    at = len(stage.shown)
    assert stage.learner.tare.take() > 10
    stage.offer(biased(samples[150:300]))
    assert stage.steps_since(at - 1).max() < QUIET
    assert np.abs(np.mean(stage.shown[-50:], axis=0)).max() < 0.4


@pytest.mark.parametrize('gated', [False, True])
def test_what_may_be_a_push_is_what_the_wandering_offset_took_without_a_gate(gated):
    """Neither the bias of a tare nor a tool."""
    settings = replace(SETTINGS, variant='P', gate_enabled=gated, diagnosis_auto='off')
    stage, samples = Stage(settings, InlineBackground()), motion(500)
    stage.offer(samples[:300])
    stage.learner.tare = Tare(6, np.full(6, 30.0))
    stage.learner.change(replace(settings, tools=(TOOL,)))
    tools = Tools(BODY, [TOOL])
    carried = [sample._replace(outputs=sample.outputs + tools.outputs(*sample[1:4]) + 30.0) for sample in samples[300:]]
    stage.offer(carried[:50])
    assert np.abs(stage.answers[-1].followed).max() < 1.0
    stage.offer(biased(carried[50:]))
    followed = np.mean([answer.followed for answer in stage.answers[-50:]], axis=0)
    assert (not followed.any()) if gated else np.abs(followed).max() > 0.5


def test_a_time_constant_of_zero_follows_at_once():
    stage, samples = settled(time_constant=0.0)
    stage.offer(biased(samples[:100]))
    stage.learner.tare.take()
    stage.offer(biased(samples[100:102]))
    assert stage.steps_since(299).max() > 1.5


def test_a_tare_after_a_tool_was_declared_takes_none_of_its_weight_for_a_bias():
    stage, samples = settled()
    tools = Tools(BODY, [TOOL])
    carried = [sample._replace(outputs=sample.outputs + tools.outputs(*sample[1:4])) for sample in samples]
    stage.offer(carried[:100])
    stage.learner.change(replace(stage.learner.settings, tools=(TOOL,)))
    stage.offer(carried[100:130])
    assert stage.learner.tare.take() == 30
    assert np.abs(stage.learner.tare.bias).max() < 0.5, 'eight newtons are the tool'


@pytest.mark.parametrize('by', ['a tool', 'a tare', 'a model'])
def test_a_tare_right_after_a_change_says_how_long_to_wait(by):
    """It took the noise of what had come since, of a single sample; or the initial window was said not to be over."""
    stage, samples = settled()
    stage.offer(samples[:100])
    if by == 'a tare':
        stage.learner.take_tare()
    else:
        tools = {'tools': (TOOL,)}
        stage.learner.change(replace(stage.learner.settings, **(tools if by == 'a tool' else {'variant': 'NP-ML'})))
    bias = stage.learner.tare.bias.copy()
    with pytest.raises(SemiparamError, match=r'second to tare by since a tool, the .*; wait for 0\.5 s of samples'):
        stage.learner.tare.take()
    stage.offer(samples[100:101])
    with pytest.raises(SemiparamError, match=r'^1 samples came since a tool, the model .* wait 0\.5 s more\.$'):
        stage.learner.tare.take()
    stage.offer(samples[101:125])
    with pytest.raises(SemiparamError, match=r'^25 samples came since .* wait 0\.02 s more\.$'):
        stage.learner.tare.take()
    np.testing.assert_array_equal(stage.learner.tare.bias, bias)
    stage.offer(samples[125:126])
    assert stage.learner.tare.take() == 26


@pytest.mark.parametrize('by', ['a model', 'a change'])
def test_a_tare_after_a_load_is_known_takes_none_of_its_weight_for_a_bias(by):
    """Most of the last second was predicted without: two newtons of the load were taken off once more."""
    stage, samples = settled()
    load = tool_from_text(TOOL).parameters
    carried = [sample._replace(outputs=sample.outputs + Tools(BODY, [TOOL]).outputs(*sample[1:4]))
               for sample in samples]
    stage.offer(carried[:100])
    if by == 'a model':
        start = (samples[0].stamp - 1000) * 1e-9
        effects = (f'payload@ft{{"start_stamp_s": {start!r}}}',)
        stage.learner.change(replace(stage.learner.settings, learning=True, effects=effects))
        with pytest.raises(SemiparamError, match='no prediction of the last second'):
            stage.learner.tare.take()
    else:
        applied = stage.learner.changes.applied
        applied.offer(1, Payload('ft'), load, 0.01 * np.ones(10), samples[99].stamp)
        applied.switch(applied.trials[0], samples[99].stamp)
    stage.offer(carried[100:130])
    assert stage.learner.tare.take() in (29, 30)
    assert np.abs(stage.learner.tare.bias).max() < 0.8, 'eight newtons are the load'


def test_a_state_tells_the_tools_that_were_there(tmp_path):
    """Those of a live parameter were gone with the process, and no word said so."""
    stage, _ = settled()
    settings = stage.learner.settings
    stage.learner.change(replace(settings, tools=(TOOL,)))
    state_file.save(tmp_path / 'a.npz', stage.learner.state())
    assert 'tools' not in state_file.load(tmp_path / 'a.npz', stage.learner.settings, BODY).sentence
    told = state_file.load(tmp_path / 'a.npz', settings, BODY).sentence
    assert f'saved with the tools {TOOL[:20]}' in told and told.endswith('; the parameter tools says none, which holds')


def test_a_tool_that_is_declared_is_taken_off_without_learning_anew_and_without_a_jump():
    """What the model has learnt stays to the last bit, and predictions hold the tool from the next sample on."""
    stage, samples = settled()
    stage.offer(samples[:50])
    tools = Tools(BODY, [TOOL])
    carried = [sample._replace(outputs=sample.outputs + tools.outputs(*sample[1:4])) for sample in samples]
    stage.offer(carried[50:100])
    assert np.abs(np.mean(stage.shown[-50:], axis=0)).max() > 5.0
    assert np.abs([answer.residual for answer in stage.answers[-50:]]).max() > 5.0
    theta, at = stage.learner.estimator.model.theta.copy(), len(stage.shown)
    assert stage.learner.change(replace(stage.learner.settings, tools=(TOOL,))) == ''
    stage.offer(carried[100:300])
    np.testing.assert_array_equal(stage.learner.estimator.model.theta, theta)
    first = stage.answers[at]
    assert np.abs(first.residual).max() < 1.0
    assert first.prediction.mean == pytest.approx(carried[100].outputs - first.residual, abs=1e-12)
    assert stage.steps_since(at - 1).max() < 0.8, 'of 8 N a twenty-fifth, and motion'
    assert np.abs(np.mean(stage.shown[-50:], axis=0)).max() < 0.5
    stage.learner.change(replace(stage.learner.settings, tools=()))
    stage.offer(samples[:1])
    assert np.abs(stage.answers[-1].residual).max() < 1.0


def test_a_reset_is_followed_from_what_was_learnt_to_the_description():
    stage, samples = settled()
    stage.offer(samples[:100])
    at = len(stage.shown)
    stage.learner.reset()
    stage.offer(samples[100:140])
    assert stage.steps_since(at - 1).max() < QUIET


def test_a_clock_that_jumps_is_no_time_to_follow_in():
    stage, samples = settled()
    stage.offer(biased(samples[:60]))
    stage.learner.tare.take()
    for shift in (-10**18, 10**15):
        before = np.array(stage.shown[-1])
        stage.learner.clear_pending()
        stage.offer([sample._replace(stamp=sample.stamp + shift) for sample in biased(samples[60:61])])
        assert np.abs(stage.shown[-1] - before).max() < 4 * QUIET, 'a tenth of a second at most'


def test_the_commands_take_the_same_tools_off():
    settings = replace(SETTINGS, tools=(TOOL,))
    stage, samples = Stage(settings, InlineBackground()), motion(120)
    stage.offer(samples)
    learner = OfflineLearner(settings, [], lambda: None)
    found = [learner.step(sample, True) for sample in samples]
    np.testing.assert_array_equal([each.mean for each in found], stage.means)
    np.testing.assert_array_equal(learner.estimator.model.theta, stage.learner.estimator.model.theta)


def test_a_tool_at_no_link_and_a_frame_that_is_none_are_refused_before_anything_changes():
    stage = Stage()
    for settings in (replace(SETTINGS, tools=('upper {"mass": 1}',)), replace(SETTINGS, external_wrench_frame='x')):
        with pytest.raises(SemiparamError, match='is not a link of the robot description'):
            stage.learner.check(settings)
        with pytest.raises(SemiparamError, match='is not a link of the robot description'):
            Stage(settings)  # as where the description comes late: each status was an internal error


def test_a_tool_beside_a_declared_delay_is_taken_off_with_what_the_delay_remembers():
    """It was computed as if each sample were the first, or remembered beside the state that is saved."""
    stage = Stage(replace(SETTINGS, tools=(TOOL,), effects=('time_delay{"delay_s": 0.012}',)), InlineBackground())
    samples = motion(60)
    stage.offer(samples)
    tools = Tools(BODY, [TOOL])
    tools.shaped_by(stage.learner.estimator.columns.effects)
    taken_off = np.array([sample.outputs for sample in samples]) - stage.learner.history.batch().samples.outputs
    np.testing.assert_allclose(taken_off, tools.outputs_of(Samples.from_list(samples)), atol=1e-9)
    assert np.abs(taken_off - Tools(BODY, [TOOL]).outputs_of(Samples.from_list(samples))).max() > 1e-3
