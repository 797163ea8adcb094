"""A load of known mass tells gains from masses."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.variants import VARIANTS
from semiparam_ros.diagnosis.data.recordings import during
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.text_report import text_report
from semiparam_ros.effects import effect_from_text, effect_to_text, kinds
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.simulation.scenario import Scenario
from semiparam_ros.simulation.simulate import simulate

GAINS = np.array([0.6, -0.3, 0.1, 0.25])
LOAD = np.array([0.4, 0.0, 0.01, 0.02, 1e-3, 0.0, 1e-3, 0.0, 0.0, 1e-3])


@pytest.fixture(scope='module')
def loaded():
    """The body; efforts in units of the motors' currents, without and with the load."""
    made = [simulate(Scenario(samples=600, outputs='effort', seed=seed, robot_seed=1, motion='mixed'))
            for seed in (1, 2)]
    body, (one, two) = body_of(made[0]), map(samples_of, made)
    added = kinds()['payload']('r_gripper').columns(body, two, None)[0] @ LOAD
    return body, [replace(one, outputs=(1.0 + GAINS) * one.outputs),
                  replace(two, outputs=(1.0 + GAINS) * (two.outputs + added))]


def test_a_load_of_known_mass_gives_the_gain_of_every_joint(loaded):
    body, recordings = loaded
    samples = Samples.joined(recordings)
    gains = [kinds()['effort_gain'](joint) for joint in body.joints]
    known = during(samples, 1, effect_from_text('payload@r_gripper{"mass": 0.4}'))
    found = diagnose(body, samples, [*gains, known], only=['joint_offset'])
    values = {finding.effect.where: finding.parameters for finding in found.declared}
    assert values['r_gripper']['mass'].value == pytest.approx(0.4, abs=1e-4)
    for joint, gain in zip(body.joints, GAINS, strict=True):
        fitted = values[joint]['gain']
        assert fitted.std < 0.03
        assert fitted.value == pytest.approx(gain, abs=4.0 * fitted.std)
    lines = text_report(found)
    assert any(line.startswith('Declared: effort_gain at r_elbow (gain ') for line in lines)
    assert not any('one and the same freedom' in line for line in lines)
    blind = replace(found, final=replace(found.final, effects=tuple(
        replace(effect, parameters={}) if effect.is_load else effect for effect in found.final.effects)))
    assert any('one and the same freedom' in line for line in text_report(blind))


def test_declared_values_of_a_load_are_kept_and_the_others_are_learnt(loaded):
    body, (_, samples) = loaded
    effect = effect_from_text('payload@r_gripper{"mass": 0.4, "first_moment_z": 0.02}')
    assert effect_from_text(effect_to_text(effect)) == effect and effect.searched == ()
    assembly = CoupledColumns(body, [effect])
    np.testing.assert_array_equal(assembly.known[:4], [0.4, 0.0, 0.0, 0.02])
    for variant in VARIANTS:
        estimator = Estimator(body, ModelOptions(variant, features_count=20, initial_samples=100), [effect])
        for sample in samples[:200]:
            estimator.step(sample)
        learnt = estimator.model.theta[-10:]
        np.testing.assert_allclose(learnt[[0, 3]], [0.4, 0.02], rtol=1e-3, err_msg=variant)


def test_a_gain_multiplies_what_a_load_adds(loaded):
    body, (samples, _) = loaded
    load, gain = effect_from_text('payload@r_gripper'), effect_from_text('effort_gain@r_elbow{"gain": 0.5}')
    plain, _ = CoupledColumns(body, [load]).batch(samples[:5])
    for effects in ([load, gain], [gain, load]):
        shaped, _ = CoupledColumns(body, effects).batch(samples[:5])
        np.testing.assert_allclose(shaped, plain * np.array([1.0, 1.0, 1.0, 1.5])[:, None])
