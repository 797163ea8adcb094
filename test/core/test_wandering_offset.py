"""The wandering offset: followed where there is one, and left alone where there is none."""

import numpy as np
import pytest

from semiparam_ros.core.wandering_offset import WanderingOffset
from semiparam_ros.errors import SemiparamError

N = 3
STD = np.array([0.1, 1.0, 5.0])


def followed(residuals, offset=None):
    """What remains of residuals (t, N) that are predicted, then learnt."""
    offset = offset or WanderingOffset(N)
    left = []
    for residual in residuals:
        left.append(residual - offset.offset)
        offset.learn(residual, STD)
    return np.array(left)


def noise(count, seed=0):
    return STD * np.random.default_rng(seed).standard_normal((count, N))


@pytest.mark.parametrize('seed', range(3))
def test_of_white_noise_nothing_is_followed(seed):
    residuals = noise(6000, seed)
    ratio = np.mean(followed(residuals)**2, axis=0) / np.mean(residuals**2, axis=0)
    assert (ratio < 1.003).all()


def test_an_offset_that_wanders_is_followed_at_its_pace():
    steps = np.array([0.0, 0.01, 0.1])  # of each output's noise
    wander = np.cumsum(steps * noise(6000, seed=1), axis=0)
    offset = WanderingOffset(N)
    left = followed(wander + noise(6000, seed=2), offset)[1000:]
    excess = np.mean(left**2, axis=0) / STD**2
    assert (excess < [1.05, 1.06, 1.25]).all()  # of the best filter: 1.00, 1.01, 1.11
    pace = offset.pace()
    assert pace[0] < 0.003 < pace[1] < 0.05 < pace[2]


def test_a_spike_hardly_moves_it():
    offset = WanderingOffset(N)
    followed(noise(1000), offset)
    before = offset.offset
    offset.learn(1e9 * STD, STD)
    assert (np.abs(offset.offset - before) < 0.6 * STD).all()


def test_while_nothing_is_learnt_it_returns_to_zero():
    offset = WanderingOffset(N)
    followed(3.0 * STD + noise(300), offset)
    assert (np.abs(offset.offset - 3.0 * STD) < STD).all()
    sizes = [np.abs(offset.offset)]
    for _ in range(5000):
        offset.rest()
        sizes.append(np.abs(offset.offset))
    assert (np.diff(sizes, axis=0) <= 0.0).all() and (sizes[-1] < sizes[0]).all()


def test_the_parts_make_the_offset():
    offset = WanderingOffset(N)
    followed(STD + noise(50), offset)
    np.testing.assert_allclose(offset.parts.sum(axis=0), offset.offset)


def test_a_restored_state_goes_on_bit_for_bit():
    one, other = WanderingOffset(N), WanderingOffset(N)
    followed(STD + noise(100), one)
    other.restore(one.state())
    np.testing.assert_array_equal(*(followed(noise(50, seed=3), offset) for offset in (one, other)))


def test_a_state_of_another_size_is_refused():
    with pytest.raises(SemiparamError, match='wandering offset'):
        WanderingOffset(N).restore(WanderingOffset(N + 1).state())
