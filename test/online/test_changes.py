"""Changes are noticed, told from contacts, followed until they end, and named."""

import pickle
import subprocess
import sys
from copy import deepcopy
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.size import push_force, size_beyond
from semiparam_ros.diagnosis.change import gain_since, name_change
from semiparam_ros.effects import effect_from_text
from semiparam_ros.online import diagnosis_jobs
from semiparam_ros.online.change_causes import Judged
from semiparam_ros.online.changes import ChangeDetector
from semiparam_ros.online.diagnosis_jobs import diagnose
from semiparam_ros.online.followed_change import JUDGED_ANEW
from semiparam_ros.online.history import batch_of
from semiparam_ros.online.learning import Learning
from semiparam_ros.online.motion_block import MotionBlock
from semiparam_ros.online.usual_noise import LENGTHS, USUAL
from semiparam_ros.online.wandering_contact import WANDERS, contact_scale, wandering
from semiparam_ros.settings import load_params
from semiparam_ros.settings.build import build_rigid_body
from support.arms import ODD_BODY, ODD_JOINTS, noisy, smooth_motion
from support.changing_arm import (
    CALM,
    LOADED_S,
    _same,
    caught,
    elbow_rests,
    free,
    heavier,
    loaded,
    offered,
    pushed,
    turned,
)
from support.declared_effects import REPOSITORY
from support.learner_stage import Stage
from support.node_helpers import SETTINGS as ARM
from support.node_helpers import InlineBackground


def told(body, samples):
    """What a detector beside a rigid body tells, and (N,) whether it says that the robot is touched; what recordings
    begin with as most do is seen once for all."""
    usual, free_samples = free()
    if body is usual and len(samples) > CALM and _same(samples[:CALM], free_samples[:CALM]):
        return seen(*deepcopy(calm(), {id(body): body}), samples[CALM:])
    return seen(*beginning(body), samples)


def beginning(body):
    estimator = Estimator(body, ModelOptions(variant='P', initial_samples=200))
    return estimator, ChangeDetector(estimator.columns), []


@cache
def calm():
    body, samples = free()
    estimator, detector, _ = beginning(body)
    found, touched, _ = seen(estimator, detector, [], samples[:CALM])
    assert not found
    return estimator, detector, touched.tolist()


def seen(estimator, detector, touched, samples):
    found = []
    for sample in samples:
        prediction = estimator.predict(sample)
        part = estimator.rigid_body_part(prediction)
        change = detector.see(*part)
        found += [change] if change else []
        touched.append(detector.touched)
        estimator.observe(prediction, prediction.motion.is_news)
    return found, np.array(touched), detector


def test_a_load_is_noticed_within_a_second_and_so_is_its_end():
    body, samples, mass = loaded()
    (first, *_, last), _, detector = told(body, samples)
    seconds = (np.array([first.since, first.noticed, last.ended, last.noticed]) - samples.origin) * 1e-9
    assert first.kind == 'payload'
    assert abs(seconds[0] - LOADED_S[0]) < 2.0
    assert 0.0 < seconds[1] - LOADED_S[0] < 1.0
    assert abs(seconds[2] - LOADED_S[1]) < 2.0
    assert seconds[3] - LOADED_S[1] < 1.0
    assert last.number == first.number
    assert abs(first.value - mass) < 0.25 * mass, 'one second tells little more'
    assert detector.followed is None


def test_noise_that_is_less_than_the_model_expects_hides_no_load():
    """Hyperparameters of a motion from point to point found the noise of its stops, where joints stick: of a gantry
    15 N, of which 3 on the way, and 4 kg were not noticed."""
    body, samples, mass = loaded()
    expected = beginning(body)[0]
    for sample in samples[:300]:
        expected.observe(expected.predict(sample))
    hyperparameters = expected.model.hyperparameters
    found = {}
    for times in (1.0, 10.0):
        noisier = replace(hyperparameters, sigma=times * hyperparameters.sigma)
        estimator = Estimator(body, ModelOptions(variant='P', hyperparameters=noisier))
        (first, *_), _, detector = seen(estimator, ChangeDetector(estimator.columns), [], samples)
        assert first.kind == 'payload'
        found[times] = first
        assert max(detector.noise, detector.innovation_noise) * times**2 < 10.0, 'kappa is that of what is seen'
    assert found[10.0].noticed - found[1.0].noticed < 1e9
    assert abs(found[10.0].value - mass) < 0.25 * mass


def test_what_changed_leaves_as_large_a_share_of_itself_as_the_model_of_the_robot_beside_white_noise():
    """A contact followed the last percent of a load that weighed more than the hand behind the sensor: it was told
    after six seconds."""
    body, samples, _ = loaded()
    detector = told(body, samples[samples.time < LOADED_S[0] + 1.0])[2]
    block = detector._blocks[0]
    weights, inside = block.own[0], (samples.stamps >= block.start) & (samples.stamps <= block.end)
    assert block.carried == pytest.approx(float((weights * samples.outputs[inside] ** 2).mean(axis=0).sum()), rel=0.5)
    fit, explained, usual = SimpleNamespace(explained=np.full(1, 900.0)), 900.0, detector.noise
    contact, starts = detector._without(detector._blocks, None), np.array([len(detector._blocks) - 4])
    for share, carried, times in ((1.0, explained / 8.75, 1.0), (0.2, 0.0, 1.0), (0.2, 100.0 * explained, 1.0),
                                  (0.2, explained / 8.75, 8.0)):
        detector._level = share * usual
        kappa = detector._noise_left(np.full(1, explained), np.full(1, carried), [fit], starts, starts, contact)
        assert kappa == pytest.approx(times * usual, rel=0.02)


def test_white_noise_is_at_most_what_the_model_expects_and_at_least_what_is_seen():
    body, samples = free()
    detector = told(body, samples[samples.time < 40.0])[2]
    block, level = detector._blocks[-1], detector._level
    assert 0.5 < level <= 1.0
    detector._follow_level(block._replace(own=0.0 * block.own))
    assert detector._level == level, 'joints that rest tell nothing'
    for times, expected in ((100.0, 1.0), (0.01, 0.01)):
        own = block.own.copy()
        own[-1] = times * own[0] * detector._noise_std**2
        for _ in range(2 * len(detector._levels)):
            detector._follow_level(block._replace(own=own))
        assert detector._level == pytest.approx(expected)


def test_a_change_acts_in_no_block_from_before_it_began():
    body, samples, _ = loaded()
    detector = told(body, samples[samples.time < LOADED_S[0] + 3.0])[2]
    followed, blocks = detector.followed, list(detector._blocks)
    acts = np.array([block.start >= followed.change.since for block in blocks])
    assert 4 < acts.sum() < len(acts) - 4
    moments, wrenches = np.array([block.moment for block in blocks]), np.array([block.wrench[1] for block in blocks])
    taken_off = (detector._left(followed) - moments, detector._without(blocks, followed).moments - wrenches,
                 detector._gained(followed)[:, None])
    for each in taken_off:
        np.testing.assert_array_equal(np.abs(each).max(axis=1) > 0.0, acts)


def test_a_small_load_that_the_model_learns_meanwhile_is_there_until_it_is_put_down():
    """Of 25 g; over when its first values, of half a second, predicted worse than none did."""
    body, samples, _ = loaded()
    outputs = 0.85 * free()[1].outputs + 0.15 * samples.outputs
    (first, last), _, _ = told(body, replace(samples, outputs=outputs))
    assert first.kind == 'payload'
    assert first.ended is None
    assert last.number == first.number
    assert abs((last.ended - samples.origin) * 1e-9 - LOADED_S[1]) < 1.0


def test_a_second_change_ends_when_it_does_while_the_first_one_is_there():
    """Blocks from before it was told are no part of its sums; it was over when it began."""
    body, samples, _ = loaded()
    there = (samples.time >= 85.0) & (samples.time < 92.0)
    jump = 5.0 * samples.outputs.std(axis=0) * there[:, None]
    both = replace(samples, outputs=samples.outputs + jump)
    found, _, _ = told(body, both[samples.time < 98.0])
    assert [(change.number, change.kind) for change in found] == [
        (1, 'payload'), (2, 'sensor_offset'), (2, 'sensor_offset')
    ]
    assert abs((found[-1].ended - samples.origin) * 1e-9 - 92.0) < 0.5


def test_a_load_that_is_followed_is_no_contact():
    """What it explains was left in what contacts are judged by: of a load of the UR5 that had no name yet, a change of
    no known kind was told after eight seconds (1337 nat), and the load was taken off no more."""
    body, samples, _ = loaded()
    detector = told(body, samples[samples.time < LOADED_S[0] + 12.0])[2]
    assert detector.followed.blocks > JUDGED_ANEW
    noise, now = np.array([detector.noise]), [len(detector._blocks)]
    with_it, without = (detector._contact(detector._without(detector._blocks, followed), noise, now)
                        for followed in (None, detector.followed))
    assert with_it.max() > 1000.0
    assert without.max() < 0.05 * with_it.max()


def test_a_second_change_is_one_change():
    """Blocks from before it was told were compared with the robot before the first one: told were five to seven."""
    (body, samples, _), (_, base) = loaded(), turned(start=84.0)
    both = replace(samples, outputs=samples.outputs + base.outputs - free()[1].outputs)
    found, _, _ = told(body, both[samples.time < 94.0])
    assert {change.number for change in found} == {1, 2}
    assert (found[-1].kind, found[-1].ended) == ('base_shift', None)
    assert abs((found[-1].touched - samples.origin) * 1e-9 - 84.0) < 0.2


def test_a_change_that_is_judged_anew_began_when_it_began():
    """A window of its last half second says what it is: the load was told as of two seconds later."""
    body, samples, _ = loaded()
    stage = offered(body, samples[samples.time < LOADED_S[0] + 3.0])
    detector, (first, *_) = stage.learner.changes.detector, stage.changes
    offset = detector.causes[1]
    size = offset.part.stop - offset.part.start
    anew = detector._change(1, Judged(offset, 2, np.zeros(size), np.eye(size), 20.0))
    assert (anew.number, anew.kind, anew.since) == (first.change.number, 'sensor_offset', first.change.since)


def test_a_change_that_lasts_is_not_over_though_it_looks_like_noise(monkeypatch):
    """It counted as noise itself: an offset of a sensor was over, and told anew, fifteen times in a minute."""
    body, samples = free()
    jump = 0.1 * samples.outputs.std(axis=0) * ((samples.time >= 70.0) & (samples.time < 72.0))[:, None]
    samples = replace(samples, outputs=samples.outputs + jump)
    stage = offered(body, samples[samples.time < 72.0])
    detector = stage.learner.changes.detector
    assert detector.followed.change.kind == 'sensor_offset'
    monkeypatch.setattr(ChangeDetector, 'innovation_noise', property(lambda _: 10.0))
    monkeypatch.setattr(detector._usual[0], 'ratio', lambda *_: 0.0)
    assert detector._end(detector.followed) is None
    stage.offer(samples[(samples.time >= 72.0) & (samples.time < 75.0)])
    assert abs(stage.changes[-1].change.ended - samples.origin - 72e9) < 5e8


def test_a_base_that_was_turned_is_known_when_something_else_changes():
    """It is no column of the model: of the load that came next eight changes were told."""
    (body, samples, _), (_, base) = loaded(between=(80.0, 130.0)), turned(start=70.0)
    both = replace(samples, outputs=samples.outputs + base.outputs - free()[1].outputs)
    found, _, _ = told(body, both[samples.time < 100.0])
    assert {change.number for change in found} == {1, 2}
    assert found[-1].kind == 'payload'


def test_what_comes_is_judged_by_the_model_from_before_the_longest_window():
    body, samples = free()
    estimator = Estimator(body, ModelOptions(variant='P', initial_samples=200))
    detector, models = ChangeDetector(estimator.columns), []
    for sample in samples[samples.time < 40.0]:
        prediction = estimator.predict(sample)
        _, model = estimator.rigid_body_part(prediction)
        detector.see(prediction, model)
        if detector.finished is not None:
            models.append(model.theta.copy())
        estimator.observe(prediction, prediction.motion.is_news)
    assert (detector.reference == models[-max(LENGTHS)]).all()


def test_what_a_model_may_learn_yet_is_as_much_at_any_rate():
    """Where noise stays alike one sample of each step is learnt, but all are judged: four times the noise is usual."""
    body, found = free()[0], []
    given = Hyperparameters(1.0, 1.0, (), 0.1, (1.0,) * 6, autocorrelation_time=50.0)
    motion = smooth_motion(body.n_joints, 1200, 1000.0, speed=2.0)
    motion = replace(motion, outputs=body.regressors(motion) @ body.base_parameters)
    for samples in (motion, motion[::4]):
        zeros = (0.0,) * 3 * body.n_joints
        options = ModelOptions('P', hyperparameters=given, input_mean=zeros, input_scale=zeros)
        estimator = Estimator(body, options)
        _, _, detector = seen(estimator, ChangeDetector(estimator.columns), [], samples)
        found.append(detector._before[3][1])
    np.testing.assert_allclose(found[0], 0.25 * found[1], rtol=0.05, atol=1e-3 * np.abs(found[1]).max())


def test_nothing_is_told_where_nothing_changes():
    found, touched, detector = told(*free())
    assert not found
    assert detector.knows
    assert touched.mean() < 0.05


def test_what_the_model_learns_when_a_joint_begins_to_move_is_no_change():
    body, samples = elbow_rests()
    stage = offered(body, samples[samples.time < 100.0])
    assert not stage.changes
    assert stage.learner.changes.state == 'as it was'
    assert stage.learner.changes.detector.before is None, 'it goes on with what was learnt'


@pytest.mark.parametrize('usual', [1.0, 1e4])
def test_what_the_model_does_not_know_yet_is_learnt_whatever_noise_is_usual(usual):
    """A first window that was predicted badly made friction that was not known yet a change."""
    body, samples = free()
    detector = told(body, samples[samples.time < 40.0])[2]
    for each in detector._usual:
        each._squares.extend([np.full(len(detector.causes), usual)] * USUAL)
    (offset,) = (cause.part for cause in detector.causes if cause.kind == 'sensor_offset')
    own = np.isin(detector._own_part, np.arange(offset.start, offset.stop))
    detector._covariance = np.diag(own.astype(float))
    theta = np.random.default_rng(0).standard_normal(own.sum())
    scale = 200.0 * usual / (theta @ sum(block.gram[offset, offset] for block in detector._blocks) @ theta)
    for number, block in enumerate(detector._blocks):
        moment, sums = scale * block.gram[:, offset] @ theta, block.own.copy()
        sums[-1] = theta @ moment[offset] / len(sums[-1])
        detector._blocks[number] = block._replace(gram=scale * block.gram, moment=moment, own=sums)
    best, learns, elsewhere = detector._likeliest(None)
    assert learns and not elsewhere
    assert best.evidence < 0.0


def test_blocks_alike_count_as_they_are_beside_others_that_tell_nothing():
    body, samples = free()
    detector = told(body, samples[samples.time < 40.0])[2]
    blocks = list(detector._blocks)
    nothing = [block._replace(gram=0.0 * block.gram, moment=0.0 * block.moment, unlike=1.0) for block in blocks[-8:]]
    detector._blocks.extend([block._replace(moment=10.0 * block.moment) for block in blocks[:-8]] + nothing)
    grams, moments = (np.array([getattr(block, name) for block in detector._blocks]) for name in ('gram', 'moment'))
    starts, kappa = np.arange(0, len(blocks), 4), np.full(len(range(0, len(blocks), 4)), detector.noise)
    root = detector._root_unlearnt()
    unchanged = detector._learning(root, *(np.array([values[start:].sum(axis=0) for start in starts])
                                           for values in (grams, moments)))
    familiar, elsewhere = detector._learnt_better(root, unchanged, grams, moments, starts, kappa)
    assert np.abs(familiar).max() > 1.0
    np.testing.assert_allclose(elsewhere, familiar, atol=1e-9)


@pytest.mark.parametrize(('seed', 'newton'), [(3, 15.0), (4, 30.0)])
def test_a_push_is_a_contact_and_no_change(seed, newton):
    """The second one was a load of -1.5 kg while a contact was no wrench."""
    body, samples = pushed(seed=seed, newton=newton)
    found, touched, _ = told(body, samples)
    pushing = (samples.time > 71.0) & (samples.time < 74.5)
    assert not found
    assert touched[pushing].mean() > 0.9
    assert not touched[samples.time > 85.0].any()


@pytest.mark.parametrize('times', [0.1, pytest.param(1000.0, marks=pytest.mark.long)])
def test_a_push_is_a_contact_on_an_arm_of_any_size(times):
    """Pushes were expected to be of 100 N: of 1.5 N or 15 kN they were jumps of the sensor and loads."""
    samples = pushed()[1]
    found, *_ = told(*heavier(times, samples[samples.time < 90.0]))
    assert not found


def test_a_load_has_its_mass_on_an_arm_of_two_tonnes():
    _, samples, mass = loaded()
    (first, *_), *_ = told(*heavier(1000.0, samples[samples.time < 90.0]))
    assert first.kind == 'payload' and first.noticed - samples.origin < 71.5e9
    assert first.value == pytest.approx(1000.0 * mass, rel=0.25)


def test_what_acts_longer_than_a_contact_does_is_a_change():
    """A contact that never ended was as likely as a cable that had caught: nothing was told of it."""
    body, samples = caught(stiffness=80.0)
    found, _, _ = told(body, samples[samples.time < 80.0])
    assert found[0].kind == '', 'no listed kind explains it as well'
    noticed, touched = ((stamp - samples.origin) * 1e-9 for stamp in (found[0].noticed, found[0].touched))
    assert noticed < 77.5
    assert abs(touched - 70.0) < 2.0


def test_the_evidence_of_a_contact_is_that_of_a_random_walk():
    rng, blocks, samples, n, k, kappa = np.random.default_rng(3), 4, 5, 3, 2, 1.7
    maps = rng.standard_normal((blocks, samples, n, k))
    time = np.tile(np.arange(samples) / samples, blocks)
    variance, outputs = np.array([4.0, 0.5]), rng.standard_normal(blocks * samples * n)
    # rows of all samples for the values at the edges of all blocks
    rows = np.zeros((blocks, samples, n, blocks + 1, k))
    for block in range(blocks):
        share = time[block * samples:(block + 1) * samples, None, None]
        rows[block, :, :, block] = (1.0 - share) * maps[block]
        rows[block, :, :, block + 1] = share * maps[block]
    each = rows.reshape(blocks, samples * n, -1)
    inside = [slice(k * block, k * (block + 2)) for block in range(blocks)]
    grams = np.array([row[:, part].T @ row[:, part] for row, part in zip(each, inside, strict=True)])
    pulled = outputs.reshape(blocks, -1)
    moments = np.array([row[:, part].T @ y for row, part, y in zip(each, inside, pulled, strict=True)])
    found = wandering(
        grams[:, None], moments[:, None], variance[None], np.array([kappa]), np.array([blocks, 2])
    )[..., 0]
    for column, end in enumerate((blocks, 2)):
        assert not found[end:, :, column].any()
        for begin in range(end):
            design, y = rows[begin:end].reshape(-1, (blocks + 1) * k), pulled[begin:end].ravel()
            steps = end - np.minimum(np.arange(blocks + 1), end)
            for row, share in enumerate(WANDERS):
                walk = 1.0 + share**2 * np.minimum.outer(steps, steps)
                noise = kappa * np.eye(len(y))
                prior = np.kron(walk, np.diag(variance))
                expected = multivariate_normal(cov=design @ prior @ design.T + noise).logpdf(y)
                expected -= multivariate_normal(cov=noise).logpdf(y)
                assert found[begin, row, column, 0] == pytest.approx(expected, rel=1e-9)


def test_a_joint_that_slides_feels_the_force_of_a_contact_whatever_it_carries():
    """It was a force [N] times a length [m]: a push that a short lift felt was too large to be one."""
    lift, *others = contact_scale(ODD_BODY) / push_force(ODD_BODY)
    assert lift == 1.0
    assert others == pytest.approx([size_beyond(ODD_BODY, joint).length for joint in ODD_JOINTS[1:]])


def test_a_jump_of_the_sensor_is_told_from_a_load():
    body, samples = free()
    jump = 0.5 * samples.outputs.std(axis=0) * np.array([1.0, -1.0, 1.0, 1.0, 1.0, -1.0])
    samples = replace(samples, outputs=samples.outputs + jump * (samples.time >= 70.0)[:, None])
    found, _, _ = told(body, samples)
    assert found[-1].kind == 'sensor_offset'
    assert found[-1].ended is None


def test_a_load_that_comes_again_is_told_again():
    body, samples, _ = loaded()
    again = loaded((115.0, 130.0))[1]
    outputs = np.where((samples.time >= 110.0)[:, None], again.outputs, samples.outputs)
    found, _, _ = told(body, replace(samples, outputs=outputs))
    assert {change.kind for change in found} == {'payload'}
    assert found[-1].number > found[0].number
    assert found[-1].ended is None


def test_a_jump_of_the_clock_drops_what_was_half_seen():
    body, samples, _ = loaded()
    _, _, detector = told(body, samples[samples.time < LOADED_S[0] + 3.0])
    detector.reset()
    assert detector.followed is None
    assert detector.knows, 'what is usual stays'


def test_what_was_known_before_an_effect_was_applied_is_kept_when_a_later_change_is_part_of_the_robot():
    """It was changed in place: taken back, the load left a model of before with the other change in it."""
    _, detector, _ = beginning(free()[0])
    detector._reference = np.ones(detector._n_own)
    before = detector.reference
    detector.resume(before)
    n, k = len(detector._names), detector._directions.shape[1]
    (jump,) = [cause for cause in detector.causes if cause.kind == 'sensor_offset']
    judged = Judged(jump, 1, np.ones(6), np.eye(6), 20.0)
    block = MotionBlock(0, 10**9, np.zeros((k, k)), np.zeros(k), (np.zeros(k), 0.0), 0.0, np.ones((6, n)),
                        np.zeros((2, n, k)), (np.zeros((12, 12)), np.zeros(12), np.zeros((12, k))), np.zeros((0, 2, n)))
    for _ in range(2):
        detector._blocks.append(block)
        detector._change(10**9, judged)
        detector.followed.blocks = JUDGED_ANEW
    assert (detector.reference != 1.0).any() and (before == 1.0).all()


@pytest.mark.parametrize('seconds', [6.0, 20.0])
def test_a_load_is_named_with_its_mass_and_its_time(seconds):
    body, samples, mass = loaded()
    seen = samples[(samples.time > 10.0) & (samples.time < LOADED_S[0] + seconds)]
    found = name_change(body, seen, [], LOADED_S[0] - 0.8)
    assert found.effect.kind == 'payload'
    assert abs(found.effect.start_s - LOADED_S[0]) < 0.15
    value = found.parameters['mass']
    assert abs(value.value - mass) < max(3.0 * value.std, 0.05 * mass)
    assert found.after['nmse_mean'] < 0.5 * found.without['nmse_mean']
    assert abs(found.seconds - seconds) < 2.0


def test_a_jump_that_was_noticed_late_is_named_with_its_time():
    """Its time was searched within two seconds of when it seemed to begin."""
    body, samples = free()
    jump = 0.5 * samples.outputs.std(axis=0)
    later = replace(samples, outputs=samples.outputs + jump * (samples.time >= 70.0)[:, None])
    found = name_change(body, later[samples.time < 80.0], [], 74.0)
    assert found.effect.kind == 'sensor_offset'
    assert abs(found.effect.start_s - 70.0) < 0.15


def test_a_load_that_was_put_down_is_named_with_its_end():
    body, samples, mass = loaded()
    found = name_change(body, samples, [], LOADED_S[0], LOADED_S[1] + 0.5)
    assert (found.effect.kind, round(found.effect.end_s)) == ('payload', LOADED_S[1])
    assert abs(found.parameters['mass'].value - mass) < 0.05 * mass


def test_no_effect_is_named_where_nothing_changed():
    body, samples = free()
    assert name_change(body, samples, [], 70.0).effect is None


@pytest.mark.parametrize(('until', 'helps'), [(130.0, True), (LOADED_S[1], False)])
def test_what_was_found_helps_as_long_as_it_is_there(until, helps):
    body, samples, _ = loaded((LOADED_S[0], until))
    found = effect_from_text(f'payload@r_gripper {{"start_s": {LOADED_S[0]}}}')
    gain = gain_since(body, samples, LOADED_S[1], [], [found])
    assert (gain.total > 12.0) if helps else (gain.total < -12.0)


def test_a_node_that_is_told_a_name_loads_nothing_of_the_diagnosis():
    """Its first name loaded 186 modules, scipy.optimize among them, in the process that answers: 30 to 80 MB."""
    body, samples, _ = loaded()
    batch = batch_of((sample, True) for sample in samples[(samples.time > 10.0) & (samples.time < 76.0)])
    since = samples.origin + round((LOADED_S[0] - 0.8) * 1e9)
    named = diagnosis_jobs.name_change(body, batch, [], (since, since), None, None, ())
    again = diagnosis_jobs.name_change(body, batch, [], (since, since), None, named.inputs, ())
    assert named.effect.kind == 'payload' and again.effect.where == named.effect.where
    code = ('import pickle, sys, semiparam_ros.ros.estimator.node; before = set(sys.modules); '
            'print(pickle.load(sys.stdin.buffer).effect.kind, *sorted(set(sys.modules) - before))')
    told = subprocess.run([sys.executable, '-c', code], input=pickle.dumps(named), capture_output=True, check=True)
    kind, *loaded_now = told.stdout.decode().split()
    assert (kind, loaded_now) == ('payload', ['semiparam_ros.diagnosis', 'semiparam_ros.diagnosis.named_change'])


@pytest.mark.parametrize('diagnosed', [40.0, 500.0, LOADED_S[1]])
def test_what_was_found_is_judged_also_long_after_it_and_after_the_clock_went_back(diagnosed):
    """Neither left samples from before the diagnosis to compare with: its effects were declared unchecked."""
    body, samples, _ = loaded((LOADED_S[0], LOADED_S[1]))
    batch = batch_of((sample, True) for sample in samples[(samples.time > 60.0) & (samples.time < 140.0)])
    stamp = samples.origin + round(diagnosed * 1e9)
    found = effect_from_text(f'payload@r_gripper {{"start_s": {LOADED_S[0]}}}').at_stamps(samples.origin)
    gain = diagnosis_jobs.gain_since(body, batch, stamp, [], [found], ())
    assert gain is not None
    assert gain < -12.0


def test_a_push_that_holds_a_load_up_says_nothing_against_it():
    body, samples, mass = loaded((LOADED_S[0], 130.0))
    up = pushed(start=105.0, seconds=20.0, force=(0.0, 0.0, 20.0 * mass))[1].outputs - free()[1].outputs
    held = replace(samples, outputs=samples.outputs + up)
    found = effect_from_text(f'payload@r_gripper {{"start_s": {LOADED_S[0]}}}')
    blind, told_of_it = (gain_since(body, held, LOADED_S[1], [], [found], contacts=contacts).total
                         for contacts in ((), ((104.5, 125.5),)))
    assert blind < -12.0
    assert told_of_it > 12.0


@pytest.mark.parametrize('begun', [70.0, 99.0, 99.98, 110.0])
def test_an_effect_that_came_later_is_not_over_before_it_came(begun):
    """A change that was named anew while a later one was known: "ends at 38.22 s and begins at 70 s"."""
    body, samples, _ = loaded()
    later = effect_from_text(f'payload@r_gripper {{"start_s": {begun}}}')
    found = name_change(body, samples, [later], 100.0)
    assert found.effect is None or found.effect.end_s is None or found.effect.end_s > (found.effect.start_s or 0.0)


@pytest.mark.parametrize('seconds', [pytest.param(5.0, marks=pytest.mark.long), 20.0])
def test_a_push_that_is_known_is_left_out_of_a_diagnosis(seconds):
    """Offsets of the sensor were told, or a force; and without the outputs of the push, that no inertias explain it."""
    body, samples = pushed(seconds=seconds)
    batch = batch_of((sample, True) for sample in samples[(samples.time > 55.0) & (samples.time < 100.0)])
    begin, end = (samples.origin + round(at * 1e9) for at in (69.5, 70.5 + seconds))
    assert diagnose(body, batch, []).report['verdict'] == 'effect_found'
    assert diagnose(body, batch, [], contacts=[(begin, end)]).report['verdict'] == 'nothing_missing'


def test_a_declared_load_that_was_put_down_ends_and_is_no_second_force():
    body, samples, _ = loaded()
    declared = effect_from_text(f'payload@r_gripper {{"start_s": {LOADED_S[0]}}}')
    found = name_change(body, samples[samples.time > 30.0], [declared], LOADED_S[1] + 0.5)
    assert (found.effect.kind, found.effect.where) == ('payload', 'r_gripper')
    assert found.effect.start_s == pytest.approx(LOADED_S[0], abs=0.2)
    assert found.effect.end_s == pytest.approx(LOADED_S[1], abs=0.2)


def test_friction_that_passed_for_an_offset_is_not_over_when_its_joint_turns():
    """The offset of a joint that had gone one way was over as soon as a contact is: the robot had not changed."""
    body, samples = rubbing_from(22.0)
    settings = replace(ARM, outputs='effort', sensor_frame='', variant='P', initial_samples=120)
    stage = Stage(settings, background=InlineBackground(), body=body)
    stage.offer(samples[samples.time < 22.0])
    detector = stage.learner.changes.detector
    causes = detector.causes
    detector.causes = [cause._replace(price=-60.0) if cause.kind == 'effort_offset' else cause for cause in causes]
    stage.offer(samples[(samples.time >= 22.0) & (samples.time < 27.0)])
    followed = detector.followed
    assert (followed.change.kind, followed.change.where) == ('effort_offset', 'a')
    detector.causes, followed.cause = causes, causes[detector.causes.index(followed.cause)]
    stage.offer(samples[samples.time >= 27.0])
    assert not stage.failures
    (record,) = stage.learner.changes.records.values()
    assert (record.change.kind, record.change.where, record.change.ended) == ('friction', 'a', None)
    assert record.change == detector.followed.change and not record.retracted


def rubbing_from(start):
    """The body of two joints, and samples of which from a time [s] on the first joint rubs, and turns every 6 s."""
    motion = smooth_motion(2, 1000, 30.0, seed=3, speed=0.6)
    late, phase = motion.time >= start, np.pi / 6.0 * (motion.time - start)
    rows = {name: getattr(motion, name).copy() for name in ('position', 'velocity', 'acceleration')}
    waves = 1.0 - np.cos(phase), np.sin(phase), np.cos(phase)
    for order, (values, wave) in enumerate(zip(rows.values(), waves, strict=True)):
        values[late, 0] = (0.8 * (np.pi / 6.0) ** order * wave)[late] + (values[late, 0][0] if order == 0 else 0.0)
    motion = replace(motion, **rows)
    body = build_rigid_body(replace(ARM, outputs='effort', sensor_frame=''))
    outputs = body.regressors(motion) @ (1.2 * body.base_parameters) + 0.1 * np.tanh(motion.velocity / 0.01)
    outputs[:, 0] += 0.4 * late * np.tanh(motion.velocity[:, 0] / 0.01)
    return body, replace(motion, outputs=noisy(outputs))


def test_motion_unlike_all_that_was_learnt_is_no_change():
    """How wrong a rigid body is elsewhere its own covariance does not tell: an offset of the sensor was told after five
    seconds, something of no known kind after fifteen."""
    settings = replace(load_params(REPOSITORY / 'config' / 'icub_right_arm.yaml'), variant='P')
    learnt, other = (load_samples(REPOSITORY / 'bags' / f'icub_{plane}.mcap', settings) for plane in ('xy', 'xz'))
    settings = replace(settings, robot_description=learnt.robot_description, robot_description_file='')
    stage = Stage(settings, InlineBackground(), build_rigid_body(settings))
    stage.offer(learnt.samples[:1200])
    then = other.samples[:600]
    stage.offer(replace(then, stamps=then.stamps + int(learnt.samples.stamps[1200] - then.stamps[0])))
    assert not stage.changes
    fates = np.array([answer.learning for answer in stage.answers[1200:]])
    assert (fates == Learning.YES).mean() > 0.85, 'what stood out is learnt once it is told'
    assert stage.learner.changes.detector.knows
