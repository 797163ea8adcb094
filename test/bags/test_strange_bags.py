"""Sound MCAP files of strangers: topics of two types, other encodings, definitions that are none."""

import struct
from functools import partial
from operator import itemgetter

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from mcap_ros2._dynamic import serialize_dynamic

from semiparam_ros.bags import sample_messages, schemas
from semiparam_ros.bags.loading import load_samples
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.cli.evaluate import load_bags
from semiparam_ros.cli.main import main
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings import Settings
from support.node_helpers import JOINTS, PERIOD_NS, damage_every_chunk, motion, write_bag

STATES, STATE, STRING = '/joint_states', 'sensor_msgs/msg/JointState', 'std_msgs/msg/String'
SETTINGS = Settings.from_mapping({'joints': list(JOINTS), 'sensor_frame': 'ft'})
DEFINITION = schemas.jazzy_schema(STATE).text.encode()


def strange(folder, **states):
    """A sound bag of 40 samples whose joint states have another type, definition or encoding; of
    the last 15 where ``since`` says so.
    """
    write_bag(folder / 'sound.mcap', motion(40))
    path, since = folder / 'a.mcap', states.pop('since', 0)
    with open_bag(folder / 'sound.mcap') as bag, path.open('wb') as file:
        messages, writer = list(bag.messages(decode=False)), McapWriter(file)
        writer.start('ros2', 'test')

        def channel(topic, type_name, text, schema_encoding='ros2msg', encoding='cdr'):
            schema = writer.register_schema(type_name, schema_encoding, text) if type_name else 0
            return writer.register_channel(topic, encoding, schema)

        known = {topic: channel(topic, info.type, schemas.jazzy_schema(info.type).text.encode())
                 for topic, info in bag.topics.items()}
        other = channel(STATES, **{'type_name': STATE, 'text': DEFINITION, **states})
        count = 0
        for each in messages:
            count += each.topic == STATES
            used = other if each.topic == STATES and count > since else known[each.topic]
            writer.add_message(used, each.log_time, each.raw, each.publish_time)
        writer.finish()
    return path


def test_messages_of_another_type_are_passed_over_and_told(tmp_path, capsys):
    """They were read by the definition of the other type, or the whole bag was refused."""
    path = strange(tmp_path, since=25, type_name=STRING, text=b'string data')
    loaded = load_samples(path, SETTINGS)
    assert len(loaded.samples) == 25
    assert f'15 messages on {STATES} are {STRING} (cdr), not {STATE} (cdr)' in loaded.losses.sentence
    assert main(['convert', str(path), str(tmp_path / 'b.mcap')]) == 0
    assert f'25 on {STATES}' in capsys.readouterr().err
    with open_bag(tmp_path / 'b.mcap') as bag:
        assert bag.topics[STATES].count == 25 and not bag.losses
        assert sum(message.topic == STATES for message in bag.messages()) == 25


@pytest.mark.parametrize('states', [
    {'text': b'\xff\xfe no definition \x00'}, {'text': b'module {', 'schema_encoding': 'ros2idl'},
    {'text': b''}, {'schema_encoding': 'jsonschema'}])
def test_a_definition_that_cannot_be_read_is_that_of_jazzy(tmp_path, states):
    """As internal error: 'NoneType' object has no attribute 'header'."""
    assert len(load_samples(strange(tmp_path, **states), SETTINGS).samples) == 40


def recorded(path, topic, *messages, names=('a',)):
    """A bag of joint states of these bytes, or of these joints."""
    raw = messages or [schemas.encoder(STATE)({'header': {'stamp': {'sec': second, 'nanosec': 0}, 'frame_id': ''},
                                               'name': list(names), 'position': [0.5] * len(names),
                                               'velocity': [], 'effort': [0.1] * len(names)}) for second in (1, 2)]
    with path.open('wb') as file:
        writer = McapWriter(file)
        writer.start('ros2', 'test')
        channel = writer.register_channel(topic, 'cdr', writer.register_schema(STATE, 'ros2msg', DEFINITION))
        for number, each in enumerate(raw):
            writer.add_message(channel, number, each, number)
        writer.finish()
    return path


def test_messages_laid_out_otherwise_are_not_taken_for_what_ros_records(tmp_path):
    """Numbers of XCDR2 stand at multiples of four bytes: its message was read as one without efforts."""
    body = (struct.pack('<iI', 1, 0) + struct.pack('<I', 1) + b'\0\0\0\0'  # stamp, frame
            + struct.pack('<II', 1, 2) + b'a\0\0\0' + 3 * struct.pack('<Id', 1, 0.5))
    path = recorded(tmp_path / 'a.mcap', STATES, b'\0\7\0\0' + body)
    with pytest.raises(SemiparamError, match='1 on /joint_states do not decode'):
        load_samples(path, Settings(outputs='effort', joints=('a',)))


@pytest.mark.parametrize(('topic', 'names', 'sentence'), [
    ('/arm\n\x1b[31m', 'a', r'it has /arm\\n\\x1b\[31m \(semiparam convert'),  # the terminal went on in red
    (STATES, ['\x1b]0;b\7'], r'names \\x1b\]0;b\\x07; expected a'),
    (STATES, 'aa', r"must name joint 'a' once; it names a, a\.$")])  # ...; others name the rest
def test_names_are_shown_as_they_are(topic, names, sentence, tmp_path):
    path = recorded(tmp_path / 'a.mcap', topic, names=names)
    with pytest.raises(SemiparamError, match=sentence) as error:
        load_samples(path, Settings(outputs='effort', joints=('a',)))
    assert str(error.value).isprintable()


@pytest.mark.parametrize(('states', 'sentence'), [
    ({'encoding': 'json'}, "messages on /joint_states are encoded as 'json'; expected cdr"),
    ({'type_name': ''}, 'topic /joint_states holds no known type; expected sensor_msgs/msg/JointState'),
    ({'type_name': 'JointState'}, 'topic /joint_states holds JointState; expected'),
    ({'text': b'string[] name\nfloat64[] header\nfloat64[900] other'}, '40 on /joint_states do not decode'),
    ({'text': b'float64[] position\nfloat64 stamp'},
     r"defines sensor_msgs/msg/JointState in a way of its own, .* no attribute 'header'"),
    ({'text': b'float64 header'}, 'defines sensor_msgs/msg/JointState in a way of its own'),
])
def test_what_cannot_be_decoded_is_one_sentence(tmp_path, states, sentence):
    with pytest.raises(SemiparamError, match=sentence):
        load_samples(strange(tmp_path, **states), SETTINGS)


HEADER = b"""std_msgs/Header header
%s
==========
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
==========
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec""".replace(b'=' * 10, b'=' * 80)


@pytest.mark.parametrize('fields', [{'position': 'float64'}, {'position': 'string[]'}, {'name': 'uint8[]'}])
def test_fields_of_other_kinds_are_one_sentence(tmp_path, fields):
    """They ended in a TypeError of len() or of sum()."""
    kinds = {'name': 'string[]', **dict.fromkeys(('position', 'velocity', 'effort'), 'float64[]'), **fields}
    text = HEADER % b'\n'.join(f'{kind} {name}'.encode() for name, kind in kinds.items())
    values = {'float64': 1.0, 'float64[]': [1.0] * len(JOINTS), 'string[]': list(JOINTS), 'uint8[]': [1] * len(JOINTS)}
    raw = serialize_dynamic(STATE, text.decode())[STATE](
        {'header': {'stamp': {'sec': 1, 'nanosec': 0}, 'frame_id': ''},
         **{name: values[kind] for name, kind in kinds.items()}})
    with (tmp_path / 'a.mcap').open('wb') as file:
        writer = McapWriter(file)
        writer.start('ros2', 'test')
        channel = writer.register_channel(STATES, 'cdr', writer.register_schema(STATE, 'ros2msg', text))
        writer.add_message(channel, 1, raw, 1)
        writer.finish()
    with pytest.raises(SemiparamError, match=f'defines {STATE} in a way of its own'):
        load_samples(tmp_path / 'a.mcap', Settings(outputs='effort', joints=JOINTS))


def test_convert_changes_nothing_in_a_definition_of_ones_own(tmp_path, capsys):
    """As internal error: 'JointState' object has no attribute 'name'."""
    path, out = strange(tmp_path, text=b'float64[] position\nfloat64 stamp'), tmp_path / 'b.mcap'
    for option in ('--effort-sign=-1', '--stamps-from-log'):
        assert main(['convert', str(path), str(out), option]) == 2
        assert f'defines {STATE} in a way of its own' in capsys.readouterr().err
    assert not out.exists() and main(['convert', str(path), str(out)]) == 0


def test_convert_tells_what_it_leaves_out_and_takes_no_other_encoding_for_cdr(tmp_path, capsys):
    path, out = strange(tmp_path, encoding='json'), tmp_path / 'b.mcap'
    assert main(['convert', str(path), str(out)]) == 0
    assert "/joint_states is left out: its messages are encoded as 'json'" in capsys.readouterr().err
    assert main(['convert', str(path), str(out), '--topic', STATES]) == 2
    assert "encoded as 'json'; expected a type of ROS 2, as cdr" in capsys.readouterr().err


def test_convert_leaves_out_a_type_that_nothing_defines(tmp_path, capsys):
    """A .db3 file of before Iron holds no definitions: with a topic of a type of one's own all of it was refused."""
    path, out = tmp_path / 'old.mcap', tmp_path / 'b.mcap'
    with path.open('wb') as file:
        writer = McapWriter(file)
        writer.start('ros2', 'test')
        for topic, kind in ((STATES, STATE), ('/franka', 'franka_msgs/msg/FrankaState')):
            channel = writer.register_channel(topic, 'cdr', writer.register_schema(kind, '', b''))
            writer.add_message(channel, 1, schemas.encoder(STATE)({}), 1)
        writer.finish()
    assert main(['convert', str(path), str(out)]) == 0
    assert '/franka is left out: neither the bag nor ROS 2 Jazzy defines its type franka_msgs/msg/FrankaState.' in \
        capsys.readouterr().err
    with open_bag(out) as bag:
        assert list(bag.topics) == [STATES] and bag.message_count == 1
    assert main(['convert', str(path), str(out), '--topic', '/franka']) == 2
    assert 'topic /franka holds franka_msgs/msg/FrankaState' in capsys.readouterr().err


def test_a_recording_without_samples_says_what_is_missing_in_it(tmp_path):
    """Of a bag whose every chunk is damaged, or whose topic is empty, it said that 0 outputs have no joint state."""
    path, damaged = tmp_path / 'a.mcap', tmp_path / 'damaged.mcap'
    for each in (path, damaged):
        write_bag(each, motion(40))
    damage_every_chunk(damaged)
    with pytest.raises(SemiparamError, match=r'no complete sample .*\): .* is damaged: .* 0 of \d+ messages read'):
        load_samples(damaged, SETTINGS)
    with open_bag(path) as bag, BagWriter(tmp_path / 'empty.mcap') as empty:
        for topic, info in bag.topics.items():
            empty.add_topic(topic, info.type, info.qos, info.schema)
        for message in bag.messages([STATES, '/joint_accelerations'], decode=False):
            empty.write_raw(message.topic, message.raw, message.log_time, message.publish_time)
    with pytest.raises(SemiparamError, match=r'0 on /wrench, .* messages\): there are none on /wrench\.$'):
        load_samples(tmp_path / 'empty.mcap', SETTINGS)


def with_another_robot(path, samples, others):
    """A bag of a robot's samples, with joint states of another one between them."""
    write_bag(path.with_name('alone.mcap'), samples)
    with open_bag(path.with_name('alone.mcap')) as alone, BagWriter(path) as bag:
        messages = [(message.log_time, partial(bag.write, message.topic, message.type, message.data, message.log_time))
                    for message in alone.messages()]
        for stamp, position, velocity, *_ in others:
            between = stamp + PERIOD_NS // 2
            messages.append((between, partial(sample_messages.joint_state, bag, between, JOINTS,
                                              (position + 1.0).tolist(), velocity.tolist())))
        for _, write in sorted(messages, key=itemgetter(0)):
            write()
    return path


def test_joint_states_of_two_robots_are_told_and_those_of_the_second_left_out(tmp_path, capsys):
    """They were mixed in silence: the error of a model was a hundred times as large."""
    samples = motion(100)
    path = with_another_robot(tmp_path / 'a.mcap', samples, samples[:99])
    loaded, = load_bags([path], SETTINGS)
    said = ' '.join(capsys.readouterr().err.split())
    assert 'positions on /joint_states go to and fro faster than joints can, so several publish there. 99 ' in said
    assert 'Record each robot on a topic of its own.' in said and loaded.faults['elsewhere'] == 99
    alone = load_samples(tmp_path / 'alone.mcap', SETTINGS).samples
    np.testing.assert_array_equal(loaded.samples.position, alone.position)
    np.testing.assert_array_equal(loaded.samples.stamps, alone.stamps)


def test_a_joint_state_that_jumps_once_or_positions_in_degrees_are_no_second_robot(tmp_path):
    samples = motion(1000)
    load = partial(load_samples, settings=SETTINGS)
    assert not load(with_another_robot(tmp_path / 'a.mcap', samples, samples[50:51])).shared
    moved = [*samples[:50], *(sample._replace(position=sample.position + 5.0) for sample in samples[50:])]
    degrees = [sample._replace(position=np.rad2deg(sample.position)) for sample in samples]
    for number, each in enumerate((moved, degrees, degrees[::2])):
        loaded = load(write_bag(tmp_path / f'{number}.mcap', each))
        assert len(loaded.samples) == len(each) and not loaded.shared and not loaded.faults
