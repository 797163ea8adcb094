"""Exported arms whose inertias are known: simulated by MuJoCo, which shares no code with us."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from semiparam_ros.core.robot.consistency import is_consistent
from semiparam_ros.core.robot.frames import load_transform, observed_links
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.effects import effect_from_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.controllers import load_at, require_possible
from semiparam_ros.export.estimate import from_recording
from semiparam_ros.export.identified import identify
from semiparam_ros.export.report import document, lines, price, remark
from semiparam_ros.export.urdf import changed_links, described_links, identified_urdf
from support.arms import ICUB_JOINTS, ICUB_OWN, ICUB_SENSOR

mujoco = pytest.importorskip('mujoco', reason='MuJoCo is not installed')

from support import mujoco_arm  # noqa: E402
from support.mujoco_arm import Robot  # noqa: E402

recording = cache(mujoco_arm.recording)

HOME = (-0.6, 0.7, 0.4, 1.0)
URDF = ICUB_OWN.read_text()
EFFORTS = Robot(URDF, ICUB_JOINTS, HOME)
WRENCH = Robot(URDF, ICUB_JOINTS, HOME, ICUB_SENSOR, 'r_upper_arm')
FRICTION = {'r_shoulder_pitch': (0.4, 0.3), 'r_elbow': (0.1, 0.2)}
LOAD = (0.4, (0.03, -0.02, 0.01), (4e-4, 3e-4, 2e-4))


def heavier(spec):
    """Masses that the description does not know, centres and inertias with them."""
    for index, body in enumerate(spec.bodies[1:]):
        body.mass *= (0.8, 1.25, 0.9, 1.3)[index % 4]
        body.inertia *= (0.85, 1.2, 0.95, 1.25)[index % 4]
        body.ipos += (0.004, -0.003, 0.005)


def rubbing(spec):
    heavier(spec)
    for name, (damping, friction) in FRICTION.items():
        joint = next(joint for joint in spec.joints if joint.name == name)
        joint.damping, joint.frictionloss = [damping, 0.0, 0.0], friction


def loaded(spec):
    mass, centre, inertia = LOAD
    body = spec.body('r_hand').add_body(name='load')
    body.mass, body.ipos, body.inertia, body.explicitinertial = mass, centre, inertia, True


def exported(robot, samples, effects=(), keep=False):
    estimate = from_recording(robot.body, [effect_from_text(text) for text in effects], samples, True, keep, 'it')
    found = identify(estimate, described_links(robot.urdf), keep)
    return found, identified_urdf(robot.urdf, found, remark(found))


def torques(urdf, samples, robot):
    body = RigidBody.from_urdf(urdf, robot.joints, 'wrench' if robot.sensor_joint else 'effort', robot.sensor_joint)
    return body.regressors(samples) @ body.base_parameters


@pytest.fixture(scope='module')
def arm():
    """What was found of an arm that rubs and is heavier, and its URDF."""
    return exported(EFFORTS, recording(EFFORTS, seed=1, prepare=rubbing))


def error_on_unseen_motion(urdf):
    """Root mean square error of a description's torques over those of the true arm."""
    unseen = recording(EFFORTS, seed=7, prepare=rubbing)
    unseen = replace(unseen, acceleration=np.gradient(unseen.velocity, unseen.time, axis=0))
    true = true_torques(unseen, heavier)
    return np.sqrt(np.mean((torques(urdf, unseen, EFFORTS) - true) ** 2) / np.mean(true**2))


def test_torques_on_unseen_motion_are_those_of_the_true_arm(arm):
    assert error_on_unseen_motion(arm[1]) < 0.02
    assert error_on_unseen_motion(URDF) > 0.1


def test_links_change_where_samples_show_it_though_the_model_is_hardly_sure():
    """Noise that a node took for a thousand times what it is; its samples say that links are not as described."""
    samples = recording(EFFORTS, seed=1, prepare=rubbing)
    estimate = from_recording(EFFORTS.body, [], samples, True, False, 'it')
    unsure = estimate._replace(information=1e-3 * estimate.information, held_out=False)
    without, judged = (identified_urdf(URDF, identify(each, described_links(URDF)), '')
                       for each in (unsure._replace(table=None), unsure))
    assert error_on_unseen_motion(judged) < 0.01 < error_on_unseen_motion(without)


def true_torques(samples, prepare):
    """(N, n) inverse dynamics of the true arm, by MuJoCo."""
    from support.mujoco_arm import built

    model = built(EFFORTS, prepare)
    data = mujoco.MjData(model)
    rows = []
    for sample in samples:
        data.qpos[:], data.qvel[:], data.qacc[:] = sample.position, sample.velocity, sample.acceleration
        mujoco.mj_inverse(model, data)
        rows.append(data.qfrc_inverse.copy())
    return np.array(rows)


@pytest.mark.long
def test_pushes_spoil_nothing():
    samples = recording(EFFORTS, seed=1, prepare=rubbing)
    outputs = samples.outputs.copy()
    for begin, end, push in ((5, 6, (3, 2, -1, 2)), (14, 14.5, (-4, 1, 2, -2)), (22, 22.8, (2, -3, 0, 1))):
        outputs[(samples.time > begin) & (samples.time < end)] += push
    _, urdf = exported(EFFORTS, replace(samples, outputs=outputs))
    assert error_on_unseen_motion(urdf) < 0.02


def test_friction_is_that_of_the_joints(arm):
    """At the usual speed: MuJoCo's dry friction gives a little, and looks partly viscous."""
    values = {(each.joint, each.name): each.value for each in arm[0].joints}
    for joint in ICUB_JOINTS:
        damping, friction = FRICTION.get(joint, (0.0, 0.0))
        found = 0.2 * values[joint, 'damping'] + values[joint, 'friction']
        assert found == pytest.approx(0.2 * damping + friction, rel=0.05, abs=1e-3)
        assert values[joint, 'friction'] == pytest.approx(friction, abs=0.03)


@pytest.mark.parametrize('gain', ['effort_gain@r_elbow', 'common_gain'])
def test_friction_beside_a_wrong_gain_is_the_joints_own(gain):
    """Efforts read it a quarter too large: so it went into the URDF, beside inertias without the gain."""
    samples = recording(EFFORTS, seed=1, prepare=rubbing)
    read = np.array([1.25 if gain == 'common_gain' or joint == 'r_elbow' else 1.0 for joint in ICUB_JOINTS])
    found, _ = exported(EFFORTS, replace(samples, outputs=read * samples.outputs), [f'{gain}{{"gain": 0.25}}'])
    values = {(each.joint, each.name): each.value for each in found.joints}
    for joint, (damping, friction) in FRICTION.items():
        assert 0.2 * values[joint, 'damping'] + values[joint, 'friction'] == pytest.approx(
            0.2 * damping + friction, rel=0.05)


def test_friction_of_either_direction_is_told_beside_its_mean():
    """The mean was written, and nothing said that the directions differ."""
    samples = recording(EFFORTS, seed=1, prepare=rubbing)
    turning = np.tanh(samples.velocity[:, 3] / 0.02) > 0.0
    one_way = replace(samples, outputs=samples.outputs + 0.2 * np.outer(turning, np.eye(4)[3]))
    found, _ = exported(EFFORTS, one_way, ['asymmetric_friction@r_elbow{"turn_speed": 0.02}'])
    head = 'asymmetric_friction@r_elbow'
    told = [found.left_out[f'{head}.coulomb_{way}'] for way in ('forward', 'backward')]
    assert dict(found.offsets)['r_elbow'] + (told[0] - told[1]) / 2.0 == pytest.approx(0.1, abs=0.02)  # one freedom
    assert f'{head}.coulomb_forward {told[0]:.3g}' in lines(found)[-1]


def test_every_body_can_be_and_pinocchio_reads_it(arm):
    assert all(is_consistent(values) for values in described_links(arm[1]).values())
    model = pin.buildModelFromXML(arm[1])
    assert all(np.linalg.eigvalsh(pin.PseudoInertia.FromInertia(body).toMatrix()).min() > 0.0
               for body in list(model.inertias)[1:] if body.mass > 0.0)


@pytest.mark.parametrize('turn', ['0 0 0', '0.3 -0.4 1.1'])
def test_inertias_are_read_and_written_as_pinocchio_has_them(arm, turn):
    urdf = URDF.replace('rpy="0 0 0"/>\n      <mass', f'rpy="{turn}"/>\n      <mass')
    assert (turn in urdf) or turn == '0 0 0'
    body = RigidBody.from_urdf(urdf, ICUB_JOINTS, 'effort')
    links = described_links(urdf)
    total = np.zeros_like(body.inertial_parameters)
    for name in observed_links(body):
        if name in links:
            index, transform = load_transform(body, name)
            total[10 * index:10 * index + 10] += transform @ links[name]
    assert np.allclose(total, body.inertial_parameters, atol=1e-9)
    again = described_links(identified_urdf(urdf, arm[0], ''))
    for name, values in arm[0].links.items():
        if name in changed_links(arm[0]):
            assert np.allclose(again[name], values, rtol=1e-8, atol=1e-9)


def test_a_mujoco_model_holds_the_same(arm):
    from semiparam_ros.export.mjcf import identified_mjcf

    model = mujoco.MjModel.from_xml_string(identified_mjcf(arm[1], arm[0], 'how'))
    for name, values in arm[0].links.items():
        assert model.body(name).mass[0] == pytest.approx(values[0], rel=1e-5)
    for each in arm[0].joints:
        attribute = {
            'damping': model.dof_damping, 'friction': model.dof_frictionloss, 'armature': model.dof_armature,
        }[each.name]
        assert attribute[model.joint(each.joint).dofadr[0]] == pytest.approx(each.value, rel=1e-5)


def test_a_description_of_a_tenth_of_the_masses_is_no_reason_to_disbelieve_the_samples():
    """Its errors were taken for slow noise, beside which the samples said too little to mend it."""
    light = re.sub(r'(mass value|i[xyz]{2})="([^"]*)"', lambda found: f'{found[1]}="{0.1 * float(found[2])}"', URDF)
    _, urdf = exported(EFFORTS._replace(urdf=light), recording(EFFORTS, seed=1, prepare=rubbing)[::2])
    assert error_on_unseen_motion(urdf) < 0.02


@pytest.mark.parametrize('declared', [True, False])
def test_an_armature_goes_to_mujoco_and_is_not_negative(declared):
    from semiparam_ros.export.mjcf import identified_mjcf

    def geared(spec):
        joint = next(joint for joint in spec.joints if joint.name == 'r_elbow')
        joint.armature = 0.05

    effects = [f'rotor_inertia@{joint}' for joint in ICUB_JOINTS] if declared else []
    found, urdf = exported(EFFORTS, recording(EFFORTS, seed=2, prepare=geared), effects)
    armature = {each.joint: each.value for each in found.joints if each.name == 'armature'}
    assert armature['r_elbow'] == pytest.approx(0.05, abs=0.005)
    assert min(armature.values()) >= 0.0
    assert 'A robot description holds no armature; MuJoCo models and the JSON file do.' in lines(found)
    model = mujoco.MjModel.from_xml_string(identified_mjcf(urdf, found, ''))
    assert model.dof_armature[model.joint('r_elbow').dofadr[0]] == pytest.approx(armature['r_elbow'], rel=1e-5)


@pytest.mark.parametrize('robot', [EFFORTS, WRENCH], ids=['efforts', 'wrench'])
def test_nothing_changes_where_nothing_was_wrong(robot):
    found, urdf = exported(robot, recording(robot, seed=3))
    assert changed_links(found) == []
    added = ('dynamics', '</joint>', 'Identified by')
    assert without(urdf, *added) == without(URDF, *added)
    assert all(each.value < 5.0 * each.std + 0.01 for each in found.joints)


def without(text, *words):
    return [line for line in text.splitlines() if not any(word in line for word in words)]


def test_what_is_exported_is_found_again_unchanged(arm):
    again = Robot(arm[1], ICUB_JOINTS, HOME)
    samples = recording(again, seed=4)
    found, _ = exported(again, samples)
    assert changed_links(found) == []


@pytest.mark.parametrize('robot', [EFFORTS, WRENCH], ids=['efforts', 'wrench'])
def test_a_load_is_one_of_its_own_where_links_are_known(robot):
    found, urdf = exported(robot, recording(robot, seed=5, prepare=loaded), ['payload@r_hand'], keep=True)
    assert changed_links(found) == []
    mass, centre, inertia = LOAD
    load = found.loads[0]
    assert load.mass == pytest.approx(mass, rel=0.03) and load.start_s is None
    assert np.allclose(load.centre, centre, atol=0.004)
    assert np.allclose(np.diag(load.inertia), inertia, atol=3e-4)
    model = pin.buildModelFromXML(urdf)
    assert model.existBodyName('payload_r_hand')
    total = sum(body.mass for body in list(model.inertias)[1:])
    base = pin.buildModelFromXML(URDF).inertias[0].mass  # of links that do not move
    assert total == pytest.approx(sum(values[0] for values in described_links(URDF).values()) - base + load.mass)
    beside = load_at(robot.body, found, 'r_gripper')
    gripper, hand = (robot.body.arm.frames[robot.body.arm.getFrameId(name)].placement
                     for name in ('r_gripper', 'r_hand'))
    assert np.allclose(beside.centre, gripper.actInv(hand.act(load.centre)), atol=1e-9)
    assert np.allclose(np.linalg.eigvalsh(beside.inertia), np.linalg.eigvalsh(load.inertia), atol=1e-9)


def test_a_load_that_the_samples_do_not_show_is_none():
    found, urdf = exported(WRENCH, recording(WRENCH, seed=6), ['payload@r_hand'])
    assert found.loads == [] and found.not_shown == ['r_hand']
    assert 'payload' not in urdf
    assert 'The samples show no load at r_hand: none is written.' in lines(found)


def joined(before, after):
    """The first half of one recording, then the second one of another."""
    half = len(before) // 2
    return replace(before, **{name: np.concatenate([getattr(before, name)[:half], getattr(after, name)[half:]])
                              for name in ('position', 'velocity', 'acceleration', 'outputs')})


def test_a_load_that_was_there_at_first_and_is_put_down_is_no_load_that_may_be_none():
    """Links between both states were exported beside the sentence that there is no load."""
    samples = joined(recording(WRENCH, seed=8, prepare=loaded), recording(WRENCH, seed=9))
    told = lines(exported(WRENCH, samples, ['payload@r_hand'])[0])
    assert any('the arm is lighter with what is at r_hand, as where a load' in line for line in told)
    alone = lines(exported(WRENCH, recording(WRENCH, seed=8), ['payload@r_hand'])[0])
    assert not any('lighter' in line for line in alone)


@pytest.mark.long
def test_two_loads_on_a_link_begin_each_at_its_own_time():
    def twice(spec):
        loaded(spec)
        body = spec.body('load')
        body.mass, body.inertia = 2.0 * LOAD[0], [2.0 * value for value in LOAD[2]]

    samples = joined(recording(WRENCH, seed=8, prepare=loaded), recording(WRENCH, seed=9, prepare=twice))
    texts = ['payload@r_hand{"start_s": 0.5}', 'payload@r_hand{"start_s": 15.0}']
    found, _ = exported(WRENCH, samples, texts, keep=True)
    assert [(load.link, load.start_s) for load in found.loads] == [('r_hand', 0.5), ('r_hand', 15.0)]


@pytest.mark.parametrize(('declared', 'within'), [
    ('', 0.8), ('{"start_s": 15.0}', 0.0), pytest.param('{"start_stamp_s": %s}', 1e-6, marks=pytest.mark.long)])
def test_a_load_picked_up_later_is_told_from_the_links(declared, within):
    samples = joined(recording(WRENCH, seed=8), recording(WRENCH, seed=9, prepare=loaded))
    start = declared.replace('%s', str(samples.origin * 1e-9 + 15.0))
    found, _ = exported(WRENCH, samples, [f'payload@r_hand{start}'])
    load = found.loads[0]
    assert load.mass == pytest.approx(LOAD[0], rel=0.05)
    assert load.start_s == pytest.approx(15.0, abs=within)


def test_velocities_of_a_recording_are_smoothed_and_not_put_right_twice():
    """The price of a declared filter was another arm: its positions tell the velocities."""
    samples = recording(EFFORTS, seed=3)
    prices = [exported(EFFORTS, samples, effects)[0].price
              for effects in ([], ['velocity_filter{"time_constant_s": 0.1}'])]
    assert prices[0] == prices[1]


def test_a_description_of_bodies_that_cannot_be_is_mended():
    wrong = URDF.replace('ixx="0.000766"', 'ixx="-0.001"').replace('izz="0.00026"', 'izz="0.01"')
    robot = Robot(wrong, ICUB_JOINTS, HOME)
    found, urdf = exported(robot, recording(EFFORTS, seed=3))
    assert sorted(found.mended) == ['r_forearm', 'r_upper_arm']
    assert all(is_consistent(values) for values in described_links(urdf).values())
    assert any('No body has the described inertia of' in line for line in lines(found))


def test_a_description_without_masses_is_refused(arm):
    bare = {name: np.zeros(10) for name in described_links(URDF)}
    estimate = from_recording(EFFORTS.body, [], recording(EFFORTS, seed=1, prepare=rubbing), True, False, 'it')
    with pytest.raises(SemiparamError, match='gives no mass to a link that the outputs feel; expected inertials'):
        identify(estimate, bare)


def test_a_robot_that_rests_for_half_of_the_time_is_judged_where_it_moves(recwarn):
    moving = recording(WRENCH, seed=3)
    rest = np.repeat(len(moving) - 1, len(moving))
    rows = np.concatenate([np.arange(len(moving)), rest])
    stamps = np.arange(len(rows)) * int(moving.stamps[1] - moving.stamps[0])
    found, _ = exported(WRENCH, replace(moving[rows], stamps=stamps))
    assert found.price.consistent < 1.05 * found.price.unconstrained
    assert not [each for each in recwarn if each.category is RuntimeWarning]


def test_efforts_without_friction_are_those_of_bodies_alone():
    samples = recording(EFFORTS, seed=1, prepare=heavier)
    estimate = from_recording(EFFORTS.body, [], samples, False, False, 'it')
    found = identify(estimate, described_links(URDF))
    assert found.joints == [] and found.offsets == {}
    urdf = identified_urdf(URDF, found, '')
    assert 'dynamics' not in urdf and 'r_upper_arm' in changed_links(found)


def test_efforts_give_no_weight_on_a_sensor():
    with pytest.raises(SemiparamError, match='takes the weight off a wrench; expected outputs: wrench'):
        require_possible('gravity-filter', EFFORTS.body)


def test_too_few_samples_are_refused():
    samples = recording(EFFORTS, seed=1)[:30]
    with pytest.raises(SemiparamError, match='it holds 30 samples of a robot that moves; expected at least'):
        from_recording(EFFORTS.body, [], samples, True, False, 'it')


def test_the_document_says_what_the_files_hold(arm):
    told = document(arm[0])
    assert set(told['links']) == set(arm[0].links)
    assert told['links']['r_forearm']['changed']
    assert told['links']['r_forearm']['described']['mass'] == pytest.approx(0.525)
    assert told['joints']['r_elbow']['friction']['unit'] == 'N m'
    assert told['errors']['consistent'] < 1.05 * told['errors']['unconstrained']
    assert price(arm[0]).startswith('On parts left out of the fit the normalised error is')
