"""What was named is tried beside the model, applied, taken back, and known when it comes again."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.frames import last_link
from semiparam_ros.core.samples import Samples
from semiparam_ros.effects import effect_from_text
from semiparam_ros.effects.cables import CableSpring
from semiparam_ros.online import state_file
from semiparam_ros.online.applied_effects import TRIED_S, AppliedEffects, as_measured
from semiparam_ros.online.change_record import APPLIED, ASSUMED, TAKEN_BACK, TRIED
from semiparam_ros.online.feedforward import Feedforward
from semiparam_ros.online.identified_parameters import Load
from semiparam_ros.online.learning import Learning
from semiparam_ros.online.model_jobs import build
from semiparam_ros.online.motion_block import BLOCK_S, MotionBlock
from support.arms import icub, smooth_motion
from support.changing_arm import LOADED_S, caught, exchanged, free, loaded, offered, pushed, turned
from support.loaded_stage import begun

pytestmark = pytest.mark.usefixtures('motion_as_recorded')
FLOOR_S = 40.0, 70.0


@pytest.fixture(scope='module')
def carried():
    """A learner that has seen a load on and off again, with the samples and the load's mass."""
    body, samples, mass = loaded()
    return offered(body, samples, diagnosis_auto='apply'), samples, mass


def errors(stage, samples):
    """(N,) root mean square over the outputs, in their standard deviations."""
    left = (stage.means - samples.outputs) / samples.outputs.std(axis=0)
    return np.sqrt(np.mean(left**2, axis=1))


def between(samples, values, start, end):
    """The root mean square of values between two times [s]."""
    return float(np.sqrt(np.mean(values[(samples.time >= start) & (samples.time < end)] ** 2)))


def test_the_error_is_back_at_its_floor_with_the_load_and_without_it(carried):
    stage, samples, _ = carried
    left = errors(stage, samples)
    floor = between(samples, left, *FLOOR_S)
    start, end = LOADED_S
    assert between(samples, left, start + 12.0, end) < 1.1 * floor, 'as long as it is carried'
    assert between(samples, left, end + 5.0, samples.time[-1]) < 1.1 * floor, 'when it was put down'


def test_a_load_is_taken_off_before_it_has_a_name(carried):
    stage, samples, _ = carried
    assumed, tried = stage.changes[-1].decisions[:2]
    first, named = ((each.stamp - samples.origin) * 1e-9 for each in (assumed, tried))
    assert first < LOADED_S[0] + 3.0 < named
    left = errors(stage, samples)
    floor = between(samples, left, *FLOOR_S)
    assert between(samples, left, first + 2.0, named) < 1.3 * floor
    assert between(samples, left, LOADED_S[0], first) > 3.0 * floor


def test_every_decision_is_told_with_its_evidence(carried):
    stage, samples, mass = carried
    record = stage.changes[-1]
    applied, over = record.decisions[-2:]
    assert [each.what for each in record.decisions] == [ASSUMED, TRIED, APPLIED, TAKEN_BACK]
    assert applied.evidence > 12.0
    assert over.evidence > 12.0
    assert over.error_share < 0.3, 'what it was worth'
    assert abs(over.stamp * 1e-9 - samples.origin * 1e-9 - LOADED_S[1]) < 2.0
    assert record.as_dict()['decisions'][2] == applied.as_dict()
    assert 'It was taken back at ' in record.sentence
    assert abs(record.named.parameters['mass'].value - mass) < 0.05 * mass
    assert stage.learner.changes.state == 'as it was'


def test_nothing_is_learnt_of_a_change_before_it_is_applied(carried):
    stage, samples, _ = carried
    record, origin = stage.changes[-1], samples.origin
    learning = stage.learner.history.batch().learning
    time = (stage.learner.history.batch().stamps - origin) * 1e-9
    applied = (record.decisions[2].stamp - origin) * 1e-9
    assert (learning[(time > LOADED_S[0] + 2.0) & (time < applied)] == Learning.OFFSET).all()
    assert (learning[(time > applied + 0.1) & (time < LOADED_S[1])] == Learning.YES).mean() > 0.99


def test_a_load_that_comes_again_is_known_at_once(carried):
    _, samples, mass = carried
    body = loaded()[0]
    again = loaded(between=(112.0, 125.0))[1].outputs
    both = replace(samples, outputs=np.where((samples.time < 105.0)[:, None], samples.outputs, again))
    stage = offered(body, both[both.time < 120.0], diagnosis_auto='apply')
    last = max(stage.learner.changes.records.values(), key=lambda record: record.change.number)
    assert last.change.number == 2
    came = last.decisions[-1]
    assert came.what == APPLIED
    assert came.stamp * 1e-9 - both.origin * 1e-9 - 112.0 < 1.5
    picked, load = stage.learner.changes.picked
    assert picked
    assert abs(load.parameters[0] - mass) < 0.05 * mass
    left = errors(stage, both[both.time < 120.0])
    floor = between(both[both.time < 120.0], left, *FLOOR_S)
    assert between(both[both.time < 120.0], left, 114.0, 120.0) < 1.1 * floor
    rather, since = stage.learner.changes.detector.contact_rather, last.change.since
    assert rather(0, True, since, np.zeros(1)) == rather(0, True, since, np.zeros(6))


def test_what_was_tried_for_a_change_goes_when_that_was_a_load_that_came_again():
    """It kept the number that the load got: "dropped, as nothing spoke for it", of a load that is applied."""
    _, samples, _ = loaded()
    stage = begun(4.0, diagnosis_auto='apply')
    watch, theta = stage.learner.changes, np.array([0.2, *np.zeros(9)])
    applied, now = watch.applied, int(samples.stamps[0])
    for number in (9, watch._followed.change.number):
        assert applied.offer(number, effect_from_text('payload@r_gripper'), theta, theta, now)
    known = applied.trials[0]
    for seconds in (0, 20):  # applied, and taken back
        applied.switch(known, now + seconds * 10**9)
    watch._switch(watch.detector, known, int(samples.stamps[-1]))
    assert [trial.number for trial in applied.trials] == [watch.latest.change.number]
    assert applied.of_change(watch.latest.change.number) is known and known.applied


@pytest.mark.parametrize(
    ('changed', 'kind'),
    [(caught, 'cable_spring'), (exchanged, 'tool_exchange'), (turned, 'base_shift')],
)
def test_what_came_is_named_and_applied(tmp_path, changed, kind):
    body, samples = changed()
    stage = offered(body, samples[samples.time < 100.0], diagnosis_auto='apply')
    (record,) = {change.change.number: change for change in stage.changes}.values()
    assert (record.effect.kind, record.decisions[-1].what) == (kind, APPLIED)
    left = errors(stage, samples[samples.time < 100.0])
    floor = between(samples[samples.time < 100.0], left, *FLOOR_S)
    assert between(samples[samples.time < 100.0], left, 85.0, 100.0) < 1.5 * floor
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    again = state_file.load(tmp_path / 's.npz', stage.learner.settings, body)
    where = f' at {record.effect.where}' if record.effect.where else ''
    assert again.sentence.endswith(f' samples, and expects {kind}{where}'), 'forces are off where it is gone'
    other = AppliedEffects(body)
    other.restore(again.applied)
    (trial,), (known,) = other.applied, stage.learner.changes.applied.applied
    assert trial.effect == known.effect
    np.testing.assert_array_equal(trial.coefficients, known.coefficients)


def test_a_load_that_the_model_has_learnt_is_put_down_and_taken_off():
    """It was named, and then learnt over minutes, as it was over."""
    body, samples, mass = loaded(between=(0.0, 70.0))
    samples = samples[samples.time < 100.0]
    stage = offered(body, samples, diagnosis_auto='apply')
    (record,) = {change.change.number: change for change in stage.changes}.values()
    assert (record.effect.kind, record.decisions[-1].what) == ('payload', APPLIED)
    assert record.effect.ends
    left = errors(stage, samples)
    floor = between(samples, left, *FLOOR_S)
    assert between(samples, left, 85.0, 100.0) < 1.3 * floor
    picked, load = stage.learner.changes.picked
    assert picked
    assert load.parameters[0] == pytest.approx(-mass, rel=0.05), 'less than the model has learnt'


def test_a_hand_that_leans_on_the_arm_for_twenty_seconds_is_not_learnt():
    """What no known kind explains is told once, and may be over; it was told four times."""
    body, samples = pushed(seconds=20.0, seed=5)
    stage = offered(body, samples, diagnosis_auto='apply')
    batch = stage.learner.history.batch()
    time = (batch.stamps - samples.origin) * 1e-9
    assert (batch.learning[(time > 72.0) & (time < 90.0)] == Learning.OFFSET).mean() > 0.95
    assert (batch.learning[time > 102.0] != Learning.OFFSET).all()
    assert not stage.learner.changes.applied.applied
    assert {record.change.number for record in stage.changes} == {1}
    left = errors(stage, samples)
    assert between(samples, left, 95.0, 130.0) < 1.1 * between(samples, left, *FLOOR_S)


def test_what_was_learnt_before_a_push_stood_out_is_taken_back():
    """The first half second of each push was learnt, and spoilt predictions for half a minute."""
    body, samples = pushed()
    pushed_at = offered(body, samples, diagnosis_auto='apply')
    never = offered(body, free()[1], diagnosis_auto='off')
    share = errors(pushed_at, samples) / between(samples, errors(never, free()[1]), 80.0, 130.0)
    assert between(samples, share, 80.0, 130.0) < 1.1
    codes = pushed_at.learner.history.batch().learning
    assert (codes == Learning.TAKEN_BACK).sum() == 1


@pytest.mark.parametrize('auto', ['report', 'off'])
def test_what_was_kept_to_take_back_is_none_of_minutes_ago(auto):
    """Who let it be applied again, as a change was told, lost all that was learnt since it was last."""
    body, samples = free()
    stage = offered(body, samples[samples.time < 20.0], diagnosis_auto='apply')
    for chosen, start, end in ((auto, 20.0, 40.0), ('apply', 40.0, 40.2)):
        stage.learner.change(replace(stage.learner.settings, diagnosis_auto=chosen))
        stage.offer(samples[(samples.time >= start) & (samples.time < end)])
    kept = [(stamp - samples.origin) * 1e-9 for stamp, _ in stage.learner.estimator.ensemble._marks]
    assert kept[-1] == pytest.approx(40.0) and kept[0] > (37.4 if auto == 'report' else 39.9)


@pytest.mark.parametrize(
    'settings', [{}, {'diagnosis_auto': 'report'}, {'variant': 'SPK-ML', 'forgetting': '0.999'}]
)
def test_a_model_that_is_built_later_takes_back_what_the_one_in_force_did(settings):
    body, samples = pushed()
    stage = offered(body, samples[samples.time < 72.0], diagnosis_auto='apply')
    chosen = replace(stage.learner.built, features_count=20, **settings)
    history = stage.learner.history
    batch = history.batch()
    (at,) = np.flatnonzero(batch.learning == Learning.TAKEN_BACK)

    def theta(count):
        return build(chosen, body, batch.part(0, count), None, history.origin).model.theta

    after = theta(at + 1)
    assert any(np.array_equal(after, theta(at - count)) for count in range(38, 54)), 'two seconds ago or so'


@pytest.mark.parametrize('stiffness', [20.0, pytest.param(40.0, marks=pytest.mark.long)])
def test_what_no_effect_explains_is_learnt_and_told_no_more(monkeypatch, stiffness):
    """It was told anew every few seconds, or applied and taken back, and never learnt."""
    monkeypatch.setattr(CableSpring, 'may_come', False)
    body, samples = caught(stiffness=stiffness)
    stage = offered(body, samples, diagnosis_auto='apply')
    noticed = [(record.change.noticed - samples.origin) * 1e-9 for record in stage.changes]
    assert max(noticed) < 110.0
    learning = stage.learner.history.batch().learning
    time = samples.time[: len(learning)]
    assert np.mean(learning[(time > 115.0) & (time < 128.0)] > 0) > 0.95


def test_an_offset_that_came_for_seconds_is_remembered_no_more_and_one_that_stayed_is():
    """After a jump of the clock back nobody knows how long it was there: it stays known."""
    body, _ = free()
    applied, effect = AppliedEffects(body), effect_from_text('sensor_offset{"start_s": 1.0}')

    def there(start, end, jump=False):
        applied.clear()
        applied.offer(1, effect, np.ones(body.n_outputs), np.ones(body.n_outputs), start)
        applied.switch(applied.trials[0], start * 10**9)
        if jump:
            applied.reset()
        applied.switch(applied.trials[0], end * 10**9)
        return [trial.remembered for trial in applied.trials]

    assert there(100, 103) == []
    assert there(100, 120) == [True]
    assert there(100, 10, jump=True) == there(100, 3, jump=True) == [True]


def test_after_what_no_effect_explains_it_is_learnt_what_is_usual_and_told_what_comes_next():
    body, samples = free()
    jump = 0.5 * samples.outputs.std(axis=0) * (samples.time >= 90.0)[:, None]
    jumped = replace(samples, outputs=samples.outputs + jump)
    stage = offered(body, jumped[samples.time < 75.0], diagnosis_auto='apply')
    stage.learner.changes._learn()  # as when no effect explained what stood out
    stage.offer(jumped[(samples.time >= 75.0) & (samples.time < 80.0)])
    assert stage.learner.changes.state == 'learns what is usual'
    stage.offer(jumped[(samples.time >= 80.0) & (samples.time < 98.0)])
    assert [record.change.kind for record in stage.changes][-1:] == ['sensor_offset']


def test_what_stands_out_with_breaks_is_held_thirty_seconds_in_all():
    """Pushes of 5 s with 2 s between began the thirty seconds anew, and held learning for minutes."""
    body, samples = free()
    outputs = samples.outputs.copy()
    for start in np.arange(40.0, 100.0, 7.0):
        outputs += pushed(start=start, newton=30.0)[1].outputs - samples.outputs
    again = replace(samples, outputs=outputs)[samples.time < 100.0]
    stage = offered(body, again, diagnosis_auto='apply')
    learning = stage.learner.history.batch().learning
    time = samples.time[: len(learning)]
    assert np.mean(learning[(time > 45.0) & (time < 60.0)] > 0) < 0.2
    held = np.isin(learning, (Learning.OFFSET, Learning.TAKEN_BACK))[(time > 40.0) & (time < 80.0)]
    assert held.sum() / 20.0 < 36.0, 'thirty, and as much as was calm between'
    assert np.mean(learning[(time > 75.0) & (time < 80.0)] > 0) > 0.9, 'a push is learnt'


@pytest.mark.long
def test_what_is_learnt_after_thirty_seconds_is_followed_and_the_arm_returns():
    """A hand leaned on the arm for 40 s: the model had outvoted it by half, and had an error of .3 afterwards."""
    (body, samples), (_, alone) = pushed(seconds=40.0, seed=5), free(5)
    stage = offered(body, samples, diagnosis_auto='apply')
    late = samples.time > 113.0
    states = alone.position[late], alone.velocity[late], alone.acceleration[late]
    theta = stage.learner.estimator.model.theta[: body.n_parameters]
    left = alone.outputs[late] - np.array([body.regressor(*each) @ theta for each in zip(*states, strict=True)])
    assert (left.std(axis=0) < 0.05 * alone.outputs[late].std(axis=0)).all()


def test_a_push_is_not_applied_and_not_learnt():
    body, samples = pushed()
    stage = offered(body, samples[samples.time < 90.0], diagnosis_auto='apply')
    assert not stage.learner.changes.applied.trials
    assert not any(record.was_applied for record in stage.changes)
    inside = (samples.time > 72.0) & (samples.time < 74.5)
    learning = stage.learner.history.batch().learning
    assert not (learning[inside[: len(learning)]] > 0).any()


@pytest.mark.parametrize('start', [85.0, 108.0])
def test_a_push_is_no_load_that_is_known(start):
    """It was taken for the load that came again, or went: upwards while it is carried, downwards afterwards."""
    body, samples, mass = loaded()
    hand = pushed(start=start, force=(0.0, 0.0, np.sign(96.0 - start) * 1.5 * 9.81 * mass))[1]
    both = replace(samples, outputs=samples.outputs + hand.outputs - free()[1].outputs)
    stage = offered(body, both[samples.time < max(start + 12.0, 104.0)], diagnosis_auto='apply')
    records = stage.learner.changes.records.values()
    decided = [
        (each.what, round((each.stamp - both.origin) * 1e-9))
        for record in records for each in record.decisions if each.what in (APPLIED, TAKEN_BACK)
    ]
    assert [what for what, _ in decided] == [APPLIED, TAKEN_BACK]
    assert decided[1][1] - LOADED_S[1] < 2.0


def test_a_load_that_was_put_down_while_the_clock_jumped_is_taken_back():
    """Since when it speaks for that was a stamp of before the jump, later than all that came."""
    body, samples, _ = loaded()
    stage = offered(body, samples[samples.time < LOADED_S[0] + 15.0], diagnosis_auto='apply')
    assert stage.learner.changes.applied.applied
    stage.learner.clear_pending()  # as the node does
    later = samples[(samples.time > LOADED_S[1]) & (samples.time < LOADED_S[1] + 5.0)]
    stage.offer(replace(later, stamps=later.stamps - round(3600e9)))
    assert not stage.learner.changes.applied.applied
    assert stage.changes[-1].decisions[-1].what == TAKEN_BACK


def test_a_load_that_is_put_down_while_it_is_learnt_anew_what_is_usual_is_taken_back():
    """After something that no effect explains; the model learnt that it was gone, and kept it."""
    body, samples, _ = loaded()
    end = LOADED_S[1] - 1.0
    stage = offered(body, samples[samples.time < end], diagnosis_auto='apply')
    assert stage.learner.changes.applied.applied
    detector = stage.learner.changes.detector
    noise = detector.innovation_noise, detector.usual_squares
    for _ in range(2):  # the second time it does not know it yet
        stage.learner.changes._learn()
        assert (detector.innovation_noise, detector.usual_squares) == noise
    stage.offer(samples[(samples.time >= end) & (samples.time < LOADED_S[1] + 5.0)])
    assert not stage.learner.changes.detector.knows
    assert not stage.learner.changes.applied.applied
    assert stage.changes[-1].decisions[-1].what == TAKEN_BACK


def test_what_is_applied_is_saved_with_the_model_and_goes_on(tmp_path):
    """Saved after it was named for the third time, 25 s after it began."""
    body, samples, _ = loaded()
    until = samples[samples.time < LOADED_S[1] - 3.0]
    stage = offered(body, until, diagnosis_auto='apply')
    settings = stage.learner.settings
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    other = offered(body, samples[:20], diagnosis_auto='apply')
    other.learner.restore(state_file.load(tmp_path / 's.npz', settings, body))
    assert [trial.applied for trial in other.learner.changes.applied.trials] == [True]
    rest = samples[(samples.time >= LOADED_S[1] - 3.0) & (samples.time < LOADED_S[1])]
    for each in (stage, other):
        del each.answers[:]
        each.offer(rest)
    np.testing.assert_array_equal(stage.means, other.means)
    row = samples.position[900], samples.velocity[900], samples.acceleration[900]
    answers = [Feedforward().answer(each.learner, *row).outputs for each in (stage, other)]
    np.testing.assert_array_equal(*answers)


def test_that_a_load_of_a_state_that_was_loaded_is_put_down_is_told(tmp_path):
    """It was 'the robot has not changed: it was over as soon as a contact is'."""
    body, samples, _ = loaded()
    saved_s = LOADED_S[0] + 10.0
    stage = offered(body, samples[samples.time < saved_s], diagnosis_auto='apply')
    settings = stage.learner.settings
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    other = offered(body, samples[:20], diagnosis_auto='apply')
    other.learner.restore(state_file.load(tmp_path / 's.npz', settings, body))
    other.offer(samples[(samples.time >= saved_s) & (samples.time < LOADED_S[1])])
    sentence = other.learner.changes.sentence
    assert sentence == 'the robot: changed, and allowed for (payload at r_gripper).'
    other.offer(samples[(samples.time >= LOADED_S[1]) & (samples.time < LOADED_S[1] + 1.5)])
    told = other.changes[0]
    begun, ended = (stamp_s - samples.origin * 1e-9 for stamp_s in told.times_s)
    assert abs(begun - LOADED_S[0]) < 10.0, 'since it was applied'
    assert abs(ended - LOADED_S[1]) < 0.3
    assert told.sentence.startswith('payload at r_gripper since ')
    assert 'It was taken back at ' in told.sentence


def test_desired_states_and_the_samples_as_measured_hold_what_is_applied():
    body, samples = free()
    link = last_link(body)
    applied, theta = AppliedEffects(body), np.array([0.5, 0.01, 0.0, 0.02, *np.zeros(6)])
    for kind, values in ((f'payload@{link}', theta), ('sensor_offset', np.arange(6.0))):
        effect = effect_from_text(kind + '{"start_s": 1.0}')
        assert applied.offer(len(applied.trials), effect, values, 0.0 * values, 0)
        applied.switch(applied.trials[-1], int(samples.stamps[9]))
    kept = [applied.taken_off(sample) for sample in list(samples[:40])]
    off = Samples.from_list([sample for sample, _ in kept])
    before = np.where(np.arange(40)[:, None] < 10, samples.outputs[:40], off.outputs)
    again = as_measured(body, replace(samples[:40], outputs=before), applied.contributions)
    np.testing.assert_allclose(again.outputs, samples.outputs[:40], rtol=0.0, atol=1e-9)
    row = samples.position[7], samples.velocity[7], samples.acceleration[7]
    shown, needed = applied.desired(*row)
    np.testing.assert_allclose(shown, kept[7][1], atol=1e-9)
    np.testing.assert_allclose(shown - needed, np.arange(6.0), atol=1e-9)
    bodies, bias = applied.bodies_and_bias()
    np.testing.assert_allclose(body.regressor(*row) @ bodies, needed, atol=1e-9)
    np.testing.assert_allclose(bias, np.arange(6.0))


def test_what_is_applied_since_many_loads_ago_is_in_the_samples_as_measured():
    """Only the latest hundred were kept, and a load is taken off by half a dozen values until it has a name."""
    body, samples = free()
    link, applied = last_link(body), AppliedEffects(body)
    applied.offer(1, effect_from_text('sensor_offset'), np.arange(6.0), np.zeros(6), 0)
    applied.switch(applied.trials[0], int(samples.stamps[0]))
    off = [applied.taken_off(samples[:1][0])[0]]
    for mass, sample in enumerate(list(samples[1:130]), start=1):
        off.append(applied.taken_off(sample)[0])
        applied.assume(Load(link, mass * np.eye(10)[0], np.eye(10)))
    again = as_measured(body, Samples.from_list(off[-20:]), applied.contributions)
    np.testing.assert_allclose(again.outputs, samples.outputs[110:130], rtol=0.0, atol=1e-8)


def test_a_state_of_what_had_another_name_before_the_next_sample_is_loaded():
    """It was over when it began: "expected an end after the start", and the state was lost."""
    body, samples = free()
    effect, applied = effect_from_text('sensor_offset'), AppliedEffects(body)
    applied.offer(1, effect, np.arange(6.0), np.zeros(6), 0)
    assert applied.unsaved == []
    applied.trials[0].acting = True
    assert applied.unsaved == [effect], 'it is tried'
    applied.switch(applied.trials[0], int(samples.stamps[5]))
    assert applied.unsaved == []
    applied.offer(1, effect, 2.0 * np.arange(6.0), np.zeros(6), int(samples.stamps[5]))
    restored = AppliedEffects(body)
    restored.restore(applied.state())
    ((_, values, _),) = restored.contributions
    assert values.tolist() == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]


def test_after_a_jump_of_the_clock_samples_as_measured_hold_what_is_applied_and_nothing_of_before():
    """A recording that is played again had the load of the first time, and one that began earlier none."""
    body, samples = free()
    effect = effect_from_text('sensor_offset{"start_s": 1.0}')
    for taken_back, hours in ((False, 1), (True, 0)):
        applied = AppliedEffects(body)
        applied.offer(1, effect, np.arange(6.0), np.ones(6), 0)
        applied.switch(applied.trials[0], int(samples.stamps[0]))
        if taken_back:
            applied.switch(applied.trials[0], int(samples.stamps[1000]))
        applied.reset()
        late = replace(samples[:40], stamps=samples.stamps[:40] - round(hours * 3600e9))
        off = Samples.from_list([applied.taken_off(sample)[0] for sample in late])
        again = as_measured(body, off, applied.contributions)
        np.testing.assert_allclose(again.outputs, late.outputs, rtol=0.0, atol=1e-9)


def test_a_load_without_a_name_is_taken_off_and_is_not_saved():
    body, samples = free()
    link = last_link(body)
    applied, theta = AppliedEffects(body), np.array([0.5, 0.01, 0.0, 0.02, *np.zeros(6)])
    off = []
    for number, sample in enumerate(samples[:40]):
        off.append(applied.taken_off(sample)[0])
        if number in (9, 19, 29):  # it is told, estimated anew, dropped
            applied.assume(None if number == 29 else Load(link, theta * number, np.eye(10)))
            state = applied.state()
            assert state['effects'] == ()
            assert all('end_stamp_s' in effect for effect, _ in state['taken_off'])
        if number == 24:
            assert applied.acts
            assert [(effect.kind, effect.where) for effect in applied.unsaved] == [('payload', link)], 'it is said so'
            bodies, _ = applied.bodies_and_bias()
            shown, needed = applied.desired(*sample[1:4])
            np.testing.assert_allclose(body.regressor(*sample[1:4]) @ bodies, needed, atol=1e-9)
            np.testing.assert_allclose(shown, needed)
    assert not applied.acts
    off = Samples.from_list(off)
    assert (off.outputs[10:30] != samples.outputs[10:30]).any(axis=1).all()
    again = as_measured(body, off, applied.contributions)
    np.testing.assert_allclose(again.outputs, samples.outputs[:40], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    'damage',
    [
        {'coefficients': (np.zeros((2, 3)),)},
        {'applied': (1,)},
        {'effects': ('payload@nowhere',)},
        {'taken_off': (('sensor_offset', np.full(6, 1e12)),)},
    ],
)
def test_a_damaged_state_is_refused(damage):
    body, _ = free()
    applied = AppliedEffects(body)
    applied.offer(1, effect_from_text('sensor_offset{"start_s": 1.0}'), np.ones(6), np.ones(6), 0)
    applied.switch(applied.trials[0], 10**9)
    state = applied.state()
    applied.restore(state)
    assert applied.trials[0].applied
    with pytest.raises((ValueError, RuntimeError)):
        applied.restore({**state, **damage})


def block_of(n, trials):
    """A block of motion of n outputs, in which so many trials add nothing."""
    nothing, none = np.zeros((0, 0)), np.zeros(0)
    return MotionBlock(0, 10**9, nothing, none, (none, 0.0), 0.0, np.full((6, n), 100.0),
                       nothing, (nothing, none, nothing), np.zeros((trials, 2, n)))


def test_an_effect_for_which_nothing_speaks_is_tried_for_so_long_and_dropped():
    body, _ = free()
    applied, n = AppliedEffects(body), body.n_outputs
    effect = effect_from_text('sensor_offset{"start_s": 1.0}')
    for number in (1, 2):
        applied.offer(number, effect, np.ones(n), np.ones(n), 0)
    applied.switch(applied.trials[0], 10**9)
    blocks = round(TRIED_S / BLOCK_S)
    for count in range(blocks):
        assert not applied.unsupported(), count
        assert applied.judge(block_of(n, 2), 1.0, 600.0) is None
    unsupported = [trial.number for trial in applied.unsupported()]
    assert unsupported == [2], 'what is applied is tried no more'
    applied.drop(2)
    applied.drop(1)
    assert [trial.number for trial in applied.trials] == [1], 'what is applied stays'


def test_what_a_block_has_of_an_effect_that_is_named_anew_speaks_for_no_other_one():
    """The other one that was tried got its place in the list, and so its evidence: it was applied."""
    body, _ = free()
    applied, n = AppliedEffects(body), body.n_outputs
    effect = effect_from_text('sensor_offset{"start_s": 1.0}')
    for number in (1, 2, 1):  # the first one is named anew while a block comes
        applied.offer(number, effect, np.ones(n), np.ones(n), 0)
    block = block_of(n, 2)
    block.added[0] = np.stack([np.full(n, 90.0), np.full(n, 1.0)])
    block.added[1] = np.stack([np.full(n, -50.0), np.full(n, 1.0)])
    found = applied.judge(block, 1.0, 600.0)
    assert found is not None and found.number == 1


def test_one_that_is_remembered_keeps_none_from_being_taken_back_when_nothing_is_applied_any_more():
    """After ``diagnosis.auto`` went from ``apply`` to ``report``."""
    body, _ = free()
    applied, n = AppliedEffects(body), body.n_outputs
    for number in (1, 2):
        effect = effect_from_text('sensor_offset{"start_s": 1.0}')
        applied.offer(number, effect, np.ones(n), np.ones(n), 0)
        applied.switch(applied.trials[-1], 10**9)
    applied.switch(applied.trials[0], 20 * 10**9)
    block = block_of(n, 2)
    block.added[0] = np.stack([np.full(n, 90.0), np.full(n, 1.0)])
    block.added[1] = np.stack([np.full(n, -50.0), np.full(n, 1.0)])
    assert applied.judge(block, 1.0, 600.0, applies=False) is applied.trials[1]
    assert applied.judge(block, 1.0, 600.0) is applied.trials[0]


@pytest.mark.parametrize('saved', [False, True])
def test_the_last_four_that_were_taken_back_are_remembered_whichever_was_named_first(saved):
    """Of four tools the first came again and was put down, and with a fifth one it was the one that was forgotten."""
    body = icub()
    applied, ones, second = AppliedEffects(body), np.ones(10), 10**9
    for turn, mass in enumerate((1.0, 2.0, 3.0, 4.0, 1.0, 5.0)):
        known = {trial.coefficients[0]: trial.number for trial in applied.trials}
        number, begun = known.get(mass, 100 + turn), 20 * turn * second
        applied.offer(number, effect_from_text(f'payload@{last_link(body)}'), mass * ones, ones, begun)
        for now in (begun, begun + 8 * second):  # applied, and taken back
            applied.switch(applied.of_change(number), now)
        if saved:
            applied.restore(applied.state())
    assert sorted(trial.coefficients[0] for trial in applied.trials) == [1.0, 3.0, 4.0, 5.0]


def gained():
    """A body, a gain of its sensor that shows 30 % too much beside what only adds, a load and its values."""
    body = icub()
    gains = ', '.join(f'"gain_{name}": 0.3' for name in body.output_names)
    declared = (effect_from_text(f'sensor_gain{{{gains}}}'), effect_from_text('sensor_drift'))
    samples = smooth_motion(body.n_joints, 7)[1:]
    samples = replace(samples, outputs=np.zeros((len(samples), body.n_outputs)))
    return body, declared, effect_from_text(f'payload@{last_link(body)}'), np.array([1.0, *np.zeros(9)]), samples


@pytest.mark.parametrize('named', [True, False])
def test_a_load_is_shaped_by_the_effects_that_the_model_declares(named):
    """Of a sensor that shows 30 % too much, a load that was named beside that gain was taken off without it."""
    body, declared, load, theta, samples = gained()
    applied = AppliedEffects(body)
    applied.shaped_by(declared)
    if named:
        applied.offer(1, load, theta, theta, 0)
        applied.switch(applied.trials[0], 0)
    else:
        applied.assume(Load(last_link(body), theta, np.eye(10)))
    off = []
    for sample in samples:
        columns = CoupledColumns(body, [*declared, load]).one(sample, samples.origin)[0]
        left, added = applied.taken_off(sample)
        assert added == pytest.approx(columns[:, -10:] @ theta)
        off.append(left)
    again = as_measured(body, Samples.from_list(off), applied.contributions)
    assert again.outputs == pytest.approx(samples.outputs, abs=1e-9)
    shown, needed = applied.desired(*sample[1:4])
    assert shown == pytest.approx(1.3 * needed)
    restored = AppliedEffects(body)
    restored.shaped_by(declared)
    restored.restore(applied.state())
    assert not named or restored.taken_off(sample)[1] == pytest.approx(added)


def test_a_load_keeps_what_it_adds_when_a_gain_is_declared_beside_it():
    """Its values are from before that; one that is named later is shaped by the gain, also as the name of the same."""
    body, declared, load, theta, samples = gained()
    applied, (first, second, third, *_) = AppliedEffects(body), samples
    applied.offer(1, load, theta, theta, 0)
    applied.switch(applied.trials[0], 0)
    plain = [applied.taken_off(sample)[1] for sample in (first, second, third)]
    off = [applied.taken_off(first)[0]]
    applied.shaped_by(declared)
    off.append(applied.taken_off(second)[0])
    assert -off[-1].outputs == pytest.approx(plain[1])
    applied.offer(2, load, theta, theta, second.stamp)
    applied.switch(applied.trials[1], second.stamp)
    off.append(applied.taken_off(third)[0])
    assert -off[-1].outputs == pytest.approx(2.3 * plain[2])
    assert applied.spread == pytest.approx(np.abs(plain[2]) * np.hypot(1.0, 1.3))
    again = as_measured(body, Samples.from_list(off), applied.contributions)
    assert again.outputs == pytest.approx(samples.outputs[:3], abs=1e-9)
    applied.offer(1, load, theta, theta, third.stamp)
    assert -applied.taken_off(third)[0].outputs == pytest.approx(2.6 * plain[2])
