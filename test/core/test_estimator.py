"""What every variant of the estimator must do: one check, run over all of them, and what only some do."""

import copy
import pickle
import re
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters, estimate
from semiparam_ros.core.initial_window import gathered_from
from semiparam_ros.core.model import ModelOptions, information_gain
from semiparam_ros.core.motion import STEP_NS, STILL_STEPS, at_start
from semiparam_ros.core.robot.size import radians
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.variants import CHOICES
from semiparam_ros.effects import effect_from_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.identified_parameters import quantities
from support.arms import ODD_BODY, icub, smooth_motion

WINDOW, COUNT = 120, 400


def measured(body, count=COUNT, seed=0):
    """What an arm of other inertias, with something unmodelled, an offset and noise, would let one measure."""
    rng = np.random.default_rng(seed)
    motion = smooth_motion(body.n_joints, count, seed=seed)
    outputs = body.regressors(motion) @ (body.base_parameters * rng.uniform(0.8, 1.2, body.n_parameters))
    scale = outputs.std(axis=0)
    outputs += 0.3 * scale * np.sin(2 * motion.position[:, :1] + motion.position[:, 1:2])
    if body.outputs == 'wrench':
        outputs += 2 * scale
    return replace(motion, outputs=outputs + 0.02 * scale * rng.standard_normal(outputs.shape))


@pytest.fixture(scope='module')
def arm():
    return icub()


@pytest.fixture(scope='module')
def recording(arm):
    return measured(arm)


def estimator(arm, variant, **options):
    return Estimator(arm, ModelOptions(**({'variant': variant, 'features_count': 60, 'initial_samples': WINDOW,
                                              'horizon': 5} | options)))


def run(model, samples, learn=True):
    return [model.step(sample, learn) for sample in samples]


def relative_error(predictions, samples):
    """Root mean square error over the outputs' standard deviation."""
    errors = [(each.sample.outputs - each.mean) / samples.outputs.std(axis=0) for each in predictions]
    return np.sqrt(np.mean(np.square(errors)))


def test_a_lift_of_a_centimetre_is_scaled_by_the_length_of_what_it_carries():
    """Features of metres beside radians did not see it."""
    lift = ODD_BODY.joints.index('lift')
    motion = smooth_motion(ODD_BODY.n_joints, WINDOW, seed=1)
    for values in (motion.position, motion.velocity, motion.acceleration):
        values[:, lift] *= 0.01
    model = estimator(ODD_BODY, 'NP-ML')
    run(model, replace(motion, outputs=ODD_BODY.regressors(motion) @ ODD_BODY.base_parameters))
    scales = model.input_scaling[1][:ODD_BODY.n_joints]
    assert scales[lift] == pytest.approx(0.2 * radians(ODD_BODY)[lift] * np.delete(scales, lift).max())
    assert radians(ODD_BODY)[lift] != 1.0


@pytest.fixture(scope='module', params=sorted(CHOICES))
def trained(request, arm, recording):
    """Each variant after the recording, with all that it said."""
    model = estimator(arm, request.param)
    return model, run(model, recording)


def trained_copy(trained):
    return copy.deepcopy(trained[0])


def hold_weights(model):
    """Of averaged variants, which follow what is measured also where nothing is learnt."""
    if model.weights:
        model.ensemble._weigh = lambda *_: None


# ---- every variant


def test_it_answers_every_sample_and_is_ready_exactly_after_the_window(trained, recording):
    _, predictions = trained
    assert [prediction.ready for prediction in predictions] == [False] * WINDOW + [True] * (COUNT - WINDOW)
    for prediction, sample in zip(predictions, recording, strict=True):
        assert prediction.sample.stamp == sample.stamp
        assert prediction.mean.shape == prediction.std.shape == (6,)
        assert np.isfinite([*prediction.mean, *prediction.std, prediction.log_density]).all()
        assert (prediction.std > 0).all()


def test_learning_on_beats_the_model_of_the_initial_window(trained, arm, recording):
    model, predictions = trained
    frozen = estimator(arm, model.options.variant)
    run(frozen, recording[:WINDOW])
    stopped = run(frozen, recording[WINDOW:], learn=False)
    learnt, kept = (relative_error(part[-100:], recording) for part in (predictions, stopped))
    assert learnt < 0.9 * kept
    assert learnt < (0.6 if model.variant.pi == 'absent' else 0.3)  # the unmodelled sine has a size of 0.3


def test_changes_are_looked_for_by_the_rigid_body_alone(arm, recording):
    """It stands beside the variant with features, and has the declared effects."""
    options = ModelOptions(variant='SPK-ML', features_count=20, initial_samples=100)
    model = Estimator(arm, options, [effect_from_text('sensor_drift')])
    run(model, recording[:120])
    prediction = model.predict(recording[120])
    part, of = model.rigid_body_part(prediction)
    assert of is model.rigid_body_model is model.ensemble.models[1].model is not model.model
    assert of.features is None and of.covered.stop == model.columns.n_columns
    np.testing.assert_array_equal(part.mean, prediction.members[1].mean)


def test_predictive_deviations_are_those_of_the_errors(trained, recording):
    _, predictions = trained
    late = predictions[-150:]
    standardised = np.array([(p.sample.outputs - p.mean) / p.std for p in late])
    widest = 2.5 if trained[0].variant.selection == 'ml' else 10.0  # a validation set: of the window's errors
    assert 1 / widest < np.sqrt(np.mean(standardised**2)) < widest


def test_the_density_is_that_of_a_gaussian_in_newtons(trained):
    prediction = trained[1][-1]
    scale = prediction.std / prediction.model_std
    covariance = np.diag(scale) @ prediction.model_covariance @ np.diag(scale)
    error = prediction.sample.outputs - prediction.mean
    expected = -0.5 * (error @ np.linalg.solve(covariance, error) + np.linalg.slogdet(2 * np.pi * covariance)[1])
    assert prediction.log_density == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), prediction.std, rtol=1e-12)


def test_predicting_changes_nothing(trained, recording):
    model = trained_copy(trained)
    sample = next(iter(recording[-1:]))
    before = model.model.recursion.state()
    first, second = model.predict(sample), model.predict(sample._replace(outputs=np.full(6, np.nan)))
    np.testing.assert_array_equal(first.mean, second.mean)
    assert np.isnan(second.log_density)
    assert all(np.array_equal(before[name], value) for name, value in model.model.recursion.state().items())


def test_a_step_is_a_prediction_and_then_an_observation(trained, recording):
    one, other = trained_copy(trained), trained_copy(trained)
    for sample in recording[:30]:
        stepped = one.step(sample)
        predicted = other.predict(sample)
        errors = other.observe(predicted, predicted.motion.is_news)
        np.testing.assert_array_equal(stepped.mean, predicted.mean)
        np.testing.assert_array_equal(stepped.horizon.eps, errors.eps)
    assert all(np.array_equal(value, other.model.recursion.state()[name])
               for name, value in one.model.recursion.state().items())


def test_without_learning_the_answers_stay_but_horizons_go_on(trained, recording):
    model = trained_copy(trained)
    hold_weights(model)
    sample = next(iter(recording[:1]))
    before = model.predict(sample)
    found = run(model, recording[:40], learn=False)
    after = model.predict(sample)
    np.testing.assert_array_equal(before.model_mean, after.model_mean)
    np.testing.assert_array_equal(before.model_std, after.model_std)
    assert all(each.horizon is not None for each in found)
    late = found[20:26]  # all by the same model: the index is that of these very predictions
    error = sum((p.sample.outputs - p.mean) ** 2 for p in late[1:])
    power = sum(p.sample.outputs**2 for p in late[1:])
    assert late[-1].horizon.origin == late[0].sample.stamp
    # Of averaged models the pool counts by what each says of the sample itself, which follows the bands.
    np.testing.assert_allclose(late[-1].horizon.eps, error / power, rtol=1e-3 if model.weights else 1e-9)


@patch('semiparam_ros.core.model.estimate', estimate)  # another search, see conftest
def test_it_is_deterministic(trained, arm, recording):
    model, predictions = trained
    again = run(estimator(arm, model.options.variant), recording)
    for one, other in zip(predictions, again, strict=True):
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.std, other.std)
        assert one.log_density == other.log_density


@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('field', ['position', 'velocity', 'acceleration', 'outputs'])
def test_values_that_are_not_finite_are_refused_and_change_nothing(trained, recording, field, bad):
    model = trained_copy(trained)
    expected = trained_copy(trained)
    for sample in recording[:12]:
        values = getattr(sample, field).copy()
        values[-1] = bad
        with pytest.raises(SemiparamError, match='expected finite values'):
            model.step(sample._replace(**{field: values}))
        one, other = model.step(sample), expected.step(sample)
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.horizon.eps, other.horizon.eps)


@pytest.mark.parametrize('count', [1, 40])
@pytest.mark.parametrize('field', ['position', 'velocity', 'acceleration', 'outputs'])
def test_values_of_another_number_of_joints_are_refused_and_change_nothing(trained, recording, field, count):
    model, expected, sample = trained_copy(trained), trained_copy(trained), recording[0]
    with pytest.raises(SemiparamError, match=rf'^{field} of a sample has the shape \({count},\); expected'):
        model.step(sample._replace(**{field: np.ones(count)}))
    np.testing.assert_array_equal(model.step(sample).mean, expected.step(sample).mean)


@pytest.mark.parametrize('given', [np.ndarray.tolist, lambda values: np.repeat(values[:, None], 2, axis=1)[:, 0],
                                   lambda values: values.astype('>f8')])
def test_values_in_any_form_are_answered_alike(trained, recording, given):
    """Lists and columns of a matrix ended in a compiled loop, which said types and no words."""
    model, expected = trained_copy(trained), trained_copy(trained)
    for sample in recording[:10]:
        other = sample._replace(**{name: given(getattr(sample, name)) for name in sample._fields[1:5]})
        np.testing.assert_array_equal(model.step(other).mean, expected.step(sample).mean)
    with pytest.raises(SemiparamError, match='outputs of a sample is no array of numbers'):
        model.step(sample._replace(outputs='abc'))


def test_a_caller_may_fill_the_same_arrays_with_every_sample(arm):
    """So slowly that neighbouring samples are of one place: their outputs then tell whether the motors are off."""
    motion = smooth_motion(4, 40)
    slow = replace(motion, position=motion.position[0] + 1e-4 * np.arange(40)[:, None])
    slow = replace(slow, outputs=arm.regressors(slow) @ arm.base_parameters + np.arange(40)[:, None])
    cable = effect_from_text(f'cable_hysteresis@{arm.joints[0]}{{"slip": 0.001}}')
    model, expected = (Estimator(arm, ModelOptions('P'), [cable]) for _ in range(2))
    reused = [np.empty(count) for count in (4, 4, 4, 6)]
    for sample in slow[:STILL_STEPS]:
        for values, given in zip(reused, sample[1:5], strict=True):
            values[:] = given
        one, other = model.step(Sample(sample.stamp, *reused)), expected.step(sample)
        np.testing.assert_array_equal(one.columns, other.columns)
        assert one.motion.is_news


def test_a_temperature_that_was_learnt_stays_where_a_caller_fills_its_array_anew(arm):
    """A saved state had that of a later sample, and so had desired states."""
    drift = effect_from_text('temperature_drift{"reference_c": 20}')
    model, reused = Estimator(arm, ModelOptions('P'), [drift]), np.array([30.0])
    sample = next(iter(smooth_motion(4, 1)))
    model.step(sample._replace(outputs=np.ones(6), temperature=reused))
    saved, desired = model.state(), model.predict_desired(*sample[1:4]).shown
    reused[:] = 90.0
    np.testing.assert_array_equal(saved.temperature, [30.0])
    np.testing.assert_array_equal(model.predict_desired(*sample[1:4]).shown, desired)


def test_horizons_start_with_the_variant_and_again_after_a_jump_of_the_clock(trained, recording):
    _, predictions = trained
    known = [prediction.horizon is not None for prediction in predictions]
    assert known == [False] * 5 + [True] * (WINDOW - 5) + [False] * 5 + [True] * (COUNT - WINDOW - 5)
    model = trained_copy(trained)
    before = model.predict(next(iter(recording[:1]))).mean
    model.clear_pending()
    np.testing.assert_array_equal(model.predict(next(iter(recording[:1]))).mean, before)
    assert [each.horizon is not None for each in run(model, recording[:8])] == [False] * 5 + [True] * 3


def test_hyperparameters_handed_on_give_the_same_model(trained, arm, recording):
    model, _ = trained
    mean, scale = model.input_scaling
    given = estimator(arm, model.options.variant, hyperparameters=model.model.hyperparameters, others=model.others,
                      input_mean=tuple(mean), input_scale=tuple(scale))
    assert given.ready
    run(given, recording[:WINDOW])
    reference = estimator(arm, model.options.variant)
    run(reference, recording[:WINDOW])
    sample = next(iter(recording[WINDOW:WINDOW + 1]))
    np.testing.assert_allclose(given.predict(sample).mean, reference.predict(sample).mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(given.predict(sample).std, reference.predict(sample).std, rtol=1e-9)


CHANGES = {
    'learnt': lambda model, sample: model.step(sample),
    'not learnt': lambda model, sample: model.step(sample, learn=False),
    'restored': lambda model, sample: model.restore(model.state()),
    'cleared': lambda model, sample: model.clear_pending(),
    'other recording': lambda model, sample: model.begin_recording(0)}


def test_another_recording_begins_with_weights_between_the_last_ones_and_those_of_left_out_blocks(trained, recording):
    model = trained_copy(trained)
    ensemble = model.ensemble
    last, elsewhere = ensemble.weights, ensemble._weights_elsewhere()
    model.begin_recording(0)
    np.testing.assert_allclose(ensemble.weights.sum(axis=0), 1.0)
    np.testing.assert_allclose(ensemble.weights, (last + elsewhere) / 2.0, atol=0.01)  # but for the least weight
    model.begin_recording(0)
    assert np.abs(ensemble.weights - elsewhere).max() <= np.abs(last - elsewhere).max() / 4.0 + 0.01


@pytest.mark.parametrize('change', CHANGES.values(), ids=CHANGES)
def test_a_prediction_is_stale_once_anything_has_changed(trained, recording, change):
    model = trained_copy(trained)
    stale = model.predict(recording[0])
    change(model, recording[1])
    expected = trained_copy((model,))
    with pytest.raises(SemiparamError, match='stale'):
        model.observe(stale)
    for sample in recording[2:10]:
        one, other = model.step(sample), expected.step(sample)
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.horizon is None or one.horizon.eps,
                                      other.horizon is None or other.horizon.eps)


def test_a_prediction_of_the_provisional_model_is_stale_when_the_window_is_over(arm, recording):
    model = estimator(arm, 'P')
    run(model, recording[:WINDOW - 1])
    stale = model.predict(recording[WINDOW])
    model.finish_window()
    with pytest.raises(SemiparamError, match='stale'):
        model.observe(stale)


def test_a_prediction_goes_to_another_process_with_its_estimator(trained, recording):
    model = trained_copy(trained)
    there, prediction = pickle.loads(pickle.dumps((model, model.predict(recording[0]))))
    there.observe(prediction, prediction.motion.is_news)
    model.step(recording[0])
    np.testing.assert_array_equal(there.predict(recording[1]).mean, model.predict(recording[1]).mean)


# ---- single questions


def test_the_window_may_end_early_but_not_without_samples(arm, recording):
    model = estimator(arm, 'SPK-ML')
    with pytest.raises(SemiparamError, match='holds no samples yet'):
        model.finish_window()
    run(model, recording[:10])
    with pytest.raises(SemiparamError, match='the initial window holds 10 samples'):
        model.finish_window()
    run(model, recording[10:60])
    model.finish_window()
    assert model.ready
    assert model.step(next(iter(recording[60:61]))).ready


def test_samples_that_are_not_learnt_are_not_in_the_window(arm, recording):
    model = estimator(arm, 'P')
    run(model, recording[:50], learn=False)
    assert not model.window
    found = run(model, recording[50:50 + WINDOW + 1])
    assert [each.ready for each in found] == [False] * WINDOW + [True]


def test_a_window_of_standstill_says_what_is_missing(arm):
    motion = smooth_motion(4, 60)
    still = Samples(motion.stamps, motion.position[:1].repeat(60, 0), 0 * motion.velocity, 0 * motion.acceleration,
                    np.ones((60, 6)), 0)
    model = estimator(arm, 'SPK-ML', initial_samples=60)
    run(model, still)
    assert not model.ready and len(model.window) == 1
    with pytest.raises(SemiparamError, match='the initial window holds 1 samples; expected at least 20'):
        model.finish_window()
    with pytest.raises(SemiparamError, match=r'output 0, 1, 2, 3, 4, 5 .* constant'):
        for sample in replace(motion, outputs=np.ones((60, 6))):
            model.observe(model.predict(sample))


@pytest.mark.parametrize(('rate_hz', 'seconds'), [(20, 20), (1000, 4)])
def test_rest_is_not_counted_in_the_window_and_changes_nothing(arm, rate_hz, seconds):
    """The first sample held for seconds, with noise."""
    recording = measured(arm, 900)
    rng, period = np.random.default_rng(3), 10**9 // rate_hz

    def rest(first, stamp, count):
        return [first._replace(stamp=stamp + index * period, position=first.position + 1e-4 * rng.uniform(-1, 1, 4),
                               velocity=first.velocity + 0.01 * rng.standard_normal(4),
                               acceleration=first.acceleration + 0.02 * rng.standard_normal(4),
                               outputs=first.outputs + 0.02 * rng.standard_normal(6)) for index in range(count)]

    start = recording.stamps[0] - seconds * 10**9
    before = rest(recording[0], int(start), seconds * rate_hz)
    model, reference = (estimator(arm, 'SPK-ML', initial_samples=400) for _ in range(2))
    run(model, before)
    assert len(model.window) == STILL_STEPS and not model.ready
    found, wanted = run(model, recording), run(reference, recording)
    assert [each.ready for each in wanted] == [False] * 400 + [True] * 500
    left = 400 - STILL_STEPS
    assert [each.ready for each in found] == [False] * (left + 1) + [True] * (899 - left)
    assert relative_error(found[400:], recording) < 1.5 * relative_error(wanted[400:], recording)
    kept = model.model.recursion.state()
    after = run(model, rest(recording[899], int(recording.stamps[-1]) + period, seconds * rate_hz))
    assert np.isfinite([each.mean for each in after]).all()
    first = model.model.recursion.state()
    run(model, rest(recording[899], int(recording.stamps[-1]) + 21 * 10**9, seconds * rate_hz))
    assert all(np.array_equal(values, model.model.recursion.state()[name]) for name, values in first.items())
    assert not np.array_equal(kept['theta'], first['theta']), 'the first second of a stop is learnt'


@pytest.mark.parametrize(('speed', 'share'), [(0.2, 1.0), (0.03, 0.9), (0.01, 0.1), (0.001, 0.0)])
def test_slow_motion_counts_as_far_as_it_goes(speed, share):
    motion, moving = at_start(0, np.zeros(3), np.ones(3)), []
    for index in range(1, 20000):
        stamp = index * 8_000_000
        motion = motion.after(stamp, np.array([0.0, speed * stamp * 1e-9, 0.0]), np.full(3, index))
        moving.append(motion.is_news)
    assert share <= np.mean(moving) <= share + 0.15


@pytest.mark.parametrize('rate_hz', [1000, 4000])
def test_of_slow_motion_a_faster_robot_shows_as_much(rate_hz):
    """Five samples of a place were news, an eighth of the time at 4 kHz: a window at a tenth of a radian a second took
    ten times as long as at 250 Hz."""
    motion, learnt = at_start(0, np.zeros(1), np.ones(1)), []
    for index in range(1, 2 * rate_hz):
        time = index / rate_hz
        motion = motion.after(round(1e9 * time), np.array([0.1 * time]), np.full(1, time))
        learnt.append(motion.is_news)
    assert np.mean(learnt) > 0.9


def test_what_of_a_recording_the_initial_window_takes(recording):
    still = replace(recording, position=recording.position[:1].repeat(COUNT, 0))
    assert gathered_from(recording, 100).indices.tolist() == list(range(100))
    assert gathered_from(recording, 100)[1:] == (100, True)
    assert gathered_from(recording, 10 * COUNT)[1:] == (COUNT, False)
    assert len(gathered_from(still, 100).indices) == STILL_STEPS and not gathered_from(still, 100).full


@pytest.mark.parametrize(('period_ms', 'step'), [(0.5, 8), (1.0, 4), (2.0, 2), (3.0, None), (5.0, 1)])
def test_a_window_of_a_fast_robot_takes_one_sample_of_each_step(arm, recording, period_ms, step):
    """A thousand samples of 4 kHz were a quarter of a second of one motion."""
    stamps = recording.stamps[0] // STEP_NS * STEP_NS + np.round(1e6 * period_ms * np.arange(COUNT)).astype(np.int64)
    fast, wanted = replace(recording, stamps=stamps), 40
    taken, model = gathered_from(fast, wanted), estimator(arm, 'P', initial_samples=wanted)
    assert taken.full and len(taken.indices) == wanted and taken.end == taken.indices[-1] + 1
    assert step is None or set(np.diff(taken.indices)) == {step}
    assert np.diff(stamps[taken.indices] // STEP_NS).min() == 1
    run(model, fast[:taken.end - 1])
    assert not model.ready and len(model.window) == wanted - 1
    np.testing.assert_array_equal(model.window.inputs, fast[taken.indices[:-1]].inputs)
    run(model, fast[taken.end - 1:taken.end])
    assert model.ready and model.window_samples == wanted


def test_a_twin_finishes_the_window_while_the_rigid_body_goes_on(arm, recording):
    model, reference = (estimator(arm, 'SPK-ML') for _ in range(2))
    run(reference, recording[:WINDOW + 20])
    for sample in recording[:WINDOW]:
        model.observe(model.predict(sample), finish=False)
    assert model.window_full and not model.ready
    twin = model.with_window_alone()
    for sample in recording[WINDOW:WINDOW + 20]:
        model.observe(model.predict(sample), finish=False)
    assert len(model.window) == WINDOW and not model.ready
    twin.finish_window()
    run(twin, recording[WINDOW:WINDOW + 20])
    for own, its in zip(twin.kept.state().values(), reference.kept.state().values(), strict=True):
        np.testing.assert_array_equal(own, its)
    sample = recording[WINDOW + 20]
    np.testing.assert_array_equal(twin.predict(sample).mean, reference.predict(sample).mean)


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_a_robot_that_rested_over_the_initial_window_is_predicted_within_reason_when_it_moves(arm, outputs):
    """At rest most columns hold rounding errors alone: the noise was fitted with them, by coefficients of 1e14."""
    body = arm if outputs == 'wrench' else ODD_BODY
    rng = np.random.default_rng(2)
    place, rest = rng.uniform(-1.0, 1.0, body.n_joints), np.zeros(body.n_joints)
    still = [Sample(i * 50_000_000, place, rest, rest, 3 + 0.1 * rng.standard_normal(body.n_outputs))
             for i in range(70)]
    for variant in CHOICES:
        model = estimator(body, variant, initial_samples=1000)
        for sample in still[:60]:
            model.observe(model.predict(sample))
        model.finish_window()
        off = np.abs([each.mean - 3 for each in run(model, still[60:])])
        assert off.max() < 0.5 and off[-1].max() < 0.3, variant
        moving = Sample(70 * 50_000_000, place + 0.3, rest + 0.5, rest + 0.5, still[0].outputs)
        assert np.abs(model.predict(moving).mean).max() < 100.0, variant


def test_the_time_of_an_effect_starts_with_the_first_sample_also_when_it_was_not_learnt(arm, recording):
    model = Estimator(arm, ModelOptions(variant='P', initial_samples=40, horizon=5), [effect_from_text('sensor_drift')])
    predictions = run(model, recording[:20], learn=False) + run(model, recording[20:70])
    drift = [prediction.columns[:, -6:] for prediction in predictions]
    np.testing.assert_allclose(drift, np.arange(70)[:, None, None] / 20 * np.eye(6), atol=1e-9)


def test_the_time_of_an_effect_may_start_before_the_first_sample(arm, recording):
    push = effect_from_text('external_force@r_hand{"start_s": 6.0}')
    late = recording[200:]
    begun = (late.stamps - recording.origin) * 1e-9 >= 6.0
    for origin, expected in ((recording.origin, begun), (None, begun & False)):
        model = Estimator(arm, ModelOptions(variant='P', initial_samples=300), [push], origin)
        shown = [np.abs(model.step(sample, learn=False).columns[:, -3:]).max() > 0.0 for sample in late[:100]]
        np.testing.assert_array_equal(shown, expected[:100])
        assert model.origin == (recording.origin if origin is not None else late[0].stamp)


PUSH = np.array([3.0, -2.0, 4.0])
PUSHED_FROM = 220


@pytest.fixture(scope='module')
def pushed(arm, recording):
    """The recording with a constant force on the hand that begins after the initial window."""
    columns, _ = effect_from_text('external_force@r_hand').columns(arm, recording, None)
    begun = (np.arange(COUNT) >= PUSHED_FROM)[:, None]
    return replace(recording, outputs=recording.outputs + begun * (columns @ PUSH))


def declaring(trained, arm, *effects):
    """The same variant, untrained, with effects."""
    return Estimator(arm, trained[0].options, [effect_from_text(text) for text in effects])


def test_every_variant_learns_an_effect_that_begins_after_the_window(trained, arm, recording, pushed):
    model = declaring(trained, arm, f'external_force@r_hand{{"start_s": {recording.time[PUSHED_FROM]}}}')
    clean, declared = (relative_error(part[-100:], recording) for part in (trained[1], run(model, pushed)))
    assert declared < 1.15 * clean
    learnt = model.model.part(model.columns.blocks['0'])
    if model.options.variant.startswith('SP'):  # features alone, or none, take an unmodelled sine of 0.3 for a force
        np.testing.assert_allclose(learnt, PUSH, atol=1.0)
    assert len(model.model.theta) == len(model.model.theta_std()) == len(quantities(model)) == {
        'absent': 3}.get(model.variant.pi, model.columns.n_columns)
    assert [quantity.name for quantity in quantities(model)][-3:] == [f'external_force@r_hand.force_{axis}'
                                                                      for axis in 'xyz']
    assert quantities(model)[-3].value == learnt[0]
    assert len(model.hyperparameters().pi or ()) == {'absent': 0}.get(model.variant.pi, model.columns.n_own)


@pytest.mark.parametrize('effect', [
    'payload@r_hand', 'payload@r_hand{"start_s": 15}', pytest.param('sensor_drift', marks=pytest.mark.long)])
def test_an_effect_that_the_window_cannot_tell_or_does_not_see_explodes_in_no_variant(trained, arm, recording, effect):
    """With the columns of effects among the fixed ones, SP and SP2 took what the window left open for any size."""
    model = declaring(trained, arm, effect)
    declared = relative_error(run(model, recording)[WINDOW:], recording)
    assert declared < 2.0 * relative_error(trained[1][WINDOW:], recording)


@pytest.mark.parametrize('variant', ['SP-ML', 'NP-ML', 'SP2-ML'])
def test_hyperparameters_handed_on_give_the_same_model_with_effects(arm, pushed, variant):
    effects = [effect_from_text('external_force@r_hand')]
    options = ModelOptions(variant=variant, features_count=60, initial_samples=WINDOW, alone=True)
    reference = Estimator(arm, options, effects)
    run(reference, pushed[:WINDOW])
    mean, scale = reference.input_scaling
    options = replace(reference.options, hyperparameters=reference.model.hyperparameters, input_mean=tuple(mean),
                      input_scale=tuple(scale))
    given = Estimator(arm, options, effects)
    run(given, pushed[:WINDOW])
    for sample in pushed[WINDOW:WINDOW + 5]:
        np.testing.assert_allclose(given.step(sample).mean, reference.step(sample).mean, rtol=0, atol=1e-9)


def test_a_variant_with_features_beats_p_where_something_is_unmodelled(arm):
    samples = measured(arm, 900)
    errors = {}
    for variant in ('P', 'SPK-ML'):
        predictions = run(estimator(arm, variant, features_count=100, initial_samples=300), samples)
        errors[variant] = relative_error(predictions[-300:], samples)
    assert errors['SPK-ML'] < 0.5 * errors['P']


def test_efforts_are_learnt_as_well():
    samples = measured(ODD_BODY)
    for variant in CHOICES:
        predictions = run(estimator(ODD_BODY, variant), samples)
        assert relative_error(predictions[-100:], samples) < 0.4, variant


def test_before_the_window_the_description_answers(arm):
    motion = replace(smooth_motion(4, 3), outputs=np.full((3, arm.n_outputs), np.nan))
    described = arm.regressors(motion) @ arm.base_parameters
    for sample, expected in zip(motion, described, strict=True):
        np.testing.assert_allclose(estimator(arm, 'NP-ML').predict(sample).mean, expected, atol=1e-9)


def test_forgetting_follows_a_change(arm):
    samples = measured(arm, 500)
    heavier = replace(samples, outputs=np.where(np.arange(500)[:, None] < 250, samples.outputs,
                                                1.5 * samples.outputs))
    errors = {}
    for forgetting in (1.0, 0.98):
        predictions = run(estimator(arm, 'SPK-ML', forgetting=forgetting), heavier)
        errors[forgetting] = relative_error(predictions[-80:], samples)
    assert errors[0.98] < 0.5 * errors[1.0]


GIVEN = Hyperparameters(gamma=0.3, rho=1.0, tau=(3.0,), sigma=0.1, output_scale=(1.0,) * 6)


@pytest.mark.parametrize(('variant', 'changes', 'options', 'sentence'), [
    ('SPK', {}, {}, "variant 'SPK' is unknown; expected one of P, NP-ML"),
    ('SPK-ML', {}, {'input_mean': ()}, 'hold 0 and 12 values; expected 12'),
    ('SP-ML', {}, {}, 'hyperparameters.pi holds 0 values; expected 23 for SP-ML'),
    ('SPK-ML', {'output_scale': (1.0,)}, {}, 'output_scale holds 1 values; expected 6'),
    ('SPK-ML', {'tau': (1.0, 2.0)}, {}, '2 length scales for 12 inputs'),
    ('SPK-ML', {'sigma': 0.0}, {}, 'sigma 0.0'),
    ('SPK-ML', {'gamma': 0.0}, {}, 'expected positive finite ones'),
    ('SPK-ML', {}, {'features_count': 61}, 'features.count is 61'),
    ('SPK-ML', {}, {'features_count': 'auto'}, 'features.count is auto, but hyperparameters are given'),
    ('SPK-ML', {}, {'forgetting': 0.0}, 'forgetting is 0.0'),
    ('SPK-ML', {}, {'horizon': 0}, 'horizon.length is 0'),
])
def test_impossible_choices_are_refused(arm, variant, changes, options, sentence):
    scaling = {'input_mean': (0.0,) * 12, 'input_scale': (1.0,) * 12}
    with pytest.raises(SemiparamError, match=re.escape(sentence)):
        estimator(arm, variant, **({'hyperparameters': replace(GIVEN, **changes)} | scaling | options))


@pytest.mark.parametrize('variant', ['P', 'SPK-ML'])
def test_each_third_sample_is_learnt_and_all_are_followed(arm, recording, variant):
    samples = list(recording)
    model, by_hand = (estimator(arm, variant, learn_every=every, priors='paper') for every in (3, 1))
    for index, sample in enumerate(samples[:WINDOW + 60]):
        predictions = model.step(sample), by_hand.predict(sample)
        by_hand.observe(predictions[1], learn=index < WINDOW or (index - WINDOW) % 3 == 2)
        np.testing.assert_array_equal(predictions[0].model_mean, predictions[1].model_mean)
    for name, values in model.model.recursion.state().items():
        np.testing.assert_array_equal(values, by_hand.model.recursion.state()[name], err_msg=name)
    assert model.passed_over == 40 and by_hand.passed_over == 0
    kept = model.kept.state()['counts'].tolist()[-1]
    assert kept == WINDOW + 20, 'features know no more of the inputs than was learnt'
    offset, expected = (each.ensemble.first.wandering.offset for each in (model, by_hand))
    assert np.abs(offset - expected).max() > 0.0, 'the offset follows every sample'


def test_where_noise_stays_alike_a_faster_robot_learns_as_much(arm):
    """How much a sample tells is estimated from those that are 4 ms apart; four times as many were learnt at 1 kHz, and
    the deviations told were too small."""
    motion = smooth_motion(4, 400, 1000.0)
    noise = 0.1 * np.random.default_rng(0).standard_normal((400, 6))
    fast = replace(motion, outputs=arm.regressors(motion) @ (1.1 * arm.base_parameters) + noise)
    models = []
    for recording, r in ((fast, 50.0), (fast[::4], 50.0), (fast, 1.0)):
        given = replace(GIVEN, autocorrelation_time=r)
        model = estimator(arm, 'P', hyperparameters=given, input_mean=(0.0,) * 12, input_scale=(1.0,) * 12)
        run(model, recording)
        models.append((model.model.theta, model.passed_over))
    (theta, passed_over), (slow, none), (_, white) = models
    np.testing.assert_array_equal(theta, slow)
    assert (passed_over, none, white) == (300, 0, 0)


def test_what_tells_too_little_is_not_learnt(arm, recording):
    least = 0.3
    model, learnt = estimator(arm, 'SPK-ML', learn_least_gain=least, priors='paper'), []
    for sample in recording:
        prediction = model.predict(sample)
        noise, ready, passed_over = model.model.noise_std, model.ready, model.passed_over
        gain = information_gain(prediction.members[0].prior, noise)
        ratio = prediction.model_covariance / np.outer(noise, noise)
        assert gain >= 0.5 * np.linalg.slogdet(ratio)[1] - 1e-9
        if ready:
            learnt.append(gain >= least)
        model.observe(prediction)
        assert model.passed_over == passed_over + (ready and not learnt[-1])
    assert 0.05 < np.mean(learnt) < 0.95


def test_the_horizon_holds_the_wandering_offset_of_each_model(trained, recording):
    """The index of origin t is that of a copy made at t which predicts on without learning."""
    model = trained_copy(trained)
    ebbing = np.array([3.0, -2.0, 1.0, 0.1, 0.2, -0.3])
    model.ensemble.first.wandering.learn(ebbing, np.ones(6))
    run(model, recording[:30])
    twin, follows = copy.deepcopy(model), recording[30:30 + model.options.horizon]
    hold_weights(twin)
    origin = model._newest
    error = sum((each.sample.outputs - each.mean) ** 2 for each in run(twin, follows, learn=False))
    power = sum(sample.outputs**2 for sample in follows)
    found = [each.horizon for each in run(model, follows)][-1]
    assert found.origin == origin and np.abs(model.ensemble.first.wandering.offset).max() > 1e-4
    # How sure each member of an average is of a sample is what it says when that comes, having learnt those before.
    np.testing.assert_allclose(found.eps, error / power, rtol=1e-3 if model.weights else 1e-9)


@pytest.mark.parametrize('variant', ['NP-ML', 'SP-ML'])
def test_a_model_that_learns_effects_alone_does_not_take_them_for_what_changed(arm, variant):
    """With as many columns of effects as of the rigid body, directions of its inertias widened those of the effects."""
    effects = [effect_from_text(kind) for kind in ('payload@r_gripper', 'sensor_drift', 'sensor_offset',
                                                   'thermal_drift{"time_constant_s": 9.0}')]
    scaling = {'input_mean': (0.0,) * 12, 'input_scale': (1.0,) * 12}
    own = Estimator(arm, ModelOptions(variant='P')).columns.n_own
    given = Hyperparameters(0.0, 1.0, (2.0,), 0.1, (1.0,) * 6, (0.0,) * own if variant == 'SP-ML' else None)
    model = Estimator(arm, ModelOptions(variant=variant, hyperparameters=given, alone=True, **scaling), effects)
    assert model.columns.n_effects >= own
    before = model.model.recursion.theta_covariance()
    model.follow_change(np.ones((own, 2)))
    np.testing.assert_allclose(model.model.recursion.theta_covariance(), before)
