"""Hyperparameters are estimated again when later motion leaves the window that they are from."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.samples import Sample
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online.history import batch_of
from semiparam_ros.online.learning import Learning, directions_of
from semiparam_ros.online.model_jobs import known_of, new_estimator, renew
from semiparam_ros.online.model_switcher import same_model
from semiparam_ros.online.renewal import Errors, RecentWindow, later_window
from semiparam_ros.online.worker import Urgency
from support.learner_stage import Stage
from support.node_helpers import BODY, SETTINGS, InlineBackground, ServedProcess, at_period, faster, motion

TAKEOVER_AFTER = 15


SLOWER = replace(SETTINGS, initial_samples=100)
SAMPLES = motion(550)
DAY = [*faster(SAMPLES[:200], 0.15), *SAMPLES[200:]]


def renewals(stage):
    return sum('estimated again' in sentence for sentence in stage.news)


def assert_as_offline(stage, day, windows=1):
    offline = OfflineLearner(stage.learner.built, [], lambda: None, stage.learner.takeovers)
    steps = [offline.step(sample, True) for sample in day]
    assert offline.learner.renewals == windows
    np.testing.assert_allclose(stage.means, [step.mean for step in steps], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('variant', ['SPK-ML', 'NP-ML', pytest.param('SP2-ML', marks=pytest.mark.long)])
def test_once_where_motion_becomes_faster_and_live_as_offline(variant, monkeypatch):
    monkeypatch.setattr('semiparam_ros.online.renewal.LEAST_DRAFT', 1)
    stage, waited, scales = Stage(replace(SLOWER, variant=variant)), 0, []
    for sample in DAY:
        stage.offer([sample])
        if stage.background.jobs:
            waited += 1
            if waited > TAKEOVER_AFTER:
                stage.background.run(1)
                waited = 0
        if stage.learner.estimator.ready:
            scales.append(stage.learner.estimator.input_scaling[1])
    assert 'has new hyperparameters and takes over' in stage.news[-1]
    assert (scales[-1] > 3.0 * scales[0])[2:].all()
    assert 'a draft of its hyperparameters' in stage.news[1]
    drafted, first, *later = stage.learner.takeovers
    assert 0 < drafted < first and 3 <= len(later) == 1 + renewals(stage) <= 4 and min(later) > 0
    assert_as_offline(stage, DAY)


def test_the_process_gives_a_draft_before_the_window(monkeypatch):
    monkeypatch.setattr('semiparam_ros.online.renewal.LEAST_DRAFT', 1)
    stage, start = Stage(SLOWER, ServedProcess()), 0
    for takeovers, end in enumerate((100, 110, 130)):
        stage.background.serve(lambda so_many=takeovers: len(stage.learner.takeovers) >= so_many)
        stage.offer(SAMPLES[start:end])
        start = end
    stage.background.close()
    assert stage.learner.takeovers == [0, 10] and not stage.failures
    assert 'with a draft of its hyperparameters' in stage.news[1] and 'has its hyperparameters' in stage.news[2]
    assert_as_offline(stage, SAMPLES[:130], windows=0)


def test_a_draft_does_not_wait_for_what_it_makes_pointless(monkeypatch):
    """The hyperparameters of slow motion are still being estimated when fast motion has come."""
    monkeypatch.setattr('semiparam_ros.online.renewal.LEAST_DRAFT', 1)
    stage = Stage(SLOWER)
    stage.offer(DAY[:105])
    stage.background.run(1)
    for sample in DAY[105:]:
        stage.offer([sample])
        if len(stage.learner.takeovers) > 1:
            stage.background.run()
    told = ' | '.join(stage.news)
    assert 'goes on with a draft' in told and 'has its hyperparameters' not in told and 'has new' in told
    assert stage.learner.takeovers[:3] == [5, 140, 0]
    assert_as_offline(stage, DAY)


def test_a_draft_does_not_wait_where_a_whole_window_must(monkeypatch):
    """Motion leaves the second window after ten samples: a draft of the next 52, and the third window 200 later."""
    monkeypatch.setattr('semiparam_ros.online.renewal.LEAST_DRAFT', 1)
    slowest, slow, fast = (faster(SAMPLES[part], speed) for part, speed in (
        (slice(0, 120), 0.02), (slice(120, 230), 0.15), (slice(230, 550), 1.0)))
    stage, seen = Stage(SLOWER, InlineBackground()), []
    for sample in [*slowest, *slow, *fast]:
        stage.offer([sample])
        seen.append(len(stage.news))
    at = [int(np.searchsorted(seen, count + 1)) + 1 for count in range(len(stage.news))]
    drafts = [place for place, sentence in zip(at, stage.news, strict=True) if 'goes on with a draft' in sentence]
    windows = [place for place, sentence in zip(at, stage.news, strict=True) if 'has new' in sentence]
    assert windows[0] == 221 and 282 in drafts and windows[1] > windows[0] + 200


@pytest.mark.parametrize('effects', [(), ('sensor_drift',)])
@pytest.mark.parametrize(('draft', 'every', 'changed', 'fate', 'returned'), [
    (False, 5, 0, Learning.YES, 0), (True, 23, 0, Learning.YES, 0), (False, 5, 60, Learning.AFTER_CHANGE, 0),
    (True, 17, 60, Learning.AFTER_CHANGE, 0), (False, 5, 60, Learning.AFTER_LOAD, 0),
    (False, 5, 60, Learning.AFTER_FRICTION, 0), (False, 5, 60, Learning.AFTER_LOAD, 150),
    (False, 5, 60, Learning.AFTER_LOAD, 260), (True, 8, 60, Learning.AFTER_LOAD, 150)])
def test_older_motion_does_not_outvote_the_window_nor_delay_its_draft(draft, every, changed, fate, returned,
                                                                      effects, monkeypatch):
    """Of what was learnt before it, a fifth is learnt again; of a draft at most so many, however long the life. Of a
    robot that has changed since it is kept apart, to return to: a load was put down, and nothing was left of that."""
    monkeypatch.setattr('semiparam_ros.online.model_jobs.OLDER_OF_DRAFT', 10)
    pairs = [(sample, fate if changed and number == changed else Learning.YES)
             for number, sample in enumerate(DAY[:330])]
    if returned:
        pairs[returned] = DAY[returned], Learning.RETURNED
    settings = replace(SLOWER, effects=effects)
    renewed = renew(settings, BODY, batch_of(pairs), DAY[0].stamp, RecentWindow(100, draft=draft))
    expected = new_estimator(settings, BODY, known_of(renewed), DAY[0].stamp)
    window = 230 - (returned > 230)  # of 100 that are learnt
    last = returned if 0 < returned < window else changed
    first = max(5, last // 10) if draft else 5
    for number, (sample, _) in enumerate(pairs):
        if number == changed > 0:
            expected.follow_change(directions_of(fate, expected.columns))
        begin, step = (last, every) if number >= last else (0, first)
        learnt = number >= window or (number - begin) % step == 0 or number == changed
        if number == returned > 0:
            expected.observe(expected.predict(sample), False, follow=number >= window)
            expected.go_back()
        elif learnt or effects:  # they may remember what is not learnt
            expected.observe(expected.predict(sample), learnt)
    for sample in DAY[330:340]:
        np.testing.assert_allclose(renewed.predict(sample)[:2], expected.predict(sample)[:2], rtol=1e-9)
    assert (renewed.model.recursion.before is not None) == bool(changed)


@pytest.mark.parametrize('changed', [0, 120])
def test_a_model_of_some_of_the_older_samples_has_learnt_nothing_of_what_was_taken_back(changed):
    """A fifth of the samples of a load's first half second was learnt again, as of the arm."""
    def thetas(spoilt):
        """Of the model, and of the one before its change."""
        pairs = [(sample._replace(outputs=sample.outputs + spoilt * (103 < number < 143)), Learning.YES)
                 for number, sample in enumerate(DAY[:330])]
        pairs[143:150] = [(sample, Learning.OFFSET) for sample, _ in pairs[143:150]]
        pairs[143] = pairs[143][0], Learning.TAKEN_BACK
        if changed:
            pairs[changed] = DAY[changed], Learning.AFTER_LOAD
        recursion = renew(SLOWER, BODY, batch_of(pairs), DAY[0].stamp, RecentWindow(100)).model.recursion
        return recursion.theta, recursion.before and recursion.before.theta

    now, before = zip(thetas(0.0), thetas(100.0), strict=True)
    if changed:  # what is known since then may be taken back, no more
        assert not np.array_equal(*before)
    else:
        np.testing.assert_array_equal(*now)


def until_an_estimate():
    """A stage whose motion has just left its window, so that an estimate is asked for; what it has not seen yet."""
    stage = Stage(SLOWER)
    stage.offer_and_build(DAY[:100])
    played = 100
    while not stage.background.jobs:
        stage.offer(DAY[played:played + 1])
        played += 1
    return stage, DAY[played:]


@pytest.mark.parametrize('wish', [{'effects': ('sensor_drift',)}, {'variant': 'P'}])
def test_an_estimate_from_a_later_window_gives_way_to_what_a_user_asks_for(wish):
    """And none begins before that is there."""
    stage, rest = until_an_estimate()
    estimate, wanted = stage.background.jobs[0], replace(SLOWER, **wish)
    stage.learner.change(wanted)
    stage.offer(rest)
    assert estimate.cancelled and not stage.learner.switcher.renewed
    (asked,) = [job for job in stage.background.jobs if not job.cancelled]
    assert asked.urgency == Urgency.TAKES_OVER
    stage.background.run(3)  # the estimate, which nobody wants, and the model in two parts
    assert same_model(stage.learner.built, wanted) and 'takes over' in stage.news[-1]


@pytest.mark.parametrize('fails', [False, True])
def test_an_estimate_that_gave_way_to_a_model_that_does_not_come_is_made_after_all(fails):
    """The model went on with hyperparameters of slow motion, until twice as many samples had been learnt."""
    stage, rest = until_an_estimate()
    stage.learner.change(replace(SLOWER, variant='P'))
    if fails:
        stage.background.jobs.pop().done(None, SemiparamError('there was no memory for it.'))
    else:
        stage.learner.change(SLOWER)
    stage.offer_and_build(rest[:10])
    assert stage.learner.renewals == 1 and stage.learner.switcher.renewed
    assert same_model(stage.learner.built, SLOWER) and 'has new hyperparameters and takes over' in stage.news[-1]


def test_an_estimate_that_a_restart_ended_is_made_after_it():
    """The state told that it was being made: twice as many samples had to be learnt first."""
    stage, rest = until_an_estimate()
    stage.offer(rest[:5])
    restarted = Stage(SLOWER)
    restarted.learner.restore(stage.learner.state())
    restarted.offer_and_build(rest[5:7])
    assert restarted.learner.switcher.renewed and restarted.learner.renewals == 1


def test_motion_within_the_window_is_no_reason():
    stage = Stage(SLOWER, InlineBackground())
    stage.offer([*SAMPLES[:200], *faster(SAMPLES[200:], 0.1)])
    assert renewals(stage) == 0


def test_a_window_that_gives_nothing_leaves_the_model_as_it_is_and_is_not_tried_for_ever():
    stage = Stage(SLOWER)
    stage.offer_and_build(DAY[:120])
    ready = stage.learner.estimator
    for sample in DAY[120:]:
        stage.offer([sample])
        while stage.background.jobs:
            stage.background.jobs.popleft().done(None, SemiparamError('there was no memory for it.'))
    assert stage.learner.estimator is ready and stage.learner.learnt == len(DAY)
    assert 1 <= renewals(stage) <= 2 and 'goes on with those it has' in stage.news[-1]
    assert not stage.learner.switcher.renewed


def test_a_shadow_follows():
    stage = Stage(replace(SLOWER, shadow_variants=('NP-ML',)), InlineBackground())
    stage.offer(DAY)
    shadow = stage.learner.switcher.shadows['NP-ML'].estimator
    assert renewals(stage)
    np.testing.assert_allclose(shadow.input_scaling[1], stage.learner.estimator.input_scaling[1], rtol=0.5)


def test_a_later_window_is_made_of_the_latest_samples_learnt():
    learnt = np.ones(300, dtype=bool)
    learnt[250:260] = False
    chosen = later_window(learnt, 100)
    assert chosen.sum() == 100 and chosen[190:].sum() == 100 and not chosen[~learnt].any()
    assert later_window(learnt[:20], 100).all()


def test_of_a_fast_robot_one_sample_of_each_step_counts():
    def asked(day):
        """The sample at which hyperparameters were estimated again, and the inputs' scale then."""
        stage = Stage(SLOWER, InlineBackground())
        for number, sample in enumerate(day):
            stage.offer([sample])
            if renewals(stage):
                assert_as_offline(stage, day[:number + 1])
                return number, stage.learner.estimator.input_scaling

    day = [*faster(motion(500), 0.15), *motion(900)[500:]]
    number, scaling = asked(at_period(day, 2_000_000))
    alone, expected = asked(at_period(day[::2], 4_000_000))
    assert number == 2 * alone
    np.testing.assert_array_equal(scaling, expected)


@pytest.mark.parametrize('constant', [0.3, 1e-3, 0.0])
def test_an_output_that_stays_the_same_decides_nothing(constant):
    """Its variance is rounding, which errors of a thousandth exceed ten thousand times."""
    errors, rng = Errors(2), np.random.default_rng(0)
    for _ in range(500):
        outputs = np.array([constant, rng.standard_normal()])
        prediction = Prediction(*[None] * len(Prediction._fields))._replace(
            mean=outputs + np.array([1e-3, 0.1]), sample=Sample(0, *[np.zeros(0)] * 3, outputs))
        errors.add(prediction)
    assert errors.size == pytest.approx(0.1, rel=0.1)
