"""Standard deviations that are told, against the scatter of values over draws of what disturbs them."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.findings import declared_findings
from semiparam_ros.diagnosis.named_change import Quantity
from semiparam_ros.diagnosis.preparation import Inputs
from semiparam_ros.diagnosis.regression import fit_model, refit_weights
from semiparam_ros.diagnosis.search.refit import fitted_to_all
from semiparam_ros.diagnosis.text_report import quantity_text
from semiparam_ros.diagnosis.uncertainty import estimates
from semiparam_ros.effects import kinds
from semiparam_ros.effects.base import Span
from support.arms import ODD_ARM, ODD_BODY, ODD_JOINTS, noisy, smooth_motion

BODY = ODD_BODY
MOTION = smooth_motion(4, 1500, seed=2, speed=0.5)
EXACT = BODY.regressors(MOTION) @ BODY.base_parameters
VISCOUS, GAIN, DRAWS = 0.3, 0.1, 20


def white(rng):
    return rng.standard_normal(EXACT.shape)


def of_the_motion(rng):
    """Noise that grows with the joints' speed."""
    return rng.standard_normal(EXACT.shape) * np.abs(MOTION.velocity) / np.abs(MOTION.velocity).mean(axis=0)


def of_the_law(rng):
    """A friction that differs from stretch to stretch."""
    return np.repeat(rng.standard_normal((20, 4)), len(EXACT) // 20, axis=0) * MOTION.velocity


def told(disturbance, joint, viscous=VISCOUS):
    """How far a friction is off, and the standard deviation that is told, with efforts disturbed by a hundredth and one
    of another ``joint``, or of the same, read with a gain."""
    friction = np.zeros_like(EXACT)
    friction[:, 1] = viscous * MOTION.velocity[:, 1]
    gains = np.where(np.arange(4) == joint, 1.0 + GAIN, 1.0)
    small = 0.01 * EXACT.std(axis=0) / disturbance.std(axis=0)
    samples = replace(MOTION, outputs=(EXACT + friction) * gains + disturbance * small)
    effects = [kinds()['viscous_friction'](BODY.joints[1]), kinds()['effort_gain'](BODY.joints[joint], {'gain': GAIN})]
    start = refit_weights(fit_model(BODY, samples, effects, np.ones(len(samples), dtype=bool), np.ones(4)))
    fit = fitted_to_all(start, start.train_mask, [])
    value, std = estimates(fit, [0]).coefficients[:, -1]
    return value - viscous, std


@pytest.mark.parametrize('disturbed, joint, viscous', [
    (white, 2, VISCOUS), (white, 1, VISCOUS), (white, 1, 100.0 * VISCOUS), (of_the_motion, 2, VISCOUS),
    (of_the_law, 2, VISCOUS)])
def test_deviations_are_as_large_as_the_scatter_of_the_values(disturbed, joint, viscous):
    """The model's own covariance gives two thirds of it where noise or a law differs from stretch to stretch. Beside a
    gain of its own joint a friction was told as the efforts read it, a tenth too large, and as sure as without one."""
    rng = np.random.default_rng(1)
    off, std = np.array([told(disturbed(rng), joint, viscous) for _ in range(DRAWS)]).T
    assert 0.6 < np.sqrt(np.mean(off**2) / np.mean(std**2)) < 1.25


def test_a_zero_that_no_sample_shows_is_as_unsure_as_beforehand():
    """Turned inertias explain the last joint's: it was told to 1e-10 rad."""
    samples = replace(MOTION, outputs=EXACT + 0.01 * EXACT.std(axis=0) * white(np.random.default_rng(0)))
    zeros = [kinds()['joint_offset'](joint, {'offset': 0.0}) for joint in ('elbow', 'grip')]
    fit = refit_weights(fit_model(BODY, samples, zeros, np.ones(len(samples), dtype=bool), np.ones(4)))
    (seen,), (unseen,) = (values[1] for values in estimates(fit, []).calibrations.values())
    assert 1e-4 < seen < 0.01 and unseen == zeros[1].calibration_scale(BODY)
    assert quantity_text(Quantity(-1e-5, unseen, 'rad')) == '0.00 +- 0.10 rad'


def test_a_declared_zero_that_no_sample_shows_stays_as_it_was_declared():
    """It went to zero as soon as anything was settled."""
    zeros = [kinds()['joint_offset'](joint, {'offset': 0.03}) for joint in ('elbow', 'grip')]
    fit = fit_model(BODY, replace(MOTION, outputs=EXACT), zeros, np.ones(len(MOTION), dtype=bool), np.ones(4))
    seen, unseen = fitted_to_all(refit_weights(fit), fit.train_mask, ()).effects
    assert abs(seen.value('offset')) < 1e-5 and unseen.value('offset') == pytest.approx(0.03, abs=1e-6)


def test_what_errors_of_a_smoothed_motion_shift_is_taken_off_and_counts_as_a_deviation():
    """They make every spring too soft here, by 2 of the deviations that outputs alone give; a quarter of that stays."""
    truth, inputs = smooth_motion(4, 1500, rate=20.0, seed=2, speed=0.6), Inputs('smoothed more', 1)
    exact, used = BODY.regressors(truth) @ BODY.base_parameters, inputs.mask(np.ones(len(truth), dtype=bool))
    told = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        seen = replace(truth, position=truth.position + 3e-3 * white(rng), velocity=truth.velocity + 5e-2 * white(rng),
                       acceleration=np.zeros_like(exact), outputs=exact + 1e-4 * exact.std(axis=0) * white(rng))
        spring = kinds()['joint_spring'](BODY.joints[3])
        fit = refit_weights(fit_model(BODY, inputs.prepare(seen), [spring], used, np.ones(4)))
        stiffness = fit.assembly.blocks['0'].start
        told.append([estimates(fit, [0], disturbed).coefficients[:, stiffness]
                     for disturbed in ((), inputs.disturbed(seen))])
    (before, after), (narrow, wide) = np.sqrt(np.mean(np.square(told), axis=0)).T
    assert before > 1.5 * narrow
    assert after < 0.4 * before and after < wide < 2.5 * narrow


def test_a_calibration_and_what_it_cannot_be_told_from_have_deviations():
    """With the gains of all joints open, the direction that the masses hold already counts as known."""
    effects = [kinds()['effort_gain'](joint, {'gain': GAIN}) for joint in BODY.joints]
    samples = replace(MOTION, outputs=EXACT * (1.0 + GAIN) + 0.01 * white(np.random.default_rng(2)))
    sure = estimates(fit_model(BODY, samples, effects, np.ones(len(samples), dtype=bool), np.ones(4)), ())
    assert list(sure.calibrations) == [0, 1, 2, 3]
    assert all(0.0 < float(std[0]) < 10.0 for _, std in sure.calibrations.values())


def test_gains_of_a_wrench_are_as_uncertain_as_the_channel_that_counts_as_right():
    """The median channel does, which is a torque here; without it forces were told five standard deviations off."""
    body = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'wrench', 'tool')
    exact, used = body.regressors(MOTION) @ body.base_parameters, np.ones(len(MOTION), dtype=bool)
    rng = np.random.default_rng(3)
    noise = exact.std(axis=0) * [1e-4, 2e-4, 3e-4, 0.03, 0.03, 0.03]
    far = []
    for _ in range(DRAWS):
        samples = replace(MOTION, outputs=exact + noise * rng.standard_normal(exact.shape))
        start = refit_weights(fit_model(body, samples, [kinds()['sensor_gain']()], used, np.ones(6)))
        fit = fitted_to_all(start, used, [])
        gain = fit.effects[-1]
        far.append([gain.value(name) for name, _ in gain.calibrations] / estimates(fit, []).calibrations[0][1])
    assert 0.5 < np.sqrt(np.mean(np.square(far)[:, :3])) < 1.5


def test_gains_are_told_alike_whichever_recording_judges():
    """Where another one did they had the common gain of the search: the median channel's, right by definition, read
    0.97, and all of them were 17 of their deviations from what they are told otherwise."""
    body, read = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'wrench', 'tool'), np.array([1.1, 1.0, 1.3, 1.2, 0.9, 1.0])
    one, other = (replace(motion, outputs=read * noisy(body.outputs_of(motion, body.base_parameters)))
                  for motion in (smooth_motion(4, 900, seed=seed, speed=0.5) for seed in (1, 2)))
    for judge in (None, ('other', other)):
        found = diagnose(body, one, other=judge, only=['sensor_gain'])
        told, deviation = np.transpose([(each.value, each.std) for each in found.findings[0].parameters.values()])
        assert np.median(told) == pytest.approx(0.0, abs=1e-9)
        assert np.all(np.abs(told - (read / np.median(read) - 1.0)) < 5.0 * deviation)


def test_the_coefficients_of_a_declared_formula_are_told_as_they_were_fitted():
    """They were told as they were declared, without unit or deviation."""
    elbow = MOTION.position[:, BODY.joints.index('elbow')]
    outputs = EXACT + 0.3 * elbow[:, None]**3 * (np.array(BODY.joints) == 'elbow')
    samples = replace(MOTION, outputs=outputs + 0.01 * white(np.random.default_rng(0)))
    formula = kinds()['terms']('elbow', {'q_elbow^3': 0.2})
    fit = refit_weights(fit_model(BODY, samples, [formula], np.ones(len(samples), dtype=bool), np.ones(4)))
    (told,) = declared_findings(fit, [], estimates(fit, []))
    value, std, unit = vars(told.parameters['q_elbow^3']).values()
    assert unit == 'N m/rad^3' and 0.0 < std < 0.01 and abs(value - 0.3) < 4.0 * std


def test_values_of_efforts_are_told_where_joints_slide():
    """Where a joint is slow its friction is another one than the model holds: both were told five deviations off, with
    deviations thirteen times as large."""
    rng, dry, viscous = np.random.default_rng(4), 0.1 * float(EXACT[:, 1].std()), 0.3
    velocity = MOTION.velocity[:, 1]
    friction = np.zeros_like(EXACT)
    friction[:, 1] = dry * np.tanh((velocity / (0.03 * np.abs(velocity).max())) ** 3) + viscous * velocity
    samples = replace(MOTION, outputs=EXACT + friction + 3e-3 * EXACT.std(axis=0) * rng.standard_normal(EXACT.shape))
    effects = [kinds()['coulomb_friction'](BODY.joints[1], {'turn_speed': 1e-4}),
               kinds()['viscous_friction'](BODY.joints[1])]
    fit = refit_weights(fit_model(BODY, samples, effects, np.ones(len(samples), dtype=bool), np.ones(4)))
    values, stds = estimates(fit, []).coefficients[:, -2:]
    assert np.all(np.abs(values - [dry, viscous]) < 2.0 * stds)
    assert np.all(stds < [0.01 * dry, 0.02 * viscous])


def test_what_acts_only_where_its_joint_is_slow_is_told_by_the_samples_that_it_acts_in():
    """It was told as 0 with the deviation of its prior: none of its samples is one in which the joint slides."""
    rng, dry = np.random.default_rng(4), 0.1 * float(EXACT[:, 1].std())
    velocity, time = MOTION.velocity[:, 1], MOTION.time
    turn = int(np.flatnonzero(np.diff(np.sign(velocity[100:])))[0]) + 100
    pushed = (time >= time[turn - 1]) & (time < time[turn + 3])
    friction = np.zeros_like(EXACT)
    friction[:, 1] = dry * np.tanh((velocity / (0.03 * np.abs(velocity).max())) ** 3) + 10.0 * dry * pushed
    samples = replace(MOTION, outputs=EXACT + friction + 3e-3 * EXACT.std(axis=0) * rng.standard_normal(EXACT.shape))
    effects = [kinds()['coulomb_friction'](BODY.joints[1], {'turn_speed': 1e-4}),
               kinds()['effort_offset'](BODY.joints[1], span=Span(start_s=time[turn - 1], end_s=time[turn + 3]))]
    fit = refit_weights(fit_model(BODY, samples, effects, np.ones(len(samples), dtype=bool), np.ones(4)))
    values, stds = estimates(fit, []).coefficients[:, -2:]
    assert stds[0] < 0.01 * dry, 'told where joints slide'
    assert values[1] == fit.theta[-1] == pytest.approx(10.0 * dry, rel=0.1) and stds[1] < dry


def test_an_output_that_counts_from_later_on_scatters_in_its_own_stretches_alone():
    """The first stretch, which it does not count in, had the sum of all: deviations were up to 45 % too large."""
    rng, counted = np.random.default_rng(4), np.ones(EXACT.shape, dtype=bool)
    counted[:100, 1] = False
    samples = replace(MOTION, outputs=EXACT + 0.01 * EXACT.std(axis=0) * of_the_motion(rng))
    used = np.ones(len(samples), dtype=bool)
    fit = refit_weights(fit_model(BODY, samples, [], used, np.ones(4), counted=counted))
    columns = fit.assembly.batch(samples)[0]
    covariance, pulls = fit.theta_covariance(), np.einsum(
        'nkp,nk->np', columns, counted * fit.residual / fit.scale**2)
    changes = np.array([part.sum(axis=0) for part in np.array_split(pulls, fit.config.blocks)]) @ covariance
    clustered = np.sqrt((changes**2).sum(axis=0) * fit.config.blocks / (fit.config.blocks - 1))
    repeated = sum((memory - 1.0) * rows.T @ rows / scale**2 for memory, rows, scale in zip(
        fit.correlation, [columns[use, k] for k, use in enumerate(counted.T)], fit.scale, strict=True))
    single = np.sqrt(np.diag(covariance + covariance @ repeated @ covariance))
    std = estimates(replace(fit, body=BODY), []).coefficients[1]
    np.testing.assert_allclose(std, np.maximum(single, clustered), rtol=1e-9)
