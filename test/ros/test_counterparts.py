"""Programs of others on the other side: another DDS vendor, rosbags and Foxglove's MCAP library."""

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from conftest import _free_domain
from semiparam_ros.bags.loading import load_samples
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.ros.message_types import message_class
from semiparam_ros.settings import load_params
from support import mcap_core
from support.recordings import FRAME, JOINTS, write_arm
from support.replay_peers import EVERYTHING, LATCHED, START, STATES, TEXT, WRENCH, Peer, Tool, write_robot

SUPPORT = Path(__file__).resolve().parents[1] / 'support'
# A namespace in which the only network is loopback: two DDS vendors meet there, and nobody else hears them.
NETWORK = 'ip link set lo up && ip link set lo multicast on && ip route add 224.0.0.0/4 dev lo && exec "$@"'
PARAMS = f"""
/**:
  ros__parameters:
    joints: {json.dumps(JOINTS)}
    sensor_frame: {FRAME}
    features.count: 40
    initial.samples: 100
"""


def alone():
    """The command that runs another in a namespace of its own; skips where that is not permitted."""
    reason = 'unshare and ip (util-linux, iproute2) are not installed'
    if shutil.which('unshare') and shutil.which('ip'):
        for unshare in (['unshare', '-n'], ['unshare', '-r', '-n']):
            command = [*unshare, 'sh', '-c', NETWORK, 'sh']
            done = subprocess.run([*command, 'true'], capture_output=True, text=True)
            if done.returncode == 0:
                return command
            reason = f'a network namespace is not permitted here: {done.stderr.strip()}'
    if os.environ.get('CI', '').lower() == 'true':
        pytest.fail(reason)
    return pytest.skip(reason)


@pytest.fixture(scope='module')
def cyclone(tmp_path_factory):
    """What Cyclone DDS received from the estimator and heard about its parameters; the bag and the parameters."""
    folder = tmp_path_factory.mktemp('cyclone')
    bag, params, out = write_arm(folder / 'arm.mcap', 300), folder / 'params.yaml', folder / 'out.json'
    params.write_text(PARAMS)
    environment = {name: value for name, value in os.environ.items() if name != 'ROS_AUTOMATIC_DISCOVERY_RANGE'}
    with _free_domain() as domain:
        command = [*alone(), sys.executable, SUPPORT / 'counterpart_cyclone.py', bag, params, out]
        environment |= {'ROS_DOMAIN_ID': str(domain), 'ROS_LOG_DIR': str(folder / 'ros_log')}
        for _ in range(4):  # the binding of the other vendor dies of a segmentation fault now and then, or hangs
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                                       env=environment, start_new_session=True)
            try:
                _, said = process.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                said = 'it hung'
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # the estimator that it started, too
            if process.wait() >= 0:
                break
    log = out.with_suffix('.log')
    assert process.returncode == 0, said + (log.read_text() if log.exists() else '')
    return json.loads(out.read_text()), bag, params


def test_another_dds_vendor_receives_the_predictions_of_the_offline_estimator(cyclone):
    heard, bag, params = cyclone
    settings = load_params(params)
    loaded = load_samples(bag, settings)
    learner = OfflineLearner(settings, [loaded], lambda: None, heard['takeovers'])
    expected = [(sample.stamp, learner.step(sample, True).mean) for sample in loaded.samples]
    assert [stamp for stamp, _ in heard['answers']] == [stamp for stamp, _ in expected] and len(expected) == 300
    np.testing.assert_allclose([mean for _, mean in heard['answers']], [mean for _, mean in expected], atol=1e-9)
    assert heard['exit'] == 0


def test_another_dds_vendor_lists_sets_and_refuses_parameters(cyclone):
    heard, _, _ = cyclone
    assert {'variant', 'features.count', 'horizon.length', 'effects'} <= set(heard['listed'])
    (done, _), (also, _), *refused = heard['results']
    assert done and also
    assert [successful for successful, _ in refused] == [False] * 4
    sentences = [reason for _, reason in refused]
    assert 'forgetting' in sentences[0] and '7' in sentences[0] and 'forgetting' in sentences[1]
    assert 'SPK-ML' in sentences[2] and "'forgetting'" in sentences[3]
    assert heard['values'] == [0.999, False, 'SPK-ML']


NO_LIMIT = QosTime(2147483647, 4294967295)
OFFER = Qos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, NO_LIMIT, NO_LIMIT,
            QosLiveliness.AUTOMATIC, NO_LIMIT, False)


@pytest.mark.parametrize('storage', [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_rosbag2_directory_written_by_rosbags_plays(tmp_path, ros_domain, storage):
    types = get_typestore(Stores.ROS2_JAZZY)
    with open_bag(write_robot(tmp_path / 'a.mcap', 50)) as bag:
        messages = list(bag.messages(decode=False))
    with Writer(tmp_path / 'theirs', version=9, storage_plugin=storage) as writer:
        topics = {topic: writer.add_connection(topic, kind, typestore=types,
                                               offered_qos_profiles=[OFFER] if kind == TEXT else [])
                  for topic, kind in {'/robot_description': TEXT, '/joint_states': STATES, '/wrench': WRENCH}.items()}
        for message in messages:
            writer.write(topics[message.topic], message.log_time, message.raw)
    assert (tmp_path / 'theirs' / 'metadata.yaml').exists()
    with Peer() as peer:
        peer.listen('/robot_description', TEXT, LATCHED, raw=True)
        peer.listen('/joint_states', STATES, raw=True)
        peer.listen('/wrench', WRENCH, raw=True)
        with Tool(tmp_path, 'replay', tmp_path / 'theirs', '--wait-for-subscribers', '--rate', 5) as tool:
            assert tool.wait() == 0, tool.output
        peer.wait_for(lambda: sum(map(len, peer.heard.values())) == len(messages))
        for topic, heard in peer.heard.items():
            assert heard == [message.raw for message in messages if message.topic == topic]


def test_mcap_core_reads_what_record_writes(tmp_path, ros_domain, node_modules):
    out = tmp_path / 'out.mcap'
    with Peer('arm') as peer:
        wrench = peer.node.create_publisher(message_class(WRENCH), '/wrench', EVERYTHING)
        latched = peer.node.create_publisher(message_class(TEXT), '/robot_description', LATCHED)
        latched.publish(message_class(TEXT)(data='<robot/>'))
        with Tool(tmp_path, 'record', out, '--node', '/arm', '--count', '/wrench=30') as record:
            peer.wait_for(lambda: wrench.get_subscription_count() and record.said('recording 2 topics'))
            for k in range(30):
                message = message_class(WRENCH)()
                message.header.stamp.sec, message.wrench.force.z = START // 10**9, float(k)
                wrench.publish(message)
            assert record.wait() == 0, record.output
    read = mcap_core.read(node_modules, out)
    wrenches = [each for each in read if each['topic'] == '/wrench']
    assert [each['data']['wrench']['force']['z'] for each in wrenches] == [float(k) for k in range(30)]
    assert wrenches[0]['data']['header']['stamp'] == {'sec': START // 10**9, 'nanosec': 0}
    described = [each for each in read if each['topic'] == '/robot_description']
    assert described[0]['data'] == {'data': '<robot/>'} and 'transient_local' in described[0]['qos']
