"""Whatever is asked of the feedforward: it is refused in a sentence, or finite, within the limits, and marked."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.effects import effect_from_text, kinds
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.estimate import from_estimator
from semiparam_ros.online.desired_state import described, desired, joint_torques
from semiparam_ros.online.feedforward import STATUS, Feedforward, status
from support.arms import icub, smooth_motion
from support.effect_cases import BODIES, CASES, MOTION, NAMES
from support.learner_stage import Stage
from support.node_helpers import BODY, SETTINGS, URDF, InlineBackground, motion

WILD = st.one_of(st.floats(-1.0, 1.0), st.floats(-1e9, 1e9), st.sampled_from([0.0, 1e9, -1e9, 1e-300, np.pi]))
NAN_OR_WILD = st.one_of(WILD, st.sampled_from([np.nan, np.inf]))


def assert_safe(body, found):
    """Finite, within the limits, and marked where it was cut."""
    for values in (found.outputs, found.outputs_std, found.efforts, found.efforts_std, [found.variance_ratio]):
        assert np.isfinite(values).all()
    assert (found.outputs_std >= 0.0).all() and (found.efforts_std >= 0.0).all()
    assert (np.abs(found.efforts) <= body.effort_limits).all()
    assert (np.abs(found.efforts[found.limited]) == body.effort_limits[found.limited]).all()
    if body.outputs == 'effort':
        assert found.outputs is found.efforts
    marks = dict(zip(STATUS, status(found), strict=True))
    assert bool(marks['valid']) == (not found.described and not found.limited.any() and found.distance <= 2.0
                                    and found.variance_ratio <= 1.0)


LEARNT = {}


def learnt(outputs, effect):
    """P with an effect after a short motion; built once."""
    place = outputs, NAMES[CASES.index((outputs, effect))]
    if place not in LEARNT:
        body = BODIES[outputs]
        estimator = Estimator(body, ModelOptions(variant='P', initial_samples=1000), [effect])
        for sample in list(MOTION)[:20]:
            row = [values[:body.n_joints] for values in sample[1:4]]
            outputs = body.regressor(*row) @ body.base_parameters + 0.1
            estimator.step(Sample(sample.stamp, *row, outputs, sample.temperature))
        LEARNT[place] = estimator
    return LEARNT[place]


@pytest.mark.filterwarnings('ignore:.*encountered in.*:RuntimeWarning')
@given(st.sampled_from(CASES), st.lists(NAN_OR_WILD, min_size=12, max_size=12))
def test_every_effect_and_every_state(case, values):
    outputs, effect = case
    body, estimator = BODIES[outputs], learnt(outputs, effect)
    row = np.reshape(values[:3 * body.n_joints], (3, body.n_joints))
    for answer in (desired, described):
        try:
            found = answer(estimator, *row)
        except SemiparamError as error:
            assert 'expected finite values' in str(error)
        else:
            assert np.isfinite(row).all()
            assert_safe(body, found)


def test_what_is_known_well_is_as_uncertain_as_a_measurement_which_is_a_quarter_of_what_is_valid():
    body = BODIES['effort']
    estimator, ratios = Estimator(body, ModelOptions(variant='P', initial_samples=50, forgetting=1.0)), []
    rng = np.random.default_rng(0)
    for sample in smooth_motion(4, 2000):
        outputs = body.regressor(*sample[1:4]) @ body.base_parameters + 0.1 * rng.standard_normal(body.n_outputs)
        estimator.step(sample._replace(outputs=outputs))
        if estimator.ready:
            ratios.append(desired(estimator, *sample[1:4]).variance_ratio)
    assert 0.25 < ratios[-1] < 0.3 < ratios[0]


def test_a_desired_state_is_as_warm_as_the_newest_sample():
    body, number, velocity = BODIES['effort'], 2, np.array([0.1, -0.2, 0.7, 0.3])
    effect = kinds()['temperature_friction'](body.joints[number], options={'reference_c': 30.0})
    estimator = Estimator(body, ModelOptions(variant='P', initial_samples=1000, forgetting=1.0,
                                                   joint_friction=False), [effect])
    for sample in smooth_motion(4, 400):
        friction = np.zeros(4)
        warmth = np.full(4, 30.0 + (sample.stamp % 10**9) * 1e-8)
        friction[number] = (3.0 - 0.2 * (warmth[number] - 30.0)) * sample.velocity[number]
        estimator.step(sample._replace(temperature=warmth, outputs=friction + body.regressor(*sample[1:4])
                                       @ body.base_parameters))
    found = {}
    for warmth in (30.0, 40.0, np.nan):
        estimator.step(sample._replace(temperature=np.full(4, warmth), outputs=np.zeros(4)), learn=False)
        found[warmth] = desired(estimator, np.zeros(4), velocity, np.zeros(4)).outputs
    expected = np.zeros(4)
    expected[number] = -0.2 * 10.0 * velocity[number]
    np.testing.assert_allclose(found[40.0] - found[30.0], expected, atol=0.02)
    np.testing.assert_allclose(found[np.nan], found[30.0], atol=1e-12)


def test_the_cases_are_of_every_effect():
    assert len(CASES) == len(NAMES) and {outputs for outputs, _ in CASES} == {'wrench', 'effort'}


ROW = [np.array([0.1, -0.2]), np.array([0.3, 0.1]), np.array([0.0, 0.5])]


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_it_is_withheld_until_there_is_a_model_or_answered_by_the_description(outputs):
    settings = replace(SETTINGS, outputs=outputs)
    body = BODY if outputs == 'wrench' else RigidBody.from_urdf(URDF, settings.joints, 'effort')
    stage, feedforward = Stage(settings, body=body), Feedforward()
    samples = motion(100, body=body)
    gathering = 'the initial window is over, which has {} of 60 samples of motion'
    for count, until in ((0, gathering.format(0)), (30, gathering.format(30)),
                         (60, 'the hyperparameters of SPK-ML are estimated from the initial window')):
        stage.offer(samples[stage.learner.answered:count])
        with pytest.raises(SemiparamError, match=f'no model yet: there is none until {until}'):
            from_estimator(stage.learner.estimator, None, 'it')
        with pytest.raises(SemiparamError, match=f'withheld until {until}'):
            feedforward.answer(stage.learner, *ROW)
    stage.learner.change(replace(settings, feedforward_before_ready='description'))
    found = feedforward.answer(stage.learner, *ROW)
    expected = body.regressor(*ROW) @ body.base_parameters
    assert found.described and status(found)[0] == 0.0
    np.testing.assert_allclose(found.outputs, expected, atol=1e-12)
    assert (found.outputs_std > 0.2 * np.abs(expected)).all(), 'inertias known to 30 % are not known well'
    assert_safe(body, found)
    stage.background.run()
    found = feedforward.answer(stage.learner, *samples[50][1:4])
    assert not found.described and not found.outside
    assert_safe(body, found)
    counts = feedforward.counts
    assert (counts['answered'], counts['described'], counts['withheld']) == (2, 1, 3)
    stage.learner.change(replace(settings, feedforward_before_ready='withhold'))
    stage.learner.reset()
    with pytest.raises(SemiparamError, match='withheld'):
        feedforward.answer(stage.learner, *ROW)


@pytest.mark.parametrize(('farther', 'less_sure', 'valid'), [(1.9, 0.9, 1.0), (2.1, 0.9, 0.0), (1.9, 1.1, 0.0)])
def test_a_state_is_valid_up_to_twice_the_distance_and_twice_the_deviation(farther, less_sure, valid):
    found = desired(learnt(*CASES[0]), *np.zeros((3, BODIES[CASES[0][0]].n_joints)))
    none = np.zeros(len(found.efforts), dtype=bool)
    assert status(found._replace(distance=farther, variance_ratio=less_sure, limited=none))[0] == valid


@pytest.mark.parametrize('mass', [0.1, 1.0, 100.0])
def test_a_description_is_known_to_the_same_share_of_any_robot(mass):
    urdf = f'''<robot name="beam"><link name="base"/><link name="beam"><inertial><origin xyz="0.5 0 0"/>
        <mass value="{mass}"/><inertia ixx="{mass / 100}" ixy="0" ixz="0" iyy="{mass / 10}" iyz="0" izz="{mass / 10}"/>
        </inertial></link><joint name="hinge" type="revolute"><parent link="base"/><child link="beam"/>
        <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1e9" velocity="9"/></joint></robot>'''
    body = RigidBody.from_urdf(urdf, ['hinge'], 'effort')
    found = described(Estimator(body, ModelOptions(variant='P')), *np.zeros((3, 1)))
    share = found.outputs_std / np.abs(found.outputs)
    assert 0.3 < share < 0.5, 'its centre may lie elsewhere too'


def test_efforts_are_cut_to_the_limits_of_the_description_and_said_so():
    settings = replace(SETTINGS, outputs='effort', variant='P')
    stage, feedforward = Stage(settings, body=RigidBody.from_urdf(URDF, settings.joints, 'effort')), Feedforward()
    stage.offer_and_build(motion(60, body=stage.learner.body))
    before = feedforward.counts.copy()
    found = feedforward.answer(stage.learner, ROW[0], ROW[1], np.array([0.0, 4000.0]))
    assert found.efforts[1] == 10.0 and found.limited[1], 'the limit of joint b'
    assert 'acceleration of b' in found.outside
    assert feedforward.sentence(before).startswith('of 1 desired states 1 cut to the effort limits')
    assert status(found)[:1] == [0.0]


@pytest.mark.parametrize('text', ['effort="0"', 'effort="-3"', 'effort="inf"', 'effort="much"', ''])
def test_what_is_no_limit_limits_nothing(text):
    text = URDF.replace('effort="10"', text, 1)
    assert RigidBody.from_urdf(text, ('a', 'b'), 'effort').effort_limits.tolist() == [np.inf, 10.0]


def test_the_deviation_of_torques_is_that_of_the_wrench_carried_to_the_joints():
    stage = Stage(replace(SETTINGS, variant='P'))
    stage.offer_and_build(motion(60))
    found, step = desired(stage.learner.estimator, *ROW), 1e-6
    wrench, covariance = found.outputs, stage.learner.estimator.predict_desired(*ROW).covariance
    base = joint_torques(BODY, *ROW, wrench)[0]
    jacobian = np.array([(joint_torques(BODY, *ROW, wrench + step * unit)[0] - base) / step for unit in np.eye(6)])
    np.testing.assert_allclose(found.efforts_std**2, np.diag(jacobian.T @ covariance @ jacobian), rtol=1e-4)


@pytest.mark.parametrize('effect', ['gravity_tilt{"tilt_x": 0.1}', 'joint_offset@r_shoulder_roll{"offset": 0.1}',
                                    'gear_coupling@r_shoulder_roll{"ratio": 0.3}'])
def test_torques_from_a_wrench_are_those_of_the_arm_as_the_effects_have_it(effect):
    """Of the links before the sensor too, which the wrench does not show."""
    body, rng = icub(), np.random.default_rng(0)
    estimator, doubting = (Estimator(body, ModelOptions('P', alone=alone), [effect_from_text(effect)])
                           for alone in (True, False))
    row = rng.normal(0.0, 0.5, (3, 4))
    moved, gravity, motors = row.copy(), body.arm.gravity.linear, np.eye(4)
    if 'tilt' in effect:
        gravity = pin.exp3(np.array([0.1, 0.0, 0.0])).T @ gravity
    elif 'offset' in effect:
        moved[0, 1] += 0.1
    else:
        motors[0, 1] = 0.3
        moved = row @ motors
    arm = body.arm.copy()
    arm.gravity.linear = gravity
    expected = motors @ pin.rnea(arm, arm.createData(), *moved)
    np.testing.assert_allclose(desired(estimator, *row).efforts, expected, atol=1e-9)
    without = pin.rnea(body.arm, body.arm.createData(), *row)
    np.testing.assert_allclose(desired(doubting, *row).efforts, 0.5 * (expected + without), rtol=0.05, atol=0.01)


def test_what_the_description_answers_after_a_reset_is_not_marked_as_what_came_before_it():
    """Nothing was cut of a state at rest, but the log said so."""
    stage, samples = Stage(replace(SETTINGS, variant='P', feedforward_before_ready='description'),
                           InlineBackground()), motion(100)
    stage.offer(samples)
    feedforward, at_rest = Feedforward(), (samples[0].position, np.zeros(2), np.zeros(2))
    feedforward.answer(stage.learner, samples[0].position, np.full(2, 99.0), np.zeros(2))
    assert 'effort of a cut' in feedforward.sentence(Counter())
    stage.learner.reset()
    before = feedforward.counts.copy()
    feedforward.answer(stage.learner, *at_rest)
    assert feedforward.sentence(before).endswith('by the robot description alone (no model yet).')
