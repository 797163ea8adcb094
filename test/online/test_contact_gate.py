"""The gate on innovations whose distribution is known: it keeps to its rate, finds pushes, and follows a change."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from semiparam_ros.core.motion import at_start
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.recursion import Prior
from semiparam_ros.core.samples import Sample
from semiparam_ros.online.contact_gate import ContactGate, explained
from semiparam_ros.settings import Settings
from support.node_helpers import BODY

RATE_HZ = 20
SCALES = np.array([20.0, 1.0, 0.05])
ON = Settings(gate_enabled=True)
NO_PRIOR = Prior(*[np.zeros(0)] * len(Prior._fields))


class Stand:
    """A gate with three outputs that is given innovations and speeds, at 20 Hz."""

    def __init__(self, settings=ON, joints=None, forces=None):
        self.gate, self.settings, self.stamp = ContactGate(3, joints, forces), settings, 10**9
        self.position = np.zeros(1)

    def judge(self, innovations, speed=0.5, std=1.0, beyond=0.0, ready=True):
        """Whether each of (N, 3) innovations is refused."""
        return np.array([self._one(row, speed, std, beyond, ready=ready) for row in innovations])

    def used(self, seconds=60):
        """The same after free motion."""
        self.judge(white(RATE_HZ * seconds))
        return self

    def _one(self, innovation, speed, std, beyond, off=False, ready=True):
        """``speed``: of the fastest joint, or velocities of all three."""
        self.stamp += 10**9 // RATE_HZ
        velocity = speed if np.ndim(speed) else np.array([0.0, -speed, 0.0])
        self.position = self.position + velocity / RATE_HZ
        sample = Sample(self.stamp, self.position, velocity, np.zeros(3), innovation)
        prediction = Prediction(np.zeros(3), std * SCALES, np.zeros(3), std * SCALES, ready, sample, NO_PRIOR,
                                np.zeros((3, 0)), None, at_start(self.stamp, sample.position, innovation), beyond,
                                off=off)
        return self.gate.judge(prediction, self.settings)


def white(count, seed=0):
    return SCALES * np.random.default_rng(seed).standard_normal((count, 3))


def coloured(count, seed=0):
    """Autocorrelation 0.67 at lag 20, as measured on the iCub arm."""
    memory = 0.67 ** (1 / 20)
    return np.sqrt(1 - memory**2) * lfilter([1.0], [1.0, -memory], white(count + 500, seed), axis=0)[500:]


def heavy(count, seed=0):
    return SCALES * np.random.default_rng(seed).laplace(size=(count, 3))


@pytest.mark.parametrize('noise', [white, coloured, heavy])
def test_free_motion_closes_it_about_as_often_as_asked(noise):
    stand = Stand(replace(ON, gate_false_alarms_per_hour=100.0))
    stand.judge(noise(RATE_HZ * 1800))
    assert 12 <= stand.gate.contacts <= 100, '50 were asked for'


@pytest.mark.parametrize('noise', [white, coloured, heavy])
@pytest.mark.parametrize('std', [0.3, 4.0])
def test_pushes_are_found_however_wrong_the_predicted_deviation_is(noise, std):
    stand, innovations, pushed = Stand(), noise(RATE_HZ * 120), np.zeros(RATE_HZ * 120, dtype=bool)
    for number, start in enumerate(range(RATE_HZ * 20, len(innovations), RATE_HZ * 10)):
        innovations[start:start + 10, number % 3] += 20.0 * SCALES[number % 3]
        pushed[start:start + 10] = True
    refused = stand.judge(innovations, std=std)
    assert refused[pushed].mean() > 0.95
    assert 10 <= stand.gate.contacts <= 11
    assert refused.sum() <= pushed.sum() + 10 * RATE_HZ, 'it opens after gate.hold of usual innovations'


def test_it_says_in_which_outputs():
    stand = Stand().used(20)
    assert stand.gate.touched() == []
    stand.judge(np.array([[0.0, 20.0, 2.0]]))
    assert stand.gate.touched() == [2, 1] and stand.gate.closed


def test_it_works_in_the_first_seconds_while_the_model_improves():
    falling = np.exp(-np.arange(RATE_HZ * 10) / (2.0 * RATE_HZ))[:, None]
    stand, innovations = Stand(), white(RATE_HZ * 10) * (1.0 + 50.0 * falling)
    innovations[-20:-10, 1] += 80.0
    refused = stand.judge(innovations)
    assert not refused[:-20].any() and refused[-20:-10].all()


def test_a_lasting_change_is_let_in_after_the_timeout_and_pushes_are_found_again():
    stand, load, push = Stand(), np.array([200.0, 20.0, 0.0]), np.array([0.0, 20.0, 0.0])
    stand.judge(coloured(RATE_HZ * 10, seed=4), speed=1.5)  # seldom so fast: how it was under the load is not kept
    stand.judge(coloured(RATE_HZ * 60))
    refused = stand.judge(coloured(RATE_HZ * 60, seed=1) + load)
    assert refused[:RATE_HZ * 5].all() and not refused[RATE_HZ * 5 + 1:].any()
    assert stand.gate.changes == 1
    stand.judge(coloured(RATE_HZ * 20, seed=2))  # by now the model has learnt the load
    assert stand.judge(coloured(10, seed=3) + push).all()


@pytest.mark.parametrize('timeout', [0.3, 1.0])
def test_after_a_short_timeout_what_was_usual_is_not_forgotten(timeout):
    stand, load = Stand(replace(ON, gate_timeout=timeout)).used(), np.array([200.0, 20.0, 0.0])
    refused = stand.judge(white(int(RATE_HZ * timeout) + 3, seed=1) + load)
    assert refused[:int(RATE_HZ * timeout)].all() and stand.gate.changes == 1
    assert stand.judge(white(5, seed=2) + 1000.0 * SCALES).all()


def test_a_change_that_leaves_an_output_silent_makes_nothing_louder():
    """An emergency stop in motion: the motor that holds nothing shows noise alone until the gate has opened."""
    stand, stopped = Stand().used(), np.array([300.0, 10.0, 0.0])
    refused = stand.judge(0.01 * white(RATE_HZ * 6, seed=1) + stopped)
    assert refused[:RATE_HZ * 5].all() and stand.gate.changes == 1
    assert not stand.judge(white(RATE_HZ * 60, seed=2)).any()


def test_motors_that_are_off_touch_nothing():
    """Neither while they are off nor when they hold the arm again; also a gate that had closed meanwhile opens."""
    stand, weight = Stand().used(), np.array([300.0, 10.0, 0.0])
    stand.judge(0.01 * white(RATE_HZ * 20), speed=0.0)
    assert stand.judge(0.01 * white(2) - weight, speed=0.0).all()
    assert not any(stand._one(row - weight, 0.0, 1.0, 0.0, off=True) for row in 0.01 * white(RATE_HZ * 20))
    assert not stand.gate.closed and not stand.gate.level.any()
    held = 0.5 * weight
    assert not stand.judge(0.01 * white(RATE_HZ * 20, seed=1) + held, speed=0.0).any(), 'stiction is another one now'
    assert stand.judge(0.01 * white(10) + held + weight, speed=0.0).all()


def swinging(seconds, burst, seed=0):
    """White innovations, and velocities of three joints that swing; with each turn of the second one comes a burst."""
    time, slow = np.arange(RATE_HZ * seconds) / RATE_HZ, 2.0 * np.pi / np.array([6.0, 8.3, 7.1])
    velocity = np.sin(time[:, None] * slow)
    innovations = white(len(time), seed)
    turn = np.abs(velocity[:, 1]) < 0.1
    innovations[turn, 1] += burst * np.sign(innovations[turn, 1])
    return innovations, velocity, turn


def test_a_burst_at_each_turn_of_a_joint_is_friction_and_a_push_between_two_turns_is_found():
    burst = 30.0
    gates, contacts = {}, {}
    for of_joints in (True, False):
        stand = gates[of_joints] = Stand(joints=np.array([1, 2, 3]) if of_joints else None)
        for number, (row, velocity) in enumerate(zip(*swinging(90, burst, seed=3)[:2], strict=True)):
            stand._one(row, np.array([0.0, *velocity]), 1.0, 0.0)  # the first joint is an input only
            if number == RATE_HZ * 15:
                known = stand.gate.contacts
        contacts[of_joints] = stand.gate.contacts - known
    assert contacts[True] == 0, 'four turns are known'
    assert contacts[False] >= 4, 'scales that do not know of turns take them for contacts'
    innovations, velocity, _ = swinging(60, burst, seed=1)
    between = np.abs(velocity[:, 1]) > 0.9
    between[RATE_HZ * 3:] = False
    innovations[between, 1] += burst
    rows = zip(innovations, np.insert(velocity, 0, 0.0, axis=1), strict=True)
    refused = np.array([gates[True]._one(*row, 1.0, 0.0) for row in rows])
    assert refused[between].mean() > 0.9


def test_a_joint_that_moves_for_the_first_time_does_not_touch_and_is_judged_later():
    """Nothing is known of its friction, also while it creeps; the others feel a push meanwhile."""
    stand = Stand(joints=np.arange(3))
    innovations, velocity, _ = swinging(90, 0.0)
    velocity[:, 1] = 0.0
    assert not any(stand._one(*row, 1.0, 0.0) for row in zip(innovations, velocity, strict=True))
    innovations, velocity, _ = swinging(60, 0.0, seed=1)
    velocity[:40, 1] = np.linspace(0.005, velocity[40, 1], 40)
    friction = np.array([0.0, 12.0, 0.0]) * np.tanh(velocity / 0.05)
    refused = [stand._one(*row, 1.0, 0.0) for row in zip((innovations + friction)[:100], velocity, strict=False)]
    assert not any(refused)
    push = np.array([300.0, 0.0, 0.0])
    assert all(stand._one(row + push, velocity[100], 1.0, 0.0) for row in innovations[100:110])
    for row in zip(innovations[110:], velocity[110:], strict=True):  # by now the model has learnt the friction
        stand._one(*row, 1.0, 0.0)
    assert all(stand._one(row + push[[1, 0, 1]] / 15.0, velocity[-1], 1.0, 0.0) for row in white(10, seed=2))


def test_a_joint_that_rests_anywhere_from_the_start_is_judged():
    stand, innovations = Stand(joints=np.arange(3)), white(RATE_HZ * 12)
    stand.position, velocity = np.ones(3), np.zeros((RATE_HZ * 12, 3))
    velocity[:, 1] = np.sin(np.arange(len(velocity)) / RATE_HZ)
    innovations[-20:, 0] += 100.0 * SCALES[0]
    refused = [stand._one(*row, 1.0, 0.0) for row in zip(innovations, velocity, strict=True)]
    assert not any(refused[:-20]) and all(refused[-20:])


@pytest.mark.parametrize(('sigmas', 'by_friction'), [(8.0, False), (20.0, True)])
def test_what_no_force_at_a_link_brings_about_counts_half(sigmas, by_friction):
    """Forces at the only link are felt by the first two outputs in equal parts of their scales; the third has none."""
    maps = 100.0 * np.array([[[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]]) * SCALES[:, None]
    for shape, found in (((1.0, 1.0, 0.0), True), ((0.0, 0.0, 1.0), by_friction)):
        stand = Stand(forces=lambda position: maps).used()
        assert stand.judge(sigmas * SCALES * np.array([shape] * 3)).any() == found
        stand = Stand().used()
        assert stand.judge(sigmas * SCALES * np.array([shape] * 3)).any(), 'either is large'


def test_time_without_samples_is_none_that_a_contact_lasts():
    """A node that was ended in a contact, and started again a minute later, took it for a change."""
    stand = Stand().used(30)
    assert stand.judge(white(RATE_HZ, 1) + 60.0 * SCALES)[-1]
    stand.stamp += 60 * 10**9
    assert stand.judge(white(2 * RATE_HZ, 2) + 60.0 * SCALES).all()
    assert not stand.judge(white(2 * RATE_HZ, 3))[-1], 'it was a contact'
    assert stand.gate.changes == 0


def test_without_a_timeout_it_stays_closed():
    stand = Stand(replace(ON, gate_timeout=0.0)).used()
    assert stand.judge(white(RATE_HZ * 60) + 100.0 * SCALES).all()


def test_rest_is_judged_by_rest():
    """Stiction holds the arm with other efforts at each stop; noise is small; encoders and currents have steps."""
    stand, stiction, push = Stand(), np.array([30.0, 2.0, -0.1]), np.array([0.0, 3.0, 0.0])
    noise = 0.02 * white(RATE_HZ * 600)
    noise[RATE_HZ * 300:] += 0.1 * SCALES  # a step, as of a sensor's digits
    assert not stand.judge(noise + stiction, speed=0.001).any()
    assert not stand.judge(white(RATE_HZ * 30), speed=0.5).any(), 'the first motion is no contact'
    assert not stand.judge(noise[:RATE_HZ * 60] - 1.5 * stiction, speed=0.0).any(), 'another stop, other efforts'
    assert stand.judge(noise[:10] - 1.5 * stiction + push, speed=0.0).all()


def test_silence_is_not_exactness():
    stand = Stand()
    assert not stand.judge(np.zeros((RATE_HZ * 60, 3)), speed=0.0).any()
    assert not stand.judge(0.1 * white(RATE_HZ * 10), speed=0.0).any()


def test_ten_times_the_speed_is_no_contact():
    stand = Stand()
    stand.judge(white(RATE_HZ * 60), speed=0.15)
    assert not stand.judge(6.0 * white(RATE_HZ * 60, seed=1), speed=1.5).any()


@pytest.mark.parametrize(('sigmas', 'refused'), [(2.5, False), (8.0, True)])
def test_fast_motion_that_slows_down_is_no_slow_motion(sigmas, refused):
    stand = Stand()
    stand.judge(0.2 * white(RATE_HZ * 60), speed=0.5)
    stand.judge(white(RATE_HZ * 60, seed=1), speed=1.5)
    stand.judge(0.2 * white(RATE_HZ * 5, seed=2), speed=0.5)
    assert stand.judge(sigmas * SCALES * np.ones((3, 1)), speed=0.5).any() == refused


def test_motion_that_was_never_seen_is_learnt_first_and_hard_pushes_are_found():
    stand = Stand().used()
    assert not stand.judge(5.0 * white(RATE_HZ * 3, seed=1), beyond=0.3).any()
    assert stand.judge(60.0 * SCALES * np.ones((5, 1)), beyond=0.3).all()
    stand.gate.reset()
    assert not stand.judge(white(RATE_HZ * 20, seed=2)).any()
    assert stand.judge(20.0 * SCALES * np.ones((5, 1))).all(), 'what was unseen is no excuse later'


@pytest.mark.parametrize(('seconds', 'refused'), [(1, False), (4, True)])
def test_at_the_edge_of_what_was_learnt_thresholds_are_higher_for_a_while(seconds, refused):
    """A joint that creeps to where it never was is never far outside, as what is learnt widens the range."""
    stand = Stand().used()
    stand.judge(white(1), beyond=0.05)
    stand.judge(white(RATE_HZ * seconds, seed=1))
    assert stand.judge(8.0 * SCALES * np.ones((3, 1))).any() == refused


@pytest.mark.parametrize('ready', [False, True])
def test_a_provisional_model_is_judged_with_higher_thresholds(ready):
    stand = Stand().used()
    assert stand.judge(8.0 * SCALES * np.ones((3, 1)), ready=ready).any() == ready


def test_what_comes_again_and_again_is_the_robots_own():
    """Each turn of a circle has a jerk that the model does not know; else every turn would be a contact."""
    stand, innovations = Stand(), white(RATE_HZ * 120)
    for start in range(RATE_HZ * 30, len(innovations), RATE_HZ * 2):
        innovations[start:start + 6, 1] += 15.0
    refused = stand.judge(innovations)
    assert refused[RATE_HZ * 30:RATE_HZ * 36].any() and not refused[RATE_HZ * 70:].any()
    assert stand.gate.contacts <= 12


def test_closures_from_before_the_clock_was_set_back_are_not_those_of_the_last_seconds():
    stand, jerk = Stand().used(), white(6, seed=5) + np.array([0.0, 15.0, 0.0])
    for _ in range(2):
        assert stand.judge(jerk).any()
        stand.judge(white(RATE_HZ * 2, seed=1))
    stand.gate.reset()
    stand.stamp -= 3600 * 10**9
    tails = len(stand.gate.state()['tails'][1])
    stand.judge(jerk)
    stand.judge(white(8, seed=2))
    assert stand.gate.contacts == 3 and not stand.gate.closed
    assert len(stand.gate.state()['tails'][1]) == tails, 'it was no motion of the robot itself'


def test_who_taps_a_robot_again_and_again_is_noticed_each_time():
    """After the sixth tap in a quarter of a minute taps were usual, and learnt."""
    stand, innovations = Stand(), white(RATE_HZ * 120)
    taps = range(RATE_HZ * 30, len(innovations) - RATE_HZ, RATE_HZ * 5 // 2)
    for start in taps:
        innovations[start:start + RATE_HZ // 2, 1] += 40.0
    refused = stand.judge(innovations)
    assert all(refused[start:start + RATE_HZ // 2].all() for start in taps)


def test_an_arm_that_sets_out_does_not_touch():
    """Friction at the start is that of fast motion, which slow motion does not have."""
    stand = Stand()
    stand.judge(white(RATE_HZ * 40), speed=0.1)
    stand.judge(5.0 * white(RATE_HZ * 40, seed=1), speed=1.0)
    for seed in range(5):
        stand.judge(0.01 * white(RATE_HZ * 10, seed=seed), speed=0.0)
        start = white(RATE_HZ * 3, seed=seed)
        start[:10, 0] += 300.0
        assert not stand.judge(start, speed=0.1).any()


def test_it_goes_on_where_it_was_saved():
    one, other = (Stand(joints=np.arange(3)) for _ in range(2))
    one.judge(coloured(RATE_HZ * 60))
    other.gate.restore(one.gate.state())
    other.stamp = one.stamp
    rest = coloured(RATE_HZ * 60, seed=1)
    rest[100:120, 1] += 20.0
    velocities = swinging(60, 0.0)[1]
    for row in zip(rest, velocities, strict=True):
        assert one._one(*row, 1.0, 0.0) == other._one(*row, 1.0, 0.0)
    assert one.gate.contacts == other.gate.contacts >= 1
    np.testing.assert_array_equal(one.gate.level, other.gate.level)


@pytest.mark.parametrize('spoil', [lambda state: None, lambda state: {**state, 'bands': ()},
                                   lambda state: {**state, 'level': np.zeros(4)},
                                   lambda state: {name: value for name, value in state.items() if name != 'speed'}])
def test_no_state_of_another_kind_is_taken(spoil):
    gate = ContactGate(3)
    with pytest.raises((LookupError, TypeError, ValueError)):
        gate.restore(spoil(gate.state()))


def test_reset_opens_it_and_keeps_what_is_usual_and_forget_does_not():
    stand = Stand().used()
    push = white(5, seed=1) + 30.0 * SCALES
    assert stand.judge(push).all()
    stand.gate.reset()
    assert not stand.gate.closed and stand.judge(push).all()
    stand.gate.forget()
    assert not stand.gate.closed and not stand.judge(push).any()


def test_what_a_push_explains_is_told_whatever_the_usual_peaks_are():
    """Behind a dead sensor peaks were of rounding: the covariance was singular, and the sample lost."""
    rng = np.random.default_rng(0)
    ratio, maps = rng.standard_normal(6), rng.standard_normal((4, 6, 3))
    covariance = maps @ maps.swapaxes(1, 2) + np.eye(6)
    expected = np.abs(ratio - np.array([np.linalg.solve(each, ratio) for each in covariance]))
    np.testing.assert_allclose(explained(ratio, maps), expected.max(axis=0), rtol=1e-9)
    beside_rounding = 1e15 * maps[:1, :, :1] * [1.0, 0.5, 0.25]  # of one joint, as efforts have it
    pushed = beside_rounding[0] @ np.ones(3)
    np.testing.assert_allclose(explained(pushed, beside_rounding), np.abs(pushed), rtol=1e-9)


def test_a_state_brings_no_contact_of_before_it_was_loaded():
    gate = ContactGate.of(BODY)
    saved = gate.state()
    gate.place.see(np.zeros(BODY.n_joints), np.ones(6), np.ones(6), 0.1)
    assert gate.place.probabilities.any()
    gate.restore(saved)
    assert not gate.place.probabilities.any()
