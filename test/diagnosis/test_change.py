"""What has changed at a known time is named."""

import pytest

from semiparam_ros.diagnosis.change import name_change
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate

JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
PICKED_UP_S = 42.0


@pytest.mark.parametrize('seed', [0, 1])
def test_a_load_is_named_where_the_dry_friction_of_the_joints_sticks(seed):
    """Of the columns that stand for a joint's dry friction some may be negative beside the load;
    the load was then refused, and a force told in its place."""
    friction = tuple(EffectRequest('stribeck_friction', joint) for joint in JOINTS)
    load = EffectRequest('payload', size=2.0, start_s=PICKED_UP_S)
    scenario = Scenario(
        outputs='effort', motion='mixed', samples=1000, seed=seed, effects=(*friction, load)
    )
    found = simulate(scenario)
    named = name_change(body_of(found), samples_of(found), [], PICKED_UP_S + 0.3)
    assert named.effect is not None
    assert named.effect.kind == 'payload'
    mass, true = named.parameters['mass'], found.truth[-1]['parameters']['mass']['value']
    assert abs(mass.value - true) < 3.0 * mass.std
