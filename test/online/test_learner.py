"""What the node does around the estimator, without ROS: order, background work, switches, gate, tare, state files."""

import importlib
import os
import pickle
import signal
import struct
import subprocess
import sys
import time
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semiparam_ros.bags.readings import Reading
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.robot.frames import load_in_base
from semiparam_ros.core.robot.tools import Tools
from semiparam_ros.diagnosis.setup.identifiability import unidentifiable
from semiparam_ros.effects import effect_from_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online import diagnosis_jobs, learner, model_jobs, state_file, transport, worker
from semiparam_ros.online.history import History, arrays_of, batch_from, batch_of
from semiparam_ros.online.identified_parameters import (
    Excitation,
    carried_load,
    conditioning,
    quantities,
    reported_load,
)
from semiparam_ros.online.learning import Learning, begins_anew, see_again
from semiparam_ros.online.model_jobs import new_estimator
from semiparam_ros.online.model_switcher import same_model
from semiparam_ros.online.tare import Tare
from semiparam_ros.online.worker import ProcessBackground, Urgency, _spawned_worker
from semiparam_ros.ros.estimator.subscriptions import ClockWatch
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator, build_rigid_body, model_options
from semiparam_ros.settings.rules import broken_rule
from support.arms import ICUB_JOINTS, ICUB_OWN, smooth_motion
from support.learner_stage import Stage
from support.node_helpers import (
    BODY,
    PERIOD_NS,
    SETTINGS,
    URDF,
    InlineBackground,
    ServedProcess,
    at_period,
    motion,
)

VARIANTS = ('P', 'NP-ML', 'SP-ML', 'SP2-ML', 'SPK-ML')


def offline(samples, settings=SETTINGS, learnt=None, takeovers=(0,)):
    """The commands' learner, and its predictions."""
    estimator, steps = steps_of(samples, settings, learnt, takeovers)
    return estimator, np.array([step.mean for step in steps])


def steps_of(samples, settings=SETTINGS, learnt=None, takeovers=(0,)):
    learner, flags = OfflineLearner(settings, [], lambda: None, takeovers), learnt or [True] * len(samples)
    steps = [learner.step(sample, flag) for sample, flag in zip(samples, flags, strict=True)]
    return learner.estimator, steps


@pytest.mark.parametrize(('variant', 'until'), [('SPK-ML', 100), ('SPK-ML', 180), ('NP-ML', 61), ('P', 100)])
def test_answers_go_on_while_hyperparameters_are_estimated(variant, until):
    """By the provisional model; the variant then takes over as if it had been there since the end of the window."""
    settings = replace(SETTINGS, variant=variant)
    samples, stage = motion(250), Stage(settings)
    stage.offer(samples[:until])
    assert len(stage.answers) == until and stage.learner.estimating
    stage.background.run()
    assert stage.learner.estimator.ready and not stage.learner.estimating
    stage.offer(samples[until:])
    assert [answer.prediction.sample.stamp for answer in stage.answers] == [sample.stamp for sample in samples]
    assert stage.learner.takeovers == [until - SETTINGS.initial_samples]
    steps = steps_of(samples, settings, takeovers=stage.learner.takeovers)[1]
    np.testing.assert_array_equal(stage.means, [step.mean for step in steps])
    np.testing.assert_array_equal(stage.means[until:], offline(samples, settings)[1][until:])
    horizons = [step.horizon for step in steps if step.horizon is not None]
    assert [errors.origin for errors in stage.errors] == [errors.origin for errors in horizons]
    np.testing.assert_array_equal([errors.eps for errors in stage.errors], [errors.eps for errors in horizons])


def test_many_samples_are_caught_up_beside_the_answers():
    """None of them keeps an answer waiting for more than a few others."""
    samples, stage = motion(300), Stage()
    stage.offer(samples[:100])
    stage.background.later = lambda function: None  # there is never a moment when nothing else is to be done
    stage.background.run()
    assert stage.learner.estimating, 'none is learnt within the callback but one'
    stage.offer(samples[100:138])
    assert not stage.learner.estimator.ready
    stage.offer(samples[138:])
    assert stage.learner.takeovers == [79]
    np.testing.assert_array_equal(stage.means, offline(samples, takeovers=[79])[1])


def test_settings_change_while_hyperparameters_are_estimated():
    samples, stage = motion(260), Stage()
    stage.offer(samples[:80])
    assert 'is being built' in stage.learner.change(replace(SETTINGS, variant='NP-ML'))
    assert not stage.learner.estimating
    stage.offer(samples[80:100])
    assert stage.learner.change(SETTINGS) == 'SPK-ML goes on.'
    assert stage.learner.estimating and len([job for job in stage.background.jobs if not job.cancelled]) == 1
    stage.offer(samples[100:120])
    assert stage.learner.change(replace(SETTINGS, gate_timeout=7.0)) == ''
    stage.background.run()
    stage.offer(samples[120:])
    assert stage.learner.built.variant == 'SPK-ML'
    np.testing.assert_allclose(stage.means[120:], offline(samples)[1][120:], atol=1e-8)
    stage = Stage()
    stage.offer(samples[:80])
    stage.learner.change(replace(SETTINGS, variant='NP-ML'))
    stage.background.run()
    stage.offer(samples[80:])
    assert stage.learner.built.variant == 'NP-ML' and stage.learner.estimator.ready
    expected = offline(samples, replace(SETTINGS, variant='NP-ML'))[1]
    np.testing.assert_allclose(stage.means[80:], expected[80:], atol=1e-8)


def test_a_state_saved_while_hyperparameters_are_estimated_goes_on(tmp_path):
    samples, stage = motion(260), Stage()
    stage.offer(samples[:100])
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    again = Stage()
    again.learner.restore(state_file.load(tmp_path / 's.npz', SETTINGS, BODY))
    again.offer(samples[100:110])
    assert again.learner.estimating
    again.background.run()
    again.offer(samples[110:])
    np.testing.assert_array_equal(again.means[:10], offline(samples, takeovers=[50])[1][100:110])
    np.testing.assert_allclose(again.means[10:], offline(samples)[1][110:], atol=1e-8)


def test_a_state_saved_while_another_model_is_built_has_that_built_anew(tmp_path):
    """What was asked for, such as the effects of a diagnosis, was forgotten without a word: the state took it back."""
    samples, stage = motion(260), Stage()
    stage.offer_and_build(samples[:120])
    asked = replace(SETTINGS, variant='P', effects=('sensor_drift',))
    assert 'is being built' in stage.learner.change(asked)
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    saved = state_file.load(tmp_path / 's.npz', replace(SETTINGS, horizon_length=9), BODY)
    assert saved.sentence == 'SPK-ML with 120 samples; the P that was being built is built anew'
    assert saved.adopted_by(replace(SETTINGS, gate_timeout=7.0)).asked == replace(asked, gate_timeout=7.0)
    again = Stage()
    again.learner.restore(saved)
    assert (again.learner.settings, again.learner.built) == (asked, SETTINGS)
    for each in (stage, again):
        each.offer_and_build(samples[120:180])
        each.offer(samples[180:])
        assert each.learner.built == asked
    np.testing.assert_array_equal(again.means, stage.means[120:])
    assert stage.learner.state().asked is None and 'built anew' not in stage.learner.state().sentence


def test_a_model_that_broke_is_not_asked_for_by_the_checkpoint_that_takes_its_place():
    samples, states = motion(200), []
    stage = Stage(checkpoint=lambda: states[-1])
    stage.offer_and_build(samples[:120])
    stage.learner.change(replace(SETTINGS, variant='P'))
    states.append(pickle.loads(pickle.dumps(stage.learner.state())))
    stage.offer_and_build(samples[120:140])
    stage.learner._fall_back(ValueError('broken'))
    assert stage.learner.settings.variant == stage.learner.built.variant == 'SPK-ML'
    assert stage.reverted[-1].variant == 'SPK-ML'


def test_a_robot_at_rest_is_answered_and_not_learnt():
    """An hour of it changes nothing, with and without forgetting; and the window goes on where it was."""
    rest = [sample._replace(position=motion(1)[0].position) for sample in motion(500)]
    for forgetting in (1.0, 0.9):
        settings = replace(SETTINGS, forgetting=forgetting)
        stage = Stage(settings, InlineBackground())
        stage.offer(rest)
        assert [answer.learnt for answer in stage.answers] == [True] * 5 + [False] * 495
        assert len(stage.learner.estimator.window) == 5
        assert len(stage.learner.history) == 5 and len(stage.learner.history.batch()) == 25
        moving = later(motion(200), 100.0)
        stage.offer(moving)
        assert stage.learner.estimator.ready and all(answer.learnt for answer in stage.answers[503:])
        stopped = [moving[-1]._replace(stamp=moving[-1].stamp + (index + 1) * PERIOD_NS,
                                       outputs=np.full(6, 50.0 + 0.1 * (index % 2))) for index in range(500)]
        stage.offer(stopped)
        assert [answer.learnt for answer in stage.answers[-500:]] == [True] * 4 + [False] * 496


def test_windows_without_end_are_accounted_for_up_to_a_number(monkeypatch):
    """A robot whose outputs are constant fills lists, and a status with them, for as long as it runs."""
    monkeypatch.setattr(learner, 'MOST_WINDOWS', 3)
    stage = Stage()
    for _ in range(5):
        stage.offer_and_build(still(90))
    assert stage.learner.takeovers == [30, 30, 30] and len(stage.learner.failed_windows) == 3


def test_a_window_without_variation_keeps_the_provisional_model_and_says_why():
    stage = Stage()
    stage.offer_and_build(still(90))
    assert len(stage.answers) == 90 and not stage.learner.estimator.ready
    assert 'gives no hyperparameters' in stage.news[1]
    stage.offer_and_build([sample._replace(stamp=sample.stamp + 10**10) for sample in motion(100)])
    assert stage.learner.estimator.ready


@pytest.mark.parametrize('after', VARIANTS)
def test_a_switch_misses_no_sample_and_equals_a_node_started_with_that_variant(after):
    samples, stage = motion(260), Stage()
    stage.offer_and_build(samples[:150])
    sentence = stage.learner.change(replace(SETTINGS, variant=after))
    stage.offer(samples[150:200])
    assert len(stage.answers) == 200, 'the old variant answers meanwhile'
    stage.background.run()
    stage.offer_and_build(samples[200:])
    assert len(stage.answers) == 260
    expected = offline(samples, replace(SETTINGS, variant=after))[1]
    np.testing.assert_allclose(stage.means[200:], expected[200:], atol=1e-8)
    np.testing.assert_array_equal(stage.means[:200], offline(samples[:200], takeovers=[90])[1])
    assert stage.learner.built.variant == after
    assert after == SETTINGS.variant or 'is being built from 150 samples' in sentence


@pytest.mark.parametrize('period_ns', [1_000_000, 250_000])
def test_a_switch_of_a_fast_robot_equals_a_node_started_with_that_variant(period_ns):
    """Its window, which holds one sample of each step, is the same when it is gathered from what was kept."""
    samples, switched = at_period(motion(1500), period_ns), replace(SETTINGS, initial_samples=50, variant='SPK-ML')
    stage = Stage(replace(switched, variant='P', retained_samples=1))
    stage.offer_and_build(samples[:1000])
    stage.learner.change(switched)
    stage.offer_and_build(samples[1000:1001])
    built = stage.learner.estimator
    expected = steps_of(samples[:1001], switched)[0]
    assert built.variant == expected.variant and built.ready
    np.testing.assert_array_equal(built.input_scaling, expected.input_scaling)
    assert built.model.hyperparameters == expected.model.hyperparameters


@pytest.mark.parametrize('period_ns', [1_000_000, PERIOD_NS])
def test_a_variant_that_comes_back_answers_as_if_it_had_never_left(period_ns):
    """The window comes again as it was learnt, of a fast robot one sample of each step."""
    samples, settings = at_period(motion(900), period_ns), replace(SETTINGS, initial_samples=50, variant='P')
    stage = Stage(settings, InlineBackground())
    stage.offer(samples[:600])
    for variant, until in (('NP-ML', 700), ('P', 900)):
        stage.learner.change(replace(settings, variant=variant))
        stage.offer(samples[len(stage.answers):until])
    np.testing.assert_allclose(stage.means[701:], offline(samples, settings)[1][701:], atol=1e-8)


def test_hyperparameters_are_estimated_once_for_each_model():
    samples, stage = motion(120), Stage()
    stage.offer_and_build(samples)
    stage.learner.change(replace(SETTINGS, horizon_length=7))
    assert len(stage.background.jobs) == 1
    stage.background.run()
    assert stage.learner.estimator.options.hyperparameters is not None, 'the known ones were handed over'
    assert stage.learner.estimator.ensemble.first.horizon.length == 7


def test_the_last_wish_wins_when_switches_follow_each_other():
    samples, stage = motion(120), Stage()
    stage.offer_and_build(samples)
    for variant in ('P', 'NP-ML', 'SPK-ML', 'SP-ML'):
        stage.learner.change(replace(SETTINGS, variant=variant))
    stage.background.run()
    assert stage.learner.built.variant == 'SP-ML'
    stage.learner.change(replace(SETTINGS, variant='P'))
    assert stage.learner.change(replace(SETTINGS, variant='SP-ML')) == 'SP-ML goes on.'
    stage.background.run()
    assert stage.learner.built.variant == 'SP-ML'


def test_a_switch_within_the_initial_window_keeps_its_samples():
    samples, stage = motion(130), Stage()
    stage.offer(samples[:30])
    stage.learner.change(replace(SETTINGS, variant='SP-ML'))
    stage.background.run()
    stage.offer_and_build(samples[30:])
    np.testing.assert_allclose(stage.means, offline(samples, replace(SETTINGS, variant='SP-ML'), takeovers=[70])[1],
                               atol=1e-10)


def test_a_model_that_cannot_be_built_is_refused_beforehand_or_reverted():
    stage = Stage()
    with pytest.raises(SemiparamError, match='nowhere'):
        stage.learner.check(replace(SETTINGS, effects=('external_force@nowhere',)))
    stage.offer_and_build(motion(120))
    with pytest.raises(SemiparamError, match='nowhere'):
        stage.learner.check(replace(SETTINGS, effects=('external_force@nowhere',)))
    stage.learner.change(replace(SETTINGS, effects=('external_force@nowhere',)))  # as if it had got past the check
    stage.background.run()
    assert stage.reverted == [SETTINGS]
    assert 'could not be built' in stage.news[-1]
    stage.offer(motion(130)[120:])
    assert len(stage.answers) == 130


def test_shadows_learn_the_same_samples_and_take_over_at_once():
    samples = motion(220)
    stage = Stage(replace(SETTINGS, shadow_variants=('P', 'NP-ML')))
    stage.offer_and_build(samples[:150])
    stage.offer(samples[150:180])
    assert {variant for variant, _ in stage.horizons} == {'P', 'NP-ML'}
    sentence = stage.learner.change(replace(stage.learner.settings, variant='NP-ML'))
    assert 'learnt as a shadow' in sentence and stage.learner.built.variant == 'NP-ML'
    stage.offer(samples[180:])
    expected = offline(samples, replace(SETTINGS, variant='NP-ML'))[1]
    np.testing.assert_allclose(stage.means[180:], expected[180:], atol=1e-8)
    stage.learner.change(replace(stage.learner.settings, shadow_variants=()))
    assert not stage.learner.switcher.shadows


def still(count, start=0):
    """Samples of a robot that does not move and a sensor that says nothing."""
    return [sample._replace(outputs=np.full(6, 1.0)) for sample in motion(start + count)[start:]]


def later(samples, seconds):
    return [sample._replace(stamp=sample.stamp + round(seconds * 1e9)) for sample in samples]


@pytest.mark.parametrize('wish', [{'variant': 'NP-ML'}, {'effects': ('sensor_drift',)}, {'shadow_variants': ('P',)}])
def test_nothing_is_built_from_a_window_that_gave_no_hyperparameters(wish):
    stage, moving = Stage(), later(motion(130), 60.0)
    stage.offer_and_build(still(90))
    assert not stage.learner.estimator.ready
    settings = replace(SETTINGS, **wish)
    stage.learner.change(settings)
    stage.background.run()
    stage.offer_and_build(moving)
    assert same_model(stage.learner.built, settings) and stage.learner.estimator.ready
    assert not any('could not be built' in sentence for sentence in stage.news)
    assert all(model.estimator.ready for model in stage.learner.switcher.shadows.values())
    # The window holds what followed the news of the dead one.
    expected = new_estimator(settings, BODY, origin=motion(1)[0].stamp)
    for sample in moving:
        expected.step(sample)
    np.testing.assert_allclose(stage.learner.estimator.predict(moving[-1]).mean, expected.predict(moving[-1]).mean,
                               atol=1e-8)


def test_a_shadow_gathers_another_window_with_the_active_model():
    stage = Stage(replace(SETTINGS, shadow_variants=('NP-ML',)))
    stage.offer_and_build(still(90))
    assert len(stage.answers) == 90 and not stage.background.jobs
    stage.offer_and_build(later(motion(100), 60.0))
    assert stage.learner.switcher.shadows['NP-ML'].estimator.ready


def test_a_shadow_that_fails_while_a_successor_is_built_leaves_one_successor():
    samples, stage = motion(200), Stage()
    stage.offer_and_build(samples[:100])
    shadowed = replace(SETTINGS, shadow_variants=('NP-ML',))
    stage.learner.change(shadowed)
    shadow_job = stage.background.jobs.popleft()
    stage.learner.change(replace(shadowed, variant='P'))
    successor = stage.learner.switcher.successor
    shadow_job.done(None, MemoryError('worker'))
    assert stage.learner.switcher.successor is successor and len(stage.background.jobs) == 1
    assert not stage.learner.switcher.shadows and 'NP-ML could not be built' in stage.news[-1]
    assert [place for place, _ in stage.failures] == ['the model NP-ML beside the active one']
    stage.offer_and_build(samples[100:])
    assert stage.learner.built.variant == 'P' and stage.learner.switcher.successor is None
    np.testing.assert_allclose(stage.learner.estimator.predict(samples[-1]).mean,
                               offline(samples, replace(SETTINGS, variant='P'))[0].predict(samples[-1]).mean, atol=1e-8)


def test_a_retired_successor_never_takes_over():
    samples, stage = motion(100), Stage()
    stage.offer_and_build(samples)
    stage.learner.change(replace(SETTINGS, variant='P'))
    orphan = stage.background.jobs.popleft()
    stage.learner.change(replace(SETTINGS, variant='NP-ML'))
    function, arguments = pickle.loads(orphan.packed)
    orphan.done(function(*arguments), None)
    assert stage.learner.built.variant == SETTINGS.variant
    stage.background.run()
    assert stage.learner.built.variant == 'NP-ML'


def break_down(estimator, how):
    """Damage a model as a fault in the numerics would."""
    if how == 'not finite':
        estimator.model.recursion.theta = np.full_like(estimator.model.recursion.theta, np.nan)
    else:
        estimator.model.recursion = None


@pytest.mark.parametrize('how', ['not finite', 'errors'])
def test_a_broken_model_is_replaced_by_p(how):
    samples, stage = motion(250), Stage(replace(SETTINGS, effects=('sensor_drift',)), InlineBackground())
    stage.offer(samples[:100])
    break_down(stage.learner.estimator, how)
    stage.offer(samples[100:])
    assert stage.learner.built.variant == 'P' and stage.learner.built.effects == ()
    assert stage.reverted[-1] == stage.learner.settings == stage.learner.built
    broken = next(sentence for sentence in stage.news if 'SPK-ML is broken' in sentence)
    assert 'P begins anew' in broken
    assert stage.failures and stage.failures[0][0] == 'the active model'
    unanswered = 0 if how == 'not finite' else 2
    assert len(stage.answers) == 250 - unanswered == 250 - stage.learner.lost
    assert stage.learner.estimator.ready and np.isfinite(stage.means).all()


def test_a_broken_model_of_given_hyperparameters_that_p_lacks_begins_anew():
    """P could not be built of them, and no further sample was answered."""
    given = replace(SETTINGS, variant='NP-ML', effects=('sensor_drift',), hyperparameters_rho=(1.0,),
                    hyperparameters_tau=(1.0,) * 3, hyperparameters_sigma=(0.1,),
                    hyperparameters_output_scale=(1.0,) * 6, hyperparameters_input_mean=(0.0,) * 6,
                    hyperparameters_input_scale=(1.0,) * 6)
    samples, stage = motion(60), Stage(given, InlineBackground())
    stage.offer(samples[:30])
    break_down(stage.learner.estimator, 'not finite')
    stage.offer(samples[30:])
    assert len(stage.answers) == 60 and np.isfinite(stage.means).all()
    assert stage.reverted == [replace(given, effects=())] and stage.learner.settings == stage.learner.built
    assert stage.news[-1].startswith('NP-ML is broken') and stage.news[-1].endswith('NP-ML begins anew.')
    assert broken_rule(stage.learner.settings) is None, 'its parameters may change'


def test_a_broken_model_is_replaced_by_the_last_checkpoint():
    samples, kept = motion(250), []
    stage = Stage(background=InlineBackground(), checkpoint=lambda: kept[-1])
    stage.offer(samples[:150])
    kept.append(pickle.loads(pickle.dumps(stage.learner.state())))
    stage.offer(samples[150:200])
    break_down(stage.learner.estimator, 'not finite')
    stage.offer(samples[200:])
    assert 'SPK-ML of the last checkpoint goes on' in stage.news[-1]
    expected = offline([*samples[:150], *samples[200:]])[1]
    np.testing.assert_allclose(stage.means[200:], expected[150:], atol=1e-10)


def test_the_sample_on_which_a_model_breaks_is_answered_with_the_bias_of_the_checkpoint():
    """The bias of the model that broke was taken off it, and that of the checkpoint added."""
    samples, kept = motion(130), []
    stage = Stage(background=InlineBackground(), checkpoint=lambda: kept[-1])
    stage.offer(samples[:110])
    kept.append(pickle.loads(pickle.dumps(stage.learner.state())))
    stage.learner.tare.bias = np.full(6, 50.0)
    stage.learner.takes_off_otherwise()
    break_down(stage.learner.estimator, 'not finite')
    stage.offer(samples[110:])
    assert 'SPK-ML of the last checkpoint goes on' in stage.news[-1] and not stage.learner.tare.active
    shown = [answer.residual + answer.prediction.mean for answer in stage.answers[110:]]
    np.testing.assert_allclose(shown, [sample.outputs for sample in samples[110:]], atol=1e-10)
    kept_outputs = stage.learner.history.batch().samples.outputs
    np.testing.assert_array_equal(kept_outputs, [sample.outputs for sample in samples])


def test_a_sample_that_cannot_be_learnt_ends_nothing(monkeypatch):
    samples, stage = motion(200), Stage(background=InlineBackground())
    stage.offer(samples[:100])
    monkeypatch.setattr(stage.learner.estimator.ensemble.first.horizon, 'moved_on', lambda *_: 1 / 0)
    stage.offer(samples[100:])
    assert len(stage.answers) == 200 and stage.learner.built.variant == 'P'
    assert stage.failures[0][0] == 'learning'


def test_time_goes_on_after_a_reset_and_after_jumps_of_the_clock():
    samples = motion(300)
    stage = Stage(replace(SETTINGS, variant='P', effects=('payload@ft{"start_s": 1.0}',)), InlineBackground())
    stage.offer(samples[:100])
    stage.learner.reset()
    stage.offer(samples[100:200])
    assert stage.learner.estimator.origin == samples[0].stamp
    assert stage.learner.estimator.predict(samples[200]).columns[:, -10:].any(), 'the load is there'
    for jump in (365 * 86400.0, -365 * 86400.0):
        moved = later(samples[200:], jump)
        prediction = stage.learner.estimator.predict(moved[0])
        assert prediction.columns[:, -10:].any()
        stage.offer(moved)
    drift = build_estimator(replace(SETTINGS, variant='P', effects=('sensor_drift',)))
    for sample in [*samples[:100], *later(samples[100:110], 1e8), *later(samples[110:120], -1e8)]:
        columns = drift.step(sample).columns[:, -6:]
        assert 0.0 <= columns.max() < 5.0, 'seconds since the start, without those that the clock jumped'


def test_a_model_built_after_a_jump_of_the_clock_leaves_out_the_same_blocks():
    """The block that had begun lasted until the clock was where it had been."""
    samples, stage = motion(900), Stage(replace(SETTINGS, variant='P'), InlineBackground())
    stage.offer(samples[:600])
    stage.learner.clear_pending()  # as the node does
    stage.offer(later(samples[600:], -11.0))
    estimator, history = stage.learner.estimator, stage.learner.history
    known = model_jobs.known_of(estimator)
    built = model_jobs.build(stage.learner.built, BODY, history.batch(), known, history.origin)
    one, other = (each.ensemble.carried.state() for each in (estimator, built))
    np.testing.assert_array_equal(one['counts'], other['counts'])
    np.testing.assert_allclose(one['theta0'], other['theta0'], rtol=1e-9)


def test_a_span_begins_after_the_last_jump_of_the_clock():
    history, samples = History(5, 100, 2), motion(60)
    for sample in [*later(samples[:30], 500.0), *samples[30:]]:
        history.append(sample, True)
    assert history.span(1000.0).samples.stamps.tolist() == [sample.stamp for sample in samples[30:]]
    assert len(history.span(0.1)) == 6


def test_what_came_around_a_stamp_counts_pauses_as_one_step():
    history, samples = History(5, 100, 2), motion(60)
    for sample in [*samples[:30], *later(samples[30:], 500.0)]:
        history.append(sample, True)
    stamps = [sample.stamp for sample in [*samples[:30], *later(samples[30:], 500.0)]]
    step_s = (stamps[1] - stamps[0]) * 1e-9
    assert history.around(stamps[40], 500.0).stamps.tolist() == stamps
    assert len(history.around(stamps[30], 0.1 + 4.5 * step_s)) == 30 + 5
    assert len(history.around(stamps[-1] + 1, 1.5 * step_s)) == 2
    assert not len(History(5, 100, 2).around(0, 1.0))


def test_a_pause_predicts_without_learning():
    samples, stage = motion(160), Stage()
    stage.offer_and_build(samples[:100])
    stage.learner.change(replace(SETTINGS, learning=False))
    stage.offer(samples[100:])
    flags = [True] * 100 + [False] * 60
    np.testing.assert_array_equal(stage.means, offline(samples, learnt=flags, takeovers=[40])[1])
    assert stage.learner.learnt == 100


def test_contacts_are_flagged_not_learnt_and_seen_in_the_residual():
    samples, push, ends = motion(300), np.array([5.0, 0, 0, 0, 0, 0]), []
    touched = [sample._replace(outputs=sample.outputs + push) if 200 <= index < 230 else sample
               for index, sample in enumerate(samples)]
    for seed in range(3):
        stage = Stage(replace(SETTINGS, gate_enabled=True, gate_hold=0.1, features_count=100, features_seed=seed),
                      InlineBackground())
        stage.offer(touched)
        contact = np.array([answer.contact for answer in stage.answers])
        assert contact[200:230].all() and not contact[:200].any() and not contact[250:].any()
        ends.append(np.flatnonzero(contact)[-1])
        assert [answer.learnt for answer in stage.answers] == (~contact).tolist()
        force = np.mean([answer.residual[0] for answer in stage.answers[200:230]])
        assert force == pytest.approx(5.0, abs=0.5)
        assert stage.learner.gate.refused == contact.sum()
    assert np.median(ends) < 240


def test_a_load_is_told_and_learnt_when_the_gate_gives_way():
    """What was learnt before then counts for less, in the model in force, in one built later, and offline."""
    settings = replace(SETTINGS, variant='P', gate_enabled=True, gate_timeout=3.0, diagnosis_auto='off')
    samples, stage = motion(1200), Stage(settings, InlineBackground())
    samples[300:900] = [sample._replace(outputs=sample.outputs + 5.0) for sample in samples[300:900]]
    stage.offer(samples[:700])
    stage.learner.change(replace(settings, variant='P'))
    stage.learner.change(settings)
    stage.offer(samples[700:])
    contact = np.array([answer.contact for answer in stage.answers])
    assert contact[300:450].all() and not contact[452:900].any()
    assert sum('is a change of the robot, and is learnt' in news for news in stage.news) == 1
    left = [np.abs(answer.prediction.model_mean - answer.prediction.sample.outputs).max() for answer in stage.answers]
    assert max(left[850:900]) < 0.5
    assert max(left[300:310]) > 4.0 and max(left[1080:]) < 1.0, 'put down: what was learnt without it goes on'
    assert sum('again as it was before its last change' in news for news in stage.news) == 1
    np.testing.assert_allclose(stage.means, offline(samples, settings)[1], atol=1e-8)


def test_a_load_that_is_put_on_while_the_robot_rests_is_followed_once_it_moves(tmp_path):
    """The gate gave way at rest, of which nothing is learnt: the past counted as before, and the load came slowly."""
    settings = replace(SETTINGS, variant='P', gate_enabled=True, gate_timeout=1.0)
    rests, zeros, noise = motion(301)[300], np.zeros(2), np.random.default_rng(3).standard_normal((250, 6))
    at_rest = [rests._replace(stamp=rests.stamp + number * PERIOD_NS, velocity=zeros, acceleration=zeros,
                              outputs=rests.outputs + 0.02 * row) for number, row in enumerate(noise)]
    samples = [sample._replace(outputs=sample.outputs + 5.0 * (number >= 400))
               for number, sample in enumerate([*motion(300), *at_rest, *later(motion(700), 11.0)])]
    stage = Stage(settings, InlineBackground())
    stage.offer(samples[:550])
    assert stage.learner.gate.changes and not stage.learner.gate.closed
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    stage.learner.restore(state_file.load(tmp_path / 's.npz', settings, BODY))
    stage.offer(samples[550:])
    learning = [answer.learning for answer in stage.answers]
    assert learning.index(Learning.AFTER_CHANGE) == next(
        number for number in range(550, 600) if learning[number] > 0)
    left = [np.abs(answer.prediction.model_mean - answer.prediction.sample.outputs).max() for answer in stage.answers]
    assert np.mean(left[1100:]) < 1.0, '2.0 N before'


def test_tare_takes_off_the_bias_and_leaves_the_weight():
    samples = motion(400)
    drifted = samples[:200] + [sample._replace(outputs=sample.outputs + 2.0) for sample in samples[200:]]
    settings = replace(SETTINGS, features_count=100)
    stage = Stage(settings, InlineBackground())
    stage.offer(drifted[:200])
    stage.learner.change(replace(settings, learning=False))
    stage.offer(drifted[200:300])
    assert stage.learner.tare.take() == 51
    np.testing.assert_allclose(stage.learner.tare.bias, 2.0, atol=0.12)
    stage.offer(drifted[300:])
    residual = np.array([answer.residual for answer in stage.answers[300:]])
    assert np.abs(residual.mean(axis=0)).max() < 0.4, 'two newtons before'
    published = np.array([answer.prediction.mean for answer in stage.answers[300:]])
    measured = np.array([sample.outputs for sample in drifted[300:]])
    np.testing.assert_allclose(published + residual, measured, atol=1e-12)
    with pytest.raises(SemiparamError, match='no prediction of the last second'):
        Stage().learner.tare.take()


def test_a_history_of_fates_that_there_are_not_is_refused():
    arrays = arrays_of(batch_of((sample, Learning.YES) for sample in motion(3)))
    for fate in (begins_anew(Learning.NO), begins_anew(Learning.TAKEN_BACK)):
        assert (batch_from({**arrays, 'learnt': np.full(3, fate)}, 2, 6).learning == fate).all()
    with pytest.raises(ValueError, match='no fate of a sample'):
        batch_from({**arrays, 'learnt': np.full(3, 7)}, 2, 6)


@pytest.mark.parametrize('by', ['a tare', 'a tool'])
@pytest.mark.parametrize('saved', [False, True])
def test_what_the_wandering_offset_followed_is_not_taken_off_once_more(by, saved, tmp_path):
    """The arm stood, where offsets stay: predictions held a bias, or a tool, twice until it moved again."""
    tool = 'ft {"mass": 0.3}'
    settings, samples = replace(SETTINGS, variant='P', diagnosis_auto='off'), motion(420)
    more = [np.full(6, 2.0) if by == 'a tare' else Tools(BODY, [tool]).outputs(*sample[1:4]) for sample in samples]
    samples = [sample._replace(outputs=sample.outputs + min(max(number / 100 - 2.0, 0.0), 1.0) * each)
               for number, (sample, each) in enumerate(zip(samples, more, strict=True))]
    stage, held = Stage(settings, InlineBackground()), samples[379]
    rest = [held._replace(stamp=held.stamp + (number + 1) * PERIOD_NS, velocity=np.zeros(2), acceleration=np.zeros(2))
            for number in range(140)]
    stage.offer([*samples[:380], *rest[:120]])
    assert np.abs(stage.answers[-1].followed).max() > 0.5
    if by == 'a tare':
        stage.learner.take_tare()
    else:
        settings = replace(settings, tools=(tool,))
        stage.learner.change(settings)
    if saved:
        state_file.save(tmp_path / 's.npz', stage.learner.state())
        stage.learner.restore(state_file.load(tmp_path / 's.npz', settings, BODY))
    stage.offer(rest[120:])
    assert not stage.answers[-1].followed.any()
    assert by == 'a tool' or np.abs(stage.answers[-1].residual).max() < 0.3, 'two newtons before'
    stage.offer(later(samples[380:], 139 * PERIOD_NS * 1e-9))
    fresh = new_estimator(settings, BODY, None, stage.learner.history.origin)
    for answer in stage.answers:
        see_again(fresh, answer.prediction.sample, answer.learning)
    offset = stage.learner.estimator.ensemble.first.wandering.offset
    np.testing.assert_allclose(fresh.ensemble.first.wandering.offset, offset, atol=1e-9)


@pytest.mark.parametrize('by', ['a tare', 'a tool', 'a model'])
def test_what_is_taken_off_or_predicted_otherwise_at_rest_is_no_contact(by):
    """The gate was closed for five seconds, then told a change of the robot, which the model was to follow."""
    stage, samples = Stage(replace(SETTINGS, variant='P'), InlineBackground()), motion(200)
    stage.offer(samples)
    stage.learner.change(replace(stage.learner.settings, gate_enabled=True))
    held = samples[-1]._replace(velocity=np.zeros(2), acceleration=np.zeros(2))
    outputs = BODY.regressor(*held[1:4]) @ (1.2 * BODY.base_parameters) + 3.0
    noise = 0.01 * np.random.default_rng(0).standard_normal((400, 6))
    rest = [held._replace(stamp=held.stamp + (number + 1) * PERIOD_NS, outputs=outputs + each)
            for number, each in enumerate(noise)]
    stage.offer(rest[:380])
    settings = stage.learner.settings
    if by == 'a tare':
        assert stage.learner.take_tare() == 51 and stage.learner.tare.bias.min() > 2.0
    else:
        tool = 'ft {"mass": 0.5}'
        stage.learner.change(replace(settings, tools=(tool,)) if by == 'a tool' else replace(settings, variant='NP-ML'))
    stage.offer(rest[380:])
    gate = stage.learner.gate
    assert gate.contacts == 0, (gate.level, stage.news)
    stage.offer([rest[-1]._replace(stamp=rest[-1].stamp + PERIOD_NS, outputs=rest[-1].outputs + 20.0)])
    assert gate.contacts == 1, 'a push still is one'


def test_a_bias_that_no_sensor_has_is_not_taken():
    tare = Tare(6)
    tare.add(0, np.full(6, 1e43), True)
    with pytest.raises(SemiparamError, match=r'the bias would be 1e\+43'):
        tare.take()
    assert not tare.active


def test_a_tare_goes_by_the_last_second_alone_while_motors_are_on():
    tare = Tare(6)
    tare.add(0, np.ones(6), True)
    tare.add(2 * 10**9, np.ones(6), False)
    with pytest.raises(SemiparamError, match='no prediction of the last second'):
        tare.take()
    stage = Stage(SETTINGS, InlineBackground())
    samples = motion(300)
    stage.offer(samples[:200])
    still = samples[200]._replace(outputs=np.full(6, 1e-3))
    stage.offer([still._replace(stamp=still.stamp + index * PERIOD_NS) for index in range(100)])
    assert stage.answers[-1].prediction.off
    with pytest.raises(SemiparamError, match='no prediction of the last second'):
        stage.learner.tare.take()


def test_files_that_do_not_fit_are_refused(tmp_path):
    stage, path = Stage(SETTINGS, InlineBackground()), tmp_path / 's.npz'
    stage.offer(motion(100))
    state_file.save(path, stage.learner.state())
    for changes, sentence in (({'robot_description': URDF.replace('0 0 0.3', '0 0 0.4')}, 'another robot'),
                              ({'wrench_convention': 'reaction'}, 'another robot'),
                              ({'features_count': 60}, 'features.count 40; this node has 60')):
        other = replace(SETTINGS, **changes)
        with pytest.raises(SemiparamError, match=sentence):
            state_file.load(path, other, build_rigid_body(other))


def test_reset_forgets_and_drops_what_the_background_still_does():
    samples, stage = motion(200), Stage()
    stage.offer(samples[:70])
    assert stage.learner.estimating
    stage.learner.reset()
    stage.background.run()
    assert not stage.learner.estimator.ready and not len(stage.learner.estimator.window)
    stage.offer_and_build(samples[70:])
    assert len(stage.answers) == 200 and stage.learner.estimator.ready


def test_a_switch_counts_samples_since_the_reset():
    samples, stage = motion(300), Stage()
    stage.offer_and_build(samples[:200])
    stage.learner.reset()
    stage.offer_and_build(samples[200:])
    assert 'is being built from 100 samples' in stage.learner.change(replace(SETTINGS, variant='P'))
    stage.background.run()
    assert stage.news[-1] == 'P takes over from SPK-ML after 100 samples.'


@pytest.mark.parametrize('jump', [-3600.0, 0.0, 365 * 86400.0])
def test_the_first_sample_after_a_jump_of_the_clock_is_answered_and_not_learnt(jump):
    """The filter that gives accelerations begins anew with it; it told of one 30 times too large, or of none."""
    samples, stage = motion(200), Stage(SETTINGS, InlineBackground())
    stage.offer(samples[:150])
    stage.learner.clear_pending()
    wrong = samples[150]._replace(acceleration=np.full(2, 1e3))
    stage.offer(later([wrong, *samples[151:]], jump))
    assert [answer.learnt for answer in stage.answers[150:]] == [False] + [True] * 49
    assert np.abs([answer.residual for answer in stage.answers[151:]]).max() < 1.0


def test_a_state_from_a_time_that_is_to_come_is_gone_on_from_as_after_a_jump_of_the_clock():
    """Of a simulation that began anew the gate stayed closed as long as the one before had run, and a load that is
    taken off was missing in the samples as measured."""
    samples, stage, again = motion(200), *(Stage(SETTINGS, InlineBackground()) for _ in range(2))
    stage.offer(samples[:150])
    gate, applied, newest = stage.learner.gate, stage.learner.changes.applied, samples[149].stamp
    gate.closed, gate._closed_since, gate._calm_since = True, newest, newest
    applied.offer(1, effect_from_text('sensor_offset'), np.ones(6), np.ones(6), newest)
    applied.switch(applied.trials[0], newest)
    for delay in (0.0, -3600.0):
        again.learner.restore(pickle.loads(pickle.dumps(stage.learner.state())))
        again.offer(later(samples[150:151], delay))
        assert again.learner.gate.closed == (delay == 0.0)
        (taken_off,) = again.learner.changes.applied.contributions
        assert (taken_off.effect.span.start_stamp_s is None) == (delay < 0.0)


def test_history_keeps_the_first_and_the_latest():
    history, samples = History(5, 10, 2), motion(40)
    for sample in samples:
        history.append(sample, True)
    batch = history.batch()
    kept = [*samples[:5], *samples[30:]]
    assert batch.samples.stamps.tolist() == [sample.stamp for sample in kept]
    np.testing.assert_array_equal(batch.samples.outputs, [sample.outputs for sample in kept])
    assert history.latest().stamp == samples[-1].stamp
    assert len(history.span(0.08)) == 5


def test_a_history_of_a_fast_robot_keeps_the_window_also_from_a_file():
    """Ten samples, one of each step, and those between them."""
    history, again = History(10, 5, 2), History(10, 5, 2)
    for sample in at_period(motion(100), 1_000_000):
        history.append(sample, Learning.YES)
    again.refill(pickle.loads(pickle.dumps(history.batch())))
    for each in (history, again):
        assert each.batch().stamps.tolist() == [number * 1_000_000 for number in (*range(37), *range(95, 100))]
        assert len(each._window) == 37


@pytest.mark.parametrize('works', [False, True])
def test_what_a_history_lets_go_of_hours_is_no_jump_of_the_clock(works):
    """A model that is built from it counts time as the one does that has seen every sample."""
    samples, minute = motion(400), 60.0
    hours = later(samples[:200], 0.0)
    for number in range(200, 390):  # three hours of one sample a minute, of work or of rest
        chosen = samples[number if works else 199]
        stamp = samples[199].stamp + round((number - 199) * minute * 1e9)
        hours.append(chosen._replace(stamp=stamp))
    hours += later(samples[390:], 190 * minute)
    live, history = build_estimator(replace(SETTINGS, variant='P')), History(40, 60, 2)
    for sample in hours:
        prediction = live.predict(sample)
        live.observe(prediction, prediction.motion.is_news)
        is_news = prediction.motion.is_news
        history.append(sample, Learning.YES if is_news else Learning.NO_NEWS)
    assert len(history) < 140
    bridged = history._bridge._chunks
    assert all(len(rows.values.base) == 1 for rows in bridged), 'each kept a chunk: 21 MB a day'
    again = History(40, 60, 2)
    again.refill(pickle.loads(pickle.dumps(history.batch())))
    for each in (history, again):
        rebuilt = model_jobs.build(replace(SETTINGS, variant='P'), BODY, each.batch(), None, each.origin)
        assert rebuilt.origin == live.origin == samples[0].stamp


def values_of(batch):
    return [(sample.stamp, learnt, *np.concatenate(sample[1:]).tolist()) for sample, learnt in batch.pairs()]


@pytest.mark.parametrize('chunk', [1, 7, 1000])
def test_what_a_history_hands_over_stays_as_it_is(chunk, monkeypatch):
    """Nothing is copied, so nothing may be overwritten while samples go on coming."""
    monkeypatch.setattr('semiparam_ros.online.history.CHUNK', chunk)
    rng, samples, history = np.random.default_rng(chunk), motion(200), History(10, 50, 2)
    learnt, given, pairs = rng.random(200) < 0.7, [], []
    for index, sample in enumerate(samples):
        history.append(sample, bool(learnt[index]))
        if index in (3, 40, 120):
            given.append(history.batch())
            pairs.append(values_of(given[-1]))
    first = int(np.flatnonzero(np.cumsum(learnt) == 10)[0]) + 1
    expected = [*range(first), *range(150, 200)]
    assert [sample.stamp for sample, _ in history.batch().pairs()] == [samples[k].stamp for k in expected]
    assert history.batch().learnt.tolist() == learnt[expected].tolist()
    for batch, before in zip(given, pairs, strict=True):
        assert values_of(batch) == before
        again = History(10, 50, 2)
        again.refill(pickle.loads(pickle.dumps(batch)))
        assert values_of(again.batch()) == before
        again.append(samples[199], True)
        assert values_of(again.batch())[:4] == before[:4] and again.latest().stamp == samples[199].stamp
        assert again._learnt == batch.learnt.sum() + 1 and again.origin == samples[0].stamp
        thin = batch.part(2, len(batch) - 1, 3)
        assert thin.stamps.tolist() == batch.stamps[2:-1:3].tolist() and len(thin) == len(thin.learnt)
        np.testing.assert_array_equal(thin.samples.outputs, batch.samples.outputs[2:-1:3])


def test_the_clock_has_jumped_when_several_messages_agree():
    def went_back(topic, stamp, name):
        return [held.frame_id for _, held in watch.refused(topic, Reading(stamp, name, ()))]

    watch = ClockWatch()
    assert not went_back('wrench', 10, 'w1')
    watch.accepted('wrench')
    assert not went_back('wrench', 10, 'w2')
    assert not went_back('joint_states', 10, 'j1')
    assert not went_back('wrench', 5, 'w3'), 'not later than the one before: no clock'
    for stamp in (6, 7, 8):
        assert not went_back('wrench', stamp, f'w{stamp}')
    assert went_back('wrench', 9, 'w9') == ['j1', 'w3', 'w6', 'w7', 'w8', 'w9']


def test_joints_that_stand_still_are_named_and_the_conditioning_tells_so():
    moving, excitation = motion(200), Excitation(('a', 'b'))
    assert excitation.sentences() == []
    still = [sample._replace(position=sample.position * [1, 0], velocity=sample.velocity * [1, 0],
                             acceleration=sample.acceleration * [1, 0]) for sample in moving]
    for sample in still:
        excitation.add(sample)
    assert excitation.sentences() == [
        'joint b has moved 0.000 rad only, not enough to identify what depends on it']
    assert ' 0.000 m only' in excitation.sentences(prismatic={'b'})[0]
    found = []
    for samples in (moving, still):
        estimator = Estimator(BODY, model_options(replace(SETTINGS, variant='P')))
        for sample in samples:
            estimator.step(sample)
        found.append(conditioning(estimator.model, estimator.columns.prior_scale))
    assert found[1].undetermined > found[0].undetermined


def test_what_the_hand_carries_is_found():
    settings = replace(SETTINGS, variant='P')
    heavy = build_rigid_body(replace(settings, robot_description=URDF.replace('mass value="0.5"', 'mass value="0.9"')))
    estimator = build_estimator(settings)
    for sample in motion(400):
        row = (sample.position, sample.velocity, sample.acceleration)
        outputs = heavy.regressor(*row) @ heavy.base_parameters
        estimator.step(sample._replace(outputs=outputs + 1e-3 * np.random.default_rng(0).standard_normal(6)))
    carried = reported_load(*carried_load(estimator))
    assert carried.link == 'ft' and carried.mass == pytest.approx(0.4, rel=0.02)
    np.testing.assert_allclose(carried.centre, [0.02, 0.0, 0.1], atol=0.01)
    assert abs(carried.mass - 0.4) < 4 * carried.std.mass < 0.1
    assert (abs(carried.centre - [0.02, 0.0, 0.1]) < 4 * carried.std.centre).all()


def test_friction_rotors_and_offsets_have_the_names_of_their_joints():
    settings = Settings(joints=ICUB_JOINTS, outputs='effort', variant='P', initial_samples=100,
                        robot_description=ICUB_OWN.read_text())
    body, estimator = build_rigid_body(settings), build_estimator(settings)
    exact = smooth_motion(4, 150)
    for sample in replace(exact, outputs=body.regressors(exact) @ body.base_parameters + 0.2 * exact.velocity):
        estimator.step(sample)
    named, blocks = [(each.name, each.unit) for each in quantities(estimator)], estimator.columns.blocks
    assert named[blocks['friction']][:4] == [(f'viscous@{joint}', 'N m s/rad') for joint in ICUB_JOINTS]
    assert named[blocks['rotor']] == [(f'rotor@{joint}', 'kg m^2') for joint in ICUB_JOINTS]
    assert named[blocks['offset']] == [(f'offset_{joint}', 'N m') for joint in ICUB_JOINTS]


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('joint_friction', [False, True])
def test_what_the_hand_carries_is_as_unsure_as_the_description_is_wrong_elsewhere(joint_friction, seed):
    """Links heavier by 15 % and a load of 0.4 kg were told as a load that was off by 60 standard deviations, with some
    motions also once what no load explains was taken into account as the likeliest."""
    settings = Settings(joints=ICUB_JOINTS, outputs='effort', variant='P', initial_samples=100,
                        robot_description=ICUB_OWN.read_text(), joint_friction=joint_friction)
    body, exact = build_rigid_body(settings), smooth_motion(4, 300, seed=seed)
    load = np.array([0.4, 0.01, -0.01, 0.02, 4e-3, 0.0, 4e-3, 0.0, 0.0, 3e-3])
    told = []
    for heavier in (1.0, 1.15):
        outputs = body.regressors(exact) @ (heavier * body.base_parameters + load_in_base(body, 'r_gripper', load))
        outputs += 0.01 * np.random.default_rng(0).standard_normal(outputs.shape)
        estimator = build_estimator(settings)
        for sample in replace(exact, outputs=outputs):
            estimator.step(sample)
        told.append(reported_load(*carried_load(estimator)))
    assert [each.link for each in told] == ['r_gripper'] * 2
    errors = np.array([told[0].mass - 0.4, told[1].mass - 0.4 - 0.15 * body.inertial_parameters[-10]])
    assert (abs(errors) < 4 * np.array([each.std.mass for each in told])).all()
    if not joint_friction and not seed:  # where rotors may be, the samples tell less of the description
        assert told[0].std.mass < 0.01


@pytest.mark.parametrize('variant', ['SP-ML', 'SP2-VS'])
def test_a_rigid_body_that_stays_as_the_window_left_it_tells_of_no_load(variant):
    estimator = build_estimator(replace(SETTINGS, variant=variant))
    for sample in motion(200):
        estimator.step(sample)
    assert estimator.ready and carried_load(estimator) is None


def test_two_loads_on_a_link_are_known_as_well_as_their_sum():
    """The first was there for a moment alone, so each by itself is hardly known."""
    texts = 'payload@ft{"start_s": 3.0}', 'payload@ft{"start_s": 3.1}'
    estimator = build_estimator(replace(SETTINGS, variant='P', effects=texts))
    for sample in motion(400):
        estimator.step(sample)
    places = [estimator.columns.blocks[name].start for name in ('0', '1')]
    both = estimator.model.recursion.theta_covariance()[np.ix_(places, places)]
    found = carried_load(estimator)
    assert found.covariance[0, 0] == pytest.approx(both.sum(), rel=1e-9)
    assert both.sum() < 0.5 * np.trace(both), 'which it said'
    assert found.parameters[0] == pytest.approx(estimator.model.theta[places].sum(), abs=1e-12)


def test_a_payload_is_a_body_or_not_told_and_nothing_is_told_before_there_is_a_model():
    estimator = build_estimator(replace(SETTINGS, variant='P', effects=('payload@ft{"start_s": 0.0}',)))
    for sample in motion(30):
        estimator.step(sample)
    assert carried_load(estimator) is None, 'the initial window is not over'
    load = np.r_[0.5, 0.5 * np.array([0.1, 0.0, 0.2]), 0.03, 0.0, 0.032, -0.01, 0.0, 0.01]
    body = reported_load('ft', load, 1e-8 * np.eye(10))
    assert np.isfinite(body.inertia).all() and np.linalg.eigvalsh(body.inertia)[0] > 0.0
    np.testing.assert_allclose(body.std.mass, 1e-4)
    np.testing.assert_allclose(body.std.centre, 1e-4 / 0.5 * np.sqrt(1.0 + body.centre**2), rtol=1e-3)
    none = reported_load('ft', load * np.r_[np.ones(4), np.zeros(6)], 1e-8 * np.eye(10))
    assert np.isnan(none.inertia).all() and np.isfinite(none.centre).all()
    nothing = reported_load('ft', load, np.eye(10))
    assert nothing.mass == 0.5 and nothing.std.mass == 1.0 and np.isnan(nothing.centre).all()


PINNED = []


def use_memory():
    """What glibc keeps to itself: arrays that lie between others that stay."""
    del [np.ones(4_000_000)][:]  # from now on arrays of that size lie in the heap
    arrays = [np.ones(1_000_000) for _ in range(30)]
    PINNED.append(np.ones(1_000_000))
    del arrays


def resident_mb():
    return int(Path('/proc/self/statm').read_text().split()[1]) * os.sysconf('SC_PAGESIZE') / 1e6


def test_a_process_runs_jobs_hands_back_results_and_is_replaced_when_it_dies(tmp_path):
    background = ServedProcess()

    def run(function, *arguments):
        background.begin(function, *arguments)
        return background.results_of(1).pop()

    assert run(max, 1, 3) == (3, None)
    assert run(os.getpid)[0] != os.getpid()
    assert isinstance(run(int, 'x')[1], ValueError)
    before, _ = run(resident_mb)
    assert run(use_memory)[1] is None
    assert run(resident_mb)[0] - before < 100.0, 'what a job used is given back'
    process, _ = run(os.getpid)
    pointless = background.begin(work_for_ever, tmp_path / 'begun')
    wait_for(tmp_path / 'begun')
    pointless.cancel()
    assert run(os.getpid) == (process, None)
    # One that is cancelled before the process has begun with it is given up all the same, and what waits comes next.
    background.begin(work_for_ever, tmp_path / 'again').cancel()
    assert run(os.getpid) == (process, None)
    assert 'died 2 times' in str(run(os._exit, 1)[1])
    assert run(max, 4, 5) == (5, None)
    background.close()


def test_where_no_process_can_be_begun_each_job_is_told_so(monkeypatch):
    """The thread that begins them ended, and whoever asked for anything from then on waited for ever."""
    def refuse():
        raise BlockingIOError(11, 'Resource temporarily unavailable')

    monkeypatch.setattr(worker, '_spawned_worker', refuse)
    background = ServedProcess()
    for number in range(2):
        background.begin(max, 1, 2)
        background.results_of(number + 1)
    background.close()
    told = 'no process can be begun beside the node ([Errno 11] Resource temporarily unavailable).'
    assert [(result, str(error)) for result, error in background.results] == [(None, told)] * 2


def test_a_job_whose_process_is_killed_runs_again_and_those_behind_it_run_once(tmp_path):
    background = ServedProcess(still_s=3.0)
    for name in ('killed', 'second', 'dropped', 'stopped', 'killed while it sends', 'third'):
        job = background.begin(append_and_perhaps_die, tmp_path / name)
        if name == 'dropped':
            job.cancel()
            dropped = weakref.ref(job)
    while dropped() is not None:  # what it holds is free as soon as the next one comes
        time.sleep(0.01)  # unless the thread of the background is just looking through what waits
    results = background.results_of(5)
    background.close()
    runs = {'killed': 2, 'second': 1, 'stopped': 2, 'killed while it sends': 2, 'third': 1}
    assert results == [(name, None) for name in runs]
    assert {path.name: len(path.read_text()) for path in tmp_path.iterdir()} == runs


@pytest.mark.parametrize('stopped', [False, True])
def test_who_ends_waits_for_no_job(tmp_path, stopped):
    """A node that built a model ended after five seconds."""
    background, results = ProcessBackground(lambda *task: None), []
    for name in ('running', 'waiting'):
        background.submit(work_for_ever, tmp_path / name, done=lambda *result: results.append(result))
    wait_for(tmp_path / 'running')
    process = background._process
    if stopped:
        os.kill(process.pid, signal.SIGSTOP)
    background.close()
    assert not process.is_alive() and not results and not (tmp_path / 'waiting').exists()


def test_what_is_urgent_interrupts_what_is_not_which_begins_anew(tmp_path):
    background = ServedProcess()
    background.begin(wait_until_there, tmp_path / 'begun', tmp_path / 'go on')
    background.begin(max, 1, 2)
    wait_for(tmp_path / 'begun')
    (tmp_path / 'begun').unlink()
    background.begin(max, 7, 8, urgency=Urgency.ASKED)
    assert not wait_for(tmp_path / 'begun', seconds=0.3), 'who asks comes next, and interrupts nothing'
    background.begin(max, 3, 4).urgency = Urgency.TAKES_OVER  # a shadow that succeeds before it is built
    background.begin(max, 5, 6, urgency=Urgency.TAKES_OVER)
    background.results_of(3)
    wait_for(tmp_path / 'begun')
    (tmp_path / 'go on').touch()
    results = background.results_of(5)
    background.close()
    assert results == [(result, None) for result in (4, 6, 8, 'done', 2)]


def test_what_is_interrupted_while_it_imports_can_be_done_later(tmp_path, monkeypatch):
    """Half of scipy.ndimage stayed in the process: every later diagnosis was an internal error."""
    package = tmp_path / 'slowly'
    package.mkdir()
    (package / 'part.py').touch()
    (package / '__init__.py').write_text(IMPORTED.format(begun=tmp_path / 'begun'))
    monkeypatch.syspath_prepend(tmp_path)
    background = ServedProcess()
    cancelled = background.begin(import_and_name, 'slowly', urgency=Urgency.ASKED)
    wait_for(tmp_path / 'begun')
    cancelled.cancel()
    background.begin(import_and_name, 'slowly', urgency=Urgency.ASKED)
    results = background.results_of(1)
    background.close()
    assert results == [('slowly', None)]


IMPORTED = """
from .part import *
import pathlib, time
pathlib.Path('{begun}').touch()
time.sleep(0.5)
del part
"""


def import_and_name(name):
    """In the background process."""
    return importlib.import_module(name).__name__


def test_a_process_that_is_still_loading_does_not_die_of_a_job_that_is_to_give_way():
    process, line = _spawned_worker()
    os.kill(process.pid, signal.SIGUSR1)
    transport.send(line, (max, (1, 3)))
    assert transport.receive(line).result == 3
    process.kill()
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, []), 'programs of later tests would not hear of Ctrl-C'


def wait_for(path, seconds=np.inf):
    """Whether a file comes in that time; without one, where a process of low priority has still to load, pytest's own
    limit is enough."""
    end = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.01)
    return path.exists()


SHARED = """
import os, time
from semiparam_ros.online.diagnosis_jobs import processor_share
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
busy = os.fork()
while not busy:
    pass
time.sleep(0.1)
print(processor_share())
os.kill(busy, 9)
"""


def test_a_diagnosis_looks_at_as_many_samples_as_its_share_of_a_processor_allows():
    shared = subprocess.run([sys.executable, '-c', SHARED], capture_output=True, text=True, check=True)
    assert 0.0 < float(shared.stdout) < 0.75, 'another one has half of it'
    batch = batch_of((sample._replace(stamp=number), True) for number, sample in enumerate(motion(500) * 25))
    looked = {share: diagnosis_jobs.thinned(batch, share) for share in (1.0, 0.5, 0.25, 0.1, 0.01)}
    assert [len(part) for part in looked.values()] == [4167, 2500, 1250, 1042, 1042]
    for part in looked.values():
        assert len(set(np.diff(part.stamps))) == 1, 'no gap of its own making'
    for count in (7, 1500):
        assert len(diagnosis_jobs.thinned(batch.part(0, count), 0.1)) == count


def test_stamps_of_a_wrong_clock_are_told_as_they_came():
    """Of samples that were thinned by two the period to convert by was said to be twice what it is."""
    batch = batch_of((sample._replace(stamp=number * PERIOD_NS // 4), True)
                     for number, sample in enumerate(motion(2500)))
    for share in (1.0, 0.1):
        looked = diagnosis_jobs.thinned(batch, share)
        assert looked.every == (1 if share == 1.0 else 2)
        (told,) = diagnosis_jobs.setup_problems(BODY, looked, (), (), ()).values()
        assert told.startswith('The stamps are 0.005 s apart, but positions and velocities agree with 0.02'), told


def test_gaps_are_told_where_the_robot_rested_and_none_of_thinning():
    """Of a rest a history keeps its last samples alone."""
    moving, history = motion(3000), History(60, 60_000, 2)
    for number, sample in enumerate(moving):
        if number == 1500:
            for rest in range(500):
                later = sample._replace(stamp=sample.stamp + rest * PERIOD_NS)
                history.append(later, Learning.NO_NEWS)
        history.append(sample._replace(stamp=sample.stamp + (number >= 1500) * 500 * PERIOD_NS), True)
    batch = history.span(300.0)
    for share in (1.0, 0.1):
        samples = diagnosis_jobs.thinned(batch, share).samples
        (told,) = [note for note in unidentifiable(BODY, samples) if 'gap' in note]
        assert told.startswith('The samples looked at have 1 gap in time, namely 9.'), told


def test_how_long_a_diagnosis_takes_yet_follows_what_it_gets():
    expected = diagnosis_jobs.expected_s(5000)
    assert diagnosis_jobs.left_s(5000, 20.0, 5.0) == pytest.approx(4.0 * (expected - 5.0))
    assert diagnosis_jobs.left_s(5000, 200.0, 50.0) == pytest.approx(diagnosis_jobs.LINGERS * 200.0)
    assert diagnosis_jobs.left_s(5000, 0.0, 0.0) == 0.0


def wait_until_there(begun, there):
    """In the background process."""
    begun.touch()
    return wait_for(there) and 'done'


def work_for_ever(path):
    """In the background process."""
    path.touch()
    while True:
        time.sleep(0.01)


def append_and_perhaps_die(path):
    """In the background process: leave a mark of each run; in the first one die as by the system's hand, or stop."""
    with path.open('a') as stream:
        stream.write('x')
    if len(path.read_text()) == 1:
        if path.name == 'killed while it sends':
            half = struct.pack('!i', 1000) + b'half a result'
            os.write(sys._getframe(2).f_locals['line'].fileno(), half)
        if path.name.startswith('killed'):
            os.kill(os.getpid(), signal.SIGKILL)
        if path.name == 'stopped':
            os.kill(os.getpid(), signal.SIGSTOP)
    return path.name


def test_only_a_change_of_the_model_tells_of_the_model_that_is_being_built():
    """Pausing meanwhile was answered by that, and said to have failed where the model could not be built."""
    stage = Stage(replace(SETTINGS, variant='P'))
    stage.offer_and_build(motion(200))
    wanted = replace(SETTINGS, variant='NP-ML')
    assert 'is being built' in stage.learner.change(wanted)
    assert stage.learner.change(replace(wanted, learning=False)) == ''


def test_a_tare_long_after_the_last_sample_is_refused(monkeypatch):
    """It took the residuals of the last second before the sensor fell silent, an hour ago."""
    tare = Tare(6)
    tare.add(0, np.ones(6), True)
    now = time.monotonic()
    monkeypatch.setattr(time, 'monotonic', lambda: now + 3600.0)
    with pytest.raises(SemiparamError, match='samples must come'):
        tare.take()
    assert not tare.active
