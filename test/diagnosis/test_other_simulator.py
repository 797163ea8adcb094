"""Diagnoses of recordings by another simulator (MuJoCo), of three arms at 100 Hz: names, places and values."""

from dataclasses import replace

import numpy as np
import pytest

from support.arms import ICUB_JOINTS, ICUB_OWN, ICUB_SENSOR

mujoco = pytest.importorskip('mujoco', reason='MuJoCo is not installed')

from semiparam_ros.diagnosis.diagnose import diagnose  # noqa: E402
from support.mujoco_arm import GRAVITY, Robot, recording  # noqa: E402

SECONDS, LONG_S = 14.0, 20.0
HALF_S = SECONDS / 2
RUBBING = ('viscous_friction', 'coulomb_friction', 'asymmetric_friction', 'stribeck_friction',
           'load_friction', 'backlash', 'joint_spring')
STANDING = ('joint_offset', 'gravity_tilt', 'payload', 'external_force', 'base_shift',
            'effort_offset')
"""Kinds that resemble each other."""
ICUB = Robot(ICUB_OWN.read_text(), ICUB_JOINTS, (-0.6, 0.7, 0.4, 1.0), ICUB_SENSOR, 'r_upper_arm')
UR3_JOINTS = tuple(f'{name}_joint' for name in (
    'shoulder_pan', 'shoulder_lift', 'elbow', 'wrist_1', 'wrist_2', 'wrist_3'))


@pytest.fixture(scope='module')
def ur3(shared_data):
    return Robot((shared_data / 'ur3_arm' / 'ur3.urdf').read_text(), UR3_JOINTS, (0.0, -1.3, 1.2, -0.8, -1.2, 0.3))


@pytest.fixture(scope='module')
def wrist(shared_data):
    joints = tuple(f'panda_joint{number}' for number in range(1, 8))
    return Robot((shared_data / 'panda_arm' / 'panda.urdf').read_text(), joints, (0.0, -0.3, 0.0, -1.8, 0.0, 1.8, 0.6),
                 'panda_joint8', 'panda_link8')


def pushing(link, force, from_s=0.0):
    """A force [N] on a link's centre of mass, constant or a function of the model and its state."""
    def act(model, data):
        if data.time >= from_s:
            body = model.body(link).id
            data.xfrc_applied[body, :3] = force(model, data, body) if callable(force) else force
    return act


@pytest.fixture(scope='module')
def diagnosed(long):
    """Diagnoses what a robot records: among the kinds told, or among all of them in the long form."""
    def run(robot, *rivals, seconds=LONG_S if long else SECONDS, **hidden):
        samples = recording(robot, seconds=seconds, **hidden)
        found = diagnose(robot.body, samples, only=() if long else rivals)
        assert not found.setup
        return found
    return run


def named(found):
    return [(finding.effect.kind, finding.effect.where) for finding in found.findings]


def values(finding, *names):
    return [finding.parameters[name].value for name in names]


def test_nothing_is_missing_of_an_ur3(ur3, diagnosed):
    found = diagnosed(ur3)
    assert (found.verdict, named(found)) == ('nothing_missing', [])
    assert found.before.nmse.max() < 1e-3


def test_friction_of_a_joint_of_an_ur3(ur3, diagnosed):
    def oiled(spec):
        spec.joint('elbow_joint').damping = [1.5, 0.0, 0.0]

    found = diagnosed(ur3, *RUBBING, prepare=oiled)
    assert named(found) == [('viscous_friction', 'elbow_joint')]
    assert values(found.findings[0], 'viscous') == pytest.approx([1.5], rel=0.01)


@pytest.mark.long
def test_dry_friction_that_turns_softly(ur3, diagnosed):
    """MuJoCo's dry friction is a soft constraint: it turns over within 0.1 rad/s on a light arm."""
    def worn(spec):
        spec.joint('elbow_joint').frictionloss = 2.0

    found = diagnosed(ur3, *RUBBING, prepare=worn)
    assert (found.verdict, named(found)[0]) == ('effect_found', ('coulomb_friction', 'elbow_joint'))
    assert values(found.findings[0], 'coulomb') == pytest.approx([2.0], rel=0.1)


def test_a_base_that_is_not_level(ur3, diagnosed):
    """Its first axis stands upright in the description: a tilt shows masses that no level base shows."""
    tilt = np.radians(3.0)

    def tilted(spec):
        spec.option.gravity = [GRAVITY * np.sin(tilt), 0.0, -GRAVITY * np.cos(tilt)]

    found = diagnosed(ur3, *STANDING, prepare=tilted)
    assert named(found) == [('gravity_tilt', None)]
    assert values(found.findings[0], 'tilt_x', 'tilt_y') == pytest.approx([0.0, tilt], abs=0.002)


@pytest.mark.long
def test_a_push_from_half_time_on(ur3, diagnosed):
    """So strong that no inertias explain the efforts."""
    force = (0.0, 8.0, -10.0)
    found = diagnosed(ur3, 'external_force', 'payload', 'joint_offset', 'effort_offset', 'gravity_tilt',
                      act=pushing('wrist_3_link', force, 0.5 * LONG_S), seconds=LONG_S)
    assert named(found)[0] == ('external_force', 'wrist_3_link')
    assert values(found.findings[0], 'force_x', 'force_y', 'force_z') == pytest.approx(force, abs=0.05)
    assert found.findings[0].effect.start_s == pytest.approx(0.5 * LONG_S, abs=2.5)


@pytest.mark.parametrize('mass', [pytest.param(0.5, marks=pytest.mark.long), 2.5])
def test_what_a_hand_picks_up_is_weighed_by_a_wrist_sensor(wrist, diagnosed, mass):
    """More than the hand itself: nothing was found, or a cable, of what weighs as much as all that the sensor feels."""
    def load(spec):
        body = spec.body('panda_hand').add_body(name='load', pos=[0.02, 0.0, 0.1])
        body.mass, body.inertia, body.explicitinertial = 1e-6, [1e-9] * 3, True

    def pick_up(model, data):
        if data.time >= HALF_S and model.body('load').mass[0] < 0.1:
            model.body('load').mass, model.body('load').inertia = mass, [2e-3] * 3
            mujoco.mj_setConst(model, mujoco.MjData(model))

    found = diagnosed(wrist, 'payload', 'external_force', 'sensor_offset', 'sensor_gain', 'joint_offset',
                      prepare=load, act=pick_up)
    assert [kind for kind, _ in named(found)] == ['payload']
    assert values(found.findings[0], 'mass') == pytest.approx([mass], rel=0.01)


@pytest.mark.long
def test_a_spring_between_the_hand_and_the_room(diagnosed):
    anchor = []

    def pull(model, data, body):
        anchor.append(data.xipos[body].copy())
        return -15.0 * (data.xipos[body] - anchor[0])

    found = diagnosed(ICUB, 'cable_spring', 'cable_hysteresis', 'external_force', 'payload', 'viscous_drag',
                      'joint_offset', act=pushing('r_hand', pull))
    assert named(found)[0][0] == 'cable_spring'
    assert found.after.nmse.mean() < 0.01 * found.before.nmse.mean()
    stiffness = values(found.findings[0], 'stiffness_xx', 'stiffness_yy', 'stiffness_zz')
    assert stiffness == pytest.approx([15.0] * 3, rel=0.02)


def test_a_hand_in_water(diagnosed):
    def drag(model, data, body):
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        return -3.0 * velocity[3:]

    found = diagnosed(ICUB, act=pushing('r_hand', drag))
    assert named(found)[0][0] == 'viscous_drag'
    assert values(found.findings[0], 'drag') == pytest.approx([3.0], rel=0.03)


@pytest.mark.long
def test_zeros_of_several_encoders(diagnosed):
    offsets = np.radians([2.0, 1.5, -2.0, 0.0])
    found = diagnosed(ICUB, zeros=-offsets)
    assert named(found) == [('joint_offset', joint) for joint in ICUB_JOINTS[:3]]
    assert [values(finding, 'offset')[0] for finding in found.findings] == pytest.approx(offsets[:3], abs=0.001)


def test_late_efforts_of_joints_with_friction(ur3, long):
    """Joint by joint, a delay looks like bristles that bend before they slide."""
    samples = recording(ur3, seed=1, seconds=LONG_S if long else SECONDS)
    rubbing = 1.5 * np.tanh(samples.velocity / 0.02) + samples.velocity
    late = np.concatenate([samples.outputs[:2], (samples.outputs + rubbing)[:-2]])
    dry = {'coulomb_friction': 'coulomb', 'stribeck_friction': 'coulomb'}
    expected = {**dict.fromkeys(dry, 1.5), 'viscous_friction': 1.0, 'time_delay': 0.02}
    numbers = {**dry, 'viscous_friction': 'viscous', 'time_delay': 'delay_s'}
    found = diagnose(ur3.body, replace(samples, outputs=late),
                     only=() if long else (*expected, 'backlash', 'effort_gain', 'joint_offset'))
    for finding in found.findings:
        kind = finding.effect.kind
        assert values(finding, numbers[kind])[0] == pytest.approx(expected[kind], rel=0.05)
    kinds = sorted((str(joint), 'dry' if kind in dry else kind) for kind, joint in named(found))
    assert kinds == sorted([('None', 'time_delay'), *((joint, kind) for joint in UR3_JOINTS
                                                       for kind in ('dry', 'viscous_friction'))])
    assert found.after.nmse.max() < 1e-3
