"""What ~/payload tells while loads come and go."""

import pytest

from semiparam_ros.ros.estimator.diagnostics import Tally, believed_load
from support.changing_arm import LOADED_S, loaded, offered


def carried(stage):
    """The mass that is told [kg], None where it is withheld."""
    told, _ = believed_load(stage.learner, Tally(stage.learner.body.joints))
    return None if told is None else told.parameters[0]


def test_what_the_hand_carries_follows_a_load_that_is_named_and_put_down():
    body, samples, mass = loaded()
    stage = offered(body, samples[samples.time < LOADED_S[0]])
    before = carried(stage)
    stage.offer(samples[(samples.time >= LOADED_S[0]) & (samples.time < LOADED_S[0] + 4.0)])
    assert carried(stage) - before == pytest.approx(mass, rel=0.15), 'before it has a name'
    stage.offer(samples[(samples.time >= LOADED_S[0] + 4.0) & (samples.time < LOADED_S[1])])
    assert carried(stage) - before == pytest.approx(mass, rel=0.05)
    stage.offer(samples[(samples.time >= LOADED_S[1]) & (samples.time < LOADED_S[1] + 5.0)])
    assert abs(carried(stage) - before) < 0.05 * mass


def test_declared_loads_are_told_together_while_they_are_there():
    body, samples, mass = loaded()
    from_there = LOADED_S[0]
    effects = (
        f'payload@r_gripper {{"start_s": {from_there}, "end_s": {LOADED_S[1]}}}',
        'payload@r_hand {"start_s": 5.0, "mass": 0.25}',
    )
    stage = offered(
        body, samples[samples.time < LOADED_S[0] + 15.0], effects=effects, diagnosis_auto='off'
    )
    assert carried(stage) == pytest.approx(mass + 0.25, rel=0.1)
    stage.offer(samples[(samples.time >= LOADED_S[0] + 15.0) & (samples.time < LOADED_S[1] + 3.0)])
    assert carried(stage) == pytest.approx(0.25, rel=0.01)
