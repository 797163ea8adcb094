"""Hyperparameters found again in data drawn from the model, whatever the start, the method or the class."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from semiparam_ros.core.hyperparameters.autocorrelation import integrated_autocorrelation_time
from semiparam_ros.core.hyperparameters.estimation import estimate, plain_least_squares
from semiparam_ros.core.hyperparameters.feature_count import FEW_NAT, fewest_features
from semiparam_ros.core.hyperparameters.marginal_likelihood import Window, evidence, harmonics
from semiparam_ros.core.hyperparameters.maximisation import (
    Maximum,
    _distinct,
    maximise,
    maximise_evidence,
    maximise_from,
)
from semiparam_ros.core.hyperparameters.validation import Grid, select_by_validation
from semiparam_ros.core.hyperparameters.window import check_window, input_groups
from semiparam_ros.core.variants import VARIANTS
from semiparam_ros.errors import SemiparamError

THETA = np.array([1.0, -2.0, 0.5])
STEPS, FREQUENCIES = 300, 40


class Draw:
    """A window of a moving robot: smooth inputs, three coupled columns, a smooth unmodelled part, noise."""

    def __init__(self, seed=0, sigma=(0.1, 0.1), drift=0.0, tau=1.5, rho=0.5, steps=STEPS):
        rng = np.random.default_rng(seed)
        time = np.arange(steps)[:, None]
        waves = [np.sin(2 * np.pi * time / period + phase) for period, phase in
                 zip(rng.uniform(15, 90, (3, 6)), rng.uniform(0, 6, (3, 6)), strict=True)]
        self.inputs = sum(waves) / np.std(sum(waves), axis=0)
        self.coupled = np.stack([self.inputs[:, [0, 3]], self.inputs[:, [1, 4]], np.ones((steps, 2))], axis=2)
        self.spectrum = rng.normal(size=(FREQUENCIES, 6))
        smooth = harmonics(self.inputs / tau @ self.spectrum.T)
        self.noise = np.array(sigma) * rng.normal(size=(steps, 2))
        slow = np.zeros((steps, 2))
        for step in range(1, steps):
            slow[step] = 0.97 * slow[step - 1] + drift * np.sqrt(1 - 0.97**2) * rng.normal(size=2)
        self.outputs = self.coupled @ THETA + rho * smooth @ rng.normal(size=(2 * FREQUENCIES, 2)) + self.noise + slow

    def window(self, length_scales='one'):
        groups = input_groups(length_scales, 6)
        return Window(self.outputs, self.coupled, self.inputs, self.spectrum, groups, np.ones(3))

    def estimate(self, variant, **options):
        return estimate(variant, self.outputs, self.coupled, self.inputs, self.spectrum, **options)


@pytest.fixture(scope='module')
def draw():
    return Draw()


def slow_noise(rng, steps, memory):
    """(steps,) of standard deviation one, alike over ``memory`` steps."""
    white, decay = rng.standard_normal(steps), np.exp(-1.0 / memory)
    return lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], white)


@pytest.mark.parametrize('alike', [5.0, 50.0])
def test_slow_noise_tells_as_much_as_so_many_samples_of_white_noise(alike):
    """The variance of least squares under it is so many times that under white noise."""
    rng, steps, memory = np.random.default_rng(1), 2000, 30.0
    columns = np.array([slow_noise(rng, steps, alike) for _ in range(20)])
    noises = np.array([slow_noise(rng, steps, memory) for _ in range(200)])
    times = np.mean((columns @ noises.T) ** 2) / np.mean(np.sum(columns**2, axis=1))
    columns = columns.T[:, None, :]
    assert integrated_autocorrelation_time(columns, 1e9, memory) == pytest.approx(times, rel=0.15)
    assert integrated_autocorrelation_time(columns, 0.0, memory) == 1.0


@pytest.mark.parametrize(('memory', 'true', 'counts'), [(40.0, 0.1, True), (40.0, 0.3, True), (None, 0.1, False),
                                                        (40.0, 30.0, False)])
def test_noise_that_is_alike_for_long_is_learnt_as_fewer_samples(memory, true, counts):
    """Also where left-out parts do not tell. But where the prior is far off samples count whole, and so they do under
    white noise."""
    rng, steps, n = np.random.default_rng(2), 600, 3
    time = np.arange(steps)[:, None] / rng.uniform(80.0, 400.0, n * 4)
    coupled = np.sin(2.0 * np.pi * time).reshape(steps, n, 4) + 0.02 * rng.standard_normal((steps, n, 4))
    noise = rng.standard_normal((steps, n)) if memory is None else np.column_stack(
        [slow_noise(rng, steps, memory) for _ in range(n)])
    outputs = coupled @ (true * rng.standard_normal(4)) + noise
    inputs = rng.standard_normal((steps, 6))
    found = estimate('P', outputs, coupled, inputs, np.zeros((0, 6)), physical=True, prior_scale=np.full(4, 0.3))
    assert (found.autocorrelation_time > 5.0) == counts


@pytest.mark.parametrize('variant', VARIANTS)
def test_a_class_has_what_its_terms_need_and_no_more(draw, variant):
    found = draw.estimate(variant, length_scales='kind', noise='output', starts=2)
    kind = VARIANTS[variant]
    assert (found.gamma > 0) == (kind.pi == 'learnt')
    assert (found.rho > 0) == kind.features
    assert len(found.tau) == (3 if kind.features else 0)
    assert (found.pi is not None) == (kind.pi == 'fixed')
    assert np.prod(found.output_scale) == pytest.approx(1.0)
    assert found.sigma > 0


@pytest.mark.parametrize('variant', ['SPK-ML', 'SP-ML', 'SP2-ML'])
def test_the_truth_is_found_again(draw, variant):
    found = draw.estimate(variant)
    assert found.sigma == pytest.approx(0.1, rel=0.15)
    assert found.tau[0] == pytest.approx(1.5, rel=0.35)


def test_pi_of_sp_is_the_truth_and_that_of_sp2_is_near_least_squares_by_its_prior(draw):
    assert draw.estimate('SP-ML').pi == pytest.approx(THETA, abs=0.3)
    rows = draw.coupled.reshape(-1, 3)
    expected = np.linalg.lstsq(rows, draw.outputs.ravel(), rcond=None)[0]
    for physical in (True, False):
        assert draw.estimate('SP2-ML', physical=physical).pi == pytest.approx(expected, abs=0.05)
    assert plain_least_squares(draw.outputs, draw.coupled, 'one') == pytest.approx(expected)


def test_what_the_window_hardly_shows_stays_within_the_papers_prior():
    """Coefficients of 1e3 fitted a quarter second of an arm, which then predicted -20 kN m for 7."""
    short = Draw(steps=24)
    alike = short.coupled[:, :, :1] + 1e-4 * short.inputs[:, [2, 5], None]
    short.coupled = np.concatenate([short.coupled, alike], axis=2)
    assert np.abs(plain_least_squares(short.outputs, short.coupled, 'one')).max() > 100.0
    assert np.abs(short.estimate('SP2-ML').pi).max() < 5.0


def wide(tau):
    """A window of a function that is rougher for smaller tau, with features of another seed than its own."""
    draw = Draw(tau=tau, sigma=(0.02, 0.02))
    return replace(draw.window(), spectrum=np.random.default_rng(5).standard_normal((150, 6)))


def test_a_rougher_function_gets_more_features():
    smooth, rough = (estimate('SPK-ML', window.outputs, window.coupled, window.inputs, window.spectrum, fewest=True,
                              starts=1).features for window in map(wide, (8.0, 1.5)))
    assert 50 <= smooth < rough <= 300


@pytest.mark.parametrize('tau', [3.0, 8.0])
def test_validation_takes_the_fewest_features_that_are_hardly_worse(tau):
    window, grid = replace(wide(tau), coupled=np.zeros((STEPS, 2, 0)), prior_scale=np.zeros(0)), Grid((2.0, 8.0))
    many, few = (select_by_validation(window, False, 'one', grid, fewest=fewest) for fewest in (False, True))
    assert few.score <= 1.01 * many.score and few.features <= many.features == 300
    for count in (50, 100, 200):
        less = replace(window, spectrum=window.spectrum[:count // 2])
        score = select_by_validation(less, False, 'one', replace(grid, tau=many.tau)).score
        assert count >= few.features or score > 1.01 * many.score


def test_as_few_features_as_are_enough_lose_no_evidence_to_speak_of():
    window = wide(8.0)
    many = maximise_evidence(window, 'one', False, 'quasi-newton', 1, 1)
    few, found = fewest_features(window, many, 'one', False, 'quasi-newton')
    assert 25 < len(few.spectrum) < 150 and np.array_equal(few.spectrum, window.spectrum[:len(few.spectrum)])
    least = many.value - FEW_NAT
    assert found.value >= least
    assert found.value == pytest.approx(evidence(few, found.at, gradient=False).value)
    less = replace(window, spectrum=window.spectrum[:25])
    assert maximise_from(less, many.at, 'one', False, 'quasi-newton').value < least


def test_no_features_are_rougher_than_they_can_show_with_physical_priors():
    """Friction of a joint that turns back was taken for a function too rough to hold elsewhere."""
    draw = Draw(tau=0.6, rho=1.0)
    free, held = (draw.estimate('SPK-ML', physical=physical, starts=1) for physical in (False, True))
    alike = np.exp(-6.0 / np.array([free.tau[0], held.tau[0]]) ** 2)
    assert alike[0] < (2 * FREQUENCIES) ** -0.5 <= 1.000001 * alike[1]


def test_each_output_has_its_own_noise():
    found = Draw(sigma=(0.02, 0.3)).estimate('SPK-ML', noise='output')
    assert found.sigma * np.array(found.output_scale) == pytest.approx([0.02, 0.3], rel=0.4)


def test_a_drift_is_told_from_the_features():
    """Taken for white, it would shorten the length scale: the next recording repeats no drift."""
    drifting = Draw(drift=0.3, tau=4.0)
    allowed, white = drifting.estimate('SPK-ML'), drifting.estimate('SPK-ML', drifting=False)
    assert allowed.drift_share > 0.7
    assert allowed.tau[0] == pytest.approx(4.0, rel=0.3)
    assert white.tau[0] < 2.5
    assert Draw().estimate('SPK-ML').drift_share < 0.2


@pytest.mark.parametrize('variant', ['NP-ML', 'SP-ML', 'SPK-ML'])
def test_the_result_does_not_depend_on_how_many_starts(draw, variant):
    results = [draw.estimate(variant, length_scales='kind', noise='output', starts=starts) for starts in (1, 3, 6)]
    for other in results[1:]:
        assert other.sigma == pytest.approx(results[0].sigma, rel=1e-2)
        assert other.tau == pytest.approx(results[0].tau, rel=5e-2)


def test_nelder_mead_agrees_with_the_gradient(draw):
    values = [maximise_evidence(draw.window(), 'one', False, method, 2, 1).value
              for method in ('quasi-newton', 'nelder-mead')]
    assert values[1] == pytest.approx(values[0], abs=0.1)


def test_threads_change_nothing(draw):
    assert draw.estimate('SPK-ML', jobs=2) == draw.estimate('SPK-ML', jobs=1)


def test_every_start_of_a_hilly_function_is_searched():
    """Two hills: the search must end on the higher one although the first start leads to the lower."""
    def hills(point, gradient):
        x = point[0]
        lower, higher = np.exp(-(x + 2) ** 2), 2 * np.exp(-(x - 2) ** 2)
        return lower + higher, np.array([-2 * (x + 2) * lower - 2 * (x - 2) * higher])

    bounds = np.array([[-5.0, 5.0]])
    ends = maximise(hills, [np.array([-2.5]), np.array([2.5])], bounds)
    assert [round(float(end.point[0])) for end in ends] == [2, -2]


def test_a_validation_grid_finds_its_best_point(draw):
    seen = []
    found = draw.estimate('SP2-VS', grid=Grid(tau=(0.2, 2.0, 20.0)), progress=lambda *count: seen.append(count))
    assert found.tau == (2.0,)
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_a_validation_grid_has_a_length_scale_for_each_kind_at_most(draw):
    tau = draw.estimate('NP-VS', length_scales='input', grid=Grid(tau=(1.0, 4.0))).tau
    assert len(tau) == 6
    assert tau[0::2] == tau[1::2]


@pytest.mark.parametrize(('options', 'sentence'), [
    ({'tau': (1.0,), 'ratio': (0.1,)}, 'one point'), ({'tau': (0.0, 1.0)}, 'expected positive finite values'),
    ({'fitting_share': 1.0}, 'would fit')])
def test_a_senseless_grid_is_refused(options, sentence):
    with pytest.raises(SemiparamError, match=sentence):
        Grid(**options)


def test_windows_that_tell_nothing_are_refused(draw):
    with pytest.raises(SemiparamError, match='10 samples'):
        estimate('P', draw.outputs[:10], draw.coupled[:10], draw.inputs[:10], draw.spectrum)
    constant = draw.outputs.copy()
    constant[:, 1] = 3.0
    with pytest.raises(SemiparamError, match=r'output 1 .* constant'):
        estimate('P', constant, draw.coupled, draw.inputs, draw.spectrum)
    with pytest.raises(SemiparamError, match='not finite'):
        estimate('P', np.where(draw.outputs > 0, np.nan, 0.0), draw.coupled, draw.inputs, draw.spectrum)
    with pytest.raises(SemiparamError, match='one of each for a sample'):
        estimate('P', draw.outputs, draw.coupled[1:], draw.inputs, draw.spectrum)


@pytest.mark.parametrize(('options', 'sentence'), [
    ({'variant': 'SPX'}, "variant 'SPX' is unknown"),
    ({'variant': 'P', 'method': 'annealing'}, "optimiser 'annealing'"),
    ({'variant': 'P', 'length_scales': 'two'}, "length scales 'two'")])
def test_unknown_choices_are_refused(draw, options, sentence):
    with pytest.raises(SemiparamError, match=sentence):
        draw.estimate(**options)


def test_ends_on_one_flat_top_are_polished_once():
    """Far apart in a direction that the window does not tell, and equally good; another basin is polished too."""
    best, flat, other = (Maximum(np.array([place]), value)
                         for place, value in ((0.0, 99.9), (4.0, 99.8), (9.0, 97.0)))
    assert _distinct([best, flat]) == [best]
    assert _distinct([best, flat, other]) == [best, other]


def test_outputs_whose_squares_are_nothing_are_constant():
    """The estimate went on with a variance of 0, and ended with deviations of 0."""
    outputs = np.random.default_rng(0).standard_normal((200, 2))
    check_window(outputs, outputs, outputs)
    with pytest.raises(SemiparamError, match=r'output 0, 1 \(counted from 0\) is constant'):
        check_window(1e-300 * outputs, outputs, outputs)
