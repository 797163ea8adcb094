"""Variants without and with the effects found, judged where the diagnosis judged."""

import numpy as np

from semiparam_ros.diagnosis.diagnose import Recorded
from semiparam_ros.effects.registry import effect_from_text
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.experiments.variants_with_effects import _judge
from semiparam_ros.settings import Settings
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate


def test_parts_of_the_same_recording_are_judged_at_their_own_time():
    """Time went on from the end: a load of the last third was there in all of them."""
    recording = simulate(Scenario(samples=900, effects=(EffectRequest('payload', size=3.0, start_s=30.0),), seed=1))
    body, samples = body_of(recording), samples_of(recording)
    fitting = np.arange(900) // 50 % 3 != 1
    load = effect_from_text(f'payload@{recording.truth[0]["where"]}{{"start_s": 30.0}}')
    without, having = (_judge(Settings(variant='P', initial_samples=300), body,
                              Recorded(samples, fitting, samples, ~fitting), effects)['nmse_mean']
                       for effects in ((), (load,)))
    assert having < 0.002 < 0.02 < without
