"""Wrenches from outside against forces that pinocchio's rnea is given, known tools against heavier descriptions."""

import json
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from semiparam_ros.core.robot.contact_place import ContactPlace
from semiparam_ros.core.robot.external_wrench import ExternalWrench, push_wrench
from semiparam_ros.core.robot.frames import force_maps, last_link
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.tools import Tools, tool_from_text
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.effects import effect_from_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.compensation import bodies_and_bias
from semiparam_ros.online.desired_state import described
from semiparam_ros.settings.build import build_estimator, build_rigid_body
from support.arms import joint, link
from support.learner_stage import Stage
from support.node_helpers import BODY, SETTINGS, URDF, motion

TOOL = {'mass': 0.7, 'centre': [0.01, -0.02, 0.15], 'inertia': [4e-3, 1e-4, -2e-4, 5e-3, 3e-4, 3e-3]}
ONE = np.ones(1)
TEXT = f'ft {json.dumps(TOOL)}'
SNIPPET = """<link name="ft"/><link name="gripper"><inertial><mass value="0.7"/><origin xyz="0 0 0.05"/>
  <inertia ixx="4e-3" ixy="1e-4" ixz="-2e-4" iyy="5e-3" iyz="3e-4" izz="3e-3"/></inertial></link>
  <joint name="flange" type="fixed"><parent link="ft"/><child link="gripper"/><origin xyz="0.01 -0.02 0.1"/></joint>"""


JOINTS = tuple(f'j{number}' for number in range(7))


def chain(share=1.0):
    """Seven joints about two axes in turn, 0.3 m apart, and a sensor behind the third; of so much of its mass."""
    parts, parent = [link('base')], 'base'
    for number, name in enumerate(JOINTS):
        parts += [link(f'l{number}', share * (1.5 - 0.1 * number)),
                  joint(name, 'revolute', parent, f'l{number}', axis='0 1 0' if number % 2 else '0 0 1')]
        parent = f'l{number}'
        if number == 2:
            parts += [link('sensed', share), joint('sensor', 'fixed', parent, 'sensed', '0 0.02 0.05', '0.3 0 0.2')]
            parent = 'sensed'
    parts += [link('tip', 0.2 * share), joint('end', 'fixed', parent, 'tip')]
    return f'<robot name="chain">{"".join(parts)}</robot>'


def arm(outputs, convention='action'):
    """The chain, with the sensor in the upper arm or in the joints."""
    return RigidBody.from_urdf(chain(), JOINTS, outputs, 'sensor' if outputs == 'wrench' else None, convention)


def efforts_against(body, state, frame, wrench):
    """(n,) efforts of the description while a wrench, along the frame's axes, acts there from outside."""
    model, data = body.arm, body.arm.createData()
    q, dq, ddq = (body.arm_vector(values) for values in state)
    index = model.getFrameId(frame, pin.FrameType.BODY)
    item = model.frames[index]
    forces = pin.StdVec_Force([pin.Force.Zero() for _ in range(model.njoints)])
    forces[item.parentJoint] = item.placement.act(pin.Force(wrench))
    return np.array(pin.rnea(model, data, q, dq, ddq, forces))[body.arm_columns]


class Leaves:
    """As much of a prediction as the external wrench looks at."""

    def __init__(self, position, std):
        self.sample = Sample(0, position, 0 * position, 0 * position, np.zeros(len(std)))
        self.std = self.model_std = std
        self.model_covariance = np.diag(std**2)


@pytest.mark.parametrize('seed', range(3))
def test_a_wrench_at_the_last_link_is_found_from_efforts_and_from_a_wrench(seed):
    rng = np.random.default_rng(seed)
    state, wrench = rng.uniform(0.3, 0.9, (3, 7)), np.array([*rng.uniform(-20, 20, 3), *rng.uniform(-3, 3, 3)])
    body = arm('effort')
    link = last_link(body)
    residual = efforts_against(body, state, link, wrench) - efforts_against(body, state, link, np.zeros(6))
    found = ExternalWrench(body).of(Leaves(state[0], np.full(7, 1e-4)), residual, ONE)
    np.testing.assert_allclose(found.wrench, wrench, atol=0.02)
    assert found.std.max() < 0.5
    for convention in 'action', 'reaction':
        sensor = arm('wrench', convention)
        residual = ExternalWrench(sensor, link).outputs_of(state[0]) @ wrench
        there = ExternalWrench(sensor, link).of(Leaves(state[0], np.full(6, 1e-4)), residual, ONE)
        np.testing.assert_allclose(there.wrench, wrench, atol=1e-2)
        at_sensor = ExternalWrench(sensor).of(Leaves(state[0], np.full(6, 1e-4)), residual, ONE)
        assert np.linalg.norm(at_sensor.wrench[:3]) == pytest.approx(np.linalg.norm(wrench[:3]))
        np.testing.assert_array_equal(at_sensor.wrench, -sensor.sign * residual)


def test_a_wrench_is_told_as_it_is_where_a_gain_or_a_zero_is_wrong():
    """Too small a gain of a motor made a push too weak, and turned it."""
    state = np.random.default_rng(0).uniform(0.3, 0.9, (3, 7))
    wrench, body = np.array([20.0, -15.0, 10.0, 1.0, -2.0, 0.5]), arm('effort')
    true, link = (state[0] + 0.3 * np.eye(7)[2], *state[1:]), last_link(body)
    residual = efforts_against(body, true, link, wrench) - efforts_against(body, true, link, np.zeros(6))
    residual[4] *= 0.7
    external = ExternalWrench(body)
    external.shaped_by([effect_from_text('effort_gain@j4{"gain": -0.3}'),
                        effect_from_text('joint_offset@j2{"offset": 0.3}')])
    found = external.of(Leaves(state[0], np.full(7, 1e-4)), residual, ONE)
    np.testing.assert_allclose(found.wrench, wrench, atol=0.02)


@pytest.mark.parametrize('convention', ['action', 'reaction'])
def test_a_wrench_is_told_as_it_is_where_the_sensor_is_turned_in_its_mount(convention):
    wrench, body = np.array([20.0, -15.0, 10.0, 1.0, -2.0, 0.5]), arm('wrench', convention)
    external, leaves = ExternalWrench(body), Leaves(np.zeros(7), np.linspace(0.1, 0.2, 6))
    external.shaped_by([effect_from_text('sensor_misalignment{"rotation_y": 0.2}')])
    turn = np.kron(np.eye(2), Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix())
    found = external.of(leaves, -body.sign * turn.T @ wrench, ONE)
    np.testing.assert_allclose(found.wrench, wrench, atol=1e-9)
    np.testing.assert_allclose(found.covariance, turn @ leaves.model_covariance @ turn.T, atol=1e-12)


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_a_push_that_the_wandering_offset_took_is_within_the_deviation(outputs):
    """A push of 20 N was told as 0 with 5 N, half a second after it began."""
    wrench, position = np.array([12.0, -14.0, 8.0, 0.0, 0.0, 0.0]), np.linspace(0.3, 0.9, 7)
    external = ExternalWrench(arm(outputs))
    push = external.outputs_of(position) @ wrench
    free, taken = (external.of(Leaves(position, np.full(len(push), 1e-3)), 0.0 * push, ONE, offset)
                   for offset in (0.0, push))
    assert free.std.max() < 0.2
    assert taken.std[:3] == pytest.approx(np.abs(wrench[:3]), rel=0.1)
    assert taken.std[3:] == pytest.approx(free.std[3:], rel=0.1) and not taken.wrench.any()


def test_what_a_short_arm_does_not_feel_keeps_the_deviation_of_a_push_and_is_told():
    """Two joints: of six directions at the hand four are never felt, and are zero."""
    body = build_rigid_body(replace(SETTINGS, outputs='effort', sensor_frame=''))
    external = ExternalWrench(body, 'ft')
    position = np.array([0.3, 0.4])
    found = external.of(Leaves(position, np.full(2, 0.01)), np.array([0.5, -0.2]), ONE)
    values = np.linalg.eigvalsh(found.covariance / np.outer(*2 * [push_wrench(body)]))
    assert (values > 0.999).sum() == 4 and (values < 1e-4).sum() == 2
    assert external.outputs_of(position) @ found.wrench == pytest.approx([0.5, -0.2], rel=1e-3)
    assert external.unseen(found).endswith(' at ft') and 'force' in external.unseen(found)
    whole = ExternalWrench(BODY)
    assert not whole.unseen(whole.of(Leaves(position, np.full(6, 0.1)), np.zeros(6), ONE))


def test_a_glitch_beside_which_doubles_hold_nothing_is_told_all_the_same():
    """A wrench of 1e9 N was an internal error of a status: singular matrix, 93 times of 300."""
    rng, external = np.random.default_rng(0), ExternalWrench(BODY, 'upper')
    for _ in range(50):
        leaves = Leaves(rng.uniform(-1.0, 1.0, 2), np.full(6, 1e-12))
        found = external.of(leaves, rng.standard_normal(6), np.ones(6), 1e9 * rng.standard_normal(6))
        assert np.isfinite(found.wrench).all() and np.isfinite(found.std).all()


def test_a_frame_that_is_no_link_is_refused():
    with pytest.raises(SemiparamError, match="link 'hand' is not a link of the robot description"):
        ExternalWrench(BODY, 'hand')


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_the_touched_link_is_the_likeliest(outputs):
    """Of forces of 20 N beside its bones, at rest, with outputs that err by a twentieth of what they feel."""
    body, rng = arm(outputs), np.random.default_rng(0)
    place, right = ContactPlace(body), []
    for _ in range(60):
        position = rng.uniform(-0.7, 0.7, 7)
        maps = force_maps(body, position)[len(place.links):]  # at the centres of mass
        index = rng.integers(len(place.links))
        direction = rng.standard_normal(3)
        change = maps[index] @ (20.0 * direction / np.linalg.norm(direction))
        scale = np.full(body.n_outputs, 0.05)
        if np.abs(change).max() < 20 * scale[0]:
            continue
        place.forget()
        assert not place.probabilities.any()
        for _ in range(5):
            place.see(position, change + scale * rng.standard_normal(len(change)) / 3, scale, 0.02)
        assert place.probabilities.sum() == pytest.approx(1.0)
        right.append(place.probabilities.argmax() == index)
    assert np.mean(right) > 0.85


def test_the_touched_link_is_as_likely_on_an_arm_that_is_lighter_and_pushed_by_less():
    """The forces of a touch were 5 to 80 N on each arm, of a hundredth of a newton of noise too."""
    heavy, light = (ContactPlace(RigidBody.from_urdf(chain(share), JOINTS, 'effort')) for share in (0.4, 0.1))
    position, rng = np.linspace(-0.5, 0.5, 7), np.random.default_rng(0)
    for _ in range(5):
        change, scale = rng.standard_normal(7), np.full(7, 0.2)
        heavy.see(position, change, scale, 0.1)
        light.see(position, 0.25 * change, 0.25 * scale, 0.1)
    np.testing.assert_allclose(light.probabilities, heavy.probabilities, rtol=1e-6)


@pytest.mark.parametrize('text', [TEXT, SNIPPET, f'<robot name="x">{SNIPPET}</robot>', f'  {TEXT}'],
                         ids=['numbers', 'links', 'robot', 'spaces'])
@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_a_tool_adds_what_a_description_with_it_has_more(text, outputs):
    settings = replace(SETTINGS, outputs=outputs, sensor_frame='ft' if outputs == 'wrench' else '')
    with_tool = URDF.replace('</robot>', SNIPPET.replace('<link name="ft"/>', '', 1) + '</robot>')
    bare, heavier = build_rigid_body(settings), build_rigid_body(replace(settings, robot_description=with_tool))
    tools = Tools(bare, [text])
    for state in np.random.default_rng(0).normal(0, 1.5, (5, 3, 2)):
        wanted = heavier.regressor(*state) @ heavier.base_parameters - bare.regressor(*state) @ bare.base_parameters
        np.testing.assert_allclose(tools.outputs(*state), wanted, atol=1e-9)
    assert np.allclose(Tools(bare, [text, f'- {TEXT}']).parameters, 0.0)


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_a_tool_is_measured_by_a_turned_sensor_or_a_wrong_gain_and_hangs_on_a_tilted_base_as_links_do(outputs):
    """What was taken off was that of a perfect sensor on a level base: the rest was learnt as something else."""
    settings = replace(SETTINGS, outputs=outputs, sensor_frame='ft' if outputs == 'wrench' else '')
    with_tool = URDF.replace('</robot>', SNIPPET.replace('<link name="ft"/>', '', 1) + '</robot>')
    bare, heavier = build_rigid_body(settings), build_rigid_body(replace(settings, robot_description=with_tool))
    tilt, zero = Rotation.from_rotvec([0.1, 0.05, 0.0]).inv().apply([0.0, 0.0, -9.81]), np.array([0.0, 0.2])
    texts = ['gravity_tilt{"tilt_x": 0.1, "tilt_y": 0.05}', 'joint_offset@b{"offset": 0.2}']
    if outputs == 'wrench':
        texts.append('sensor_misalignment{"rotation_z": 0.3}')
        measured = np.kron(np.eye(2), Rotation.from_rotvec([0.0, 0.0, -0.3]).as_matrix())
    else:
        texts.append('effort_gain@b{"gain": 0.3}')
        measured = np.diag([1.0, 1.3])
    tools = Tools(bare, [TEXT])
    tools.shaped_by([effect_from_text(each) for each in texts])
    samples = Samples.from_list(motion(50, body=bare))
    for sample, of_recording in zip(samples, tools.outputs_of(samples), strict=True):
        state = sample.position + zero, sample.velocity, sample.acceleration
        true = np.subtract(*(each.with_gravity(tilt).full_regressor(*state) @ each.inertial_parameters
                             for each in (heavier, bare)))
        np.testing.assert_allclose(tools.taken_off(sample)[1], measured @ true, atol=1e-9)
        np.testing.assert_allclose(of_recording, measured @ true, atol=1e-9)
        shown, needed = tools.desired(*sample[1:4])
        np.testing.assert_allclose(shown, measured @ true, atol=1e-9)
        np.testing.assert_allclose(needed, true if outputs == 'wrench' else measured @ true, atol=1e-9)


def test_a_learner_takes_a_known_tool_off_as_its_sensor_shows_it():
    settings = replace(SETTINGS, tools=(TEXT,), effects=('sensor_misalignment{"rotation_z": 0.3}',))
    stage, sample = Stage(settings), motion(1)[0]
    load = Tools(BODY, [TEXT]).outputs(*sample[1:4])
    turned = np.kron(np.eye(2), Rotation.from_rotvec([0.0, 0.0, -0.3]).as_matrix())
    bare = build_estimator(replace(settings, tools=())).predict(sample)
    stage.learner.offer(sample)
    np.testing.assert_allclose(stage.answers[-1].prediction.mean - bare.mean, turned @ load, atol=1e-9)


@pytest.mark.parametrize(('text', 'sentence'), [
    ('', 'cannot be read; expected LINK'), ('ft', 'cannot be read'), ('ft {"mass": }', 'cannot be read'),
    ('ft {"mass": 1, "mass": 2}', 'cannot be read'),  # was 2 kg
    ('ft {"weight": 1}', 'cannot be read'), ('{"mass": 1}', 'cannot be read'), ('ft [1]', 'cannot be read'),
    ('ft {"mass": true}', 'expected 1 finite number of'), ('ft {"mass": NaN}', 'expected 1 finite number of'),
    ('ft {"mass": 1, "centre": [0, 0]}', 'expected 3 finite numbers'), ('ft {"mass": 1e9}', 'of at most 10000'),
    ('ft {"mass": -1}', 'has mass -1 kg'), ('ft {"mass": 1, "inertia": [9, 0, 0, 1, 0, 1]}', 'no moment larger'),
    ('<link', 'is not valid XML'), ('<link name="ft"/>', 'has mass 0 kg'),
    (SNIPPET.replace('fixed', 'revolute'), 'joints that move'),
    pytest.param('ft {"mass": ' + 100_000 * '[', 'cannot be read', id='no end of lists')])
def test_what_is_no_tool_is_refused_in_a_sentence(text, sentence):
    with pytest.raises(SemiparamError, match='(?s).*' + sentence.replace('(', '\\(')) as error:
        tool_from_text(text)
    assert str(error.value).endswith('.') and '\n' not in str(error.value).replace(text, '')


def test_a_tool_at_a_link_that_the_outputs_do_not_feel_is_refused():
    with pytest.raises(SemiparamError, match="link 'upper' is not a link of the robot description that the outputs"):
        Tools(BODY, ['upper {"mass": 1.0}'])
    efforts = build_rigid_body(replace(SETTINGS, outputs='effort', sensor_frame=''))
    with pytest.raises(SemiparamError, match=r"link 'base' is not .* feel; expected one of upper, .*ft\.$"):
        Tools(efforts, ['base {"mass": 1.0}'])  # was an internal error


def test_efforts_tell_no_wrench_at_a_link_that_no_joint_moves():
    """At the base it was zero, whatever pushed; a sensor's wrench is told anywhere."""
    efforts = build_rigid_body(replace(SETTINGS, outputs='effort', sensor_frame=''))
    with pytest.raises(SemiparamError, match=r"link 'base' is not .* feel; expected one of upper, .*ft\.$"):
        ExternalWrench(efforts, 'base')
    assert np.linalg.matrix_rank(ExternalWrench(BODY, 'base').outputs_of(np.zeros(2))) == 6


def test_desired_efforts_carry_the_tools():
    estimator, state = build_estimator(SETTINGS), np.array([[0.3, -0.4], [1.0, 0.5], [2.0, -1.0]])
    with_tool = build_rigid_body(replace(SETTINGS, robot_description=URDF.replace(
        '</robot>', SNIPPET.replace('<link name="ft"/>', '', 1) + '</robot>')))
    model = with_tool.arm
    wanted = np.array(pin.rnea(model, model.createData(), *(with_tool.arm_vector(values) for values in state)))
    added = Tools(BODY, [TEXT]).outputs(*state)
    found = described(estimator, *state, added=(added, added))
    np.testing.assert_allclose(found.efforts, wanted[with_tool.arm_columns], atol=1e-9)


@pytest.mark.parametrize(('joints', 'convention'), [
    (JOINTS, 'action'), (JOINTS, 'reaction'), ((*JOINTS[4:], *JOINTS[:4]), 'action'), (JOINTS[4:5], 'action')])
def test_desired_efforts_of_joints_beyond_the_sensor_carry_the_tools_too(joints, convention):
    """They were those of the description alone, to a deviation of 0: half of the torque of a wrist with its tool."""
    strong = chain().replace('effort="9"', 'effort="900"')
    settings = replace(SETTINGS, robot_description=strong, joints=joints, sensor_frame='sensor',
                       wrench_convention=convention)
    heavy = build_rigid_body(replace(settings, robot_description=strong.replace(
        '</robot>', SNIPPET.replace('<link name="ft"/>', '', 1).replace('"ft"', '"tip"') + '</robot>')))
    tools = Tools(build_rigid_body(settings), [TEXT.replace('ft', 'tip', 1)])
    state = np.random.default_rng(1).normal(0, 1.0, (3, len(joints)))
    added = tools.outputs(*state)
    found = described(build_estimator(settings), *state, added=(added, added), beyond=tools.beyond_sensor(*state))
    wanted = np.array(pin.rnea(heavy.arm, heavy.arm.createData(), *(heavy.arm_vector(values) for values in state)))
    np.testing.assert_allclose(found.efforts, wanted[heavy.arm_columns], atol=1e-9)
    assert Tools(BODY, [TEXT]).beyond_sensor(*np.zeros((3, 2))) is None


def test_torques_of_tools_beyond_the_sensor_are_those_of_joints_as_they_are_on_a_tilted_base():
    """As of all else that is told of a desired state; they were those of a perfect zero on a level base."""
    strong = chain().replace('effort="9"', 'effort="900"')
    settings = replace(SETTINGS, robot_description=strong, joints=JOINTS, sensor_frame='sensor')
    bare, heavy = (build_rigid_body(replace(settings, robot_description=each)) for each in (strong, strong.replace(
        '</robot>', SNIPPET.replace('<link name="ft"/>', '', 1).replace('"ft"', '"tip"') + '</robot>')))
    tools, state = Tools(bare, [TEXT.replace('ft', 'tip', 1)]), np.random.default_rng(1).normal(0, 1.0, (3, 7))
    tools.shaped_by([effect_from_text(text)
                     for text in ('joint_offset@j5{"offset": 0.3}', 'gravity_tilt{"tilt_x": 0.2}')])
    tilt = Rotation.from_rotvec([0.2, 0.0, 0.0]).inv().apply([0.0, 0.0, -9.81])
    models = [each.with_gravity(tilt).arm for each in (heavy, bare)]
    true = state[0] + 0.3 * np.eye(7)[5], state[1], state[2]
    wanted = np.subtract(*(pin.rnea(model, model.createData(), *true)[bare.arm_columns] for model in models))
    np.testing.assert_allclose(tools.beyond_sensor(*state)[bare.beyond_sensor], wanted[bare.beyond_sensor], atol=1e-9)


def test_a_declared_load_that_acts_and_a_sensors_drift_are_part_of_what_is_taken_off():
    settings = replace(SETTINGS, variant='P', effects=('payload@ft{"start_s": 1.0}', 'sensor_drift'))
    estimator, samples = build_estimator(settings), motion(200)
    load = Tools(BODY, [TEXT])
    for sample in samples:
        late = 1e-9 * (sample.stamp - samples[0].stamp)
        outputs = sample.outputs + 0.05 * late
        if late >= 1.0:
            outputs = outputs + load.outputs(*sample[1:4])
        sample = sample._replace(outputs=outputs)
        prediction = estimator.step(sample)
    bodies, bias = bodies_and_bias(estimator, prediction)
    regressor = BODY.regressor(*sample[1:4])
    left = outputs - regressor @ bodies - bias
    assert np.abs(left).max() < 0.5 < np.abs(load.outputs(*sample[1:4])).max()
    before = prediction._replace(columns=np.zeros_like(prediction.columns))  # as before the load's start
    assert bodies[0] - bodies_and_bias(estimator, before)[0][0] == pytest.approx(0.7, abs=0.2)
