"""How unlike a state is what was learnt, taken together."""

import numpy as np
import pytest

from semiparam_ros.core.learnt_inputs import ROOM, LearntInputs
from semiparam_ros.core.random_features import RandomFeatures
from semiparam_ros.core.samples import Sample
from semiparam_ros.errors import SemiparamError

M = 6


def together(rng, count):
    """Inputs that move along one line."""
    return rng.uniform(-1.0, 1.0, (count, 1)) * np.arange(1.0, M + 1.0) + 0.01 * rng.standard_normal((count, M))


def as_sample(x):
    """Whose inputs are x (m,)."""
    nothing = np.zeros(0)
    return Sample(0, x, nothing, nothing, nothing)


def test_a_state_within_every_range_may_be_far_from_what_was_learnt():
    rng, learnt = np.random.default_rng(0), LearntInputs(M)
    for x in together(rng, 2000):
        learnt.add(as_sample(x))
    seen = [learnt.distance(x) for x in together(rng, 500)]
    assert np.mean(np.array(seen) <= 1.0) > 0.98
    assert learnt.distance(0.5 * np.arange(1.0, M + 1.0) * (1, -1, 1, -1, 1, -1)) > 3.0


def test_features_know_what_is_near_and_nothing_far_from_what_was_learnt():
    rng, learnt = np.random.default_rng(0), LearntInputs(M)
    features = RandomFeatures(M, 20, 0, (2.0,), np.zeros(M), np.ones(M))
    assert learnt.known(np.zeros(M), features, 0.1) == 0.0
    inputs = 0.3 * rng.standard_normal((3 * ROOM, M))
    for x in inputs:
        learnt.add(as_sample(x))
    kept = learnt.state()['kept'][:-(len(learnt.state()['kept']) % 64) or None]
    covariance = features.kernel(kept, kept) + 0.1 / 4 * np.eye(len(kept))  # each stands for four
    state = 0.5 * np.ones(M)
    among = features.kernel(state[None], kept)[0]
    assert learnt.known(state, features, 0.1) == pytest.approx(among @ np.linalg.solve(covariance, among), rel=1e-4)
    assert learnt.known(inputs[7], features, 0.1) > 0.95 > 1e-3 > learnt.known(8.0 * np.ones(M), features, 0.1)


@pytest.mark.parametrize('count', [1, 5, ROOM, ROOM + 1, 10 * ROOM + 7])
def test_what_is_kept_is_spread_over_all_that_was_learnt(count):
    learnt = LearntInputs(1)
    for index in range(count):
        learnt.add(as_sample(np.array([float(index)])))
    kept = learnt.state()['kept'].ravel()
    steps = np.diff(kept)
    assert len(kept) <= ROOM and (not len(steps) or (np.ptp(steps) == 0.0 and steps[0] > 0.0))
    assert count < 2 or kept[-1] > 0.9 * (count - 1) - 1.0
    assert count < ROOM or len(kept) >= ROOM // 2


def test_nothing_learnt_is_infinitely_far_and_one_input_is_no_fault():
    learnt = LearntInputs(M)
    assert learnt.distance(np.zeros(M)) == np.inf
    learnt.add(as_sample(np.zeros(M)))
    assert np.isfinite(learnt.distance(np.ones(M))) and learnt.distance(np.zeros(M)) == 0.0


def test_a_state_goes_on_bit_for_bit_and_another_one_is_refused():
    rng, learnt, twin = np.random.default_rng(0), LearntInputs(M), LearntInputs(M)
    for x in together(rng, 3 * ROOM + 5):
        learnt.add(as_sample(x))
    twin.restore(learnt.state())
    later = together(rng, ROOM)
    for x in later:
        learnt.add(as_sample(x))
        twin.add(as_sample(x))
        assert learnt.distance(later[0]) == twin.distance(later[0])
    for spoilt in ({'kept': np.zeros((3, M + 1))}, {'kept': np.full((3, M), np.nan)}, {'counts': np.array([0, 5])}):
        with pytest.raises(SemiparamError, match='saved inputs'):
            twin.restore({**learnt.state(), **spoilt})
