"""Estimates of a recording: when a load appears."""

import numpy as np
import pytest

from semiparam_ros.core.robot.frames import load_regressor
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.effects import effect_from_text
from semiparam_ros.export.estimate import from_recording
from support.arms import ICUB_JOINTS, ICUB_OWN, as_recorded, smooth_motion


def test_a_load_that_a_slow_arm_picks_up_is_there_from_then_on():
    """What it leaves of the efforts before passed for noise, in which it had 0.16 kg and no time was likelier."""
    body, motion = RigidBody.from_urdf(ICUB_OWN.read_text(), ICUB_JOINTS, 'effort'), smooth_motion(4, 600, speed=0.1)
    load = np.array([0.8, 0.02, -0.03, 0.05, 8e-3, 0.0, 8e-3, 0.0, 0.0, 6e-3])
    samples = as_recorded(body, motion)
    samples.outputs[270:] += load_regressor(body, motion, 'r_hand')[270:] @ load
    found = from_recording(body, [effect_from_text('payload@r_hand')], samples, True, False, 'it')
    assert list(found.starts.values()) == [pytest.approx(motion.time[270])]
    np.testing.assert_allclose(found.mean[-10:-6], load[:4], atol=0.02)


@pytest.mark.parametrize('first', [150, 240])
def test_a_load_is_told_from_another_one_that_was_put_down_before(first):
    """Of a tool of 0.9 kg and the next one of 0.5 kg, the export had one of 0.62 kg since the first."""
    body, motion = RigidBody.from_urdf(ICUB_OWN.read_text(), ICUB_JOINTS, 'effort'), smooth_motion(4, 600)
    loads = np.array([0.8, 0.02, -0.03, 0.05, 8e-3, 0.0, 8e-3, 0.0, 0.0, 6e-3]), 0.4 * np.eye(10)[0]
    loads[1][[1, 4, 6, 9]] = 0.02, 3e-3, 4e-3, 4e-3
    samples = as_recorded(body, motion)
    for load, rows in zip(loads, (slice(first, 390), slice(390, None)), strict=True):
        samples.outputs[rows] += load_regressor(body, motion, 'r_hand')[rows] @ load
    found = from_recording(body, [effect_from_text('payload@r_hand')], samples, True, False, 'it')
    own = found.columns.blocks['0']
    assert found.starts[own.start] == pytest.approx(motion.time[390])
    np.testing.assert_allclose(found.mean[own][:4], loads[1][:4], atol=0.02)
    assert f'another load at r_hand until {motion.time[390]:.1f} s' in found.how
