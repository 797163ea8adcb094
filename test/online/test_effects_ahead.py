"""What is applied goes, and comes again, sample by sample, before it is told that it does."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.samples import Samples
from semiparam_ros.effects import effect_from_text
from semiparam_ros.online.applied_effects import AppliedEffects, as_measured
from semiparam_ros.online.contact_gate import UNSEEN_S
from semiparam_ros.online.identified_parameters import Load
from support.changing_arm import LOADED_S, free, loaded, offered, pushed

pytestmark = pytest.mark.usefixtures('motion_as_recorded')
BIAS = np.arange(1.0, 7.0)
ONES = np.ones(6)
FREE_S = 50.0


def known(samples, *, is_there):
    """An offset that is applied, or was, and what is left of a sample by the model without it."""
    body = free()[0]
    applied = AppliedEffects(body)
    applied.offer(1, effect_from_text('sensor_offset'), BIAS, np.zeros(6), 0)
    for ago_s in (20,) if is_there else (20, 0):
        applied.switch(applied.trials[0], int(samples.stamps[0]) - ago_s * 10**9)
    return applied


def fed(applied, samples, left, weight=ONES, applies=True):
    """Samples as they are learnt; ``left`` (n,) is what the model leaves without what is applied."""
    learnt = []
    for sample in list(samples):
        learnt.append(applied.taken_off(sample)[0])
        applied.compare(left, weight, applies)
    return Samples.from_list(learnt)


@pytest.mark.parametrize('is_there', [True, False])
def test_it_goes_and_comes_as_soon_as_samples_say_so_and_only_then(is_there):
    samples = free()[1][:200]
    applied = known(samples, is_there=is_there)
    (trial,) = applied.trials
    fed(applied, samples[1:100], 0.6 * (-BIAS if is_there else BIAS))
    assert trial.acting == is_there, 'less than two thirds of it'
    otherwise = fed(applied, samples[100:140], -BIAS if is_there else BIAS)
    assert (trial.acting, trial.applied) == (not is_there, is_there), 'nothing is told'
    assert applied.ahead.tolist() == [-1.0 if is_there else 1.0]
    np.testing.assert_allclose(otherwise.outputs[-1] + applied.taken_ahead, samples.outputs[139] - is_there * BIAS)
    fed(applied, samples[140:180], 0.0 * BIAS)
    assert trial.acting == is_there, 'what pushed is over'


def test_what_is_unusually_noisy_is_weighed_less():
    samples = free()[1][:40]
    applied = known(samples, is_there=True)
    fed(applied, samples[1:40], -BIAS, weight=0.01 * ONES)
    assert applied.trials[0].acting


def test_nothing_goes_ahead_beside_a_load_that_has_no_name_yet():
    """Its innovations are those of the load."""
    samples = free()[1][:80]
    applied = known(samples, is_there=True)
    applied.assume(Load('r_gripper', np.eye(10)[0], np.eye(10)))
    fed(applied, samples[1:80], -BIAS)
    assert applied.trials[0].acting


def test_where_one_goes_the_evidence_of_all_begins_anew():
    samples = free()[1][:60]
    applied = known(samples, is_there=True)
    applied.offer(2, effect_from_text('sensor_offset'), 0.8 * BIAS, np.zeros(6), 0)
    applied.switch(applied.trials[1], int(samples.stamps[0]))
    one, other = applied.trials
    while one.acting and other.acting:
        fed(applied, samples[:1], -BIAS)
        samples = samples[1:]
    assert one.otherwise.nats == other.otherwise.nats == 0.0


def test_nothing_comes_again_where_nothing_is_applied_by_itself_but_what_is_there_goes():
    samples = free()[1][:80]
    for is_there in (True, False):
        applied = known(samples, is_there=is_there)
        fed(applied, samples[1:80], -BIAS if is_there else BIAS, applies=False)
        assert not applied.trials[0].acting


@pytest.mark.parametrize('is_there', [True, False])
def test_a_state_a_jump_of_the_clock_and_what_is_told_go_on_with_what_is_applied(is_there):
    samples = free()[1][:80]
    for settled in ('state', 'reset', 'settle', 'dropped', 'switch', 'named anew'):
        applied = known(samples, is_there=is_there)
        fed(applied, samples[1:60], -BIAS if is_there else BIAS)
        assert applied.ahead.any()
        if settled == 'state':
            applied, before = AppliedEffects(free()[0]), applied
            applied.restore(before.state())
        elif settled == 'reset':
            applied.reset()
        elif settled == 'settle':
            applied.settle()
        elif settled == 'dropped':
            applied.drop(1)
        elif settled == 'named anew':
            applied.offer(1, effect_from_text('sensor_offset'), 2.0 * BIAS, np.zeros(6), int(samples.stamps[59]))
        else:
            applied.switch(applied.trials[0], int(samples.stamps[59]))
        assert settled in ('dropped', 'named anew') or not applied.ahead.any()
        off = fed(applied, samples[60:70], 0.0 * BIAS)
        again = as_measured(free()[0], off, applied.contributions)
        np.testing.assert_allclose(again.outputs, samples.outputs[60:70], atol=1e-9, err_msg=settled)


def test_a_load_that_is_put_down_is_not_predicted_any_more_long_before_that_is_told():
    body, samples, _ = loaded()
    until = samples[samples.time < LOADED_S[1] + 0.4]
    stage = offered(body, until, diagnosis_auto='apply')
    applied = stage.learner.changes.applied
    (trial,) = applied.trials
    assert (trial.applied, trial.acting) == (True, False)
    ended = [effect.span.end_stamp_s for effect, *_ in applied.contributions if effect.is_load][-1]
    assert 0.0 < ended - samples.origin * 1e-9 - LOADED_S[1] < 0.2
    assert stage.learner.changes.state != 'as it was' and stage.changes[-1].change.ended is None
    measured = as_measured(body, stage.learner.history.batch().samples, applied.contributions)
    np.testing.assert_allclose(measured.outputs, until.outputs[-len(measured):], atol=1e-6)
    for goes_on in (stage.learner.changes._learn, stage.learner.changes.forget):
        trial.acting = False
        goes_on()
        assert trial.acting, 'what is learnt as the robot, or by another model, is without what is applied and no other'


def test_a_load_is_not_taken_off_twice():
    """A load that is known may be what stands out, while one that has no name is followed as well."""
    body, samples, _ = loaded()
    watch = offered(body, samples[samples.time < LOADED_S[0] + 4.0], diagnosis_auto='apply').learner.changes
    assert watch.applied.provisional is not None
    watch.applied.offer(99, effect_from_text('payload@r_gripper'), np.eye(10)[0], np.zeros(10), 0)
    watch.applied.trials[-1].acting = True
    watch._assume(watch.detector)
    assert watch.applied.provisional is None


def test_samples_are_charged_alike_in_motion_never_seen():
    """An arm that is thrown about by what it does not carry any more is in such motion."""
    body, samples, _ = loaded()
    stage = offered(body, samples[samples.time < FREE_S], diagnosis_auto='apply')
    estimator, detector = stage.learner.estimator, stage.learner.changes.detector
    sample = samples[len(stage.answers)]
    part = estimator.rigid_body_part(estimator.predict(sample, sample.outputs))
    weighed, moments = [], []
    for familiar_s, usual in ((0.0, 1.0), (UNSEEN_S, 1.0), (UNSEEN_S, 2.0)):
        each = deepcopy(detector)
        each._familiar, each._usual_size = familiar_s, usual * detector._usual_size
        each.see(*part)
        weighed.append(each.weighed)
        moments.append(each._sums.moment - detector._sums.moment)
    np.testing.assert_array_equal(*weighed[:2])
    np.testing.assert_allclose(weighed[2], 0.5 * np.array(weighed[1]))
    assert np.linalg.norm(moments[0]) < 0.5 * np.linalg.norm(moments[1])


def test_a_hand_that_pushes_like_a_load_is_no_load():
    """It is predicted while it lasts, and neither told nor learnt."""
    body, samples, mass = loaded()
    hand = pushed(start=108.0, force=(0.0, 0.0, -9.81 * mass))[1]
    both = replace(samples, outputs=samples.outputs + hand.outputs - free()[1].outputs)
    stage = offered(body, both[both.time < 118.0], diagnosis_auto='apply', gate_enabled=True)
    spans = [(effect.span.start_stamp_s - samples.origin * 1e-9, effect.span.end_stamp_s - samples.origin * 1e-9)
             for effect, *_ in stage.learner.changes.applied.contributions if effect.is_load]
    assert any(107.9 < begin < 108.5 and end < 113.6 for begin, end in spans)
    at = np.flatnonzero((both.time > 109.0) & (both.time < 112.0))
    weight = np.linalg.norm(hand.outputs[at, :3] - free()[1].outputs[at, :3], axis=1)
    told = [stage.answers[index] for index in at]
    assert np.mean([answer.contact_level[:3].max() for answer in told]) > 1.0, 'the gate sees its force'
    outside = np.array([np.linalg.norm((answer.residual + answer.followed)[:3]) for answer in told])
    assert abs(outside.mean() - weight.mean()) < 0.05 * weight.mean(), 'it acts from outside'
    within = np.array([np.linalg.norm(answer.residual[:3]) for answer in told])
    assert within.mean() < 0.3 * weight.mean(), 'it is predicted'
    assert len(stage.learner.changes.records) == 1
    assert stage.learner.changes.state == 'as it was'
