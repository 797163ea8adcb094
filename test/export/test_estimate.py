"""Estimates of a recording: when a load appears."""

import numpy as np
import pytest

from semiparam_ros.core.robot.frames import load_regressor
from semiparam_ros.effects import effect_from_text
from semiparam_ros.export.estimate import from_recording
from support.arms import as_recorded, icub, smooth_motion


def test_a_load_that_a_slow_arm_picks_up_is_there_from_then_on():
    """What it leaves of the efforts before passed for noise, in which it had 0.16 kg and no time was likelier."""
    body, motion = icub('effort'), smooth_motion(4, 600, speed=0.1)
    load = np.array([0.8, 0.02, -0.03, 0.05, 8e-3, 0.0, 8e-3, 0.0, 0.0, 6e-3])
    samples = as_recorded(body, motion)
    samples.outputs[270:] += load_regressor(body, motion, 'r_hand')[270:] @ load
    found = from_recording(body, [effect_from_text('payload@r_hand')], samples, True, False, 'it')
    assert list(found.starts.values()) == [pytest.approx(motion.time[270])]
    np.testing.assert_allclose(found.mean[-10:-6], load[:4], atol=0.02)


@pytest.mark.parametrize('ends', [(150, 390), (240, 390), (0, 300), (120, 270, 420)])
def test_a_load_is_told_from_others_that_were_put_down_before(ends):
    """Of a tool of 0.9 kg and the next one of 0.5 kg, the export had one of 0.62 kg since the first."""
    body, motion = icub('effort'), smooth_motion(4, 600)
    samples, keep = as_recorded(body, motion), ends[0] == 0  # from the first sample on it is told by known links alone
    samples.outputs[:] /= 1.15 if keep else 1.0
    for number, (first, last) in enumerate(zip(ends, (*ends[1:], 600), strict=True)):
        mass = (0.8, 0.4, 0.6)[number]
        load = mass * np.array([1.0, 0.02, -0.03 * number, 0.05, 0.01, 0.0, 0.01, 0.0, 0.0, 0.01])
        samples.outputs[first:last] += load_regressor(body, motion, 'r_hand')[first:last] @ load
    effects = [effect_from_text('payload@r_hand')]
    found = from_recording(body, effects, samples, True, keep, 'it')
    own, end_s = found.columns.blocks['0'], motion.time[ends[-1]]
    assert found.starts[own.start] == pytest.approx(end_s)
    np.testing.assert_allclose(found.mean[own][:4], load[:4], atol=0.02)
    assert found.how.count('another load at r_hand until') == len(ends) - 1 and f'until {end_s:.1f} s' in found.how
