"""Feedforward: the torques that follow from a wrench model, against pinocchio's rnea."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from node_helpers import BODY, SETTINGS, URDF, motion
from trajectory_msgs.msg import JointTrajectoryPoint

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.desired_trajectory import desired_state, joint_order
from semiparam_ros.ros.feedforward import Desired, joint_torques, sensor_offset
from semiparam_ros.settings.build import build_estimator, build_rigid_body

MIDDLE = replace(SETTINGS, robot_description=URDF.replace(
    '<child link="ft"/><origin', '<child link="fore"/><origin').replace(
    '<link name="ft">', '<link name="fore"><inertial><mass value="0.7"/><inertia ixx="0.01" iyy="0.01" izz="0.01" '
    'ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="mount" type="fixed"><parent link="fore"/>'
    '<child link="ft"/><origin xyz="0.01 0 0.2" rpy="0.3 0.1 0"/></joint><joint name="wrist" type="revolute">'
    '<parent link="ft"/><child link="hand"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" '
    'effort="9" velocity="9"/></joint><link name="hand"><inertial><mass value="0.4"/><origin xyz="0 0.03 0.05"/>'
    '<inertia ixx="0.003" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="ft">'),
    joints=('wrist', 'a', 'b'))


def rnea(settings, *row):
    """Torques of the description of some settings, in the order of the joints."""
    body = build_rigid_body(settings)
    q, dq, ddq = (body.arm_vector(values) for values in row)
    return np.array(pin.rnea(body.arm, body.arm.createData(), q, dq, ddq))[body.arm_columns]


@pytest.mark.parametrize('convention', ['action', 'reaction'])
@pytest.mark.parametrize('settings', [SETTINGS, MIDDLE], ids=['at the end', 'in the middle'])
def test_torques_follow_from_the_wrench_of_a_heavier_hand(settings, convention):
    """The wrench of a hand that weighs more than described gives the torques of the arm with that hand."""
    settings = replace(settings, wrench_convention=convention)
    body = build_rigid_body(settings)
    proximal = [index for index, name in enumerate(settings.joints) if name != 'wrist']
    heavier = replace(settings, robot_description=settings.robot_description.replace('value="0.5"', 'value="0.9"'))
    heavy, rng = build_rigid_body(heavier), np.random.default_rng(3)
    for _ in range(20):
        row = rng.uniform(-2.0, 2.0, (3, body.n_joints))
        wrench = heavy.regressor(*row) @ heavy.base_parameters
        np.testing.assert_allclose(joint_torques(body, *row, wrench)[proximal], rnea(heavier, *row)[proximal],
                                   atol=1e-9)
        described = body.regressor(*row) @ body.base_parameters
        np.testing.assert_allclose(joint_torques(body, *row, described), rnea(settings, *row), atol=1e-9)


def test_a_learnt_model_gives_the_torques_of_the_robot_as_it_is_without_the_sensors_offset():
    settings = replace(SETTINGS, variant='P')
    heavier = replace(settings, robot_description=URDF.replace('mass value="0.5"', 'mass value="0.9"'))
    heavy, estimator, rng = build_rigid_body(heavier), build_estimator(settings), np.random.default_rng(0)
    offset = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
    for sample in motion(600):
        outputs = heavy.regressor(*sample[1:4]) @ heavy.base_parameters + offset
        estimator.step(sample._replace(outputs=outputs + 1e-4 * rng.standard_normal(6)))
    sample = motion(620)[-1]
    desired = Desired(estimator, sample.stamp, *sample[1:4])
    np.testing.assert_allclose(desired.efforts, rnea(heavier, *sample[1:4]), atol=0.01)
    np.testing.assert_allclose(desired.outputs, heavy.regressor(*sample[1:4]) @ heavy.base_parameters + offset,
                               atol=0.01)


def test_an_effort_model_predicts_them_and_a_purely_nonparametric_one_knows_no_offset():
    settings = replace(SETTINGS, outputs='effort', sensor_frame='', variant='P')
    estimator, sample = build_estimator(settings), motion(2)[1]
    desired = Desired(estimator, sample.stamp, *sample[1:4])
    np.testing.assert_allclose(desired.efforts, rnea(settings, *sample[1:4]), atol=1e-9)
    estimator = build_estimator(replace(SETTINGS, variant='NP-ML'))
    for each in motion(80):
        estimator.step(each)
    np.testing.assert_array_equal(sensor_offset(estimator), np.zeros(BODY.n_outputs))


def test_trajectories_that_lack_something_are_refused_by_name():
    assert joint_order(['b', 'a'], ('a', 'b')) == [1, 0]
    for names in ([], ['a'], ['a', 'c'], ['a', 'b', 'b']):
        with pytest.raises(SemiparamError, match='expected a, b'):
            joint_order(names, ('a', 'b'))
    point = JointTrajectoryPoint(positions=[1.0, 2.0], velocities=[3.0, 4.0], accelerations=[5.0, 6.0])
    assert [part.tolist() for part in desired_state(point, [1, 0], 0)] == [[2.0, 1.0], [4.0, 3.0], [6.0, 5.0]]
    point.accelerations = []
    with pytest.raises(SemiparamError, match='point 7 of desired_trajectory has 0 accelerations for 2 joints'):
        desired_state(point, [0, 1], 7)
