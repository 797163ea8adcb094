"""Friction, rotor and offset of the joints as part of the rigid body's model of efforts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.joint_friction import (
    KINDS,
    OFFSET_SHARE,
    TOP_SPEED,
    TURN_SPEEDS,
    friction_scale,
    joint_columns,
    turning_variance,
)
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import base_scale, inertial_scale, radians, size_beyond
from support.arms import ODD_ARM, ODD_BODY, ODD_JOINTS, icub, smooth_motion

ARM = ODD_BODY
TWO_OF_FOUR = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'effort', output_joints=('turn', 'grip'))
VISCOUS, DRY, OFFSET = np.array([3.0, 1.0, 0.5, 0.1]), np.array([5.0, 2.0, 1.0, 0.2]), np.array([1.0, -0.5, 0.3, 0.1])
ROTOR = np.array([2.0, 0.5, 0.2, 0.05])


def rubbing(motion, turn_speed, rotor=0.0):
    outputs = ARM.regressors(motion) @ ARM.base_parameters + OFFSET + VISCOUS * motion.velocity
    return replace(motion, outputs=outputs + DRY * np.tanh(motion.velocity / turn_speed) + rotor * motion.acceleration)


@given(st.lists(st.floats(-10.0, 10.0), min_size=4, max_size=4))
def test_a_sample_has_the_columns_of_a_batch_each_for_its_own_effort(velocity):
    for body in (ARM, TWO_OF_FOUR):
        sample = smooth_motion(4, 2)[0]._replace(velocity=np.array(velocity))
        columns, n = CoupledColumns(body, joint_friction=True), body.n_outputs
        one, _ = columns.one(sample, 0)
        friction, rotor = (columns.blocks[name] for name in ('friction', 'rotor'))
        block = one[:, friction.start:rotor.stop]
        batch = joint_columns(body, sample.velocity[None], sample.acceleration[None])[0]
        np.testing.assert_allclose(block, batch, rtol=1e-12, atol=1e-15)
        np.testing.assert_array_equal(one[:, rotor], np.diag(sample.acceleration[body.output_index]))
        own = sample.velocity[body.output_index]
        np.testing.assert_array_equal(block[:, :n], np.diag(own))
        for index, speed in enumerate(TURN_SPEEDS, start=1):
            turns = own / (speed * radians(body)[body.output_index])
            np.testing.assert_allclose(block[:, index * n:(index + 1) * n], np.diag(np.tanh(turns)), rtol=1e-12)
        np.testing.assert_array_equal(one[:, columns.blocks['offset']], np.eye(n))


def test_a_short_stroke_turns_over_as_fast_as_a_short_arm_does():
    """A quill of .1 m that moves at .05 m/s had half its friction, for its direction turned over as a metre's does."""
    quill = RigidBody.from_urdf(
        '<robot name="r"><link name="b"/><link name="q"><inertial><mass value="1"/><origin xyz="0 0 0.1"/>'
        '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="quill" '
        'type="prismatic"><parent link="b"/><child link="q"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" '
        'velocity="1"/></joint></robot>', ['quill'], 'effort')
    speed = 0.05 * np.sin(np.linspace(0.0, 100.0, 5000))[:, None]
    viscous, *dry, _ = joint_columns(quill, speed, np.zeros_like(speed)).reshape(5000, -1).T
    rows, force = np.column_stack([viscous, *dry]), 20.0 * speed + 8.0 * np.sign(speed)
    found = np.linalg.lstsq(rows, force, rcond=None)[0].ravel()
    assert found[1:].sum() == pytest.approx(8.0, rel=0.02) and found[0] == pytest.approx(20.0, rel=0.05)


def test_the_directions_are_the_dry_columns_output_by_output():
    for body in (ARM, TWO_OF_FOUR):
        columns, n = CoupledColumns(body, joint_friction=True), body.n_outputs
        rows, _ = columns.one(smooth_motion(4, 2)[0]._replace(velocity=np.full(4, 1.0)), 0)
        dry = rows[:, columns.directions].reshape(n, len(TURN_SPEEDS), n)
        np.testing.assert_array_equal(dry, np.broadcast_to(np.eye(n)[:, None], dry.shape))
        assert len(CoupledColumns(body).directions) == 0


def test_the_variance_of_turning_is_that_of_a_sign_with_the_mean_of_the_columns():
    for body in (ARM, TWO_OF_FOUR):
        motion, columns = smooth_motion(4, 50), CoupledColumns(body, joint_friction=True)
        rows, _ = columns.batch(motion)
        theta = np.random.default_rng(1).standard_normal(columns.n_columns)
        friction = theta[columns.directions].reshape(len(TURN_SPEEDS), body.n_outputs)
        own = motion.velocity[:, body.output_index] / radians(body)[body.output_index]
        mean = sum(each * np.tanh(own / speed) for each, speed in zip(friction, TURN_SPEEDS, strict=True))
        expected = np.maximum(friction.sum(axis=0)**2 - mean**2, 0.0)
        for one, its in zip(rows, expected, strict=True):
            np.testing.assert_allclose(turning_variance(columns.directions, theta, one), its, atol=1e-12)


def test_a_wrench_and_the_bare_rigid_body_have_none():
    for body, chosen in ((icub(), True), (ARM, False)):
        columns, bare = CoupledColumns(body, joint_friction=chosen), CoupledColumns(body)
        assert columns.blocks == bare.blocks and columns.n_own == bare.n_own
    assert CoupledColumns(ARM, joint_friction=True).n_own == ARM.n_parameters + (KINDS + 2) * 4


@pytest.mark.parametrize('turn_speed', [0.005, 0.012, 0.03])
def test_friction_between_the_two_speeds_and_rotors_are_learnt_and_carried_to_another_motion(turn_speed):
    errors = {}
    for joint_friction in (True, False):
        estimator = Estimator(ARM, ModelOptions(variant='P', initial_samples=200, joint_friction=joint_friction))
        for sample in rubbing(smooth_motion(4, 1200, rate=50.0, seed=1), turn_speed, ROTOR):
            estimator.step(sample)
        other = rubbing(smooth_motion(4, 400, rate=50.0, seed=2), turn_speed, ROTOR)
        estimator.begin_recording(other.origin)
        left = np.array([sample.outputs - estimator.step(sample, learn=False).mean for sample in other])
        errors[joint_friction] = np.mean(left**2 / other.outputs.var(axis=0))
    assert errors[True] < 2e-3 and errors[True] < 0.02 * errors[False]


def test_friction_of_joints_that_went_one_way_is_that_of_the_other_way_too():
    """No sample tells it from an offset. A third was taken for one, and 40 % of the variance was missed there."""
    estimator = Estimator(ARM, ModelOptions(variant='P', initial_samples=200))
    motion = smooth_motion(4, 1200, rate=50.0, seed=1)
    forth = motion.velocity - 1.1 * motion.velocity.min(axis=0)
    one_way = replace(motion, velocity=forth, position=np.cumsum(forth, axis=0) / 50.0)
    for sample in rubbing(one_way, 0.012):
        estimator.step(sample)
    slow, still = np.full(4, 0.2), np.zeros(4)
    there, back = (estimator.predict_desired(still, way * slow, still).needed for way in (1.0, -1.0))
    np.testing.assert_allclose(0.5 * (there - back), DRY + VISCOUS * slow, rtol=0.2, atol=0.2)


def test_the_prior_is_as_wide_as_the_robot_is_large():
    columns = CoupledColumns(ARM, joint_friction=True, physical=True)
    scale, blocks = columns.prior_scale, columns.blocks
    np.testing.assert_array_equal(scale[blocks['rigid_body']], base_scale(ARM))
    viscous, *dry = scale[blocks['friction']].reshape(KINDS, -1)
    radius = np.array([size_beyond(ARM, 'lift').length, 1.0, 1.0, 1.0])  # no lift of decimetres is as fast as 3 m/s
    np.testing.assert_allclose(viscous * TOP_SPEED * radius, friction_scale(ARM), rtol=1e-14)
    np.testing.assert_array_equal(dry, [friction_scale(ARM)] * len(TURN_SPEEDS))
    swing = 18.0 * radius  # [rad/s^2], of the lift [m/s^2]
    np.testing.assert_allclose(scale[blocks['rotor']] * swing, friction_scale(ARM), rtol=1e-14)
    np.testing.assert_array_equal(scale[blocks['offset']], OFFSET_SHARE * friction_scale(ARM))
    np.testing.assert_array_equal(columns.expected[blocks['rigid_body']], ARM.base_parameters)
    assert not CoupledColumns(ARM, joint_friction=True).expected.any(), 'of the paper: about zero'
    bodies = ARM.inertial_parameters.reshape(-1, 10)
    assert (inertial_scale(ARM).reshape(-1, 10) >= np.abs(bodies) * (1.0 - 1e-9)).all()


def test_joints_need_friction_and_offset_of_a_desired_state():
    estimator = Estimator(ARM, ModelOptions(variant='P', initial_samples=200))
    for sample in rubbing(smooth_motion(4, 1200, rate=50.0, seed=1), 0.012):
        estimator.step(sample)
    zero, velocity = np.zeros(4), np.full(4, 0.4)
    there, back = (estimator.predict_desired(zero, way * velocity, zero).needed for way in (1.0, -1.0))
    np.testing.assert_allclose(0.5 * (there - back), DRY + VISCOUS * velocity, rtol=0.1, atol=0.1)
