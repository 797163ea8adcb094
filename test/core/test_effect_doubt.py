"""Declared effects are believed as far as what comes speaks for them."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.effect_doubt import MOST_EVIDENCE, EffectDoubt
from semiparam_ros.core.estimator import Estimator, ModelOptions
from semiparam_ros.effects import effect_from_text
from semiparam_ros.errors import SemiparamError
from support.arms import icub, smooth_motion

WINDOW, COUNT, START = 100, 220, 160
BODY = icub()


def recording(load=0.0):
    """With a load [kg] from ``START`` on."""
    motion = smooth_motion(BODY.n_joints, COUNT, seed=2)
    outputs = BODY.regressors(motion) @ (1.1 * BODY.base_parameters)
    carried = load * payload(motion).columns(BODY, motion, None)[0][:, :, 0]
    noise = 0.02 * outputs.std(axis=0) * np.random.default_rng(0).standard_normal(outputs.shape)
    return replace(motion, outputs=outputs + carried + noise)


def payload(samples):
    return effect_from_text(f'payload@r_gripper{{"start_s": {float(samples.time[START])}}}')


def estimator(variant, effects=(), **options):
    return Estimator(BODY, ModelOptions(**({'variant': variant, 'features_count': 40, 'initial_samples': WINDOW,
                                            'horizon': 5} | options)), effects)


@pytest.mark.parametrize(('variant', 'forgetting'), [('P', 'auto'), ('SPK-ML', 'auto'), ('SPK-ML', 1.0),
                                                     ('SP-ML', 'auto'), ('NP-ML', 0.99)])
def test_one_recursion_holds_the_model_without_effects_too(variant, forgetting):
    samples = recording()
    first = estimator(variant)
    for sample in samples[:WINDOW]:
        first.step(sample)
    mean, scale = map(tuple, first.input_scaling)
    given = {'hyperparameters': first.hyperparameters(), 'input_mean': mean, 'input_scale': scale,
             'forgetting': forgetting}
    plain, doubting = estimator(variant, **given), estimator(variant, [payload(samples)], **given)
    size = samples.outputs.std(axis=0)
    for sample in samples:
        expected, found = plain.step(sample), doubting.step(sample).prior.beside
        np.testing.assert_allclose(found[2] / size, expected.model_mean / size, atol=1e-8)
        np.testing.assert_allclose(found[3], expected.model_std, rtol=1e-8)


@pytest.mark.parametrize('variant', ['P', 'SP-ML', 'SPK-ML'])
def test_a_load_is_believed_within_a_few_samples(variant):
    samples = recording(load=0.3)
    plain, doubting = estimator(variant), estimator(variant, [payload(samples)])
    left = np.array([[sample.outputs - each.step(sample).mean for each in (plain, doubting)] for sample in samples])
    assert doubting.doubt.probability > 0.999
    error = np.sqrt(np.mean(np.square(left / samples.outputs.std(axis=0)), axis=2))
    assert error[START + 5:, 1].mean() < 0.5 * error[START + 5:, 0].mean()
    np.testing.assert_allclose(error[:START, 1], error[:START, 0], rtol=0.05)


def test_evidence_is_bounded_and_forgotten():
    doubt = EffectDoubt(2, wandering=False)
    before = doubt.probability
    ones = np.ones((2, 2))
    doubt.learn(np.array([[0.0, 0.0], [1.0, 1.0]]), ones)
    assert doubt.probability > before
    for _ in range(100):
        doubt.learn(np.array([[9.0, 9.0], [0.0, 0.0]]), ones)
    assert doubt.evidence[0] == -MOST_EVIDENCE and 0.0 < doubt.probability < before
    for _ in range(5000):
        doubt.learn(ones, ones)
    assert doubt.probability == pytest.approx(before, abs=1e-4)


@pytest.mark.parametrize('state', [{}, {'evidence_of_effects': np.array([np.nan])},
                                   {'evidence_of_effects': np.array([1e3])}, {'evidence_of_effects': np.zeros(2)},
                                   {'evidence_of_effects': np.zeros(1), 'without_effects': np.zeros((2, 2))}])
def test_a_state_that_cannot_be_one_is_refused(state):
    doubt = EffectDoubt(6, wandering=True)
    with pytest.raises(SemiparamError, match=r'evidence of the effects|wandering offset'):
        doubt.restore(state)
    assert doubt.evidence[0] == 0.0
