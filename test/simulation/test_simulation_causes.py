"""Hidden causes: each of exactly the size asked for, and each true to its physics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from semiparam_ros import effects
from semiparam_ros.simulation import EffectRequest, Scenario, simulate
from semiparam_ros.simulation.causes import CAUSES, LISTED_KINDS, UNLISTED_KINDS, kinds
from semiparam_ros.simulation.fine_states import bouc_wen, bristle, play
from support.arms import ODD_ARM, ODD_BODY, ODD_JOINTS

WRENCH = ('payload', 'sensor_offset', 'sensor_drift', 'thermal_drift', 'sensor_gain', 'sensor_crosstalk',
          'sensor_misalignment', 'time_delay', 'joint_offset', 'gravity_tilt', 'external_force', 'viscous_drag',
          'quadratic_drag', 'cable_spring', 'cable_hysteresis', 'periodic_disturbance', 'temperature_drift')
EFFORT = ('viscous_friction', 'coulomb_friction', 'stribeck_friction', 'asymmetric_friction', 'load_friction',
          'rotor_inertia', 'joint_spring', 'effort_offset', 'effort_gain', 'transmission_ripple', 'backlash', 'payload',
          'time_delay', 'joint_offset', 'gravity_tilt', 'external_force', 'periodic_disturbance',
          'temperature_friction')
QUIET = {outputs: Scenario(motion='fourier', samples=500, outputs=outputs, seed=4, noise=0.0)
         for outputs in ('wrench', 'effort')}
CASES = [(outputs, kind) for outputs in QUIET for kind in kinds(outputs)]


@pytest.fixture(scope='module')
def bare():
    return {outputs: simulate(scenario) for outputs, scenario in QUIET.items()}


def with_effect(outputs, kind, size=1.0, **more):
    return simulate(replace(QUIET[outputs], effects=(EffectRequest(kind, size=size, **more),)))


def test_every_listed_kind_can_be_simulated():
    assert set(WRENCH) <= set(kinds('wrench'))
    assert set(EFFORT) <= set(kinds('effort'))
    assert set(LISTED_KINDS) == set(WRENCH) | set(EFFORT)
    assert set(CAUSES) == set(LISTED_KINDS) | set(UNLISTED_KINDS)
    assert len(UNLISTED_KINDS) >= 3


@pytest.mark.parametrize(('outputs', 'kind'), CASES)
@pytest.mark.parametrize('size', [0.5, pytest.param(2.0, marks=pytest.mark.long)])
def test_size_is_the_share_of_the_outputs(bare, outputs, kind, size):
    """With and without the effect, everything else the same: RMS over standard deviation, mean over channels."""
    without, recording = bare[outputs].outputs, with_effect(outputs, kind, size)
    share = np.mean(np.sqrt(np.mean((recording.outputs - without) ** 2, axis=0)) / without.std(axis=0))
    assert share == pytest.approx(0.1 * size, rel=2e-3)
    assert recording.truth[0]['rms_share'] == pytest.approx(0.1 * size, rel=1e-8)
    assert np.array_equal(recording.position, bare[outputs].position)


def change(bare, kind, outputs='wrench', **more):
    """What the effect does to the outputs, its truth, and the recording."""
    recording = with_effect(outputs, kind, **more)
    truth = recording.truth[0]
    values = {name: np.array(entry['value']) for name, entry in truth['parameters'].items()}
    return recording.outputs - bare[outputs].outputs, values, truth, recording


def seconds(recording):
    return (recording.stamps - recording.stamps[0]) * 1e-9


def test_payload_begins_when_it_says_and_weighs_what_it_says(bare):
    difference, values, truth, recording = change(bare, 'payload')
    before = seconds(recording) < truth['start_s']
    assert 0.2 < before.mean() < 0.65
    assert np.all(difference[before] == 0)
    force = np.linalg.norm(difference[~before, :3], axis=1)
    # Mostly its weight: this motion is slow.
    assert np.median(force) == pytest.approx(9.81 * values['mass'], rel=0.1)
    assert truth['where'] == 'r_hand'


@pytest.mark.parametrize('kind', ['payload', 'sensor_offset', 'external_force'])
def test_an_end_can_be_asked_for(bare, kind):
    difference, _, truth, recording = change(bare, kind, start_s=10.0, end_s=20.0)
    assert (truth['start_s'], truth['end_s']) == (10.0, 20.0)
    time = seconds(recording)
    inside = (time >= 10.0) & (time < 20.0)
    assert not difference[~inside].any()
    assert np.abs(difference[inside]).max(axis=1).min() > 0.0


def test_a_start_is_drawn_before_the_end(bare):
    """It came after the end, and the effect was refused because it changes nothing."""
    _, _, truth, _ = change(bare, 'payload', end_s=0.2 * seconds(bare['wrench'])[-1])
    assert 0.0 < truth['start_s'] < truth['end_s']


def test_a_start_can_be_asked_for(bare):
    difference, _, truth, recording = change(bare, 'viscous_drag', start_s=10.0)
    assert truth['start_s'] == 10.0
    assert np.all(difference[seconds(recording) < 10.0] == 0)
    assert np.any(difference[seconds(recording) > 10.0] != 0)


def test_courses_of_the_sensors_offset(bare):
    difference, values, truth, recording = change(bare, 'sensor_offset')
    time = seconds(recording)
    assert np.allclose(difference[time >= truth['start_s']], values['offset'], atol=2e-3)
    difference, values, _, _ = change(bare, 'sensor_drift')
    assert np.allclose(difference, np.outer(time, values['rate']), atol=2e-3)
    difference, values, _, _ = change(bare, 'thermal_drift')
    state = 1 - np.exp(-time / values['time_constant_s'])
    assert np.allclose(difference, np.outer(state, values['drift']), atol=2e-3)


def test_faults_of_the_reading(bare):
    """The sensor's constant offset is added behind the fault, so differences of samples show the matrix."""
    reading = np.diff(bare['wrench'].outputs, axis=0)
    difference, values, truth, _ = change(bare, 'sensor_gain', where='fz')
    assert truth['where'] == 'fz'
    assert np.allclose(np.diff(difference[:, 2]), values['gain'] * reading[:, 2], atol=3e-3)
    assert np.all(np.delete(difference, 2, axis=1) == 0)
    difference, values, _, _ = change(bare, 'sensor_crosstalk')
    assert np.allclose(np.diff(difference, axis=0), reading @ values['crosstalk'].T, atol=5e-3)
    assert np.all(np.diag(values['crosstalk']) == 0)
    difference, values, _, recording = change(bare, 'sensor_misalignment')
    sizes = [np.linalg.norm(np.diff(outputs[:, :3], axis=0), axis=1)
             for outputs in (recording.outputs, bare['wrench'].outputs)]
    assert np.allclose(*sizes, atol=3e-3)


def test_delay_is_a_shift_in_time(bare):
    difference, values, _, recording = change(bare, 'time_delay')
    late = np.stack([np.interp(seconds(recording) - values['delay_s'], seconds(recording), column)
                     for column in bare['wrench'].outputs.T], axis=1)
    scale = bare['wrench'].outputs.std(axis=0)
    assert np.all(np.abs(late - recording.outputs)[1:] / scale < 0.02)
    assert np.abs(difference / scale).max() > 0.1


def test_joint_offset_leaves_the_reading_and_moves_the_arm(bare):
    _, values, truth, recording = change(bare, 'joint_offset', where='r_elbow')
    assert truth['where'] == 'r_elbow'
    shifted = recording.position.copy()
    shifted[:, 3] += values['offset']
    assert np.array_equal(recording.position, bare['wrench'].position)
    assert np.allclose(rigid(recording, shifted), recording.outputs - offset_of(bare), atol=0.05)


def test_gravity_tilt_keeps_the_weight(bare):
    _, values, _, recording = change(bare, 'gravity_tilt')
    assert 0 < np.hypot(values['tilt_x'], values['tilt_y']) < 0.2
    weights = [np.linalg.norm(outputs[:, :3] - offset_of(bare)[:3], axis=1)
               for outputs in (recording.outputs, bare['wrench'].outputs)]
    assert np.abs(weights[0] - weights[1]).mean() < 0.01 * weights[1].mean()


def rigid(recording, position):
    """Outputs of the true robot at other positions."""
    from semiparam_ros.simulation.robots import arm_of, varied
    from semiparam_ros.simulation.simulate import robot_generators

    scenario = QUIET[recording.outputs_kind]
    arm = varied(arm_of(scenario), robot_generators(scenario)[0])
    return arm.evaluate(position, recording.velocity, recording.acceleration)


def offset_of(bare):
    recording = bare['wrench']
    return (recording.outputs - rigid(recording, recording.position)).mean(axis=0)


def test_drag_takes_energy_from_the_motion(bare):
    from semiparam_ros.simulation.robots import arm_of

    for kind in ('viscous_drag', 'quadratic_drag'):
        difference, _, truth, recording = change(bare, kind, 'effort', where='r_hand')
        velocity = arm_of(QUIET['effort']).pose('r_hand', recording.position).velocity(recording.velocity)[:, :3]
        power = np.sum(difference * recording.velocity, axis=1)
        exponent = {'viscous_drag': 2, 'quadratic_drag': 3}[kind]
        drag = truth['parameters']['drag']['value']
        assert np.allclose(power, drag * np.linalg.norm(velocity, axis=1) ** exponent, atol=2e-2 * power.max())


def test_a_spring_gives_its_energy_back_and_hysteresis_does_not(bare):
    taken = {}
    for kind in ('cable_spring', 'cable_hysteresis'):
        difference, _, _, recording = change(bare, kind, 'effort')
        power = np.sum(difference * recording.velocity, axis=1)
        taken[kind] = power.sum() / np.abs(power).sum()
    assert abs(taken['cable_spring']) < 0.1
    assert taken['cable_hysteresis'] > 0.3


def test_periodic_disturbance_has_its_frequency(bare):
    difference, values, truth, recording = change(bare, 'periodic_disturbance', 'effort', where='r_elbow')
    phase = 2 * np.pi * values['frequency'] * seconds(recording) + values['phase']
    assert np.allclose(difference[:, 3], values['torque'] * np.sin(phase), atol=2e-3)
    assert truth['where'] == 'r_elbow'


def test_joint_torques(bare):
    """Additive effects on one joint's effort, from the recorded motion and the truth's numbers."""
    torque = {
        'viscous_friction': lambda p, q, dq, ddq: p['viscous'] * dq,
        'rotor_inertia': lambda p, q, dq, ddq: p['inertia'] * ddq,
        'joint_spring': lambda p, q, dq, ddq: p['stiffness'] * (q - p['rest_position']),
        'effort_offset': lambda p, q, dq, ddq: p['offset'] + 0 * q,
        'transmission_ripple': lambda p, q, dq, ddq: p['amplitude'] * np.sin(p['order'] * q + p['phase']),
    }
    for kind, law in torque.items():
        difference, values, _, recording = change(bare, kind, 'effort', where='r_shoulder_roll')
        state = (recording.position[:, 1], recording.velocity[:, 1], recording.acceleration[:, 1])
        expected = law(values, *state)
        # The readings are noisy: accelerations by 5 % of what they are here.
        assert np.sqrt(np.mean((difference[:, 1] - expected) ** 2)) < 0.06 * np.sqrt(np.mean(expected**2))
        assert np.all(np.delete(difference, 1, axis=1) == 0)


def test_dry_friction_opposes_sliding(bare):
    for kind in ('coulomb_friction', 'stribeck_friction', 'load_friction', 'asymmetric_friction', 'backlash'):
        difference, _, _, recording = change(bare, kind, 'effort', where='r_elbow')
        sliding = np.abs(recording.velocity[:, 3]) > 0.3
        power = difference[sliding, 3] * recording.velocity[sliding, 3]
        assert np.mean(power >= 0) > 0.9, kind
    difference, values, _, recording = change(bare, 'coulomb_friction', 'effort', where='r_elbow')
    sliding = np.abs(recording.velocity[:, 3]) > 0.3
    assert np.allclose(np.abs(difference[sliding, 3]), values['coulomb'], atol=1e-3)


def test_stiction_rises_near_standstill(bare):
    difference, values, _, _ = change(bare, 'stribeck_friction', 'effort', where='r_elbow')
    size = np.abs(difference[:, 3])
    assert values['coulomb'] * 1.1 < size.max() <= values['coulomb'] + values['stiction'] + 1e-3


def test_bouc_wen_is_the_solution_of_its_equation():
    time = np.linspace(0, 6, 6001)
    way = np.sin(time) * (1 + 0.2 * time)
    def rate(t, z):
        dx = np.cos(t) * (1 + 0.2 * t) + 0.2 * np.sin(t)
        return dx - (0.7 * abs(dx) * z + 0.3 * dx * abs(z)) / 0.4
    exact = solve_ivp(rate, (0, 6), [0.0], t_eval=time, rtol=1e-9, atol=1e-11, max_step=1e-2).y[0]
    state = bouc_wen(way, 0.4, 0.7)
    assert np.abs(state - exact).max() < 2e-3
    assert np.abs(state).max() <= 0.4 + 1e-12
    assert np.allclose(bouc_wen(way[::2], 0.4, 0.7), state[::2], atol=1e-3)


def test_bristle_and_play():
    way = np.concatenate([np.linspace(0, 1, 200), np.linspace(1, 0, 200)])
    deflection = bristle(way, 0.01)
    assert deflection[199] == pytest.approx(1.0, abs=1e-9)
    assert deflection[-1] == pytest.approx(-1.0, abs=1e-9)
    inside = play(way, 0.3)
    assert inside[199] == 0.3
    assert inside[-1] == 0.0
    assert inside[199 + 50] == pytest.approx(0.3 - (1 - way[249]), abs=1e-2)


def test_two_effects_and_their_places():
    effects = (EffectRequest('payload'), EffectRequest('joint_offset', 'r_elbow', 0.5))
    truth = simulate(replace(QUIET['wrench'], effects=effects)).truth
    assert [(entry['kind'], entry['size']) for entry in truth] == [('payload', 1.0), ('joint_offset', 0.5)]
    assert truth[1]['rms_share'] == pytest.approx(0.05, rel=1e-6)


def test_a_random_place_is_one_where_the_effect_shows():
    """The rotor of the first joint is an inertia about a fixed axis, which the rigid body explains."""
    for seed in range(6):
        scenario = replace(QUIET['effort'], seed=seed, effects=(EffectRequest('rotor_inertia'),))
        truth = simulate(scenario).truth[0]
        assert truth['where'] != 'r_shoulder_pitch'
        assert truth['unexplained_share'] > 0.02


@pytest.mark.parametrize('kind', ['viscous_friction', 'asymmetric_friction', 'joint_spring', 'rotor_inertia',
                                  'effort_offset', 'transmission_ripple', 'backlash', 'temperature_friction'])
def test_values_of_a_joint_that_slides_have_its_units(kind):
    """They were told in those of a joint that turns: friction in N m."""
    scenario = Scenario(motion='mixed', samples=60, outputs='effort', urdf=ODD_ARM, joints=ODD_JOINTS)
    for where, slides in (('lift', True), ('turn', False)):
        recording = simulate(replace(scenario, effects=(EffectRequest(kind, where),)))
        effect = effects.kinds()[kind](where)
        known = dict(effect.coefficients(ODD_BODY)) | {'gap': effect.unit_of('gap', ODD_BODY)}
        units = {name: entry['unit'] for name, entry in recording.truth[0]['parameters'].items()}
        assert {name: unit for name, unit in units.items() if name in known}.items() <= known.items()
        assert not slides or not any('rad' in unit or 'N m' in unit for name, unit in units.items() if name != 'phase')
        assert units.get('phase', 'rad') == 'rad'
