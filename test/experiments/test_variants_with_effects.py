"""Variants without and with the effects found, judged where the diagnosis judged."""

from dataclasses import replace

import numpy as np

from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.diagnose import Recorded
from semiparam_ros.effects.registry import effect_from_text
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.experiments.variants_with_effects import _judge
from semiparam_ros.settings import Settings
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate


def judged(effects, load, fitting):
    """Errors of P in the parts that do not fit, where a load is hidden, without effects and with these."""
    samples, body = load
    settings, parts = Settings(variant='P', initial_samples=300), Recorded(samples, fitting, samples, ~fitting)
    return [_judge(settings, body, parts, [effect_from_text(text) for text in each])['nmse_mean']
            for each in ((), effects)]


def recorded(seed, **effect):
    hidden = (EffectRequest('payload', 'r_hand', 3.0, **effect),) if effect else ()
    made = simulate(Scenario(samples=900, effects=hidden, seed=seed, robot_seed=1))
    return samples_of(made), body_of(made)


FITTING = np.arange(900) // 50 % 3 != 1


def test_parts_of_the_same_recording_are_judged_at_their_own_time():
    """Time went on from the end: a load of the last third was there in all of them."""
    without, having = judged(['payload@r_hand{"start_s": 30.0}'], recorded(1, start_s=30.0), FITTING)
    assert having < 0.002 < 0.02 < without


def test_recordings_of_two_days_are_judged_at_their_own_times():
    """A day between two was a jump of the clock: what began with the second one never did."""
    (one, body), (two, _) = recorded(1), recorded(1, start_s=0.0)
    day = 86_400.0
    both = Samples.joined([one, replace(two, stamps=two.stamps + int(day * 1e9))])
    without, having = judged([f'payload@r_hand{{"start_s": {day}}}'], (both, body), np.tile(FITTING, 2))
    assert having < 0.002 < 0.02 < without


def test_what_belongs_to_the_clock_of_one_recording_is_left_out_of_another_one():
    """A drift of the first one went on in it: .53 in place of .0006, and .08 without the effect."""
    one, two = (simulate(Scenario(samples=700, seed=seed, robot_seed=1, effects=(
        EffectRequest('sensor_drift', size=3.0),) if seed == 1 else ())) for seed in (1, 2))
    parts = Recorded(samples_of(one), np.ones(700, dtype=bool), samples_of(two), np.ones(700, dtype=bool))
    without, having = (_judge(Settings(variant='P', initial_samples=300), body_of(one), parts, effects)['nmse_mean']
                       for effects in ((), [effect_from_text('sensor_drift')]))
    assert having < 0.1 * without
