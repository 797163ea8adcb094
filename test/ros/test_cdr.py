"""Messages read from and written to their bytes say what rclpy says of them."""

import math
import struct

import pytest
from geometry_msgs.msg import WrenchStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from semiparam_ros.bags import readings
from semiparam_ros.bags.schemas import decoder
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.cdr import (
    MOST_BYTES,
    MOST_LAYOUTS,
    Reader,
    joint_state_layout,
    joint_state_layout_of,
    wrench_layout,
)

TEXTS = st.text(st.characters(exclude_categories=['Cs'], exclude_characters='\0'), max_size=12)
FLOATS = st.floats()
COLUMNS = st.lists(FLOATS, max_size=5)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)


@st.composite
def joint_states(draw):
    message = JointState(name=draw(st.lists(TEXTS, max_size=5)), position=draw(COLUMNS), velocity=draw(COLUMNS),
                         effort=draw(COLUMNS))
    return stamped(message, draw)


@st.composite
def wrenches(draw):
    message = WrenchStamped()
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = (draw(FLOATS) for _ in range(6))
    return stamped(message, draw)


def stamped(message, draw):
    message.header.frame_id = draw(TEXTS)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(draw(STAMPS), 10**9)
    return message


def joint_state_reader():
    return Reader(JointState, readings.of_joint_state, joint_state_layout_of)


def wrench_reader():
    return Reader(WrenchStamped, readings.of_wrench, lambda reading: wrench_layout(reading.frame_id))


def plain(reading):
    """With NaN as text, which equals itself."""
    fields = [[str(value) for value in field] if not isinstance(field, str) else field for field in reading.fields]
    return reading.stamp, reading.frame_id, fields


@given(st.lists(joint_states(), min_size=1, max_size=4))
def test_joint_states_are_read_as_rclpy_reads_them(messages):
    reader = joint_state_reader()
    for message in messages * 2:
        raw = serialize_message(message)
        assert plain(reader(raw)) == plain(reader(raw)) == plain(readings.of_joint_state(message))


@given(st.lists(wrenches(), min_size=1, max_size=4))
def test_wrenches_are_read_as_rclpy_reads_them(messages):
    reader = wrench_reader()
    for message in messages * 2:
        raw = serialize_message(message)
        assert plain(reader(raw)) == plain(reader(raw)) == plain(readings.of_wrench(message))


@given(joint_states())
def test_joint_states_are_written_as_everyone_reads_them(message):
    stamp, frame_id, (names, *columns) = readings.of_joint_state(message)
    layout = joint_state_layout(frame_id, names, *map(len, columns))
    raw = layout.write(stamp, *(column for column in columns if len(column)))
    assert plain(readings.of_joint_state(deserialize_message(raw, JointState))) == plain(
        readings.of_joint_state(message))
    assert plain(readings.of_joint_state(decoder('sensor_msgs/msg/JointState')(raw))) == plain(
        readings.of_joint_state(message))


@given(wrenches())
def test_wrenches_are_written_as_everyone_reads_them(message):
    stamp, frame_id, (_, values) = readings.of_wrench(message)
    raw = wrench_layout(frame_id).write(stamp, values)
    for read in (deserialize_message(raw, WrenchStamped), decoder('geometry_msgs/msg/WrenchStamped')(raw)):
        assert plain(readings.of_wrench(read)) == plain(readings.of_wrench(message))


@given(joint_states(), st.data())
def test_damaged_bytes_are_read_as_rclpy_reads_them_or_refused(message, data):
    raw = bytearray(serialize_message(message))
    reader = joint_state_reader()
    reader(bytes(raw))
    place = data.draw(st.integers(0, len(raw) - 1))
    raw[place] ^= data.draw(st.integers(1, 255))
    damaged = bytes(raw[:data.draw(st.integers(4, len(raw)))])
    expected = outcome(joint_state_reader(), damaged)  # a new reader leaves it to rclpy
    assert outcome(reader, damaged) == expected


def outcome(reader, raw):
    try:
        return plain(reader(raw))
    except SemiparamError:
        return 'refused'


def test_rclpy_is_asked_once_for_each_layout(monkeypatch):
    asked = []
    monkeypatch.setattr('semiparam_ros.ros.cdr.deserialize_message',
                        lambda raw, kind: asked.append(kind) or deserialize_message(raw, kind))
    reader = joint_state_reader()
    one, other = (joint_state_layout('', names, 2, 2, 0) for names in (['hip', 'knee'], ['left_wrist', 'left_thumb']))
    for turn in range(10):  # two publishers take turns on the topic
        assert reader(one.write(turn, [turn, 2.0], [3.0, 4.0])).fields[1] == pytest.approx((turn, 2.0))
        assert reader(other.write(turn, [turn, 6.0], [7.0, 8.0])).fields[0] == ['left_wrist', 'left_thumb']
    assert len(asked) == 2


def test_the_layouts_that_a_reader_remembers_are_limited():
    reader = wrench_reader()
    for length in range(0, 16 * MOST_LAYOUTS, 8):
        assert reader(wrench_layout('f' * length).write(7, range(6))).frame_id == 'f' * length
        assert len(reader._known) <= MOST_LAYOUTS


def test_empty_texts_without_their_zero_byte_are_left_to_rclpy():
    raw = wrench_layout('').write(0, range(6))[:4] + struct.pack('=iI5I', 3, 5, 0, 0, 0, 0, 0)  # as some vendors do
    reader = joint_state_reader()
    assert plain(reader(raw)) == plain(reader(raw)) == (3 * 10**9 + 5, '', [[], [], [], []])


def test_other_byte_orders_are_left_to_rclpy():
    little = wrench_layout('ft').write(5, range(6))
    big = b'\0\0\0\0' + struct.pack('>iII3sx6d', 0, 5, 3, b'ft\0', *range(6))
    reader = wrench_reader()
    assert len(big) == len(little)
    assert reader(little) == reader(big) == reader(little)


@pytest.mark.parametrize('kind', [2, 3, 6, 7, 10, 11])
def test_other_encapsulations_are_left_to_rclpy(kind):
    usual = wrench_layout('ft').write(5, range(6))
    other = b'\0' + bytes([kind]) + usual[2:]
    reader = wrench_reader()
    reader(usual)
    asked = []
    reader._decoded = lambda raw: asked.append(raw)
    reader(other)
    assert asked == [other]


@pytest.mark.parametrize('raw', [b'', b'\0\1', b'\0\1\0\0', b'\xff' * 40])
def test_bytes_that_are_no_message_are_refused_in_a_sentence(raw):
    with pytest.raises(SemiparamError, match=f'{len(raw)} bytes is no JointState'):
        joint_state_reader()(raw)


def test_values_that_are_not_finite_are_read_as_they_are():
    reading = wrench_reader()(wrench_layout('').write(1, [math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324]))
    assert math.isnan(reading.fields[1][0]) and reading.fields[1][1:3] == (math.inf, -math.inf)


def test_a_message_that_is_too_long_is_not_decoded():
    """Its layout would be kept: a joint state of a million joints left 650 MB."""
    read = Reader(JointState, readings.JOINT_STATE.read, joint_state_layout_of)
    message = JointState(name=[f'joint_{index}' for index in range(MOST_BYTES // 16)])
    raw = bytes(serialize_message(message))
    with pytest.raises(SemiparamError, match=f'a JointState of {len(raw)} bytes is too long; expected at most 100000'):
        read(raw)
    assert not read._known
