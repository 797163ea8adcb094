"""The simulated arm: kinematics, wrench of the distal bodies, forces on links."""

import re

import numpy as np
import pinocchio as pin
import pytest

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.arm import Arm, follow
from semiparam_ros.simulation.hiding import RigidBodyFit
from semiparam_ros.simulation.robots import ICUB_JOINTS, ICUB_SENSOR, bundled_urdf, varied
from semiparam_ros.simulation.trajectory import Trajectory
from semiparam_ros.simulation.world import World


@pytest.fixture(scope='module')
def urdf():
    return bundled_urdf().read_text()


@pytest.fixture(scope='module')
def wrench_arm(urdf):
    return Arm.from_urdf(urdf, ICUB_JOINTS, 'wrench', ICUB_SENSOR)


@pytest.fixture(scope='module')
def states(wrench_arm):
    rng = np.random.default_rng(0)
    return rng.uniform(*wrench_arm.limits, (20, 4)), rng.standard_normal((20, 4)), rng.standard_normal((20, 4))


def test_urdf_is_the_published_arm(urdf, shared_data):
    """Kinematics and inertias of iCubGenova01, whose own angles are rounded to 1e-5."""
    published = (shared_data / 'icub_arm' / 'iCubGenova01.urdf').read_text()
    arms = [Arm.from_urdf(text, ICUB_JOINTS, 'wrench', ICUB_SENSOR) for text in (urdf, published)]
    rng = np.random.default_rng(1)
    position = rng.uniform(*arms[0].limits, (10, 4))
    hands = [arm.pose('r_gripper', position).place for arm in arms]
    assert np.allclose(hands[0], hands[1], atol=2e-5)
    motion = rng.standard_normal((2, 10, 4))
    wrenches = [arm.evaluate(position, *motion) for arm in arms]
    assert np.allclose(wrenches[0], wrenches[1], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_links_may_have_the_names_of_joints(urdf, states, outputs):
    """As of the published Baxter: pinocchio found several frames of one name."""
    alike = urdf.replace('"r_upper_arm"', '"r_elbow"').replace('"r_forearm"', '"r_wrist_fixed_joint"')
    plain, arm = (Arm.from_urdf(text, ICUB_JOINTS, outputs, ICUB_SENSOR) for text in (urdf, alike))
    np.testing.assert_array_equal(arm.evaluate(*states), plain.evaluate(*states))
    forearm, same = plain.pose('r_forearm', states[0]), arm.pose('r_wrist_fixed_joint', states[0])
    np.testing.assert_array_equal(same.place, forearm.place)


def test_blanks_about_a_mass_do_not_take_the_body_away(urdf, states):
    spaced = re.sub('<mass value="([^"]*)"', r'<mass value=" \1 "', urdf)
    assert spaced != urdf
    plain, arm = (Arm.from_urdf(text, ICUB_JOINTS, 'wrench', ICUB_SENSOR) for text in (urdf, spaced))
    np.testing.assert_array_equal(arm.evaluate(*states), plain.evaluate(*states))


def test_wrench_at_rest_is_the_weight_of_the_distal_bodies(wrench_arm):
    weight = 9.81 * (0.729 + 0.074 + 0.525 + 0.213)
    still = np.zeros((1, 4))
    wrench = wrench_arm.evaluate(np.array([[-0.3, 0.7, 0.4, 1.0]]), still, still)
    assert np.linalg.norm(wrench[0, :3]) == pytest.approx(weight)
    turned = wrench_arm.pose('r_arm_ft_sensor', np.array([[-0.3, 0.7, 0.4, 1.0]])).rotation[0] @ wrench[0, :3]
    # The reaction: the arm pulls the sensor down.
    assert turned == pytest.approx([0.0, 0.0, -weight])


def test_action_is_the_opposite_of_the_reaction(urdf, wrench_arm, states):
    action = Arm.from_urdf(urdf, ICUB_JOINTS, 'wrench', 'r_upper_arm', 'action')
    assert np.array_equal(action.evaluate(*states), -wrench_arm.evaluate(*states))


def test_frame_kinematics_are_pinocchios(wrench_arm, states):
    pose, model, frame = wrench_arm.pose('r_hand', states[0]), wrench_arm.model, wrench_arm.frame_id('r_hand')
    data = model.createData()
    for row, configuration in enumerate(wrench_arm.configuration(states[0])):
        pin.computeJointJacobians(model, data, configuration)
        pin.updateFramePlacements(model, data)
        jacobian = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        assert np.allclose(pose.place[row], data.oMf[frame].translation)
        assert np.allclose(pose.rotation[row], data.oMf[frame].rotation)
        assert np.allclose(pose.jacobian[row], jacobian[:, wrench_arm.columns])


@pytest.mark.parametrize('outputs', ['wrench', 'effort'])
def test_force_on_a_link_equals_newton_euler_with_it(urdf, states, outputs):
    """The load carried by Jacobians is what rnea gives with the force among the external ones."""
    arm = Arm.from_urdf(urdf, ICUB_JOINTS, outputs, ICUB_SENSOR)
    force = np.random.default_rng(2).standard_normal((20, 3))
    position = states[0]
    carried = arm.load_of_force(arm.pose('r_hand', position), force, position)
    expected = _rnea_with_force(arm, states, 'r_hand', force) - arm.evaluate(*states)
    assert np.allclose(carried, expected, atol=1e-9)


def _rnea_with_force(arm, states, frame_name, force):
    model, data = arm.model, arm.model.createData()
    frame = model.frames[arm.frame_id(frame_name)]
    rows = []
    for *state, push in zip(*(arm.configuration(values) for values in states), force, strict=True):
        pin.framesForwardKinematics(model, data, state[0])
        local = data.oMf[arm.frame_id(frame_name)].rotation.T @ push
        external = pin.StdVec_Force()
        external.extend([pin.Force.Zero() for _ in range(model.njoints)])
        external[frame.parentJoint] = frame.placement.act(pin.Force(local, np.zeros(3)))
        effort = pin.rnea(model, data, *state, external)
        rows.append(effort[arm.columns] if arm.sensor_frame is None
                    else arm.sign * data.f[model.getJointId(arm.sensor_frame)].vector)
    return np.array(rows)


def test_a_body_added_is_a_body_weighed(wrench_arm):
    loaded = wrench_arm.with_body('r_hand', pin.Inertia.FromSphere(0.5, 0.02))
    still = np.zeros((1, 4))
    weights = [np.linalg.norm(arm.evaluate(still, still, still)[0, :3]) for arm in (wrench_arm, loaded)]
    assert weights[1] - weights[0] == pytest.approx(0.5 * 9.81)


def test_a_varied_robot_is_possible_and_differs(wrench_arm):
    for seed in range(20):
        robot = varied(wrench_arm, np.random.default_rng(seed))
        for joint in range(1, robot.model.njoints):
            pseudo = pin.PseudoInertia.FromInertia(robot.model.inertias[joint]).toMatrix()
            change = robot.model.inertias[joint].mass / wrench_arm.model.inertias[joint].mass
            assert np.linalg.eigvalsh(pseudo).min() > 0
            assert 0.1 <= abs(change - 1) <= 0.3


def test_the_rigid_body_fit_absorbs_inertias_and_offset_only(wrench_arm, states):
    time = np.linspace(0, 10, 400)
    position = 0.5 + 0.3 * np.sin(np.outer(time, [1.0, 1.7, 2.3, 3.1]))
    world = World(wrench_arm, Trajectory(time, position), time, np.zeros(4))
    fit = RigidBodyFit(world, world.outputs.std(axis=0))
    heavier = wrench_arm.with_body('r_hand', pin.Inertia.FromSphere(0.2, 0.03)).evaluate(*world.now[1:])
    assert fit.unexplained(heavier - world.outputs + np.arange(6.0)) < 1e-7
    drag = np.sign(world.now.velocity[:, [0, 1, 2, 3, 0, 1]])
    assert fit.unexplained(drag) > 0.3


def test_the_tip_follows_a_path_within_the_limits(wrench_arm):
    home = np.array([-0.3, 0.75, 1.4, 1.29])
    angle = np.linspace(0, 2 * np.pi, 50)[:, None]
    path = wrench_arm.pose('r_gripper', home[None]).place + 0.05 * np.hstack([np.cos(angle), np.sin(angle), 0 * angle])
    position = follow(wrench_arm, 'r_gripper', path, home)
    assert np.abs(wrench_arm.pose('r_gripper', position).place - path).max() < 2e-3
    assert np.all(position >= wrench_arm.limits[0])
    assert np.all(position <= wrench_arm.limits[1])


@pytest.mark.parametrize(('change', 'words'), [
    ({'joints': ('r_elbow', 'elbow')}, "no moving joint 'elbow'"),
    ({'joints': ()}, 'joints is empty'),
    ({'joints': ('r_elbow', 'r_elbow')}, 'one joint twice'),
    ({'sensor_frame': 'ft'}, "no frame 'ft'"),
    ({'sensor_frame': None}, 'sensor_frame is empty'),
    ({'sensor_frame': 'r_gripper'}, 'carries no mass'),
    ({'outputs': 'force'}, "outputs 'force' is unknown"),
    ({'convention': 'up'}, "wrench_convention 'up' is unknown"),
    ({'urdf': '<robot'}, 'is not XML'),
    ({'urdf': '<sdf/>'}, "expected a URDF's <robot>"),
    ({'urdf': bundled_urdf().read_text().replace('</robot>', '''
        <joint name="back" type="fixed"><parent link="r_hand"/><child link="r_upper_arm"/></joint></robot>''')},
     "link 'r_upper_arm' of the robot description is the child of two joints"),  # the process died: segmentation fault
])
def test_refusals(urdf, change, words):
    arguments = {'urdf': urdf, 'joints': ICUB_JOINTS, 'outputs': 'wrench', 'sensor_frame': ICUB_SENSOR, **change}
    with pytest.raises(SemiparamError, match=words):
        Arm.from_urdf(**arguments)
