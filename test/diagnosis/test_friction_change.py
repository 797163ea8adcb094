"""Friction of a joint that changes within a recording is told, beside the one value that the search has for it."""

import re
from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.friction_change import friction_changes
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.stepwise import starting_fit
from semiparam_ros.effects.base import Span
from semiparam_ros.effects.friction import CoulombFriction, ViscousFriction
from support.arms import ODD_BODY, ODD_JOINTS, icub, noisy, smooth_motion

COUNT, TURN = 1500, 0.02
EVERYTHING = np.ones(COUNT, dtype=bool)


def rubbing(times=1.0, joint=1, seed=0, before=1.0):
    """Dry friction of 3 and viscous of 1 at all joints, at one so many times as large from .6 of the time on."""
    motion = smooth_motion(4, COUNT, seed=seed, speed=0.5)
    friction = 3.0 * np.tanh(motion.velocity / TURN) + motion.velocity
    friction[int(0.6 * COUNT):, joint] *= times
    friction[:int(0.6 * COUNT), joint] *= before
    exact = ODD_BODY.regressors(motion) @ ODD_BODY.base_parameters + friction
    return replace(motion, outputs=noisy(exact, 0.01, seed=seed), whole=True)


def found(samples):
    """What is told beside the model with dry friction alone."""
    effects = [CoulombFriction(joint, {'turn_speed': TURN}) for joint in ODD_JOINTS]
    return friction_changes(declare(starting_fit(ODD_BODY, samples, [], EVERYTHING), effects), [''])


@pytest.mark.parametrize(('times', 'joint'), [(2.0, 1), (0.5, 3), (1.3, 0)])
def test_a_joint_whose_friction_changes_is_told_with_the_time_and_both_values(times, joint):
    samples = rubbing(times, joint)
    (sentence,) = found(samples)
    place, seconds = re.match(r'The friction of (\w+) changes at ([\d.]+) s', sentence).groups()
    assert place == ODD_JOINTS[joint] and float(seconds) == pytest.approx(samples.time[int(0.6 * COUNT)], abs=0.1)
    for name, value in (('coulomb', 3.0), ('viscous', 1.0)):
        before, since = map(float, re.search(rf'{name} (\S+) \S.*? before and (\S+) since', sentence).groups())
        assert before == pytest.approx(value, rel=0.1) and since == pytest.approx(times * value, rel=0.1)
    usual, with_both = map(float, re.search(r'errors of (\S+) .* fall to (\S+)\.$', sentence).groups())
    assert with_both < 0.5 * usual


@pytest.mark.parametrize('seed', range(5))
def test_friction_that_stays_is_no_change(seed):
    assert found(rubbing(seed=seed)) == []


def test_friction_that_is_declared_from_a_time_on_is_left_alone():
    samples = rubbing(before=0.0)
    late = Span(start_s=float(samples.time[int(0.6 * COUNT)]))
    declared = [kind('turn', values, span=late) for kind, values in
                ((ViscousFriction, {}), (CoulombFriction, {'turn_speed': TURN}))]
    known = [CoulombFriction(joint, {'turn_speed': TURN}) for joint in ODD_JOINTS if joint != 'turn']
    fit = declare(starting_fit(ODD_BODY, samples, declared, EVERYTHING), known)
    assert friction_changes(fit, ['']) == []


def test_of_a_wrench_no_joint_rubs():
    body = icub()
    samples = smooth_motion(len(body.joints), COUNT)
    samples = replace(samples, outputs=noisy(body.regressors(samples) @ body.base_parameters, 0.01), whole=True)
    assert friction_changes(starting_fit(body, samples, [], EVERYTHING), ['']) == []


def test_a_diagnosis_tells_it():
    notes = diagnose(ODD_BODY, rubbing(2.0)).notes
    assert [note for note in notes if 'friction of turn changes at' in note], notes
