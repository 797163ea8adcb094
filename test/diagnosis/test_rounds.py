"""The rounds of a search: each helps on unseen blocks, none leads back, and joints at rest tell nothing of friction."""

import gc
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from conftest import SHARED_DATA
from semiparam_ros.bags.loading import load_samples
from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.consistency import pseudo_inertia
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.config import DEFAULTS
from semiparam_ros.diagnosis.data.outliers import counted_outputs, resting
from semiparam_ros.diagnosis.diagnose import _unlike, diagnose
from semiparam_ros.diagnosis.evaluation import evaluation_of
from semiparam_ros.diagnosis.named_change import Gain
from semiparam_ros.diagnosis.preparation import BUT_ACCELERATIONS, ESTIMATED, best_inputs
from semiparam_ros.diagnosis.regression import Fit, fit_model, refitted, with_effects
from semiparam_ros.diagnosis.search import stepwise
from semiparam_ros.diagnosis.search.candidates import added_columns, candidates, held
from semiparam_ros.diagnosis.search.moves import Move, simplest, swapping_moves
from semiparam_ros.diagnosis.search.plausibility import all_plausible
from semiparam_ros.diagnosis.search.refit import declare, gauss_newton
from semiparam_ros.diagnosis.search.score import gain
from semiparam_ros.diagnosis.search.stepwise import Rival, Step, _rivalries, _rivals, search, starting_fit
from semiparam_ros.diagnosis.text_report import text_report
from semiparam_ros.effects import effect_from_text, kinds
from semiparam_ros.effects.base import Span
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.settings import load_params
from semiparam_ros.settings.build import build_rigid_body
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate
from support.arms import ODD_ARM, ODD_BODY, ODD_JOINTS, noisy, smooth_motion
from support.plain_calibration import further_calibrated_error
from support.plain_model import nmse, plain_model

BODY = ODD_BODY
COUNT = 1500
RUBBING = ('viscous_friction', 'coulomb_friction', 'stribeck_friction', 'asymmetric_friction', 'load_friction')


def moving(seed=0):
    """An odd arm in motion; its efforts with 1 % of noise."""
    motion = smooth_motion(4, COUNT, seed=seed, speed=0.5)
    return replace(motion, outputs=noisy(BODY.regressors(motion) @ BODY.base_parameters, seed=seed))


def rubbing(samples, coulomb, viscous, turn_speed=0.01):
    friction = coulomb * np.tanh(samples.velocity / turn_speed) + viscous * samples.velocity
    return replace(samples, outputs=samples.outputs + friction)


def with_rests(joint=1):
    """One joint in moves of a second and rests of two, while static friction holds any effort at it."""
    samples, rng = moving(), np.random.default_rng(3)
    time = samples.time % 3.0
    number = (samples.time // 3.0).astype(int)
    aims = np.cumsum(rng.uniform(-1.0, 1.0, number.max() + 2)) * 0.4
    s = np.clip(time, 0.0, 1.0)
    step = (aims[1:] - aims[:-1])[number]
    position, velocity, acceleration = (getattr(samples, role).copy()
                                        for role in ('position', 'velocity', 'acceleration'))
    position[:, joint] = aims[number] + step * (10 * s**3 - 15 * s**4 + 6 * s**5)
    velocity[:, joint] = step * (30 * s**2 - 60 * s**3 + 30 * s**4)
    acceleration[:, joint] = step * (60 * s - 180 * s**2 + 120 * s**3)
    samples = replace(samples, position=position, velocity=velocity, acceleration=acceleration)
    exact = BODY.regressors(samples) @ BODY.base_parameters
    friction = 3.5 * np.sign(velocity[:, joint]) + 2.8 * velocity[:, joint]
    still = time >= 1.0
    held_by = rng.uniform(-8.0, 8.0, number.max() + 1)[number]
    exact[:, joint] += np.where(still, held_by, friction)
    return replace(samples, outputs=exact + 0.02 * rng.standard_normal(exact.shape)), still


def test_a_joint_at_rest_tells_nothing_while_others_move():
    samples, still = with_rests()
    counted = counted_outputs(BODY, samples)
    assert counted[:, [0, 2, 3]].mean() > 0.98
    assert not counted[still, 1].any()
    assert counted[~still, 1].mean() > 0.5
    assert counted_outputs(RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'wrench', 'mid_link_ft'),
                           replace(samples, outputs=np.zeros((COUNT, 6)))).all()


def test_a_joint_that_rests_wherever_it_is_judged_is_judged_all_the_same():
    """No error at all would pass for a perfect one."""
    rng = np.random.default_rng(0)
    outputs, residual = rng.standard_normal((2, 100, 4))
    counted = np.ones((100, 4), dtype=bool)
    counted[:, 2] = False
    valid = np.arange(100) < 60
    judged = evaluation_of(BODY, outputs, residual, valid, counted=counted)
    assert judged.nmse == pytest.approx(np.mean(residual[valid] ** 2, axis=0) / outputs[valid].var(axis=0))
    assert nmse(residual, outputs, valid[:, None] & counted) == pytest.approx(judged.nmse)


def test_a_slower_recording_that_judges_is_averaged_as_its_own_rate_asks():
    """A mean of twelve samples at 40 Hz was over 0.3 s, and what it left was told as the error of the model."""
    fast, slow = (replace(motion, outputs=BODY.outputs_of(motion, 1.1 * BODY.base_parameters))
                  for motion in (smooth_motion(4, 3600, rate=500.0), smooth_motion(4, 800, rate=40.0, seed=1)))
    found = diagnose(BODY, fast, other=('slow', slow), only=['time_delay'])
    assert found.before.nmse.max() < 1e-6
    ranges = found.as_dict()['held_out']['ranges']
    assert sum(end - start for start, end in ranges) == found.elsewhere.valid.sum() > 700


def test_what_is_left_is_a_share_of_the_outputs_that_count():
    """Where joints rest nine times in ten, a model that left all seemed to leave a tenth."""
    samples, counted = moving(), np.arange(COUNT)[:, None] % 20 < np.array([1, 20, 20, 20])
    fit = starting_fit(BODY, samples, [], np.ones(COUNT, dtype=bool), counted=counted)
    deviation = samples.outputs - samples.outputs.mean(axis=0)
    assert _unlike(replace(fit, residual=deviation * [1.0, 0.0, 0.0, 0.0]))
    assert not _unlike(replace(fit, residual=deviation * [0.1, 0.0, 0.0, 0.0]))


def test_a_joint_that_moves_where_it_is_judged_alone_is_fitted_all_the_same():
    """No output of it was left to tell its noise, and the diagnosis ended in an error."""
    samples, counted = moving(), np.ones((COUNT, 4), dtype=bool)
    counted[:, 2] = np.arange(COUNT) < 200
    fit = starting_fit(BODY, samples, [], np.arange(COUNT) >= 180, counted=counted)
    assert np.all(fit.counts == COUNT - 180) and np.all(np.isfinite(fit.theta))


def test_a_joint_that_never_moves_still_counts_and_one_that_turns_back_does_not_rest():
    samples = moving()
    position = samples.position.copy()
    position[:, 2] = 0.3
    assert counted_outputs(BODY, replace(samples, position=position))[:, 2].all()
    assert resting(samples).mean() < 0.03


def test_a_joint_that_sticks_where_it_turns_back_rests():
    """For a seventh of a second: static friction then changes sides while nothing moves, and seems to come early."""
    samples = moving()
    turns = np.flatnonzero(np.diff(np.sign(samples.velocity[:, 1])))
    turn = int(turns[np.argmax(np.abs(samples.acceleration[turns, 1]))])
    count = round(0.14 / np.diff(samples.time).mean())
    position = samples.position.copy()
    position[turn:turn + count, 1] = position[turn, 1]
    counted = counted_outputs(BODY, replace(samples, position=position))
    assert not counted[turn:turn + count, 1].any()
    assert counted[:, 1].mean() > 0.97


def test_the_motion_is_chosen_beside_friction():
    """Friction hid that the recorded motion, without accelerations, explains less than any that has some."""
    samples = replace(rubbing(moving(), 40.0, 20.0), acceleration=np.zeros((COUNT, 4)))
    samples = replace(samples, velocity=samples.velocity + 0.02 * np.random.default_rng(0).standard_normal((COUNT, 4)))
    chosen = best_inputs(BODY, samples, [], np.ones(COUNT, dtype=bool))
    assert chosen.motion in ESTIMATED


def test_late_outputs_choose_no_late_motion():
    """Filtered accelerations that came as late as the outputs explained these better, and hid a part of the delay: one
    of 15 ms was told as 12 ms, beside a force and a drift that were not there."""
    exact, rng = moving(), np.random.default_rng(0)
    samples = replace(exact[2:], velocity=exact.velocity[1:-1], acceleration=exact.acceleration[:-2],
                      outputs=exact.outputs[:-2],
                      position=exact.position[2:] + 1e-5 * rng.standard_normal(exact.position[2:].shape))
    chosen = best_inputs(BODY, samples, [], np.ones(COUNT - 2, dtype=bool))
    assert chosen.lags == pytest.approx((0.05, 0.1), abs=0.02)
    assert chosen.motion not in ('recorded', BUT_ACCELERATIONS)


def test_static_friction_is_neither_fitted_nor_judged():
    """What holds the joint at rest would pass for dry friction twice as large, and hide the viscous one."""
    samples, _ = with_rests()
    found = diagnose(BODY, samples, only=['viscous_friction', 'coulomb_friction', 'effort_offset'])
    values = {(finding.effect.kind, finding.effect.where): next(iter(finding.parameters.values())).value
              for finding in found.findings}
    assert set(values) == {('coulomb_friction', 'turn'), ('viscous_friction', 'turn')}
    assert values['coulomb_friction', 'turn'] == pytest.approx(3.5, rel=0.1)
    assert values['viscous_friction', 'turn'] == pytest.approx(2.8, rel=0.15)
    assert found.after.nmse[1] < 1e-3


def test_no_two_models_improve_on_each_other():
    """Friction that differs between the directions, and dry beside viscous friction, took turns."""
    samples = rubbing(moving(), np.array([0.0, 2.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0]))
    fit = starting_fit(BODY, samples, [], np.ones(COUNT, dtype=bool))
    one = declare(fit, [kinds()['asymmetric_friction']('turn', {'turn_speed': 0.01})])
    other = declare(fit, [kinds()['coulomb_friction']('turn', {'turn_speed': 0.01}),
                          kinds()['viscous_friction']('turn', {})])
    assert min(gain(fit, one).total, gain(fit, other).total) > 100.0
    assert gain(one, other).total <= 0.0 or gain(other, one).total <= 0.0


def test_what_a_model_holds_as_a_part_is_no_candidate():
    samples = moving()
    use, scale = np.ones(COUNT, dtype=bool), np.ones(4)
    asymmetric = kinds()['asymmetric_friction']('turn', {'turn_speed': 0.01})
    assert held([asymmetric]) == {(kind, 'turn') for kind in (
        'asymmetric_friction', 'coulomb_friction', 'viscous_friction')}
    tried = {(kind.kind, where)
             for kind, where in candidates(fit_model(BODY, samples, [asymmetric], use, scale))}
    assert not tried & held([asymmetric]) and ('coulomb_friction', 'grip') in tried


def test_of_two_effects_with_a_part_in_common_the_later_one_is_declared():
    """Beside each other their dry friction cancelled: -9 and 10 N m were told of a joint with 1.5."""
    parts = {'stribeck_friction': {'turn_speed': 0.01, 'stribeck_speed': 0.1},
             'asymmetric_friction': {'turn_speed': 0.01}, 'viscous_friction': {}}
    sticking, asymmetric, viscous = (kinds()[kind]('turn', dict(values)) for kind, values in parts.items())
    fit = fit_model(BODY, moving(), [], np.ones(COUNT, dtype=bool), np.ones(4))
    assert [effect.kind for effect in declare(fit, [viscous, sticking, asymmetric]).effects] == ['asymmetric_friction']
    assert [effect.kind for effect in declare(fit, [asymmetric, sticking]).effects] == ['stribeck_friction']
    elsewhere = kinds()['stribeck_friction']('grip', dict(parts['stribeck_friction']))
    assert len(declare(fit, [viscous, sticking, elsewhere]).effects) == 3


def test_friction_that_differs_stands_beside_no_offset_but_one_that_comes():
    """Where a joint slides both are one freedom, which its turns alone tell apart: of 0.88 and 0.72 N m were told 0.98
    and 0.62, each 8 deviations off, beside an offset of -0.10."""
    samples = moving()
    asymmetric = kinds()['asymmetric_friction']('turn', {'turn_speed': 0.01})
    offset = kinds()['effort_offset']('turn')
    fit = fit_model(BODY, samples, [], np.ones(COUNT, dtype=bool), np.ones(4))
    assert [effect.kind for effect in declare(fit, [offset, asymmetric]).effects] == ['asymmetric_friction']
    jump = replace(offset, span=Span(float(samples.time[COUNT // 2])))
    assert [effect.span for effect in declare(fit, [jump, asymmetric]).effects] == [jump.span, Span()]
    assert ('effort_offset', 'turn') in {(kind.kind, where) for kind, where in candidates(declare(fit, [asymmetric]))}


def test_friction_that_differs_is_found_where_a_plainer_one_is_held_already():
    """What it adds to that one has opposite signs, so it seemed to drive the joint, and was never tried."""
    samples = moving()
    speed, outputs = samples.velocity[:, 1], samples.outputs.copy()
    outputs[:, 1] += np.where(speed > 0.0, 2.0, 0.8) * np.tanh(speed / 0.01) + speed
    plain = [effect_from_text('coulomb_friction@turn{"turn_speed": 0.01}'), effect_from_text('viscous_friction@turn')]
    found = diagnose(BODY, replace(samples, outputs=outputs), plain, only=RUBBING)
    assert [(each.effect.kind, each.effect.where) for each in found.findings] == [('asymmetric_friction', 'turn')]
    assert any(line.startswith('Declared, but dropped, because') for line in text_report(found))
    for name, value in {'coulomb_forward': 2.0, 'coulomb_backward': 0.8, 'viscous_forward': 1.0}.items():
        assert found.findings[0].parameters[name].value == pytest.approx(value, rel=0.1)


def test_a_declared_zero_that_is_wrong_is_told_with_its_own_value():
    """Beside nothing else it stayed as it was declared, and the rest was said to be what no kind explains."""
    motion = smooth_motion(4, COUNT, speed=0.5)
    there = BODY.regressors(replace(motion, position=motion.position + 0.06 * np.eye(4)[2])) @ BODY.base_parameters
    samples = replace(motion, outputs=there + 0.01 * there.std(axis=0)
                      * np.random.default_rng(0).standard_normal(there.shape))
    told = {value: diagnose(BODY, samples, [effect_from_text(f'joint_offset@elbow{{"offset": {value}}}')],
                            only=['joint_offset', 'gravity_tilt']) for value in (0.06, -0.02)}
    assert told[0.06].verdict == 'nothing_missing' and not told[0.06].findings
    assert [(each.effect.kind, each.effect.where) for each in told[-0.02].findings] == [('joint_offset', 'elbow')]
    offset = told[-0.02].findings[0].parameters['offset']
    assert offset.value == pytest.approx(0.06, abs=3.0 * offset.std)
    opening, line, *_ = text_report(told[-0.02])
    assert opening == 'One effect has other values than declared.' and 'declared with offset -0.02 rad' in line
    assert not told[-0.02].declared


def test_values_of_what_was_declared_rest_on_all_samples_where_nothing_is_found_too():
    """They rested on the two thirds that fit, and were other ones once anything else was found."""
    samples = rubbing(moving(), np.zeros(4), np.array([0.0, 2.0, 0.0, 0.0]))
    found = diagnose(BODY, samples, [effect_from_text('viscous_friction@turn')], only=RUBBING)
    assert found.verdict == 'nothing_missing' and [each.effect.kind for each in found.declared] == ['viscous_friction']
    assert (found.everything.train_mask == found.first.train_mask | found.held_out).all()
    anew = fit_model(BODY, found.first.samples, found.first.effects, found.everything.train_mask,
                     found.everything.scale, counted=found.first.counted)
    np.testing.assert_allclose(found.everything.theta, anew.theta, rtol=1e-6, atol=1e-9)


def test_a_declared_friction_of_the_wrong_form_is_told_with_its_own_form():
    """The model was said to lack no effect, though one was found."""
    samples = rubbing(moving(), np.array([0.0, 2.0, 0.0, 0.0]), np.zeros(4), turn_speed=0.005)
    late = effect_from_text('coulomb_friction@turn{"turn_speed": 0.005, "lead_s": 0.02}')
    found = diagnose(BODY, samples, [late], only=[*RUBBING, 'backlash'])
    assert [(each.effect.kind, each.effect.where) for each in found.findings] == [('coulomb_friction', 'turn')]
    assert abs(found.findings[0].effect.value('lead_s')) < 0.001 and not found.declared
    assert text_report(found)[0] == 'One effect has other values than declared.'


def test_friction_of_all_joints_is_found_in_one_round_and_every_round_improves_the_same_score(long):
    dry, viscous = np.array([1.0, 2.0, 0.5, 0.1]), np.array([2.0, 1.0, 0.3, 0.05])
    found = diagnose(BODY, rubbing(moving(1), dry, viscous, 0.02), only=() if long else RUBBING)
    expected = {(kind, joint) for kind in ('coulomb_friction', 'viscous_friction') for joint in ODD_JOINTS}
    assert {(effect.kind, effect.where) for effect in found.steps[0].added} == expected
    assert {(finding.effect.kind, finding.effect.where) for finding in found.findings} == expected
    for finding in found.findings:
        size = (dry if finding.effect.kind == 'coulomb_friction' else viscous)[ODD_JOINTS.index(finding.effect.where)]
        assert next(iter(finding.parameters.values())).value == pytest.approx(size, rel=0.1)
    models = [found.first, *(step.after for step in found.steps)]
    assert all(gain(before, after).total > 0.0 for before, after in pairwise(models)) and len(models) > 1


def test_a_round_that_is_over_keeps_none_of_what_its_models_and_trials_computed():
    """Of an hour's samples these are 100 MB and more in every round."""
    body, samples = BODY, rubbing(moving(2)[:600], np.zeros(4), np.array([0.0, 1.0, 0.0, 0.5]))
    steps = search(starting_fit(body, samples, (), np.ones(600, dtype=bool)))
    assert len(steps) > 0
    for step in steps:
        assert not {'design', 'sliding', 'corrected', 'asked'} & vars(step.before).keys()
        assert all(trial.residual is None for trial in step.ranking)
    others = [one for one in gc.get_objects() if isinstance(one, Fit) and one is not steps[-1].after]
    assert not [one for one in others if one.body is body and one.samples is samples and 'design' in vars(one)]


def test_moves_keep_sums_of_blocks_alone():
    """Where one of them is a delay all are compared as joints slide: of a Panda's five minutes that was 150 MB each."""
    friction = [effect_from_text(f'viscous_friction@{joint}') for joint in ODD_JOINTS]
    samples = rubbing(moving(2)[:600], np.zeros(4), np.ones(4))
    fit = declare(starting_fit(BODY, samples, (), np.ones(600, dtype=bool)), friction)
    effects = [effect_from_text(text) for text in ('time_delay{"delay_s": 0.0}', 'rotor_inertia@turn', 'payload@tool')]
    moves = [Move.of((effect,), fit, declare(fit, [effect]), 0.0) for effect in effects]
    assert all('sums' in vars(move.after) for move in moves[1:]), 'the delay is judged where joints slide'
    best = simplest(moves)
    others = [move.after for move in moves if move is not best]
    for _ in range(2):
        assert not [1 for fit in others if {'design', 'sliding', 'corrected', 'asked'} & vars(fit).keys()]
        _rivals(fit, best, moves)


@pytest.mark.parametrize('text', [
    'coulomb_friction@turn{"turn_speed": 0.02}', 'rotor_inertia@grip', 'payload@tool', 'effort_gain@turn{"gain": 0.1}',
    'time_delay{"delay_s": 0.01}', 'load_friction@turn{"turn_speed": 0.02}'])
def test_a_model_made_of_another_ones_parts_is_the_same_as_one_made_anew(text):
    samples, scale, use = moving(5)[:600], np.array([1.0, 2.0, 0.5, 0.1]), np.arange(600) % 200 < 150
    known = [effect_from_text(each) for each in ('coulomb_friction@grip{"turn_speed": 0.02}',
                                                 'payload@tool{"start_s": 8.0}', 'joint_offset@turn{"offset": 0.1}')]
    nuisance, counted = np.random.default_rng(0).standard_normal((600, 4, 2)), ~resting(samples)
    first = refitted(fit_model(BODY, samples, known, use, scale, counted=counted), known, nuisance, counted)
    others = refitted(first, known, nuisance[::-1], counted)
    np.testing.assert_allclose(others.theta, refitted(fit_model(
        BODY, samples, known, use, scale, counted=counted), known, nuisance[::-1], counted).theta, rtol=1e-9, atol=1e-9)
    for effects in ([*known, effect_from_text(text)], [known[1], effect_from_text(text), known[0]], known[:1]):
        shared = with_effects(first, effects)
        anew = refitted(fit_model(BODY, samples, effects, use, scale, counted=counted), effects, nuisance,
                        counted)
        np.testing.assert_allclose(shared.theta, anew.theta, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(shared.residual, anew.residual, rtol=1e-9, atol=1e-9)
        columns = CoupledColumns(BODY, effects).batch(samples)[0]
        np.testing.assert_allclose(shared.design.predicted(np.append(shared.theta[:-2], [0.0, 0.0])),
                                   columns @ shared.theta[:-2], atol=1e-9)


def test_a_search_ends_once_what_was_found_shows_that_more_samples_are_needed():
    """It went on to its end, and then all began anew: a minute of an arm of seven joints took four searches."""
    motion, words = smooth_motion(4, 6000, rate=200.0, seed=1, speed=2.0), []
    outputs = BODY.regressors(motion) @ BODY.base_parameters
    outputs = outputs + outputs.std(axis=0) / motion.velocity.std(axis=0) * motion.velocity
    found = diagnose(BODY, replace(motion, outputs=noisy(outputs, 1e-3, 1)), only=RUBBING,
                     progress=lambda text, share: words.append(text))
    ends = [number for number, text in enumerate(words) if text.startswith('round 1: found')]
    assert len(ends) == 2 and found.config.working_rate_hz > DEFAULTS.working_rate_hz
    assert all(text.startswith('round 1') for text in words[:ends[1]]), 'no second round before'
    assert {finding.effect.kind for finding in found.findings} == {'viscous_friction'}


def test_friction_of_one_joint_is_not_taken_for_friction_of_all(long):
    found = diagnose(BODY, rubbing(moving(2), np.zeros(4), np.array([0.0, 1.0, 0.0, 0.0])),
                     only=() if long else RUBBING)
    assert [(finding.effect.kind, finding.effect.where) for finding in found.findings] == [('viscous_friction', 'turn')]


def test_a_backlash_that_bends_the_fit_of_the_other_joints_is_not_taken_for_friction_of_all():
    """While dry friction at its joint had the wrong form, friction seemed credible at most joints."""
    made = simulate(Scenario(motion='circle_xy', samples=4000, outputs='effort', seed=91, accelerations=False,
                             effects=(EffectRequest('backlash', size=2.0),)))
    found = diagnose(body_of(made), samples_of(made),
                     only=('coulomb_friction', 'viscous_friction', 'effort_offset', 'backlash'))
    assert [(finding.effect.kind, finding.effect.where) for finding in found.findings] == [('backlash', 'r_elbow')]


@pytest.mark.parametrize(('kind', 'where', 'possible', 'impossible'), [
    ('effort_gain', 'turn', {'gain': -0.3}, {'gain': -1.3}), ('joint_offset', 'turn', {'offset': 0.1}, {'offset': 2.0}),
    ('gravity_tilt', None, {'tilt_x': 0.1}, {'tilt_y': -1.0})])
def test_calibrations_that_no_robot_has_are_known(kind, where, possible, impossible):
    assert kinds()[kind](where, possible).possible and not kinds()[kind](where, impossible).possible


def test_a_spring_that_pushes_on_is_impossible():
    spring = kinds()['joint_spring']('grip')
    assert spring.physical(np.array([0.2, -1.0])) and not spring.physical(np.array([-0.2, 1.0]))


def test_friction_that_drives_its_joint_in_one_direction_is_impossible():
    friction = kinds()['asymmetric_friction']('turn', {'turn_speed': 0.01})
    assert friction.physical(np.array([1.0, 0.5, 0.2, -0.01]))
    assert not friction.physical(np.array([0.018, 0.030, -0.010, -0.003]))


def with_load(theta, noise, seed=0):
    samples = moving(seed)
    load = kinds()['payload']('tool', span=Span(20.0))
    columns = load.columns(BODY, samples, None)[0]
    rng = np.random.default_rng(seed)
    outputs = samples.outputs + columns @ theta + noise * rng.standard_normal(samples.outputs.shape)
    fit = starting_fit(BODY, replace(samples, outputs=outputs), [], np.ones(COUNT, dtype=bool))
    return fit, declare(fit, [load])


def test_a_load_that_comes_in_a_gap_is_said_to_have_come_there():
    samples = moving(3)
    columns = kinds()['payload']('tool', span=Span(18.5)).columns(BODY, samples, None)[0]
    loaded = replace(samples, outputs=samples.outputs + columns @ np.array([0.4, 0.01, 0.0, 0.02, *[0.0] * 6]))
    seen = loaded[(samples.time < 17.0) | ((samples.time > 20.0) & (samples.time < 40.0))]
    found = diagnose(BODY, seen, only=['payload', 'external_force'])
    assert [finding.effect.kind for finding in found.findings] == ['payload']
    assert 17.0 <= found.findings[0].effect.start_s <= 20.2
    assert [note for note in found.notes if 'began' in note] == [
        f'payload at {found.findings[0].effect.where} began between {seen.time[seen.time < 17.0][-1]:.1f} and '
        f'{seen.time[seen.time > 20.0][0]:.1f} s, where nothing was looked at.']


def test_a_second_load_is_not_taken_for_the_one_that_was_declared():
    samples = moving(3)
    outputs = samples.outputs
    for start_s, mass in ((6.0, 0.4), (18.0, 0.9)):
        columns = kinds()['payload']('tool', span=Span(start_s)).columns(BODY, samples, None)[0]
        outputs = outputs + columns @ np.array([mass, 0.01, 0.0, 0.02, *[0.0] * 6])
    known = kinds()['payload']('tool', span=Span(6.0))
    found = diagnose(BODY, replace(samples, outputs=outputs), [known], only=['payload'])
    assert [round(finding.effect.start_s) for finding in found.findings] == [18]
    assert [round(finding.effect.start_s) for finding in found.declared] == [6]
    assert abs(found.declared[0].parameters['mass'].value - 0.4) < 0.05


def test_a_load_must_be_a_body_as_far_as_the_motion_shows():
    body = np.array([0.4, 0.01, 0.0, 0.02, 3e-3, 0.0, 3e-3, 0.0, 0.0, 1e-3])
    assert all_plausible(*with_load(body, 0.01))
    assert np.linalg.eigvalsh(pseudo_inertia(body))[0] > 0.0
    ghost = np.array([0.007, 0.0, 0.0, 0.0, -1.9, 0.0, -1.9, 0.0, 0.0, -1.9])
    assert not all_plausible(*with_load(ghost, 0.01))


def test_what_was_found_gives_way_to_a_rival_that_more_knowledge_tells_from_it():
    """A load at a tool, told as a force while friction was unknown, stayed one, and a zero beside it was missed."""
    samples, known = moving(), kinds('effort')
    half = Span(float(samples.time[COUNT // 2]))
    load, force = (known[kind]('finger', span=half) for kind in ('payload', 'external_force'))
    carried = load.columns(BODY, samples, None)[0] @ [0.05, 0.0, 0.0, 0.008, 2e-3, 0.0, 2e-3, 0.0, 0.0, 2e-4]
    samples = replace(samples, outputs=samples.outputs + carried)
    start = starting_fit(BODY, samples, [], np.ones(COUNT, dtype=bool))
    wrong, right = declare(start, [force]), declare(start, [load])
    [swap], [back] = swapping_moves(wrong, [(force, load)]), swapping_moves(right, [(load, force)])
    assert [effect.kind for effect in swap.after.effects] == ['payload'] and swap.good and not back.good
    assert swap.price == pytest.approx(-back.price)
    step = Step(added=(force,), rivals=(Rival(load.without_span(), 0.1), Rival(load, 1.0)), ranking=(), before=start,
                after=wrong)
    assert _rivalries(wrong, [step]) == [(force, load)] and _rivalries(right, [step]) == []


def test_a_cause_at_several_times_is_one_rival(monkeypatch):
    """A load with its end open and the same until a time stood side by side, each the likelier one."""
    fit, known = SimpleNamespace(config=DEFAULTS, residual=np.zeros(1)), kinds('effort')
    causes = (('external_force', 5), ('payload', 1), ('joint_spring', 0), ('payload', 3), ('payload', 2))
    moves = [Move((known[kind]('finger', span=Span(float(at))),), SimpleNamespace(
        residual=np.array(lost), forget=lambda *kept: None), Gain(1.0, 0.1), 0.0)
        for at, (kind, lost) in enumerate(causes)]
    monkeypatch.setattr(stepwise, 'overlap', lambda *models: 1.0)
    monkeypatch.setattr(stepwise, 'block_gains', lambda _, other: np.sign(np.arange(0.5, 24.0) - 10.0 - other.residual))
    force, *rivals = moves
    found = _rivals(fit, force, rivals)
    assert [rival.effect.kind for rival in found] == ['joint_spring', 'payload']
    assert found[1].effect is rivals[0].added[0]


def test_a_move_that_comes_to_nothing_does_not_end_the_search(monkeypatch):
    """The best move was friction in another form; it came to what was known, and a zero of 2.3 degrees was missed."""
    made, tried = stepwise._made, []

    def nothing_at_first(fit, best, *others):
        tried.append(best)
        step = made(fit, best, *others)
        return step if len(tried) > 1 else replace(step, added=(), after=fit)

    monkeypatch.setattr(stepwise, '_made', nothing_at_first)
    samples = moving()
    samples.outputs[:, 1] += 0.4 * samples.velocity[:, 1]
    samples.outputs[:, 3] += 0.05 * samples.acceleration[:, 3]
    known = {name: kinds('effort')[name] for name in ('viscous_friction', 'rotor_inertia')}
    steps = search(starting_fit(BODY, samples, [], np.ones(COUNT, dtype=bool), considered=known))
    assert [step.added[0].kind for step in steps] == ['rotor_inertia', 'viscous_friction']


def test_a_force_beyond_the_weight_of_the_arm_is_no_finding():
    samples = moving()
    push = kinds()['external_force']('tool')
    columns = push.columns(BODY, samples, None)[0]
    fit = starting_fit(BODY, samples, [], np.ones(COUNT, dtype=bool))
    for force, expected in ((10.0, True), (500.0, False)):
        pushed = replace(samples, outputs=samples.outputs + columns @ np.array([0.0, 0.0, -force]))
        fit = starting_fit(BODY, pushed, [], np.ones(COUNT, dtype=bool))
        assert all_plausible(fit, declare(fit, [push])) == expected


@pytest.mark.long
def test_a_measured_franka_is_explained_as_well_as_by_a_plain_model(shared_data):
    """All base parameters, and offset, viscous and dry friction of each joint, its cut-off chosen on the fit."""
    from semiparam_ros.bags.reader import open_bag

    with open_bag(SHARED_DATA / 'panda_arm' / 'panda_exciting_trajectory.db3') as bag:
        messages = list(bag.messages(['/joint_states']))
    order = [messages[0].data.name.index(f'fer_joint{number}') for number in range(1, 8)]
    stamps = np.array([message.data.header.stamp.sec * 10**9 + message.data.header.stamp.nanosec
                       for message in messages])
    position, velocity, effort = (np.array([np.array(getattr(message.data, role))[order] for message in messages])
                                  for role in ('position', 'velocity', 'effort'))
    samples = Samples(stamps, position, velocity, np.zeros_like(velocity), effort, int(stamps[0]))
    body = RigidBody.from_urdf((shared_data / 'panda_arm' / 'panda.urdf').read_text(),
                               [f'panda_joint{number}' for number in range(1, 8)], 'effort')
    found = diagnose(body, samples)
    first, counted = found.first, found.first.counted
    plain = plain_model(body, first.samples, first.train_mask[:, None] & counted)
    judged = found.judged[:, None] & counted
    assert found.after.nmse == pytest.approx(nmse(found.final.residual, first.samples.outputs, judged))
    assert found.after.nmse.mean() < 1.05 * plain.nmse(first.samples, judged).mean()


@pytest.mark.long
def test_zeros_tilt_and_crosstalk_gain_nothing_beyond_what_is_found_on_a_measured_icub(measured_icub):
    """Both recordings in one diagnosis, every third sample of them."""
    settings = load_params(measured_icub / 'icub.yaml')
    bags = [load_samples(measured_icub / f'{name}.mcap', settings) for name in ('train', 'test')]
    body = build_rigid_body(settings, bags[0].robot_description)
    found = diagnose(body, Samples.joined([bag.samples[::3] for bag in bags]))
    assert found.after.nmse.mean() < 0.75 * found.before.nmse.mean()
    assert found.after.nmse.mean() < 1.01 * further_calibrated_error(found)


def test_a_delay_is_settled_beside_strong_friction():
    """Late efforts bring late friction with them: without that in the derivative the steps grew and never settled."""
    known = [kinds()['coulomb_friction'](joint, {'turn_speed': 0.05}) for joint in BODY.joints]
    delay = kinds()['time_delay'](None, {'delay_s': 0.012})
    theta = np.append(BODY.base_parameters, [20.0] * len(known))
    samples = replace(moving(), whole=True)
    exact = CoupledColumns(BODY, [*known, delay]).batch(samples)[0] @ theta
    fit = starting_fit(BODY, replace(samples, outputs=exact), [*known, delay.with_values(delay_s=0.0)],
                       np.ones(COUNT, dtype=bool))
    settled = gauss_newton(fit, [delay])
    assert settled.loss < 0.01 * fit.loss
    assert settled.effects[-1].value('delay_s') == pytest.approx(0.012, abs=2e-4)


def test_a_step_that_raises_the_loss_is_shortened(monkeypatch):
    delay = kinds()['time_delay'](None, {'delay_s': 0.0})
    samples = moving()
    fit = starting_fit(BODY, replace(samples, whole=True), [delay.with_values(delay_s=0.012)],
                       np.ones(COUNT, dtype=bool))
    monkeypatch.setattr('semiparam_ros.diagnosis.search.refit.added_columns',
                        lambda fit, effect: added_columns(fit, effect) / 50.0)
    assert gauss_newton(fit, [delay]).loss < fit.loss


def test_a_joint_that_moves_in_one_block_alone_does_not_hide_what_all_others_gain():
    """What the other blocks leave open made the error there hundreds of times that of the mean, and friction of 3 N m
    at each joint was not believed."""
    samples = moving()
    alone = (np.arange(COUNT) // (COUNT // 10) == 4)[:, None]
    factor = np.where(alone, 1.0, 1e-3)[:, 0]
    position, velocity, acceleration = samples.position.copy(), samples.velocity.copy(), samples.acceleration.copy()
    for values in (position, velocity, acceleration):
        values[:, 1] *= factor
    still = replace(samples, position=position, velocity=velocity, acceleration=acceleration)
    outputs = noisy(BODY.regressors(still) @ (1.5 * BODY.base_parameters), 0.02, seed=1)
    recorded = rubbing(replace(still, outputs=outputs), 3.0, 0.0)
    friction = [kinds()['coulomb_friction'](joint, {'turn_speed': 0.01}) for joint in BODY.joints]
    plain = starting_fit(BODY, recorded, [], np.ones(COUNT, dtype=bool))
    with_friction = declare(plain, friction)
    gained = gain(plain, with_friction)
    assert gained.total > 100.0 and gained.total > 10.0 * gained.error


def test_an_output_that_nothing_explains_is_said_first():
    """Two efforts swapped left 0.94 of one's variance, and the verdict spoke of what was found elsewhere alone."""
    samples = rubbing(moving()[:800], np.zeros(4), np.array([0.0, 2.0, 0.0, 0.0]))
    outputs = samples.outputs.copy()
    outputs[:, 3] = np.std(outputs[:, 3]) * np.sign(np.sin(samples.time / 2.7)) * np.sin(samples.time)
    found = diagnose(BODY, replace(samples, outputs=outputs), only=['viscous_friction'])
    assert list(found.unexplained_outputs) == [ODD_JOINTS[3]]
    left, noise = found.unexplained_outputs[ODD_JOINTS[3]]
    assert left > 0.5 > noise
    assert text_report(found)[1].startswith(f'{ODD_JOINTS[3]} is not explained: {100 * left:.0f} % of its variance')
    assert not diagnose(BODY, samples, only=['viscous_friction']).unexplained_outputs


@pytest.mark.parametrize('turned', [1.001, None])
def test_other_values_begin_a_round_only_where_they_gain_what_an_effect_costs(monkeypatch, turned):
    """They did for a tenth of a nat, and all candidates were tried anew. Here forms stay coarse until the end."""
    samples = rubbing(moving(2), np.array([0.0, 2.0, 0.0, 0.0]), np.zeros(4), turn_speed=0.07)
    samples, tried = replace(samples, outputs=noisy(samples.outputs, 1e-3)), list[int]()
    coarse = stepwise.coarse

    def softer(fit, *rest):
        tried.append(len(fit.effects))
        return [replace(trial, effect=trial.effect.with_values(turn_speed=0.3))
                for trial in coarse(fit, *rest)]

    def slightly(fit, kept):
        return with_effects(fit, [effect.with_values(turn_speed=turned * effect.value('turn_speed'))
                                  for effect in fit.effects])

    monkeypatch.setattr(stepwise, 'coarse', softer)
    monkeypatch.setattr(stepwise, 'refine_foremost', lambda fit, trials: trials)
    monkeypatch.setattr(stepwise, 'group_moves', lambda *_: [])
    monkeypatch.setattr(stepwise, 'bent', lambda fit, *_: fit)
    if turned:
        monkeypatch.setattr(stepwise, 'reshaped', slightly)
    kind = {'coulomb_friction': kinds('effort')['coulomb_friction']}
    steps = search(starting_fit(BODY, samples, (), np.ones(len(samples), dtype=bool), considered=kind))
    assert len(steps) == 1 and tried[:2] == [0, 1] and (len(tried) > 2) == (turned is None)
