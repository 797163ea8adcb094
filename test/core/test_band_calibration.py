"""Calibrated bands: they hold 95 % of what comes, also after the errors have changed their size."""

import numpy as np
import pytest

from semiparam_ros.core.band_calibration import BandCalibration
from semiparam_ros.errors import SemiparamError

N, STD = 4, np.array([0.5, 1.0, 2.0, 10.0])


def covered(calibration, innovations):
    """Whether each innovation (t, N) lay within its band, told before it was learnt."""
    inside = []
    for innovation in innovations:
        inside.append(np.abs(innovation) <= 1.96 * calibration.factor * STD)
        calibration.learn(innovation, STD)
    return np.array(inside)


def noise(count, seed=0):
    return STD * np.random.default_rng(seed).standard_normal((count, N))


def test_where_the_model_is_right_the_bands_stay_its_own():
    calibration = BandCalibration(N)
    assert covered(calibration, noise(4000)).mean() == pytest.approx(0.95, abs=0.006)
    np.testing.assert_allclose(calibration.factor, 1.0, atol=0.06)


@pytest.mark.parametrize('size', [0.05, 3.0, 30.0])
def test_errors_of_another_size_are_followed_within_a_few_samples(size):
    calibration = BandCalibration(N)
    covered(calibration, noise(1000))
    inside = covered(calibration, size * noise(2000, seed=1))
    assert inside[30:].mean() == pytest.approx(0.95, abs=0.015)
    np.testing.assert_allclose(calibration.factor, size, rtol=0.15)
    assert covered(calibration, noise(1000, seed=2))[60:].mean() == pytest.approx(0.95, abs=0.015)  # and back


def test_each_output_has_its_own_scale():
    calibration = BandCalibration(N)
    covered(calibration, noise(1000) * [1.0, 5.0, 1.0, 1.0])
    np.testing.assert_allclose(calibration.factor, [1.0, 5.0, 1.0, 1.0], rtol=0.15)


def test_one_spike_does_not_spoil_the_bands():
    calibration = BandCalibration(N)
    covered(calibration, noise(1000))
    calibration.learn(1e6 * STD, STD)
    assert np.isfinite(calibration.factor).all() and (calibration.factor < 4.0).all()


def test_an_output_without_noise_keeps_a_band():
    calibration = BandCalibration(N)
    covered(calibration, np.zeros((5000, N)))
    assert (calibration.factor > 0.0).all()


def test_a_restored_state_goes_on_bit_for_bit():
    one, other = BandCalibration(N), BandCalibration(N)
    covered(one, noise(100))
    other.restore(one.state())
    for calibration in (one, other):
        covered(calibration, noise(50, seed=3))
    np.testing.assert_array_equal(one.factor, other.factor)


def test_a_state_of_another_size_is_refused():
    calibration = BandCalibration(N)
    with pytest.raises(SemiparamError, match='calibration of the bands'):
        calibration.restore(BandCalibration(N + 1).state())
