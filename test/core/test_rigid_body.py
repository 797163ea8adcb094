"""The rigid-body regressor against pinocchio's rnea and against iDynTree, and its sentences for bad descriptions."""

import gc
import pickle
import re
import time
import weakref
from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.robot import rigid_body
from semiparam_ros.core.robot import urdf as urdf_tree
from semiparam_ros.core.robot.arm_motion import FEW
from semiparam_ros.core.robot.external_wrench import ExternalWrench
from semiparam_ros.core.robot.frames import (
    force_maps,
    frame_motion,
    load_transform,
    loaded_links,
    nearest_link,
    observed_links,
    unit_maps,
)
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import arm_size, radians, reach_of, size_beyond, size_of
from semiparam_ros.core.samples import Samples
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.desired_state import joint_torques
from support.arms import (
    ICUB_JOINTS,
    ICUB_OWN,
    ICUB_SENSOR,
    ODD_ARM,
    ODD_BODY,
    ODD_JOINTS,
    icub,
    idyntree_wrench_and_efforts,
    joint,
    link,
    pinocchio_efforts,
    pinocchio_link_wrench,
    smooth_motion,
)

EXACT = {'rtol': 0, 'atol': 1e-9}


def predicted(body, state):
    return body.regressor(*state) @ body.base_parameters


def states(n_joints, count=20, seed=0):
    return np.random.default_rng(seed).normal(0, 1.5, (count, 3, n_joints))


@pytest.fixture
def icub_full(shared_data):
    return (shared_data / 'icub_arm' / 'iCubGenova01.urdf').read_text()


@pytest.mark.parametrize('outputs', ['effort', 'wrench'])
@pytest.mark.parametrize('tilted', [False, True])
def test_outputs_of_one_state_are_the_regressor_times_the_parameters(outputs, tilted):
    body = icub() if outputs == 'wrench' else ODD_BODY
    body = body.with_gravity(np.array([0.3, -0.2, -9.7])) if tilted else body
    parameters = np.random.default_rng(1).normal(size=body.n_parameters)
    for state in states(body.n_joints, 5):
        np.testing.assert_allclose(body.outputs_at(*state, parameters), body.regressor(*state) @ parameters,
                                   rtol=1e-10, atol=1e-10)


# ---- the wrench at a sensor


def test_wrench_in_the_middle_of_the_real_arm_equals_rnea_and_idyntree(icub_full):
    locked = {'torso_pitch': 0.3, 'torso_yaw': -0.2, 'r_wrist_prosup': 0.4, 'r_wrist_yaw': -0.1}
    body = RigidBody.from_urdf(icub_full, ICUB_JOINTS, 'wrench', ICUB_SENSOR, locked=locked)
    for state in states(4, 5):
        wrench = predicted(body, state)
        np.testing.assert_allclose(
            wrench, pinocchio_link_wrench(icub_full, ICUB_JOINTS, ICUB_SENSOR, locked, *state), **EXACT)
        np.testing.assert_allclose(
            wrench, idyntree_wrench_and_efforts(icub_full, ICUB_JOINTS, 'r_upper_arm', locked, *state)[0], **EXACT)


@pytest.mark.parametrize('neck', ['a_neck', 'z_neck'])
def test_a_branch_that_the_sensor_does_not_feel_changes_nothing(neck):
    """The joints beyond the sensor were taken for the last ones of the robot: of half of all branched ones."""
    head = link('head', 2.0) + joint(neck, 'revolute', 'chest', 'head')
    urdf = ICUB_OWN.read_text().replace('</robot>', f'{head}</robot>')
    body = RigidBody.from_urdf(urdf, (*ICUB_JOINTS, neck), 'wrench', ICUB_SENSOR)
    motion = np.moveaxis(states(5, FEW + 1), 1, 0)
    samples = Samples(np.arange(FEW + 1), *motion, np.zeros((FEW + 1, 6)), 0)
    expected = [predicted(icub(), state[:, :4]) for state in motion.swapaxes(0, 1)]
    np.testing.assert_allclose([predicted(body, state) for state in motion.swapaxes(0, 1)], expected, **EXACT)
    np.testing.assert_allclose(body.regressors(samples) @ body.base_parameters, expected, **EXACT)
    np.testing.assert_allclose(body.outputs_of(samples, body.base_parameters), expected, **EXACT)


@pytest.mark.parametrize('neck', ['a_neck', 'z_neck'])
def test_a_robot_is_as_heavy_as_all_of_its_branches_and_as_long_as_the_longest(neck):
    """Only the first one by name counted, and all of their lengths were one reach."""
    own = icub('effort')
    head = link('head', 0.1, '0 0 0') + joint(neck, 'revolute', 'chest', 'head')
    body = RigidBody.from_urdf(ICUB_OWN.read_text().replace('</robot>', f'{head}</robot>'), (*ICUB_JOINTS, neck),
                               'effort')
    assert size_of(body) == pytest.approx((size_of(own).mass + 0.1, size_of(own).length))
    assert reach_of(body) == pytest.approx(reach_of(own))


def test_wrench_of_the_bundled_arm_equals_that_of_the_whole_robot(icub_full):
    whole = RigidBody.from_urdf(icub_full, ICUB_JOINTS, 'wrench', ICUB_SENSOR)
    for state in states(4, 5):
        np.testing.assert_allclose(predicted(icub(), state), predicted(whole, state), rtol=0, atol=2e-3)


@pytest.mark.parametrize('joints', [ODD_JOINTS, ODD_JOINTS[::-1]])
def test_wrench_with_prismatic_continuous_branching_and_mimic_joints_in_any_order(joints):
    body = RigidBody.from_urdf(ODD_ARM, joints, 'wrench', 'mid_link_ft')
    for state in states(4, 5):
        wrench = predicted(body, state)
        np.testing.assert_allclose(wrench, pinocchio_link_wrench(ODD_ARM, joints, 'mid_link_ft', {}, *state), **EXACT)
        np.testing.assert_allclose(
            wrench, idyntree_wrench_and_efforts(ODD_ARM, joints, 'upper_end', {}, *state)[0], **EXACT)


@pytest.mark.parametrize('frame', ['forearm', 'elbow'])
def test_a_sensor_frame_is_a_link_or_the_joint_that_carries_it(frame):
    body = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'wrench', frame)
    for state in states(4, 5):
        expected = idyntree_wrench_and_efforts(ODD_ARM, ODD_JOINTS, 'forearm', {}, *state)[0]
        np.testing.assert_allclose(predicted(body, state), expected, **EXACT)


def test_a_sensor_with_no_joint_after_it_carries_one_body():
    body = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'wrench', 'tool_joint')
    assert body.bodies == ('tool_joint',)
    assert body.n_parameters == 10
    for state in states(4, 5):
        expected = pinocchio_link_wrench(ODD_ARM, ODD_JOINTS, 'tool_joint', {}, *state)
        np.testing.assert_allclose(predicted(body, state), expected, **EXACT)


def test_a_sensor_at_the_root_carries_the_whole_robot():
    body = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'wrench', 'base')
    mounted = ODD_ARM.replace('</robot>', '<link name="floor"/>' + joint('foot', 'fixed', 'floor', 'base', '0 0 0')
                              + '</robot>')
    for state in states(4, 5):
        expected = pinocchio_link_wrench(mounted, ODD_JOINTS, 'foot', {}, *state)
        np.testing.assert_allclose(predicted(body, state), expected, **EXACT)


@pytest.mark.parametrize('joints', [('lift', 'turn'), ('elbow',), ('grip', 'elbow')])
def test_only_proximal_and_only_distal_joints(joints):
    locked = {name: 0.4 for name in ODD_JOINTS if name not in joints}
    body = RigidBody.from_urdf(ODD_ARM, joints, 'wrench', 'mid_link_ft', locked=locked)
    for state in states(len(joints), 5):
        expected = pinocchio_link_wrench(ODD_ARM, joints, 'mid_link_ft', locked, *state)
        np.testing.assert_allclose(predicted(body, state), expected, **EXACT)


def test_reaction_is_the_opposite_of_action():
    state = states(4, 1)[0]
    np.testing.assert_array_equal(predicted(icub(convention='reaction'), state), -predicted(icub(), state))


# ---- joint efforts


@pytest.mark.parametrize('joints', [ODD_JOINTS, ('grip', 'lift', 'elbow', 'turn'), ('turn', 'elbow'), ('lift',)])
def test_efforts_equal_rnea_and_idyntree(joints):
    locked = {name: -0.6 for name in ODD_JOINTS if name not in joints}
    body = RigidBody.from_urdf(ODD_ARM, joints, 'effort', locked=locked)
    assert (body.n_outputs, body.output_names) == (len(joints), joints)
    for state in states(len(joints), 5):
        efforts = predicted(body, state)
        np.testing.assert_allclose(efforts, pinocchio_efforts(ODD_ARM, joints, locked, *state), **EXACT)
        np.testing.assert_allclose(
            efforts, idyntree_wrench_and_efforts(ODD_ARM, joints, 'forearm', locked, *state)[1], **EXACT)


REAL_ROBOTS = pytest.mark.parametrize(('folder', 'urdf', 'joints'), [
    ('ur3_arm', 'ur3.urdf', [f'{name}_joint' for name in (
        'shoulder_pan', 'shoulder_lift', 'elbow', 'wrist_1', 'wrist_2', 'wrist_3')]),
    ('panda_arm', 'panda.urdf', [f'panda_joint{index}' for index in range(1, 8)])])


@REAL_ROBOTS
def test_efforts_of_real_robots_equal_rnea(shared_data, folder, urdf, joints):
    text = (shared_data / folder / urdf).read_text()
    body = RigidBody.from_urdf(text, joints, 'effort')
    for state in states(len(joints), 5):
        np.testing.assert_allclose(predicted(body, state), pinocchio_efforts(text, joints, {}, *state), **EXACT)


@REAL_ROBOTS
@pytest.mark.parametrize('gravity', [(0.5, 0.2, -9.8), (9.81, 0.0, 0.0)])
def test_a_tilted_base_shows_masses_that_an_upright_first_axis_hides(shared_data, folder, urdf, joints, gravity):
    text = (shared_data / folder / urdf).read_text()
    body = RigidBody.from_urdf(text, joints, 'effort')
    tilted = body.with_gravity(np.array(gravity))
    for state in states(len(joints), 5):
        efforts = pinocchio_efforts(text, joints, {}, *state, gravity)
        np.testing.assert_allclose(tilted.regressor(*state) @ body.base_parameters, efforts, **EXACT)


# ---- base parameters


@pytest.mark.parametrize(('outputs', 'frame'), [('wrench', 'mid_link_ft'), ('effort', None)])
def test_base_parameters_span_all_that_motion_can_show(outputs, frame):
    body = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, outputs, frame)
    full = np.vstack([body.full_regressor(*state) for state in states(4, 200, seed=7)])
    assert body.n_parameters == np.linalg.matrix_rank(full, tol=1e-8 * np.linalg.norm(full, 2))
    np.testing.assert_allclose(body.basis.T @ body.basis, np.eye(body.n_parameters), atol=1e-12)
    np.testing.assert_allclose(full @ body.basis @ body.basis.T, full, atol=1e-8 * np.abs(full).max())


@pytest.mark.parametrize('probes', [50, 400, 1000])
def test_base_parameters_do_not_depend_on_how_they_were_found(monkeypatch, probes):
    reference = icub()
    monkeypatch.setattr(rigid_body, 'MOST_PROBES', probes)
    monkeypatch.setattr(np.linalg, 'svd', mirrored(np.linalg.svd))
    np.testing.assert_allclose(icub().base_parameters, reference.base_parameters, atol=1e-9)
    np.testing.assert_allclose(icub().basis, reference.basis, atol=1e-9)


def test_an_arm_of_many_joints_is_read_in_as_few_states_as_tell_its_parameters(monkeypatch):
    """400 states of an arm of 60 joints took six seconds, of one of 200 joints minutes and gigabytes."""
    names = [f'j{number}' for number in range(40)]
    urdf = ''.join(link(f'l{number}') for number in range(41)) + ''.join(
        joint(name, 'revolute', f'l{number}', f'l{number + 1}', '0 0 0.1',
              axis='0 1 0' if number % 2 else '0 0 1') for number, name in enumerate(names))
    urdf = f'<robot name="long">{urdf}</robot>'
    begun = time.process_time()
    body = RigidBody.from_urdf(urdf, names, 'effort')
    taken = time.process_time() - begun
    begun = time.process_time()
    monkeypatch.setattr(rigid_body, 'LEAST_ROWS', rigid_body.MOST_PROBES * len(names))
    full = RigidBody.from_urdf(urdf, names, 'effort')
    assert taken < 0.6 * (time.process_time() - begun)
    np.testing.assert_allclose(body.basis, full.basis, atol=1e-8)


def mirrored(svd):
    """As another library might: singular vectors of the opposite sign."""
    def wrapped(matrix, **options):
        left, singular, right = svd(matrix, **options)
        return -left, singular, -right
    return wrapped


def test_regressors_of_many_samples_are_those_of_each():
    body, motion = icub(), smooth_motion(4, 7)
    stacked = body.regressors(motion)
    assert stacked.shape == (7, 6, body.n_parameters)
    for row, sample in zip(stacked, motion, strict=True):
        np.testing.assert_array_equal(row, body.regressor(sample.position, sample.velocity, sample.acceleration))
    assert body.regressors(motion[:0]).shape == (0, 6, body.n_parameters)


@pytest.mark.parametrize('options', [('wrench', 'mid_link_ft', 'reaction'), ('effort',)])
@pytest.mark.parametrize('joints', [ODD_JOINTS, ODD_JOINTS[::-1]])
def test_regressors_all_at_once_are_those_of_each_sample(joints, options):
    body = RigidBody.from_urdf(ODD_ARM, joints, *options).with_gravity(np.array([1.0, -0.5, -9.0]))
    motion = smooth_motion(len(joints), 2 * FEW)
    each = [body.full_regressor(sample.position, sample.velocity, sample.acceleration) for sample in motion]
    np.testing.assert_allclose(body.full_regressors(motion), each, atol=1e-12)


@pytest.mark.parametrize(('joints', 'options'), [
    (ODD_JOINTS, ('wrench', 'mid_link_ft', 'reaction')), (ODD_JOINTS[::-1], ('wrench', 'mid_link_ft')),
    (ODD_JOINTS, ('effort',)), (ODD_JOINTS[::-1], ('effort',))])
@pytest.mark.parametrize('gravity', [(0.0, 0.0, -9.81), (1.0, -0.5, -9.0)])
def test_predictions_are_those_of_the_regressors_for_any_base_parameters(joints, options, gravity):
    body = RigidBody.from_urdf(ODD_ARM, joints, *options).with_gravity(np.array(gravity))
    motion = smooth_motion(len(joints), 50)
    for parameters in (np.random.default_rng(0).normal(size=body.n_parameters), np.zeros(body.n_parameters)):
        expected = body.regressors(motion) @ parameters
        np.testing.assert_allclose(body.outputs_of(motion, parameters), expected, atol=1e-11)


@pytest.mark.parametrize('options', [('wrench', 'mid_link_ft', 'reaction'), ('effort',)])
@pytest.mark.parametrize('joints', [ODD_JOINTS, ODD_JOINTS[::-1]])
def test_links_move_alike_seen_one_by_one_and_all_at_once(joints, options):
    body, motion = RigidBody.from_urdf(ODD_ARM, joints, *options), smooth_motion(len(joints), 2 * FEW)
    for name in observed_links(body):
        together = frame_motion(body, motion, name)
        pieces = [frame_motion(body, motion[start:start + FEW // 3], name) for start in range(0, 2 * FEW, FEW // 3)]
        for role, all_at_once, *few in zip(together._fields, together, *pieces, strict=True):
            np.testing.assert_allclose(np.concatenate(few), all_at_once, atol=1e-12, err_msg=f'{name} {role}')
    moved = [frame_motion(body, motion, name) for name in loaded_links(body)]
    found = force_maps(body, motion.position[3])
    np.testing.assert_allclose(found[:len(moved)], [frame.force_map[3] for frame in moved], atol=1e-12)
    frames = [body.arm.frames[body.arm.getFrameId(name)] for name in loaded_links(body)]
    centres = [frame.placement.actInv(body.arm.inertias[frame.parentJoint].lever) for frame in frames]
    np.testing.assert_allclose(found[len(moved):], [frame.at(point).force_map[3] for frame, point in
                                                    zip(moved, centres, strict=True)], atol=1e-12)


@pytest.mark.parametrize('chosen', [('grip',), ('elbow', 'lift')])
def test_efforts_of_some_joints_are_those_rows_of_all(chosen):
    joints = ('turn', 'lift', 'grip', 'elbow')  # in another order than the tree
    every = RigidBody.from_urdf(ODD_ARM, joints, 'effort')
    body = RigidBody.from_urdf(ODD_ARM, joints, 'effort', output_joints=chosen)
    rows = [index for index, name in enumerate(joints) if name in chosen]
    assert body.output_names == tuple(joints[row] for row in rows) and body.n_outputs == len(body.output_units)
    np.testing.assert_array_equal(body.effort_limits, every.effort_limits[rows])
    motion = smooth_motion(4, 2 * FEW)
    np.testing.assert_allclose(body.regressors(motion) @ body.base_parameters,
                               (every.regressors(motion) @ every.base_parameters)[:, rows], atol=1e-9)
    np.testing.assert_allclose(body.outputs_of(motion, body.base_parameters),
                               every.outputs_of(motion, every.base_parameters)[:, rows], atol=1e-9)
    state = states(4, 1)[0]
    np.testing.assert_allclose(predicted(body, state), predicted(every, state)[rows], **EXACT)
    name = list(loaded_links(every))[-1]
    np.testing.assert_allclose(frame_motion(body, motion, name).force_map,
                               frame_motion(every, motion, name).force_map[:, rows], atol=1e-12)
    place = motion.position[3]
    links, whole = list(loaded_links(every)), force_maps(every, place)[:, rows]
    felt = np.tile([link in loaded_links(body) for link in links], 2)
    np.testing.assert_allclose(force_maps(body, place), whole[felt], atol=1e-12)
    np.testing.assert_array_equal(whole[~felt], 0.0)
    with pytest.raises(SemiparamError, match="output_joints names 'wrist'; expected some of the joints turn, lift"):
        RigidBody.from_urdf(ODD_ARM, joints, 'effort', output_joints=['wrist'])


@pytest.mark.parametrize('chosen', [('grip',), ('elbow',), ('turn', 'grip'), ('lift',)])
def test_efforts_feel_the_links_that_their_joints_carry_and_no_others(chosen):
    """A load, or a wrench from outside, at a link that only other joints carry was accepted, and told as zero."""
    every = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'effort')
    body = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'effort', output_joints=chosen)
    position = np.array([0.3, -0.5, 0.7, 0.2])
    for name in observed_links(every):
        pushed = np.abs(ExternalWrench(every, name).outputs_of(position)[[ODD_JOINTS.index(each) for each in chosen]])
        feels = bool(pushed.max() > 0.0)
        assert (name in observed_links(body)) is feels
        assert feels or name not in loaded_links(body)
        if not feels:
            for refused in (ExternalWrench, load_transform):
                with pytest.raises(SemiparamError, match=f"link '{name}' is not a link .* that the outputs feel"):
                    refused(body, name)


def test_a_description_without_inertias_still_has_a_regressor():
    bare = re.sub(r'<inertial>.*?</inertial>', '', ODD_ARM)
    given = RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'wrench', 'mid_link_ft')
    body = RigidBody.from_urdf(bare, ODD_JOINTS, 'wrench', 'mid_link_ft')
    assert body.n_parameters == given.n_parameters
    np.testing.assert_array_equal(body.base_parameters, 0.0)
    state = states(4, 1)[0]
    np.testing.assert_allclose(body.regressor(*state) @ (body.basis.T @ given.inertial_parameters),
                               predicted(given, state), **EXACT)


# ---- what a description may hold


@pytest.mark.parametrize('kind', ['floating', 'planar'])
def test_joints_that_are_not_one_number_stay_where_they_are(kind):
    loose = ODD_ARM.replace('</robot>', link('cart') + joint('loose', kind, 'forearm', 'cart') + '</robot>')
    fixed = loose.replace(f'type="{kind}"', 'type="fixed"')
    state = states(4, 1)[0]
    np.testing.assert_allclose(
        predicted(RigidBody.from_urdf(loose, ODD_JOINTS, 'wrench', 'mid_link_ft'), state),
        predicted(RigidBody.from_urdf(fixed, ODD_JOINTS, 'wrench', 'mid_link_ft'), state), **EXACT)


@pytest.mark.parametrize('options', [('effort',), ('wrench', 'mid_link_ft')])
@pytest.mark.parametrize(('joints', 'name', 'instead'), [
    (ODD_JOINTS, 'elbow', 'root_joint'), (ODD_JOINTS, 'forearm', 'grip'), (ODD_JOINTS[:3], 'forearm', 'grip'),
    (ODD_JOINTS, 'tool', 'tool_joint'), (ODD_JOINTS, 'tool', 'mid_link_ft')])
def test_any_joint_may_have_any_name_and_a_link_that_of_a_joint(joints, options, name, instead):
    """As the gripper of the SO-100, and left_hand of Baxter: pinocchio asked which of the two was meant."""
    renamed = ODD_ARM.replace(f'"{name}"', f'"{instead}"')
    assert renamed != ODD_ARM
    state = states(len(joints), 1)[0]
    named = RigidBody.from_urdf(renamed, [instead if joint == name else joint for joint in joints], *options)
    plain = RigidBody.from_urdf(ODD_ARM, joints, *options)
    np.testing.assert_allclose(predicted(named, state), predicted(plain, state), **EXACT)


# ---- sentences


def read(urdf=ODD_ARM, joints=ODD_JOINTS, outputs='wrench', frame='mid_link_ft', **options):
    return RigidBody.from_urdf(urdf, joints, outputs, frame, **options)


@pytest.mark.parametrize(('options', 'sentence'), [
    ({'urdf': 'not xml'}, 'not valid XML'),
    ({'urdf': ''}, 'not valid XML'),
    ({'urdf': '<sdf/>'}, 'starts with <sdf>'),
    ({'urdf': '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="arm"/></robot>'},
     'is xacro, which is no URDF yet; expand it first, by xacro FILE > FILE.urdf'),
    ({'urdf': ODD_ARM.replace('</robot>', '<a xmlns:x="http://ros.org/wiki/xacro"><x:hand/></a></robot>')}, 'is xacro'),
    ({'urdf': ODD_ARM.replace('</robot>', '<a>' * 2000 + '</a>' * 2000 + '</robot>')},
     'elements lie more than 100 deep within each other'),
    ({'urdf': ODD_ARM.replace('"forearm"', '"universe"')}, "a link is called 'universe', a name that is taken"),
    ({'urdf': ODD_ARM.replace('"elbow"', '"semiparam_sensor"')}, "a joint is called 'semiparam_sensor'"),
    ({'urdf': ODD_ARM.replace('xyz="0 0 0.2"', 'xyz="0 0 2e4"')}, 'origin xyz="0 0 2e4"; expected numbers up to 10000'),
    ({'urdf': re.sub('mass value="[^"]*"', 'mass value="1e300"', ODD_ARM)},
     'mass value="1e300"; expected numbers up to 1e+09'),
    ({'urdf': ODD_ARM.replace('"elbow"', '"universe"')}, "a joint is called 'universe', a name that is taken"),
    ({'urdf': '<robot name="x"/>'}, 'holds 0 links'),
    ({'urdf': ODD_ARM.replace('<parent link="turret"/>', '<parent link="tower"/>')},
     "robot description: joint 'mid_link_ft' has the parent link 'tower', which is not described"),
    ({'urdf': ODD_ARM.replace('mass value="0.9"', 'mass value="heavy"')},
     "link 'forearm' has mass value=\"heavy\"; expected 1 finite number"),
    ({'urdf': ODD_ARM.replace('<child link="forearm"/>', '')}, "joint 'elbow' has no child link"),
    ({'urdf': ODD_ARM.replace('type="revolute"', 'type="revolutionary"')},
     "joint 'elbow' has type 'revolutionary'"),
    ({'urdf': ODD_ARM.replace('mass value="0.9"', 'mass value="nan"')}, 'expected 1 finite number'),
    ({'urdf': ODD_ARM.replace('mass value="0.9"', 'mass value="1_0"')}, 'expected 1 finite number'),  # was none
    ({'urdf': ODD_ARM.replace('mass value="0.9"', 'mass value="\u0669"')}, 'expected 1 finite number'),
    ({'urdf': ODD_ARM + '<!-- \ud800 -->'}, 'not valid XML'),  # as YAML has it: "\ud800"
    ({'urdf': ODD_ARM.replace('mass value="0.9"', 'mass value="-0.9"')}, "link 'forearm' has a negative mass"),
    ({'urdf': ODD_ARM.replace('<mass value="0.9"/>', '')}, "link 'forearm' has an inertial without mass value"),
    ({'urdf': ODD_ARM.replace('xyz="0 0 0.2"', 'xyz="0 0.2"')}, "joint 'elbow' has origin xyz"),
    ({'urdf': ODD_ARM.replace('axis xyz="0 1 0"', 'axis xyz="0 0 0"')}, "joint 'elbow' moves about the axis"),
    ({'urdf': ODD_ARM.replace('link name="finger"', 'link name="thumb"')}, "two links are called 'thumb'"),
    ({'urdf': ODD_ARM.replace('child link="finger"', 'child link="thumb"')}, "'thumb' is the child of two joints"),
    ({'joints': ['lift', 'elbw']}, "joint 'elbw' is not in the robot description; its moving joints are: lift, turn"),
    ({'joints': ['tool_joint']}, "joint 'tool_joint' is fixed"),
    ({'joints': ['lift', 'lift']}, 'named twice'),
    ({'joints': []}, 'no joints are named'),
    ({'frame': 'mid_link'}, "sensor frame 'mid_link' is neither a link nor a joint"),
    ({'frame': 'mid_link'}, 'names that look like a sensor: mid_link_ft'),
    ({'frame': ''}, 'sensor_frame is empty'),
    ({'outputs': 'torque'}, "outputs 'torque' is unknown; expected one of wrench, effort"),
    ({'convention': 'act'}, "wrench_convention 'act' is unknown"),
    ({'joints': ['lift', 'turn'], 'locked': {'elbw': 0.1}}, "locked joint 'elbw'"),
    ({'joints': ['lift', 'turn'], 'locked': {'elbow': float('nan')}}, "locked joint 'elbow'"),
    ({'locked': {'elbow': 0.1}}, "joint 'elbow' is named both among the moving and the locked joints"),
])
def test_a_bad_description_or_name_becomes_one_sentence(options, sentence):
    with pytest.raises(SemiparamError, match=re.escape(sentence)) as error:
        read(**options)
    assert '\n' not in str(error.value)


def test_loops_and_two_roots_are_refused():
    loop = ODD_ARM.replace('</robot>', joint('back', 'fixed', 'tool', 'base') + '</robot>')
    with pytest.raises(SemiparamError, match=r"0 links are nobody's child \(a loop\)"):
        read(loop)
    with pytest.raises(SemiparamError, match=r"2 links are nobody's child \(base, orphan\)"):
        read(ODD_ARM.replace('</robot>', link('orphan') + '</robot>'))
    ring = link('a') + link('b') + joint('ab', 'fixed', 'a', 'b') + joint('ba', 'fixed', 'b', 'a')
    with pytest.raises(SemiparamError, match="link 'a' is part of a loop"):
        read(ODD_ARM.replace('</robot>', ring + '</robot>'))


def test_a_joint_without_limits_is_read():
    free = re.sub('<limit [^>]*>', '', ODD_ARM)
    state = states(4, 1)[0]
    np.testing.assert_array_equal(predicted(read(free), state), predicted(read(), state))


def test_the_reading_of_a_description_leaves_no_trace_on_the_terminal(capfd):
    with pytest.raises(SemiparamError):
        read(ODD_ARM.replace('<parent link="turret"/>', '<parent link="tower"/>'))
    out, err = capfd.readouterr()
    assert (out, err) == ('', '')


def test_samples_of_the_wrong_width_are_refused():
    body = icub()
    motion = smooth_motion(3, 2)
    with pytest.raises(SemiparamError, match='4 joints'):
        body.regressors(Samples(motion.stamps, motion.position, motion.velocity, motion.acceleration,
                                motion.outputs, 0))


@pytest.mark.parametrize(('joint', 'count', 'sentence'), [
    ('revolute', 250, 'it has 250 moving joints; expected at most 200'),
    ('fixed', 1100, 'it has 1101 links; expected at most 1000')])
def test_a_description_of_more_than_a_robot_is_refused_at_once(joint, count, sentence):
    """A thousand moving joints, in a quarter of a megabyte, took all memory there was."""
    parts = [f'<link name="l{index + 1}"/><joint name="j{index}" type="{joint}"><parent link="l{index}"/>'
             f'<child link="l{index + 1}"/></joint>' for index in range(count)]
    with pytest.raises(SemiparamError, match=sentence):
        urdf_tree.parse(f'<robot name="x"><link name="l0"/>{"".join(parts)}</robot>')
    with pytest.raises(SemiparamError, match='has 2000001 characters; expected at most 2000000'):
        urdf_tree.parse('<' * 2_000_001)


def test_units_along_a_joint_that_slides():
    assert ODD_BODY.prismatic == {'lift'} and ODD_BODY.output_units == ('N', 'N m', 'N m', 'N m')
    turning = ('rad', 'rad/s', 'N m', 'N m s/rad', 'N m s/(rad K)', 'kg m^2', '1/(N m)', '1/(N^2 m^2)', 's')
    assert [ODD_BODY.joint_unit('lift', unit) for unit in turning] == [
        'm', 'm/s', 'N', 'N s/m', 'N s/(m K)', 'kg', '1/N', '1/N^2', 's']
    assert tuple(ODD_BODY.joint_unit('turn', unit) for unit in turning) == turning
    assert icub().output_units == ('N',) * 3 + ('N m',) * 3


@pytest.mark.parametrize(('joints', 'locked', 'offset', 'told'), [
    (ODD_JOINTS, {}, '', True), ((*ODD_JOINTS, 'grip_mimic'), {}, '', False),
    (ODD_JOINTS[:3], {}, '', False), (ODD_JOINTS[:3], {}, 'offset="0.2"', True),
    (ODD_JOINTS[:3], {'grip': 0.3}, '', True), (ODD_JOINTS[:3], {'grip': 0.3, 'grip_mimic': -0.3}, '', False)])
def test_a_mimic_joint_that_is_held_elsewhere_than_its_leader_puts_it_is_told(joints, locked, offset, told):
    """A palletiser's wrist, held level by a mimic of the elbow, had half its mass and a joint 9 degrees off."""
    urdf = ODD_ARM.replace('multiplier="-1"', f'multiplier="-1" {offset}')
    remark = RigidBody.from_urdf(urdf, joints, 'effort', locked=locked).remark
    assert ('joints that mimic others, grip_mimic (of grip), but are held where' in remark) == told
    assert bool(remark) == told


def test_a_mimic_joint_that_follows_by_no_number_is_refused():
    with pytest.raises(SemiparamError, match='joint \'grip_mimic\' has mimic multiplier="x"; expected 1 finite number'):
        RigidBody.from_urdf(ODD_ARM.replace('multiplier="-1"', 'multiplier="x"'), ODD_JOINTS, 'effort')


@pytest.mark.parametrize(('outputs', 'frame'), [('effort', None), ('wrench', 'mid_link_ft')])
@pytest.mark.parametrize('joints', [('lift', 'turn', 'elbow'), ('turn', 'elbow', 'grip')])
def test_a_load_hangs_on_no_link_beyond_a_locked_joint(joints, outputs, frame):
    body = RigidBody.from_urdf(ODD_ARM, joints, outputs, frame, locked={'grip_mimic': 0.3})
    assert 'thumb' in observed_links(body) and 'thumb' not in loaded_links(body)
    assert ('finger' in loaded_links(body)) == ('grip' in joints)
    assert 'tool' in loaded_links(body)
    inside = body.arm.frames[body.arm.getFrameId('thumb')].placement.translation  # forearm and body share their frame
    assert nearest_link(body, 'forearm', inside)[0] == 'tool'
    assert nearest_link(body, 'thumb', np.zeros(3))[0] == 'thumb'


@pytest.mark.parametrize('options', [('effort', None), ('wrench', 'mid_link_ft')])
def test_a_robot_of_one_joint_is_an_arm_of_which_the_others_rest(options):
    """pinocchio gives its Jacobian as a vector, over which contacts and outside forces stumbled."""
    alone, arm = (RigidBody.from_urdf(ODD_ARM, joints, *options) for joints in (('elbow',), ('elbow', 'turn')))
    motion = smooth_motion(1, 2 * FEW)
    roles = 'position', 'velocity', 'acceleration'
    still = replace(motion, **{role: np.column_stack([getattr(motion, role), np.zeros(2 * FEW)]) for role in roles})
    both = (alone, motion), (arm, still)
    rows = slice(0, alone.n_outputs)
    for few in (slice(0, FEW // 2), slice(None)):
        found, expected = (frame_motion(body, samples[few], 'tool') for body, samples in both)
        for role in ('position', 'velocity', 'turning'):
            np.testing.assert_allclose(getattr(found, role), getattr(expected, role), atol=1e-12)
        np.testing.assert_allclose(found.force_map, expected.force_map[:, rows], atol=1e-12)
    points = np.array([[0.1, 0.2, 0.3]])
    for found, expected in zip(unit_maps(alone, motion.position[3], [alone.arm.njoints - 1], points),
                               unit_maps(arm, still.position[3], [arm.arm.njoints - 1], points), strict=True):
        np.testing.assert_allclose(found, expected[:, rows], atol=1e-12)
    wrenches = [ExternalWrench(body, 'tool').outputs_of(samples.position[3])[rows]
                for body, samples in both]
    np.testing.assert_allclose(*wrenches, atol=1e-12)
    if alone.outputs == 'wrench':
        torques = [joint_torques(body, *(getattr(samples, role)[3] for role in roles), np.arange(6.0))[0][:1]
                   for body, samples in both]
        np.testing.assert_allclose(*torques, atol=1e-9)


def test_what_the_description_says_of_friction_refuses_no_robot():
    rubbing = ODD_ARM.replace('<axis', '<dynamics damping="nan" friction="-1"/><axis')
    body = RigidBody.from_urdf(rubbing, ODD_JOINTS, 'effort')
    np.testing.assert_array_equal(body.base_parameters, ODD_BODY.base_parameters)


@pytest.mark.parametrize(('before', 'after'), [
    ('mass value="0.9"', 'mass value=" 0.9\n"'),  # the body was without any mass
    *[('axis xyz="0 1 0"', f'axis xyz="0 {length} 0"') for length in ('1e-200', '1e200', '5e-324')]])  # moved nothing
def test_spaces_about_a_number_and_the_length_of_an_axis_change_nothing(before, after):
    state = states(4, 1)[0]
    assert before in ODD_ARM
    read_alike = read(ODD_ARM.replace(before, after))
    np.testing.assert_allclose(predicted(read_alike, state), predicted(read(), state), **EXACT)


def test_what_is_remembered_of_a_robot_goes_with_it():
    """A node's models each bring their own: caches that hold them would hold those of the latest hundreds."""
    body = pickle.loads(pickle.dumps(RigidBody.from_urdf(ODD_ARM, ODD_JOINTS, 'effort')))
    last = list(loaded_links(body))[-1]
    sizes = size_of(body), arm_size(body), reach_of(body), size_beyond(body, ODD_JOINTS[0])
    assert load_transform(body, last) is load_transform(body, last)
    assert radians(body) is radians(body)
    force_maps(body, np.zeros(len(ODD_JOINTS)))
    copy, there = pickle.loads(pickle.dumps(body)), weakref.ref(body)
    assert sizes == (size_of(copy), arm_size(copy), reach_of(copy), size_beyond(copy, ODD_JOINTS[0]))
    assert observed_links(copy) == observed_links(body)
    del body
    gc.collect()
    assert there() is None
