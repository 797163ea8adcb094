"""Independent readers read what is written here: rosbags, mcap-ros2-support and, in JavaScript, @mcap/core."""

import fcntl
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter

PACKAGES = {'@mcap/core': '2.2.2', '@mcap/support': '1.1.0', '@foxglove/rosmsg': '5.0.5',
            '@foxglove/rosmsg2-serialization': '3.1.0'}
READER = """
import { McapIndexedReader } from '@mcap/core';
import { loadDecompressHandlers } from '@mcap/support';
import { parse } from '@foxglove/rosmsg';
import { MessageReader } from '@foxglove/rosmsg2-serialization';
import { readFileSync } from 'node:fs';

const bytes = readFileSync(process.argv[2]);
const part = (offset, size) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + size)));
const readable = { size: async () => BigInt(bytes.length), read: async (offset, size) => part(offset, size) };
const decompressHandlers = await loadDecompressHandlers();
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const readers = new Map();
for (const channel of reader.channelsById.values()) {
  const text = new TextDecoder().decode(reader.schemasById.get(channel.schemaId).data);
  readers.set(channel.id, new MessageReader(parse(text, { ros2: true })));
}
const plain = (key, value) => ArrayBuffer.isView(value) ? Array.from(value) : value;
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  console.log(JSON.stringify({ topic: channel.topic, time: message.logTime.toString(),
    qos: channel.metadata.get('offered_qos_profiles'),
    data: readers.get(channel.id).readMessage(message.data) }, plain));
}
"""


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


@pytest.fixture(scope='module')
def node_modules() -> Path:
    """A folder with the JavaScript packages, installed once for all checkouts of this user."""
    if shutil.which('npm') is None:
        _unavailable('npm is not installed')
    folder = Path(tempfile.gettempdir()) / f'semiparam_ros_test_npm_{os.getuid()}'
    folder.mkdir(exist_ok=True)
    with (folder / 'lock').open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        wanted = json.dumps({'type': 'module', 'private': True, 'dependencies': PACKAGES})
        package, done = folder / 'package.json', folder / 'installed.json'
        if not done.exists() or done.read_text() != wanted:
            package.write_text(wanted)
            install = subprocess.run(['npm', 'install', '--no-audit', '--no-fund', '--loglevel=error'], cwd=folder,
                                     capture_output=True, text=True, timeout=200)
            if install.returncode:
                _unavailable(f'npm could not install {", ".join(PACKAGES)}: {install.stderr[-500:]}')
            done.write_text(wanted)
    return folder


def _unavailable(reason: str) -> None:
    """Where CI=true the JavaScript reader must be there."""
    if os.environ.get('CI', '').lower() == 'true':
        pytest.fail(reason)
    pytest.skip(reason)


def test_mcap_core_reads_what_is_written(bag, node_modules):
    script = node_modules / 'reader.mjs'
    script.write_text(READER)
    done = subprocess.run(['node', str(script), str(bag)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    theirs = [json.loads(line) for line in done.stdout.splitlines()]
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
