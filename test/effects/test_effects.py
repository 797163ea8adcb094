"""Effects: one check that every kind passes at every place, their text form, kinds of other packages, and physics.

The physics is checked against the simulator, which shares no code with the effects: columns times the true parameters
must be the difference that the hidden cause makes there.
"""

import importlib
import math
import re
import sys
import textwrap
from dataclasses import replace
from functools import cache
from itertools import permutations, product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.frames import nearest_link, observed_links
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.small_turns import SmallTurns
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.diagnosis.regression import Fit, fit_model
from semiparam_ros.diagnosis.search.candidates import added_columns
from semiparam_ros.effects import Effect, effect_from_text, effect_to_text, effects_to_parameters, kinds, registry
from semiparam_ros.effects.application_point import AtPoint
from semiparam_ros.effects.base import CHANNELS, Coefficient, Span
from semiparam_ros.effects.friction import MOST_PRESLIDING, JointEffect
from semiparam_ros.effects.geometry import BaseShift, GravityTilt, JointOffset, ZeroSlip
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.export.estimate import from_recording
from semiparam_ros.simulation.causes.forces import PAYLOAD_RADIUS_M
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate
from support import arms
from support.arms import TWO_ARMS, TWO_ARMS_JOINTS, icub, smooth_motion
from support.effect_cases import BODIES, CASES, MOTION, NAMES

UNITS = {'N', 'm', 'kg', 's', 'rad', 'Hz', 'K', 'or'}
START_S = 1.0
SMALL, TURN = 0.01, 0.002
UNSEEN = ('joint_offset', 'lift')
"""No effort tells where a sliding joint stands on the fixed base."""


@pytest.mark.parametrize(('outputs', 'effect'), CASES, ids=NAMES)
def test_every_kind_at_every_place(outputs, effect):
    check_effect(BODIES[outputs], effect)


def check_effect(body: RigidBody, effect: Effect) -> None:
    """Whatever every effect must satisfy; those of other packages too."""
    for check in (check_text_form, check_sentences, check_coefficients, check_live_equals_offline,
                  check_late_and_uneven, check_start, check_neutral_calibration, check_candidate_columns,
                  check_carried_shapes_have_units):
        check(body, effect)


def check_text_form(body: RigidBody, effect: Effect) -> None:
    back = effect_from_text(effect_to_text(effect))
    assert back == effect
    assert type(back) is type(effect)


def check_sentences(body: RigidBody, effect: Effect) -> None:
    for text in (effect.sentence, effect.separated_by):
        assert len(text) > 10
        assert not text.endswith('.')  # it is put into a longer sentence
    assert effect.mistaken_for or effect.kind == 'terms'
    assert set(effect.mistaken_for) <= set(kinds()) - {effect.kind}
    assert not effect.mistaken_for or any(body.outputs in kinds()[name].outputs for name in effect.mistaken_for)


def check_coefficients(body: RigidBody, effect: Effect) -> None:
    named = [*effect.coefficients(body), *effect.calibrations]
    assert len({name for name, _ in named}) == len(named) > 0
    columns, _ = effect.columns(body, MOTION, None)
    assert len(effect.coefficients(body)) == columns.shape[2] == len(effect.prior_scale(body))
    assert (effect.prior_scale(body) > 0).all()
    assert effect.is_calibration == (columns.shape[2] == 0)
    for name, unit in named:
        assert set(re.findall('[A-Za-z]+', unit)) <= UNITS, f'{name} [{unit}]'


def one_by_one(assembly: CoupledColumns, samples: Samples) -> np.ndarray:
    """Columns (N, n, p) as a node computes them, a sample at a time."""
    memory, rows = None, []
    for sample in samples:
        row, memory = assembly.one(sample, samples.origin, memory)
        rows.append(row)
    return np.array(rows)


def check_live_equals_offline(body: RigidBody, effect: Effect) -> None:
    """Columns of one sample at a time, or of pieces, are those of the whole recording."""
    moved = disturbed(effect)
    assembly = CoupledColumns(body, [moved])
    expected, _ = assembly.batch(MOTION)
    assert expected.shape == (len(MOTION), body.n_outputs, assembly.n_columns)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(one_by_one(assembly, MOTION), expected, rtol=0, atol=1e-10 * scale)
    first, memory = assembly.batch(MOTION[:7])
    second, _ = assembly.batch(MOTION[7:], memory)
    np.testing.assert_allclose(np.concatenate([first, second]), expected, rtol=0, atol=1e-10 * scale)


def check_start(body: RigidBody, effect: Effect) -> None:
    """Columns are zero before the start, and from there on what they always were."""
    always, _ = effect.columns(body, MOTION, None)
    late, _ = effect.with_values(start_s=START_S).columns(body, MOTION, None)
    begun = MOTION.time >= START_S
    assert np.isfinite(always).all()
    np.testing.assert_array_equal(late[~begun], 0.0)
    np.testing.assert_array_equal(late[begun], always[begun])


def check_neutral_calibration(body: RigidBody, effect: Effect) -> None:
    """A calibration of zero changes nothing, one that is not zero does; a kind with columns leaves the arm alone."""
    plain, _ = CoupledColumns(body).batch(MOTION)
    scale = np.abs(plain).max()
    zero = effect.with_values(**dict.fromkeys((name for name, _ in effect.calibrations), 0.0))
    found, _ = CoupledColumns(body, [zero]).batch(MOTION)
    np.testing.assert_allclose(found[:, :, :plain.shape[2]], plain, rtol=0, atol=1e-10 * scale)
    if effect.is_calibration and (effect.kind, effect.where) != UNSEEN:
        changed, _ = CoupledColumns(body, [disturbed(effect)]).batch(MOTION)
        assert np.abs(changed - plain).max() > 1e-5 * scale


@cache
def fit_of(body: RigidBody) -> Fit:
    """The rigid body alone, fitted to what it predicts."""
    exact = replace(MOTION, outputs=body.regressors(MOTION) @ body.base_parameters)
    return fit_model(body, exact, [], np.ones(len(MOTION), dtype=bool), np.ones(body.n_outputs))


def check_candidate_columns(body: RigidBody, effect: Effect) -> None:
    """What a diagnosis would regress on: finite, one for each unknown, and none of them empty in general motion."""
    columns = added_columns(fit_of(body), effect)
    assert columns.shape == (len(MOTION), body.n_outputs, len(effect.coefficients(body)) or len(effect.calibrations))
    assert np.isfinite(columns).all()
    assert np.abs(columns).max() > 0.0 or (effect.kind, effect.where) == UNSEEN


def check_carried_shapes_have_units(body: RigidBody, effect: Effect) -> None:
    assert effect.unit_of('start_s') == 's'
    columns = {name for name, _ in effect.coefficients(body)}
    for name in set(effect.searched) - columns:
        assert effect.unit_of(name), name
        assert set(re.findall('[A-Za-z]+', effect.unit_of(name))) <= UNITS, name


def disturbed(effect: Effect) -> Effect:
    """With calibrations that are not zero, each another one."""
    names = [name for name, _ in effect.calibrations]
    return effect.with_values(**{name: SMALL * (1 + 0.3 * index) for index, name in enumerate(names)})


def test_both_outputs_have_the_kinds_that_the_design_lists():
    both = {'payload', 'time_delay', 'joint_offset', 'gravity_tilt', 'external_force', 'periodic_disturbance',
            'terms', 'gear_coupling', 'velocity_filter', 'tool_exchange', 'base_shift', 'zero_slip', 'cable_spring'}
    assert set(kinds('wrench')) == both | {
        'sensor_offset', 'sensor_drift', 'thermal_drift', 'temperature_drift', 'sensor_gain', 'sensor_crosstalk',
        'sensor_misalignment', 'viscous_drag', 'quadratic_drag', 'cable_hysteresis'}
    assert set(kinds('effort')) == both | {
        'viscous_friction', 'coulomb_friction', 'stribeck_friction', 'asymmetric_friction', 'load_friction',
        'rotor_inertia', 'joint_spring', 'effort_offset', 'effort_gain', 'transmission_ripple', 'backlash',
        'common_gain', 'sensor_nonlinearity', 'temperature_friction'}


SPANS = ({}, {'start_s': START_S}, {'start_stamp_s': START_S}, {'start_s': START_S, 'end_s': 2 * START_S},
         {'end_stamp_s': START_S})


@pytest.mark.parametrize(('outputs', 'kind'), [(outputs, kind) for outputs in BODIES for kind in kinds(outputs)])
def test_every_kind_is_declared_without_values_where_it_is_permitted_and_starts_if_it_can(outputs, kind):
    body = BODIES[outputs]
    for where, start in product(kinds()[kind].permitted(body), SPANS):
        declared = kinds()[kind](where).with_values(**start)
        if start and declared.is_calibration:  # it has no columns that could begin
            with pytest.raises(SemiparamError, match=f"effect '{kind}' has a start or an end; expected none"):
                CoupledColumns(body, [declared])
            continue
        assembly = CoupledColumns(body, [declared])
        columns, _ = assembly.batch(MOTION[:5])
        assert columns.shape[2] == assembly.n_columns == assembly.n_own + len(declared.coefficients(body))
        assert np.isfinite(columns).all()


@pytest.mark.parametrize('outputs', BODIES)
def test_every_text_is_answered_with_columns_or_a_sentence(outputs):
    """Each kind at no place, at a joint, at a link, on a channel, in the wrong outputs."""
    body = BODIES[outputs]
    links = sorted({place for kind in kinds().values() for place in kind.permitted(body)} - {None, *body.joints},
                   key=str)
    for name, kind in kinds().items():
        for where in (None, body.joints[0], links[0], body.output_names[0], 'base_link', 'r_tentacle'):
            effect = effect_from_text(name + (f'@{where}' if where else ''))
            if outputs in kind.outputs and where in kind.permitted(body):
                columns, _ = CoupledColumns(body, [effect]).batch(MOTION[:3])
                assert np.isfinite(columns).all()
            else:
                with pytest.raises(SemiparamError, match=f"effect '{name}' .*expected"):
                    CoupledColumns(body, [effect])


MISDECLARED = {
    'periodic_disturbance@r_elbow': 'cannot act at .r_elbow.; expected periodic_disturbance@PLACE with one of',
    'cable_spring': 'names no place; expected cable_spring@PLACE with one of .*r_hand',
    'sensor_drift@r_hand': 'expected none, for it has no place',
    'viscous_friction@r_elbow': 'does not act on outputs wrench; expected outputs effort',
    'thermal_drift{"time_constant_s": 0}': 'has time_constant_s 0; expected more than 0',
    'cable_hysteresis@r_hand{"slip": -0.1}': 'has slip -0.1; expected more than 0',
    'cable_hysteresis@r_elbow{"slip": 0.1, "azimuth": 0.1}': 'has a direction at the joint r_elbow',
    'payload@r_hand{"start_s": 3, "start_stamp_s": 1.7e9}': 'has start_s and start_stamp_s; expected one of them',
    'payload@r_hand{"start_s": 3, "end_s": 3}': 'ends at 3 s and begins at 3 s; expected an end after the start',
    'terms@fx{"sin(q_elbow)": 1}': "names the joint 'elbow'; expected one of r_shoulder_pitch",
}


@pytest.mark.parametrize('text', MISDECLARED)
def test_what_cannot_be_is_refused_where_it_is_declared(text):
    from semiparam_ros.core.estimator import Estimator

    with pytest.raises(SemiparamError, match=MISDECLARED[text]):
        Estimator(BODIES['wrench'], effects=[effect_from_text(text)])


def test_a_reference_must_fit_the_robot():
    effect = effect_from_text('load_friction@turn{"reference": [1, 2]}')
    with pytest.raises(SemiparamError, match=r'has a reference of 2 values; expected \d+, the base parameters'):
        CoupledColumns(BODIES['effort'], [effect])


def test_only_kinds_that_need_a_reference_keep_one():
    """Files of earlier versions hold one for every effect."""
    for name, kind in kinds().items():
        effect = effect_from_text(name + '{"reference": [1, 2.5]}')
        assert effect.reference == ((1.0, 2.5) if kind.needs_reference else ())
        assert kind.from_values(None, {}, (1.0, 2.5)) == effect
    needing = {name for name, kind in kinds().items() if kind.needs_reference}
    assert needing == {'load_friction', 'sensor_nonlinearity', 'base_shift', 'zero_slip'}


def test_a_reference_model_stands_once_beside_the_texts():
    one, other = (tuple(np.random.default_rng(seed).standard_normal(36).tolist()) for seed in (0, 1))
    rubbing = [kinds()['load_friction'](joint, {'turn_speed': 0.1 + 0.2}, reference=reference)
               for joint, reference in (('a', one), ('b', one), ('c', other), ('d', ()))]
    effects = [*rubbing, effect_from_text('viscous_friction@a')]
    texts, shared = effects_to_parameters(effects)
    assert shared == one
    assert [('reference' in text, len(text) < 100) for text in texts] == [
        (False, True), (False, True), (True, False), (True, True), (False, True)]
    assert [effect_from_text(text, shared) for text in texts] == effects  # to the last digit
    assert [effect_from_text(effect_to_text(effect)) for effect in effects] == effects
    assert effects_to_parameters(effects[3:]) == (('load_friction@d{"turn_speed": 0.30000000000000004}',
                                                   'viscous_friction@a'), ())


def test_values_go_where_they_belong():
    shaking = effect_from_text('periodic_disturbance@r_hand{"link_axes": 1, "start_s": 2, "frequency_hz": 3}')
    assert (shaking.parameters, shaking.options) == ({'frequency_hz': 3.0}, {'link_axes': 1.0})
    assert shaking.span == Span(2.0) and shaking.searched == ('frequency_hz',)
    assert (shaking.value('frequency_hz'), shaking.value('link_axes')) == (3.0, 1.0)
    assert effect_to_text(shaking) == \
        'periodic_disturbance@r_hand{"frequency_hz": 3.0, "link_axes": 1.0, "start_s": 2.0}'
    moved = shaking.with_values(frequency_hz=4.0, start_stamp_s=5.0)
    assert moved.values == {'frequency_hz': 4.0, 'link_axes': 1.0, 'start_s': 2.0, 'start_stamp_s': 5.0}
    zero = effect_from_text('joint_offset@r_elbow{"offset": 0.1}')
    assert zero.searched == ()


def test_each_kind_bounds_its_own_line_search():
    span = float(MOTION.time[-1] - MOTION.time[0])
    reach = float(np.ptp(MOTION.position[:, BODIES['wrench'].joints.index('r_elbow')]))
    residual = np.zeros((len(MOTION), 6))

    def bounds(text, name):
        return effect_from_text(text).bounds(name, BODIES['wrench'], MOTION, residual)

    assert bounds('periodic_disturbance{"frequency_hz": 3}', 'frequency_hz') == (3.0 - 0.5 / span, 3.0 + 0.5 / span)
    assert bounds('transmission_ripple@r_elbow{"order": 40}', 'order') == (
        pytest.approx(40.0 - np.pi / reach), pytest.approx(40.0 + np.pi / reach))
    assert bounds('thermal_drift{"time_constant_s": 10}', 'time_constant_s') == (4.0, 25.0)
    assert bounds('external_force@r_hand{"x": -1}', 'x') == (-2.5, -0.4)
    assert bounds('external_force@r_hand{"x": 0}', 'x') == (0.0, 0.0)
    for presliding in (0.01, 0.03, 1.0):
        value = presliding * reach
        for text, name in ((f'coulomb_friction@r_elbow{{"presliding": {value}}}', 'presliding'),
                           (f'stribeck_friction@r_elbow{{"presliding_stuck": {value}}}', 'presliding_stuck')):
            low, high = bounds(text, name)
            assert low <= high == pytest.approx(min(2.5 * presliding, MOST_PRESLIDING) * reach)
    still = replace(MOTION, position=np.zeros_like(MOTION.position))
    bristle = effect_from_text('coulomb_friction@r_elbow{"presliding": 0.1}')
    assert min(bristle.bounds('presliding', BODIES['wrench'], still, residual)) > 0.0, 'nothing divides by zero'


def test_a_cable_pulls_at_a_link_that_has_the_name_of_a_joint():
    """Of efforts its columns were those of a joint, one for each channel of a wrench, so no change could be named."""
    alike = RigidBody.from_urdf(TWO_ARMS.replace('b_fore', 'b_elbow'), TWO_ARMS_JOINTS, 'effort')
    body = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS, 'effort')
    motion, cable = smooth_motion(5, 40), kinds()['cable_spring']
    columns = cable('b_elbow').columns(alike, motion, None)[0]
    np.testing.assert_array_equal(columns, cable('b_fore').columns(body, motion, None)[0])
    assert cable('b_elbow').coefficients(alike) == cable('b_fore').coefficients(body)


def test_a_cable_slips_in_the_unit_of_its_place():
    """Reports said 'rad or m' of each."""
    body, cable = BODIES['wrench'], kinds()['cable_hysteresis']
    units = [cable(where, {'slip': 0.1}).unit_of('slip', body) for where in (body.joints[0], 'r_hand')]
    assert units == ['rad', 'm']


def test_a_load_moves_to_the_link_nearest_to_its_centre():
    body = BODIES['wrench']
    load = effect_from_text('payload@r_hand')
    link, _ = nearest_link(body, 'r_hand', np.array([0.0, 0.0, 0.3]))
    assert load.relocated(body, np.array([2.0, 0.0, 0.0, 0.6, *[0.0] * 6])).where == link
    assert load.relocated(body, np.array([-2.0, 0.0, 0.0, 0.6, *[0.0] * 6])) == load
    push = effect_from_text('external_force@r_hand')
    assert push.relocated(body, np.ones(3)) == push


def test_a_file_of_earlier_versions_may_hold_what_now_follows_from_the_place():
    assert effect_from_text('periodic_disturbance@r_hand{"frequency_hz": 3, "directions": 3, "link_axes": 1}') == \
        effect_from_text('periodic_disturbance@r_hand{"frequency_hz": 3, "link_axes": 1}')
    assert effect_from_text('cable_spring@r_hand{"at_link": 1}') == effect_from_text('cable_spring@r_hand')


def test_columns_of_another_package_that_do_not_fit_its_coefficients_are_refused():
    class Wide(type(effect_from_text('external_force'))):
        def basis(self, body, samples, memory):
            return np.zeros((len(samples), body.n_outputs, 4)), None

    with pytest.raises(SemiparamError, match=r"'external_force' gives columns of shape \(6, 4\); expected \(6, 3\)"):
        CoupledColumns(BODIES['wrench'], [Wide('r_hand')]).batch(MOTION)


ORIGIN = 1_750_000_000_123_456_789
STAMPED = replace(MOTION, stamps=MOTION.stamps - MOTION.stamps[0] + ORIGIN, origin=ORIGIN)


@pytest.mark.parametrize('row', range(0, 40, 3))
def test_a_start_may_be_told_as_a_stamp(row):
    """To the sample, whoever counts time from wherever: a double holds such a stamp to 0.24 us."""
    payload = kinds()['payload']('r_hand', span=Span(float(STAMPED.time[row])))
    stamped = payload.at_stamps(ORIGIN)
    assert set(stamped.values) == {'start_stamp_s'}
    expected, _ = payload.columns(BODIES['wrench'], STAMPED, None)
    assert np.abs(expected[row]).max() > 0.0
    for origin in (ORIGIN, ORIGIN + 10**9, 0):
        columns, _ = stamped.columns(BODIES['wrench'], replace(STAMPED, origin=origin), None)
        np.testing.assert_array_equal(columns, expected)
    back = effect_from_text(effect_to_text(stamped)).in_recording(ORIGIN)
    assert back.start_s == pytest.approx(payload.start_s, abs=1e-6)
    assert back.at_stamps(ORIGIN) == stamped  # to the last digit, however often it goes to and fro

def test_an_effect_is_there_from_its_start_until_before_its_end():
    payload = kinds()['payload']('r_hand')
    throughout, _ = payload.columns(BODIES['wrench'], STAMPED, None)
    times = STAMPED.time[[10, 20]].tolist()
    between = payload.with_values(start_s=times[0], end_s=times[1])
    for effect in (between, between.at_stamps(ORIGIN), effect_from_text(effect_to_text(between))):
        columns, _ = effect.columns(BODIES['wrench'], STAMPED, None)
        np.testing.assert_array_equal(columns[10:20], throughout[10:20])
        assert not columns[:10].any() and not columns[20:].any()
    assert set(between.at_stamps(ORIGIN).values) == {'start_stamp_s', 'end_stamp_s'} and between.ends
    assert between.at_stamps(ORIGIN).in_recording(ORIGIN).end_s == pytest.approx(times[1], abs=1e-6)


@pytest.mark.parametrize('row', range(1, 20))
def test_times_that_were_stamps_are_those_of_the_same_samples(row):
    span = Span(float(STAMPED.time[row]), end_s=float(STAMPED.time[row + 15]))
    back = span.at_stamps(ORIGIN).in_recording(ORIGIN)
    np.testing.assert_array_equal(back.holds(STAMPED.stamps, ORIGIN), span.holds(STAMPED.stamps, ORIGIN))


@pytest.mark.parametrize('order', list(permutations(range(3))))
def test_coupled_gears_do_the_work_of_the_joints_in_whichever_order_they_are_declared(order):
    """What motors give is what joints take: the torques follow from how the speeds do; a gain is of one motor's own."""
    body, rng = BODIES['effort'], np.random.default_rng(0)
    _, second, third = body.joints[:3]
    declared = [effect_from_text(text) for text in (
        f'gear_coupling@{second}{{"ratio": 0.3}}', f'gear_coupling@{third}{{"ratio": 0.2}}',
        f'effort_gain@{third}{{"gain": 0.1}}')]
    assembly, state = CoupledColumns(body, [declared[index] for index in order]), rng.normal(size=(3, body.n_joints))
    _, motion, moved = assembly.as_it_is(tuple(state))
    expected = moved @ (body.regressor(*motion) @ body.base_parameters)
    expected[2] *= 1.1
    columns, _ = assembly.one(Sample(0, *state, np.zeros(body.n_outputs)), 0)
    np.testing.assert_allclose(columns[:, :body.n_parameters] @ body.base_parameters, expected, atol=1e-12)


def late_and_uneven() -> Samples:
    """The motion at 1 kHz a day after the origin, then rest; a pause of half an hour, stamps that come twice."""
    steps = np.full(2 * len(MOTION), 1_000_000)
    steps[25], steps[50], steps[[1, 12, 60]] = 1800 * 10**9, 10 * 10**6, 0
    at = np.minimum(np.arange(len(steps)), len(MOTION) - 1)
    still = np.where(np.arange(len(steps)) < len(MOTION), 1.0, 0.0)[:, None]
    return Samples(ORIGIN + 10**14 + np.cumsum(steps), MOTION.position[at], still * MOTION.velocity[at],
                   still * MOTION.acceleration[at], MOTION.outputs[at], ORIGIN, temperature=MOTION.temperature[at])


def check_late_and_uneven(body: RigidBody, effect: Effect) -> None:
    """A day later at 1 kHz columns are finite, and one at a time the same; also at rest and after a pause."""
    samples, assembly = late_and_uneven(), CoupledColumns(body, [disturbed(effect)])
    expected, _ = assembly.batch(samples)
    assert np.isfinite(expected).all()
    scale = np.maximum(np.abs(expected).max(axis=(0, 1)), 1e-6)  # what is less, at rest, is rounding
    np.testing.assert_allclose(one_by_one(assembly, samples) / scale, expected / scale, rtol=0, atol=1e-9)


JOINT_FORMS = {'viscous_friction': ({}, {}),
               'coulomb_friction': ({'turn_speed': 0.01}, {'turn_speed': 0.03}),
               'stribeck_friction': ({'turn_speed': 0.01, 'stribeck_speed': 0.1},
                                     {'turn_speed': 0.02, 'stribeck_speed': 0.3}),
               'asymmetric_friction': ({'turn_speed': 0.01, 'lead_s': 0.01},
                                       {'turn_speed': 0.1, 'lead_s': 0.02}),
               'rotor_inertia': ({}, {}), 'joint_spring': ({}, {}), 'effort_offset': ({}, {}),
               'transmission_ripple': ({'order': 3.0}, {'order': 40.0})}
APART = ('coulomb_friction@elbow{"presliding": 0.01}', 'effort_offset@elbow{"start_s": 0.5}',
         'load_friction@elbow', 'temperature_friction@elbow', 'backlash@elbow{"gap": 0.01}')


def test_effects_of_many_joints_are_computed_at_once_to_the_last_digit():
    """18 declared frictions and offsets take the time of a few; each states its formula once."""
    body = BODIES['effort']
    together = [kinds()[kind](joint, values[index % 2]) for kind, values in JOINT_FORMS.items()
                for index, joint in enumerate(body.joints)]
    apart = [effect_from_text(text) for text in APART]
    columns = CoupledColumns(body, [*together, *apart], joint_friction=True)
    groups = {tuple(found.joints) for found, _ in columns._at_once}
    assert groups == {tuple(range(body.n_joints))} and len(columns._at_once) == len(JOINT_FORMS)
    assert [effect for effect, _ in columns._by_themselves] == [*range(len(together), len(columns.effects))]
    memory, memories = None, [None] * len(columns.effects)
    for sample in MOTION:
        found, memory = columns.one(sample, MOTION.origin, memory)
        row = MOTION[np.array([np.flatnonzero(MOTION.stamps == sample.stamp)[0]])]
        for index, effect in enumerate(columns.effects):
            expected, memories[index] = effect.columns(body, row, memories[index])
            np.testing.assert_array_equal(found[:, columns.blocks[str(index)]], expected[0])


def test_a_kind_whose_functions_take_single_values_is_computed_by_itself_where_these_differ():
    class Own(JointEffect):
        kind, names = 'own', (Coefficient('size', 'N m'),)
        parameter_units = {'size': ''}  # noqa: RUF012

        def functions(self, position, velocity, acceleration):
            return (position if float(self.value('size')) > 0.0 else velocity)[:, None]

    body = BODIES['effort']
    for sizes, groups in (((1.0, 1.0), 1), ((1.0, -1.0), 2)):
        effects = [Own(joint, {'size': size})
                   for joint, size in zip(body.joints, sizes, strict=False)]
        columns = CoupledColumns(body, effects)
        assert len(columns._at_once) == groups
        found, _ = columns.one(MOTION[3], MOTION.origin)
        expected = [MOTION[3].position[0], (MOTION[3].position if groups == 1 else MOTION[3].velocity)[1]]
        np.testing.assert_array_equal(found[[0, 1], [-2, -1]], expected)


def test_what_a_friction_is_made_up_of_acts_as_long_as_it_does():
    """Friction that differs between directions in one recording of several was split into dry friction there and
    viscous friction in all of them."""
    body, joint = BODIES['effort'], BODIES['effort'].output_names[0]
    start, end = STAMPED.time[[10, 20]].tolist()
    whole = kinds()['asymmetric_friction'](joint, {'turn_speed': 0.1}, span=Span(start, end_s=end))
    same, parts = (sum(each.columns(body, STAMPED, None)[0].sum(axis=2) for each in effects)
                   for effects in ([whole], whole.plainer()))
    assert np.ptp(same) > 0.0
    np.testing.assert_allclose(parts, same, atol=1e-12)


def test_without_a_start_an_effect_is_always_there():
    effect = kinds()['external_force']('r_hand', {'x': 0.1})
    assert effect.at_stamps(ORIGIN) == effect.in_recording(ORIGIN) == effect
    for start in ('start_s', 'start_stamp_s', 'end_s', 'end_stamp_s'):
        assert effect.with_values(**{start: 3.0}).without_span() == effect
    terms = kinds()['terms']('fx', {'sin(q_r_elbow)': 1.0}, span=Span(start_stamp_s=3.0))
    assert tuple(terms.parameters) == ('sin(q_r_elbow)',)


BAD_TEXTS = {
    'unknown kind': ('payloda', 'payloda'),
    'nothing': ('', 'no known kind'),
    'only a place': ('@r_hand', 'no known kind'),
    'open brace': ('payload@r_hand{"start_s": 1', 'JSON'),
    'trailing text': ('payload{"start_s": 1} and more', 'JSON'),
    'not a number': ('payload{"start_s": NaN}', 'start_s'),
    'infinite': ('payload{"start_s": 1e999}', 'start_s'),
    'beyond any time': ('time_delay{"delay_s": 1e300}', 'delay_s'),
    'beyond any float': ('payload{"start_s": 1' + '0' * 400 + '}', 'start_s'),
    'text': ('payload{"start_s": "3"}', 'start_s'),
    'truth value': ('payload{"start_s": true}', 'start_s'),
    'nothing as value': ('payload{"start_s": null}', 'start_s'),
    'list': ('payload{"start_s": [3]}', 'start_s'),
    'reference of text': ('load_friction@turn{"reference": ["1"]}', 'reference'),
    'reference no list': ('load_friction@turn{"reference": 3}', 'reference'),
    'bottomless': ('payload' + '{"a":' * 100_000, 'JSON'),
    'code': ('payload{"start_s": __import__("os").getpid()}', 'JSON'),
    'misspelt value': ('joint_offset@r_elbow{"offest": 0.1}', 'offest'),
}


@pytest.mark.parametrize('name', BAD_TEXTS)
def test_bad_text_is_refused_in_one_sentence(name):
    text, expected = BAD_TEXTS[name]
    with pytest.raises(SemiparamError, match=re.escape(expected)) as refusal:
        effect_from_text(text)
    message = str(refusal.value)
    assert '\n' not in message
    assert len(message) < 1000


@pytest.mark.parametrize('text', ['payload', 'payload@r_hand', ' payload@r_hand {"start_s": 3} ',
                                  'sensor_drift{}', 'joint_offset@r_elbow{"offset": -0.0279}'])
def test_text_as_a_person_writes_it(text):
    effect = effect_from_text(text)
    assert effect_from_text(effect_to_text(effect)) == effect
    assert effect.kind == text.strip().partition('@')[0].partition('{')[0]


OWN_KIND = '''
    from semiparam_ros.effects import Coefficient, Effect
    import numpy as np


    class Magnet(Effect):
        """A force along the sensor's x axis that falls off with the elbow's angle."""

        kind = 'magnet'
        outputs = ('wrench',)
        sentence = 'a magnet near the table pulls the hand'
        mistaken_for = ('cable_spring',)
        separated_by = 'motion farther from the table'
        parameter_units = {'reach': 'rad'}

        @classmethod
        def searches(cls, body, samples, where, residual):
            return [{'reach': 0.3}, {'reach': 1.0}]

        def coefficients(self, body):
            return (Coefficient('pull', 'N'),)

        def basis(self, body, samples, memory):
            columns = np.zeros((len(samples), 6, 1))
            columns[:, 0, 0] = np.exp(-np.abs(samples.position[:, 3]) / self.value('reach', 1.0))
            return columns, None


    class Impostor(Effect):
        kind = 'payload'


    class Nameless(Effect):
        pass


    NOT_A_KIND = 3
'''


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Puts a package with entry points where an installer would; gone again after the test."""
    monkeypatch.syspath_prepend(tmp_path)

    def installed(code: str = textwrap.dedent(OWN_KIND), **points: str) -> None:
        (tmp_path / 'own_effects.py').write_text(code)
        monkeypatch.delitem(sys.modules, 'own_effects', raising=False)
        info = tmp_path / 'own_effects-1.0.dist-info'
        info.mkdir()
        (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: own-effects\nVersion: 1.0\n')
        lines = [f'{name} = own_effects:{target}' for name, target in points.items()]
        (info / 'entry_points.txt').write_text('\n'.join([f'[{registry.GROUP}]', *lines, '']))
        importlib.invalidate_caches()
        registry._all_kinds.cache_clear()

    yield installed
    monkeypatch.undo()
    registry._all_kinds.cache_clear()


def test_another_package_adds_a_kind(install):
    install(magnet='Magnet')
    assert 'magnet' in kinds('wrench')
    assert 'magnet' not in kinds('effort')
    effect = effect_from_text('magnet{"reach": 0.5}')
    assert effect.value('reach') == 0.5
    check_effect(BODIES['wrench'], effect)


@pytest.mark.parametrize(('target', 'expected'), [
    ('Impostor', "defines the kind 'payload', which exists already"), ('Nameless', 'expected a subclass'),
    ('NOT_A_KIND', 'expected a subclass'), ('Missing', "entry point 'wrong'")])
def test_a_wrong_entry_point_is_refused_by_name(install, target, expected):
    install(wrong=target)
    with pytest.raises(SemiparamError, match=re.escape(expected)):
        kinds()


# --- physics: the simulator's causes, which share no code with the effects ---

def vector(parameters: dict, name: str) -> list[float]:
    value = parameters[name]['value']
    return list(value) if isinstance(value, list) else [value]


def ball(parameters: dict) -> list[float]:
    """Mass, first moment and inertia about the link's origin of the simulator's solid ball."""
    (mass,), centre = vector(parameters, 'mass'), np.array(vector(parameters, 'centre'))
    inertia = mass * (0.4 * PAYLOAD_RADIUS_M**2 * np.eye(3) + centre @ centre * np.eye(3) - np.outer(centre, centre))
    return [mass, *(mass * centre), *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]]


def sine(parameters: dict) -> list[float]:
    (phase,), force = vector(parameters, 'phase'), np.array(vector(parameters, 'force'))
    return [*(math.cos(phase) * force), *(math.sin(phase) * force)]


def spring(parameters: dict) -> list[float]:
    (stiffness,), (rest,) = vector(parameters, 'stiffness'), vector(parameters, 'rest_position')
    return [stiffness, -stiffness * rest]


def ripple(parameters: dict) -> list[float]:
    (amplitude,), (phase,) = vector(parameters, 'amplitude'), vector(parameters, 'phase')
    return [amplitude * math.cos(phase), amplitude * math.sin(phase)]


def crosstalk(parameters: dict) -> dict[str, float]:
    channels = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')
    matrix = parameters['crosstalk']['value']
    return {f'{to}_from_{by}': matrix[i][j] for i, to in enumerate(channels) for j, by in enumerate(channels)
            if i != j}


def reference(parameters: dict) -> dict[str, float]:
    return {'reference_c': parameters['reference_c']['value']}


def same(*names: str):
    """Coefficients that both call by these names, in this order."""
    return lambda parameters: [value for name in names for value in vector(parameters, name)]


SIZE = 0.1
"""RMS of the effects over the outputs' standard deviation."""
EXACT = 5e-3
"""Share of a difference that the steps of the simulator's encoders and converters leave."""
BRISTLE = {'presliding': 1e-3}
"""The simulator's friction is carried by bristles that need this way to turn over [rad]."""

# kind: (nonlinear parameters from the truth, coefficients from the truth, share of the difference left unexplained)
COLUMNS = {
    'payload': (lambda p: {}, ball, EXACT),
    'external_force': (lambda p: {}, same('force'), EXACT),
    'viscous_drag': (lambda p: {}, same('drag'), EXACT),
    'quadratic_drag': (lambda p: {}, same('drag'), EXACT),
    'sensor_offset': (lambda p: {}, same('offset'), EXACT),
    'sensor_drift': (lambda p: {}, same('rate'), EXACT),
    'thermal_drift': (lambda p: {'time_constant_s': p['time_constant_s']['value']}, same('drift'), EXACT),
    'periodic_disturbance': (lambda p: {'frequency_hz': p['frequency']['value'], 'link_axes': 1.0}, sine, EXACT),
    'viscous_friction': (lambda p: {}, same('viscous'), EXACT),
    'rotor_inertia': (lambda p: {}, same('inertia'), EXACT),
    'joint_spring': (lambda p: {}, spring, EXACT),
    'effort_offset': (lambda p: {}, same('offset'), EXACT),
    'transmission_ripple': (lambda p: {'order': p['order']['value']}, ripple, EXACT),
    'coulomb_friction': (lambda p: BRISTLE, same('coulomb'), EXACT),
    'load_friction': (lambda p: BRISTLE, same('load_coefficient'), EXACT),
    'stribeck_friction': (lambda p: {**BRISTLE, 'stribeck_speed': p['stribeck_velocity']['value'],
                                     'presliding_stuck': 1e-3 * (1.0 + p['stiction']['value'] / p['coulomb']['value'])},
                          same('coulomb', 'stiction'), 2.0 * EXACT),
    'backlash': (lambda p: {'gap': p['gap']['value'], 'flank': 0.1 * p['gap']['value']}, same('torque'), EXACT),
    'temperature_friction': (reference, same('viscous', 'viscous_per_kelvin'), EXACT),
    'temperature_drift': (reference, same('drift'), EXACT),
    'asymmetric_friction': (lambda p: BRISTLE, same('coulomb_forward', 'coulomb_backward', 'viscous_forward',
                                                 'viscous_backward'), EXACT),
}

@pytest.mark.parametrize(('kind', 'outputs'), [(name, outputs) for name, kind in kinds().items()
                                               if issubclass(kind, AtPoint) for outputs in kind.outputs])
def test_at_a_point_of_a_link_where_another_link_stands_a_kind_does_the_same(kind, outputs):
    """The gripper is fixed to the hand."""
    body = icub(outputs)
    hand, gripper = (body.arm.frames[body.arm.getFrameId(name)].placement for name in ('r_hand', 'r_gripper'))
    shift = hand.actInv(gripper.translation)
    assert np.linalg.norm(shift) > 0.01
    link, point = nearest_link(body, 'r_hand', shift)
    np.testing.assert_allclose(point, 0.0, atol=1e-12)
    assert link == 'r_gripper'
    moved = kinds()[kind]('r_hand', dict(zip('xyz', shift.tolist(), strict=True)))
    columns, plain = (effect.columns(body, MOTION, None)[0] for effect in (moved, kinds()[kind]('r_hand')))
    np.testing.assert_allclose(columns, kinds()[kind]('r_gripper').columns(body, MOTION, None)[0], atol=1e-9)
    assert np.abs(columns - plain).max() > 1e-3


# kind: (calibrations from the truth, share of the difference left unexplained)
CALIBRATIONS = {
    'joint_offset': (lambda p: {'offset': p['offset']['value']}, EXACT),
    'gravity_tilt': (lambda p: {name: p[name]['value'] for name in ('tilt_x', 'tilt_y')}, EXACT),
    'sensor_misalignment': (lambda p: dict(zip(('rotation_x', 'rotation_y', 'rotation_z'),
                                               p['rotation_vector']['value'], strict=True)), EXACT),
    'sensor_crosstalk': (crosstalk, EXACT),
    'sensor_gain': (None, EXACT),
    'effort_gain': (lambda p: {'gain': p['gain']['value']}, EXACT),
    'time_delay': (lambda p: {'delay_s': p['delay_s']['value']}, 0.05),
}

# Share left when the coefficients and an offset are fitted at the best place. The simulator's mechanism is another one
# there (a taut rope, strands that rub), which the columns can only resemble.
RESEMBLANCES = {'cable_spring': 0.02, 'cable_hysteresis': 0.4}

# The simulator's disturbance shakes a link, which moves every joint's effort; as an effect it acts on one joint.
NOT_ALIKE = {('periodic_disturbance', 'effort')}


def acting(table: dict) -> list[tuple[str, str]]:
    """(kind, outputs) for every output on which a kind of the table acts alike in both."""
    return [(kind, outputs) for kind in table for outputs in kinds()[kind].outputs
            if (kind, outputs) not in NOT_ALIKE]


def simulated(kind: str, outputs: str, rate_hz: float = 20.0):
    """The same motion without noise, with the cause and without: body, samples without, difference, truth."""
    scenario = Scenario(motion='circle_xy', samples=600, rate_hz=rate_hz, outputs=outputs, noise=0.0,
                        encoder_noise=0.0, seed=3, temperatures=True,
                        effects=(EffectRequest(kind, size=2.0),))  # far above the converter's step
    changed, plain = simulate(scenario), simulate(replace(scenario, effects=()))
    np.testing.assert_array_equal(changed.position, plain.position)
    return body_of(plain), samples_of(plain), changed.outputs - plain.outputs, changed.truth[0]


def share(left: np.ndarray, whole: np.ndarray) -> float:
    return float(np.linalg.norm(left) / np.linalg.norm(whole))


@pytest.mark.parametrize(('kind', 'outputs'), acting(COLUMNS))
def test_columns_times_true_coefficients_are_what_the_simulator_adds(kind, outputs):
    shape, coefficients, accuracy = COLUMNS[kind]
    """Friction turns over between two samples, at which a bristle is bent more or less; at the first sample it
    has a past."""
    rate_hz = 1.0 if kind.startswith('temperature') else 20.0  # it is read once a second
    body, samples, difference, truth = simulated(kind, outputs, rate_hz)
    parameters = truth['parameters']
    start = {} if truth['start_s'] is None else {'start_s': truth['start_s']}
    effect = kinds()[kind].from_values(truth['where'], {**shape(parameters), **start}, rigid_body_of(body, samples))
    columns, _ = effect.columns(body, samples, None)
    assert share((columns @ coefficients(parameters) - difference)[5:], difference[5:]) < accuracy


@pytest.mark.parametrize(('kind', 'outputs'), acting(CALIBRATIONS))
def test_true_calibrations_give_what_the_simulator_changes(kind, outputs):
    calibrations, accuracy = CALIBRATIONS[kind]
    body, samples, difference, truth = simulated(kind, outputs)
    where = None if kind == 'sensor_gain' else truth['where']
    values = {f'gain_{truth["where"]}': truth['parameters']['gain']['value']} if calibrations is None \
        else calibrations(truth['parameters'])
    parameters = np.array(rigid_body_of(body, samples))
    with_it, _ = CoupledColumns(body, [kinds()[kind](where, values)]).batch(samples)
    without = body.regressors(samples)
    found = with_it[:, :, :body.n_parameters] @ parameters - without @ parameters
    assert share(found - difference, difference) < accuracy


@pytest.mark.parametrize('kind', RESEMBLANCES)
def test_columns_can_resemble_what_the_simulator_does_otherwise(kind):
    body, samples, difference, _ = simulated(kind, 'wrench')
    left = [share_left(kinds()[kind](where, dict(shape)), body, samples, difference)
            for where in kinds()[kind].places(body)
            for shape in kinds()[kind].searches(body, samples, where, difference)]
    assert min(left) < RESEMBLANCES[kind]


def share_left(effect: Effect, body: RigidBody, samples, difference: np.ndarray) -> float:
    """What the effect and an offset leave of a difference, its mean aside.

    The first second is left out: the simulator's cable was bent before the recording began.
    """
    columns, _ = effect.columns(body, samples, None)
    columns, wanted = (values[20:] - values[20:].mean(axis=0) for values in (columns, difference))
    columns, wanted = columns.reshape(-1, columns.shape[2]), wanted.ravel()
    return share(wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0], wanted)


def rigid_body_of(body: RigidBody, samples) -> tuple[float, ...]:
    """(p,) base parameters of the simulated arm, whose inertias are not those of the description."""
    offset = np.broadcast_to(np.eye(6), (len(samples), 6, 6)) if body.outputs == 'wrench' \
        else np.zeros((len(samples), body.n_outputs, 0))
    columns = np.concatenate([body.regressors(samples), offset], axis=2)
    columns = columns.reshape(-1, columns.shape[2])
    theta, *_ = np.linalg.lstsq(columns, samples.outputs.ravel(), rcond=1e-13)
    assert share(samples.outputs.ravel() - columns @ theta, samples.outputs) < EXACT * SIZE
    return tuple(theta[:body.n_parameters].tolist())


# --- docs/reference/effects.md ---

@pytest.fixture(scope='module')
def page(repository):
    return (repository / 'docs' / 'reference' / 'effects.md').read_text(encoding='utf-8')


def test_the_documented_tables_hold_every_kind(page):
    tables = page.split('<!-- tables of effects: begin -->')[1].split('<!-- tables of effects: end -->')[0]
    tried = {name for name in {**kinds('wrench'), **kinds('effort')} if name != 'terms'}
    assert set(re.findall(r'^\| `(\w+)` \|', tables, re.MULTILINE)) == tried


def test_the_documented_kind_is_one(repository, install):
    page = (repository / 'docs' / 'tutorials' / '4_own_effect.md').read_text(encoding='utf-8')
    install(re.search(r'```python\n(.*?)```', page, re.DOTALL)[1], table_magnet='TableMagnet')
    assert '[project.entry-points."semiparam_ros.effects"]\ntable_magnet = ' in page
    effect = kinds('wrench')['table_magnet'](None, {'angle': 0.3})
    check_effect(BODIES['wrench'], effect)


def test_the_documented_texts_are_read(page):
    texts = re.findall(r"'([^']*)'", page[page.index('effects: ['):page.index("'sensor_drift']") + 16])
    assert len(texts) == 5
    assembly = CoupledColumns(BODIES['wrench'], [effect_from_text(text) for text in texts])
    columns, _ = assembly.batch(MOTION)
    assert columns.shape[2] == assembly.n_columns
    assert effect_from_text(re.search(r'`(terms@fx\{.*?\})`', page)[1]).coefficients(BODIES['wrench'])


@pytest.mark.parametrize('size', [1.0, 2.0])
def test_a_delay_is_not_drawn_to_whole_samples_by_noise_of_the_encoders(size):
    clean = Scenario(motion='circle_xy', samples=1500, rate_hz=20.0, seed=1)
    recording = simulate(replace(clean, effects=(EffectRequest('time_delay', size=size),)))
    body, samples = body_of(recording), samples_of(recording)
    scale = samples.outputs.std(axis=0)
    offset = np.broadcast_to(np.eye(6), (len(samples), 6, 6))

    def left(delay_s: float) -> float:
        columns, _ = CoupledColumns(body, [kinds()['time_delay'](None, {'delay_s': delay_s})]).batch(samples)
        matrix = (np.concatenate([columns, offset], axis=2) / scale[:, None])[2:].reshape(-1, columns.shape[2] + 6)
        outputs = (samples.outputs / scale)[2:].ravel()
        return share(outputs - matrix @ np.linalg.lstsq(matrix, outputs, rcond=None)[0], outputs)

    delays = np.arange(0.0, 0.0501, 0.001)
    assert abs(delays[np.argmin([left(delay) for delay in delays])] - recording.truth[0]['parameters']['delay_s'][
        'value']) < 0.0015


def test_accelerations_of_a_whole_recording_are_interpolated_as_exactly_as_they_are_smooth():
    """A parabola made a delay three standard deviations too long."""
    time = np.arange(100) * 0.05
    samples = Samples((time * 1e9).astype(np.int64), *(np.tile(values[:, None], 4) for values in (
        np.sin(6.0 * time), 6.0 * np.cos(6.0 * time), -36.0 * np.sin(6.0 * time), np.zeros(100))), 0, whole=True)
    _, delayed, _ = kinds()['time_delay'](None, {'delay_s': 0.02}).correct(BODIES['effort'], samples, None)
    off = delayed.acceleration[:, 0] + 36.0 * np.sin(6.0 * (time - 0.02))
    assert np.abs(off[5:-5]).max() < 1e-4 * 36.0


def test_accelerations_are_as_noisy_between_samples_as_at_them():
    """Half a sample's delay had three quarters of the noise, and so less error where there is none."""
    count, step_ns = 20_000, 50_000_000
    noise, still = np.random.default_rng(0).standard_normal((count, 4)), np.zeros((count, 4))
    samples = Samples(np.arange(count) * step_ns, still, still, noise, still, 0, whole=True)
    sizes = [kinds()['time_delay'](None, {'delay_s': part * step_ns * 1e-9}).correct(
        BODIES['effort'], samples, None)[1].acceleration.std() for part in (0.0, 0.1, 0.25, 0.4, 0.5, -0.5, 1.0)]
    assert np.ptp(sizes) < 0.02 * np.mean(sizes)


def test_a_bristle_that_hardly_bends_at_standstill_gives_numbers():
    """Its way was zero after rounding, and zero over zero at rest."""
    effect = kinds()['stribeck_friction']('elbow', {'presliding': 1e-3, 'presliding_stuck': 1e-20,
                                                    'stribeck_speed': 0.1})
    still = replace(MOTION, position=0.0 * MOTION.position, velocity=0.0 * MOTION.velocity)
    assert np.isfinite(effect.columns(BODIES['effort'], still, None)[0]).all()


@pytest.mark.parametrize('delay_s', [0.02, 0.1, 0.2, -0.01, -0.02])
def test_a_delay_of_many_samples_is_followed_as_they_come(delay_s):
    """The noise of a millisecond was extrapolated over a hundred of them: joints were off by turns of the base."""
    time, rng = np.arange(800) * 1e-3, np.random.default_rng(0)
    stamps = (time * 1e9).astype(np.int64)

    def motion(at):
        return np.stack([np.sin(6.0 * at), 6.0 * np.cos(6.0 * at), -36.0 * np.sin(6.0 * at)])

    noisy = motion(time) + np.array([[1e-4], [2e-3], [2e-2]]) * rng.standard_normal((3, len(time)))
    samples = Samples(stamps, *noisy[:, :, None], np.zeros((len(time), 1)), 0)
    effect, memory, rows = kinds()['time_delay'](None, {'delay_s': delay_s}), None, []
    for index in range(len(time)):
        _, row, memory = effect.correct(BODIES['effort'], samples[index:index + 1], memory)
        rows.append(np.concatenate([row.position[0], row.velocity[0], row.acceleration[0]]))
    off, begin = np.abs(np.array(rows).T - motion(time - delay_s)), round(abs(delay_s) * 1e3) + 1
    assert np.all(off[:, begin:].max(axis=1) < (5e-3, 0.1, 1.0))
    assert np.all(off[:, :begin].max(axis=1) < (0.5, 5.0, 36.0)), 'before anything came'
    whole = effect.correct(BODIES['effort'], samples, None)[1]
    found = np.stack([whole.position, whole.velocity, whole.acceleration])[:, :, 0]
    np.testing.assert_allclose(np.array(rows).T, found, rtol=1e-9, atol=1e-9, err_msg='all at once')
    for absurd in (-4e9, 4e9):
        effect.with_values(delay_s=absurd).correct(BODIES['effort'], samples, None)


@pytest.mark.parametrize('backwards', [False, True])
@pytest.mark.parametrize(('outputs', 'texts'), [
    ('wrench', ('sensor_misalignment{"rotation_x": 0.1, "rotation_y": -0.2, "rotation_z": 0.05}',
                'sensor_gain{"gain_fx": 0.2, "gain_ty": -0.1}', 'external_force@r_gripper')),
    ('effort', ('gear_coupling@turn{"ratio": 0.3}', 'gear_coupling@elbow{"ratio": 0.2}',
                'effort_gain@turn{"gain": 0.3}', 'joint_offset@turn{"offset": 0.1}', 'external_force@tool'))])
def test_derivatives_by_calibrations_are_those_of_the_model_in_the_order_in_which_they_are_declared(
        outputs, texts, backwards):
    """That of a turned sensor held for gains that come before the turn: it was off by a fifth."""
    body, effects = BODIES[outputs], [effect_from_text(text) for text in (texts[::-1] if backwards else texts)]
    rng, everything = np.random.default_rng(0), np.ones(len(MOTION), dtype=bool)
    measured = body.regressors(MOTION) @ body.base_parameters + 0.01 * rng.normal(size=(len(MOTION), body.n_outputs))
    fit = fit_model(body, replace(MOTION, outputs=measured), effects, everything, np.ones(body.n_outputs))

    def prediction(changed: list[Effect]) -> np.ndarray:
        assembly = CoupledColumns(body, changed)
        force = next(index for index, effect in enumerate(changed) if effect.kind == 'external_force')
        columns, _ = assembly.batch(fit.samples)
        return columns[:, :, :body.n_parameters] @ fit.rigid_part \
            + columns[:, :, assembly.blocks[str(force)]] @ fit.theta[fit.assembly.blocks[str(force)]]

    for index, effect in enumerate(effects):
        for number, (name, _) in enumerate(effect.calibrations):
            ahead, behind = (prediction([*effects[:index], effect.with_values(**{name: effect.value(name) + step}),
                                         *effects[index + 1:]]) for step in (1e-5, -1e-5))
            expected = (ahead - behind) / 2e-5
            np.testing.assert_allclose(added_columns(fit, effect)[..., number], expected,
                                       atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize('outputs', BODIES)
def test_a_turn_that_comes_adds_what_its_calibration_changes(outputs):
    """To first order, and the same of one state as of many."""
    body, rng = BODIES[outputs], np.random.default_rng(0)
    reference = body.base_parameters * rng.uniform(0.7, 1.3, body.n_parameters)
    theta, level = tuple(reference.tolist()), body.outputs_of(MOTION, reference)
    pairs = [(ZeroSlip(joint, reference=theta), JointOffset(joint, {'offset': TURN})) for joint in body.joints]
    tilts = [GravityTilt(None, {name: TURN}) for name in ('tilt_x', 'tilt_y')]
    columns = [effect.columns(body, MOTION, None)[0][..., 0] for effect, _ in pairs]
    columns += list(np.moveaxis(BaseShift(reference=theta).columns(body, MOTION, None)[0], 2, 0))
    for column, calibration in zip(columns, [other for _, other in pairs] + tilts, strict=True):
        turned, inputs, _ = calibration.correct(body, MOTION, None)
        change = turned.outputs_of(inputs, reference) - level
        assert TURN * column == pytest.approx(change, abs=0.02 * np.abs(change).max() + 1e-9)
    state = MOTION.position[7], MOTION.velocity[7], MOTION.acceleration[7]
    one = SmallTurns(body).one(*state, reference)
    assert one == pytest.approx(np.stack(columns[-2:] + columns[:-2], axis=-1)[7], abs=1e-5 * np.abs(one).max())


@pytest.mark.parametrize('kind', ['external_force', 'cable_spring', 'periodic_disturbance', 'base_shift', 'zero_slip'])
@pytest.mark.parametrize('outputs', BODIES)
def test_a_gain_or_a_turn_of_what_measures_holds_for_all_that_acts_on_the_links(outputs, kind):
    """As for a load: forces, and what turns add, reach the sensor or the motors as the weights of links do."""
    body = BODIES[outputs]
    found = kinds(outputs)[kind]
    where = {'base_shift': None, 'zero_slip': body.joints[-1]}.get(kind, observed_links(body)[-1])
    if outputs == 'wrench':
        turn, gains = np.array([0.1, -0.2, 0.05]), np.array([1.2, 1.0, 1.0, 1.0, 0.9, 1.0])
        texts = ['sensor_misalignment{"rotation_x": 0.1, "rotation_y": -0.2, "rotation_z": 0.05}',
                 'sensor_gain{"gain_fx": 0.2, "gain_ty": -0.1}']
        measured = np.diag(gains) @ np.kron(np.eye(2), Rotation.from_rotvec(-turn).as_matrix())
    else:
        texts = ['effort_gain@turn{"gain": 0.3}', 'common_gain{"gain": 0.2}']
        measured = 1.2 * np.diag([1.3 if joint == 'turn' else 1.0 for joint in body.output_names])
    effect = found.from_values(where, {'frequency_hz': 1.0} if kind == 'periodic_disturbance' else {})
    alone, beside = ([effect], [*(effect_from_text(text) for text in texts), effect])
    columns = [CoupledColumns(body, effects).batch(MOTION)[0][:, :, -len(effect.coefficients(body)):]
               for effects in (alone, beside)]
    np.testing.assert_allclose(columns[1], measured @ columns[0], rtol=1e-9, atol=1e-9)


def test_a_force_is_borne_by_the_motor_of_a_coupled_gear():
    body = BODIES['effort']
    force, coupling = effect_from_text('external_force@tool'), effect_from_text('gear_coupling@elbow{"ratio": 0.3}')
    assembly = CoupledColumns(body, [force, coupling])
    state = np.random.default_rng(0).normal(size=(3, body.n_joints))
    _, motion, moved = assembly.as_it_is(tuple(state))
    columns, _ = assembly.one(Sample(0, *state, np.zeros(body.n_outputs)), 0)
    plain, _ = CoupledColumns(body, [force]).one(Sample(0, *motion, np.zeros(body.n_outputs)), 0)
    np.testing.assert_allclose(columns[:, -3:], moved @ plain[:, -3:], atol=1e-12)


def test_the_gain_that_all_channels_share_is_no_finding():
    """Which it is no motion tells from the masses: one wrong gain was told 20 standard deviations off."""
    gains = {f'gain_{name}': 0.1 for name in CHANNELS}
    one = kinds()['sensor_gain'](None, {**gains, 'gain_ty': -0.45}).without_common_gain()
    assert one.value('gain_ty') == pytest.approx(-0.5)
    assert one.value('gain_fx') == pytest.approx(0.0, abs=1e-12)
    cross = kinds()['sensor_crosstalk'](None, {**gains, 'fx_from_fy': 0.22}).without_common_gain()
    assert cross.value('fx_from_fy') == pytest.approx(0.2)
    np.testing.assert_allclose(np.diag(cross.matrix()), 1.0)


@pytest.mark.parametrize('size', [0.1, 1.0, 10.0])
def test_the_slip_of_a_zero_is_of_the_arms_size_where_the_joint_slides(size):
    """Limits of angles were taken for metres: a slip of 9 m along ten was none, one of 0.3 m of a small arm was."""
    urdf = '<robot name="crane">' + ''.join([
        arms.link('base'), arms.link('boom'), arms.link('trolley', com=f'0 0 {0.1 * size}'),
        arms.joint('turn', 'revolute', 'base', 'boom', '0 0 0', axis='0 1 0'),
        arms.joint('reach', 'prismatic', 'boom', 'trolley', f'0 0 {size}')]) + '</robot>'
    body = RigidBody.from_urdf(urdf, ('turn', 'reach'), 'effort')
    slip, turn, zero = (kinds()[kind](where) for kind, where in (
        ('zero_slip', 'reach'), ('zero_slip', 'turn'), ('joint_offset', 'reach')))
    assert slip.prior_scale(body) == pytest.approx(zero.calibration_scale(body))
    assert [slip.conceivable(body, np.array([share * size])) for share in (0.09, 0.9, 3.0)] == [True, True, False]
    assert turn.prior_scale(body) == [0.1]
    assert [turn.conceivable(body, np.array([angle])) for angle in (-0.7, 0.9)] == [True, False]


def test_a_frequency_is_found_in_stretches_of_a_long_recording():
    """A spectrum over the pauses between them had steps of a quarter of a second, and saw no shaking above 2 Hz."""
    body = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS, 'effort')
    whole = smooth_motion(5, 12000)
    some = whole[np.concatenate([np.arange(start, start + 200) for start in range(0, 12000, 1000)])]
    shaking = np.sin(2.0 * np.pi * 5.0 * some.time)[:, None] * np.eye(5)[0]
    searched = kinds()['periodic_disturbance'].searches(body, some, 'waist', shaking)
    assert min(abs(values['frequency_hz'] - 5.0) for values in searched) < 0.05
    low, high = kinds()['periodic_disturbance']('waist', {'frequency_hz': 5.0}).bounds(
        'frequency_hz', body, some, shaking)
    assert high - low == pytest.approx(1.0 / 9.95)


def test_rotors_of_a_toy_are_found_that_resist_for_many_times_its_links():
    """Reflected inertia of a servo's gear, of an arm of 0.2 kg with 3 N m."""
    limit = '<limit lower="-3" upper="3" effort="3" velocity="6"/>'
    body = '<inertial><origin xyz="0 0.01 0.05"/><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="3e-5" '\
           'ixy="0" ixz="0" iyz="0"/></inertial>'
    urdf = ('<robot name="toy"><link name="base"/>' + ''.join(
        f'<link name="{child}">{body}</link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="0 0 0.1"/><axis xyz="{axis}"/>{limit}</joint>'
        for name, parent, child, axis in (('lift', 'base', 'upper', '0 1 0'), ('roll', 'upper', 'fore', '0 0 1')))
        + '</robot>')
    joints, rotor = ('lift', 'roll'), np.array([0.03, 0.02])
    toy = RigidBody.from_urdf(urdf, joints, 'effort')
    time = np.arange(800)[:, None] / 40
    turning = 2 * np.pi * np.array([0.31, 0.23])
    position = np.sin(turning * time) + 0.4 * np.cos(2.2 * turning * time)
    velocity = np.gradient(position, time[:, 0], axis=0)
    acceleration = np.gradient(velocity, time[:, 0], axis=0)
    moved = Samples((time[:, 0] * 1e9).astype(np.int64), position, velocity, acceleration, np.zeros((800, 2)), 0)
    outputs = toy.regressors(moved) @ toy.base_parameters + rotor * acceleration
    effects = [effect_from_text(f'rotor_inertia@{joint}') for joint in joints]
    found = from_recording(toy, effects, replace(moved, outputs=outputs), True, False, 'it')
    own = found.mean[found.columns.blocks['rotor']]  # it shares a rotor with the declared one
    np.testing.assert_allclose(own + found.mean[-2:], rotor, rtol=0.1)


@pytest.mark.parametrize('delay_s', [-6.45, 6.45])
def test_long_before_and_after_a_whole_recording_the_nearest_sample_tells_the_motion(delay_s):
    """A step of a search led there, and a regression on samples that were all as far away had no solution."""
    time, still = np.arange(1500) * 0.02, np.zeros((1500, 4))
    moving = np.tile(np.sin(time)[:, None], 4)
    samples = Samples((time * 1e9).astype(np.int64), moving, still, moving, still, 0, whole=True)
    _, delayed, _ = kinds()['time_delay'](None, {'delay_s': delay_s}).correct(BODIES['effort'], samples, None)
    nearest = np.sin(time[0 if delay_s > 0.0 else -1])
    beyond = (time < 6.4) if delay_s > 0.0 else (time > time[-1] - 6.4)
    np.testing.assert_allclose(delayed.acceleration[beyond], nearest, atol=1e-12)
    np.testing.assert_allclose(delayed.acceleration[~beyond][10:-10, 0], np.sin(time - delay_s)[~beyond][10:-10],
                               atol=1e-4)
