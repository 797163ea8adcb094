"""Independent readers read what is written here: rosbags, mcap-ros2-support and, in JavaScript, @mcap/core."""

from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from support import mcap_core


@pytest.fixture(scope='module')
def bag(tmp_path_factory) -> Path:
    """Every type that the package records, over several chunks."""
    path = tmp_path_factory.mktemp('bag') / 'bag.mcap'
    with BagWriter(path, chunk_bytes=4000) as bag:
        bag.write('/robot_description', 'std_msgs/msg/String', {'data': '<robot name="ü"/>'}, 10**9)
        for row in range(100):
            stamp = 10**9 + row * 10**7
            header = {'stamp': {'sec': stamp // 10**9, 'nanosec': stamp % 10**9}, 'frame_id': 'sensor'}
            bag.write('/joint_states', 'sensor_msgs/msg/JointState', {
                'header': header, 'name': ['hip', 'knee'], 'position': [row / 7, 1.0],
                'velocity': [-1.0, row / 3]}, stamp)
            bag.write('/wrench', 'geometry_msgs/msg/WrenchStamped', {
                'header': header, 'wrench': {'force': {'x': row / 11}, 'torque': {'z': -row / 13}}}, stamp)
            bag.write('/joint_accelerations', 'trajectory_msgs/msg/JointTrajectory', {
                'header': header, 'joint_names': ['hip'], 'points': [{'accelerations': [row / 17]}]}, stamp)
    return path


def test_mcap_core_reads_what_is_written(bag, node_modules):
    theirs = mcap_core.read(node_modules, bag)
    with open_bag(bag) as reader:
        ours = list(reader.messages())
    assert len(theirs) == len(ours) == 301
    for left, right in zip(theirs, ours, strict=True):
        assert (left['topic'], int(left['time'])) == (right.topic, right.log_time)
    assert theirs[0]['data'] == {'data': '<robot name="ü"/>'} and 'transient_local' in theirs[0]['qos']
    state, wrench, accelerations = (message['data'] for message in theirs[-3:])
    assert state['name'] == ['hip', 'knee'] and state['position'] == [99 / 7, 1.0] and state['velocity'] == [-1.0, 33.0]
    assert wrench['header']['stamp'] == {'sec': 1, 'nanosec': 990000000} and wrench['header']['frame_id'] == 'sensor'
    assert (wrench['wrench']['force']['x'], wrench['wrench']['torque']['z']) == (9.0, -99 / 13)
    assert accelerations['points'][0]['accelerations'] == [99 / 17]


def test_rosbags_reads_what_is_written(bag):
    with AnyReader([bag]) as reader:
        assert {connection.topic: connection.msgtype for connection in reader.connections} == {
            '/robot_description': 'std_msgs/msg/String', '/joint_states': 'sensor_msgs/msg/JointState',
            '/wrench': 'geometry_msgs/msg/WrenchStamped', '/joint_accelerations': 'trajectory_msgs/msg/JointTrajectory'}
        offers = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
        assert offers['/robot_description'][0].durability == QosDurability.TRANSIENT_LOCAL
        assert offers['/wrench'][0].durability == QosDurability.VOLATILE
        messages = [(c.topic, time, reader.deserialize(raw, c.msgtype)) for c, time, raw in reader.messages()]
    assert len(messages) == 301
    _, time, wrench = next(entry for entry in reversed(messages) if entry[0] == '/wrench')
    assert time == 10**9 + 99 * 10**7 and wrench.wrench.force.x == 9.0


def test_mcap_ros2_support_reads_what_is_written(bag):
    with bag.open('rb') as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        topics = [channel.topic for _, channel, _, _ in reader.iter_decoded_messages()]
        summary = reader.get_summary()
    assert len(topics) == 301
    assert summary.statistics.message_count == 301
    assert all(channel.metadata['topic_type_hash'].startswith('RIHS01_') for channel in summary.channels.values())
