"""`bag_replay` as a process on real DDS, with listening and answering nodes on the other side."""

import json
import os
import pty
import select
import signal
import sys
import time
from io import StringIO
from math import inf, nan
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, patch

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rich.console import Console
from std_srvs.srv import Trigger

from semiparam_ros.bags.base import TopicInfo
from semiparam_ros.bags.header_stamp import read_stamp
from semiparam_ros.bags.qos import Qos
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.options import FollowOptions, ReplayOptions
from semiparam_ros.playback.player import Player
from semiparam_ros.playback.timeline import Selection
from semiparam_ros.ros.replay.controls import ReplayControls
from semiparam_ros.ros.replay.follower import Follower
from semiparam_ros.ros.replay.session import ReplaySession
from semiparam_ros.ros.replay.subscribers import NAMED_S, SETTLE_S, SubscriberCheck, owner
from support.commands import refusal
from support.replay_peers import (
    EVERYTHING,
    LATCHED,
    PATIENCE_S,
    SECOND,
    START,
    STATES,
    TEXT,
    WRENCH,
    Peer,
    Tool,
    stamp,
    write_robot,
)

pytestmark = pytest.mark.usefixtures('ros_domain')

SILENT_S = 10
"""Silence that ends a playback: longer than a busy machine lets a follower that goes on stand still."""


def replayed(tmp_path, *arguments, code=0):
    """The playback of these arguments, which has ended with this exit code."""
    with Tool(tmp_path, 'replay', *arguments) as tool:
        assert tool.wait() == code, tool.output
    return tool


def raw_messages(path, topic):
    with open_bag(path) as bag:
        return [message.raw for message in bag.messages([topic], decode=False)]


def test_lossless_with_a_short_queue_and_every_byte_as_recorded(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 1000)
    with Peer('estimator') as peer:
        peer.answer('/wrench', WRENCH, depth=20)
        peer.listen('/joint_states', STATES, raw=True)
        peer.listen('/robot_description', TEXT, LATCHED, raw=True)
        tool = replayed(tmp_path, bag, '--as-fast-as-followed', '--window', 20, '--json',
                        tmp_path / 'a.json')
        for topic, heard in peer.heard.items():
            assert heard == raw_messages(bag, topic)
    account = json.loads((tmp_path / 'a.json').read_text())
    assert account['ending'] == 'finished' and account['messages'] == 2001
    assert account['answers'][0] == {'topic': '/estimator/residual', 'request_topic': '/wrench', 'requests': 1000,
                                     'answers': 1000, 'unexpected': 0, 'unanswered': 0,
                                     'first_unanswered_stamp_ns': None}
    assert tool.said('/estimator/residual answered 1000 of 1000 messages on /wrench.')


def test_a_follower_that_falls_silent_ends_the_playback_with_a_sentence(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 400)
    with Peer('estimator') as peer:
        peer.answer('/wrench', WRENCH, refuses=lambda count: count > 150)
        tool = replayed(tmp_path, bag, '--as-fast-as-followed', '--window', 50, '--answer-timeout',
                        SILENT_S, code=1)
    assert tool.said('while 50 messages on /wrench wait for it; it answered 150 of 200')
    assert tool.said('answered 150 of 200 messages on /wrench; 50 unanswered, the first stamped 1700000001.500000000 s')
    assert 'Traceback' not in tool.output


def test_a_subscriber_that_takes_nothing_ends_a_lossless_playback_with_a_sentence(tmp_path):
    # More than the queues of both sides hold: 5000 each.
    bag = write_robot(tmp_path / 'a.mcap', 10500)
    with Peer('estimator') as peer, Peer('idle') as idle:
        peer.answer('/wrench', WRENCH)
        idle.executor.remove_node(idle.node)
        idle.listen('/joint_states', STATES)
        tool = replayed(tmp_path, bag, '--as-fast-as-followed', '--answer-timeout', SILENT_S,
                        '--wait-for-subscribers', 2, code=1)
    assert tool.said('failed: /joint_states cannot be published: a reliable subscriber has taken nothing for 10 s')


def test_a_follower_that_leaves_ends_the_playback_at_once(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 400)
    with Peer('estimator') as peer:
        peer.answer('/wrench', WRENCH, refuses=lambda count: count > 150)
        with Tool(tmp_path, 'replay', bag, '--as-fast-as-followed') as tool:
            # All that the window lets through: the last answers have reached the playback then.
            peer.wait_for(lambda: len(peer.heard['/wrench']) == 250)
            peer.node.destroy_node()
            assert tool.wait() == 1, tool.output
    assert tool.said('failed: the follower has left while ') and tool.said('it answered 150 of 250')


def test_refused_samples_are_counted_and_told(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 300)
    with Peer('estimator') as peer:
        peer.answer('/wrench', WRENCH, refuses=lambda count: count % 100 == 50)
        tool = replayed(tmp_path, bag, '--as-fast-as-followed', code=1)
    assert tool.said('3 of 300 messages on /wrench were not answered')


def test_two_followers_in_two_namespaces_answer_one_playback(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 500)
    with Peer('estimator') as peer:
        peer.answer('/wrench', WRENCH, '/left/residual')
        peer.answer('/joint_states', STATES, '/right/residual')
        tool = replayed(tmp_path, bag, '--as-fast-as-followed', '--follow', '/left/residual',
                        '/right/residual=/joint_states', '--window', 30)
    assert tool.said('/left/residual answered 500 of 500') and tool.said('/right/residual answered 500 of 500')


def test_paced_playback_offers_what_the_bag_recorded_and_the_overrides_change_it(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 60, wrench=Qos(reliability='best_effort'), joint_states=Qos(depth=3))
    overrides = tmp_path / 'overrides.yaml'
    overrides.write_text('/joint_states: {durability: transient_local, depth: 50}\n')
    with Peer() as peer:
        peer.listen('/wrench', WRENCH, 10)  # asks for more than best effort: nothing will come, and a sentence says so
        peer.listen('/joint_states', STATES, QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=1,
                                                        durability=DurabilityPolicy.TRANSIENT_LOCAL))
        with Tool(tmp_path, 'replay', bag, '--rate', 2, '--wait-for-subscribers', '--qos-overrides', overrides,
                  '--start-paused') as tool:  # it is there until its offers are read
            # A message may come before the graph tells who sent it.
            peer.wait_for(lambda: all(map(peer.node.get_publishers_info_by_topic, peer.heard)))
            offer = {topic: peer.node.get_publishers_info_by_topic(topic)[0].qos_profile
                     for topic in peer.heard}
            assert peer.call(Trigger, '/bag_replay/resume').success
            assert tool.wait() == 0, tool.output
        peer.wait_for(lambda: len(peer.heard['/joint_states']) >= 60)
    assert offer['/wrench'].reliability.name == 'BEST_EFFORT' and offer['/wrench'].durability.name == 'VOLATILE'
    assert offer['/joint_states'].durability.name == 'TRANSIENT_LOCAL'
    assert tool.said('/peer receives nothing on /wrench'), tool.output


def test_who_subscribes_with_another_type_is_told(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 60)
    with Peer() as peer:
        peer.listen('/wrench', STATES, 10)
        peer.listen('/joint_states', STATES, 10)
        with Tool(tmp_path, 'replay', bag, '--rate', 2, '--wait-for-subscribers') as tool:
            assert tool.wait() == 0, tool.output
    assert tool.said('/peer receives nothing on /wrench: it is published as geometry_msgs/msg/WrenchStamped, and '
                     'subscribed to as sensor_msgs/msg/JointState.'), tool.output
    assert len(peer.heard['/wrench']) == 0
    assert len(peer.heard['/joint_states']) == 60


@pytest.mark.parametrize('named_at', [1.0, None])
def test_a_subscriber_is_waited_for_until_it_has_a_name(named_at):
    """A sentence about it named a number of DDS; who is not of ROS has no name, and is waited for no longer."""
    now, info = 0.0, TopicEndpointInfo(
        node_name='_NODE_NAME_UNKNOWN_', node_namespace='_NODE_NAMESPACE_UNKNOWN_', topic_type=WRENCH)
    publisher = SimpleNamespace(topic_name='/wrench', get_subscription_count=lambda: 1)
    check = SubscriberCheck(SimpleNamespace(
        outputs={'/wrench': publisher}, offers={'/wrench': Qos()}, types={'/wrench': WRENCH},
        get_subscriptions_info_by_topic=lambda _: [info]), 1)
    with patch('time.monotonic', lambda: now):
        while not check():
            now += 0.1
            if named_at is not None and now > named_at:
                info.node_name, info.node_namespace = 'peer', '/'
    assert (owner(info) == '/peer') == (named_at is not None)
    assert now == pytest.approx((named_at or 0.0) + (SETTLE_S if named_at else NAMED_S), abs=0.25)


def test_messages_come_at_their_time(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 221, rate_hz=20)
    with Peer() as peer:
        arrivals = []
        peer.node.create_subscription(peer_type(WRENCH), '/wrench', lambda _: arrivals.append(time.monotonic()), 221)
        replayed(tmp_path, bag, '--wait-for-subscribers', '--topics', '/wrench')
        peer.wait_for(lambda: len(arrivals) >= 221)
    assert len(arrivals) == 221
    # Any one of them may wait for a busy machine, which stands still for less than half of the playback.
    late = np.array(arrivals) - np.arange(221) / 20
    assert late[-110:].min() == pytest.approx(late[:110].min(), abs=0.1)


def test_a_recording_of_a_follower_is_played_to_it_without_its_old_answers(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 50)
    with open_bag(bag) as source, BagWriter(tmp_path / 'b.mcap') as copy:
        for message in source.messages():
            copy.write(message.topic, message.type, message.data, message.log_time)
            if message.topic == '/wrench':
                copy.write('/estimator/residual', WRENCH, message.data, message.log_time)
    with Peer('estimator') as peer:
        peer.answer('/wrench', WRENCH)
        tool = replayed(tmp_path, tmp_path / 'b.mcap', '--as-fast-as-followed')
    assert tool.said('/estimator/residual is not played: the follower publishes there.')
    assert tool.said('answered 50 of 50')


def test_a_follower_that_needs_the_description_first_gets_it_first(tmp_path):
    """The estimator offers no answers before it knows its robot, which only the bag describes."""
    bag = write_robot(tmp_path / 'a.mcap', 50)
    with Peer('estimator') as peer:
        peer.heard['/robot_description'] = descriptions = []

        def begin(message):
            descriptions.append(message)
            peer.answer('/wrench', WRENCH)
        peer.node.create_subscription(peer_type(TEXT), '/robot_description', begin, LATCHED)
        tool = replayed(tmp_path, bag, '--as-fast-as-followed')
    assert len(descriptions) == 1 and tool.said('answered 50 of 50') and tool.said('/robot_description 1,')


def test_a_long_run_of_refused_samples_is_passed_when_the_follower_keeps_all(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 40)
    with Peer('estimator') as peer:
        peer.node.declare_parameter('queue_depth', 0)
        peer.answer('/wrench', WRENCH, refuses=lambda count: count <= 15)
        tool = replayed(tmp_path, bag, '--as-fast-as-followed', '--window', 10, code=1)
    assert tool.said('answered 25 of 40 messages on /wrench; 15 unanswered')
    assert tool.said('failed: 15 of 40 messages on /wrench were not answered.')


def peer_type(name):
    from semiparam_ros.ros.message_types import message_class
    return message_class(name)


def test_another_name_new_stamps_and_the_clock(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 200, rate_hz=10)  # in 6 s a machine that stands still lets some clocks pass
    before = time.time_ns()
    with Peer() as peer:
        peer.listen('/force', WRENCH, raw=True)
        peer.listen('/joint_states', STATES)
        peer.listen('/clock', 'rosgraph_msgs/msg/Clock')
        replayed(tmp_path, bag, '--rate', 2.5, '--wait-for-subscribers', '--remap',
                 '/wrench:=/force', '--restamp', '--clock', 100, '--regex', 'wrench',
                 '--start-offset', 5)
        peer.wait_for(lambda: len(peer.heard['/force']) >= 150)
    assert len(peer.heard['/force']) == 150 and peer.heard['/joint_states'] == []
    stamps = [read_stamp(raw) for raw in peer.heard['/force']]
    assert stamps == sorted(stamps) and before < stamps[0] < stamps[-1] < time.time_ns()
    clock = [message.clock.sec * SECOND + message.clock.nanosec for message in peer.heard['/clock']]
    assert len(clock) > 10 and clock == sorted(clock)
    assert clock[0] >= START + 5 * SECOND and clock[-1] <= stamp(199, 10)


def set_parameter(peer, name, value):
    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value) if isinstance(value, float) \
        else ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=value)
    request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
    return peer.call(SetParameters, '/bag_replay/set_parameters', request).results[0]


def test_services_and_parameters_steer_a_playback(tmp_path):
    # Played at 500 a second: what a listener misses that stands still is sent again.
    bag = write_robot(tmp_path / 'a.mcap', 1000, wrench=Qos(depth=5000))
    with Peer() as peer:
        peer.listen('/wrench', WRENCH, raw=True)
        wrenches = peer.heard['/wrench']
        with Tool(tmp_path, 'replay', bag, '--start-paused', '--wait-for-subscribers', '--topics', '/wrench') as tool:
            def trigger(service):
                return peer.call(Trigger, f'/bag_replay/{service}')

            assert trigger('is_paused').success
            assert trigger('play_next').success and trigger('play_next').success
            peer.wait_for(lambda: len(wrenches) == 2)
            refused = set_parameter(peer, 'rate', -1.0)
            assert not refused.successful and 'above 0' in refused.reason
            refused = set_parameter(peer, 'seek_to', 12.0)
            assert not refused.successful and 'lasts from 0 to 9.990 s' in refused.reason
            assert set_parameter(peer, 'seek_to', 5.0).successful
            assert trigger('play_next').success
            peer.wait_for(lambda: len(wrenches) == 3)
            assert trigger('seek').success and trigger('play_next').success
            peer.wait_for(lambda: len(wrenches) == 4)
            assert [read_stamp(raw) for raw in wrenches] == [stamp(k, 100) for k in (0, 1, 500, 500)]
            assert set_parameter(peer, 'rate', 5.0).successful and set_parameter(peer, 'loop', True).successful
            assert trigger('resume').success and not trigger('is_paused').success and not trigger('play_next').success
            peer.wait_for(lambda: len(wrenches) >= 600)
            assert trigger('toggle_paused').success
            values = peer.call(GetParameters, '/bag_replay/get_parameters',
                               GetParameters.Request(names=['rate', 'paused', 'loop'])).values
            assert (values[0].double_value, values[1].bool_value, values[2].bool_value) == (5.0, True, True)
            assert trigger('stop').success
            assert tool.wait() == 0 and tool.said('stopped after')
    looped = [read_stamp(raw) for raw in wrenches[3:505]]
    assert looped == [stamp(k, 100) for k in [*range(500, 1000), 0, 1]]


def test_a_signal_ends_it_with_an_account(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 1000, rate_hz=10)
    with Peer() as peer:
        peer.listen('/wrench', WRENCH)
        with Tool(tmp_path, 'replay', bag, '--wait-for-subscribers') as tool:
            peer.wait_for(lambda: len(peer.heard['/wrench']) >= 3)
            tool.interrupt(signal.SIGTERM)
            assert tool.wait() == 0
    assert tool.said('stopped after') and 'Traceback' not in tool.output


def test_a_signal_to_a_lossless_playback_is_no_success(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 400)
    with Peer('estimator') as peer:
        peer.answer('/wrench', WRENCH, refuses=lambda count: count > 150)
        with Tool(tmp_path, 'replay', bag, '--as-fast-as-followed', '--window', 10) as tool:
            # The window opens for the last ten only when every answer has arrived.
            peer.wait_for(lambda: len(peer.heard['/wrench']) == 160)
            tool.interrupt()
            assert tool.wait() == 130, tool.output
    assert tool.said('stopped after') and tool.said('answered 150 of')


def test_a_damaged_bag_plays_as_far_as_it_goes(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 400, rate_hz=1000)
    bag.write_bytes(bag.read_bytes()[:bag.stat().st_size // 2])
    with open_bag(bag) as damaged:
        left = sum(1 for _ in damaged.messages(['/wrench'], decode=False))
    with Peer() as peer:
        peer.listen('/wrench', WRENCH)
        tool = replayed(tmp_path, bag, '--wait-for-subscribers', '--wait-for-all-acked', PATIENCE_S,
                        '--json', tmp_path / 'a.json')
        peer.wait_for(lambda: len(peer.heard['/wrench']) >= left)
    assert 0 < left < 400 and len(peer.heard['/wrench']) == left
    assert tool.said('is damaged') and 'is damaged' in json.loads((tmp_path / 'a.json').read_text())['losses'][0]


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (['--as-fast-as-followed', '--wait-timeout', 0.3], 'nobody publishes /estimator/residual after 0.3 s'),
    (['--wait-for-subscribers', 2, '--wait-timeout', 0.3], '0 of 2 subscribing nodes are connected after 0.3 s'),
    (['--ros-args', '-p', 'rate:=fast'], "'rate'"),
])
def test_mistakes_are_one_sentence(tmp_path, arguments, sentence):
    bag = write_robot(tmp_path / 'a.mcap', 3)
    tool = replayed(tmp_path, bag, *arguments, code=2)
    assert tool.said(sentence) and 'Traceback' not in tool.output and tool.output.count('\n') == 1


@pytest.mark.parametrize(('arguments', 'sentence'), [(['--topics', '/wrnch'], 'has no topic /wrnch'),
                                                     (['--rate', 0.0], 'rate must be a finite number above 0'),
                                                     (['--remap', '/wrench:=/a', '/wrench:=/b'],
                                                      '--remap names /wrench with /a and with /b; expected one'),
                                                     (['--follow', '/a/b=/wrench', '/a/b'],
                                                      '--follow names /a/b with /wrench and with none; expected one'),
                                                     (['--window', 3], '--window is for followers; expected --follow'),
                                                     (['--answer-timeout', 3], '--answer-timeout is for followers'),
                                                     (['--follow', '/a/b=/wrnch'],
                                                      '/a/b cannot answer /wrnch, which is not played: expected one')])
def test_a_senseless_playback_is_refused(tmp_path, capsys, arguments, sentence):
    assert sentence in refusal(capsys, 'replay', write_robot(tmp_path / 'a.mcap', 3), *arguments)


def test_a_bag_is_not_played_twice_at_once(tmp_path, capsys):
    """Each message came twice."""
    bag = write_robot(tmp_path / 'a.mcap', 3)
    assert 'is named twice; expected another recording' in refusal(capsys, 'replay', bag, bag)


def read_until(terminal, text, seen=b''):
    """What a terminal shows until ``text`` appears."""
    deadline = time.monotonic() + PATIENCE_S
    while text not in seen:
        assert time.monotonic() < deadline, seen.decode(errors='replace')
        if select.select([terminal], [], [], 0.2)[0]:
            seen += os.read(terminal, 4096)
    return seen


def test_keys_on_a_real_terminal(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 3000)
    with Peer() as peer:
        peer.listen('/wrench', WRENCH)
        child, terminal = pty.fork()
        if child == 0:
            os.environ.update(TERM='xterm', COLUMNS='120')
            os.execv(sys.executable, [sys.executable, '-m', 'semiparam_ros.cli.main', 'replay', str(bag),
                                      '--start-paused', '--topics', '/wrench', '--wait-for-subscribers'])
        try:
            read_until(terminal, b'paused')
            os.write(terminal, b'\x1b[C\x1b[C\x1b[C')
            read_until(terminal, b'3 messages')
            peer.wait_for(lambda: len(peer.heard['/wrench']) >= 3)
            assert len(peer.heard['/wrench']) == 3
            os.write(terminal, b'\x1b[A\x1b[A ')
            read_until(terminal, b'1.21 x')
            peer.wait_for(lambda: len(peer.heard['/wrench']) > 20)
            os.write(terminal, b'\x03')
            read_until(terminal, b'stopped after')
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        finally:
            os.close(terminal)


def test_the_program_of_its_own_name_takes_ros_arguments(tmp_path):
    bag = write_robot(tmp_path / 'a.mcap', 50)
    with Peer() as peer:
        peer.listen('/arm/wrench', WRENCH, EVERYTHING)
        replayed(tmp_path, bag, '--wait-for-subscribers', '--ros-args', '-r',
                 '/wrench:=/arm/wrench', '-p', 'rate:=5.0')
        peer.wait_for(lambda: len(peer.heard['/arm/wrench']) >= 50)
    assert len(peer.heard['/arm/wrench']) == 50



def topics_played(topics, **options):
    """Names and reasons of what a playback plays of a bag with topics of these types, and what it does not."""
    session = ReplaySession(ReplayOptions((Path('a.mcap'),), **options), Console(quiet=True), [])
    played, skipped = session._topics(SimpleNamespace(topics=topics))
    return [topic.name for topic in played.values()], list(skipped.values())


def test_what_a_follower_publishes_is_played_under_another_name():
    topics = {topic: TopicInfo(WRENCH, 1, Qos()) for topic in ('/wrench', '/estimator/residual')}
    options = {'follow': FollowOptions({'/estimator/residual': None}), 'rate': None}
    assert topics_played(topics, **options)[0] == ['/wrench']
    names = topics_played(topics, **options, remap={'/estimator/residual': '/before/residual'})[0]
    assert names == ['/wrench', '/before/residual']


def test_inputs_in_the_namespace_of_the_answers_are_played():
    """They were left out as the follower's own, and nothing was left to play."""
    topics = {f'/left/{name}': TopicInfo(WRENCH, 1, Qos()) for name in ('wrench', 'other', 'answer')}
    follow = FollowOptions({'/left/answer': '/left/wrench'})
    assert topics_played(topics, follow=follow, rate=None) == (
        ['/left/wrench', '/left/other'], ['/left/answer is not played: the follower publishes there.'])


def test_inputs_that_are_taken_for_the_followers_own_are_told_as_such():
    """It was said that the follower publishes there, and that nobody answers."""
    topics = {topic: TopicInfo(WRENCH, 1, Qos()) for topic in ('/left/wrench', '/wrench')}
    assert topics_played(topics, follow=FollowOptions({'/left/answer': None}), rate=None) == (
        ['/wrench'], ['/left/wrench is not played: it is beside /left/answer, where the follower publishes; if it is '
                      'an input, --follow /left/answer=PLAYED tells so.'])


def test_names_that_the_bag_does_not_have_are_said(tmp_path):
    """The topics that were meant were played as the bag recorded them, or were not left out."""
    overrides, told = tmp_path / 'qos.yaml', StringIO()
    overrides.write_text('/wrnch: {depth: 5}\n/wrench: {depth: 5}\n')
    options = ReplayOptions((Path('a.mcap'),), qos_overrides=overrides, selection=Selection(exclude=('/other', '/b')))
    session = ReplaySession(options, Console(file=told), [])
    topics = {name: TopicInfo(WRENCH, 1, Qos()) for name in ('/wrench', '/b')}
    played, _ = session._topics(SimpleNamespace(topics=topics))
    assert [topic.qos.depth for topic in played.values()] == [5]
    assert told.getvalue() == (f'--exclude names /other, which the bag does not have.\n{overrides} names /wrnch, which '
                               'the bag does not have.\n')


def test_topics_of_two_types_are_not_played_on_one():
    """The bytes of the one were published as the other's."""
    topics = {'/a': TopicInfo(WRENCH, 1, Qos()), '/b': TopicInfo(STATES, 1, Qos()), '/c': TopicInfo(WRENCH, 1, Qos())}
    with pytest.raises(SemiparamError, match='both cannot be played on /x'):
        topics_played(topics, remap={'/a': '/x', '/b': '/x'})
    assert topics_played(topics, remap={'/a': '/x', '/c': '/x'})[0] == ['/x', '/b', '/x']


def test_messages_of_another_encoding_are_not_published():
    topics = {'/a': TopicInfo(WRENCH, 1, Qos()), '/b': TopicInfo(STATES, 1, Qos(), encoding='json')}
    assert topics_played(topics) == (['/a'], ["/b is not played: its messages are encoded as 'json'; expected cdr, as "
                                              'ROS 2 records them.'])


@pytest.mark.parametrize('clock', [{'clock_hz': 40.0}, {'clock_before_each': True}, {}])
def test_there_is_one_clock(clock):
    """That of the bag came between the times of the playback."""
    topics = {'/a': TopicInfo(WRENCH, 1, Qos()), '/clock': TopicInfo('rosgraph_msgs/msg/Clock', 1, Qos())}
    assert topics_played(topics, **clock)[0] == (['/a'] if clock else ['/a', '/clock'])


def test_answers_that_the_playback_publishes_itself_are_refused():
    """Those in the bag counted as the follower's, which said nothing: 200 of 200 answered."""
    node = SimpleNamespace(resolve_topic_name='/{}'.format, outputs={'/a': SimpleNamespace(topic_name='/a')})
    with pytest.raises(SemiparamError, match='/a is played itself'):
        Follower(node, 'a', None, FollowOptions({'a': None}), 1.0, None, None)


@pytest.mark.parametrize('value', [nan, inf])
def test_a_time_that_is_none_is_no_place_to_go_to(value):
    """The call had no answer, and the playback broke off."""
    controls = ReplayControls.__new__(ReplayControls)
    controls._start_ns = START
    controls._player = Player(SimpleNamespace(start_ns=START, end_ns=START + SECOND), None)
    assert not controls._validate([RosParameter('seek_to', value=value)]).successful


def test_a_held_playback_goes_back_to_its_start_before_the_first_message():
    """It began where it had been sent before."""
    player = Player(SimpleNamespace(start_ns=START, end_ns=START + 9 * SECOND), None, paused=True)
    controls = ReplayControls(MagicMock(), player, START)
    controls._apply([RosParameter('seek_to', value=5.0)])
    assert player._target == START + 5 * SECOND
    controls._apply([RosParameter('seek_to', value=0.0)])
    assert player._target == START


def test_topics_by_names_that_ros_does_not_have_are_left_out_or_refused():
    """One of a stranger's bag ended the playback by an internal error."""
    topics = {topic: TopicInfo(WRENCH, 1, Qos()) for topic in ('/a', '/force-torque', '/a//b')}
    names, skipped = topics_played(topics)
    assert names == ['/a'] and len(skipped) == 2 and skipped[1].endswith("topic name must not contain repeated '/'.")
    assert topics_played(topics, remap={'/force-torque': '/force_torque'})[0] == ['/a', '/force_torque']
    for options in ({'remap': {'/a': '/a-b'}}, {'follow': FollowOptions({'/a-b': None})}):
        with pytest.raises(SemiparamError, match="'/a-b' is no name of a topic: topic name must not contain char"):
            topics_played(topics, **options)
