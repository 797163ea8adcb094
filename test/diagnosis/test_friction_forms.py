"""The form of dry friction: averaged over a working sample, ahead of the velocities, and never told as a delay."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.named_change import Gain
from semiparam_ros.diagnosis.preparation import averaged
from semiparam_ros.diagnosis.residual.contacts import contacts
from semiparam_ros.diagnosis.search import revision
from semiparam_ros.diagnosis.search.moves import Move, hidden_moves, single_moves
from semiparam_ros.diagnosis.search.plausibility import without_impossible
from semiparam_ros.diagnosis.search.refit import declare, gauss_newton, settled
from semiparam_ros.diagnosis.search.revision import bent, pruned, with_common_forms, with_usual
from semiparam_ros.diagnosis.search.score import gain, worth
from semiparam_ros.diagnosis.search.scoring import coarse_trial, refine_foremost
from semiparam_ros.diagnosis.search.stepwise import starting_fit
from semiparam_ros.effects import kinds
from semiparam_ros.effects.base import Span
from semiparam_ros.effects.drive import EffortOffset, JointSpring
from semiparam_ros.effects.friction import AsymmetricFriction, CoulombFriction, ViscousFriction
from semiparam_ros.effects.geometry import TimeDelay
from semiparam_ros.effects.hysteresis import Way
from support.arms import ODD_BODY, ODD_JOINTS, as_recorded, joint, link, noisy, smooth_motion

BODY = ODD_BODY
COUNT, TURN = 1500, 0.02
EVERYTHING = np.ones(COUNT, dtype=bool)
FRICTION = [('coulomb_friction', joint, None) for joint in ODD_JOINTS]
KINDS = kinds('effort')


def rubbing(lead_s=0.0, delay_s=0.0):
    """An arm whose joints rub, all of them as if they were faster by ``lead_s`` times the acceleration."""
    motion = smooth_motion(4, COUNT, seed=0, speed=0.5)
    _, inputs, _ = TimeDelay(None, {'delay_s': delay_s}).correct(BODY, replace(motion, whole=True), None)
    exact = BODY.regressors(inputs) @ BODY.base_parameters
    exact += 3.0 * np.tanh((inputs.velocity + lead_s * inputs.acceleration) / TURN)
    return replace(motion, outputs=noisy(exact, 0.003, seed=1), whole=True)


def fitted(samples, delay_s=None, lead_s=None, turn_speed=TURN):
    values = {'turn_speed': turn_speed, **({} if lead_s is None else {'lead_s': lead_s})}
    delay = [] if delay_s is None else [TimeDelay(None, {'delay_s': delay_s})]
    return declare(starting_fit(BODY, samples, [], EVERYTHING),
                   [*(CoulombFriction(joint, dict(values)) for joint in BODY.joints), *delay])


def with_leads(fit):
    return bent(fit, FRICTION)


def test_a_working_sample_holds_the_mean_of_the_friction_within_it():
    fine = smooth_motion(4, 4000, seed=0, speed=0.5)
    coarse = averaged(fine, 10)
    friction = CoulombFriction('turn', {'turn_speed': 0.002})
    wanted = np.tanh(fine.velocity[:, 1] / 0.002).reshape(-1, 10).mean(axis=1)
    error, plain = (np.std(friction.basis(BODY, samples, None)[0][:, 1, 0] - wanted)
                    for samples in (coarse, replace(coarse, averaged_s=0.0)))
    assert error < 0.3 * plain


@pytest.mark.parametrize('turn', [0.002, TURN])
def test_dry_friction_is_as_large_in_working_samples_as_it_was_recorded(turn):
    """Outputs of working samples are means less their curvature, which made dry friction 2 % larger beside each turn:
    it was told .4 % too large, viscous friction .5 % too small, and stiction where there was none."""
    fine = smooth_motion(4, 4000, seed=0, speed=0.25)
    fine = replace(fine, outputs=np.tanh(fine.velocity / turn))
    coarse = averaged(fine, 5)
    columns = np.hstack([CoulombFriction('turn', {'turn_speed': turn}).basis(BODY, coarse, None)[0][:, 1],
                         coarse.velocity[:, 1, None]])
    (dry, viscous), *_ = np.linalg.lstsq(columns, coarse.outputs[:, 1])
    assert dry == pytest.approx(1.0, abs=1e-3)
    assert viscous == pytest.approx(0.0, abs=3e-3)


def test_friction_of_either_direction_is_averaged_by_itself():
    """A working sample in which a joint turns back holds friction of both directions, but the mean direction there is
    near none: friction that differs by a third was told to differ by a tenth, beside an offset that there was not."""
    fine = smooth_motion(4, 4000, seed=0, speed=0.25)
    coarse = averaged(replace(fine, outputs=np.maximum(np.tanh(fine.velocity / TURN), 0.0)), 5)
    both, forward = (kind('turn', {'turn_speed': TURN}).basis(BODY, coarse, None)[0][:, 1, 0]
                     for kind in (CoulombFriction, AsymmetricFriction))
    error, of_mean = (np.std(column - coarse.outputs[:, 1]) for column in (forward, np.maximum(both, 0.0)))
    assert error < 0.2 * of_mean


def test_friction_with_a_lead_is_that_of_the_velocity_to_come():
    motion = smooth_motion(4, 200, seed=0, speed=0.5)
    ahead = replace(motion, velocity=motion.velocity + 0.01 * motion.acceleration)
    column, same = (CoulombFriction('turn', {'turn_speed': TURN, **lead}).basis(BODY, inputs, None)[0]
                    for lead, inputs in (({'lead_s': 0.01}, motion), ({}, ahead)))
    np.testing.assert_allclose(column, same)


def test_friction_that_leads_is_no_delay_of_the_efforts():
    """MuJoCo's friction turns over up to 10 ms before its joint does: efforts were told to be 2 to 6 ms early."""
    bare = fitted(rubbing(lead_s=0.01))
    late = fitted(bare.samples, delay_s=0.0)
    assert late.effects[-1].value('delay_s') == pytest.approx(0.0, abs=2e-4)
    leading = with_leads(bare)
    assert [effect.value('lead_s') for effect in leading.effects] == pytest.approx([0.01] * 4, abs=5e-4)
    both = declare(leading, [TimeDelay(None, {'delay_s': 0.0})])
    left = pruned(both, known=FRICTION)
    assert [effect.kind for effect in left.effects] == ['coulomb_friction'] * 4
    assert [effect.value('lead_s') for effect in left.effects] == pytest.approx(
        [effect.value('lead_s') for effect in leading.effects], abs=1e-9)


def test_friction_with_its_shape_anew_holds_no_impossible_value():
    """A joint that creeps has a friction of any slope, -15 N m s/rad once; the leads of all joints bent it so."""
    samples = rubbing(lead_s=0.01)
    driven = samples.outputs - 0.5 * samples.velocity * (np.arange(4) == 1)
    start = fitted(replace(samples, outputs=driven))
    viscous = [ViscousFriction(joint) for joint in BODY.joints[:2]]
    start = declare(start, viscous)
    assert not viscous[1].physical(start.theta[start.assembly.blocks['5']])
    leading = without_impossible(with_leads(start))
    assert viscous[1] not in leading.effects
    assert viscous[1] in without_impossible(replace(start, declared=(viscous[1],))).effects


def test_friction_turns_over_as_that_of_the_others_where_no_block_tells_how():
    """A wrist that was never slow where the model was fitted had a form by chance, and nine times the error."""
    samples = rubbing()
    fast = np.abs(samples.velocity[:, 1]) > 0.3 * np.abs(samples.velocity[:, 1]).max()
    forms = {joint: {'turn_speed': TURN} for joint in BODY.joints} | {'turn': {'presliding': 0.1}}
    start = declare(starting_fit(BODY, samples, [], fast), [CoulombFriction(*form) for form in forms.items()])
    error, chance = (np.mean((fit.residual[~fast, 1] / samples.outputs[:, 1].std())**2)
                     for fit in (with_common_forms(with_leads(start)), with_leads(start)))
    assert error < 0.01 < chance


def test_friction_of_another_form_stays_where_blocks_tell_it():
    samples = rubbing()
    own = 3.0 * (np.tanh(samples.velocity[:, 1] / (20.0 * TURN)) - np.tanh(samples.velocity[:, 1] / TURN))
    start = fitted(replace(samples, outputs=samples.outputs + np.outer(own, np.arange(4) == 1)))
    shapes = {effect.where: effect.value('turn_speed') for effect in with_common_forms(with_leads(start)).effects}
    assert shapes.pop('turn') == pytest.approx(20.0 * TURN, rel=0.05)
    assert list(shapes.values()) == pytest.approx([TURN] * 3, rel=0.1)


def with_an_offset(samples, used):
    friction = [CoulombFriction(joint, {'turn_speed': TURN}) for joint in BODY.joints if joint != 'turn']
    return declare(starting_fit(BODY, samples, [], used), [*friction, EffortOffset('turn')])


def test_a_joint_that_goes_one_way_rubs_as_the_others_do():
    """It tells no offset from its dry friction. The offset stayed by chance, and erred by 1.25 of the variance where
    the joint went the other way."""
    samples = rubbing()
    one_way = samples.velocity[:, 1] > 0.3 * samples.velocity[:, 1].max()
    start = with_an_offset(samples, one_way)
    fit = with_usual(start)
    assert {(effect.kind, effect.where) for effect in fit.effects} == {place[:2] for place in FRICTION}
    back = samples.velocity[:, 1] < -TURN
    error, before = (np.mean((each.residual[back, 1] / samples.outputs[:, 1].std())**2) for each in (fit, start))
    assert error < 0.02 < 1.0 < before


@pytest.mark.parametrize('rubs', [1.0, 0.8])
def test_an_offset_stays_where_motion_both_ways_tells_it_from_friction(rubs):
    """Beside a joint that does not rub, and beside one that rubs a fifth of what the others do."""
    samples = rubbing()
    own = 3.0 * (1.0 - rubs * np.tanh(samples.velocity[:, 1] / TURN))
    start = with_an_offset(replace(samples, outputs=samples.outputs + np.outer(own, np.arange(4) == 1)), EVERYTHING)
    assert with_usual(start) is start


LIFT = RigidBody.from_urdf('<robot name="gantry">' + ''.join([
    link('base'), link('bridge', 9.0), link('carriage', 4.0),
    joint('slide', 'prismatic', 'base', 'bridge', axis='1 0 0'),
    joint('lift', 'prismatic', 'bridge', 'carriage')]) + '</robot>', ('slide', 'lift'), 'effort')


@pytest.mark.parametrize(('rotor', 'offset', 'told'), [(10.0, 0.0, 'rotor_inertia'), (0.0, 20.0, 'effort_offset')])
def test_what_leaves_the_description_as_it_is_comes_before_an_offset(rotor, offset, told):
    """Of a lift, an offset makes up for the weight of ten kilograms that its rotor is taken for. No block tells these
    two from the rotor alone: the offset came first and stayed."""
    motion = smooth_motion(2, COUNT, seed=0, speed=0.5)
    exact = LIFT.regressors(motion) @ LIFT.base_parameters
    exact[:, 1] += rotor * motion.acceleration[:, 1] + offset
    samples = replace(motion, outputs=noisy(exact, 0.01, seed=1), whole=True)
    start = declare(starting_fit(LIFT, samples, [], EVERYTHING), [EffortOffset('lift')])
    fit = with_usual(start)
    assert [(effect.kind, effect.where) for effect in fit.effects] == [(told, 'lift')]
    assert fit.theta[-1] == pytest.approx(rotor + offset, rel=0.05)


def test_what_is_not_worth_its_price_takes_no_place(monkeypatch):
    """It was pruned at once, so the rarer cause was gone, came again and went again: a measured Franka took 41 s, not
    15, and lost a ripple."""
    monkeypatch.setattr(revision, '_likelier_beforehand', lambda *_: True)
    motion = smooth_motion(2, COUNT, seed=0, speed=0.5)
    exact = LIFT.regressors(motion) @ LIFT.base_parameters
    exact[:, 1] += 0.5 * np.sin(40.0 * motion.position[:, 1])
    samples = replace(motion, outputs=noisy(exact, 0.001, seed=1), whole=True)
    bare = starting_fit(LIFT, samples, [], EVERYTHING)
    ripple = coarse_trial(bare, KINDS['transmission_ripple'], 'lift').effect
    fit = declare(bare, [ripple])
    assert with_usual(fit) is fit


def test_what_the_other_joints_have_comes_as_easily_as_it_stays():
    """Viscous friction that went beside a delay, and was worth two standard errors then, came no more: its joint's dry
    friction was told 8 deviations too large."""
    fit, unsure = fitted(rubbing()), Gain(5.0, 3.0)
    friction = fit.effects[:len(BODY.joints)]
    assert Move(friction[:1], fit, unsure, 0.3).good
    assert not Move(friction, fit, unsure, 0.3).good, 'none of them is there yet'
    begun = replace(friction[0], span=Span(start_s=5.0))
    assert not Move((begun,), fit, unsure, 0.3).good, 'a change is not what the others always had'
    offset = EffortOffset('turn')
    assert not Move((offset,), declare(fit, [offset]), unsure, 0.3).good, 'no other joint has it'
    springs = [JointSpring(joint) for joint in BODY.joints]
    assert not Move(tuple(springs[:1]), declare(fit, springs), unsure, 0.3).good, 'springs are of no group'


def test_a_delay_that_every_output_shows_is_believed():
    bare = fitted(rubbing(delay_s=0.02))
    late = fitted(bare.samples, delay_s=0.0)
    gained = gain(with_leads(bare), late)
    assert gained.total > 100.0 and gained.total > 10.0 * gained.error


@pytest.mark.parametrize('lead_s', [0.0, 0.01])
@pytest.mark.parametrize('turn_speed', [0.25 * TURN, TURN])
def test_a_delay_is_settled_where_joints_slide_whatever_form_friction_has_at_turns(turn_speed, lead_s):
    """4 to 16 ms were told of efforts that were 20 ms late."""
    found = fitted(rubbing(lead_s, delay_s=0.02), delay_s=0.0, turn_speed=turn_speed)
    assert found.effects[-1].value('delay_s') == pytest.approx(0.02, abs=2e-4)


def test_leads_of_frictions_follow_a_delay():
    """In the efforts turns stay where they are; else a delay spoils them, and none was told."""
    early = with_leads(fitted(rubbing(lead_s=0.01, delay_s=0.02)))
    assert [effect.value('lead_s') for effect in early.effects] == pytest.approx([-0.01] * 4, abs=5e-4)
    found = declare(early, [TimeDelay(None, {'delay_s': 0.0})])
    assert found.effects[-1].value('delay_s') == pytest.approx(0.02, abs=5e-4)
    assert [effect.value('lead_s') for effect in found.effects[:-1]] == pytest.approx([0.01] * 4, abs=5e-4)


def test_a_delay_is_judged_where_joints_slide():
    """A friction of a form that the model lacks weighs more than all that a delay of smooth motion explains."""
    samples = rubbing(delay_s=0.004)
    earlier = 3.0 * (np.tanh((samples.velocity + 0.02 * samples.acceleration) / TURN)
                     - np.tanh(samples.velocity / TURN))
    before = fitted(replace(samples, outputs=samples.outputs + earlier))
    after = fitted(before.samples, delay_s=0.0)
    assert after.loss * (after.scale / before.scale).mean() ** 2 > before.loss
    assert gain(before, after).exceeds(20.0, 2.5)
    assert worth(after)[-1].exceeds(20.0, 2.5)


def test_a_delay_ends_where_the_loss_is_least():
    """Its derivatives hold noise of the accelerations, and with those of another delay it ended 11 ms off."""
    samples = rubbing(delay_s=0.01)
    noise = samples.acceleration.std(axis=0) * np.random.default_rng(3).standard_normal(samples.acceleration.shape)
    start = starting_fit(BODY, replace(samples, acceleration=samples.acceleration + noise),
                         [*(CoulombFriction(joint, {'turn_speed': TURN}) for joint in BODY.joints),
                          TimeDelay(None, {'delay_s': 0.03})], EVERYTHING)
    found = gauss_newton(start, [start.effects[-1]])
    again = gauss_newton(found, [found.effects[-1]])
    assert again.effects[-1].value('delay_s') == pytest.approx(found.effects[-1].value('delay_s'), abs=1e-4)
    assert found.effects[-1].value('delay_s') < 0.01


def test_a_lead_of_friction_and_a_delay_are_settled_together():
    start = fitted(rubbing(lead_s=0.01, delay_s=0.02), delay_s=0.01, lead_s=0.0)
    found = settled(start, range(4))
    assert found.effects[-1].value('delay_s') == pytest.approx(0.02, abs=1e-3)
    assert [effect.value('lead_s') for effect in found.effects[:-1]] == pytest.approx([0.01] * 4, abs=2e-3)


def test_a_joint_that_turns_back_is_no_touch():
    """Eleven touches were told, wherever friction of another form than the model's turned over beside little noise."""
    motion = smooth_motion(4, COUNT, seed=0, speed=0.1)
    exact = BODY.regressors(motion) @ BODY.base_parameters + 3.0 * np.tanh(motion.velocity / (1.5 * TURN))
    samples = replace(motion, outputs=noisy(exact, 0.001, seed=1), whole=True)
    assert contacts(fitted(samples)) == []
    touched = samples.outputs + 5.0 * ((samples.time > 30.0) & (samples.time < 30.8))[:, None]
    assert [contact.joint for contact in contacts(fitted(replace(samples, outputs=touched)))] == [BODY.joints[-1]]


def test_friction_of_a_short_lift_is_told_along_the_lift():
    """Of a joint that slides by centimetres friction is as much in a metre as its force over its way."""
    urdf = '<robot name="lift">' + ''.join([
        link('base'), link('quill', 0.8), link('flange', 0.2, '0.01 0 -0.02'),
        joint('z', 'prismatic', 'base', 'quill', axis='0 0 -1'),
        joint('turn', 'revolute', 'quill', 'flange', '0 0 -0.1'),
    ]) + '</robot>'
    body, motion = RigidBody.from_urdf(urdf, ('z', 'turn'), 'effort'), smooth_motion(2, 2000, 40.0, seed=3)
    roles = ('position', 'velocity', 'acceleration')
    motion = replace(motion, **{role: getattr(motion, role) * (0.08, 1.0) for role in roles})
    samples = as_recorded(body, motion, noise=0.02)
    speed = motion.velocity[:, 0]
    noisy = np.random.default_rng(4).standard_normal(len(speed))
    outputs = samples.outputs + np.outer(60.0 * speed + 12.0 * np.tanh(speed / 0.002) + 0.3 * noisy, [1.0, 0.0])
    samples = replace(samples, velocity=motion.velocity, outputs=outputs)
    found = diagnose(body, samples, only=['viscous_friction', 'coulomb_friction', 'effort_offset'])
    values = {finding.effect.kind: finding.parameters for finding in found.findings if finding.effect.where == 'z'}
    for kind, name, true, unit in (('viscous_friction', 'viscous', 60.0, 'N s/m'),
                                   ('coulomb_friction', 'coulomb', 12.0, 'N')):
        told = values[kind][name]
        assert told.value == pytest.approx(true, abs=4.0 * told.std) and told.std < 0.1 * true and told.unit == unit
    assert values['coulomb_friction']['turn_speed'].unit == 'm/s'


@pytest.mark.parametrize(('joint', 'ripple'), [(1, 1.0), (2, 0.5)])
def test_friction_and_another_cause_that_hide_each_other_are_found_together(joint, ripple):
    """With friction alone, or the ripple alone, a residual stays that repeats itself: few samples tell of it. A quarter
    of the joint's variance was left then, and nothing was found."""
    motion = smooth_motion(4, 600, seed=0, speed=0.5)
    exact = BODY.regressors(motion) @ BODY.base_parameters
    size, position, velocity = exact[:, joint].std(), motion.position[:, joint], motion.velocity[:, joint]
    exact[:, joint] += size * (0.3 * np.tanh(velocity / TURN) + 0.2 * velocity + ripple * np.sin(11.0 * position))
    noise = 0.003 * exact.std(axis=0) * np.random.default_rng(1).standard_normal(exact.shape)
    found = diagnose(BODY, replace(motion, outputs=exact + noise),
                     only=['coulomb_friction', 'viscous_friction', 'transmission_ripple'])
    assert {(effect.kind, effect.where) for effect in found.final.effects} == {
        (kind, BODY.joints[joint]) for kind in ('coulomb_friction', 'viscous_friction', 'transmission_ripple')}


def test_friction_and_rotors_that_hide_each_other_are_tried_together_without_another_cause():
    """Beside its dry friction a knee had neither viscous friction nor rotor: 4 and 3 nat alone, 28 together."""
    motion = smooth_motion(4, 600, seed=0, speed=0.5)
    exact = BODY.regressors(motion) @ BODY.base_parameters
    exact[:, 2] += exact[:, 2].std() * (0.3 * motion.velocity[:, 2] + 0.3 * motion.acceleration[:, 2])
    noise = 0.01 * exact.std(axis=0) * np.random.default_rng(1).standard_normal(exact.shape)
    fit = starting_fit(BODY, replace(motion, outputs=exact + noise, whole=True), [], np.ones(600, dtype=bool),
                       considered={kind: KINDS[kind] for kind in ('viscous_friction', 'rotor_inertia')})
    (move,) = hidden_moves(fit, [], lambda words, share: None)
    assert move.good
    assert {(effect.kind, effect.where) for effect in move.added} == {
        ('viscous_friction', 'elbow'), ('rotor_inertia', 'elbow')}


def test_a_bristle_stays_bent_while_its_joint_rests():
    """Noise of encoders went the length of a bristle within seconds: what it lacked when the joint moved on was told as
    a delay, and as offsets that began and ended with rests."""
    time = np.arange(1600) * 0.02
    path = 0.3 * np.clip(time - 1.0, 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip(time - 1.0, 0.0, 1.0))
    path += 0.3 * np.clip(time - 30.0, 0.0, 1.0) ** 2
    still, noise = np.zeros((1600, 4)), 2e-5 * np.random.default_rng(0).standard_normal(1600)
    stamps = (time * 1e9).astype(np.int64)
    friction = CoulombFriction('turn', {'presliding': 0.002})
    exact, noisy_one = (friction.basis(BODY, Samples(
        stamps, *(np.tile(values[:, None], 4) for values in (position, np.gradient(position, time))), still, still, 0,
        whole=True), None)[0][:, 1, 0] for position in (path, path + noise))
    moves = (time > 1.1) & (time < 1.9) | (time > 29.9)
    assert exact[time > 29.9].min() > 0.99
    assert np.abs(noisy_one - exact)[moves].max() < 0.05
    assert noisy_one[(time > 29.0) & (time < 30.0)].min() > 0.95


def test_slow_ways_in_a_rest_are_followed():
    """One that goes on beyond the bounds of a rest is no noise."""
    time = np.arange(3000) * 0.02
    path = np.where(time < 10.0, np.sin(2.0 * time), np.sin(20.0)) + 0.02 * np.sin(0.5 * (time - 10.0)) * (time > 10.0)
    way = Way((time * 1e9).astype(np.int64), path, np.gradient(path, time)).without_noise_at_rest(time)
    assert np.abs(way.position - path).max() < 1e-3
    assert np.ptp(way.position[time > 11.0]) > 0.9 * np.ptp(path[time > 11.0])


def other_way(lead_s):
    """The rubbing arm, of which a joint has a tenth more viscous friction one way than the other."""
    samples = rubbing(lead_s)
    speed = samples.velocity[:, 1]
    return replace(samples, outputs=samples.outputs + np.outer(2.0 * speed + 0.1 * np.abs(speed), np.arange(4) == 1))


def test_what_takes_the_place_of_a_friction_begins_with_its_form():
    """Beside dry friction that was bent, a coarse form loses more than the difference between directions gains: an
    offset and a shake were told in its place."""
    samples = other_way(lead_s=0.01)
    known = with_leads(declare(fitted(samples), [ViscousFriction('turn')]))
    own = next(effect for effect in known.effects if (effect.kind, effect.where) == ('coulomb_friction', 'turn'))
    trial = coarse_trial(known, KINDS['asymmetric_friction'], 'turn')
    assert trial.effect.parameters == own.parameters
    moves = single_moves(known, refine_foremost(known, [trial]))
    assert [move.good for move in moves] == [True]
