"""Coupled gears, readings that are not in proportion, a common gain and touches: found and named."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.data.recordings import during
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.regression import with_effects
from semiparam_ros.diagnosis.residual.contacts import bend, contacts
from semiparam_ros.diagnosis.search.scoring import coarse_trial
from semiparam_ros.diagnosis.search.stepwise import starting_fit
from semiparam_ros.diagnosis.text_report import text_report
from semiparam_ros.effects import effect_from_text, kinds
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate
from support.arms import ODD_ARM, TWO_ARMS, TWO_ARMS_JOINTS, joint, link, noisy, pinocchio_efforts, smooth_motion

PENDULUM = '<robot name="pendulum">' + ''.join([
    link('base'), link('arm', 6.0, '0 0 0.3'), joint('swing', 'revolute', 'base', 'arm', axis='0 1 0')]) + '</robot>'
COMPETITORS = ['joint_offset', 'gravity_tilt', 'time_delay', 'payload', 'external_force']


@cache
def recorded(outputs, seed=1, samples=800):
    made = simulate(Scenario(samples=samples, outputs=outputs, seed=seed, robot_seed=1, motion='mixed'))
    return made, body_of(made), samples_of(made)


def names(found):
    return [(finding.effect.kind, finding.effect.where) for finding in found.findings]


@pytest.mark.parametrize('outputs', [pytest.param('wrench', marks=pytest.mark.long), 'effort'])
def test_a_joint_that_moves_with_the_motor_before_it(outputs):
    """The encoders sit at the motors: what they show of the joint lacks the other's share."""
    _, body, samples = recorded(outputs)
    ratio, shown = 0.15, {}
    for role in ('position', 'velocity', 'acceleration'):
        shown[role] = getattr(samples, role).copy()
        shown[role][:, 3] -= ratio * shown[role][:, 2]
    outputs_there = samples.outputs.copy()
    if outputs == 'effort':  # by virtual work that motor carries a share of the joint's torque
        outputs_there[:, 2] += ratio * outputs_there[:, 3]
    found = diagnose(body, replace(samples, **shown, outputs=outputs_there),
                     only=[*COMPETITORS, 'gear_coupling'])
    assert names(found)[0] == ('gear_coupling', body.joints[3])
    assert found.findings[0].parameters['ratio'].value == pytest.approx(ratio, abs=0.01)


def test_torques_of_coupled_gears_are_those_of_another_library():
    made, body, samples = recorded('effort')
    effect, ratio = effect_from_text('gear_coupling@r_elbow{"ratio": 0.3}'), 0.3
    columns, _ = CoupledColumns(body, [effect]).batch(samples[:3])
    for row, sample in zip(columns, samples[:3], strict=True):
        states = [values.copy() for values in (sample.position, sample.velocity, sample.acceleration)]
        for state in states:
            state[3] += ratio * state[2]
        torque = pinocchio_efforts(made.urdf, body.joints, {}, *states)
        torque[2] += ratio * torque[3]
        np.testing.assert_allclose(row @ body.base_parameters, torque, atol=1e-9)


def test_a_joint_is_coupled_to_the_one_that_carries_it_in_whichever_order_joints_are_named():
    """It was coupled to the one named before it: of permuted joints, or of two arms, to a joint far away."""
    made, body, samples = recorded('effort')
    order = [2, 0, 3, 1]
    other = RigidBody.from_urdf(made.urdf, [body.joints[index] for index in order], 'effort')
    coupled = kinds()['gear_coupling']
    assert set(coupled.places(other)) == set(coupled.places(body)) == set(body.joints[1:])
    permuted = replace(samples, **{role: getattr(samples, role)[:, order] for role in (
        'position', 'velocity', 'acceleration', 'outputs')})
    effect = coupled(body.joints[3], {'ratio': 0.3})
    there, here = (CoupledColumns(each, [effect]).batch(some[:5])[0] @ each.base_parameters
                   for each, some in ((other, permuted), (body, samples)))
    np.testing.assert_allclose(there, here[:, order], atol=1e-9)
    arms = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS, 'effort')
    moved = coupled('b_shoulder', {'ratio': 0.3}).correct(arms, smooth_motion(5, 3), None)[1].position
    still = smooth_motion(5, 3).position
    np.testing.assert_allclose(moved[:, 3], still[:, 3] + 0.3 * still[:, TWO_ARMS_JOINTS.index('waist')])


def scaled(motion, share, middle=0.0):
    """The same motion, smaller and about another middle."""
    return replace(motion, position=middle + share * motion.position, velocity=share * motion.velocity,
                   acceleration=share * motion.acceleration)


def test_a_screw_of_any_lead_ripples():
    """Orders were tried up to 240 for each radian or metre, so a lead of less than 26 mm was no ripple."""
    slide = RigidBody.from_urdf(ODD_ARM, ['lift'], 'effort')
    motion, order = scaled(smooth_motion(1, 1500, speed=0.5), 0.1), 2.0 * np.pi / 0.008
    exact = slide.regressors(motion) @ slide.base_parameters + 0.5 * np.sin(order * motion.position)
    found = diagnose(slide, replace(motion, outputs=noisy(exact, 0.002)), only=['transmission_ripple'])
    assert names(found) == [('transmission_ripple', 'lift')]
    assert found.findings[0].parameters['order'].value == pytest.approx(order, rel=1e-3)


def test_a_spring_that_weights_nearly_imitate_is_tried_as_it_would_be_fitted():
    """One of its two directions was left out, for weights explain all but a millionth of its power: of a six-axis
    arm a ripple was told instead."""
    arm = RigidBody.from_urdf(PENDULUM, ['swing'], 'effort')
    motion = scaled(smooth_motion(1, 1500, speed=0.5), 0.2, 0.9)
    exact = arm.regressors(motion) @ arm.base_parameters + 4.0 * (motion.position + 1.0)
    samples = replace(motion, outputs=noisy(exact, 0.0005), whole=True)
    fit = starting_fit(arm, samples, [], np.ones(1500, dtype=bool))
    tried = coarse_trial(fit, kinds()['joint_spring'], 'swing')
    assert tried.squares == pytest.approx(with_effects(fit, [tried.effect]).squares, rel=1e-3)


@pytest.mark.parametrize('frequency', [12.0, 33.0])
def test_a_shake_of_averaged_samples_is_told_as_it_was_recorded(frequency):
    """Means of five samples keep nine tenths of 12 Hz, and read 33 Hz as 7 Hz of a fifth of its size."""
    body, size = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS[:3], 'effort'), 0.5
    motion = smooth_motion(3, 6000, rate=200.0, speed=0.5)
    outputs = noisy(body.regressors(motion) @ body.base_parameters)
    outputs[:, 1] += size * np.sin(2.0 * np.pi * frequency * motion.time)
    found = diagnose(body, replace(motion, outputs=outputs), only=['periodic_disturbance'])
    assert names(found) == [('periodic_disturbance', 'a_shoulder')] and found.inputs.factor == 5
    told = found.findings[0].parameters
    assert told['frequency_hz'].value == pytest.approx(frequency, abs=0.01)
    assert np.hypot(told['sin'].value, told['cos'].value) == pytest.approx(size, rel=0.02)


def test_a_ripple_of_averaged_samples_is_told_as_it_was_recorded():
    """Means of 25 samples keep less of it the faster the joint is: 0.48 N m were told."""
    body = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS[:3], 'effort')
    motion = smooth_motion(3, 20_000, rate=1000.0, speed=0.5)
    outputs = noisy(body.regressors(motion) @ body.base_parameters, 0.05)
    outputs[:, 1] += 0.5 * np.sin(60.0 * motion.position[:, 1])
    found = diagnose(body, replace(motion, outputs=outputs), only=['transmission_ripple'])
    assert names(found) == [('transmission_ripple', 'a_shoulder')] and found.inputs.factor == 25
    told = found.findings[0].parameters
    assert np.hypot(told['sin'].value, told['cos'].value) == pytest.approx(0.5, rel=0.02)


def test_joints_that_are_inputs_only():
    """Friction is found where the effort is an output; a load moves the efforts that there are."""
    made, _, samples = recorded('effort')
    every = made.joint_names
    body = RigidBody.from_urdf(made.urdf, every, 'effort', output_joints=(every[1], every[3]))
    outputs = samples.outputs[:, [1, 3]].copy()
    outputs[:, 1] += 0.8 * np.tanh(samples.velocity[:, 3] / 0.05)
    found = diagnose(body, replace(samples, outputs=outputs), only=['coulomb_friction', 'viscous_friction', 'payload'])
    assert names(found) == [('coulomb_friction', every[3])]
    assert found.findings[0].parameters['coulomb'].value == pytest.approx(0.8, rel=0.1)
    assert kinds()['gear_coupling'].places(body) == [every[1], every[3]]
    with pytest.raises(SemiparamError, match=f'with one of {every[1]}, {every[3]}'):
        CoupledColumns(body, [effect_from_text(f'viscous_friction@{every[0]}')])


def test_an_effort_that_is_not_in_proportion():
    channel = 'r_shoulder_roll'
    _, body, samples = recorded('effort')
    index = body.output_names.index(channel)
    true = body.regressors(samples)[:, index] @ body.base_parameters
    bent = samples.outputs.copy()
    bent[:, index] += 0.3 / np.abs(true).max() * true**2
    found = diagnose(body, replace(samples, outputs=bent),
                     only=[*COMPETITORS, 'sensor_nonlinearity', 'gear_coupling'])
    assert names(found)[0] == ('sensor_nonlinearity', channel)
    assert found.after.nmse.mean() < 0.3 * found.before.nmse.mean()


def test_a_common_gain_is_found_beside_a_known_load_and_not_without_one():
    _, body, one = recorded('effort', 1)
    _, _, two = recorded('effort', 2)
    load = np.array([0.4, 0.0, 0.01, 0.02, 1e-3, 0.0, 1e-3, 0.0, 0.0, 1e-3])
    added = kinds()['payload']('r_gripper').columns(body, two, None)[0] @ load
    samples = Samples.joined([replace(one, outputs=1.4 * one.outputs),
                              replace(two, outputs=1.4 * (two.outputs + added))])
    known = during(samples, 1, effect_from_text('payload@r_gripper{"mass": 0.4}'))
    found = diagnose(body, samples, [known], only=['common_gain', 'joint_offset'])
    assert names(found) == [('common_gain', None)]
    gain = found.findings[0].parameters['gain']
    assert gain.value == pytest.approx(0.4, abs=max(4.0 * gain.std, 0.01)) and gain.std < 0.05
    assert names(diagnose(body, replace(one, outputs=1.4 * one.outputs), only=['common_gain', 'joint_offset'])) == []


def test_filtered_velocities_are_put_right():
    """A first-order filter: v' = (dq - v) / T, so dq = v + T v'."""
    _, body, samples = recorded('effort')
    constant, time = 0.18, samples.time
    late = np.zeros_like(samples.velocity)
    late[0] = samples.velocity[0]
    for k in range(1, len(time)):
        keep = np.exp(-(time[k] - time[k - 1]) / constant)
        late[k] = keep * late[k - 1] + (1.0 - keep) * samples.velocity[k]
    change = (samples.velocity - late) / constant
    effect = effect_from_text('velocity_filter{"time_constant_s": 0.18}')
    _, right, _ = effect.correct(body, replace(samples, velocity=late, acceleration=change), None)
    np.testing.assert_allclose(right.velocity, samples.velocity, atol=1e-9)
    error = []
    filtered = replace(samples, velocity=late, acceleration=change, outputs=5.0 * samples.velocity)
    for effects in ([], [effect]):
        friction = [kinds()['viscous_friction'](joint) for joint in body.joints]
        bare = ModelOptions('P', initial_samples=200, joint_friction=False)  # rotors make up for late ones
        model = Estimator(body, bare, [*effects, *friction])
        left = np.array([sample.outputs - model.step(sample).mean for sample in filtered])[200:]
        error.append(float(np.mean(left**2)))
    assert error[1] < 0.5 * error[0]


def test_a_declared_filter_is_not_put_right_twice_in_a_whole_recording():
    """Its positions have done so: after the advice of a report was followed, the next one found something missing, and
    wrote a filter of nothing."""
    scenario = Scenario(samples=2000, rate_hz=50.0, outputs='effort', seed=4, motion='mixed', accelerations=False,
                        effects=(EffectRequest('gravity_tilt', size=3.0),))
    made = simulate(scenario)
    keep = np.exp(-0.02 / 0.1)
    samples = samples_of(made)
    samples = replace(samples, velocity=lfilter([1.0 - keep], [1.0, -keep], samples.velocity, axis=0))
    known = effect_from_text('velocity_filter{"time_constant_s": 0.1}')
    without, found = (diagnose(body_of(made), samples, effects, only=['gravity_tilt']) for effects in ([], [known]))
    assert names(found) == names(without) == [('gravity_tilt', None)]
    assert found.after.nmse.mean() == pytest.approx(without.after.nmse.mean(), rel=0.05)
    assert known in found.standing
    notes = [any(note.startswith('The velocities come') for note in each.notes) for each in (without, found)]
    assert notes == [True, False]


def test_the_link_that_was_touched_is_that_of_the_arm_whatever_the_order_of_the_joints():
    """Of joints named from the tip on it was the one next to the base."""
    body = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS[::-1], 'effort')
    samples = smooth_motion(5, 800)
    touched = noisy(body.outputs_of(samples, body.base_parameters)) + [
        0.0, 0.0, 4.0, 6.0, 3.0] * ((samples.time > 20.0) & (samples.time < 20.8))[:, None]
    fit = starting_fit(body, replace(samples, outputs=touched), [], np.ones(800, dtype=bool))
    assert [contact.joint for contact in contacts(fit)] == ['a_elbow']
    assert bend([(20.0, 20.8)], fit) and not bend([(5.0, 5.8)], fit) and not bend([(15.0, 25.0)], fit)
    assert not bend([], fit)


@pytest.mark.parametrize('pause_s', [0, 3600])
def test_what_bursts_nearly_half_the_time_is_no_touch(pause_s):
    """The time between two recordings, or stretches of a long one, counted as time without touches."""
    _, body, samples = recorded('effort')
    stamps = samples.stamps + (np.arange(800) >= 400) * pause_s * 10**9
    bursts = (np.arange(800) % 100 < 45)[:, None] * 100.0 * samples.outputs.std(axis=0)
    fit = starting_fit(body, replace(samples, stamps=stamps), [], np.ones(800, dtype=bool))
    assert contacts(replace(fit, residual=fit.residual + bursts)) == []


def test_touches_are_named_with_their_times_and_the_link():
    _, body, samples = recorded('effort')
    touched, time = samples.outputs.copy(), samples.time
    for start, last in ((5.0, 1), (17.0, 2), (29.0, 3)):  # a push on the link after joint `last`
        inside = (time >= start) & (time < start + 0.8)
        touched[inside, :last + 1] += samples.outputs.std(axis=0)[:last + 1]
    found = diagnose(body, replace(samples, outputs=touched), only=['joint_offset'])
    assert [contact.joint for contact in found.contacts] == [body.joints[last] for last in (1, 2, 3)]
    np.testing.assert_allclose([contact.start_s for contact in found.contacts], [5.0, 17.0, 29.0], atol=0.15)
    np.testing.assert_allclose([contact.end_s for contact in found.contacts], [5.8, 17.8, 29.8], atol=0.15)
    lines = text_report(found)
    assert any('touched 3 times' in line for line in lines)
    assert any('on the link after r_elbow or beyond it' in line for line in lines)
    assert len(found.as_dict()['contacts']) == 3
    assert any('or while the robot was touched' in line for line in lines)
    assert diagnose(body, samples, only=['joint_offset']).contacts == []


def test_touches_neither_bend_nor_hide_friction():
    """They stayed in the fit: of a six-axis arm 4 of 12 frictions were not found, and 3 were off by 4 to 17 deviations.
    """
    _, body, samples = recorded('effort')
    rubbed = samples.outputs + (friction := 0.02 * samples.outputs.std(axis=0)) * samples.velocity
    touched, time = rubbed.copy(), samples.time
    for start, last in ((5.0, 3), (17.0, 2), (29.0, 3)):
        inside = (time >= start) & (time < start + 0.8)
        touched[inside, :last + 1] += samples.outputs.std(axis=0)[:last + 1]
    found, free = (diagnose(body, replace(samples, outputs=outputs), only=['viscous_friction'])
                   for outputs in (touched, rubbed))
    assert len(found.contacts) == 3 and sorted(names(found)) == sorted(names(free))
    for finding in found.findings:
        value = finding.parameters['viscous']
        assert abs(value.value - friction[body.joints.index(finding.effect.where)]) < 3.0 * value.std
