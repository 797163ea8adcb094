"""A square root of the covariance beside the estimates: Potter's formula, however many changes wait and wherever the
array is divided into blocks."""

import numpy as np
import pytest

from semiparam_ros.core import square_root_filter
from semiparam_ros.core.square_root_filter import SquareRootFilter
from semiparam_ros.errors import SemiparamError

D, Q, SIGMA = 12, 5, 0.3


def rows(count=40):
    """Features (count, D) and what is measured there (count, Q)."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, D)), rng.normal(size=(count, Q))


def learn(array, phi, measured):
    projection = array.project(phi)
    array.learn(projection, SIGMA, measured - projection.regressed)


@pytest.fixture(params=[1, 5, D, 10 * D], ids=lambda columns: f'{columns}-columns')
def blocks(request, monkeypatch):
    monkeypatch.setattr(square_root_filter, 'BLOCK_ELEMENTS', request.param * D)


@pytest.fixture(params=[1, 3, 8], ids=lambda number: f'{number}-wait')
def most_waiting(request, monkeypatch):
    monkeypatch.setattr(square_root_filter, 'MOST_WAITING', request.param)


@pytest.mark.usefixtures('blocks', 'most_waiting')
def test_it_holds_the_root_of_the_textbook_covariance_and_its_estimates():
    array, covariance, estimates = SquareRootFilter(D, 2.0, Q), 4.0 * np.eye(D), np.zeros((Q, D))
    for index, (phi, measured) in enumerate(zip(*rows(), strict=True)):
        projection = array.project(phi)
        assert projection.f @ projection.f == pytest.approx(phi @ covariance @ phi)
        np.testing.assert_allclose(projection.reach, covariance @ phi, atol=1e-12)
        np.testing.assert_allclose(projection.regressed, estimates @ phi, atol=1e-12)
        array.learn(projection, SIGMA, measured - projection.regressed)
        gain = covariance @ phi / (SIGMA**2 + phi @ covariance @ phi)
        estimates += np.outer(measured - estimates @ phi, gain)
        covariance -= np.outer(gain, phi @ covariance)
        np.testing.assert_allclose(array.estimates(), estimates, atol=1e-12)
        if index % 3 == 0:
            array.inflate(1.1)
            covariance *= 1.1**2


def test_an_estimate_that_was_zero_for_long_is_placed_with_its_first_innovation():
    features, measured = rows()
    measured[:, 3] = 0.0
    measured[:7, 1], measured[:17, 4] = 0.0, 0.0  # in the midst of changes that wait
    array, expected = SquareRootFilter(D, 2.0, Q), np.zeros((Q, D))
    saved = None
    for index, (phi, row) in enumerate(zip(features, measured, strict=True)):
        projection = array.project(phi)
        expected += np.outer(row - expected @ phi, projection.reach / (SIGMA**2 + projection.f @ projection.f))
        learn(array, phi, row)
        np.testing.assert_allclose(array.estimates(), expected, atol=1e-12)
        if index == 12:
            saved = array.state()
    assert saved['places'].tolist() == [0, 2, 1, -1, -1] and array.state()['places'].tolist() == [0, 2, 1, -1, 3]
    array.restore(saved)
    for phi, row in zip(features[13:], measured[13:], strict=True):
        learn(array, phi, row)
    np.testing.assert_allclose(array.estimates(), expected, atol=1e-12)


@pytest.mark.parametrize('deviation', [2.0, None])
def test_begun_anew_it_knows_nothing_of_what_waited_before(deviation):
    """Places that are given again held what estimates of before had waited with."""
    features, measured = rows()
    array = SquareRootFilter(D, 2.0, Q)
    for phi, row in zip(features[:13], measured[:13], strict=True):
        learn(array, phi, row)
    array.begin(deviation, np.zeros((Q, D)))
    measured[13:17, 1:] = 0.0
    expected = np.zeros((Q, D))
    for phi, row in zip(features[13:19], measured[13:19], strict=True):
        projection = array.project(phi)
        expected += np.outer(row - expected @ phi, projection.reach / (SIGMA**2 + projection.f @ projection.f))
        learn(array, phi, row)
        np.testing.assert_allclose(array.estimates(), expected, atol=1e-12)


@pytest.mark.parametrize('places', [[0, 1, 1, 2, 3], [0, 2, -1, -1, 3], [-2, 0, 1, 2, 3]])
def test_impossible_places_are_refused(places):
    array = SquareRootFilter(D, 1.0, Q)
    with pytest.raises(SemiparamError, match="the saved 'places'"):
        array.restore({**array.state(), 'places': np.array(places)})


def test_an_observation_that_surprises_nobody_moves_no_estimate():
    features, measured = rows()
    array = SquareRootFilter(D, 1.0, Q)
    learn(array, features[0], measured[0])
    before = array.estimates()
    array.learn(array.project(features[1]), SIGMA)
    np.testing.assert_array_equal(array.estimates(), before)


@pytest.mark.usefixtures('blocks')
@pytest.mark.parametrize('learnt', [1, 7, 8, 9])
def test_looking_changes_nothing(learnt):
    features, measured = rows()
    looked_at, left_alone = SquareRootFilter(D, 1.0, Q), SquareRootFilter(D, 1.0, Q)
    for array in (looked_at, left_alone):
        for phi, values in zip(features[:learnt], measured[:learnt], strict=True):
            learn(array, phi, values)
            if array is looked_at:
                array.project(features[-1])
                array.state()
                array.estimates()
    for one, other in zip(looked_at.project(features[-2]), left_alone.project(features[-2]), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize('learnt', [0, 5, 8, 13])
def test_a_restored_state_goes_on_bit_for_bit(learnt):
    features, measured = rows()
    one, other = SquareRootFilter(D, 1.0, Q), SquareRootFilter(D, 7.0, Q)
    learn(other, features[0], measured[0])
    for phi, values in zip(features[:learnt], measured[:learnt], strict=True):
        learn(one, phi, values)
        one.inflate(1.01)
    other.restore(one.state())
    for phi, values in zip(features[learnt:], measured[learnt:], strict=True):
        for array in (one, other):
            learn(array, phi, values)
    for name, value in one.state().items():
        np.testing.assert_array_equal(value, other.state()[name])


@pytest.mark.parametrize('waiting', [-1, 8, 0.5])
def test_a_state_with_an_impossible_number_of_changes_is_refused(waiting):
    array = SquareRootFilter(D, 1.0, Q)
    before = array.state()
    with pytest.raises(SemiparamError, match='waiting'):
        array.restore({**before, 'array': before['array'] + 1.0, 'waiting': np.array(waiting)})
    np.testing.assert_array_equal(array.state()['array'], before['array'])


def test_growing_for_long_stays_finite():
    array = SquareRootFilter(D, 1.0)
    for phi in np.tile(rows()[0], (500, 1)):
        array.learn(array.project(phi), SIGMA)
        array.inflate(1.05)
    state = array.state()
    assert np.isfinite(state['array']).all()
    assert state['inflation'] <= square_root_filter.RENORMALISE_ABOVE
