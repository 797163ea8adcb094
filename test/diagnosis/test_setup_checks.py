"""What goes wrong before any physics: found where it is, and never where it is not."""

import itertools
import os
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.special import log_ndtr

from conftest import SHARED_DATA
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.diagnosis.config import DEFAULTS
from semiparam_ros.diagnosis.data.outliers import excluded, working_factor
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.preparation import BUT_ACCELERATIONS, Inputs, bursts, late, measured_lags
from semiparam_ros.diagnosis.setup.checks import layout_problems, setup_problems
from semiparam_ros.diagnosis.setup.identifiability import unidentifiable
from semiparam_ros.diagnosis.setup.prior_misfit import channel_scale, equations, evidence, independent
from semiparam_ros.effects import effect_from_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate
from support import arms
from support.arms import (
    ICUB_JOINTS,
    ICUB_SENSOR,
    ODD_BODY,
    ODD_JOINTS,
    as_recorded,
    icub_table,
    link,
    noisy,
    smooth_motion,
)

UR3 = ('shoulder_pan_joint', 'shoulder_lift_joint', 'elbow_joint', 'wrist_1_joint', 'wrist_2_joint', 'wrist_3_joint')
ICUB, DEGREES = ICUB_JOINTS, 180.0 / np.pi
ROLES = ('position', 'velocity', 'acceleration')


@cache
def simulated(outputs='wrench', kind=None, motion='fourier', seed=0, samples=1000, rate_hz=20.0, urdf=None,
              masses=True):
    effects = (EffectRequest(kind, size=3.0),) if kind else ()
    made = simulate(Scenario(motion=motion, samples=samples, rate_hz=rate_hz, outputs=outputs, effects=effects,
                             seed=seed, urdf=urdf))
    described = made.urdf if masses else re.sub('<inertial>.*?</inertial>', '', made.urdf, flags=re.DOTALL)
    return body_of(replace(made, urdf=described)), samples_of(made)


@cache
def real_icub():
    return RigidBody.from_urdf(described('icub_arm/iCubGenova01.urdf'), ICUB_JOINTS, 'wrench', ICUB_SENSOR,
                               'reaction'), icub_table(SHARED_DATA / 'icub_arm' / 'icubdyn_train.dat')


@pytest.fixture
def icub(request):
    """The measured arm, and a simulated one for whoever lacks the recordings."""
    if SHARED_DATA.is_dir() or os.environ.get('CI', '').lower() == 'true':
        request.getfixturevalue('shared_data')
        return real_icub()
    return simulated()


@cache
def real_ur3(name='id2.bag'):
    """The ROS 1 bag, efforts negated as its notes say; accelerations as differences over five samples."""
    with open_bag(SHARED_DATA / 'ur3_arm' / name) as bag:
        messages = list(bag.messages(['/arm']))
    stamps = np.array([message.log_time for message in messages])
    position, velocity, effort = (np.array([getattr(message.data, role) for message in messages])
                                  for role in ('position', 'velocity', 'effort'))
    time = (stamps - stamps[0]) * 1e-9
    smooth = np.apply_along_axis(np.convolve, 0, velocity, np.full(5, 0.2), 'same')
    samples = Samples(stamps, position, velocity, np.gradient(smooth, time, axis=0), -effort, int(stamps[0]))
    return RigidBody.from_urdf(described('ur3_arm/ur3.urdf'), UR3, 'effort'), samples


def described(name: str) -> str:
    return (Path(SHARED_DATA) / name).read_text()


def whats(body, samples):
    return [problem.what for problem in setup_problems(body, samples)]


def found(body, samples):
    return [(problem.what, problem.where) for problem in setup_problems(body, samples)]


# ---- ways to break a recording


def scaled(samples, factor, *roles, joint=slice(None)):
    changed = {role: getattr(samples, role).copy() for role in roles}
    for values in changed.values():
        values[:, joint] *= factor
    return replace(samples, **changed)


def swapped(samples, one, other, *roles):
    order = np.arange(getattr(samples, roles[0]).shape[1])
    order[[one, other]] = other, one
    return replace(samples, **{role: getattr(samples, role)[:, order] for role in roles})


def turned(samples, order, signs):
    force, torque = samples.outputs[:, :3], samples.outputs[:, 3:]
    return replace(samples, outputs=np.hstack([force[:, order] * signs, torque[:, order] * signs]))


def slower(samples, factor):
    return replace(samples, stamps=samples.origin + ((samples.stamps - samples.origin) * factor).astype(np.int64))


MOTION_MISTAKES = {
    'positions in degrees': (lambda s: scaled(s, DEGREES, 'position'), ('position_units', ICUB[0])),
    'velocities in degrees': (lambda s: scaled(s, DEGREES, 'velocity'), ('velocity_units', ICUB[0])),
    'everything in degrees': (lambda s: scaled(s, DEGREES, *ROLES), ('position_units', None)),
    'velocities in rpm': (lambda s: scaled(s, 30.0 / np.pi, 'velocity', joint=1), ('velocity_units', ICUB[1])),
    'a velocity negated': (lambda s: scaled(s, -1.0, 'velocity', joint=2), ('velocity_sign', ICUB[2])),
    'a velocity missing': (lambda s: scaled(s, 0.0, 'velocity', joint=3), ('velocity_missing', ICUB[3])),
    'velocities swapped': (lambda s: swapped(s, 1, 3, 'velocity'), ('velocity_order', ICUB[1])),
    'a gear ratio': (lambda s: scaled(s, 3.0, 'velocity', joint=0), ('velocity_scale', ICUB[0])),
    'a slow clock': (lambda s: slower(s, 2.0), ('clock', None)),
    'milliseconds for seconds': (lambda s: slower(s, 1e-3), ('clock', None)),
    'accelerations in degrees': (lambda s: scaled(s, DEGREES, 'acceleration'), ('acceleration_units', ICUB[0])),
    'an acceleration negated': (lambda s: scaled(s, -1.0, 'acceleration', joint=1), ('acceleration_sign', ICUB[1])),
}
WRENCH_MISTAKES = {
    'sign': (lambda s: replace(s, outputs=-s.outputs), ('wrench_sign', 'r_arm_ft_sensor')),
    'force in kilograms': (lambda s: replace(s, outputs=s.outputs / 9.81), ('output_units', 'r_arm_ft_sensor')),
    'torque in N mm': (lambda s: replace(s, outputs=s.outputs * np.repeat([1.0, 1e3], 3)),
                       ('output_units', 'r_arm_ft_sensor')),
    'axes turned': (lambda s: turned(s, (1, 2, 0), (1, -1, 1)), ('wrench_axes', 'r_arm_ft_sensor')),
    'an axis mirrored': (lambda s: turned(s, (0, 1, 2), (1, -1, 1)), ('wrench_axes', 'r_arm_ft_sensor')),
    'force and torque exchanged': (lambda s: replace(s, outputs=np.roll(s.outputs, 3, axis=1)),
                                   ('force_torque', 'r_arm_ft_sensor')),
    **{f'{name} mirrored': (lambda s, j=joint: scaled(s, -1.0, *ROLES, joint=j), ('joint_direction', name))
       for joint, name in enumerate(ICUB_JOINTS)},
    **{f'{one} and {other} swapped': (lambda s, i=one, j=other: swapped(s, i, j, *ROLES), ('joint_order', ICUB[one]))
       for one, other in itertools.combinations(range(4), 2)},
}
EVERY_MISTAKE = {**MOTION_MISTAKES, **WRENCH_MISTAKES}
ALIKE = ('r_shoulder_roll mirrored', 'r_shoulder_yaw mirrored', '0 and 2 swapped', '0 and 3 swapped', '1 and 2 swapped',
         '1 and 3 swapped')
AXES = list(itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)))[1::12]


@pytest.mark.parametrize('name', [
    pytest.param(name, marks=pytest.mark.long) if name in ALIKE else name for name in EVERY_MISTAKE])
def test_each_mistake_is_found(name, icub):
    body, samples = icub
    mistake, expected = EVERY_MISTAKE[name]
    problems = setup_problems(body, mistake(samples))
    assert expected in [(problem.what, problem.where) for problem in problems]
    assert all(problem.sentence.endswith('.') for problem in problems)


@pytest.mark.parametrize('axes', [*AXES[::2], *(pytest.param(axes, marks=pytest.mark.long) for axes in AXES[1::2])])
def test_axes_are_named_the_way_back(axes):
    """Applying the axes that the sentence names to the broken copy gives the recording again."""
    body, samples = simulated()
    problems = setup_problems(body, turned(samples, *axes))
    if axes[1] == (-1, -1, -1) and axes[0] == (0, 1, 2):
        assert problems[0].what == 'wrench_sign'
        return
    sign = -1.0 if problems[0].what == 'wrench_sign' else 1.0
    names = problems[-1].sentence.partition('(')[2].partition(')')[0].split(', ')
    back = ['xyz'.index(name[-1]) for name in names], [sign * (-1.0 if name[0] == '-' else 1.0) for name in names]
    np.testing.assert_array_equal(turned(turned(samples, *axes), *back).outputs, samples.outputs)


@pytest.mark.parametrize(('factors', 'said'), [
    ((1.0, DEGREES, DEGREES, DEGREES), ['of the joints that turn are in degrees: publish them in rad and rad/s.']),
    ((1e3, 1.0, 1.0, 1.0), ['of the joints that slide are in millimetres: publish them in m and m/s.'])])
def test_no_joint_slides_in_degrees(factors, said):
    """Sliding joints in millimetres were told to be in degrees, twice, and rad to be right for them."""
    motion = smooth_motion(4, 250)
    recorded = replace(motion, outputs=ODD_BODY.outputs_of(motion, ODD_BODY.base_parameters))
    samples = scaled(recorded, np.array(factors), *ROLES)
    assert [problem.sentence for problem in layout_problems(ODD_BODY, samples, DEFAULTS)] == [
        f'Positions and velocities {each}' for each in said]


def test_a_joint_that_slides_the_wrong_way_does_not_turn():
    motion, slides = smooth_motion(4, 250), ODD_JOINTS.index(*ODD_BODY.prismatic)
    samples = replace(motion, outputs=ODD_BODY.outputs_of(motion, ODD_BODY.base_parameters))
    (problem,) = layout_problems(ODD_BODY, scaled(samples, -1.0, *ROLES, 'outputs', joint=slides), DEFAULTS)
    assert f"when '{ODD_JOINTS[slides]}' slides the other way" in problem.sentence


def test_a_base_on_its_head_or_on_a_wall_is_no_wrong_sign():
    body, samples = simulated()
    assert whats(body.with_gravity(np.array([0.0, 0.0, 9.81])), samples) == ['base_mounting']
    assert 'gravity along its -z axis' in setup_problems(body.with_gravity(np.array([0.0, 9.81, 0.0])),
                                                         samples)[0].sentence


@pytest.mark.parametrize(('outputs', 'kind'), [
    pytest.param('wrench', None, marks=pytest.mark.long), ('effort', None), ('wrench', 'sensor_offset')])
def test_a_description_without_masses_is_learnt_and_blamed_for_nothing(outputs, kind):
    body, samples = simulated(outputs, kind, masses=False)
    assert not body.inertial_parameters.any()
    assert not setup_problems(body, samples)
    found = diagnose(body, samples)
    assert [finding.effect.kind for finding in found.findings] == ([kind] if kind else [])
    assert found.after.nmse.max() < 0.05


def test_a_description_that_is_tilted_by_less_than_a_right_angle_is_no_base_on_its_head():
    body, samples = simulated()
    tilt = np.radians(35.0)
    found = setup_problems(body.with_gravity(9.81 * np.array([np.sin(tilt), 0.0, -np.cos(tilt)])), samples)
    assert [each.what for each in found] == ['base_mounting']
    assert 'gravity along its -z axis' in found[0].sentence


def test_odds_against_a_kind_of_mistake_are_spread_over_its_places():
    """A direction of a UR10's wrist was told as wrong with 13 nat, which one of six joints gains by chance."""
    body, right = simulated('effort')
    right = right[::20]
    wrong = replace(right, outputs=right.outputs * np.where(np.arange(body.n_outputs) == 1, -1.0, 1.0))
    equal = equations(body, right, DEFAULTS)
    share = independent(equal, right.outputs, evidence(equal, right.outputs).change)
    gain = evidence(equal, right.outputs, share).log - evidence(equal, wrong.outputs, share).log
    places = 1 + body.n_outputs  # all signs, or one
    for nats, told in ((-0.1, ['effort_sign']), (0.1, [])):
        config = replace(DEFAULTS, odds=np.exp(gain + nats) / places, no_match_share=1.0)
        assert [problem.what for problem in layout_problems(body, wrong, config)][:1] == told


@pytest.mark.parametrize('mass', [1.0, 3.0])
@pytest.mark.parametrize('outputs', ['effort', 'wrench'])
def test_a_load_that_slow_motion_shows_most_is_no_other_robot(outputs, mass):
    """It is most of what the outputs do from half time on; no inertias explain both halves. No effect was sought."""
    body, samples = simulated(outputs)
    middle, rng = samples.position.mean(axis=0), np.random.default_rng(0)
    slow = replace(samples, position=middle + 0.15 * (samples.position - middle), velocity=0.15 * samples.velocity,
                   acceleration=0.15 * samples.acceleration)
    inertia = mass * np.array([1.0, 0.05, 0.02, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    late = np.arange(len(slow))[:, None] >= 0.5 * len(slow)
    load = late * (body.full_regressors(slow)[:, :, -10:] @ inertia)
    noise = 0.01 * rng.standard_normal(load.shape)
    assert whats(body, replace(slow, outputs=body.outputs_of(slow, body.base_parameters) + load + noise)) == []


@pytest.mark.parametrize('size', [1e-6, 1e-4, 1e-2])
def test_a_velocity_that_is_hardly_more_than_noise_is_missing(size):
    body, samples = simulated('effort')
    noise = np.random.default_rng(0).standard_normal(len(samples))
    velocity = samples.velocity.copy()
    velocity[:, 1] = size * noise
    assert [(each.what, each.where) for each in setup_problems(body, replace(samples, velocity=velocity))] == [
        ('velocity_missing', body.joints[1])]


def test_a_wrench_that_has_nothing_to_do_with_the_robot_is_said_to():
    body, samples = simulated()
    noise = np.random.default_rng(0).standard_normal(samples.outputs.shape)
    assert whats(body, replace(samples, outputs=noise)) == ['robot_description']


@pytest.mark.parametrize(('mistake', 'expected'), [
    (lambda s: replace(s, outputs=-s.outputs), ('effort_sign', None)),
    (lambda s: replace(s, outputs=s.outputs * 1e3), ('output_units', None)),
    (lambda s: scaled(s, -1.0, *ROLES, 'outputs', joint=2), ('joint_direction', UR3[2])),
    (lambda s: swapped(s, 1, 3, *ROLES, 'outputs'), ('joint_order', UR3[1])),
    pytest.param(lambda s: scaled(s, DEGREES, *ROLES), ('position_units', None), marks=pytest.mark.long)])
def test_mistakes_in_the_real_efforts_of_a_ur3(mistake, expected, shared_data):
    body, samples = real_ur3()
    assert expected in found(body, mistake(samples))


@pytest.mark.parametrize(('name', 'one', 'other'), [
    ('id1.bag', 2, 3), pytest.param('id2.bag', 4, 5, marks=pytest.mark.long)])
@pytest.mark.parametrize(('roles', 'what'), [
    (('outputs',), 'effort_order'), (('position',), 'position_order'),
    (('velocity', 'acceleration'), 'velocity_order')])
def test_efforts_positions_or_velocities_of_two_joints_swapped_are_told_as_that(name, one, other, roles, what,
                                                                                shared_data):
    """Elbow and first wrist joint of id1 move alike, with a correlation of 0.89."""
    body, samples = real_ur3(name)
    problem, = setup_problems(body, swapped(samples, one, other, *roles))
    assert (problem.what, problem.where) == (what, UR3[one])
    assert UR3[other] in problem.sentence


@pytest.mark.parametrize(('one', 'other'), [
    ('fx', 'fy'), ('fx', 'tz'), pytest.param('fz', 'tx', marks=pytest.mark.long),
    pytest.param('ty', 'tz', marks=pytest.mark.long)])
def test_any_two_channels_of_a_wrench_swapped_are_told_as_that(one, other, shared_data):
    body, samples = real_icub()
    channels = body.output_names.index(one), body.output_names.index(other)
    problem, = setup_problems(body, swapped(samples, *channels, 'outputs'))
    assert (problem.what, problem.where) == ('wrench_order', one)
    assert other in problem.sentence


def test_three_velocities_in_a_circle_are_one_mistake():
    body, samples = simulated()
    problem, = setup_problems(body, replace(samples, velocity=samples.velocity[:, [1, 2, 0, 3]],
                                            acceleration=samples.acceleration[:, [1, 2, 0, 3]]))
    assert (problem.what, problem.where) == ('velocity_order', ICUB[0])
    assert all(name in problem.sentence for name in ICUB[:3])


@pytest.mark.parametrize('joint', [1, 5])
@pytest.mark.parametrize(('roles', 'what'), [
    (('position',), 'position_sign'), (('velocity', 'acceleration'), 'velocity_sign'), (('outputs',), 'effort_sign')])
def test_the_one_sign_that_is_wrong_is_named(joint, roles, what, shared_data):
    """Positions and velocities contradict each other; the efforts tell which of them is wrong. Joint 5 carries nothing:
    the sign of its effort shows in its friction alone."""
    body, samples = real_ur3()
    assert found(body, scaled(samples, -1.0, *roles, joint=joint)) == [(what, UR3[joint])]


@pytest.mark.parametrize('negated', [(3, 5), (1, 0), pytest.param((2, 3), marks=pytest.mark.long)])
def test_several_wrong_signs_among_the_efforts_of_a_ur3_are_all_named(negated, shared_data):
    """One correction at a time would leave the misfit large; friction alone is no help where one carries weight."""
    body, samples = real_ur3('id1.bag')
    for joint in negated:
        samples = scaled(samples, -1.0, 'outputs', joint=joint)
    assert set(found(body, samples)) == {('effort_sign', UR3[joint]) for joint in negated}


@pytest.mark.parametrize('seed', [1, pytest.param(2, marks=pytest.mark.long)])
def test_signs_of_joints_whose_efforts_the_description_predicts_badly_are_named(seed):
    """Correlations of 0.5 and 0.7 with the prediction, as of joints with a cable or a balancer, beside clear ones."""
    body, samples = simulated('effort', seed=seed)
    disturbed, rng = samples.outputs.copy(), np.random.default_rng(seed)
    for joint, likeness in ((1, 0.5), (3, 0.7)):
        spread = np.sqrt(1.0 / likeness**2 - 1.0) * disturbed[:, joint].std()
        disturbed[:, joint] += spread * np.sin(3.0 * samples.time + rng.uniform(0.0, 6.0))
        disturbed[:, joint] *= -1.0
    signs = [where for what, where in found(body, replace(samples, outputs=disturbed)) if what == 'effort_sign']
    assert set(signs) == {ICUB[1], ICUB[3]}
    assert not any(what == 'effort_sign' for what, _ in
                   found(body, replace(samples, outputs=disturbed * np.array([1.0, -1.0, 1.0, -1.0]))))


# ---- never where it is not


def test_the_real_recordings_as_declared_raise_no_alarm(shared_data):
    assert setup_problems(*real_icub()) == []
    assert setup_problems(*real_ur3('id1.bag')) == []
    assert setup_problems(*real_ur3('id2.bag')) == []


@pytest.mark.parametrize(('outputs', 'kind', 'motion'), [
    ('wrench', 'periodic_disturbance', 'circle_xy'), ('wrench', 'time_delay', 'fourier'),
    ('wrench', 'cable_hysteresis', 'reach'), ('wrench', 'sensor_misalignment', 'mixed'),
    ('wrench', 'bump', 'circle_xy'), ('wrench', 'joint_offset', 'fourier'), ('effort', 'backlash', 'circle_xy'),
    ('effort', 'two_mass_flexibility', 'circle_xy'), ('effort', 'time_delay', 'circle_xy'),
    ('effort', 'transmission_ripple', 'reach'), ('effort', 'coulomb_friction', 'mixed')])
def test_effects_of_three_times_the_usual_size_raise_no_alarm(outputs, kind, motion):
    assert setup_problems(*simulated(outputs, kind, motion, 5)) == []


@pytest.mark.parametrize(('outputs', 'effect'), [
    ('wrench', 'payload@r_gripper{"mass": 6.0, "first_moment_z": 0.5}'),
    pytest.param('effort', 'payload@r_gripper{"mass": 6.0, "first_moment_z": 0.5}', marks=pytest.mark.long),
    ('wrench', 'sensor_misalignment{"rotation_x": 0.0, "rotation_y": 0.0, "rotation_z": 1.5}'),
    ('effort', 'joint_offset@r_shoulder_pitch{"offset": -1.5}')])
def test_large_effects_that_are_declared_are_no_mistakes(outputs, effect):
    """A heavy tool was another unit, a sensor mounted at right angles other axes, though the model knew of them."""
    body, samples = simulated(outputs)
    known = effect_from_text(effect)
    coupled = CoupledColumns(body, [known])
    changed = coupled.batch(samples)[0] @ coupled.prior_mean - body.outputs_of(samples, body.base_parameters)
    there = replace(samples, outputs=samples.outputs + changed)
    assert setup_problems(body, there) and setup_problems(body, there, effects=[known]) == []
    assert setup_problems(body, replace(there, outputs=-there.outputs), effects=[known])


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_a_dead_output_ends_the_diagnosis_in_one_sentence(outputs):
    """One of them was noted alone: weighed as exact, it ended the fit, or bent it and had an error of 1e300."""
    body, samples = simulated(outputs)
    assert whats(body, replace(samples, outputs=np.full_like(samples.outputs, 3.0))) == ['outputs_constant']
    with pytest.raises(SemiparamError, match=f'No change was measured in {body.output_names[3]} while') as error:
        diagnose(body, scaled(samples, 0.0, 'outputs', joint=3))
    assert ('output_joints' in str(error.value)) == (outputs == 'effort')


def test_a_robot_that_stands_still_says_nothing_about_its_setup():
    body, samples = simulated()
    assert setup_problems(body, scaled(samples, 0.0, *ROLES)) == []


def test_stamps_that_repeat_or_jump_do_no_harm():
    body, samples = simulated()
    setup_problems(body, replace(samples, stamps=np.repeat(samples.stamps[::2], 2)))
    assert setup_problems(body, samples[np.sort(np.random.default_rng(0).choice(1000, 150, replace=False))]) == []


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
@pytest.mark.parametrize('seed', [0, pytest.param(1, marks=pytest.mark.long)])
def test_fast_motion_at_a_low_rate_is_no_other_robot(outputs, seed):
    """Accelerations that nobody measured make most of the outputs here."""
    body = arms.icub(outputs)
    samples = as_recorded(body, smooth_motion(4, 1000, speed=3.0, seed=seed))
    assert setup_problems(body, samples) == []
    opposite = setup_problems(body, replace(samples, outputs=-samples.outputs))
    assert [problem.what for problem in opposite] == [f'{outputs}_sign']


def test_too_short_a_recording_is_not_judged():
    body, samples = simulated()
    assert setup_problems(body, replace(samples, outputs=-samples.outputs)[:40]) == []


# ---- said, though the diagnosis goes on


def filtered(samples, time_constant_s):
    keep = np.exp(-np.median(np.diff(samples.time)) / time_constant_s)
    return replace(samples, velocity=lfilter([1.0 - keep], [1.0, -keep], samples.velocity, axis=0))


def said_to_be_late(samples):
    inputs = Inputs('smoothed', working_factor(samples))
    return late(inputs._replace(lags=measured_lags(samples, inputs)), samples)


@pytest.mark.parametrize('rate', [20.0, 200.0])
def test_velocities_that_a_filter_made_late_are_said_to_be_late(rate):
    _, samples = simulated('effort', rate_hz=rate, samples=2000)
    assert said_to_be_late(samples) == []
    sentence, = said_to_be_late(filtered(samples, 0.18))
    lag = float(sentence.partition('The velocities come ')[2].partition(' ms')[0]) * 1e-3
    assert lag == pytest.approx(0.18, abs=0.05)
    assert f'velocity_filter{{"time_constant_s": {lag:.2g}}}' in sentence and 'as much earlier' in sentence


def arrived_together(samples, count=10, every=100):
    """Every so many samples ``count`` of them are stamped when the last one arrives."""
    stamps = samples.stamps.copy()
    for first in range(every, len(stamps) - count, every):
        stamps[first:first + count] = stamps[first + count - 1] + 200_000 * np.arange(1 - count, 1)
    return replace(samples, stamps=stamps)


@pytest.mark.parametrize('rate', [50.0, 500.0])
def test_stamps_of_arrival_are_said_to_come_in_bursts(rate):
    _, samples = simulated('effort', rate_hz=rate)
    assert bursts(samples) == []
    uneven = np.sort(np.random.default_rng(0).choice(1000, 750, replace=False))
    assert bursts(samples[uneven]) == [], 'samples that are missing'
    sentence, = bursts(arrived_together(samples))
    assert sentence.startswith('The stamps come in bursts: 81 samples are stamped less than ')


def all_together(samples, count):
    """All samples arrive ``count`` at a time."""
    kept = samples[np.arange(len(samples) // count * count)]
    arrived = kept.stamps.reshape(-1, count)[:, -1:] + 200_000 * np.arange(1 - count, 1)
    return replace(kept, stamps=arrived.ravel())


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('count', [2, 3, 5, 10])
@pytest.mark.parametrize('rate', [50.0, 500.0])
def test_stamps_of_which_most_are_of_messages_that_arrived_together_are_the_reason_that_is_told(rate, count):
    """Only that 0 samples are left: the usual step was taken for the short one of the bursts."""
    body, samples = simulated('effort', rate_hz=rate, samples=2000)
    together = all_together(samples, count)
    sentence, = bursts(together)
    assert f'samples are stamped less than {500.0 / rate:.1f} ms after the one before' in sentence
    with pytest.raises(SemiparamError, match=r'a diagnosis needs at least 50\. The stamps come in bursts: .*Have the'):
        diagnose(body, together)
    paused = together.stamps + 60 * 10**9 * (np.arange(len(together)) > 1000)
    assert bursts(replace(together, stamps=paused)), 'after a pause, too'


def test_stamps_of_even_steps_are_no_bursts_whatever_the_units_and_pauses():
    _, samples = simulated('effort', rate_hz=100.0, samples=2000)
    units = [replace(samples, position=57.3 * samples.position), replace(samples, velocity=57.3 * samples.velocity),
             replace(samples, velocity=0.0 * samples.velocity)]
    for each in [samples, *units]:
        assert bursts(each) == []
    slower = np.append(np.arange(1000), np.arange(1000, 2000, 8))
    assert bursts(samples[slower]) == []
    paused = samples.stamps + 60 * 10**9 * (np.arange(len(samples)) > 1000)
    assert bursts(replace(samples, stamps=paused)) == []


@pytest.mark.filterwarnings('error')
def test_a_diagnosis_of_stamps_of_arrival_says_so_and_finds_no_late_velocities():
    """An elbow was said to be touched with two million N m, and the velocities to be late."""
    body, samples = simulated('effort', rate_hz=50.0)
    found = diagnose(body, arrived_together(samples), only=['viscous_friction'])
    assert found.notes[0].startswith('The stamps come in bursts: ')
    assert not any('come' in note and 'after the motion' in note for note in found.notes)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('factor', [100, 1000])
def test_a_clock_that_leaves_no_time_to_diagnose_is_said_to_be_wrong(factor):
    """Of stamps in another unit the motion cannot be smoothed: its positions were said to jump."""
    body, samples = simulated('effort', rate_hz=200.0)
    dense = replace(samples, stamps=samples.origin + (samples.stamps - samples.origin) // factor)
    with pytest.raises(SemiparamError, match=r'^The stamps are 5e-0[56] s apart, but positions'):
        diagnose(body, dense)
    with pytest.raises(SemiparamError, match=r'^\d+ samples of the recording, .* are left'):
        diagnose(body, samples[:210])


def test_jitter_that_the_states_share_is_no_burst():
    """A scheduler's: the state is measured when it is stamped."""
    _, dense = simulated('effort', rate_hz=1000.0, samples=20_000)
    steps = np.random.default_rng(1).choice([2, 10, 18], 1900)
    assert bursts(dense[np.cumsum(steps)]) == []


def test_accelerations_that_the_package_filters_itself_are_not_said_to_be_published():
    _, samples = simulated('effort', rate_hz=100.0, samples=2000)
    estimated = CausalDifferentiator(4, 1.0)
    late_ones = replace(samples, acceleration=np.array([
        estimated.update(stamp, velocity).copy()
        for stamp, velocity in zip(samples.stamps.tolist(), samples.velocity, strict=True)]))
    sentence, = said_to_be_late(late_ones)
    assert sentence.startswith('The accelerations come ') and sentence.endswith('They were not used here.')
    assert 'where none are published, raise acceleration.cutoff' in sentence


def test_late_velocities_beside_recorded_accelerations_were_put_right():
    """They are smoothed there, a little earlier: only the accelerations stay late."""
    samples = simulated()[1]
    velocity, acceleration = late(Inputs(BUT_ACCELERATIONS, 1, lags=(0.05, 0.05)), samples)
    assert velocity.endswith('Here they were taken as much earlier.')
    assert acceleration.endswith('Until then a friction or a delay found here may be off.')


def test_the_late_velocities_of_the_real_icub_are_noted(shared_data):
    lag = float(said_to_be_late(real_icub()[1])[0].partition('The velocities come ')[2].partition(' ms')[0]) * 1e-3
    assert lag == pytest.approx(0.075, abs=0.01)
    assert said_to_be_late(real_ur3('id1.bag')[1]) == []


def test_one_sine_for_all_joints_is_said_to_be_one():
    body, samples = simulated('effort')
    phase = 2.0 * samples.time[:, None] + np.arange(4.0)
    one = replace(samples, position=np.sin(phase), velocity=2.0 * np.cos(phase), acceleration=-4.0 * np.sin(phase))
    assert any('The 4 joints move along 2 directions only' in note for note in unidentifiable(body, one))
    more = replace(one, position=one.position + 0.1 * np.sin(3.1 * phase))
    assert not any('directions only' in note for note in unidentifiable(body, more))


def test_joints_that_move_less_than_others_move_by_themselves():
    """Next to a radian and a half, 30 mm and 30 mrad counted as no direction of their own."""
    body, samples = simulated('effort')
    angle = samples.time[:, None] * np.array([1.0, 1.7, 2.3, 2.9])
    own = replace(samples, position=np.sin(angle) * np.array([1.5, 1.5, 0.03, 0.03]))
    assert not any('directions only' in note for note in unidentifiable(body, own))


def test_efforts_that_are_zero_nine_times_in_ten_are_no_measurements():
    body, samples = simulated('effort')
    seldom = np.random.default_rng(0).random(len(samples)) < 0.1
    problem, = setup_problems(body, replace(samples, outputs=samples.outputs * seldom[:, None]))
    assert problem.what == 'outputs_zero' and 'r_elbow 9' in problem.sentence
    coarse = 0.25 * np.abs(samples.outputs).max(axis=0)
    assert 'outputs_zero' not in whats(body, replace(samples, outputs=np.trunc(samples.outputs / coarse) * coarse))


# ---- what takes no part


def test_a_protective_stop_and_spikes_of_a_real_arm_are_left_out(shared_data):
    _, samples = real_ur3()
    mask = excluded(samples)
    assert mask[-9:].all() and mask[np.searchsorted(samples.time, 12.22)]
    assert mask.mean() < 0.01


def test_other_real_recordings_are_whole(shared_data):
    assert not excluded(real_icub()[1]).any() and not excluded(real_ur3('id1.bag')[1]).any()


def test_samples_beside_a_gap_are_left_out():
    _, samples = simulated()
    gapped = samples[np.r_[0:300, 340:1000]]
    assert np.flatnonzero(excluded(gapped)).tolist() == list(range(290, 310))


@pytest.mark.parametrize(('outputs', 'kind'), [
    ('wrench', None), ('wrench', 'payload'), ('wrench', 'sensor_offset'), ('effort', 'coulomb_friction'),
    ('effort', 'backlash')])
@pytest.mark.parametrize('rate', [20.0, 200.0])
def test_jumps_friction_and_coarse_converters_are_no_shocks(outputs, kind, rate):
    _, samples = simulated(outputs, kind, 'fourier', 5, 3000, rate)
    assert excluded(samples).mean() < 0.015
    for step in (0.2, 1.0):
        coarse = step * samples.outputs.std(axis=0)
        assert excluded(replace(samples, outputs=np.round(samples.outputs / coarse) * coarse)).mean() < 0.015


def test_a_single_wrong_reading_is_a_shock():
    _, samples = simulated()
    outputs = samples.outputs.copy()
    outputs[500, 2] += 8.0 * outputs[:, 2].std()
    marked = np.flatnonzero(excluded(replace(samples, outputs=outputs)))
    assert 500 in marked and len(marked) <= 8


# ---- what cannot be told


def test_what_a_recording_cannot_show_is_said_by_name():
    body, samples = simulated()
    still = np.array([1.0, 1.0, 1.0, 0.0])
    frozen = replace(samples, **{role: getattr(samples, role) * still for role in ROLES})
    notes = unidentifiable(body, frozen[np.r_[0:100, 140:200]])
    assert any('r_elbow stood still' in note for note in notes)
    assert any('1 gap in time' in note and '2.05 s from 4.95 s' in note for note in notes)
    assert any('masses or centres of mass' in note and 'r_arm_ft_sensor' in note for note in notes)


def test_a_joint_that_hardly_moves_is_named():
    body, samples = simulated()
    held = replace(samples, position=samples.position * np.array([1.0, 0.01, 1.0, 1.0]))
    assert any(note.startswith('r_shoulder_roll (0.0') and 'hardly moved' in note
               for note in unidentifiable(body, held))


def test_a_joint_that_hardly_slides_is_named_in_metres():
    samples = smooth_motion(4, 400)
    held = replace(samples, position=samples.position * np.array([0.01, 1.0, 1.0, 1.0]), outputs=samples.velocity)
    assert any(note.startswith('lift (0.0') and ' m) hardly moved' in note for note in unidentifiable(ODD_BODY, held))


GANTRY = '<robot name="gantry">' + ''.join([
    link('base'), link('bridge', 5.0), link('quill', 2.0),
    arms.joint('across', 'prismatic', 'base', 'bridge', axis='1 0 0'),
    arms.joint('down', 'prismatic', 'bridge', 'quill', axis='0 0 -1')]) + '</robot>'


@pytest.mark.parametrize(('factors', 'found'), [
    ({'position': 1e3, 'velocity': 1e3}, 'are in millimetres: publish them in m and m/s.'),
    ({'position': 57.3}, "The position of 'across' changes 57.")])
def test_what_slides_is_in_no_degrees(factors, found):
    """It was told to be in degrees."""
    body = RigidBody.from_urdf(GANTRY, ('across', 'down'), 'effort')
    made = as_recorded(body, smooth_motion(2, 800))
    assert setup_problems(body, made) == []
    sentences = [problem.sentence for problem in setup_problems(
        body, replace(made, **{role: factor * getattr(made, role) for role, factor in factors.items()}))]
    assert found in sentences[0] and not any('degrees' in sentence for sentence in sentences)


def test_efforts_of_joints_that_slide_are_told_to_be_forces():
    """They were to be published in N m, all of them."""
    made = as_recorded(ODD_BODY, smooth_motion(4, 800))
    sentences = [problem.sentence for problem in setup_problems(ODD_BODY, replace(made, outputs=1e3 * made.outputs))]
    assert sentences[0].endswith(': publish it in N or N m.')


@pytest.mark.parametrize('count', [1, 2, 5])
def test_the_shortest_recordings_are_answered(count):
    body, samples = simulated()
    assert excluded(samples[:count]).shape == (count,)
    assert setup_problems(body, samples[:count]) == []


def test_rich_motion_leaves_nothing_to_say(shared_data):
    for outputs in ('wrench', 'effort'):
        assert unidentifiable(*simulated(outputs)) == []
    assert unidentifiable(*real_icub()) == [] and unidentifiable(*real_ur3()) == []


@pytest.mark.parametrize(('joint', 'stiffness', 'seed'), [(1, -40.0, 0), (2, -10.0, 1), (1, 40.0, 0)])
def test_a_balancer_is_no_wrong_sign(joint, stiffness, seed):
    """A spring across a joint changes its effort with the angle as gravity does, and may turn that over."""
    samples = smooth_motion(4, 1500, seed=seed, speed=0.5)
    outputs = noisy(ODD_BODY.regressors(samples) @ ODD_BODY.base_parameters, seed=seed)
    angle = samples.position[:, joint]
    outputs[:, joint] += stiffness * (angle - angle.mean())
    assert setup_problems(ODD_BODY, replace(samples, outputs=outputs)) == []


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
@pytest.mark.parametrize('factor', [1.0, 7.0])
def test_the_evidence_is_that_of_its_formula_in_the_units_of_the_parameters(outputs, factor):
    body, samples = simulated(outputs)
    measured = samples.outputs * np.where(np.arange(body.n_outputs) == 1, factor, 1.0)
    equal = equations(body, samples, DEFAULTS)
    found = evidence(equal, measured, 0.3)
    log, change = _plain_evidence(equal, measured, 0.3)
    np.testing.assert_allclose(found.log, log, rtol=1e-9)
    np.testing.assert_allclose(found.change, change, rtol=1e-5, atol=1e-9 * np.abs(change).max())


def _plain_evidence(equal, outputs, share):
    columns, deviation = equal.columns, channel_scale(outputs, not len(equal.power))
    size, nuisance = np.sqrt(np.mean(columns**2, axis=0).max(axis=0)), np.diag(equal.precision) == 0.0
    largest = deviation[np.abs(columns).max(axis=0).argmax(axis=0)]
    precision = equal.precision + np.diag(np.where(nuisance, (size / largest)**2, 0.0))
    left, noise = outputs - columns @ equal.mean, deviation
    for _ in range(DEFAULTS.rounds):
        weighed = columns * (share / noise**2)[:, None]
        information = np.einsum('tna,tnb->ab', weighed, columns) + precision
        change = np.linalg.solve(information, np.einsum('tna,tn->a', weighed, left))
        noise = np.sqrt(np.mean((left - columns @ change)**2, axis=0) + DEFAULTS.model_error * deviation**2)
    log = -share * len(left) * np.log(noise).sum() - 0.5 * change @ precision @ change
    log += 0.5 * (np.linalg.slogdet(precision)[1] - np.linalg.slogdet(information)[1])
    power = equal.power
    variance = np.einsum('na,na->n', power, np.linalg.solve(information, power.T).T)
    variance += DEFAULTS.model_error * (deviation[:len(power)] * equal.speed)**2
    return log + np.sum(np.log(2.0) + log_ndtr(power @ change / np.sqrt(variance))), change


@pytest.mark.filterwarnings('error')
def test_stamps_without_a_stretch_free_of_gaps_are_no_warning_of_numpy():
    """As of two drivers that stamp in turn: numpy warned of means of nothing."""
    body, samples = simulated(samples=999)
    stamps = np.tile([1_000_000, 1_000_000, 148_000_000], 333).cumsum()
    setup_problems(body, replace(samples, stamps=stamps, origin=int(stamps[0])))
