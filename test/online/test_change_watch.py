"""The learner has changes named in the background, with what came before and after."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.frames import last_link
from semiparam_ros.diagnosis.change import name_change
from semiparam_ros.effects.base import Span
from semiparam_ros.effects.loads import Payload
from semiparam_ros.effects.sensor import SensorOffset
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online import change_watch
from semiparam_ros.online.change_causes import causes_of, friction_directions, load_directions
from semiparam_ros.online.change_record import APPLIED, ASSUMED, TAKEN_BACK, TRIED, ChangeRecord, Decision
from semiparam_ros.online.change_watch import ChangeWatch, LearntChange
from semiparam_ros.online.changes import ChangeDetector
from semiparam_ros.online.diagnosis_jobs import name_change as name_in_background
from semiparam_ros.online.followed_change import Change
from semiparam_ros.online.identified_parameters import Load
from semiparam_ros.online.learning import Learning, directions_of, learning_after, learning_of
from support.arms import ODD_BODY
from support.changing_arm import (
    LOADED_S,
    SETTINGS,
    caught,
    described,
    exchanged,
    free,
    loaded,
    offered,
    pushed,
    turned,
)
from support.learner_stage import Stage
from support.loaded_stage import begun
from support.node_helpers import BODY, InlineBackground

pytestmark = pytest.mark.usefixtures('motion_as_recorded')


def test_a_load_is_named_soon_and_again_as_more_comes_until_it_is_put_down():
    body, samples, mass = loaded()
    stage = offered(body, samples[samples.time < 112.0])
    first, *_, last = stage.changes
    assert first.named is None
    named = [record for record in stage.changes if record.named is not None]
    assert len(named) >= 4
    assert {record.effect.kind for record in named} == {'payload'}
    masses = [record.named.parameters['mass'].value for record in named]
    assert abs(masses[0] - mass) < 0.1 * mass, 'six seconds after it began'
    assert abs(masses[-1] - mass) < 0.05 * mass
    begun, ended = (stamp_s - samples.origin * 1e-9 for stamp_s in last.times_s)
    assert abs(begun - LOADED_S[0]) < 0.2
    assert abs(ended - LOADED_S[1]) < 0.2
    assert last.sentence.startswith('payload at r_gripper since ')
    assert 'over at' in last.sentence
    assert stage.learner.changes.state == 'as it was'


def returns(stage):
    """How often the robot was as before a change."""
    return sum(answer.learning == Learning.RETURNED for answer in stage.answers)


@pytest.mark.parametrize('variant', ['P', pytest.param('SPK-ML', marks=pytest.mark.long)])
def test_with_report_the_model_follows_a_load_at_once_and_returns(variant):
    """It outvoted the load for minutes, and then the arm without it: .05 of the outputs' deviation in place of .02."""
    body, samples, _ = loaded(seed=4)
    stage = offered(body, samples, variant=variant)
    deviations = (samples.outputs - stage.means) / samples.outputs.std(axis=0)
    before, during, after = (
        np.sqrt(np.mean(deviations[(samples.time >= begin) & (samples.time < end)] ** 2))
        for begin, end in ((40.0, LOADED_S[0]), (LOADED_S[0] + 2.0, LOADED_S[1]), (LOADED_S[1] + 1.0, 130.0))
    )
    assert during < 1.2 * before
    assert after < 1.2 * before
    (record,) = stage.learner.changes.records.values()
    assert record.effect is not None and record.effect.kind == 'payload' and not record.retracted
    assert abs(record.change.ended - samples.origin - LOADED_S[1] * 1e9) < 5e8
    over = next(each for each in stage.changes if each.change.ended is not None)
    assert over.change.noticed - samples.origin < (LOADED_S[1] + 0.6) * 1e9, 'as soon as the model returns'
    last = {each.change.number: each for each in stage.changes}
    assert [(number, each.retracted) for number, each in last.items()] == [(1, False)]


def test_a_model_that_returns_before_anything_is_told_tells_the_end_and_that_it_came_again(monkeypatch):
    """The detector took the model that had returned for one that had learnt, and nothing was told."""
    (body, samples, mass), (_, later, _) = loaded(), loaded((112.0, 130.0))
    again = samples.time >= 112.0
    samples = replace(samples, outputs=np.where(again[:, None], later.outputs, samples.outputs))
    stage = offered(body, samples[samples.time < LOADED_S[0] + 14.0])
    watch = stage.learner.changes
    assert [record.change.ended for record in watch.records.values()] == [None]
    watch.detector.reset()
    monkeypatch.setattr(ChangeDetector, '_tell', lambda *_: None)
    stage.offer(samples[(samples.time >= LOADED_S[1]) & (samples.time < LOADED_S[1] + 3.0)])
    (record,) = watch.records.values()
    assert returns(stage) == 1 and record.effect.kind == 'payload'
    assert abs(record.change.ended - samples.origin - LOADED_S[1] * 1e9) < 1e9
    assert watch.state == 'as it was'
    stage.offer(samples[(samples.time >= 105.0) & (samples.time < 125.0)])
    _, record = watch.records.values()
    assert returns(stage) == 2 and record.change.ended is None
    assert abs(record.change.since - samples.origin - 112e9) < 1e9
    assert record.effect.kind == 'payload' and abs(record.named.parameters['mass'].value - mass) < 0.1 * mass


@pytest.mark.parametrize(('until', 'follows'), [(80.0, []), (90.0, [Learning.AFTER_LOAD])])
def test_a_load_that_is_over_when_learning_goes_on_is_not_followed(until, follows):
    """The model was unsure of a load that was there only while learning was paused."""
    body, samples, _ = loaded((70.0, until))
    stage = offered(body, samples[samples.time < 69.0])
    for learning, end in ((False, 85.0), (True, 85.5)):
        stage.learner.settings = replace(stage.learner.settings, learning=learning)
        stage.offer(samples[(samples.time >= samples.time[len(stage.answers)]) & (samples.time < end)])
    assert [record.change.kind for record in stage.learner.changes.records.values()] == ['payload']
    assert [answer.learning for answer in stage.answers if answer.learning > Learning.YES] == follows


@pytest.mark.parametrize(('ago', 'follows'), [(0.2, None), (-0.01, Learning.AFTER_LOAD)])
def test_what_the_model_has_returned_from_is_not_followed_when_it_is_told(ago, follows, monkeypatch):
    """The detector may tell later than the model returns; it would be unsure of the load that it knows."""
    body, samples = free()
    stage = offered(body, samples[samples.time < 50.0])
    watch = stage.learner.changes
    watch._anew_at = watch._now
    change = Change(1, watch._now - round(ago * 1e9), watch._now, 'payload', 'r_gripper', 0.2, 0.01, 20.0, ())
    monkeypatch.setattr(ChangeDetector, 'see', lambda *_: change)
    stage.offer(samples[(samples.time >= 50.0) & (samples.time < 50.05)])
    assert watch.follows == follows and list(watch.records) == [1]


def test_what_the_model_has_returned_from_is_none_of_the_time_after_a_jump_of_the_clock(monkeypatch):
    """A simulation that begins anew passes the same stamps again, and a load then was not followed."""
    body, samples = free()
    stage = offered(body, samples[samples.time < 50.0])
    watch = stage.learner.changes
    watch._anew_at = watch._now
    stage.learner.clear_pending()
    change = Change(1, watch._now - round(0.2e9), watch._now, 'payload', 'r_gripper', 0.2, 0.01, 20.0, ())
    monkeypatch.setattr(ChangeDetector, 'see', lambda *_: change)
    stage.offer(samples[(samples.time >= 50.0) & (samples.time < 50.05)])
    assert watch.follows == Learning.AFTER_LOAD


def test_what_the_gate_gave_way_to_is_followed_once_and_its_end_is_none_of_an_earlier_change(monkeypatch):
    """The model that was told of it a second time forgot what was known before, and could not return."""
    body, samples = free()
    pushed = 5.0 * ((samples.time > 50.0) & (samples.time < 56.0))[:, None]
    samples = replace(samples, outputs=samples.outputs + pushed)
    monkeypatch.setattr(ChangeDetector, '_tell', lambda *_: None)
    monkeypatch.setattr(ChangeDetector, 'stands_out', False)
    stage = Stage(replace(SETTINGS, gate_enabled=True, gate_timeout=0.5), InlineBackground(), body)
    stage.offer(samples[samples.time < 52.0])
    watch, recursion = stage.learner.changes, stage.learner.estimator.model.recursion
    assert sum(answer.learning == Learning.AFTER_CHANGE for answer in stage.answers) == 1
    known, since = recursion.before, samples.origin + round(50e9)
    change = Change(7, since, watch._now, 'payload', 'r_gripper', 0.2, 0.01, 20.0, ())
    with monkeypatch.context() as told:
        told.setattr(ChangeDetector, 'see', lambda *_: change)
        stage.offer(samples[(samples.time >= 52.0) & (samples.time < 52.02)])
    assert watch.follows is None and recursion.before is known
    assert watch._learnt == [LearntChange(7, Learning.AFTER_CHANGE)], 'it is the one that was told'
    watch._learnt = [LearntChange(None, Learning.AFTER_CHANGE)]  # as if it had not been
    watch.records[7] = ChangeRecord(change._replace(ended=since - 10**9))
    stage.offer(samples[(samples.time >= 52.02) & (samples.time < 60.0)])
    assert returns(stage) == 1 and list(watch.records) == [7]


def test_every_column_of_the_model_is_learnt_and_after_friction_only_that_and_offsets_are_in_doubt():
    columns = CoupledColumns(ODD_BODY, joint_friction=True)
    causes, directions = causes_of(columns)
    own = directions[:columns.n_own, causes[0].part.stop:]
    assert (np.count_nonzero(own, axis=1) == 1).all()
    rotor = columns.blocks['rotor']
    assert not any(directions[rotor, cause.part].any() for cause in causes), 'no rotor changes'
    in_doubt = friction_directions(columns).any(axis=1)
    blocks = columns.blocks['friction'], columns.blocks['offset']
    assert in_doubt.nonzero()[0].tolist() == [place for block in blocks for place in range(block.start, block.stop)]


@pytest.mark.parametrize('kind', ['sensor_offset', 'effort_offset', 'friction', 'payload', 'zero_slip', ''])
@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_what_was_told_alone_is_in_doubt(kind, outputs):
    """Every cause that moves columns of the model; after any other all of it is."""
    body = free()[0] if outputs == 'wrench' else ODD_BODY
    columns = CoupledColumns(body, joint_friction=outputs == 'effort')
    causes, directions = causes_of(columns)
    parts = [directions[:columns.n_own, cause.part] for cause in causes if cause.kind == kind]
    found = directions_of(learning_after(kind), columns)
    if kind in ('zero_slip', ''):
        assert found is None
    else:
        for part in parts:
            residual = part - found @ np.linalg.lstsq(found, part, rcond=None)[0]
            assert np.abs(residual).max() < 1e-9 * np.abs(part).max()
        assert np.linalg.matrix_rank(found) < columns.n_own


def test_an_offset_may_change_by_as_much_as_dry_friction():
    """Its prior is a tenth of that, for where no change is told a joint that goes one way rubs."""
    columns = CoupledColumns(ODD_BODY, joint_friction=True)
    causes, directions = causes_of(columns)
    offsets, rubbing = ([directions[:, cause.part] for cause in causes if cause.kind == kind]
                        for kind in ('effort_offset', 'friction'))
    np.testing.assert_allclose([part.max() for part in offsets], [part[:, -1].max() for part in rubbing])
    np.testing.assert_allclose(directions_of(learning_after('effort_offset'), columns).max(), max(
        part.max() for part in offsets))


@pytest.mark.long
def test_a_load_that_comes_again_ends_no_earlier_change():
    """The model with it returned, and a cable that still held the arm was told as over."""
    (body, samples, _), (_, later, _) = loaded(), loaded((112.0, 130.0))
    outputs = np.where((samples.time < 112.0)[:, None], samples.outputs, later.outputs)
    stage = offered(body, replace(samples, outputs=outputs)[samples.time < 60.0])
    watch = stage.learner.changes
    watch.records[0] = ChangeRecord(Change(0, samples.origin, samples.origin, '', None, np.nan, np.nan, 20.0, ('fx',)))
    stage.offer(replace(samples, outputs=outputs)[(samples.time >= 60.0) & (samples.time < 125.0)])
    assert sum('again as it was before' in news for news in stage.news) == 2, 'put down, and picked up again'
    assert watch.records[0].change.ended is None
    first, again = (watch.records[number] for number in sorted(watch.records)[1:])
    assert first.change.ended is not None and again.change.ended is None
    assert again.effect is not None and again.effect.kind == 'payload'


@pytest.mark.long
def test_the_end_of_a_load_is_told_as_that_though_the_sensor_has_changed_since():
    """The model from before the last change has the load yet; its end was one more change, and the load was none."""
    body, samples, _ = loaded()
    jump = 0.5 * samples.outputs.std(axis=0) * (samples.time >= 85.0)[:, None]
    stage = offered(body, replace(samples, outputs=samples.outputs + jump))
    load, offset = stage.learner.changes.records.values()
    assert load.effect.kind == 'payload' and not load.retracted
    assert abs(load.change.ended - samples.origin - LOADED_S[1] * 1e9) < 5e8
    assert offset.effect.kind == 'sensor_offset' and offset.change.ended is None


@pytest.mark.long
@pytest.mark.parametrize('seed', [4, 6])
def test_another_tool_is_one_change(seed):
    """Ten were told, most of them taken back: the model outvoted it, and the first block has a part of it only."""
    body, samples = exchanged(seed=seed)
    stage = offered(body, samples)
    (record,) = stage.learner.changes.records.values()
    assert record.effect is not None and record.effect.kind == 'tool_exchange' and record.change.ended is None


def test_what_is_told_is_the_latest_change_while_it_lasts_and_else_the_state():
    (_, samples, _), (_, undisturbed), (_, touched) = loaded(), free(), pushed(start=115.0)
    samples = replace(samples, outputs=samples.outputs + touched.outputs - undisturbed.outputs)
    stage = begun(8.0)
    watch = stage.learner.changes
    assert watch.sentence.startswith('payload at r_gripper since ')
    stage.offer(samples[(samples.time >= LOADED_S[0] + 8.0) & (samples.time < 112.0)])
    assert watch.sentence.startswith(
        'the robot: as it was. The latest change: payload at r_gripper since '
    )
    assert not stage.learner.disturbed
    stage.offer(samples[(samples.time >= 112.0) & (samples.time < 116.0)])
    assert watch.sentence.startswith('the robot: touched, or changing. The latest change: ')
    assert stage.learner.disturbed, 'a tare would hold the touch'


def test_a_cable_that_lets_go_as_soon_as_a_hand_is_no_change_though_it_was_applied():
    body, samples = caught()
    record = offered(body, samples[samples.time < 84.0], diagnosis_auto='apply').changes[-1]
    assert record.effect is not None
    assert not record.effect.is_load
    assert record.was_applied
    since = record.change.since
    over = Decision(TAKEN_BACK, since + 3_000_000_000, 20.0, 0.9)
    brief = replace(
        record,
        change=record.change._replace(ended=since + 2_000_000_000),
        decisions=(*record.decisions, over),
    )
    assert brief.retracted
    assert brief.sentence.startswith('the robot has not changed since ')
    assert 'over as soon as a contact is. It was taken back at ' in brief.sentence


@pytest.mark.parametrize('newton', [pytest.param(15.0, marks=pytest.mark.long), 150.0])
def test_a_load_is_named_though_a_hand_pushed_shortly_before(newton):
    """The push would be most of what the outputs are before the load."""
    (body, samples, mass), (_, undisturbed) = loaded(), free()
    _, touched = pushed(start=60.0, seconds=4.0, newton=newton)
    samples = replace(samples, outputs=samples.outputs + touched.outputs - undisturbed.outputs)
    stage = offered(body, samples[samples.time < LOADED_S[0] + 14.0])
    record = stage.changes[-1]
    assert record.effect is not None, record.sentence
    assert record.effect.kind == 'payload'
    assert abs(record.named.parameters['mass'].value - mass) < 0.1 * mass


def test_that_a_load_without_a_name_is_taken_off_is_said():
    record, decided = begun(4.0, diagnosis_auto='apply').changes
    assert record.sentence != decided.sentence
    assert 'It was taken off until it is named at ' in decided.sentence


def test_a_record_is_machine_readable_and_says_what_the_errors_would_have_been():
    record = begun(8.0).changes[-1].as_dict()
    assert record['named']['effect']['kind'] == 'payload'
    assert record['named']['without']['nmse_mean'] > 2.0 * record['named']['after']['nmse_mean']
    assert record['named']['log_evidence_gain'] > record['named']['price']
    assert record['noticed_stamp_s'] > record['since_stamp_s']


@pytest.mark.parametrize(
    'settings', [{'diagnosis_auto': 'off'}, {'variant': 'NP-ML', 'features_count': 20}]
)
def test_nothing_is_looked_for_where_it_is_off_or_cannot_be(settings):
    body, samples, _ = loaded()
    stage = offered(body, samples[samples.time < LOADED_S[0] + 4.0], **settings)
    assert not stage.changes
    assert stage.learner.changes.state == 'not looked for'


def test_answers_are_the_same_whether_changes_are_looked_for_or_not_until_anything_stands_out():
    body, samples, _ = loaded()
    samples = samples[samples.time < LOADED_S[0] + 8.0]
    stage = begun(8.0)
    learning = stage.learner.history.batch().learning
    until = int(np.argmax(learning == Learning.TAKEN_BACK)) + 1
    assert LOADED_S[0] < samples.time[until] < (stage.changes[0].change.noticed - samples.origin) * 1e-9
    differ = (stage.means != offered(body, samples, diagnosis_auto='off').means).any(axis=1)
    assert not differ[:until].any() and differ[until:].all()


def test_a_load_that_is_told_leaves_the_arm_as_it_was_learnt():
    """What stands out is not learnt before it is told, and then of a load alone."""
    _, samples, _ = loaded()
    samples = samples[samples.time < LOADED_S[0] + 8.0]
    stage = begun(8.0)
    batch, estimator = stage.learner.history.batch(), stage.learner.estimator
    kinds = set(batch.learning[samples.time > LOADED_S[0] + 0.2].tolist())
    assert {Learning.TAKEN_BACK, Learning.OFFSET, Learning.AFTER_LOAD, Learning.YES} == kinds
    recursion = estimator.model.recursion
    moved = recursion.theta - recursion.before.theta
    directions = load_directions(estimator.columns)
    root = recursion.before.theta_root()
    along, *_ = np.linalg.lstsq(root @ directions, root @ moved, rcond=None)
    beside = root @ (moved - directions @ along)
    assert np.linalg.norm(beside) < 0.1 * np.linalg.norm(root @ moved)


@pytest.mark.parametrize(('auto', 'ends'), [('report', 'is learnt once it is told.'), ('off', 'is learnt.')])
def test_what_the_gate_says_of_a_change_is_so_while_it_is_not_yet_told(auto, ends):
    body, samples = free()
    settings = replace(SETTINGS, gate_enabled=True, gate_timeout=0.5, diagnosis_auto=auto)
    stage = Stage(settings, InlineBackground(), body)
    for sample in replace(samples, outputs=samples.outputs + 5.0 * (samples.time > 50.0)[:, None])[samples.time < 60.0]:
        stage.offer([sample])
        if stage.news[-1:] and 'the contact gate opens' in stage.news[-1]:
            break
    assert stage.news[-1].endswith(ends)
    assert stage.learner.changes.holds == ('once' in ends)
    assert (stage.answers[-1].learning > 0) == ('once' not in ends)


@pytest.mark.parametrize('forgotten', [False, True])
def test_a_return_from_what_was_taken_back_ends_no_earlier_change(forgotten):
    """Something of no kind that was none, told upon a load: with its end the load was told as over."""
    body, *_ = loaded()
    stage = begun(8.0)
    watch, (record,) = stage.learner.changes, stage.learner.changes.records.values()
    load = LearntChange(record.change.number, Learning.AFTER_LOAD)
    assert watch._learnt == [load]
    watch.detector.reset()
    later = record.change._replace(number=2, since=watch._now - 10**9, kind='', ended=watch._now)
    if not forgotten:
        nothing = name_change(body, free()[1], [], LOADED_S[0])
        watch.records[2] = replace(ChangeRecord(later), named=nothing, times_named=1)
        assert watch.records[2].retracted
    watch.began_anew(Learning.AFTER_CHANGE, told=True)
    watch._learnt[-1], told = LearntChange(2, Learning.AFTER_CHANGE), len(stage.changes)
    watch.returned(watch._now)
    assert watch.records[record.change.number].change.ended is None and len(stage.changes) == told
    assert watch._learnt == [load]
    watch.returned(watch._now)
    assert watch.records[record.change.number].change.ended is not None, 'now it is the load'
    watch.detector._count = 5
    watch.returned(watch._now)
    assert watch.detector._count == 0, 'it judges the model that has returned from now on'
    again = max(watch.records)
    assert watch._learnt == [load._replace(number=again)] and watch.records[again].change.ended is None
    watch.returned(watch._now)
    assert watch.records[again].change.ended is not None
    told = watch.records[again].change._replace(number=again + 1, ended=None)
    watch.records[again + 1] = ChangeRecord(told)
    watch.records[again] = replace(watch.records[again], named=record.named)
    watch.detector.followed = SimpleNamespace(change=told)
    watch.returned(watch._now)
    assert watch._learnt == [load._replace(number=again + 1)], 'that it came again was told already'


def test_a_model_that_begins_anew_returns_from_no_change_that_another_one_had_learnt():
    """After ~/reset, what the new model returned from was told as the end of a load of long before."""
    stage = Stage(SETTINGS, InlineBackground(), free()[0])
    watch = stage.learner.changes
    watch.records[1] = ChangeRecord(Change(1, 10**9, 2 * 10**9, 'payload', 'r_gripper', 0.2, 0.01, 20.0, ()))
    watch.began_anew(Learning.AFTER_LOAD, told=True)
    watch._learnt[-1] = watch._learnt[-1]._replace(number=1)
    stage.learner.reset()
    watch.detector = ChangeDetector(stage.learner.estimator.columns, max(watch.records))
    watch.began_anew(Learning.AFTER_CHANGE, told=False)
    for _ in range(2):  # it is over, and comes again
        watch.returned(5 * 10**9)
    assert watch.records[1].change.ended is None and not stage.changes


@pytest.mark.parametrize(('told', 'expected'), [
    ({}, Learning.YES), ({'follows': Learning.AFTER_LOAD}, Learning.RETURNED),
    ({'follows': Learning.AFTER_LOAD, 'holds': True, 'begins_to_hold': False}, Learning.OFFSET)])
def test_where_a_change_is_told_less_evidence_is_enough_to_return(told, expected):
    changes = SimpleNamespace(**{'follows': None, 'holds': False, **told})
    prediction, gate = SimpleNamespace(motion=SimpleNamespace(is_news=True)), SimpleNamespace(changed=False)
    better = SimpleNamespace(compare=lambda _: False, as_before_s=0.05)
    assert learning_of(better, prediction, True, gate, changes) == expected
    not_better = SimpleNamespace(compare=lambda _: False, as_before_s=0.0)
    assert learning_of(not_better, prediction, True, gate, changes) != Learning.RETURNED


def test_a_change_that_was_told_before_the_model_returned_is_the_end_of_the_one_before():
    stage = begun(8.0)
    watch, (record,) = stage.learner.changes, stage.learner.changes.records.values()
    over = record.change._replace(number=2, since=watch._now - 10**9)
    watch.records[2], watch.detector.followed = ChangeRecord(over), SimpleNamespace(change=over)
    watch.returned(watch._now)
    assert list(watch.records) == [1] and watch.records[1].change.ended == over.since
    (told,) = (each for each in stage.changes if each.change.number == 2)
    assert told.retracted and told.sentence.endswith(': what came or went is change 1.')
    assert watch.detector.followed is None


def test_what_is_taken_back_soon_after_a_change_is_not_the_change():
    """Two seconds are taken back: what was known before, and that the load is in doubt, would go with them."""
    body, samples, _ = loaded()
    stage = offered(body, samples[samples.time < LOADED_S[0] + 0.5])
    while stage.answers[-1].learning != Learning.AFTER_LOAD:
        stage.offer(samples[len(stage.answers):len(stage.answers) + 1])
    estimator, known = stage.learner.estimator, stage.learner.estimator.model.recursion.before
    stage.offer(samples[len(stage.answers):len(stage.answers) + 5])
    assert known is not None and estimator.ensemble._marks
    estimator.take_back()
    before = estimator.model.recursion.before
    assert before is not None and (before.theta == known.theta).all()


def test_a_touch_ends_when_nobody_looks_any_more():
    """It lasted until somebody did again: all between was left out of a diagnosis."""
    body, samples = pushed(start=50.0, newton=30.0)
    stage = offered(body, samples[samples.time < 52.0])
    for auto, start, end in (('off', 52.0, 70.0), ('report', 70.0, 72.0)):
        stage.learner.change(replace(stage.learner.settings, diagnosis_auto=auto))
        stage.offer(samples[(samples.time >= start) & (samples.time < end)])
    assert max(end - start for start, end in stage.learner.changes.contacts) < 3e9


def test_an_error_while_looking_keeps_no_sample_from_being_learnt(monkeypatch):
    body, samples = free()
    stage = Stage(SETTINGS, background=InlineBackground(), body=body)
    stage.offer(samples[:300])
    assert stage.learner.changes.detector is not None
    monkeypatch.setattr(stage.learner.changes.detector, 'see', None)
    learnt = stage.learner.learnt
    stage.offer(samples[300:302])
    assert [place for place, _ in stage.failures] == ['looking for changes']
    assert stage.learner.learnt == learnt + 2


def test_that_a_change_cannot_be_named_is_told_once():
    """Nobody heard of it: the change stayed without a name and without a reason."""
    body, samples, _ = loaded()
    stage = begun(4.0)
    watch, (*_, record) = stage.learner.changes, stage.changes
    told, number = len(stage.changes), record.change.number
    for count in (12, 40):
        watch._named(number, None, SemiparamError(f'{count} samples are too few.'))
    refused, *more = stage.changes[told:]
    assert not more and not stage.failures
    assert refused.sentence.endswith(' It could not be named: 12 samples are too few.')
    assert refused.as_dict()['unnamed'] == '12 samples are too few.'
    there = samples[samples.time < LOADED_S[1] - 2.0]
    watch._named(number, name_change(body, there, [], LOADED_S[0]), None)
    assert stage.changes[-1].effect is not None and not stage.changes[-1].unnamed
    watch._named(number, None, SemiparamError('3 samples are too few.'))
    assert stage.changes[-1].effect is not None, 'what is named stays so'


def test_what_no_effect_explains_is_taken_back_and_the_robot_is_as_it_was():
    body, samples, _ = loaded()
    stage = begun(4.0)
    watch, (record, *_) = stage.learner.changes, stage.changes
    nothing = name_change(body, free()[1], [], LOADED_S[0])
    watch._named(record.change.number, nothing, None)
    taken_back = stage.changes[-1]
    assert taken_back.retracted
    assert taken_back.sentence.startswith('the robot has not changed since ')
    assert watch.state == 'as it was'
    stage.offer(samples[(samples.time >= LOADED_S[0] + 4.0) & (samples.time < LOADED_S[0] + 9.0)])
    assert stage.changes[-1] == taken_back, 'the model has learnt it'


def test_a_change_that_is_over_and_was_none_leaves_the_next_one_as_it_is():
    """What is usual was learnt anew, so that a load was held no longer; and a contact it was called."""
    body, *_ = loaded()
    stage = begun(4.0, diagnosis_auto='apply')
    watch, record = stage.learner.changes, stage.changes[0]
    ended = record.change.since - 10**9
    before = record.change._replace(number=0, since=ended - 20 * 10**9, ended=ended)
    watch.records[0] = replace(record, change=before)
    watch._named(0, name_change(body, free()[1], [], LOADED_S[0]), None, asked=ended)
    assert stage.changes[-1].sentence.endswith(': no effect explains it.')
    assert watch.state == 'changed' and watch.holds
    assert watch._followed.change.number == record.change.number


def test_an_effect_that_is_tried_no_more_after_its_change_was_over_ends_nothing():
    """The block of motion that had begun held its part, of an effect that there was no more."""
    body, samples, _ = loaded()
    until = LOADED_S[0] + 4.0
    stage = offered(body, samples[samples.time < until], diagnosis_auto='apply')
    watch, number = stage.learner.changes, stage.changes[0].change.number
    there = samples[samples.time < LOADED_S[0] + 20.0]
    watch._named(number, name_change(body, there, [], LOADED_S[0]), None)
    watch.detector.followed = None  # as when it is over
    rest = samples[(samples.time >= until) & (samples.time < until + 1.0)]
    stage.offer(rest[:3])
    watch._named(number, name_change(body, free()[1], [], LOADED_S[0]), None)
    assert not watch.applied.trials
    stage.offer(rest[3:])
    assert not stage.failures


def test_an_effect_that_is_no_more_the_name_of_a_change_is_tried_no_more():
    """It was applied to a robot of which the record said that it had not changed."""
    body, samples, _ = loaded()
    stage = begun(4.0, diagnosis_auto='apply')
    watch, (record, *_) = stage.learner.changes, stage.changes
    there = samples[samples.time < LOADED_S[0] + 20.0]
    watch._named(record.change.number, name_change(body, there, [], LOADED_S[0]), None)
    assert [trial.effect.kind for trial in watch.applied.trials] == ['payload']
    watch._named(record.change.number, name_change(body, free()[1], [], LOADED_S[0]), None)
    assert stage.changes[-1].retracted
    assert not watch.applied.trials


def test_what_was_named_from_samples_in_which_it_may_be_over_is_named_anew():
    """A load kept the mass that a naming found while it was put down."""
    body, samples, _ = loaded()
    stage = offered(body, samples[samples.time < LOADED_S[0] + 12.0], diagnosis_auto='apply')
    watch, (*_, record) = stage.learner.changes, stage.changes
    number, (trial,) = record.change.number, watch.applied.applied
    before, half = trial.coefficients.copy(), record.named
    other = replace(half, parameters={
        name: replace(quantity, value=0.5 * quantity.value)
        for name, quantity in half.parameters.items()
    })
    trial.score, watch._due = 1.0, []
    watch._named(number, other, None)
    assert (trial.coefficients == before).all()
    assert [due for _, due in watch._due] == [number]
    trial.score = 0.0
    watch._named(number, other, None, asked=5)
    assert (trial.coefficients == before).all()
    watch._named(number, other, None)
    assert (trial.coefficients == 0.5 * before).all()


@pytest.mark.parametrize('paused_at', [LOADED_S[0], LOADED_S[0] + 3.0])
def test_a_load_is_named_where_the_robot_paused_before_or_after_it_was_picked_up(paused_at):
    """Seconds of motion count; after a pause of two minutes nothing was left to compare with."""
    body, samples, mass = loaded()
    samples = samples[samples.time < LOADED_S[0] + 12.0]
    late = (samples.time >= paused_at) * round(120e9)
    stage = offered(body, replace(samples, stamps=samples.stamps + late), diagnosis_auto='apply')
    record = stage.changes[-1]
    assert record.effect is not None
    assert record.effect.kind == 'payload'
    assert abs(record.named.parameters['mass'].value - mass) < 0.1 * mass
    assert [decision.what for decision in record.decisions] == [ASSUMED, TRIED, APPLIED]


def test_a_change_that_could_not_be_named_yet_is_named_later(monkeypatch):
    body, samples, _ = loaded()
    jobs = []

    def name(*given):
        jobs.append(given)
        if len(jobs) < 5:  # as often as more is expected to come
            raise SemiparamError('there are too few samples.')
        return name_in_background(*given)

    monkeypatch.setattr(change_watch.diagnosis_jobs, 'name_change', name, raising=True)
    monkeypatch.setattr(change_watch, 'NAMED_AFTER_S', (2.0, 4.0, 6.0))
    stage = offered(body, samples[samples.time < LOADED_S[0] + 22.0])
    assert len(jobs) >= 5
    assert stage.changes[-1].effect.kind == 'payload'


def test_a_load_that_was_there_too_briefly_to_be_named_is_over_for_the_next_one():
    """It was known without its end, and the load after it, of half the mass, was no change at all."""
    body, samples, mass = loaded((0.0, 200.0))
    time, free_arm = samples.time, free()[1].outputs
    there = ((time >= 70.0) & (time < 80.0)) + ((time >= 88.0) & (time < 91.0)) + 0.5 * (time >= 97.0)
    outputs = free_arm + there[:, None] * (samples.outputs - free_arm)
    stage = offered(body, replace(samples, outputs=outputs)[time < 107.0], diagnosis_auto='apply')
    _, brief, last = stage.learner.changes.records.values()
    assert brief.unnamed and brief.effect.span.end_stamp_s == brief.change.ended / 10**9
    assert all(number != brief.change.number for _, number in stage.learner.changes._due), 'no more comes'
    assert abs(last.named.parameters['mass'].value - 0.5 * mass) < 0.05 * mass


@pytest.mark.parametrize(('later', 'ended', 'effect', 'left_out'), [
    (1, None, None, (8.0, 99.0)), (1, None, SensorOffset(None), None), (2, None, None, None),
    (1, 12.0, None, (8.0, 12.0)), (-1, None, None, None),
    (-1, 12.0, None, (8.0, 12.0)), (1, 10.0, None, (8.0, 10.0))])
def test_what_another_change_without_a_name_is_takes_no_part_in_a_naming(later, ended, effect, left_out, monkeypatch):
    """Friction that was named three times had not come after all, by a load that was picked up and had no name yet."""
    stage, asked = begun(14.0), []
    watch, record = stage.learner.changes, stage.changes[-1]
    number, since = record.change.number + 1, record.change.since
    over = None if ended is None else since + round(ended * 1e9)
    other = record.change._replace(number=number + later, kind='', since=since + round(8e9), touched=0, ended=over)
    watch.records[number] = ChangeRecord(record.change._replace(number=number))
    watch.records[number + later] = ChangeRecord(other, times_named=int(later == 2), restored=effect)
    monkeypatch.setattr(change_watch.diagnosis_jobs, 'name_change', lambda *given: asked.append(given[-1]))
    watch._name(number, stage.learner.history, ())
    newest = (watch._now - since) * 1e-9
    told = [((first - since) * 1e-9, (last - since) * 1e-9) for first, last in asked[0][len(watch.contacts):]]
    assert told == ([] if left_out is None else [pytest.approx((left_out[0], min(left_out[1], newest)))])


def test_a_change_from_before_a_jump_of_the_clock_is_not_named_from_what_comes_after(monkeypatch):
    """Seconds of motion count, and what is due after so many would look for it in another time."""
    _, samples, _ = loaded()
    before = samples.time < LOADED_S[0] + 4.0
    stage = begun(4.0)
    number, asked = stage.changes[-1].change.number, []

    def name(body, batch, effects, since, *given):
        asked.append(since[1])
        return name_in_background(body, batch, effects, since, *given)

    monkeypatch.setattr(change_watch.diagnosis_jobs, 'name_change', name)
    later = samples[~before & (samples.time < LOADED_S[0] + 20.0)]
    stage.learner.clear_pending()  # as the node does
    stage.offer(replace(later, stamps=later.stamps - round(3600e9)))
    assert all(since < samples.stamps[0] for since in asked)
    assert not stage.learner.changes.records[number].unnamed


@pytest.mark.parametrize('error', [SemiparamError('12 samples are too few.'), None])
def test_what_is_being_named_when_the_clock_jumps_is_not_asked_again(error):
    """Of a name that was refused, or of a change that was over meanwhile, more was to come: from another time."""
    watch = ChangeWatch(BODY, InlineBackground(), lambda record: None, lambda place, failure: None)
    over = None if error else 3 * 10**9
    watch.records[1] = ChangeRecord(Change(1, 10**9, 2 * 10**9, 'payload', 'ft', 0.5, 0.1, 30.0, ('fz',), over))
    named = None if error else SimpleNamespace(inputs=None)
    watch._named(1, named, error, asked=None)
    assert [number for _, number in watch._due] == [1]
    watch.reset()
    watch._named(1, named, error, asked=None)
    assert not watch._due


def test_a_change_from_before_a_state_was_loaded_is_not_named_from_what_comes_after():
    """A load that was named was then: "the robot has not changed: no effect explains it"."""
    body, samples, _ = loaded()
    stage = offered(body, samples[samples.time < 60.0])
    saved = stage.learner.state()
    stage.offer(samples[(samples.time >= 60.0) & (samples.time < LOADED_S[0] + 7.0)])
    watch, record = stage.learner.changes, stage.changes[-1]
    assert record.effect.kind == 'payload' and watch._due
    stage.learner.restore(saved)
    assert not watch._due
    assert watch._past == record.change.number, 'nor does it stand beside those that come'


@pytest.mark.parametrize('again', ['clear_pending', pytest.param('reset', marks=pytest.mark.long)])
def test_a_load_has_its_name_also_when_the_recording_is_played_again(again):
    """That of the first time stood beside the model, so that no other one was needed."""
    body, samples, mass = loaded()
    samples = samples[(samples.time > 35.0) & (samples.time < LOADED_S[0] + 14.0)]
    stage = offered(body, samples)
    first = stage.changes[-1]
    getattr(stage.learner, again)()
    stage.offer(samples)
    record = stage.changes[-1]
    assert record.change.number > first.change.number
    assert record.effect is not None, record.sentence
    assert record.effect.kind == 'payload'
    assert abs(record.named.parameters['mass'].value - mass) < 0.1 * mass


def test_another_recording_begins_with_nothing_half_seen():
    """Its stamps may be those of an earlier day, so no change of the one before is over in it."""
    _, samples, _ = loaded()
    offline = OfflineLearner(described(), [], lambda: None)
    for part in (samples[: np.searchsorted(samples.time, LOADED_S[0] + 3.0)], samples[:600]):
        offline.begin(samples.origin)
        for sample in part:
            offline.step(sample, True)
    assert offline.learner.changes.state == 'as it was'


def test_a_change_knows_since_when_it_was_taken_for_a_contact():
    """What a name is looked for in begins there, not when it was told."""
    (body, picked_up, _), (_, alone), (_, push) = loaded((76.0, 100.0)), free(), pushed(seconds=5.0)
    both = replace(picked_up, outputs=picked_up.outputs + push.outputs - alone.outputs)
    first = offered(body, both[both.time < 85.0]).changes[0].change
    touched_s, since_s = ((stamp - both.origin) * 1e-9 for stamp in (first.touched, first.since))
    assert touched_s == pytest.approx(70.0, abs=0.5)
    assert since_s > touched_s + 1.0


@pytest.mark.parametrize('hours', [-1.0, 2.0])
def test_what_was_there_before_the_clock_jumped_and_is_over_was_a_change(hours, monkeypatch):
    """It had ended before it began: "the robot has not changed", and was named from two times that are none."""
    body, samples = free()
    jump = 5.0 * samples.outputs.std(axis=0) * (samples.time >= 70.0)[:, None]
    there = replace(samples, outputs=samples.outputs + jump)
    stage = offered(body, there[samples.time < 80.0], diagnosis_auto='apply')
    assert stage.learner.changes.applied.applied
    stage.learner.clear_pending()  # as the node does
    asked = []
    monkeypatch.setattr(change_watch.diagnosis_jobs, 'name_change', lambda *given: asked.append(given))
    later = samples[(samples.time >= 80.0) & (samples.time < 85.0)]
    stage.offer(replace(later, stamps=later.stamps + round(hours * 3600e9)))
    record = stage.changes[-1]
    assert record.decisions[-1].what == TAKEN_BACK
    assert not record.retracted
    assert not asked


def test_a_push_after_a_pause_began_after_it():
    """All motion of as long before the pause was left out of every diagnosis."""
    body, samples = pushed(start=70.0, newton=150.0)
    paused = samples.time >= 70.3
    samples = replace(samples, outputs=np.where(paused[:, None], samples.outputs, free()[1].outputs))
    samples = replace(samples, stamps=samples.stamps + np.where(paused, round(60e9), 0))
    stage = offered(body, samples[samples.time < 70.3 + 60.0 + 8.0])
    ((since, _),) = stage.learner.changes.contacts
    assert (since - samples.origin) * 1e-9 > 69.5


def test_a_load_that_is_retracted_is_taken_off_no_more(monkeypatch):
    """It was for eight seconds more, of which the model learnt that it carries less than nothing."""
    body, samples, _ = loaded()

    def name(*given):
        return replace(name_in_background(*given), effect=None, parameters={})

    monkeypatch.setattr(change_watch.diagnosis_jobs, 'name_change', name)
    stage = offered(body, samples[samples.time < LOADED_S[0] + 7.0], diagnosis_auto='apply')
    record = stage.changes[-1]
    assert record.retracted
    assert record.decisions[-1].what == ASSUMED
    assert stage.learner.changes.applied.provisional is None


def test_a_change_soon_after_a_state_was_loaded_is_named_beside_the_load_of_that_state():
    """The load was picked up among the samples of the state: "no effect explains" that the base was turned."""
    (body, samples, _), (_, base) = loaded((70.0, 130.0)), turned(start=95.0)
    samples = replace(samples, outputs=samples.outputs + base.outputs - free()[1].outputs)
    stage = offered(body, samples[samples.time < 85.0], diagnosis_auto='apply')
    assert stage.learner.changes.applied.applied
    stage.learner.restore(stage.learner.state())
    stage.offer(samples[(samples.time >= 85.0) & (samples.time < 102.0)])
    record = stage.changes[-1]
    assert record.effect is not None, record.sentence
    assert (record.effect.kind, record.was_applied) == ('base_shift', True)


def test_a_name_that_comes_after_the_clock_was_set_back_applies_nothing():
    """Its values were taken off from a stamp on that is hours ahead: samples as measured had none of it."""
    stage = begun(8.0, diagnosis_auto='apply')
    watch, record = stage.learner.changes, stage.changes[-1]
    (trial,) = watch.applied.applied
    stage.learner.clear_pending()  # as the node does
    watch._named(record.change.number, record.named, None)
    assert watch.applied.applied == [trial]
    assert [effect.span.start_stamp_s for effect, *_ in watch.applied.contributions] == [None]


def test_what_is_applied_keeps_its_name():
    """The record told of a later name, while the first one went on predicting."""
    body, samples, _ = loaded()
    stage = offered(body, samples[samples.time < LOADED_S[0] + 15.0], diagnosis_auto='apply')
    watch, record = stage.learner.changes, stage.changes[-1]
    assert record.was_applied
    other = replace(record.named, effect=Payload('r_hand', span=record.named.effect.span))
    watch._named(record.change.number, other, None)
    (trial,) = watch.applied.applied
    assert stage.changes[-1].effect.where == trial.effect.where == 'r_gripper'
    assert stage.changes[-1].times_named == record.times_named + 1


def test_no_change_gets_the_number_of_one_that_was_told_as_a_part_of_another():
    """After ``diagnosis.auto`` was off, another model or a reset: changes.jsonl had two changes of one number, and the
    second one got the name that was still being searched for the first."""
    watch = ChangeWatch(BODY, InlineBackground(), lambda record: None, lambda place, error: None)
    columns = CoupledColumns(BODY, (), True, True)
    nothing = Change(1, 10**9, 2 * 10**9, 'payload', 'r_gripper', 1.0, 0.1, 20.0, ())
    for number in (1, 2):
        watch._record(nothing._replace(number=number, since=number * 10**9))
    watch._end(1, 2)
    assert list(watch.records) == [1]
    watch.forget()
    assert watch._detector_of(columns).number == 2


@pytest.mark.parametrize(('span', 'expected'), [
    (None, 0.7), (Span(start_stamp_s=5.0), 0.9), (Span(end_stamp_s=5.0), 0.1)])
def test_what_came_or_went_is_told_on_top_of_what_is_applied(span, expected):
    """Until it had a name the load that was applied was missing, and for ten seconds what was put down was carried."""
    body, _ = free()
    link, watch, values = last_link(body), ChangeWatch(body, InlineBackground(), print, print), np.eye(10)[0]
    watch.applied.offer(1, Payload(link), 0.5 * values, 0.1 * values, 0)
    watch.applied.switch(watch.applied.trials[0], 10**9)
    change = Change(2, 5 * 10**9, 6 * 10**9, 'payload', link, 0.2, 0.01, 20.0, ())
    noticed = Load(link, 0.2 * values, np.diag(0.04 * values))
    watch.detector = SimpleNamespace(followed=SimpleNamespace(change=change), load=noticed)
    named = span and SimpleNamespace(effect=Payload(link, {}, span=span),
                                     coefficients=(0.4 * values, 0.2 * values))
    watch.records[2] = ChangeRecord(change, named)
    picked, load = watch.picked
    assert picked and load.link == link
    assert load.parameters == pytest.approx(expected * values)
    assert load.covariance == pytest.approx(0.05 * np.diag(values))
    watch.detector.load = None
    assert watch.picked[1] is None or named


@pytest.mark.parametrize(('told', 'follows'), [(True, Learning.AFTER_LOAD), (False, None)])
def test_what_stood_out_of_a_model_keeps_nothing_from_being_learnt_by_one_of_other_columns(told, follows):
    """Nothing was learnt until it was known what is usual of the new one, and the load was taken off as long."""
    body, _ = free()
    link, watch = last_link(body), ChangeWatch(body, InlineBackground(), print, print)
    change = Change(1, 5 * 10**9, 6 * 10**9, 'payload', link, 0.2, 0.01, 20.0, ())
    first = watch._detector_of(CoupledColumns(body))
    first.followed = SimpleNamespace(change=change) if told else None
    watch.holds = True
    watch.applied.assume(Load(link, np.ones(10), np.eye(10)))
    assert watch._detector_of(CoupledColumns(body)) is first and watch.holds and watch.applied.acts
    assert watch._detector_of(CoupledColumns(body, physical=True)) is not first
    assert not watch.holds and not watch.applied.acts and watch.follows == follows


def test_a_load_that_is_tried_while_effects_are_declared_is_one_change():
    """It was told a second time as one that was none, and its end was not."""
    robot = {name: getattr(described(), name) for name in ('robot_description', 'joints', 'sensor_frame',
                                                           'wrench_convention')}
    stage, (_, samples, _) = begun(3.0, diagnosis_auto='apply', **robot), loaded()
    watch, count = stage.learner.changes, len(stage.answers)
    assert watch.holds and watch.applied.provisional is not None
    stage.learner.change(replace(stage.learner.settings, effects=('sensor_gain',)))
    stage.offer(samples[(samples.time >= samples.time[count]) & (samples.time < LOADED_S[0] + 8.0)])
    assert stage.answers[count + 1].learning == Learning.AFTER_LOAD
    assert watch._learnt == [LearntChange(1, Learning.AFTER_LOAD)], 'the end of which is told when the model returns'
    assert [record.effect.kind for record in watch.records.values()] == ['payload'] and not stage.failures


@pytest.mark.parametrize(('now', 'follows'), [(False, Learning.AFTER_LOAD), (True, None)])
def test_what_waited_to_be_applied_is_followed_when_nothing_is_applied_any_more(now, follows):
    """After ``diagnosis.auto`` went from ``apply`` to ``report`` the load was learnt as if the arm had not changed: the
    errors were twice the usual ones while it was carried, and after it. What is told just now is followed anyway."""
    body, _ = free()
    watch = ChangeWatch(body, InlineBackground(), print, print)
    change = Change(1, 5 * 10**9, 6 * 10**9, 'payload', last_link(body), 0.2, 0.01, 20.0, ())
    watch.detector = SimpleNamespace(followed=SimpleNamespace(change=change), stands_out=False)
    watch.records[1], watch.holds = ChangeRecord(change), True
    watch.applies = True
    watch._hold(watch.detector, False)
    assert watch.holds and watch.follows is None
    watch.applies = False
    watch._hold(watch.detector, now)
    assert not watch.holds and watch.follows == follows
