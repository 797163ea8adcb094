"""What has changed at a known time is named."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.diagnosis import change
from semiparam_ros.diagnosis.change import name_change
from semiparam_ros.diagnosis.config import DEFAULTS
from semiparam_ros.diagnosis.named_change import Gain
from semiparam_ros.diagnosis.search.moves import Move
from semiparam_ros.diagnosis.search.stepwise import starting_fit
from semiparam_ros.effects import effect_from_text, kinds
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate, true_arm
from support.arms import ODD_BODY, TWO_ARMS, TWO_ARMS_JOINTS, noisy, smooth_motion

JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
PICKED_UP_S = 42.0


@pytest.mark.parametrize('seed', [0, pytest.param(1, marks=pytest.mark.long)])
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


@pytest.mark.parametrize('hand', ['a_fore', 'b_fore'])
def test_a_load_is_named_at_either_hand(hand):
    """The last link of all was tried alone: what the first of two arms picked up was nothing."""
    body = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS, 'effort')
    motion = smooth_motion(5, 800)
    exact = body.outputs_of(motion, body.base_parameters)
    carried = np.array([1.5, 0.0, 0.0, 0.15, 0.02, 0.0, 0.02, 0.0, 0.0, 0.005])
    load = kinds()['payload'](hand).columns(body, motion, None)[0] @ carried
    samples = replace(motion, outputs=noisy(exact) + load * (motion.time >= 25.0)[:, None])
    named = name_change(body, samples, [], 25.5)
    assert named.effect is not None and (named.effect.kind, named.effect.where) == ('payload', hand)
    assert named.parameters['mass'].value == pytest.approx(1.5, rel=0.02)


@pytest.mark.parametrize('put_down', [False, True])
def test_a_load_is_over_where_it_weighed_something(put_down):
    """Of a robot that picked up another load, the declared one was thought to be over, with a mass below zero."""
    body = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS, 'effort')
    motion, known = smooth_motion(5, 800), kinds()['payload']('a_fore')
    exact, there = body.outputs_of(motion, body.base_parameters), (motion.time < 25.0) == put_down
    load = known.columns(body, motion, None)[0] @ np.array([1.5, 0.0, 0.0, 0.15, 0.02, 0.0, 0.02, 0.0, 0.0, 0.005])
    samples = replace(motion, outputs=noisy(exact) + load * there[:, None])
    fit = starting_fit(body, samples, [known], np.ones(len(samples), dtype=bool))
    assert (change._over(fit, known, (25.5, 25.5)) is not None) == put_down


@pytest.mark.parametrize('left', [0.4, -0.4])
def test_friction_may_be_less_but_drives_no_joint(left):
    """Coulomb friction of -4.4 N m was named, and tried, where an offset had come."""
    body = RigidBody.from_urdf(TWO_ARMS, TWO_ARMS_JOINTS, 'effort')
    motion, joint = smooth_motion(5, 800), 3
    exact, was = body.outputs_of(motion, body.base_parameters), np.array([2.0, left])
    exact[:, joint] += was[(motion.time >= 25.0).astype(int)] * np.tanh(motion.velocity[:, joint] / 0.03)
    fit, _, _ = change._first_fit(body, replace(motion, outputs=noisy(exact)), [], 25.0, None, DEFAULTS,
                                  np.ones(len(motion), dtype=bool))
    friction = kinds()['coulomb_friction'](TWO_ARMS_JOINTS[joint], {'turn_speed': 0.03})
    tried = change._tried(fit, friction, (25.5, 25.5), None)
    assert (tried is not None) == (left > 0.0)


def test_a_zero_slips_at_any_joint_whatever_links_are_called():
    """Where a hand has the name of the joint that carries it, zeros were tried there alone, and a load was put down."""
    alike = TWO_ARMS.replace('a_fore', 'a_elbow').replace('b_fore', 'b_elbow')
    body = RigidBody.from_urdf(alike, TWO_ARMS_JOINTS, 'effort')
    motion = smooth_motion(5, 800)
    turned = motion.position + np.deg2rad([0.0, 4.0, 0.0, 0.0, 0.0]) * (motion.time >= 25.0)[:, None]
    exact = body.outputs_of(replace(motion, position=turned), body.base_parameters)
    named = name_change(body, replace(motion, outputs=noisy(exact)), [], 25.5)
    assert named.effect is not None and (named.effect.kind, named.effect.where) == ('zero_slip', 'a_shoulder')
    assert named.parameters['offset'].value == pytest.approx(np.deg2rad(4.0), rel=0.1)


def came(outputs: str, cause: str, seed: int, at_s: float = PICKED_UP_S):
    """A robot's samples with a cause that came, by the simulator's own arm; and its body."""
    scenario = Scenario(
        outputs=outputs, motion='mixed', samples=1000, seed=seed
    )
    found = simulate(scenario)
    body, samples = body_of(found), samples_of(found)
    arm = true_arm(scenario)
    states = samples.position, samples.velocity, samples.acceleration
    level, rng = arm.evaluate(*states), np.random.default_rng(seed)
    if cause == 'base_shift':
        turn = pin.exp3(np.deg2rad([2.5, -1.5, 0.0]))
        added = arm.with_gravity(turn.T @ arm.model.gravity.linear).evaluate(*states) - level
    elif cause == 'zero_slip':
        turned = samples.position + np.deg2rad([0.0, 4.0, 0.0, 0.0])
        added = arm.evaluate(turned, *states[1:]) - level
    elif cause == 'cable_spring':
        pose = arm.pose(arm.tip, samples.position)
        force = -40.0 * (pose.place - pose.place.mean(axis=0) - rng.uniform(-0.2, 0.2, 3))
        added = arm.load_of_force(pose, force, samples.position)
    else:
        frame = arm.distal_frames()[-1]
        tools = [
            pin.Inertia(mass, np.array(centre), 1e-3 * np.eye(3))
            for mass, centre in ((0.5, [0.03, 0.0, 0.05]), (0.4, [0.0, -0.04, 0.1]))
        ]
        before, after = (arm.with_body(frame, tool).evaluate(*states) - level for tool in tools)
        samples = replace(samples, outputs=samples.outputs + before)
        added = after - before
    late = (samples.time >= at_s)[:, None]
    return body, replace(samples, outputs=samples.outputs + late * added)


@pytest.mark.parametrize('cause', ['base_shift', 'zero_slip', 'cable_spring', 'tool_exchange'])
@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_what_came_is_named(outputs, cause):
    """Another tool was a force, which is from outside; a turn of the base or of a zero was nothing."""
    body, samples = came(outputs, cause, seed=5)
    named = name_change(body, samples, [], PICKED_UP_S + 0.3)
    assert named.effect is not None
    assert (named.effect.kind, named.effect.start_s) == (cause, pytest.approx(PICKED_UP_S, abs=0.2))
    if cause == 'zero_slip':
        assert named.effect.where == JOINTS[1]
        assert named.parameters['offset'].value == pytest.approx(np.deg2rad(4.0), rel=0.1)
    if cause == 'base_shift':
        found = [named.parameters[name].value for name in ('tilt_x', 'tilt_y')]
        assert found == pytest.approx(np.deg2rad([2.5, -1.5]), abs=np.deg2rad(0.3))


def test_what_was_long_taken_for_a_contact_is_named_with_its_time():
    """A cable that had caught fifteen seconds before it was told: its time was sought eight back."""
    body, samples = came('wrench', 'cable_spring', seed=5, at_s=30.0)
    assert name_change(body, samples, [], 45.0).effect.start_s > 36.0
    named = name_change(body, samples, [], 45.0, touched_s=30.3)
    assert named.effect is not None
    assert (named.effect.kind, named.effect.start_s) == ('cable_spring', pytest.approx(30.0, abs=0.2))


def test_a_cable_that_was_named_is_over_when_it_lets_go():
    body, samples = came('wrench', 'cable_spring', seed=5, at_s=25.0)
    _, free = came('wrench', 'cable_spring', seed=5, at_s=1e3)
    outputs = np.where((samples.time < PICKED_UP_S)[:, None], samples.outputs, free.outputs)
    caught = effect_from_text('cable_spring@r_gripper{"start_s": 25.0}')
    named = name_change(body, replace(samples, outputs=outputs), [caught], PICKED_UP_S + 0.3)
    assert named.effect is not None
    assert (named.effect.kind, named.effect.end_s) == (
        'cable_spring',
        pytest.approx(PICKED_UP_S, abs=0.2),
    )


@pytest.mark.parametrize(
    ('beyond', 'likeliest'), [(Gain(14.0, 10.0), 'payload'), (Gain(14.0, 1.0), 'cable_spring')]
)
def test_what_is_likelier_beforehand_is_named_unless_surpassed_beyond_chance(
    monkeypatch, beyond, likeliest
):
    monkeypatch.setattr(change, 'gain', lambda *_: beyond)
    cable, load = (effect_from_text(f'{kind}@r_gripper') for kind in ('cable_spring', 'payload'))
    after = SimpleNamespace(config=DEFAULTS, effects=())
    moves = [
        Move((effect,), after, Gain(100.0, 1.0), price)
        for effect, price in ((cable, 13.0), (load, 1.0))
    ]
    assert change._likeliest(moves).added[0].kind == likeliest


def test_what_a_change_is_named_beside_has_the_columns_that_every_model_of_efforts_has_of_its_joints():
    samples = smooth_motion(4, 50)
    columns = CoupledColumns(ODD_BODY, joint_friction=True)
    own = columns.batch(samples)[0][:, :, ODD_BODY.n_parameters:]
    beside = np.concatenate([effect.columns(ODD_BODY, samples, None)[0] for effect in change._of_joints(ODD_BODY)], 2)
    assert own.shape == beside.shape
    for column in np.moveaxis(own, 2, 0):
        assert np.isclose(beside, column[:, :, None], atol=1e-9).all(axis=(0, 1)).sum() == 1
