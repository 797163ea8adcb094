"""The square root of the covariance: Potter's formula, whatever the width of the blocks it is worked through in."""

import numpy as np
import pytest

from semiparam_ros.core import square_root
from semiparam_ros.core.square_root import SquareRoot

D, SIGMA = 12, 0.3


def directions(count=40):
    return np.random.default_rng(0).normal(size=(count, D))


@pytest.fixture(params=[1, 5, D, 10 * D], ids=lambda columns: f'{columns}-columns')
def blocks(request, monkeypatch):
    monkeypatch.setattr(square_root, 'BLOCK_ELEMENTS', request.param * D)


@pytest.mark.usefixtures('blocks')
def test_it_is_the_root_of_the_textbook_covariance():
    root, covariance = SquareRoot(D, 2.0), 4.0 * np.eye(D)
    for index, phi in enumerate(directions()):
        f, reach = root.project(phi)
        assert f @ f == pytest.approx(phi @ covariance @ phi)
        np.testing.assert_allclose(reach, covariance @ phi, atol=1e-12)
        root.shrink(f, reach, SIGMA)
        covariance -= np.outer(covariance @ phi, covariance @ phi) / (SIGMA**2 + phi @ covariance @ phi)
        if index % 3 == 0:
            root.inflate(1.1)
            covariance *= 1.1**2


@pytest.mark.usefixtures('blocks')
def test_projecting_changes_nothing():
    root = SquareRoot(D, 1.0)
    root.shrink(*root.project(directions()[0]), SIGMA)
    first = root.project(directions()[1])
    for _ in range(3):
        root.project(directions()[2])
    for one, other in zip(first, root.project(directions()[1]), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.usefixtures('blocks')
def test_looking_at_the_state_between_two_samples_changes_no_bit():
    looked_at, left_alone = SquareRoot(D, 1.0), SquareRoot(D, 1.0)
    for phi in directions():
        for root in (looked_at, left_alone):
            root.shrink(*root.project(phi), SIGMA)
        looked_at.state()
    for name, value in looked_at.state().items():
        np.testing.assert_array_equal(value, left_alone.state()[name])


def test_growing_for_long_stays_finite():
    root = SquareRoot(D, 1.0)
    for phi in np.tile(directions(), (500, 1)):
        root.shrink(*root.project(phi), SIGMA)
        root.inflate(1.05)
    state = root.state()
    assert np.isfinite(state['root']).all()
    assert state['inflation'] <= square_root.RENORMALISE_ABOVE


def test_a_restored_state_forgets_the_update_that_waits():
    root = SquareRoot(D, 1.0)
    fresh = root.state()
    root.shrink(*root.project(directions()[0]), SIGMA)
    root.restore(fresh)
    np.testing.assert_array_equal(root.project(directions()[1])[0], directions()[1])
