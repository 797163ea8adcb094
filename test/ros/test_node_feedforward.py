"""Feedforward: the torques that follow from a wrench model, against pinocchio's rnea."""

import struct
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pinocchio as pin
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.variants import VARIANTS
from semiparam_ros.effects import effect_from_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import desired_state as feedforward
from semiparam_ros.online.desired_state import joint_torques
from semiparam_ros.ros.estimator.desired_trajectory import (
    MOST_NAMES,
    MOST_POINTS,
    DesiredTrajectory,
    TrajectoryPoint,
    TrajectoryReader,
    TrajectoryWriter,
    desired_state,
    joint_order,
    stamp_of,
)
from semiparam_ros.settings.build import build_estimator, build_rigid_body
from support.effect_cases import BODIES, CASES, MOTION, NAMES
from support.node_helpers import SETTINGS, URDF, motion

MIDDLE = replace(SETTINGS, robot_description=URDF.replace(
    '<child link="ft"/><origin', '<child link="fore"/><origin').replace(
    '<link name="ft">', '<link name="fore"><inertial><mass value="0.7"/><inertia ixx="0.01" iyy="0.01" izz="0.01" '
    'ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="mount" type="fixed"><parent link="fore"/>'
    '<child link="ft"/><origin xyz="0.01 0 0.2" rpy="0.3 0.1 0"/></joint><joint name="wrist" type="revolute">'
    '<parent link="ft"/><child link="hand"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" '
    'effort="9" velocity="9"/></joint><link name="hand"><inertial><mass value="0.4"/><origin xyz="0 0.03 0.05"/>'
    '<inertia ixx="0.003" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="ft">'),
    joints=('wrist', 'a', 'b'))


def rnea(settings, *row):
    """Torques of the description of some settings, in the order of the joints."""
    body = build_rigid_body(settings)
    q, dq, ddq = (body.arm_vector(values) for values in row)
    return np.array(pin.rnea(body.arm, body.arm.createData(), q, dq, ddq))[body.arm_columns]


@pytest.mark.parametrize('convention', ['action', 'reaction'])
@pytest.mark.parametrize('settings', [SETTINGS, MIDDLE], ids=['at the end', 'in the middle'])
def test_torques_follow_from_the_wrench_of_a_heavier_hand(settings, convention):
    """The wrench of a hand that weighs more than described gives the torques of the arm with that hand."""
    settings = replace(settings, wrench_convention=convention)
    body = build_rigid_body(settings)
    proximal = [index for index, name in enumerate(settings.joints) if name != 'wrist']
    heavier = replace(settings, robot_description=settings.robot_description.replace('value="0.5"', 'value="0.9"'))
    heavy, rng = build_rigid_body(heavier), np.random.default_rng(3)
    for _ in range(20):
        row = rng.uniform(-2.0, 2.0, (3, body.n_joints))
        wrench = heavy.regressor(*row) @ heavy.base_parameters
        np.testing.assert_allclose(joint_torques(body, *row, wrench)[0][proximal], rnea(heavier, *row)[proximal],
                                   atol=1e-9)
        described = body.regressor(*row) @ body.base_parameters
        np.testing.assert_allclose(joint_torques(body, *row, described)[0], rnea(settings, *row), atol=1e-9)


def test_a_learnt_model_gives_the_torques_of_the_robot_as_it_is_without_the_sensors_offset():
    settings = replace(SETTINGS, variant='P')
    heavier = replace(settings, robot_description=URDF.replace('mass value="0.5"', 'mass value="0.9"'))
    heavy, estimator, rng = build_rigid_body(heavier), build_estimator(settings), np.random.default_rng(0)
    offset = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
    for sample in motion(600):
        outputs = heavy.regressor(*sample[1:4]) @ heavy.base_parameters + offset
        estimator.step(sample._replace(outputs=outputs + 1e-4 * rng.standard_normal(6)))
    sample = motion(620)[-1]
    desired = feedforward.desired(estimator, *sample[1:4])
    np.testing.assert_allclose(desired.efforts, rnea(heavier, *sample[1:4]), atol=0.01)
    np.testing.assert_allclose(desired.outputs, heavy.regressor(*sample[1:4]) @ heavy.base_parameters + offset,
                               atol=0.01)


def test_an_effort_model_predicts_them_and_a_purely_nonparametric_one_knows_no_offset():
    settings = replace(SETTINGS, outputs='effort', sensor_frame='', variant='P')
    estimator, sample = build_estimator(settings), motion(2)[1]
    desired = feedforward.desired(estimator, *sample[1:4])
    np.testing.assert_allclose(desired.efforts, rnea(settings, *sample[1:4]), atol=1e-9)
    estimator = build_estimator(replace(SETTINGS, variant='NP-ML', forgetting=1.0))
    for each in motion(80):
        estimator.step(each)
    predicted = estimator.predict_desired(*sample[1:4])
    np.testing.assert_array_equal(predicted.needed, predicted.shown)


# Desired states have no history and no past


def wanted(effect):
    """An effect with values that show, begun during the motion where it may."""
    if effect.kind == 'time_delay':
        return effect.with_values(delay_s=0.0047)
    values = {name: 0.05 for name, _ in effect.calibrations}
    return effect.with_values(**values, **({'start_s': 0.3} if effect.may_start or effect.must_start else {}))


def learnt(body, effects, count=40):
    """A model that learnt a motion whose stamps begin at some time of this year."""
    estimator = Estimator(body, ModelOptions(variant='P', initial_samples=1000, alone=True), effects)
    for sample in list(MOTION)[:count]:
        inputs = [values[:body.n_joints] for values in sample[1:4]]
        outputs = body.regressor(*inputs) @ body.base_parameters
        estimator.step(Sample(sample.stamp + 1_700_000_000_000_000_000, *inputs, outputs, sample.temperature))
    return estimator


@pytest.fixture(scope='module')
def plain():
    """Models without effects, by their outputs."""
    return {outputs: learnt(body, []) for outputs, body in BODIES.items()}


@pytest.mark.parametrize(('outputs', 'effect'), CASES, ids=NAMES)
def test_no_kind_of_effect_makes_efforts_that_the_motion_does_not_take(plain, outputs, effect):
    """The model learnt the outputs of the description, whatever is declared: commands must stay near its torques."""
    body = BODIES[outputs]
    estimator = learnt(body, [wanted(effect)])
    rng = np.random.default_rng(1)
    for row in rng.uniform(-1.0, 1.0, (5, 3, body.n_joints)):
        desired, usual = (feedforward.desired(model, *row) for model in (estimator, plain[outputs]))
        assert np.isfinite(desired.outputs).all()
        described = np.abs(usual.efforts).max()
        assert np.abs(desired.efforts - usual.efforts).max() < 0.5 * described
        assert np.abs(desired.outputs).max() < 3.0 * np.abs(usual.outputs).max()


@pytest.mark.parametrize(('outputs', 'effect'), CASES, ids=NAMES)
def test_what_was_measured_does_not_mix_with_a_desired_state(outputs, effect):
    """Columns of a desired state depend on it, the time and temperatures alone, and are those of the effect wherever
    it has no past."""
    body, effect = BODIES[outputs], wanted(effect)
    columns = CoupledColumns(body, [effect])
    row = np.random.default_rng(2).uniform(-1.0, 1.0, (3, body.n_joints))
    now = int(MOTION.stamps[-1])
    shown, needed = columns.desired(*row, now, MOTION.origin, MOTION.temperature[-1])
    # In outputs, N or N m: what a coefficient of its usual size brings about.
    assert np.isfinite(shown).all() and np.abs(shown * columns.prior_scale).max() < 1e4
    sample = Sample(now, *row, np.full(body.n_outputs, np.nan), MOTION.temperature[-1])
    acting = CoupledColumns(body, [effect.desired()])
    fresh, memory = acting.one(sample, MOTION.origin)
    if effect.kind in ('cable_hysteresis', 'backlash') or 'presliding' in effect.parameters:
        assert memory[0][1] is not None
        assert np.abs(shown[:, columns.n_own:]).max() > 0.0, 'slides on at its own velocity'
    else:
        np.testing.assert_allclose(shown, fresh, atol=1e-12)
    block = columns.blocks['0']
    if effect.of_sensor:
        np.testing.assert_array_equal(needed[:, block], 0.0)
    else:
        np.testing.assert_array_equal(needed[:, block], shown[:, block])
    if effect.kind in ('time_delay', 'periodic_disturbance'):
        np.testing.assert_array_equal(shown[:, block], 0.0)
    elif block.stop > block.start and effect.kind != 'payload':
        assert np.abs(shown[:, block]).max() > 0.0, 'a start that was reached counts'


def test_a_payload_that_was_picked_up_is_in_the_efforts_whatever_the_stamps():
    """It begins at 0.3 s of the motion; a desired state is one of now."""
    body, effect = BODIES['wrench'], effect_from_text('payload@r_hand{"start_s": 0.3}')
    row = np.random.default_rng(2).uniform(-1.0, 1.0, (3, body.n_joints))
    before, after = learnt(body, [effect], count=5), learnt(body, [effect])
    for estimator, there in ((before, False), (after, True)):
        theta = estimator.model.recursion.theta
        theta[estimator.columns.blocks['0']][0] = 2.0
        heavier = feedforward.desired(estimator, *row).efforts
        theta[estimator.columns.blocks['0']][0] = 0.0
        assert (np.abs(heavier - feedforward.desired(estimator, *row).efforts).max() > 1.0) == there


def test_a_sensors_drift_moves_the_wrench_that_it_will_show_and_no_motor():
    body, effect = BODIES['wrench'], effect_from_text('sensor_drift')
    row = np.random.default_rng(2).uniform(-1.0, 1.0, (3, body.n_joints))
    estimator = learnt(body, [effect])
    before = feedforward.desired(estimator, *row)
    estimator.model.recursion.theta[estimator.columns.blocks['0']] += 1.0
    after = feedforward.desired(estimator, *row)
    span = (MOTION.stamps[-1] - MOTION.stamps[0]) * 1e-9
    np.testing.assert_allclose(after.outputs - before.outputs, span, rtol=1e-9)
    np.testing.assert_allclose(after.efforts, before.efforts, atol=1e-9)


@pytest.mark.parametrize('variant', VARIANTS)
def test_every_variant_answers_desired_states_with_effects(variant):
    settings = replace(SETTINGS, variant=variant, effects=('sensor_drift', 'payload@ft{"start_s": 0.1}'))
    estimator = build_estimator(settings)
    samples = motion(120)
    for sample in samples:
        estimator.step(sample)
    assert estimator.ready
    again = samples[40]._replace(stamp=samples[-1].stamp)  # a state that was learnt: features fade elsewhere
    models = np.array([member.prior.mean for member in estimator.predict(again).members])
    desired = feedforward.desired(estimator, *again[1:4])
    assert (desired.outputs >= models.min(axis=0) - 1e-3).all() and (desired.outputs <= models.max(axis=0) + 1e-3).all()
    assert np.isfinite(desired.efforts).all()
    np.testing.assert_allclose(desired.efforts, rnea(settings, *again[1:4]), atol=5.0)


# Messages


def message_of(names, points, seconds=5):
    message = JointTrajectory(joint_names=names, points=points)
    message.header.stamp.sec, message.header.frame_id = seconds, 'base'
    return message


def ragged():
    """Points of every length, empty ones too."""
    rng = np.random.default_rng(4)
    points = []
    for index in range(40):
        columns = {name: rng.standard_normal(rng.integers(0, 4)).tolist()
                   for name in ('positions', 'velocities', 'accelerations', 'effort')}
        points.append(JointTrajectoryPoint(**columns))
        points[-1].time_from_start.sec, points[-1].time_from_start.nanosec = -index, 7 * index
    return points


@pytest.mark.parametrize('names', [[], ['a'], ['joint', 'b'], ['länger', 'a', 'b']])
def test_points_are_read_from_their_bytes_as_rclpy_reads_them(names):
    message = message_of(names, ragged())
    reader = TrajectoryReader(serialize_message(message))
    assert (reader.names, reader.frame_id, reader.stamp, reader.n_points) == (names, 'base', 5 * 10**9, 40)
    for point, expected in zip(reader.points(), message.points, strict=True):
        for values, name in zip(point.values, ('positions', 'velocities', 'accelerations', 'effort'), strict=True):
            assert values.tolist() == list(getattr(expected, name))
        assert point.from_start == expected.time_from_start.sec * 10**9 + expected.time_from_start.nanosec


@pytest.mark.parametrize('names', [['a'], ['ab'], ['abc'], ['abcd', 'ef'], ['abcdefgh', 'b', 'c']])
@pytest.mark.parametrize('frame', ['', 'base', 'x' * 5])
def test_points_are_written_as_rclpy_writes_them(names, frame):
    writer, points, rng = TrajectoryWriter(5 * 10**9, frame, names), [], np.random.default_rng(0)
    for index in range(3):
        columns = rng.standard_normal((4, len(names))).tolist()
        writer.add(columns, -index * 10**9 + 3)
        points.append(JointTrajectoryPoint(positions=columns[0], velocities=columns[1], accelerations=columns[2],
                                           effort=columns[3]))
        points[-1].time_from_start.sec, points[-1].time_from_start.nanosec = -index, 3
    expected = message_of(names, points)
    expected.header.frame_id = frame
    assert deserialize_message(writer.message(), JointTrajectory) == expected


def test_messages_that_are_cut_off_or_in_another_encoding():
    writer = TrajectoryWriter(0, 'base', ['a', 'b'])
    for index in range(5):
        writer.add([[1.0, 2.0]] * 4, index)
    raw = writer.message()
    assert len(list(TrajectoryReader(raw).points())) == 5
    for length in range(len(raw)):
        with pytest.raises(SemiparamError, match='is no JointTrajectory'):
            list(TrajectoryReader(raw[:length]).points())
    with pytest.raises(SemiparamError, match='is no JointTrajectory'):
        TrajectoryReader(b'\xff\xff\0\0' + raw[4:])
    big_endian = b'\0\0\0\0' + np.array([3, 1, 1, 0, 0, 0], '>u4').tobytes()
    reader = TrajectoryReader(big_endian)
    assert (reader.stamp, reader.frame_id, reader.names, reader.n_points) == (3 * 10**9 + 1, '', [], 0)


def test_long_messages_are_refused_by_their_head():
    writer = TrajectoryWriter(0, '', ['a'])
    for _ in range(MOST_POINTS):
        writer.add([[0.0]] * 4, 0)
    assert len(list(TrajectoryReader(writer.message()).points())) == MOST_POINTS
    writer.add([[0.0]] * 4, 0)
    with pytest.raises(SemiparamError, match=f'has {MOST_POINTS + 1} points; expected at most {MOST_POINTS}'):
        TrajectoryReader(writer.message())
    names = [str(index) for index in range(MOST_NAMES + 1)]
    with pytest.raises(SemiparamError, match=f'has {MOST_NAMES + 1} names; expected at most {MOST_NAMES}'):
        TrajectoryReader(TrajectoryWriter(0, '', names).message())


def in_encoding(kind, n_points, doubles=2):
    """Bytes of a trajectory of joints 'a' and 'b' in plain CDR (0, 1) or CDR2 (6, 7); even kinds are big-endian."""
    order, widest, data = '<' if kind % 2 else '>', 8 if kind < 2 else 4, bytearray()

    def put(code, *values):
        data.extend(bytes(-len(data) % min(struct.calcsize(f'={code[-1]}'), widest)))
        data.extend(struct.pack(order + code, *values))

    put('iI', 3, 1)
    put('I5s', 5, b'base\0')
    data.extend(bytes(-len(data) % 4))
    put('I', 2)
    for name in (b'a\0', b'b\0'):
        data.extend(bytes(-len(data) % 4) + struct.pack(f'{order}I2s', 2, name))
    data.extend(bytes(-len(data) % 4))
    put('I', n_points)
    for index in range(n_points):
        for column in range(4):
            put('I', doubles)
            if doubles:
                put('d' * doubles, *(index + column + 0.5 for _ in range(doubles)))
        put('iI', index, 7)
    return bytes((0, kind, 0, 3)) + bytes(data)


@pytest.mark.parametrize('kind', [0, 1, 6, 7])
def test_other_encodings_are_read_by_their_head_too(kind):
    """rclpy's objects of all points would keep every sample waiting for seconds."""
    reader = TrajectoryReader(in_encoding(kind, 3))
    assert (reader.stamp, reader.frame_id, reader.names) == (3 * 10**9 + 1, 'base', ['a', 'b'])
    for index, (values, from_start) in enumerate(reader.points()):
        assert [column.tolist() for column in values] == [[index + column + 0.5] * 2 for column in range(4)]
        assert from_start == index * 10**9 + 7
    raw = in_encoding(kind, MOST_POINTS + 1, doubles=0)
    with (patch('semiparam_ros.ros.cdr.deserialize_message', side_effect=AssertionError('its points are read')),
          pytest.raises(SemiparamError, match=f'has {MOST_POINTS + 1} points; expected at most {MOST_POINTS}')):
        TrajectoryReader(raw)


def test_trajectories_that_lack_something_are_refused_by_name():
    assert joint_order(['b', 'a'], ('a', 'b')) == [1, 0]
    assert joint_order(['gripper', 'b', 'x', 'a'], ('a', 'b')) == [3, 1]
    for names in ([], ['a'], ['a', 'c'], ['a', 'b', 'b']):
        with pytest.raises(SemiparamError, match="must name joint 'b' once" if 'a' in names else "joint 'a' once"):
            joint_order(names, ('a', 'b'))
    with pytest.raises(SemiparamError) as refusal:
        joint_order([f'a_very_long_name_of_a_joint_{index}' * 100 for index in range(1000)], ('a', 'b'))
    assert len(str(refusal.value)) < 600 and '992 more' in str(refusal.value)
    full = [np.array(values) for values in ([1.0, 2.0], [3.0, 4.0], [5.0, 6.0])]
    state = desired_state(TrajectoryPoint((*full, np.zeros(0)), 0), [1, 0], 2, 0)
    assert [part.tolist() for part in state] == [[2.0, 1.0], [4.0, 3.0], [6.0, 5.0]]
    with pytest.raises(SemiparamError, match='point 7 of desired_trajectory has 0 accelerations for 2 joints'):
        desired_state(TrajectoryPoint((*full[:2], np.zeros(0), np.zeros(0)), 0), [0, 1], 2, 7)
    for value in (np.nan, np.inf, 1e160):
        with pytest.raises(SemiparamError, match='point 3 of desired_trajectory has velocities'):
            desired_state(TrajectoryPoint((full[0], np.array([0.0, value]), full[2], np.zeros(0)), 0), [0, 1], 2, 3)
    with pytest.raises(SemiparamError, match=r'desired_trajectory has the stamp 2\.14748e\+09 s; expected one'):
        TrajectoryReader(b'\0\0\0\0' + np.array([2**31 - 1, 2**32 - 1, 0, 0, 0], '>u4').tobytes())
    with pytest.raises(SemiparamError, match='point 3 of desired_trajectory lies at'):
        stamp_of(2**31 * 10**9, TrajectoryPoint((), 2**31 * 10**9), 3)


def test_that_trajectories_are_answered_again_is_information():
    """It was logged as a warning."""
    said = []
    log = SimpleNamespace(**{level: partial(lambda level, text: said.append((level, text)), level)
                             for level in ('info', 'warning')})
    node = SimpleNamespace(get_logger=lambda: log, create_publisher=lambda *_: None,
                           create_subscription=lambda *_, **__: None)
    topic = DesiredTrajectory(node, 'wrench', *4 * [None])
    for sentence in ('feedforward is withheld.', 'feedforward is withheld.', '', ''):
        topic.feedforward.withheld = sentence
        topic._tell_withheld()
    assert said == [('warning', 'feedforward is withheld.'), ('info', 'desired trajectories are answered.')]
