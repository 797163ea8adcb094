"""Models averaged by their evidence: the weights, and members that are as each would be alone."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from semiparam_ros.core.ensemble import ELSEWHERE, EVIDENCE_MEMORY, LEAST_LOG_WEIGHT, OUTLIER_DENSITY, weigh_models
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.mixture import DEGREES
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.variants import AVERAGED
from semiparam_ros.effects import effect_from_text, effect_to_text
from semiparam_ros.errors import SemiparamError
from support.arms import ODD_BODY, ODD_JOINTS, smooth_motion

WINDOW, COUNT = 60, 260
ARM = ODD_BODY


def recording(unmodelled):
    rng = np.random.default_rng(3)
    motion = smooth_motion(ARM.n_joints, COUNT, seed=3)
    outputs = ARM.regressors(motion) @ ARM.base_parameters
    outputs += unmodelled * outputs.std(axis=0) * np.sin(3.0 * motion.position)
    return replace(motion, outputs=outputs + 0.02 * outputs.std(axis=0) * rng.standard_normal(outputs.shape))


def begun(variant, samples, effects=(), **chosen):
    options = ModelOptions(variant=variant, features_count=30, initial_samples=WINDOW, horizon=4, **chosen)
    model = Estimator(ARM, options, [effect_from_text(text) for text in effects])
    return model, [model.step(sample) for sample in samples]


EFFECTS = (f'effort_gain@{ODD_JOINTS[0]}', f'joint_offset@{ODD_JOINTS[1]}',
           f'coulomb_friction@{ODD_JOINTS[-1]}{{"start_s": 6.0}}')


@pytest.fixture(scope='module', params=[(AVERAGED, 0.0, ()), (AVERAGED, 0.5, ()), (AVERAGED, 0.5, EFFECTS[:1]),
                                        ('SP-ML', 0.0, EFFECTS), ('P', 0.5, EFFECTS[1:])],
                ids=['linear', 'bent', 'bent with an effect', 'SP-ML with effects', 'P with effects'])
def averaged(request):
    variant, unmodelled, effects = request.param
    samples = recording(unmodelled)
    return samples, *begun(variant, samples, effects)


def error(predictions):
    late = [each for each in predictions if each.ready]
    return np.mean([(each.sample.outputs - each.mean) ** 2 for each in late], axis=0)


def test_weights_are_forgotten_evidence():
    rng = np.random.default_rng(0)
    errors, std = 0.3 * rng.standard_normal((40, 3, 2)), rng.uniform(0.9, 1.1, (40, 3, 2))
    log_weights, evidence = np.zeros((3, 2)), np.zeros((3, 2))
    for index in range(40):
        weights = weigh_models(log_weights, errors[index], std[index])
        evidence = (1.0 - 1.0 / EVIDENCE_MEMORY) * evidence
        density = student.pdf(errors[index] / std[index], DEGREES) / std[index]
        evidence += np.log(density + OUTLIER_DENSITY * density.max(axis=0))
    assert np.ptp(evidence, axis=0).max() < -LEAST_LOG_WEIGHT, 'the floor is another test'
    expected = np.exp(evidence - evidence.max(axis=0))
    np.testing.assert_allclose(weights, expected / expected.sum(axis=0), rtol=1e-9)


@pytest.mark.parametrize('scale', [1e-150, 1.0, 1e150])
def test_weights_stay_finite_and_the_last_takes_over_within_a_few_samples(scale):
    log_weights = np.zeros((2, 1))
    good, poor = np.array([[0.5], [8.0]]), np.array([[8.0], [0.5]])
    for _ in range(20000):
        weights = weigh_models(log_weights, scale * good, np.full((2, 1), scale))
    assert weights[0, 0] == pytest.approx(1.0 / (1.0 + np.exp(LEAST_LOG_WEIGHT)))
    for _ in range(3):
        weights = weigh_models(log_weights, scale * poor, np.full((2, 1), scale))
    assert np.isfinite(weights).all() and weights[1, 0] > 0.9


def test_one_sample_that_only_the_poorer_model_expects_does_not_take_the_weight_from_the_better_one():
    log_weights = np.zeros((2, 1))
    for _ in range(200):
        weigh_models(log_weights, np.array([[0.5], [3.0]]), np.array([[1.0], [4.0]]))
    weights = weigh_models(log_weights, np.array([[25.0], [3.0]]), np.array([[1.0], [4.0]]))
    assert weights[0, 0] > 0.9


def test_each_member_is_as_it_would_be_alone_and_the_average_no_less_likely_than_the_best(averaged):
    samples, model, predictions = averaged
    densities = []
    for index, member in enumerate(model.members):
        effects = [effect_to_text(effect) for effect in model.columns.effects if member.has_effects]
        _, alone = begun(member.variant, samples, effects, alone=True)
        densities.append(np.mean([each.log_density for each in alone[WINDOW:]]))
        for one, other in zip(alone[WINDOW:], predictions[WINDOW:], strict=True):
            np.testing.assert_array_equal(one.mean, other.members[index].mean)
            np.testing.assert_array_equal(one.std, other.members[index].std)
    averaged = np.mean([each.log_density for each in predictions[WINDOW:]])
    assert averaged > max(densities) - 0.2  # [nat] of four outputs; the members are up to 10 apart
    gathering = 2 if model.columns.effects else 1
    assert len(predictions[WINDOW - 1].members) == gathering and len(predictions[WINDOW].members) == len(model.members)


def test_before_the_window_is_over_the_rigid_body_without_effects_stands_beside_the_one_with(averaged):
    samples, model, predictions = averaged
    if not model.columns.effects:
        assert model.effects_probability is None
        return
    plain = Estimator(ARM, replace(model.options, alone=True))
    for sample, prediction in zip(samples[:WINDOW - 1], predictions, strict=False):
        np.testing.assert_array_equal(plain.step(sample).model_mean, prediction.members[1].prior.mean)
    *having, without = model.weights.values()
    best = np.max(having, axis=0)
    np.testing.assert_allclose(model.effects_probability, best / (best + without))


def test_a_state_goes_on_as_it_was_with_the_hyperparameters_of_every_member(averaged):
    samples, model, _ = averaged
    model = pickle.loads(pickle.dumps(model))
    mean, scale = ((), ()) if model.input_scaling is None else map(tuple, model.input_scaling)
    twin = Estimator(ARM, replace(model.options, hyperparameters=model.model.hyperparameters,
                                     input_mean=mean, input_scale=scale), model.columns.effects)
    twin.restore(pickle.loads(pickle.dumps(model.state())))
    assert twin.others == model.others and list(twin.weights) == [member.name for member in model.members]
    for sample in samples[:12]:
        one, other = model.step(sample), twin.step(sample)
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.std, other.std)
        np.testing.assert_array_equal(one.horizon.eps, other.horizon.eps)
    alone, _ = begun('NP-ML', samples)
    with pytest.raises(SemiparamError, match='the saved average'):
        model.restore(alone.state())
    with pytest.raises(SemiparamError, match='the saved weights of the models'):
        model.restore(model.state()._replace(average={**model.state().average, 'shares': np.zeros(3)}))


@pytest.mark.parametrize(('variant', 'effects'), [(AVERAGED, ()), (AVERAGED, EFFECTS[:1]), ('SP-ML', EFFECTS)])
def test_a_state_from_before_the_end_of_the_window_goes_on(variant, effects):
    samples = recording(0.5)
    model, _ = begun(variant, samples[:WINDOW - 10], effects)
    twin, _ = begun(variant, samples[:5], effects)
    twin.restore(pickle.loads(pickle.dumps(model.state())))
    for sample in samples[WINDOW - 10:WINDOW + 20]:
        np.testing.assert_array_equal(model.step(sample).mean, twin.step(sample).mean)
    unready, _ = begun(variant, samples[:5], effects)
    if variant == AVERAGED:
        with pytest.raises(SemiparamError, match='the saved average'):
            unready.restore(model.state())


@pytest.mark.parametrize('variant', ['P', 'SP-ML', 'SPK-ML'])
def test_an_effect_is_believed_within_a_few_samples_of_its_start(variant):
    samples = recording(0.0)
    start = COUNT - 80
    text = f'viscous_friction@{ODD_JOINTS[-1]}{{"start_s": {samples.time[start]}}}'
    size = samples.outputs.std(axis=0)
    braked = samples.outputs.copy()
    braked[start:, -1] += 2.0 * size[-1] * samples.velocity[start:, -1]
    samples = replace(samples, outputs=braked)
    bare = {'joint_friction': False}
    plain, believing = begun(variant, samples, **bare)[1], begun(variant, samples, [text], **bare)
    left = np.array([[(sample.outputs - each.mean)[-1] / size[-1] for each in pair]
                     for sample, *pair in zip(samples, plain, believing[1], strict=True)])
    probability = believing[0].effects_probability
    assert probability[-1] > 0.99 and probability[0] == pytest.approx(0.5, abs=0.1)
    error = np.sqrt(np.mean(np.square(left[start + 5:]), axis=0))
    assert error[1] < 0.5 * error[0]
    np.testing.assert_allclose(left[WINDOW:start, 1], left[WINDOW:start, 0], atol=0.05)


def test_a_desired_state_is_between_the_models_and_as_uncertain_as_on_a_block_that_was_left_out(averaged):
    samples, model, _ = averaged
    sample = samples[COUNT // 2]
    predicted, desired = model.predict(sample), model.predict_desired(*sample[1:4])
    means = np.array([member.prior.mean for member in predicted.members])
    assert (desired.shown >= means.min(axis=0) - 1e-9).all() and (desired.shown <= means.max(axis=0) + 1e-9).all()
    noise = np.array([each.model.noise_std for each in model.ensemble.models])
    expected = ELSEWHERE * model.ensemble.carried.expected(noise)
    assert (np.sqrt(np.diag(desired.covariance)) >= expected.min(axis=0)).all()
    np.testing.assert_array_equal(desired.shown, desired.needed)
    assert model.predict_desired(*(30.0 * values for values in sample[1:4])).distance > 3.0 > desired.distance


def test_features_fade_where_nothing_was_learnt(averaged):
    """A few hundred are periodic: of a motion like none before they said as much as of what they had learnt."""
    samples, model, _ = averaged
    far = [30.0 * values for values in samples[COUNT // 2][1:4]]
    for each in model.ensemble.models:
        columns, _ = each.columns.desired(*far, 0, 0)
        known = each.known(np.concatenate(far), model.kept)
        found = each.predict_desired(np.concatenate(far), columns, columns, known)
        own = columns[:, each.model.covered] @ each.model.theta
        np.testing.assert_allclose(found.shown, own, atol=1e-6 * np.abs(own).max() + 1e-9)
        if each.model.features is not None:
            recursion = each.model.recursion
            at_least = (recursion.rho**2 + recursion.sigma**2) * recursion.scale**2
            assert (np.diag(found.covariance) >= 0.999 * at_least).all()


def test_elsewhere_the_rigid_body_answers_though_features_were_better_on_what_was_learnt():
    """On a measured UR3 features explained a tenth more of the motion learnt; on another one they erred 2.2 times as
    much as the rigid body alone."""
    samples = recording(0.5)
    model, _ = begun('SPK-ML', samples)
    ensemble, values = model.ensemble, samples[COUNT // 2][1:4]
    with_features, rigid_body = ensemble.models
    ensemble.carried._blocks[:3, 0], ensemble.carried._blocks[:3, 1] = 1e-4, 1e-2
    ensemble.carried._finished, ensemble.carried._told = 3, None
    far = [30.0 * each for each in values]
    for row, answered in ((far, rigid_body), (values, with_features)):
        x, columns = np.concatenate(row), model.columns.desired(*row, 0, 0)[0]
        own = answered.predict_desired(x, columns, columns, answered.known(x, model.kept)).shown
        other = next(each for each in ensemble.models if each is not answered)
        apart = np.abs(own - other.predict_desired(x, columns, columns, other.known(x, model.kept)).shown)
        assert (np.abs(model.predict_desired(*row).shown - own) <= 0.05 * apart + 1e-9).all()


@pytest.mark.parametrize('variant', ['SPK-ML', AVERAGED])
def test_the_less_is_known_of_features_the_less_they_weigh_and_blocks_decide_where_all_is(variant):
    model, _ = begun(variant, recording(0.5))
    ensemble = model.ensemble
    without = np.array([each.model.features is None for each in ensemble.models])
    ensemble.carried._blocks[:3] = np.where(without, 1e-2, 1e-4)[:, None]
    ensemble.carried._finished, ensemble.carried._told = 3, None
    weights = [ensemble._weights_elsewhere(np.where(without, 1.0, known)) for known in (0.0, 1e-3, 0.3, 0.9, 1.0)]
    features = [each[~without].sum(axis=0) for each in weights]
    assert (np.diff(features, axis=0) > 0.0).all() and (features[0] < 1e-9).all()
    np.testing.assert_allclose(weights[-1], ensemble._weights_elsewhere())
    np.testing.assert_allclose([each.sum(axis=0) for each in weights], 1.0)


def test_one_sample_that_no_member_can_foresee_decides_nothing(averaged):
    samples, model, _ = averaged
    model = pickle.loads(pickle.dumps(model))
    before = np.array(list(model.weights.values()))
    sample: Sample = samples[COUNT // 2]
    model.step(sample._replace(outputs=sample.outputs + 1e6))
    assert np.abs(np.array(list(model.weights.values())) - before).max() < 0.9
    assert all(np.isfinite(values).all() for values in model.weights.values())


def test_members_return_from_a_change_with_their_horizons_and_a_state_holds_what_was_before(averaged):
    samples, model, _ = averaged
    model = pickle.loads(pickle.dumps(model))
    later = [sample._replace(stamp=sample.stamp + time * int(samples.stamps[-1] - samples.stamps[0] + 10**7))
             for time in (1, 2) for sample in samples]
    load = 5.0 * samples.outputs.std(axis=0)
    model.follow_change()
    for sample in later[:COUNT]:
        model.step(sample._replace(outputs=sample.outputs + load))
    twin = pickle.loads(pickle.dumps(model))
    model.restore(pickle.loads(pickle.dumps(twin.state())))
    steps, returns = [], []
    for number, sample in enumerate(later[COUNT:]):
        for each in (model, twin):
            prediction = each.predict(sample)
            as_before = each.compare(prediction)
            steps.append(prediction._replace(horizon=each.observe(prediction)))
            if as_before:
                each.go_back()
                returns += [number]
        twins_own = steps.pop()
        np.testing.assert_array_equal(steps[-1].mean, twins_own.mean)
    (place, _) = returns  # of the model and its twin, all members at once
    assert place > 0
    assert all(step.horizon is None for step in steps[place + 1:place + 5]), 'none is pending'
    offset = np.abs(steps[place + 1].mean - steps[place + 1].model_mean)
    assert (offset < 0.1 * load).all(), 'what followed the errors of the other model is forgotten'
    assert (error(steps[COUNT // 2:]) < 0.3 * load**2).all() and steps[-1].horizon is not None


def test_horizons_of_features_that_a_change_falls_into_are_dropped(averaged):
    """They went on with a Theta that was not the one of their models."""
    samples, model, _ = averaged
    model = pickle.loads(pickle.dumps(model))
    model.clear_horizons()
    shift = int(samples.stamps[-1] - samples.stamps[0] + 10**7)
    steps = []
    for number, sample in enumerate(samples[:20]):
        if number == 10:
            model.follow_change()
        steps.append(model.step(sample._replace(stamp=sample.stamp + shift)))
    known = [False] * 4 + [True] * 6 + [not model.features_count] * 4 + [True] * 6
    assert [step.horizon is not None for step in steps] == known
