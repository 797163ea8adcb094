"""The score of a model: what it is, what it costs an effect, and what no sum of samples makes up for."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.diagnosis.config import DEFAULTS
from semiparam_ros.diagnosis.regression import fit_model, refit_weights, with_effects
from semiparam_ros.diagnosis.search import moves
from semiparam_ros.diagnosis.search.plausibility import price
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.revision import pruned
from semiparam_ros.diagnosis.search.score import (
    BlockGrams,
    ChannelGrams,
    block_grams,
    columns_of_effects,
    gain,
    repetition,
    summed,
    unlikely,
    worth,
)
from semiparam_ros.diagnosis.search.scoring import Trial, worth_refining
from semiparam_ros.diagnosis.search.stepwise import starting_fit
from semiparam_ros.effects import kinds
from semiparam_ros.effects.base import Span
from support.arms import ODD_BODY, ODD_JOINTS, noisy, smooth_motion

BODY = ODD_BODY
COUNT = 1200
KINDS = kinds('effort')


def moving(seed=0, noise=0.01):
    motion = smooth_motion(4, COUNT, seed=seed, speed=0.5)
    return replace(motion, outputs=noisy(BODY.regressors(motion) @ BODY.base_parameters, noise, seed))


def fitted(samples, effects=()):
    return declare(starting_fit(BODY, samples, [], np.ones(COUNT, dtype=bool)), list(effects))


def grams(columns, outputs, prior, blocks):
    """Of columns (n, B, m, p) and outputs (n, B, m)."""
    channels = [ChannelGrams(np.arange(len(prior)), np.swapaxes(own, 1, 2) @ own,
                             np.einsum('bmp,bm->bp', own, left)) for own, left in zip(columns, outputs, strict=True)]
    counts = np.full((blocks, len(outputs)), float(outputs.shape[2]))
    return BlockGrams(prior, channels, np.sum(outputs**2, axis=2).T, counts)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 2), st.integers(2, 4), st.integers(1, 5))
def test_a_density_is_that_of_the_block_given_all_the_others(seed, n, blocks, p):
    rng = np.random.default_rng(seed)
    columns, outputs = rng.standard_normal((n, blocks, 6, p)), 3.0 * rng.standard_normal((n, blocks, 6))
    prior, scale = rng.uniform(0.1, 3.0, p), rng.uniform(0.3, 2.0, n)
    table, values = (np.swapaxes(each, 0, 1).reshape(blocks, n * 6, -1) for each in (columns, outputs))
    noise = np.repeat(scale**2, 6)

    def logarithm(chosen):
        rows, left = np.concatenate(table[chosen]), np.concatenate(values[chosen])[:, 0]
        spread = (rows * prior**2) @ rows.T + np.diag(np.tile(noise, len(chosen)))
        return multivariate_normal(np.zeros(len(left)), spread).logpdf(left)

    whole = list(range(blocks))
    wanted = [logarithm(whole) - logarithm([each for each in whole if each != block]) for block in whole]
    known = grams(columns, outputs, prior, blocks)
    np.testing.assert_allclose(known.densities(scale, np.ones(n)), wanted, rtol=1e-7, atol=1e-7)
    kept = np.arange(p // 2, p)
    fewer = grams(columns[..., kept], outputs, prior[kept], blocks)
    np.testing.assert_allclose(known.densities(scale, np.ones(n), kept), fewer.densities(scale, np.ones(n)),
                               rtol=1e-9, atol=1e-9)


def test_columns_that_repeat_each_other_without_noise_are_fitted_all_the_same():
    """Squares of 1e14 hold no digits of the prior's: their factor was singular."""
    rng = np.random.default_rng(0)
    columns = 1e6 * rng.standard_normal((24, 50, 10)) @ rng.standard_normal((10, 40))
    known = grams(columns[None], (columns @ np.ones(40))[None], np.full(40, 3.0), 24)
    fitted_scale = known.scale_with(np.arange(20), np.ones(1))
    assert 0.0 < fitted_scale[0] < 1e-5 * columns.std()
    assert np.isfinite(known.densities(np.ones(1), np.ones(1), np.arange(20))).all()


def test_the_grams_of_a_model_are_those_of_its_columns():
    fit = fitted(moving(), [KINDS['viscous_friction']('turn'), KINDS['joint_offset']('grip', {'offset': 0.0})])
    edges, found = fit.samples_in_use.edges, block_grams(fit)
    assert len(found.prior) == fit.n_columns + 1 and found.counts.sum() == 4 * COUNT
    assert len(edges) + 1 == fit.config.blocks and np.ptp(np.diff(edges)) <= 1
    np.testing.assert_allclose(found.power.sum(axis=0), np.sum(
        (fit.at_prior + fit.effects[1].value('offset') * offset_columns(fit)) ** 2, axis=0))
    kept = np.arange(fit.n_columns)
    assert found.scale_with(kept, fit.scale) == pytest.approx(fit.scale, rel=0.05)


def test_products_of_parts_are_those_of_the_columns_in_each_block_and_channel():
    """Parts remember them; here a model made of another one's, where outputs of one joint count from later on."""
    samples, counted, use = moving(), np.ones((COUNT, 4), dtype=bool), np.arange(COUNT) % 300 < 250
    counted[:500, 1] = counted[::3, 2] = False
    known, new = KINDS['viscous_friction']('turn'), KINDS['payload']('tool', span=Span(start_s=20.0))
    fit = with_effects(fit_model(BODY, samples, [known], use, np.ones(4), counted=counted), [new, known])
    for each in (fit, with_effects(fit, [known, new])):
        same_products(each, samples, use, counted)


def same_products(fit, samples, use, counted):
    columns, edges = fit.assembly.batch(samples)[0], [0, *fit.samples_in_use.edges, COUNT]
    found = block_grams(fit)
    for channel, each in enumerate(found.channels):
        for block, (start, end) in enumerate(pairwise(edges)):
            rows = np.arange(start, end)[(use & counted[:, channel])[start:end]]
            own, left = columns[rows, channel], fit.at_prior[rows, channel]
            np.testing.assert_allclose(each.gram[block], (own.T @ own)[np.ix_(each.acting, each.acting)], atol=1e-9)
            np.testing.assert_allclose(each.moment[block], (own.T @ left)[each.acting], atol=1e-9)
            assert found.counts[block, channel] == len(rows)
            assert found.power[block, channel] == pytest.approx(left @ left)
        whole = columns[use & counted[:, channel], channel][:, each.acting]
        np.testing.assert_array_equal(fit.design.rows[channel], whole)
        np.testing.assert_allclose(fit.design.grams[channel], whole.T @ whole, rtol=1e-9, atol=1e-9)


def offset_columns(fit):
    from semiparam_ros.diagnosis.search.candidates import added_columns

    return added_columns(fit, fit.effects[1])[:, :, 0]


def test_an_effect_that_is_there_gains_and_one_that_is_not_costs():
    samples = moving()
    rubbing = replace(samples, outputs=samples.outputs + 0.3 * samples.velocity)
    true, other = KINDS['viscous_friction']('turn'), KINDS['rotor_inertia']('grip')
    fit = fitted(rubbing)
    gained, nothing = (gain(fit, fitted(rubbing, [effect])) for effect in (true, other))
    assert gained.total > 100.0 > 10.0 * gained.error and nothing.total < 5.0
    both = fitted(rubbing, [true, other])
    first, second = worth(both)
    assert first.total > 100.0 and second.total < 5.0
    assert [effect.kind for effect in pruned(both).effects] == ['viscous_friction']


def test_a_point_of_application_costs_what_its_coordinates_tell():
    """They cost nothing: a force with a point of its own was told of a load, which pays for its centre."""
    at_origin, elsewhere = (KINDS['external_force']('finger', point) for point in ({}, {'x': 1e-3, 'y': 0.0, 'z': 0.0}))
    samples = moving()
    pushed = replace(samples, outputs=samples.outputs + at_origin.columns(BODY, samples, None)[0] @ [0.3, 0.0, -0.4])
    plain, free = fitted(pushed, [at_origin]), fitted(pushed, [elsewhere])
    assert len(columns_of_effects(free)[0]) == 6 and len(columns_of_effects(plain)[0]) == 3
    assert gain(plain, free).total < -1.0
    np.testing.assert_allclose(worth(free)[0].total, gain(fitted(pushed), free).total, rtol=0.5)


def test_only_losses_speak_against_a_gain():
    few = summed(np.array([50.0, 40.0, *[0.0] * 10]))
    assert few == (90.0, 0.0)
    chance = np.random.default_rng(0).standard_normal(10_000)
    assert summed(chance).error == pytest.approx(np.sqrt(10_000), rel=0.05)


def test_evidence_does_not_grow_without_limit():
    fit = fitted(moving())
    long = replace(fit, config=replace(fit.config, coarseness=100.0))
    independent = float((fit.counts / fit.correlation).sum())
    assert repetition(fit) == pytest.approx(fit.correlation * (1.0 + independent / 1e4))
    assert float((fit.counts / repetition(long)).sum()) < 100.0


def test_a_kind_that_is_elsewhere_costs_less_and_a_start_more():
    fit = fitted(moving()[:COUNT])
    friction = [KINDS['viscous_friction'](joint) for joint in ODD_JOINTS]
    costs = [price(friction[3], friction[:known], fit) for known in range(4)]
    assert costs == sorted(costs, reverse=True)
    assert costs[0] == pytest.approx(np.log(fit.config.odds * 4 * len(KINDS)))
    assert costs[3] == pytest.approx(np.log(6 / 4))
    pushes = [KINDS['external_force'](link) for link in KINDS['external_force'].places(BODY)[:2]]
    assert price(pushes[1], pushes[:1], fit) == price(pushes[1], (), fit)  # no friction of all joints
    offset = KINDS['effort_offset']('turn')
    late = replace(offset, span=Span(3.0))
    assert price(late, (), fit) - price(offset, (), fit) == pytest.approx(np.log(fit.config.start_grid))


def test_priors_of_the_robots_size_hold_what_the_other_blocks_leave_open():
    """Of a joint that moves in one block alone the others say nothing: it is predicted with the prior's variance."""
    samples = moving()
    still = samples.position.copy(), samples.velocity.copy(), samples.acceleration.copy()
    for values in still:
        values[:COUNT - 100, 1] = 0.0
    motion = replace(samples, position=still[0], velocity=still[1], acceleration=still[2])
    motion = replace(motion, outputs=BODY.regressors(motion) @ BODY.base_parameters
                     + 0.01 * np.random.default_rng(0).standard_normal((COUNT, 4)))
    fit = fit_model(BODY, motion, [], np.ones(COUNT, dtype=bool), np.full(4, 0.01))
    densities = block_grams(fit).densities(fit.scale, np.ones(4))
    assert densities.min() > densities.max() - 100.0


@pytest.mark.parametrize('steps', [-0.5, 0.25, 0.5, 1.0])
def test_a_delay_gains_nothing_by_averaging_the_noise_of_accelerations(steps):
    """A simulated arm was told half a sample late with 160 nat, and its frictions were off by five deviations."""
    motion, rng = replace(smooth_motion(4, COUNT, speed=1.5), whole=True), np.random.default_rng(0)
    outputs = BODY.outputs_of(motion, BODY.base_parameters)
    noisy = motion.acceleration + 0.5 * motion.acceleration.std(axis=0) * rng.standard_normal(outputs.shape)
    fit = starting_fit(BODY, replace(motion, acceleration=noisy, outputs=outputs), [], np.ones(COUNT, dtype=bool))
    step_s = float(np.diff(motion.time).mean())
    delay = kinds()['time_delay'](None, {'delay_s': steps * step_s})
    after = declare(fit, [delay])
    late = refit_weights(with_effects(fit, [delay]))
    assert abs(after.effects[0].value('delay_s')) < 0.05 * step_s, 'it is settled where it belongs'
    assert gain(fit, after).total < 2.0 and gain(fit, late).total < 2.0


def test_a_delay_that_there_is_gains_as_much_as_it_explains():
    motion = replace(smooth_motion(4, COUNT, speed=1.5), whole=True)
    delay = kinds()['time_delay'](None, {'delay_s': 0.004})
    outputs = CoupledColumns(BODY, [delay]).batch(motion)[0] @ BODY.base_parameters
    outputs += 0.01 * outputs.std(axis=0) * np.random.default_rng(0).standard_normal(outputs.shape)
    fit = starting_fit(BODY, replace(motion, outputs=outputs), [], np.ones(COUNT, dtype=bool))
    assert gain(fit, declare(fit, [delay])).total > 100.0


def test_what_is_far_from_what_was_known_is_unlikely():
    """As half the squares of its deviations beforehand, of coefficients and of calibrations."""
    zero = KINDS['joint_offset']('lift', {'offset': 0.1})
    fit = fitted(moving(), [zero])
    coefficients = 0.5 * np.sum(((fit.theta - fit.prior_mean()) / fit.prior_deviation) ** 2)
    off = (fit.effects[0].value('offset') - 0.06) / zero.calibration_scale(BODY)[0]
    assert unlikely(replace(fit, declared=())) == pytest.approx(
        coefficients + 0.5 * (fit.effects[0].value('offset') / zero.calibration_scale(BODY)[0]) ** 2)
    assert unlikely(replace(fit, declared=(zero.with_values(offset=0.06),))) == pytest.approx(
        coefficients + 0.5 * off**2)


def test_the_foremost_of_each_kind_with_many_values_are_refined():
    """A coarse search tries few of their values: a cable that slips stood behind eight others, and was passed over."""
    plain = [Trial(kinds()['viscous_friction'](str(number)), 1, np.zeros(0), evidence=100.0 - number)
             for number in range(DEFAULTS.tried + 2)]
    cable = kinds('wrench')['cable_hysteresis']
    many = [Trial(cable(str(number), dict.fromkeys(('slip', 'azimuth', 'elevation', 'nearness'), 0.1)), 4, np.zeros(0),
                  evidence=evidence) for number, evidence in enumerate((80.0, 70.0, 60.0, 50.0))]
    chosen = worth_refining(SimpleNamespace(config=DEFAULTS), [*plain, *many])
    assert chosen == [*plain[:DEFAULTS.tried], *many[:DEFAULTS.of_each_kind]]
    unlikely = [replace(trial, evidence=1.0) for trial in many]
    assert worth_refining(SimpleNamespace(config=DEFAULTS), [*plain, *unlikely]) == plain[:DEFAULTS.tried]


def test_an_offset_is_no_move_beside_friction_that_includes_it(monkeypatch):
    """Alone nor with those of other joints; one that begins later may be."""
    monkeypatch.setattr(moves, 'declare', lambda fit, effects: SimpleNamespace(effects=effects))
    monkeypatch.setattr(moves, 'without_impossible', lambda after: after)
    monkeypatch.setattr(moves, 'pruned', lambda after, known: after)
    monkeypatch.setattr(moves, 'prices', lambda added, fit: 0.0)
    monkeypatch.setattr(moves.Move, 'of', lambda added, *_: added)
    monkeypatch.setattr(moves, '_plausible_moves', lambda fit, after, added: after.effects)
    one, *others = (KINDS['effort_offset'](joint) for joint in BODY.joints)
    later = replace(one, span=Span(5.0))
    monkeypatch.setattr(moves, '_at_each_time', lambda fit, effect: [effect, later] if effect == one else [effect])
    fit = SimpleNamespace(config=DEFAULTS, body=BODY, considered=KINDS,
                          effects=(KINDS['asymmetric_friction'](one.where),))
    offsets = [Trial(effect, 1, np.zeros(0), evidence=50.0) for effect in (one, *others)]
    assert moves.single_moves(fit, offsets) == [later, *others]
    assert moves.group_moves(fit, offsets) == [tuple(others)]


def test_no_kind_is_shut_out_of_the_score_by_places_of_another_one(monkeypatch):
    """Crosstalk of a measured iCub stood tenth behind three cables, and three other effects were told in its place."""
    monkeypatch.setattr(moves, '_at_each_time', lambda fit, effect: [effect])
    monkeypatch.setattr(moves, 'declare', lambda fit, effects: effects)
    monkeypatch.setattr(moves, '_plausible_moves', lambda fit, after, added: after)
    cables = [Trial(kinds('wrench')['cable_spring'](str(number)), 9, np.zeros(0), evidence=100.0 - number)
              for number in range(DEFAULTS.tried + 2)]
    crosstalk = Trial(kinds('wrench')['sensor_crosstalk'](), 30, np.zeros(0), evidence=80.0)
    hopeless = Trial(kinds('wrench')['sensor_gain'](), 6, np.zeros(0), evidence=-1.0)
    tried = moves.single_moves(SimpleNamespace(config=DEFAULTS, effects=()), [*cables, crosstalk, hopeless])
    assert tried == [trial.effect for trial in (*cables[:DEFAULTS.tried], crosstalk)]
