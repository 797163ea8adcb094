"""Motions: circles of the right size and pace, never the same, limits kept, one curve with its own derivatives."""

import re

import numpy as np
import pytest

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation import Scenario
from semiparam_ros.simulation.motions import MOTIONS, trajectory
from semiparam_ros.simulation.robots import ICUB_JOINTS, arm_of, bundled_urdf, homes_of
from semiparam_ros.simulation.trajectory import wander

ARM = arm_of(Scenario())
HOMES = homes_of(Scenario(), ARM)


def moved(motion, duration=30.0, seed=0):
    return trajectory(ARM, motion, duration, HOMES, np.random.default_rng(seed))


@pytest.mark.parametrize('motion', MOTIONS)
def test_derivatives_belong_to_the_position(motion):
    path, step = moved(motion), 1e-3
    time = np.arange(1.0, 29.0, 0.05)
    middle, before, after = (path.at(time + shift) for shift in (0.0, -step, step))
    assert np.allclose((after.position - before.position) / (2 * step), middle.velocity, atol=2e-4)
    assert np.allclose((after.velocity - before.velocity) / (2 * step), middle.acceleration, atol=2e-2)


@pytest.mark.parametrize('motion', MOTIONS)
@pytest.mark.parametrize('seed', [1, 2])
def test_limits_are_kept(motion, seed):
    position = moved(motion, 60.0, seed).at(np.arange(0, 60, 0.01)).position
    low, high = ARM.limits
    assert np.all(position > low)
    assert np.all(position < high)


@pytest.mark.parametrize('motion', MOTIONS)
def test_joints_without_room_or_speed_stay_or_move(motion):
    """Many a URDF says 0 for what nobody knows: positions were no numbers, or the motion never went on."""
    urdf = bundled_urdf().read_text()
    elbow, shoulder = (re.search(rf'<joint name="r_{name}".*?<limit[^>]*>', urdf, re.DOTALL)[0]
                       for name in ('elbow', 'shoulder_yaw'))
    urdf = urdf.replace(elbow, re.sub('(lower|upper)="[^"]*"', r'\1="0.5"', elbow))
    urdf = urdf.replace(shoulder, re.sub('velocity="[^"]*"', 'velocity="0"', shoulder))
    arm = arm_of(Scenario(urdf=urdf, joints=ICUB_JOINTS, outputs='effort', sensor_frame=''))
    path = trajectory(arm, motion, 30.0, HOMES, np.random.default_rng(0)).at(np.arange(0.0, 30.0, 0.05))
    assert np.isfinite(path.acceleration).all()
    if motion in ('fourier', 'reach'):
        assert np.ptp(path.position[:, 2]) > 0.05 and np.abs(path.position[:, 3] - 0.5).max() < 2e-3


@pytest.mark.parametrize(('motion', 'plane', 'normal'), [('circle_xy', [0, 1], 2), ('circle_xz', [0, 2], 1)])
def test_circles(motion, plane, normal):
    time = np.arange(0, 60, 0.01)
    place = ARM.pose(ARM.tip, moved(motion, 60.0).at(time).position).place
    place = place - place.mean(axis=0)
    extent = np.ptp(place, axis=0)
    assert np.all(np.abs(extent[plane] - 0.10) < 0.03)
    assert extent[normal] < 0.03
    angle = np.unwrap(np.arctan2(place[:, plane[1]], place[:, plane[0]]))
    turns = abs(angle[-1] - angle[0]) / (2 * np.pi)
    assert 60.0 / turns == pytest.approx(1.25, rel=0.1)


def test_no_turn_is_like_another():
    time = np.arange(0, 60, 0.05)
    position = moved('circle_xy', 60.0).at(time).position
    gaps = [np.abs(position[k:] - position[:-k]).max() for k in range(20, 600)]
    assert min(gaps) > 0.02


def test_what_is_unknown_is_refused():
    with pytest.raises(SemiparamError, match="motion 'dance' is unknown; expected one of circle_xy"):
        moved('dance')


def test_wander_has_unit_size():
    values = wander(np.arange(0, 4000, 0.5), 20.0, np.random.default_rng(0))
    assert values.std() == pytest.approx(1.0, abs=0.05)
    assert abs(values.mean()) < 0.05
