"""Bags written and read back: messages, times, orders, quality of service, formats, refusals."""

import os
import random
import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Qos as RosbagsQos
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore

from semiparam_ros.bags import writer
from semiparam_ros.bags.loading import load_samples, recorded_description, require_same_robot
from semiparam_ros.bags.qos import LATCHED, Qos, agreed, dump_profiles, parse_profiles
from semiparam_ros.bags.reader import MergedBag, open_bag
from semiparam_ros.bags.schemas import Schema, has_header
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.snapshot import Settings
from support.commands import semiparam
from support.node_helpers import motion, write_bag

STRING, STATE, WRENCH = 'std_msgs/msg/String', 'sensor_msgs/msg/JointState', 'geometry_msgs/msg/WrenchStamped'
SECOND = 10**9


def header(stamp: int, frame: str = '') -> dict:
    return {'stamp': {'sec': stamp // SECOND, 'nanosec': stamp % SECOND}, 'frame_id': frame}


def write_strings(path: Path, times, topic: str = '/chatter', **options) -> Path:
    with BagWriter(path, **options) as bag:
        for time in times:
            bag.write(topic, STRING, {'data': str(time)}, time)
    return path


def texts(path, **options) -> list[str]:
    with open_bag(path) as bag:
        return [message.data.data for message in bag.messages(**options)]


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        bag.write('/state', STATE, {'header': header(5 * SECOND + 7, 'base'), 'name': ['a'], 'position': [0.1]},
                  6 * SECOND, publish_ns=4 * SECOND)
        bag.write('/robot_description', 'std_msgs/String', {'data': '<robot/>'}, 7 * SECOND)
    with open_bag(path) as bag:
        state, description = bag.messages()
        assert (state.topic, state.type) == ('/state', STATE)
        assert (state.log_time, state.publish_time) == (6 * SECOND, 4 * SECOND)
        assert state.data.header.stamp.nanosec == 7 and state.data.header.frame_id == 'base'
        assert state.data.name == ['a'] and state.data.position == [0.1] and state.data.effort == []
        assert description.data.data == '<robot/>'
        assert (bag.start_ns, bag.duration_ns, bag.message_count) == (6 * SECOND, SECOND, 2)
        assert bag.topics['/state'].count == 1 and bag.topics['/robot_description'].type == STRING
        assert not bag.losses and bag.losses.sentence == '' and bag.losses.saved == 2


def test_messages_of_rclpy_are_written_so_that_rclpy_reads_them(tmp_path):
    serialization = pytest.importorskip('rclpy.serialization')
    from sensor_msgs.msg import JointState
    message = JointState(name=['a', 'bb'], position=[1.0, 2.0], effort=[3.0, 4.0])
    message.header.frame_id = 'base'
    message.header.stamp.sec = 9
    with BagWriter(tmp_path / 'bag.mcap') as bag:
        bag.write('/state', STATE, message, 1)
    with open_bag(tmp_path / 'bag.mcap') as bag:
        assert serialization.deserialize_message(next(bag.messages()).raw, JointState) == message


def test_equal_calls_give_equal_bytes(tmp_path):
    for name in ('one', 'two'):
        write_strings(tmp_path / name, range(5000))
    assert (tmp_path / 'one').read_bytes() == (tmp_path / 'two').read_bytes()


@pytest.mark.parametrize('compression', ['zstd', 'lz4', 'none'])
def test_messages_come_in_order_of_time_even_across_chunks(compression, tmp_path):
    times = list(range(3000))
    random.Random(0).shuffle(times)
    path = write_strings(tmp_path / 'bag.mcap', times, compression=compression, chunk_bytes=2000)
    assert texts(path) == [str(time) for time in range(3000)]
    assert texts(path, start_ns=100, end_ns=200) == [str(time) for time in range(100, 200)]


def test_equal_times_keep_the_order_of_recording(tmp_path):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path, chunk_bytes=500) as bag:
        for number in range(100):
            bag.write(f'/{number % 3}', STRING, {'data': str(number)}, 5)
    assert texts(path) == [str(number) for number in range(100)]


def test_equal_times_keep_the_order_of_recording_where_the_clock_went_back(tmp_path):
    """Those of the chunk that begins at the earlier time came first."""
    path = tmp_path / 'bag.mcap'
    with path.open('wb') as file:
        writer = McapWriter(file, chunk_size=10**6)
        writer.start('ros2', 'test')
        channel = writer.register_channel('/chatter', 'cdr', writer.register_schema(STRING, 'ros2msg', b'string data'))
        for number, time in enumerate([10, 20, 5, 20, 30]):
            if number == 2:
                writer.flush()
            writer.add_message(channel, time, bytes((0, 1, 0, 0, 2, 0, 0, 0, 48 + number, 0)), time)
        writer.finish()
    assert texts(path) == ['2', '0', '1', '3', '4']


def two_definitions(path, *texts):
    """A bag of a message on /a by each of some definitions of one type."""
    with path.open('wb') as file:
        writer = McapWriter(file)
        writer.start('ros2', 'test')
        for number, text in enumerate(texts):
            channel = writer.register_channel('/a', 'cdr', writer.register_schema('own/msg/Own', 'ros2msg', text))
            writer.add_message(channel, number, bytes((0, 1, 0, 0, 48 + number, 0, 0, 0)), number)
        writer.finish()
    return path


def test_a_topic_is_read_by_one_definition_of_its_type(tmp_path):
    """All messages were read, and written by convert, by the definition that came last."""
    plain, other = b'uint32 x', b'uint16 y\nuint16 x'
    path = two_definitions(tmp_path / 'bag.mcap', plain, b'# the same\nuint32  x  # in words', other)
    with open_bag(path) as bag:
        assert [message.data.x for message in bag.messages()] == [48, 49] and bag.topics['/a'].count == 2
        assert '1 messages on /a are own/msg/Own of another definition; 2 of 3 messages read' in bag.losses.sentence
    bags = [open_bag(two_definitions(tmp_path / f'{number}.mcap', text)) for number, text in enumerate((plain, other))]
    with pytest.raises(SemiparamError, match=r'topic /a holds own/msg/Own in .* by another definition than in another'):
        MergedBag('both', bags)


def test_order_by_publish_or_header_time(tmp_path):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        bag.write('/a', STATE, {'header': header(30)}, 1, publish_ns=20)
        bag.write('/b', STRING, {'data': 'no header'}, 10, publish_ns=25)
        bag.write('/c', WRENCH, {'header': header(10)}, 3, publish_ns=21)
    with open_bag(path) as bag:
        assert [m.topic for m in bag.messages()] == ['/a', '/c', '/b']
        assert [m.topic for m in bag.messages(order='publish')] == ['/a', '/c', '/b']
        assert [m.topic for m in bag.messages(order='header')] == ['/c', '/b', '/a']
        with pytest.raises(SemiparamError, match="order 'size' is unknown: expected one of"):
            bag.messages(order='size')


def test_only_the_chosen_topics_and_bytes_alone(tmp_path):
    path = tmp_path / 'bag.mcap'
    with BagWriter(path) as bag:
        for number in range(10):
            bag.write('/a' if number % 2 else '/b', STRING, {'data': str(number)}, number)
    with open_bag(path) as bag:
        chosen = list(bag.messages(['/a', '/nowhere'], decode=False))
    assert [m.log_time for m in chosen] == [1, 3, 5, 7, 9] and chosen[0].data is None
    assert chosen[0].raw == b'\x00\x01\x00\x00\x02\x00\x00\x001\x00'


def test_a_failed_recording_leaves_the_older_file(tmp_path):
    path = write_strings(tmp_path / 'bag.mcap', [1])
    before = path.read_bytes()
    with pytest.raises(RuntimeError), BagWriter(path) as bag:
        bag.write('/chatter', STRING, {'data': 'new'}, 1)
        raise RuntimeError
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_nonsense_is_refused_by_the_writer(tmp_path):
    with BagWriter(tmp_path / 'bag.mcap') as bag:
        bag.write('/a', STRING, {'data': ''}, 0)
        for arguments, sentence in {
                ('/b', 'no_msgs/msg/Such', 0): "message type 'no_msgs/msg/Such' is unknown",
                ('/a', STATE, 0): f'topic /a holds {STRING}, not {STATE}',
                ('/c', STATE, ('position', 'x')): f'message for /c does not fit {STATE}'}.items():
            message = dict([arguments[2]]) if arguments[2] else {}
            with pytest.raises(SemiparamError, match=sentence):
                bag.write(*arguments[:2], message, 0)
        with pytest.raises(SemiparamError, match='topic /d has not been declared'):
            bag.write_raw('/d', b'', 0)
    with pytest.raises(SemiparamError, match="compression 'zip' is unknown"):
        BagWriter(tmp_path / 'b.mcap', compression='zip')
    with pytest.raises(SemiparamError, match='no bag can be written to'):
        BagWriter(tmp_path / 'no' / 'b.mcap')


@pytest.mark.parametrize(('content', 'sentence'), [
    (b'', 'is empty'), (b'just text', 'is no bag: expected an MCAP file'),
    (b'\x89MCAP0\r\n', 'holds no readable message'),
    (b'SQLite format 3\x00' + bytes(200), 'cannot be read as a rosbag2'),
    (b'#ROSBAG V2.0\n', 'cannot be read as a ROS 1 bag'),
])
def test_what_is_no_bag_is_refused_in_one_sentence(content, sentence, tmp_path):
    path = tmp_path / 'file'
    path.write_bytes(content)
    with pytest.raises(SemiparamError, match=sentence) as refusal:
        open_bag(path)
    assert str(path) in str(refusal.value) and '\n' not in str(refusal.value)


def test_missing_files_and_empty_directories_are_refused(tmp_path):
    with pytest.raises(SemiparamError, match='cannot be opened: No such file'):
        open_bag(tmp_path / 'missing.mcap')
    with pytest.raises(SemiparamError, match='is no bag: expected a directory with'):
        open_bag(tmp_path)


def test_quality_of_service_is_kept(tmp_path):
    path = tmp_path / 'bag.mcap'
    sensor = Qos('keep_last', 5, 'best_effort', 'volatile', deadline_ns=3 * SECOND + 4)
    with BagWriter(path) as bag:
        bag.add_topic('/sensor', STRING, sensor)
        bag.write('/sensor', STRING, {}, 0)
        bag.write('/ns/robot_description', STRING, {}, 0)
    with open_bag(path) as bag:
        assert bag.topics['/sensor'].qos == sensor and bag.topics['/sensor'].offers == (sensor,)
        assert bag.topics['/ns/robot_description'].qos == LATCHED


def test_profiles_of_every_metadata_version_are_understood():
    old = '- history: 3\n  depth: 0\n  reliability: 2\n  durability: 1\n' \
          '  deadline: {sec: 9223372036, nsec: 854775807}\n'
    assert parse_profiles(old) == (Qos('keep_last', 0, 'best_effort', 'transient_local'),)
    assert parse_profiles(dump_profiles([LATCHED, Qos()])) == (LATCHED, Qos())
    assert parse_profiles('- deadline: {sec: x, nsec: .inf}') == (Qos(),)
    assert parse_profiles('') == parse_profiles(None) == parse_profiles('][') == parse_profiles('3') == ()


def test_offers_that_differ_become_one_that_every_subscriber_can_use():
    assert agreed([]) == Qos()
    assert agreed([LATCHED, LATCHED]) == LATCHED
    mixed = agreed([Qos(reliability='best_effort', depth=3), LATCHED])
    assert (mixed.reliability, mixed.durability, mixed.depth) == ('reliable', 'volatile', 3)


def rosbag2(path: Path, plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE) -> Path:
    """A true rosbag2 directory, by an independent writer."""
    store = get_typestore(Stores.ROS2_JAZZY)
    profile = RosbagsQos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, QosTime(0, 0),
                         QosTime(0, 0), QosLiveliness.AUTOMATIC, QosTime(0, 0), False)
    writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
    if mode != CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        chatter = writer.add_connection('/chatter', STRING, typestore=store, offered_qos_profiles=[profile])
        state = writer.add_connection('/state', STATE, typestore=store)
        for time in range(20):
            message = store.types[STRING](data=str(time))
            writer.write(chatter, time, store.serialize_cdr(message, STRING))
            stamp = store.types['builtin_interfaces/msg/Time'](sec=time, nanosec=1)
            message = store.types[STATE](store.types['std_msgs/msg/Header'](stamp, ''), ['a'], np.array([0.5 * time]),
                                         np.zeros(1), np.zeros(0))
            writer.write(state, time, store.serialize_cdr(message, STATE))
    return path


@pytest.mark.parametrize(('plugin', 'mode'), [
    (StoragePlugin.MCAP, CompressionMode.NONE), (StoragePlugin.MCAP, CompressionMode.STORAGE),
    (StoragePlugin.MCAP, CompressionMode.FILE), (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    (StoragePlugin.SQLITE3, CompressionMode.NONE), (StoragePlugin.SQLITE3, CompressionMode.FILE),
    (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
])
def test_rosbag2_directories_are_read(plugin, mode, tmp_path):
    path = rosbag2(tmp_path / 'bag', plugin, mode)
    assert texts(path, topics=['/chatter']) == [str(time) for time in range(20)]
    with open_bag(path) as bag:
        assert bag.topics['/chatter'].qos == LATCHED and bag.topics['/state'].count == 20
        assert (bag.start_ns, bag.end_ns) == (0, 19)
        last = next(iter(bag.messages(['/state'], start_ns=19)))
        assert last.data.position == [9.5] and next(bag.timed([last], 'header'))[0] == 19 * SECOND + 1
        assert not bag.losses and bag.losses.saved == 40


def test_a_database_without_its_metadata_is_read(tmp_path):
    path = rosbag2(tmp_path / 'bag', StoragePlugin.SQLITE3)
    (path / 'metadata.yaml').unlink()
    assert texts(path, topics=['/chatter']) == texts(path / 'bag.db3', topics=['/chatter'])
    assert len(texts(path, topics=['/chatter'])) == 20


@pytest.mark.parametrize('names', ['[3]', '5', '[[a]]', '{bag.mcap: 1}', '["", "a\\0b"]'])
def test_a_list_of_files_that_is_none_is_passed_over(names, tmp_path):
    """As internal error: expected str, bytes or os.PathLike object, not int."""
    path = rosbag2(tmp_path / 'bag', StoragePlugin.MCAP)
    (path / 'metadata.yaml').write_text(f'rosbag2_bagfile_information:\n  relative_file_paths: {names}\n')
    assert len(texts(path, topics=['/chatter'])) == 20


@pytest.mark.parametrize('plugin', list(StoragePlugin))
def test_files_that_a_directory_does_not_name_are_said(plugin, tmp_path):
    """Half of a recording was missing without a word, of which the metadata.yaml of the other half was left."""
    path = rosbag2(tmp_path / 'bag', plugin)
    first = next(file for file in path.iterdir() if file.suffix in ('.mcap', '.db3'))
    (path / f'bag_1{first.suffix}').write_bytes(first.read_bytes())
    with open_bag(path) as bag:
        assert sum(1 for _ in bag.messages()) == 40 and bag.losses.sentence == \
            f"'{path}' also holds bag_1{first.suffix}, which its metadata.yaml does not name: not read."


def test_a_file_that_a_directory_lacks_is_named(tmp_path):
    """The directory was, which is there."""
    path = rosbag2(tmp_path / 'bag', StoragePlugin.MCAP)
    (path / 'bag.mcap').unlink()
    with pytest.raises(SemiparamError, match=r"bag/bag.mcap' cannot be opened: No such file"):
        open_bag(path)


def test_types_of_ros1_become_those_of_ros2(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Rosbag1Writer(tmp_path / 'old.bag') as writer:
        types = ('sensor_msgs/msg/CameraInfo', 'std_msgs/msg/Time', STATE)
        info, time, state = (writer.add_connection(f'/{number}', name, typestore=store, latching=1)
                             for number, name in enumerate(types))
        head = store.types['std_msgs/msg/Header'](7, store.types['builtin_interfaces/msg/Time'](3, 4), 'cam')
        roi = store.types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
        matrix = np.arange(9.0)
        message = store.types[types[0]](head, 480, 640, 'plumb_bob', np.zeros(5), matrix, matrix, np.zeros(12), 0, 0,
                                        roi)
        writer.write(info, 1, store.serialize_ros1(message, types[0]))
        message = store.types[types[1]](store.types['builtin_interfaces/msg/Time'](5, 6))
        writer.write(time, 2, store.serialize_ros1(message, types[1]))
        message = store.types[STATE](head, ['a'], np.ones(1), np.zeros(1), np.zeros(0))
        writer.write(state, 3, store.serialize_ros1(message, STATE))
    with open_bag(tmp_path / 'old.bag') as bag:
        info, time, state = bag.messages()
        assert info.data.k == matrix.tolist() and info.data.header.frame_id == 'cam'
        assert (time.data.data.sec, time.data.data.nanosec) == (5, 6)
        assert state.data.position == [1.0] and next(bag.timed([state], 'header'))[0] == 3 * SECOND + 4
        assert all(topic.qos.latched for topic in bag.topics.values())


def test_a_topic_of_ros1_is_of_the_type_that_most_of_its_messages_have(tmp_path):
    """All were taken for messages of its first publisher: a text for a number."""
    store, text, number = get_typestore(Stores.ROS1_NOETIC), 'std_msgs/msg/String', 'std_msgs/msg/Int32'
    with Rosbag1Writer(tmp_path / 'old.bag') as writer:
        connections = [writer.add_connection('/x', name, typestore=store) for name in (number, text)]
        writer.write(connections[0], 1, store.serialize_ros1(store.types[number](7), number))
        for time in (2, 3):
            writer.write(connections[1], time, store.serialize_ros1(store.types[text]('word'), text))
    with open_bag(tmp_path / 'old.bag') as bag:
        assert [message.data.data for message in bag.messages()] == ['word', 'word']
        assert (bag.topics['/x'].type, bag.topics['/x'].count) == (text, 2)
        assert f'1 messages on /x are {number}, not {text}' in bag.losses.sentence


@pytest.mark.parametrize('opened', ['new', 'new/new.db3'])
def test_a_topic_of_a_database_has_all_messages_of_one_type(opened, tmp_path):
    """All were taken for messages of its last publisher, and its alone were counted."""
    store, number = get_typestore(Stores.ROS2_JAZZY), 'std_msgs/msg/Int32'
    best_effort = RosbagsQos(QosHistory.KEEP_LAST, 5, QosReliability.BEST_EFFORT, QosDurability.VOLATILE, QosTime(0, 0),
                             QosTime(0, 0), QosLiveliness.AUTOMATIC, QosTime(0, 0), False)
    with Rosbag2Writer(tmp_path / 'new', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        numbers = [writer.add_connection('/x', number, typestore=store, offered_qos_profiles=profiles)
                   for profiles in ([], [best_effort])]
        text = writer.add_connection('/x', STRING, typestore=store)
        for time, connection in enumerate((*numbers, numbers[0])):
            writer.write(connection, time, store.serialize_cdr(store.types[number](7 + time), number))
        writer.write(text, 9, store.serialize_cdr(store.types[STRING]('word'), STRING))
    with open_bag(tmp_path / opened) as bag:
        assert [message.data.data for message in bag.messages()] == [7, 8, 9]
        info = bag.topics['/x']
        assert (info.type, info.count, info.qos.reliability) == (number, 3, 'best_effort')
        assert f'1 messages on /x are {STRING}, not {number}' in bag.losses.sentence


def test_a_message_of_another_layout_has_no_stamp_to_read_or_to_write(tmp_path):
    """The length that XCDR2 writes first was taken for the stamp, and --stamps-from-log wrote over it."""
    raw = bytes((0, 9, 0, 0, 20, 0, 0, 0, 5, 0, 0, 0, 6, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0))
    with BagWriter(tmp_path / 'in.mcap') as writer:
        writer.add_topic('/point', 'geometry_msgs/msg/PointStamped')
        writer.write_raw('/point', raw, 7 * SECOND)
    with open_bag(tmp_path / 'in.mcap') as bag:
        message, = bag.messages(['/point'], decode=False)
        assert list(bag.timed([message], 'header')) == [(7 * SECOND, message)]
    assert semiparam('convert', tmp_path / 'in.mcap', tmp_path / 'out.mcap', '--stamps-from-log') == 0
    with open_bag(tmp_path / 'out.mcap') as bag:
        assert [message.raw for message in bag.messages(decode=False)] == [raw]


def schema_bag(path: Path, encoding: str, text: bytes, raw: bytes) -> Path:
    with path.open('wb') as file:
        writer = McapWriter(file)
        writer.start('ros2', 'test')
        schema = writer.register_schema('my_msgs/msg/Pair', encoding, text)
        channel = writer.register_channel('/pair', 'cdr', schema)
        for number in range(3):
            writer.add_message(channel, number, raw, number)
        writer.finish()
    return path


IDL = (b'=' * 80 + b'\nIDL: my_msgs/msg/Pair\n'
       b'module my_msgs { module msg { struct Pair { double first; double second; }; }; };\n')


@pytest.mark.parametrize(('encoding', 'text'), [('ros2msg', b'float64 first\nfloat64 second\n'), ('ros2idl', IDL)])
def test_types_of_ones_own_are_read_by_the_definition_in_the_bag(encoding, text, tmp_path):
    raw = b'\x00\x01\x00\x00' + np.array([1.5, 2.5]).tobytes()
    with open_bag(schema_bag(tmp_path / 'bag.mcap', encoding, text, raw)) as bag:
        message = next(bag.messages())
        assert (message.data.first, message.data.second) == (1.5, 2.5)


@pytest.mark.parametrize(('text', 'has'), [
    ('std_msgs/Header header  # stamp = time of the exposure\nint32 x\n', True),
    ('# Header header\nint32 LARGEST = 5  # std_msgs/Header\nstd_msgs/Header header\n', True),
    ('string UNIT = "# of turns"\nint32 x\nstd_msgs/Header header\n', False), ('std_msgs/Header[] header\n', False),
    ('string<=10 name\nstd_msgs/Header header\n', False), ('uint8[<=3] data\nstd_msgs/Header header\n', False),
    ('int32 LARGEST=5\nint32 LEAST =1\nstd_msgs/Header header\n', True)])
def test_a_header_is_known_by_the_first_field_whatever_the_remarks_say(text, has):
    """A remark with an equals sign hid it, and --order header put such messages by the clock of others. A bounded field
    was passed over for a constant, and convert --stamps-from-log wrote a stamp into its text."""
    assert has_header('my_msgs/msg/Own', Schema('ros2msg', text)) is has


def test_bytes_that_do_not_fit_their_type_are_counted_and_left_out(tmp_path):
    with open_bag(schema_bag(tmp_path / 'bag.mcap', 'ros2msg', b'float64 first\nfloat64 second\n', b'\x00')) as bag:
        assert list(bag.messages()) == []
        assert '3 messages on /pair do not decode' in bag.losses.sentence


def test_types_that_nothing_defines_keep_their_bytes(tmp_path):
    with open_bag(schema_bag(tmp_path / 'bag.mcap', '', b'', b'\x00\x01\x00\x00')) as bag:
        assert [message.data for message in bag.messages()] == [None] * 3
        assert not bag.losses


def test_bags_merge_by_time(tmp_path):
    one = write_strings(tmp_path / 'one.mcap', [1, 3, 5])
    two = write_strings(tmp_path / 'two.mcap', [2, 3, 4], topic='/other')
    with MergedBag('both', [open_bag(one), open_bag(two)]) as bag:
        assert [(m.log_time, m.topic) for m in bag.messages()] == [
            (1, '/chatter'), (2, '/other'), (3, '/chatter'), (3, '/other'), (4, '/other'), (5, '/chatter')]
        assert (bag.start_ns, bag.end_ns, bag.message_count) == (1, 5, 6)
        assert not bag.losses and bag.losses.saved == 6


def test_bags_whose_topics_contradict_are_not_merged(tmp_path):
    one = write_strings(tmp_path / 'one.mcap', [1])
    with BagWriter(tmp_path / 'two.mcap') as bag:
        bag.write('/chatter', STATE, {}, 1)
    with pytest.raises(SemiparamError, match='they cannot be merged'):
        MergedBag('both', [open_bag(one), open_bag(tmp_path / 'two.mcap')])


def robot_bag(path: Path, states: str = '/joint_states', accelerations: bool = False) -> Path:
    with BagWriter(path) as bag:
        for number in range(10):
            stamp = number * 10**7
            bag.write(states, STATE, {'header': header(stamp), 'name': ['a', 'b'], 'position': [number, 0.0],
                                      'velocity': [0.0, 1.0], 'effort': [2.0, 3.0]}, stamp)
            bag.write('/wrench', WRENCH, {'header': header(stamp + 10**6, 'ft'), 'wrench': {'force': {'x': number}}},
                      stamp)
            if accelerations:
                bag.write('/joint_accelerations', 'trajectory_msgs/msg/JointTrajectory', {
                    'header': header(stamp), 'joint_names': ['a', 'b'],
                    'points': [{'accelerations': [7.0, 8.0]}]}, stamp)
    return path


def test_a_recording_becomes_samples(tmp_path):
    loaded = load_samples(robot_bag(tmp_path / 'bag.mcap'), Settings(joints=('b', 'a'), sensor_frame='ft'))
    assert len(loaded.samples) == 9 and loaded.frame_id == 'ft' and loaded.robot_description is None
    np.testing.assert_allclose(loaded.samples.position[:, 1], np.arange(9) + 0.1)
    np.testing.assert_array_equal(loaded.samples.outputs[:, 0], np.arange(9))
    assert loaded.faults == {} and not loaded.losses


def test_recordings_are_told_apart_by_the_frames_of_the_wrenches_that_are_taken(tmp_path):
    """Another sensor's wrench that came first made them different robots', and so did a slash before the frame."""
    settings = Settings(joints=('a', 'b'), sensor_frame='ft')
    paths = [robot_bag(tmp_path / 'one.mcap'), tmp_path / 'two.mcap']
    with open_bag(paths[0]) as bag, BagWriter(paths[1]) as two:
        two.write('/wrench', WRENCH, {'header': header(0, 'other')}, 0)
        for message in bag.messages():
            if message.type == WRENCH:
                message.data.header.frame_id = '/ft'
            two.write(message.topic, message.type, message.data, message.log_time)
    loaded = [load_samples(path, settings) for path in paths]
    require_same_robot(settings, loaded)
    assert [len(each.samples) for each in loaded] == [9, 9] and loaded[1].faults == {'wrong_frame': 1}


def test_measured_accelerations_are_taken_where_they_were_recorded(tmp_path):
    path = robot_bag(tmp_path / 'bag.mcap', accelerations=True)
    measured = load_samples(path, Settings(joints=('a', 'b'), sensor_frame='ft')).samples.acceleration
    np.testing.assert_array_equal(measured, np.tile([7.0, 8.0], (9, 1)))
    settings = Settings(joints=('a', 'b'), sensor_frame='ft', acceleration_source='filter')
    filtered = load_samples(path, settings).samples.acceleration
    np.testing.assert_array_equal(filtered, np.zeros((9, 2)))


def test_topics_of_other_names_are_named(tmp_path):
    path = robot_bag(tmp_path / 'bag.mcap', states='/arm')
    settings = Settings(joints=('a', 'b'), outputs='effort')
    with pytest.raises(SemiparamError, match=r'has no topic /joint_states; it has /arm, /wrench '
                                             r'\(semiparam convert --topic /arm=/joint_states renames one\)\.$'):
        load_samples(path, settings)
    with pytest.raises(SemiparamError, match='--topic /arm=/joint_states --topic /wrench renames one'):
        load_samples(path, Settings(joints=('a', 'b'), sensor_frame='ft'))  # convert leaves out what is not named


def test_the_command_that_renames_topics_leaves_none_out_that_is_needed(tmp_path):
    """Of a bag of an arm with a namespace it kept the joint states alone."""
    path, renamed = tmp_path / 'left.mcap', tmp_path / 'renamed.mcap'
    with open_bag(robot_bag(tmp_path / 'bag.mcap')) as bag, BagWriter(path) as left:
        left.write('/left/robot_description', 'std_msgs/msg/String', {'data': '<robot/>'}, 0)
        for message in bag.messages():
            left.write(f'/left{message.topic}', message.type, message.data, message.log_time)
    settings = Settings(joints=('a', 'b'), sensor_frame='ft')
    with pytest.raises(SemiparamError, match=r'\(semiparam convert (.*) renames them\)\.$') as error:
        load_samples(path, settings)
    options = re.search(r'convert (.*) renames', str(error.value))[1].split()
    assert semiparam('convert', path, renamed, *options) == 0
    loaded = load_samples(renamed, settings)
    assert (len(loaded.samples), loaded.robot_description) == (9, '<robot/>')


@pytest.mark.parametrize(('changes', 'sentence'), [
    ({'acceleration_source': 'measured'}, r'has no topic /joint_accelerations; it has /joint_states, /wrench\.$'),
    ({'joints': ('a', 'c')}, "holds no complete sample .10 on /joint_states, 10 on /wrench messages.: joint state at "
                             "0.090000000 s must name joint 'c' once; it names a, b. semiparam convert --joint "
                             'NAME=NEW renames joints.'),
    ({'joints': ('c', 'd')}, 'names a, b; expected c, d. semiparam convert --joint NAME=NEW renames joints.'),
    ({'sensor_frame': 'elsewhere'}, "is in frame 'ft'; expected 'elsewhere'"),
    ({'joints': ()}, 'bag.mcap.: no robot description'),
])
def test_a_recording_without_what_is_needed_is_refused(changes, sentence, tmp_path):
    path = robot_bag(tmp_path / 'bag.mcap')
    with pytest.raises(SemiparamError, match=sentence):
        load_samples(path, Settings(**{'joints': ('a', 'b'), 'sensor_frame': 'ft', **changes}))


def test_a_robot_description_that_is_no_text_is_none(tmp_path):
    """As internal error: object of type 'int' has no len()."""
    path = tmp_path / 'a.mcap'
    with BagWriter(path) as bag:
        bag.write('/robot_description', 'std_msgs/msg/Int32', {'data': 5}, 0)
    with open_bag(path) as bag:
        assert recorded_description(bag) is None


def test_a_topic_of_the_wrong_type_is_refused(tmp_path):
    path = write_strings(tmp_path / 'bag.mcap', [1], topic='/joint_states')
    with pytest.raises(SemiparamError, match=f'topic /joint_states holds {STRING}; expected {STATE}'):
        load_samples(path, Settings(joints=('a',), outputs='effort'))


def test_a_topic_of_accelerations_without_a_message_is_none(tmp_path):
    """As of a recorder beside a driver that offers the topic: the recording was refused, whose accelerations are
    estimated where there is no such topic."""
    path = write_bag(tmp_path / 'bag.mcap', motion(60))
    with open_bag(path) as bag, BagWriter(tmp_path / 'offered.mcap') as offered:
        offered.add_topic('/joint_accelerations', 'trajectory_msgs/msg/JointTrajectory')
        for message in bag.messages():
            if message.topic != '/joint_accelerations':
                offered.write(message.topic, message.type, message.data, message.log_time)
    settings = Settings(joints=('a', 'b'), sensor_frame='ft')
    assert len(load_samples(tmp_path / 'offered.mcap', settings).samples) > 0
    with pytest.raises(SemiparamError, match='there are none on /joint_accelerations'):
        load_samples(tmp_path / 'offered.mcap', settings.changed({'acceleration.source': 'measured'}))


def test_a_recording_of_some_joints_names_the_parameter_that_tells_which(tmp_path):
    path = write_bag(tmp_path / 'bag.mcap', motion(10), joints=('a', 'gripper'))
    with pytest.raises(SemiparamError, match=r"must name joint 'b' once; it names a, gripper. The parameter joints is "
                                             'not given, so every moving joint of the robot description is expected; '
                                             r'name in it those that the recording has\.$'):
        load_samples(path, Settings(sensor_frame='ft'))


def test_two_writers_of_one_bag_do_not_write_over_each_other(tmp_path):
    """Both wrote into the same file, and the one that failed removed it under the other."""
    with BagWriter(tmp_path / 'a.mcap') as first:
        first.write('/text', STRING, {'data': 'first'}, 0)
        with pytest.raises(SemiparamError, match=r"a\.mcap\.partial' holds a bag that broke off, or is being made"):
            BagWriter(tmp_path / 'a.mcap')
        first.write('/text', STRING, {'data': 'more'}, 1)
    with open_bag(tmp_path / 'a.mcap') as bag:
        assert [message.data.data for message in bag.messages()] == ['first', 'more']
    (tmp_path / 'a.mcap.partial').write_bytes(b'of one that was killed')
    with BagWriter(tmp_path / 'a.mcap', overwrite=True) as third:
        third.write('/text', STRING, {'data': 'third'}, 0)
    assert [path.name for path in tmp_path.iterdir()] == ['a.mcap']


def test_a_bag_that_is_being_written_is_not_replaced_by_the_next_writer(tmp_path):
    """The first gave the half of the second the name, and said that its own messages were there."""
    with BagWriter(tmp_path / 'a.mcap') as first:
        first.write('/text', STRING, {'data': 'first'}, 0)
        with pytest.raises(SemiparamError, match=r"a\.mcap\.partial' is being written by another program"):
            BagWriter(tmp_path / 'a.mcap', overwrite=True)
    with open_bag(tmp_path / 'a.mcap') as bag:
        assert [message.data.data for message in bag.messages()] == ['first']
    assert [path.name for path in tmp_path.iterdir()] == ['a.mcap']


@pytest.mark.parametrize('finish', [BagWriter.close, BagWriter.abort])
def test_a_writer_whose_file_was_removed_lets_that_of_the_next_be(tmp_path, finish):
    first = BagWriter(tmp_path / 'a.mcap')
    first.write('/text', STRING, {'data': 'first'}, 0)
    first.partial_path.unlink()
    with BagWriter(tmp_path / 'a.mcap') as second:
        with suppress(SemiparamError) if finish is BagWriter.abort else pytest.raises(
                SemiparamError, match=r"a\.mcap\.partial' has been removed or replaced meanwhile\.$"):
            finish(first)
        assert not second.path.exists() and second.partial_path.exists()
        second.write('/text', STRING, {'data': 'second'}, 0)
    with open_bag(tmp_path / 'a.mcap') as bag:
        assert [message.data.data for message in bag.messages()] == ['second']


@pytest.mark.parametrize('action', ['flush', 'close'])
def test_a_full_disk_is_one_sentence(tmp_path, monkeypatch, action):
    """A recorder whose disk filled up ended by an internal error."""
    monkeypatch.setattr(writer, '_open_for_writing', lambda *_: os.fdopen(os.open('/dev/full', os.O_WRONLY), 'wb'))
    bag = BagWriter(tmp_path / 'a.mcap')
    bag.write('/text', STRING, {'data': 'text'}, 0)
    with pytest.raises(SemiparamError, match=r"a\.mcap' cannot be written: No space left on device"):
        getattr(bag, action)()
    bag.abort()
