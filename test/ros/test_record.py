"""`semiparam record` as a process: what it picks, when it ends, and what a reader finds in the file."""

import json
import signal
import subprocess
import time
from collections import deque
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import pytest
from builtin_interfaces.msg import Time
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from std_msgs.msg import Header

from semiparam_ros.bags.qos import Qos
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.context import DELIVER_S
from semiparam_ros.ros.message_types import message_class
from semiparam_ros.ros.record import session, topics
from semiparam_ros.ros.record.node import RecordNode
from semiparam_ros.ros.record.options import Limits, RecordOptions, parse_count
from support.commands import refusal
from support.node_client import stamp_of
from support.node_helpers import JOINTS, SETTINGS, motion
from support.replay_peers import EVERYTHING, LATCHED, STATES, TEXT, WRENCH, Peer, Tool, write_robot

pytestmark = pytest.mark.usefixtures('ros_domain')

CLOCK = 'rosgraph_msgs/msg/Clock'
TIME = message_class(CLOCK)(clock=Time(sec=100))


class Source(Peer):
    """A node that publishes on demand, and waits until a recorder listens."""

    def offer(self, topic, type_name, qos=EVERYTHING):
        return self.node.create_publisher(message_class(type_name), topic, qos)

    def wait_for_listeners(self, *outputs):
        self.wait_for(lambda: all(output.get_subscription_count() for output in outputs), 'nobody records')


@contextmanager
def recorder(out, *arguments):
    """A recorder of /wrench that listens to a source: source, publisher and recorder."""
    with Source() as source:
        wrench = source.offer('/wrench', WRENCH)
        with Tool(out.parent, 'record', out, '--topics', '/wrench', *arguments) as record:
            source.wait_for_listeners(wrench)
            source.wait_for(lambda: record.said('recording 1 topics'))
            source.meet('bag_record')
            yield source, wrench, record


def topics_of(path):
    with open_bag(path) as bag:
        return {topic: info.count for topic, info in bag.topics.items()}


def test_a_nodes_outputs_beside_its_inputs_byte_for_byte(tmp_path):
    """Three processes: the node answers what the replay plays, and the record holds all of it."""
    bag, out = write_robot(tmp_path / 'a.mcap', 300), tmp_path / 'out.mcap'
    with Peer('estimator') as peer:
        peer.answer('/wrench', WRENCH)
        peer.listen('/joint_states', STATES)
        peer.listen('/robot_description', TEXT, LATCHED)
        with Tool(tmp_path, 'record', out, '--count', '/estimator/residual=300',
                  '--json', tmp_path / 'r.json') as record:
            peer.wait_for(lambda: record.said('recording 4 topics: /estimator/residual, /joint_states, '
                                              '/robot_description, /wrench.'))
            assert not out.exists()
            with Tool(tmp_path, 'replay', bag, '--as-fast-as-followed', '--wait-for-subscribers', 2) as replay:
                assert replay.wait() == 0, replay.output
            assert record.wait() == 0, record.output
    with open_bag(bag) as before, open_bag(out) as after:
        for topic in before.topics:
            recorded = [message.raw for message in after.messages([topic])]
            # The count ends with the last answer; a joint state may come after it on another thread.
            assert recorded == [message.raw for message in before.messages([topic])][:len(recorded)]
            assert len(recorded) >= before.topics[topic].count - 1
        assert after.topics['/estimator/residual'].count == 300 and not after.losses
        assert after.topics['/robot_description'].qos.latched and not after.topics['/wrench'].qos.latched
    account = json.loads((tmp_path / 'r.json').read_text())
    assert account['recorded']['/estimator/residual'] == 300 and account['messages'] >= 898
    with AnyReader([out]) as reader:
        forces = [reader.deserialize(raw, connection.msgtype).wrench.force.x
                  for connection, _, raw in reader.messages() if connection.topic == '/estimator/residual']
    assert forces == [float(k) for k in range(300)]


def test_it_ends_when_nothing_comes_any_more(tmp_path):
    out = tmp_path / 'out.mcap'
    with Source() as source:
        wrench, chatter = source.offer('/wrench', WRENCH), source.offer('/diagnostics', TEXT)
        source.node.create_timer(0.1, lambda: chatter.publish(message_class(TEXT)()))
        with Tool(tmp_path, 'record', out, '--topics', '/wrench', '/diagnostics', '--until-idle', 3) as record:
            source.wait_for_listeners(wrench, chatter)
            for _ in range(20):
                wrench.publish(message_class(WRENCH)())
            assert record.wait() == 0, record.output
    assert topics_of(out)['/wrench'] == 20 and topics_of(out)['/diagnostics'] > 2


def test_a_signal_ends_it_and_the_file_is_whole(tmp_path):
    out = tmp_path / 'out.mcap'
    with recorder(out) as (_, wrench, record):
        record.interrupt(signal.SIGSTOP)  # as on a machine that gives it no time
        for _ in range(50):
            wrench.publish(message_class(WRENCH)())
        record.interrupt(signal.SIGTERM)
        record.interrupt(signal.SIGCONT)
        assert record.wait() == 0, record.output
    assert topics_of(out) == {'/wrench': 50}
    assert record.said('recorded 50 messages') and not list(tmp_path.glob('*.partial'))


def test_a_call_that_makes_no_sense_does_not_end_it(tmp_path):
    """A parameter of a type that there is not: the recording broke off."""
    out = tmp_path / 'out.mcap'
    with recorder(out, '--count', 1) as (source, wrench, record):
        client = source.node.create_client(SetParameters, '/bag_record/set_parameters')
        source.wait_for(client.service_is_ready)
        source.meet('bag_record')
        call = client.call_async(SetParameters.Request(parameters=[Parameter(value=ParameterValue(type=77))]))
        source.wait_for(call.done)
        assert not call.result().results[0].successful
        wrench.publish(message_class(WRENCH)())
        assert record.wait() == 0, record.output
    assert topics_of(out) == {'/wrench': 1}


@pytest.mark.long
def test_what_was_published_before_the_signal_is_recorded_also_after_a_pause(tmp_path):
    out = tmp_path / 'out.mcap'
    with recorder(out) as (_, wrench, record):
        wrench.publish(message_class(WRENCH)())
        time.sleep(1.0)
        record.interrupt(signal.SIGSTOP)  # as on a machine that gives it no time
        for _ in range(600):  # more than DDS holds for it: the others are sent again after three seconds
            wrench.publish(message_class(WRENCH)())
        record.interrupt(signal.SIGINT)
        record.interrupt(signal.SIGCONT)
        assert record.wait() == 0, record.output
    assert topics_of(out) == {'/wrench': 601}


class Clock:
    """In place of the module: [s] that pass only while somebody sleeps."""

    def __init__(self):
        self.passed = 0.0

    def monotonic(self):
        return self.passed

    def time_ns(self):
        return round(1e9 * self.passed)

    def sleep(self, seconds):
        self.passed += seconds


@pytest.mark.parametrize(('arrivals', 'reliable', 'over'), [
    ([(3.1, -1.0)], True, 3.1 + DELIVER_S), ([(3.1, -1.0), (6.2, -0.5)], True, 6.2 + DELIVER_S),
    ([], True, DELIVER_S), ([(0.2, 0.1)], True, session.QUIET_S),
    ([(0.3, -1.0)], False, 0.3 + session.QUIET_S)], ids=str)
def test_what_may_still_be_sent_again_is_waited_for_and_nothing_else(monkeypatch, arrivals, reliable, over):
    """``arrivals``: when each message comes and when it was published [s], both from the end of the recording on."""
    clock, coming, taken = Clock(), list(arrivals), []
    monkeypatch.setattr(session, 'time', clock)

    def take_late():
        while coming and coming[0][0] <= clock.passed:
            taken.append(coming.pop(0))
            yield '/wrench', round(1e9 * taken[-1][1])
    node = SimpleNamespace(complete=False, take_late=take_late, count_publishers=lambda topic: 1,
                           repeated=lambda: {'/wrench'} if reliable else set())
    ended = session.RecordSession.__new__(session.RecordSession)
    ended._say = lambda sentence: None
    ended._let_the_last_arrive(SimpleNamespace(stop_spinning=lambda: None), node)
    assert taken == arrivals and clock.passed == pytest.approx(over, abs=3.0 * session.POLL_S)


def test_a_killed_recorder_leaves_what_it_had_under_another_name(tmp_path):
    out = tmp_path / 'out.mcap'
    with recorder(out) as (source, wrench, record):
        timer = source.node.create_timer(0.01, lambda: wrench.publish(message_class(WRENCH)()))
        partial = tmp_path / 'out.mcap.partial'
        # The file grows with each flush, every two seconds.
        source.wait_for(lambda: partial.exists() and partial.stat().st_size > 1000)
        record.process.kill()
        record.wait()
        timer.cancel()
    assert not out.exists() and topics_of(partial)['/wrench'] > 10


def test_all_topics_less_some_and_one_that_comes_later(tmp_path):
    out = tmp_path / 'out.mcap'
    with Source() as source:
        wrench, other = source.offer('/arm/wrench', WRENCH), source.offer('/arm/noise', TEXT)
        with Tool(tmp_path, 'record', out, '--all', '--exclude', '/arm/noise', '--count', '/late=5') as record:
            source.wait_for_listeners(wrench)
            wrench.publish(message_class(WRENCH)())
            late = source.offer('/late', STATES)
            source.wait_for_listeners(late)
            for _ in range(5):
                late.publish(message_class(STATES)())
            assert record.wait() == 0, record.output
            assert other.get_subscription_count() == 0
    assert topics_of(out) == {'/arm/wrench': 1, '/late': 5}


def test_a_best_effort_publisher_that_comes_later_is_heard(tmp_path):
    """Subscribed before anybody publishes, the recorder expects a reliable publisher and mends that when it must."""
    out = tmp_path / 'out.mcap'
    with Source() as source:
        source.listen('/wrench', WRENCH)
        with Tool(tmp_path, 'record', out, '--topics', '/wrench', '--count', 3) as record:
            source.wait_for(lambda: record.said('recording 1 topics'))
            quick = source.offer('/wrench', WRENCH, rclpy_sensor_data())
            source.wait_for_listeners(quick)
            source.node.create_timer(0.05, lambda: quick.publish(message_class(WRENCH)()))
            assert record.wait() == 0, record.output
    with open_bag(out) as bag:
        assert bag.topics['/wrench'].qos.reliability == 'best_effort' and bag.topics['/wrench'].count == 3


def test_a_publisher_of_another_type_that_comes_later_is_told_and_ends_nothing(tmp_path):
    """Of best effort, it had the recorder subscribe anew with its type: an internal error, and no recording."""
    out = tmp_path / 'out.mcap'
    with recorder(out, '--count', 2) as (source, wrench, record), Peer() as stranger:
        wrench.publish(message_class(WRENCH)())
        stranger.node.create_publisher(message_class(TEXT), '/wrench', rclpy_sensor_data())
        source.wait_for(lambda: record.process.poll() is not None or record.said(
            f'what is published on /wrench as {TEXT} is not recorded: its messages are recorded as {WRENCH}.'))
        wrench.publish(message_class(WRENCH)())
        assert record.wait() == 0, record.output
    with open_bag(out) as bag:
        assert bag.topics['/wrench'].qos.reliability == 'reliable' and bag.topics['/wrench'].count == 2


def test_a_simulated_time_is_waited_for_and_what_came_before_it_has_its_beginning(tmp_path):
    """A latched description had the time 0, so that a playback waited for the rest for years."""
    out = tmp_path / 'out.mcap'
    with Source() as source:
        source.offer('/robot_description', TEXT, LATCHED).publish(message_class(TEXT)())
        wrench, clock = source.offer('/wrench', WRENCH), source.offer('/clock', CLOCK)
        with Tool(tmp_path, 'record', out, '--topics', '/robot_description', '/wrench', '--count', 'wrench=5',
                  '--ros-args', '-p', 'use_sim_time:=true') as record:
            source.wait_for_listeners(wrench, clock)
            source.wait_for(lambda: clock.publish(TIME) or record.said('recording 2 topics'))
            for number in range(5):
                wrench.publish(message_class(WRENCH)())
                if number == 3:
                    time.sleep(0.5)  # the clock comes on another topic
                    clock.publish(message_class(CLOCK)(clock=Time(sec=99)))
                    time.sleep(0.5)
            assert record.wait() == 0, record.output
    assert record.said('the clock went back meanwhile')
    with open_bag(out) as bag:
        assert bag.start_ns == 99 * 10**9 and bag.end_ns == 100 * 10**9
        assert {topic: info.count for topic, info in bag.topics.items()} == {'/robot_description': 1, '/wrench': 5}


def test_what_arrives_while_it_is_written_does_not_end_a_recording_without_a_time_yet():
    """Where many messages came before the simulated time, looking for it among them met others that arrived."""
    node, written = SimpleNamespace(_arrived=deque(), complete=False, now=lambda: 9), []

    def arrives(stamp):
        node._arrived.append(('/wrench', b'', stamp))
        return 9

    def write(topic, raw, stamp):
        arrives(5)
        written.append(stamp)

    for stamp in (0, 0, 3, 4, 0):
        arrives(stamp)
    node.now, node._write = lambda: arrives(5), write
    RecordNode.write_arrived(node)
    assert written == [3, 3, 3, 4, 9]
    RecordNode.write_arrived(node)
    assert set(written[5:]) == {5}


def test_of_several_offers_the_one_is_recorded_that_every_subscriber_can_use(monkeypatch):
    """The first was: of best effort, a replay of it reached no reliable subscriber."""
    recorded = []
    monkeypatch.setattr(topics, 'offers', lambda *_: [Qos(reliability='best_effort', depth=3), Qos(depth=2)])
    node = RecordNode.__new__(RecordNode)
    node._writer = SimpleNamespace(add_topic=lambda *topic: recorded.append(topic), write_raw=lambda *message: None)
    node.counts, node.topics, node._limits = {'/a': 0}, {'/a': TEXT}, Limits()
    node._write('/a', b'', 1)
    assert recorded == [('/a', TEXT, Qos(depth=3))]


def rclpy_sensor_data():
    from rclpy.qos import qos_profile_sensor_data
    return qos_profile_sensor_data


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (['--node', '/estimatr', '--wait-timeout', 0.3], '/estimatr was not found within 0.3 s'),
    (['--topics', '/wrench', '--wait-timeout', 0.3], '/wrench was not found within 0.3 s'),
    (['--all', '--wait-timeout', 0.3, '--ros-args', '-p', 'use_sim_time:=true'], '/clock was not found within 0.3 s'),
    (['--topics', '/a-b'], "'/a-b' is no name of a topic"),
    (['--all', '--count', '/a/=3'], "'/a/' is no name of a topic"),
    (['--all', '--duration', 0.3], 'nothing was recorded'),
    (['--all', '--duration', 0.31], 'there is no topic to record yet; each is recorded from when it appears'),
])
def test_mistakes_are_one_sentence_and_leave_no_file(tmp_path, arguments, sentence):
    out = tmp_path / 'out' / 'out.mcap'
    out.parent.mkdir()
    with Tool(tmp_path, 'record', out, *arguments) as record:
        assert record.wait() == 2, record.output
    assert record.said(sentence) and 'Traceback' not in record.output
    assert not list(out.parent.glob('*'))


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (['--count', 'many'], "'many' is no count: expected N or TOPIC=N"),
    (['--until-idle', 0], 'the idle time must be a finite number above 0'),
    (['--wait-timeout', 'nan'], 'the time to wait must be a finite number of at least 0, got nan'),  # it never ended
])
def test_a_senseless_end_is_refused(tmp_path, capsys, arguments, sentence):
    assert sentence in refusal(capsys, 'record', tmp_path / 'out.mcap', *arguments)
    assert not list(tmp_path.iterdir())


def test_an_older_file_is_not_replaced_unless_asked(tmp_path):
    out = tmp_path / 'out.mcap'
    out.write_bytes(b'old')
    with pytest.raises(SemiparamError, match='exists already'):
        RecordOptions(out, topics=('/wrench',))
    RecordOptions(out, topics=('/wrench',), overwrite=True)
    (tmp_path / 'other.mcap.partial').write_bytes(b'of one that was killed')
    with pytest.raises(SemiparamError, match='holds a recording that broke off'):
        RecordOptions(tmp_path / 'other.mcap', topics=('/wrench',))
    with pytest.raises(SemiparamError, match='expected a node, a topic'):
        RecordOptions(tmp_path / 'new.mcap')


def test_a_file_that_got_the_name_meanwhile_is_not_replaced(tmp_path):
    out = tmp_path / 'out.mcap'
    with recorder(out) as (_, wrench, record):
        wrench.publish(message_class(WRENCH)())
        out.write_bytes(b'of another')
        record.interrupt()
        assert record.wait() == 2, record.output
    assert record.said("out.mcap' has appeared meanwhile and is not replaced; ")
    assert out.read_bytes() == b'of another' and topics_of(tmp_path / 'out.mcap.partial') == {'/wrench': 1}


def test_what_a_silent_robots_node_says_again_and_again_keeps_no_recording_going():
    """Its ~/payload came each second, so that --until-idle never ended a recording of the estimator."""
    node = RecordNode.__new__(RecordNode)
    kind = 'geometry_msgs/msg/InertiaStamped'
    node.__dict__.update(_sim_time=False, _newest=0, went_back=False, _arrived=deque(), _latched=set(), _stamps={},
                         topics={'/estimator/payload': kind, '/unstamped': kind, '/text': TEXT})
    stamped, later, unset = (serialize_message(message_class(kind)(header=Header(stamp=Time(sec=seconds))))
                             for seconds in (5, 6, 0))

    def is_news(topic, raw):
        node.last_message = 0.0
        node._receive(topic, raw)
        return node.last_message > 0.0

    payloads = stamped, stamped, later, later
    assert [is_news('/estimator/payload', raw) for raw in payloads] == [True, False, True, False]
    assert all(is_news('/unstamped', unset) and is_news('/text', b'text') for _ in range(3))


def test_counts_and_limits_as_written():
    assert parse_count('12') == (12, None) and parse_count('/a=3') == (3, '/a')
    assert Limits(idle_s=1.0).idle_s == 1.0
    with pytest.raises(SemiparamError, match='duration must be a finite number above 0'):
        Limits(duration_s=-time.monotonic())


def test_a_node_that_ends_waits_until_a_busy_recorder_has_its_last_answers(tmp_path, start_node):
    node, client = start_node(replace(SETTINGS, variant='P', acceleration_source='measured'))
    client.offer('joint_states', 'joint_accelerations', 'wrench')
    out, topic, samples = tmp_path / 'out.mcap', '/estimator/predicted_wrench', motion(500)
    with Tool(tmp_path, 'record', out, '--topics', topic) as record:
        client.wait(lambda: record.said('recording 1 topics'))
        played, partial = 0, tmp_path / 'out.mcap.partial'
        while not partial.exists() or partial.stat().st_size < 1000:  # it is flushed every two seconds
            client.play(samples[played:played + 1], JOINTS)
            played += 1
            client.wait(lambda: len(client.stamps('predicted_wrench')) == played)  # noqa: B023
            time.sleep(0.05)
        record.interrupt(signal.SIGSTOP)  # as on a machine that gives it no time
        # So few that none is lost and sent again after seconds.
        client.play(samples[played:played + 20], JOINTS)
        client.wait(lambda: len(client.stamps('predicted_wrench')) == played + 20)
        node.process.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            node.process.wait(0.3)
        record.interrupt(signal.SIGCONT)
        assert node.process.wait(60.0) == 0
        record.interrupt()
        assert record.wait() == 0, record.output
    with AnyReader([out]) as reader:
        stamps = [stamp_of(reader.deserialize(raw, connection.msgtype)) for connection, _, raw in reader.messages()]
    # The first ones came before the node knew the recorder.
    assert len(stamps) >= 20 and stamps == [sample.stamp for sample in samples[:played + 20]][-len(stamps):]
