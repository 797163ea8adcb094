"""Variants averaged by their evidence: the weights, the mixture, and members that are as each would be alone."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from semiparam_ros.core.averaged_estimator import (
    DEGREES,
    EVIDENCE_MEMORY,
    LEAST_LOG_WEIGHT,
    VariantWeights,
    estimator_of,
    mixture,
    mixture_covariance,
)
from semiparam_ros.core.estimator import ModelOptions
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.variants import AVERAGED, MEMBERS
from semiparam_ros.errors import SemiparamError
from support.arms import ODD_ARM, ODD_JOINTS, smooth_motion

WINDOW, COUNT = 60, 260
ARM = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'effort')


def recording(unmodelled):
    rng = np.random.default_rng(3)
    motion = smooth_motion(ARM.n_joints, COUNT, seed=3)
    outputs = ARM.regressors(motion) @ ARM.base_parameters
    outputs += unmodelled * outputs.std(axis=0) * np.sin(3.0 * motion.position)
    return replace(motion, outputs=outputs + 0.02 * outputs.std(axis=0) * rng.standard_normal(outputs.shape))


def begun(variant, samples):
    model = estimator_of(ARM, ModelOptions(variant=variant, features_count=30, initial_samples=WINDOW, horizon=4))
    return model, [model.step(sample) for sample in samples]


@pytest.fixture(scope='module', params=[0.0, 0.5])
def averaged(request):
    samples = recording(request.param)
    return samples, *begun(AVERAGED, samples)


def error(predictions):
    late = [each for each in predictions if each.ready]
    return np.mean([(each.sample.outputs - each.mean) ** 2 for each in late], axis=0)


def test_weights_are_forgotten_evidence():
    rng = np.random.default_rng(0)
    errors, std = 0.3 * rng.standard_normal((40, 3, 2)), rng.uniform(0.9, 1.1, (40, 3, 2))
    weights, evidence = VariantWeights(3, 2), np.zeros((3, 2))
    for index in range(40):
        weights.learn(errors[index], std[index])
        evidence = (1.0 - 1.0 / EVIDENCE_MEMORY) * evidence
        evidence += student.logpdf(errors[index] / std[index], DEGREES) - np.log(std[index])
    assert np.ptp(evidence, axis=0).max() < -LEAST_LOG_WEIGHT, 'the floor is another test'
    expected = np.exp(evidence - evidence.max(axis=0))
    np.testing.assert_allclose(weights.weights, expected / expected.sum(axis=0), rtol=1e-9)


@pytest.mark.parametrize('scale', [1e-150, 1.0, 1e150])
def test_weights_stay_finite_and_the_last_takes_over_within_a_few_samples(scale):
    weights = VariantWeights(2, 1)
    good, poor = np.array([[0.5], [8.0]]), np.array([[8.0], [0.5]])
    for _ in range(20000):
        weights.learn(scale * good, np.full((2, 1), scale))
    assert weights.weights[0, 0] == pytest.approx(1.0 / (1.0 + np.exp(LEAST_LOG_WEIGHT)))
    for _ in range(3):
        weights.learn(scale * poor, np.full((2, 1), scale))
    assert np.isfinite(weights.weights).all() and weights.weights[1, 0] > 0.9


def test_mean_and_variance_are_those_of_the_mixture():
    rng = np.random.default_rng(1)
    weights, means = np.array([[0.7, 0.7], [0.3, 0.3]]), rng.standard_normal((2, 2))
    roots = [np.array([[1.0, 0.0], [0.8, 1.2]]), np.array([[0.5, 0.0], [-0.1, 1.0]])]
    std = np.sqrt([np.diag(root @ root.T) for root in roots])
    chosen = rng.random(400000) < 0.7
    draws = np.where(chosen[:, None], *(mean + rng.standard_normal((400000, 2)) @ root.T
                                        for mean, root in zip(means, roots, strict=True)))
    mean, found = mixture(weights, means, std)
    np.testing.assert_allclose(mean, draws.mean(axis=0), atol=0.02)
    covariance = mixture_covariance(weights, means, [root @ root.T for root in roots])
    np.testing.assert_allclose(covariance, np.cov(draws.T), atol=0.03)
    np.testing.assert_allclose(found**2, np.diag(covariance), rtol=1e-12)


def test_each_member_is_as_it_would_be_alone_and_the_average_no_worse_than_the_best(averaged):
    samples, _, predictions = averaged
    errors = []
    for index, name in enumerate(MEMBERS):
        _, alone = begun(name, samples)
        errors.append(error(alone))
        for one, other in zip(alone[WINDOW:], predictions[WINDOW:], strict=True):
            np.testing.assert_array_equal(one.mean, other.members[index].mean)
            np.testing.assert_array_equal(one.std, other.members[index].std)
    ratio = error(predictions) / samples.outputs.var(axis=0)
    assert ratio.mean() < 1.02 * (errors / samples.outputs.var(axis=0)).mean(axis=1).min()
    assert not predictions[WINDOW - 1].members and len(predictions[WINDOW].members) == len(MEMBERS)


def test_a_state_goes_on_as_it_was_with_the_hyperparameters_of_every_member(averaged):
    samples, model, _ = averaged
    model = pickle.loads(pickle.dumps(model))
    mean, scale = model.input_scaling
    twin = estimator_of(ARM, replace(model.options, hyperparameters=model.model.hyperparameters,
                                     input_mean=tuple(mean), input_scale=tuple(scale)))
    twin.restore(pickle.loads(pickle.dumps(model.state())))
    assert twin.others == model.others and set(twin.weights) == set(MEMBERS)
    for sample in samples[:12]:
        one, other = model.step(sample), twin.step(sample)
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.std, other.std)
        np.testing.assert_array_equal(one.horizon.eps, other.horizon.eps)
    unready, _ = begun(AVERAGED, samples[:5])
    for kept, state in ((unready, model.state()), (model, begun('SPK-ML', samples)[0].state())):
        with pytest.raises(SemiparamError, match='the saved average'):
            kept.restore(state)
    with pytest.raises(SemiparamError, match='the saved weights of the variants'):
        model.restore(model.state()._replace(average={**model.state().average, 'shares': np.zeros(3)}))


def test_a_desired_state_is_answered_as_a_sample_with_these_inputs(averaged):
    samples, model, _ = averaged
    sample = samples[COUNT // 2]
    predicted, desired = model.predict(sample), model.predict_desired(*sample[1:4])
    np.testing.assert_allclose(desired.shown, predicted.mean, rtol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(desired.covariance)), predicted.std, rtol=1e-9)
    np.testing.assert_array_equal(desired.shown, desired.needed)


def test_one_sample_that_no_member_can_foresee_decides_nothing(averaged):
    samples, model, _ = averaged
    model = pickle.loads(pickle.dumps(model))
    before = np.array(list(model.weights.values()))
    sample: Sample = samples[COUNT // 2]
    model.step(sample._replace(outputs=sample.outputs + 1e6))
    assert np.abs(np.array(list(model.weights.values())) - before).max() < 0.9
    assert all(np.isfinite(values).all() for values in model.weights.values())


def test_members_return_from_a_change_with_their_horizons_and_a_state_holds_what_was_before(averaged, monkeypatch):
    monkeypatch.setattr('semiparam_ros.core.recursion.KEPT', 20.0)
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
    for sample in later[COUNT:]:
        steps.append(model.step(sample))
        returns.append(model.returns)
        np.testing.assert_array_equal(steps[-1].mean, twin.step(sample).mean)
    assert returns[0] == 0 and model.returns >= len(MEMBERS)
    for place in np.flatnonzero(np.diff(returns)) + 1:
        assert all(step.horizon is None for step in steps[place + 1:place + 5]), 'none is pending'
    assert (error(steps[COUNT // 2:]) < 0.3 * load**2).all() and steps[-1].horizon is not None
