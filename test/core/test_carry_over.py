"""Errors of a model that stood still for a block, and what they say of desired states."""

import numpy as np
import pytest

from semiparam_ros.core.carry_over import BLOCK_NS, BLOCKS, CHARGED_EVERY, FEWEST, CarryOver, Coefficients
from semiparam_ros.errors import SemiparamError

N, P, D, STEP = 2, 3, 4, 10**7


def models(rng):
    return [Coefficients(rng.normal(size=P), rng.normal(size=(N, count))) for count in (D, 0)]


def live(carried, rng, count, start=0):
    """(stamp, what each model left) of the samples that are charged, by hand; the first model is right up to noise."""
    frozen, left = None, []
    for index in range(start, start + count):
        columns, phi, stamp = rng.normal(size=(N, P)), rng.normal(size=D), index * STEP
        if frozen is not None:
            outputs = columns @ frozen[0].theta + frozen[0].alpha @ phi + 0.1 * rng.normal(size=N)
            if carried.next_is_due():
                carried.charge(outputs, [columns, columns], [phi, phi[:0]])
                left.append((stamp, outputs - columns @ frozen[0].theta - frozen[0].alpha @ phi,
                             outputs - columns @ frozen[1].theta))
        if carried.wants_coefficients(stamp):
            frozen = models(rng)
            carried.begin_block(stamp, frozen)
    return left


def test_a_block_has_the_mean_square_of_what_coefficients_of_its_begin_left():
    carried, rng = CarryOver(2, N), np.random.default_rng(0)
    left = live(carried, rng, 3 * BLOCK_NS // STEP + 2)
    assert len(carried.squares) == 3
    for block, squares in enumerate(carried.squares):
        own = [entry for entry in left if block * BLOCK_NS < entry[0] <= (block + 1) * BLOCK_NS]
        assert len(own) == pytest.approx(BLOCK_NS / STEP / CHARGED_EVERY, abs=1)
        for model in (0, 1):
            np.testing.assert_allclose(squares[model], np.mean([entry[1 + model]**2 for entry in own], axis=0))
    expected = carried.expected(np.full((2, N), 1e-3))
    np.testing.assert_allclose(expected, np.sqrt(np.median(carried.squares, axis=0)))
    log_weights = carried.log_weights
    np.testing.assert_array_equal(log_weights.max(axis=0), 0.0)
    ratio = np.sqrt(np.prod(carried.squares[:, 1] / carried.squares[:, 0], axis=0))
    np.testing.assert_allclose(log_weights[0] - log_weights[1], np.log(ratio))


def test_before_the_first_block_the_models_own_deviations_hold():
    carried = CarryOver(2, N)
    np.testing.assert_array_equal(carried.expected(np.full((2, N), 0.7)), 0.7)
    assert not len(carried.squares) and carried.wants_coefficients(0)


def test_a_block_that_was_interrupted_or_too_short_does_not_count():
    carried, rng = CarryOver(2, N), np.random.default_rng(0)
    live(carried, rng, BLOCK_NS // STEP - 5)
    carried.interrupt()
    live(carried, rng, CHARGED_EVERY * (FEWEST - 1), start=10**6)
    carried.begin_block(0, models(rng))
    assert not len(carried.squares)


@pytest.mark.parametrize(('period', 'moving', 'every'), [(2 * 10**8, 400, 400), (5 * 10**7, 20, 120)])
def test_a_block_of_a_slow_robot_or_of_short_motions_goes_on_until_it_counts(period, moving, every):
    """At 5 Hz, and of a robot of 20 Hz that moves for a second in six, there never was one."""
    carried, rng = CarryOver(2, N), np.random.default_rng(0)
    for index in range(400):
        if index % every < moving:
            if carried.next_is_due():
                carried.charge(*(rng.normal(size=N), [np.zeros((N, P))] * 2, [np.zeros(D), np.zeros(0)]))
            if carried.wants_coefficients(index * period):
                carried.begin_block(index * period, models(rng))
    learnt = 400 * moving / every
    assert len(carried.squares) == pytest.approx(learnt / (CHARGED_EVERY * FEWEST), abs=1.0) and len(carried.squares)


def test_the_latest_blocks_count_and_a_state_goes_on_bit_for_bit():
    carried, twin = CarryOver(2, N), CarryOver(2, N)
    live(carried, np.random.default_rng(0), (BLOCKS + 3) * BLOCK_NS // STEP + 20)
    assert len(carried.squares) == BLOCKS
    sizes = [(P, D), (P, 0)]
    twin.restore(carried.state(), sizes)
    for name, values in carried.state().items():
        np.testing.assert_array_equal(values, twin.state()[name], err_msg=name)
    for each in (carried, twin):
        live(each, np.random.default_rng(1), 2 * BLOCK_NS // STEP, start=10**7)
    np.testing.assert_array_equal(carried.squares, twin.squares)
    for spoilt in ({'blocks': np.zeros(3)}, {'sums': np.full((2, N), np.nan)}, {'theta0': np.zeros(P + 1)},
                   {'blocks': np.zeros((BLOCKS, 2, N))}):
        with pytest.raises(SemiparamError, match='left-out blocks'):
            twin.restore({**carried.state(), **spoilt}, sizes)


def test_errors_of_any_size_stay_finite():
    carried, rng = CarryOver(1, N), np.random.default_rng(0)
    carried.begin_block(0, models(rng)[:1])
    for _ in range(10):
        carried.charge(np.full(N, 1e200), [rng.normal(size=(N, P))], [rng.normal(size=D)])
    carried.begin_block(BLOCK_NS, models(rng)[:1])
    assert np.isfinite(carried.squares).all() and np.isfinite(carried.expected(np.ones((1, N)))).all()
