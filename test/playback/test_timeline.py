"""What is played of a bag, in which order and under which name; stamps in serialised messages."""

import array
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.bags.header_stamp import read_stamp, with_stamp
from semiparam_ros.bags.qos import Qos
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.options import FollowOptions, ReplayOptions, parse_follow, parse_remap
from semiparam_ros.playback.timeline import BagTimeline, Cut, PlayedTopic, Selection
from semiparam_ros.ros.cdr import begins_with_header
from semiparam_ros.ros.message_types import message_class

SECOND = 10**9
START = 1_700_000_000 * SECOND
WRENCH, STATES, TEXT = 'geometry_msgs/msg/WrenchStamped', 'sensor_msgs/msg/JointState', 'std_msgs/msg/String'


def header(stamp):
    return {'stamp': {'sec': stamp // SECOND, 'nanosec': stamp % SECOND}, 'frame_id': 'sensor'}


@pytest.fixture
def bag(tmp_path):
    """Ten seconds: a description at the start, a wrench each second whose stamp runs backwards, states between."""
    with BagWriter(tmp_path / 'a.mcap') as writer:
        writer.write('/robot_description', TEXT, {'data': '<robot/>'}, START)
        for k in range(10):
            now = START + k * SECOND
            writer.write('/wrench', WRENCH, {'header': header(START + (10 - k) * SECOND)}, now, now - 2 * k * SECOND)
            writer.write('/joint_states', STATES, {'header': header(now)}, now + SECOND // 2)
    with open_bag(tmp_path / 'a.mcap') as reader:
        yield reader


def timeline(bag, *topics, **options):
    chosen = {topic: PlayedTopic(topic, bag.topics[topic].type, bag.topics[topic].qos)
              for topic in topics or bag.topics}
    return BagTimeline(bag, chosen, **options)


def played(line, from_ns=None):
    return [(item.topic, (item.time - START) / SECOND) for item in line.play(line.start_ns if from_ns is None
                                                                            else from_ns)]


def test_all_of_it_in_order(bag):
    expected = [('/robot_description', 0.0)] + [(topic, k + late) for k in range(10)
                                                for topic, late in (('/wrench', 0.0), ('/joint_states', 0.5))]
    assert played(timeline(bag)) == expected


def test_what_is_announced_is_due_at_the_start(tmp_path):
    """With /clock before every message the time ran ahead to a late robot description, and back with the first one."""
    with BagWriter(tmp_path / 'b.mcap') as writer:
        writer.write('/wrench', WRENCH, {'header': header(START)}, START)
        writer.write('/robot_description', TEXT, {'data': '<robot/>'}, START + 3 * SECOND)
    with open_bag(tmp_path / 'b.mcap') as bag:
        line = timeline(bag)
        assert [(item.topic, item.time) for item in line.announcements()] == [('/robot_description', START)]
        assert played(line) == [('/wrench', 0.0), ('/robot_description', 3.0)]


def test_a_part_keeps_what_was_latched_before_it(bag):
    line = timeline(bag, cut=Cut(start_offset_s=2.0, duration_s=1.5))
    assert played(line) == [('/robot_description', 2.0), ('/wrench', 2.0), ('/joint_states', 2.5), ('/wrench', 3.0),
                            ('/joint_states', 3.5)]
    assert played(line, line.start_ns + SECOND) == [('/robot_description', 3.0), ('/wrench', 3.0),
                                                    ('/joint_states', 3.5)]


@pytest.mark.parametrize('cut', [Cut(until_s=2.0), Cut(until_stamp_s=1_700_000_002.0), Cut(duration_s=2.0),
                                 Cut(until_s=2.0, duration_s=5.0)])
def test_every_way_to_name_the_end(bag, cut):
    assert played(timeline(bag, '/wrench', cut=cut)) == [('/wrench', 0.0), ('/wrench', 1.0), ('/wrench', 2.0)]


def test_a_part_of_nothing_is_refused(bag):
    with pytest.raises(SemiparamError, match='begin 8 s after the start and end 3 s after it'):
        timeline(bag, cut=Cut(start_offset_s=8.0, until_s=3.0))


@pytest.mark.parametrize('cut', [{'start_offset_s': nan}, {'start_offset_s': -1.0}, {'duration_s': inf},
                                 {'until_s': nan}, {'until_stamp_s': inf}])
def test_times_that_are_none_are_refused(cut):
    """As internal error: cannot convert float NaN to integer."""
    with pytest.raises(SemiparamError, match='of the playback must be a number of seconds'):
        Cut(**cut)


def test_order_by_publish_time(bag):
    assert played(timeline(bag, '/wrench', order='publish')) == [('/wrench', float(-k)) for k in range(9, -1, -1)]


@pytest.mark.parametrize('unset', [None, 0])
def test_what_has_no_stamp_stays_where_it_was_among_stamps_of_a_simulation(unset, tmp_path):
    """A text, or a header whose stamp is not set, was played decades after (before) the rest."""
    with BagWriter(tmp_path / 'a.mcap') as writer:
        writer.write('/robot_description', TEXT, {'data': '<robot/>'}, START)
        for k in range(1, 5):
            now = START + k * SECOND
            writer.write('/wrench', WRENCH, {'header': header(k * SECOND)}, now)
            other = (TEXT, {'data': '.'}) if unset is None else (STATES, {'header': header(unset)})
            writer.write('/other', *other, now + SECOND // 2)
    with open_bag(tmp_path / 'a.mcap') as bag:
        line = timeline(bag, order='header')
        assert [item.time / SECOND for item in line.announcements()] in ([], [0.0])
        assert [(item.topic, item.time / SECOND) for item in line.play(line.start_ns)] == [
            ('/robot_description', 0.0),
            *[each for k in range(1, 5) for each in (('/wrench', float(k)), ('/other', k + 0.5))]]


def test_order_by_header_time(bag):
    line = timeline(bag, '/wrench', order='header')
    assert [read_stamp(item.raw) for item in line.play(line.start_ns)] == [START + k * SECOND for k in range(1, 11)]
    assert played(line, START + 9 * SECOND) == [('/wrench', 9.0), ('/wrench', 10.0)]


def test_latched_messages_come_first_in_every_order(bag):
    line = timeline(bag, '/robot_description', '/joint_states', order='header', cut=Cut(start_offset_s=4.0))
    assert played(line)[0] == ('/robot_description', 3.5)  # by the stamps, which are half a second earlier


@pytest.mark.parametrize(('selection', 'expected'), [
    (Selection(), ['/arm/wrench', '/arm/joint_states', '/rosout']),
    (Selection(topics=('/rosout',)), ['/rosout']),
    (Selection(regex='^/arm/'), ['/arm/wrench', '/arm/joint_states']),
    (Selection(regex='joint', topics=('/rosout',)), ['/arm/joint_states', '/rosout']),
    (Selection(exclude=('/rosout',)), ['/arm/wrench', '/arm/joint_states']),
    (Selection(regex='arm', exclude_regex='joint'), ['/arm/wrench']),
])
def test_topics_are_chosen_by_name_and_by_expression(selection, expected):
    assert selection.of(['/arm/wrench', '/arm/joint_states', '/rosout']) == expected


def test_a_topic_that_is_not_there_is_named():
    with pytest.raises(SemiparamError, match='no topic /wrnch: it has /wrench'):
        Selection(topics=('/wrnch',)).of(['/wrench'])


def test_a_bad_expression_is_named():
    with pytest.raises(SemiparamError, match=r"'\(' is not a regular expression"):
        Selection(regex='(')


def serialised(stamp, name='x'):
    from rclpy.serialization import serialize_message
    message = message_class(STATES)()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
    message.header.frame_id, message.position = name, array.array('d', [1.0, 2.0])
    return message, serialize_message(message)


# A string of ROS ends at its first NUL
WRITABLE = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=5)


@given(st.integers(0, 2**31 * SECOND - 1), st.integers(0, 2**31 * SECOND - 1), WRITABLE)
def test_a_stamp_is_read_and_replaced_where_rclpy_puts_it(stamp, other, name):
    from rclpy.serialization import deserialize_message
    raw = serialised(stamp, name)[1]
    assert read_stamp(raw) == stamp
    moved = with_stamp(raw, other)
    assert moved[:4] + moved[12:] == raw[:4] + raw[12:]
    assert deserialize_message(moved, message_class(STATES)) == serialised(other, name)[0]  # bytes between fields vary


def test_big_endian_stamps_are_read_and_written():
    raw = bytes([0, 0, 0, 0]) + (7).to_bytes(4, 'big') + (9).to_bytes(4, 'big') + b'rest'
    assert read_stamp(raw) == 7 * SECOND + 9
    assert read_stamp(with_stamp(raw, 3 * SECOND + 1)) == 3 * SECOND + 1


def test_types_with_and_without_a_header():
    assert begins_with_header(WRENCH) and begins_with_header(STATES)
    assert not begins_with_header(TEXT) and not begins_with_header('nowhere_msgs/msg/Missing')


def test_a_short_message_and_a_late_century_are_errors():
    with pytest.raises(SemiparamError, match='too short for a header stamp'):
        read_stamp(b'\0\1\0\0')
    with pytest.raises(SemiparamError, match='32-bit seconds'):
        with_stamp(serialised(0)[1], 2**40 * SECOND)


@pytest.mark.parametrize(('name', 'sentence'), [
    ('sensor_msgs/JointState', 'expected package/msg/Name'),
    ('nowhere_msgs/msg/Missing', "expected the package 'nowhere_msgs'"),
    ('sensor_msgs/msg/Missing', "'sensor_msgs/msg/Missing' is not installed"),
])
def test_unknown_types_are_named(name, sentence):
    with pytest.raises(SemiparamError, match=sentence):
        message_class(name)


@pytest.mark.parametrize(('options', 'sentence'), [
    ({'rate': 0.0}, 'rate must be a finite number above 0'),
    ({'rate': None}, 'needs a follower'),
    ({'restamp': True, 'follow': FollowOptions({'/answers': None})}, 'restamped messages cannot be followed'),
    ({'order': 'time'}, 'expected one of log, publish, header'),
    ({'delay_s': -1.0}, 'delay must not be negative'),
    ({'wait_s': float('inf')}, 'wait must not be negative or endless, got inf'),
    ({'clock_hz': 0.0}, 'clock rate must be above 0 Hz'),
    ({'clock_hz': 1e12}, 'at most 10000 Hz, got 1e\\+12'),
    ({'bags': ()}, 'expected at least one'),
])
def test_options_that_make_no_sense_are_refused(options, sentence):
    with pytest.raises(SemiparamError, match=sentence):
        ReplayOptions(**{'bags': ('a.mcap',), **options})


def test_remappings_and_followers_as_written():
    assert parse_remap('/a:=/b') == ('/a', '/b')
    assert parse_follow('/e/residual=/w') == ('/e/residual', '/w') and parse_follow('/e/residual')[1] is None
    with pytest.raises(SemiparamError, match='expected /old:=/new'):
        parse_remap('/a=/b')


def test_the_offer_of_a_bag_is_what_is_played(bag):
    assert bag.topics['/robot_description'].qos.latched and bag.topics['/wrench'].qos == Qos()
