"""Terms of a formula as an effect: a closed grammar, columns, units, and the way through parameters."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.effects import effect_from_text, effect_to_text, kinds
from semiparam_ros.effects.base import Span
from semiparam_ros.effects.terms import Terms, parse_term, term_unit, term_values
from semiparam_ros.errors import SemiparamError
from support.arms import ODD_BODY, icub, smooth_motion

MOTION = smooth_motion(4, 50)
ELBOW = MOTION.position[:, 3], MOTION.velocity[:, 3]


@pytest.mark.parametrize(('term', 'values'), [
    ('q_r_elbow', ELBOW[0]), ('q_r_elbow^3', ELBOW[0] ** 3), ('sin(q_r_elbow)', np.sin(ELBOW[0])),
    ('dq_r_elbow*abs(dq_r_elbow)', ELBOW[1] * np.abs(ELBOW[1])), ('sign(dq_r_elbow)', np.sign(ELBOW[1])),
    ('time*cos(q_r_elbow)', MOTION.time * np.cos(ELBOW[0])), ('time^2 * ddq_r_elbow',
                                                              MOTION.time**2 * MOTION.acceleration[:, 3]),
    ('bump(q_r_elbow,-0.5,2e-1)', np.exp(-0.5 * ((ELBOW[0] + 0.5) / 0.2) ** 2))])
def test_terms_are_what_they_are_called(term, values):
    np.testing.assert_allclose(term_values(term, icub(), MOTION), values, rtol=1e-14)


@pytest.mark.parametrize('term', [
    '', 'q', 'q_', 'x_r_elbow', 'sin(sin(q_r_elbow))', 'exp(q_r_elbow)', 'q_r_elbow^9', 'q_r_elbow^-1', 'q_r_elbow**2',
    'bump(q_r_elbow,1)', 'bump(q_r_elbow,0,0)', 'bump(q_r_elbow,nan,1)', '__import__("os")', 'q_r_elbow;time', '2*time',
    'time*time*time*time*time', 'sin(q_r_elbow', 'q_r_elbow\n', 'bump(q_r_elbow,1e999,1)'])
def test_what_is_outside_the_grammar_is_refused(term):
    with pytest.raises(SemiparamError, match='term'):
        parse_term(term)


@given(st.text(max_size=40))
def test_no_text_does_anything_but_parse_or_refuse(text):
    try:
        factors = parse_term(text)
    except SemiparamError:
        return
    assert 1 <= len(factors) <= 4


def test_columns_stand_in_their_channel_alone_and_begin_when_they_should():
    effect = Terms('tz', {'sin(q_r_elbow)': 1.0, 'dq_r_elbow': -2.0}, span=Span(1.0))
    columns = effect.columns(icub(), MOTION, None)[0]
    assert columns.shape == (50, 6, 2) and not columns[:, :5].any()
    np.testing.assert_array_equal(columns[:, 5, 1], np.where(MOTION.time >= 1.0, ELBOW[1], 0.0))


def test_an_effect_goes_through_the_parameter_and_back():
    effect = Terms('r_elbow', {'bump(q_r_elbow,0.25,0.1)': 1.5, 'time*dq_r_elbow': -2e-3})
    assert effect_from_text(effect_to_text(effect)) == effect
    with pytest.raises(SemiparamError, match='sqrt'):
        effect_from_text('terms@fx{"sqrt(time)": 1}')


def test_units_divide_the_channel_by_the_term():
    body = icub()
    units = {'q_r_elbow': 'N/rad', 'dq_r_elbow^2': 'N s^2/rad^2', 'sin(q_r_elbow)': 'N', 'time*dq_r_elbow': 'N/rad',
             'time': 'N/s', 'time*ddq_r_elbow': 'N s/rad', 'time*q_r_elbow': 'N/(s rad)'}
    assert {term: term_unit(term, body, 0) for term in units} == units
    assert term_unit('dq_lift*abs(dq_lift)', ODD_BODY, 1) == 'N m s^2/m^2'


def test_a_declared_formula_is_learnt():
    body = icub()
    effect = Terms('fy', {'bump(q_r_elbow,0.2,0.3)': 0.5, 'dq_r_shoulder_yaw': 0.2})
    columns, _ = CoupledColumns(body, [effect]).batch(MOTION)
    truth = np.concatenate([body.base_parameters, np.ones(6), [0.7, -0.3]])
    outputs = columns @ truth
    rows = columns.reshape(-1, len(truth))
    found = np.linalg.lstsq(rows, outputs.ravel(), rcond=1e-12)[0]
    np.testing.assert_allclose(found[-2:], [0.7, -0.3], rtol=1e-5)
    np.testing.assert_allclose(effect.prior_scale(body), [5.0, 2.0])


def test_unknown_joints_and_channels_are_named():
    with pytest.raises(SemiparamError, match=r"'l_elbow'.*r_elbow"):
        Terms('fx', {'q_l_elbow': 1.0}).columns(icub(), MOTION, None)
    for where in (None, 'r_hand'):
        with pytest.raises(SemiparamError, match='expected terms@CHANNEL'):
            Terms(where, {'q_r_elbow': 1.0}).coefficients(icub())


def test_a_search_does_not_try_it():
    assert kinds('wrench')['terms'] is Terms and list(Terms.places(icub())) == []
    assert dataclasses.replace(Terms('fx', {'time': 1.0}), where='fy').where == 'fy'
