"""One playback from the opening of its bags to its account: binds the player, the node and the terminal together."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from rich.console import Console

from semiparam_ros.bags.base import BagReader, Losses, TopicInfo
from semiparam_ros.bags.reader import MergedBag, open_bag
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.flow_control import Followers, FollowerSilent
from semiparam_ros.playback.keyboard import HELP, RATE_HELP, Keyboard
from semiparam_ros.playback.options import ReplayOptions
from semiparam_ros.playback.player import Ending, Player
from semiparam_ros.playback.progress import ReplayProgress
from semiparam_ros.playback.read_ahead import ReadAhead
from semiparam_ros.playback.report import ReplayAccount
from semiparam_ros.playback.timeline import BagTimeline, PlayedTopic
from semiparam_ros.ros.context import DELIVER_S, RosProcess, call_in_executor
from semiparam_ros.ros.discovery import Stopped, handshake, name_fault, require_topic_names, wait_until
from semiparam_ros.ros.message_types import is_installed
from semiparam_ros.ros.recorded_qos import load_overrides, lossless, overridden
from semiparam_ros.ros.replay.controls import ReplayControls
from semiparam_ros.ros.replay.follower import Follower
from semiparam_ros.ros.replay.node import ReplayNode
from semiparam_ros.ros.replay.subscribers import subscribers, wait_for_subscribers, warnings

ACKNOWLEDGE_S = 10.0
# Python's threads take turns of 5 ms by default: a message would be so late while another thread reads ahead.
SWITCH_S = 2e-4


class ReplaySession:
    """Plays what the options name. Use :meth:`run` once.

    :param ros_arguments: what followed ``--ros-args`` on the command line
    """

    def __init__(self, options: ReplayOptions, console: Console, ros_arguments: Sequence[str]) -> None:
        self._options = options
        self._console = console
        self._ros_arguments = ros_arguments
        self._stopping = threading.Event()
        self._failures: list[str] = []
        self._followers: list[Follower] = []
        self._player: Player | None = None
        self._duration = 0.0

    def run(self) -> ReplayAccount:
        """Play; raises SemiparamError for what is wrong before the first message."""
        with ExitStack() as stack:
            bag = stack.enter_context(_open(self._options.bags))
            topics, skipped = self._topics(bag)
            timeline = BagTimeline(bag, topics, self._options.order, self._options.cut)
            ros = stack.enter_context(RosProcess(self._ros_arguments, self._stop))
            node = self._node(topics)
            ros.spin(node)
            try:
                self._connect(node, timeline)
                ending = self._play(node, timeline)
            except Stopped:
                ending = 'stopped'
            if ros.error is not None:
                self._failures.append(f'a callback failed: {ros.error}')
            answers = {follower.answer_topic: follower.flow for follower in self._followers}
            return ReplayAccount(ending, self._duration, dict(node.counts), answers, tuple(self._failures),
                                 _losses(bag) if ending == 'finished' else (), skipped,
                                 lossless=self._options.follow is not None)

    def _node(self, topics: Mapping[str, PlayedTopic]) -> ReplayNode:
        options = self._options
        return ReplayNode({topic.name: (topic.type, topic.qos) for topic in topics.values()}, self._stopping,
                          restamp=options.restamp, clock_before_each=options.clock_before_each,
                          blocked_s=options.follow.timeout_s if options.follow else 1.0)

    def _stop(self) -> None:
        """Called when a signal came, in a thread of its own."""
        self._stopping.set()
        if self._player is not None:
            self._player.stop()

    def _topics(self, bag: BagReader) -> tuple[dict[str, PlayedTopic], dict[str, str]]:
        """Topics that are played, and the reasons why other chosen ones are not."""
        options = self._options
        _check_remap(options.remap, bag.topics)
        require_topic_names(options.follow.answers if options.follow else ())
        overrides = load_overrides(options.qos_overrides) if options.qos_overrides else {}
        self._say(f'{where} names {topic}, which the bag does not have.' for where, named in (
            ('--exclude', options.selection.exclude), (options.qos_overrides, overrides))
            for topic in named if topic not in bag.topics)
        played, skipped = {}, {}
        for topic in options.selection.of(list(bag.topics)):
            info = bag.topics[topic]
            if reason := self._obstacle(options.remap.get(topic, topic), info):
                skipped[topic] = f'{topic} is not played: {reason}.'
                continue
            qos = lossless(info.qos) if options.follow else info.qos
            if topic in overrides:
                qos = overridden(qos, overrides[topic], f'{options.qos_overrides}, {topic}')
            played[topic] = PlayedTopic(options.remap.get(topic, topic), info.type, qos)
            _require_one_type(played, topic)
        self._say(skipped.values())
        if not played:
            raise SemiparamError('there is nothing to play: no topic of the bag is chosen and installed.')
        _check_answered(options.follow.answers if options.follow else {}, [topic.name for topic in played.values()])
        return played, skipped

    def _obstacle(self, topic: str, info: TopicInfo) -> str:
        """Reason why a topic is not played under this name, '' when it is."""
        if not is_installed(info.type):
            return f'its type {info.type or "(unknown)"} is not installed'
        if fault := name_fault(topic):
            return fault
        if info.encoding != 'cdr':
            return f'its messages are encoded as {info.encoding!r}; expected cdr, as ROS 2 records them'
        if topic == '/clock' and (self._options.clock_hz is not None or self._options.clock_before_each):
            return 'the time of the bag is published there'
        return _published_by_follower(topic, self._options.follow.answers if self._options.follow else {})

    def _connect(self, node: ReplayNode, timeline: BagTimeline) -> None:
        """Find the followers and wait for subscribers."""
        options = self._options
        if options.follow is not None:
            # Before it knows its robot, the estimator has nothing to answer with and offers no answers.
            node.announce(timeline.announcements())
            for answer, request in options.follow.answers.items():
                self._followers.append(Follower(node, answer, request, options.follow, options.wait_s, self._stopping,
                                                self._wake))
            self._say(follower.remark for follower in self._followers if follower.remark)
        count = max(options.wait_for_subscribers, 1 if self._followers else 0)
        if count:
            wait_for_subscribers(node, count, options.wait_s, self._stopping)
            known = {follower.name for follower in self._followers}
            for name in {each.owner for each in subscribers(node)} - known:
                handshake(node, name, self._stopping)
        self._say(warnings(subscribers(node), bool(self._followers)))
        if options.delay_s:
            wait_until(lambda: False, options.delay_s, self._stopping)

    def _wake(self) -> None:
        if self._player is not None:
            self._player.wake()

    def _play(self, node: ReplayNode, timeline: BagTimeline) -> str:
        """Play to the end; 'finished', 'stopped' or 'failed'."""
        options = self._options
        gate = Followers([follower.flow for follower in self._followers])
        sys.setswitchinterval(SWITCH_S)
        player = Player(ReadAhead(timeline), node.publish, rate=options.rate, loop=options.loop, paused=options.paused,
                        gate=gate if self._followers else None)
        self._player = player
        controls = call_in_executor(node, partial(ReplayControls, node, player, timeline.start_ns))
        if options.clock_hz is not None:
            call_in_executor(node, partial(node.start_clock, options.clock_hz, player.now))
        if self._stopping.is_set():
            raise Stopped
        with Keyboard(controls.keys(), options.keyboard) as keyboard:
            if keyboard.active:
                self._say([HELP + (RATE_HELP if player.rate else '')])
            with ReplayProgress(player, timeline.start_ns, timeline.end_ns, self._console, gate.answers,
                                quiet=not options.progress):
                return self._play_out(node, player, gate)

    def _play_out(self, node: ReplayNode, player: Player, gate: Followers) -> str:
        """Run the player and see the last messages off."""
        ending = 'failed'
        began = time.monotonic()
        try:
            if player.run() is Ending.STOPPED:
                raise Stopped
            if self._followers:
                wait_until(gate.settled, float('inf'), self._stopping)
            ending = 'finished'
        except Stopped:
            ending = 'stopped'
        except (FollowerSilent, SemiparamError) as error:
            self._failures.append(str(error))
        self._duration = time.monotonic() - began
        if ending == 'finished':
            self._settle(node)
        for follower in self._followers:
            follower.flow.give_up()
        self._judge(ending)
        return ending

    def _settle(self, node: ReplayNode) -> None:
        """Wait until the last messages have arrived; that some have not is a failure where it was asked for."""
        patience = max(self._options.wait_for_all_acked_s, ACKNOWLEDGE_S if self._followers else 0.0)
        # A follower that has answered has received: only others are asked, for their answer may take 3 s.
        followers = {follower.name for follower in self._followers}
        topics = {each.topic for each in subscribers(node) if each.owner not in followers}
        missed = node.wait_for_all_acked(topics, patience or DELIVER_S)
        if patience:
            self._failures += [f'not every subscriber of {topic} acknowledged everything within {patience:g} s.'
                               for topic in missed]

    def _judge(self, ending: str) -> None:
        """An unanswered request is a failure of a playback that promised to lose none."""
        if ending != 'finished':
            return
        missing = [follower.flow for follower in self._followers if follower.flow.unanswered_stamps]
        self._failures += [f'{len(flow.unanswered_stamps)} of {flow.requests} messages on {flow.request_topic} '
                           'were not answered.' for flow in missing]

    def _say(self, sentences: Iterable[str]) -> None:
        for sentence in sentences:
            self._console.print(sentence, soft_wrap=True)


def _require_one_type(played: Mapping[str, PlayedTopic], topic: str) -> None:
    mine = played[topic]
    others = [other for other, each in played.items() if each.name == mine.name and each.type != mine.type]
    if others:
        raise SemiparamError(f'{topic} holds {mine.type} and {others[0]} {played[others[0]].type}: both cannot be '
                             f'played on {mine.name}.')


def _published_by_follower(topic: str, answers: Mapping[str, str | None]) -> str:
    """Reason to take a topic for the follower's, '' where there is none."""
    if topic in answers:
        return 'the follower publishes there'
    for answer, played in answers.items():
        prefix = answer.rpartition('/')[0] + '/'
        # A namespace that also has what is answered is the robot's, not the follower's own.
        if len(prefix) > 1 and topic.startswith(prefix) and not (played or '').startswith(prefix):
            hint = '' if played else f'; if it is an input, --follow {answer}=PLAYED tells so'
            return f'it is beside {answer}, where the follower publishes{hint}'
    return ''


def _check_answered(answers: Mapping[str, str | None], played: Sequence[str]) -> None:
    """Raise SemiparamError where an answered topic is not played, before a follower is waited for."""
    for answer, request in answers.items():
        if request and request not in played:
            raise SemiparamError(f'{answer} cannot answer {request}, which is not played: expected one of '
                                 f'{", ".join(played)}.')


def _check_remap(remap: Mapping[str, str], found: Mapping[str, object]) -> None:
    unknown = [topic for topic in remap if topic not in found]
    if unknown:
        raise SemiparamError(f'cannot remap {", ".join(unknown)}: the bag has {", ".join(found)}.')
    require_topic_names(remap.values())


def _open(paths: Sequence[Path]) -> BagReader:
    """One bag, or several merged by time."""
    with ExitStack() as opened:
        readers = [opened.enter_context(open_bag(path)) for path in paths]
        opened.pop_all()
    return readers[0] if len(readers) == 1 else MergedBag(', '.join(map(str, paths)), readers)


def _losses(bag: BagReader) -> tuple[str, ...]:
    """One sentence for each damaged file, and for each folder that holds more than it names."""
    readers = getattr(bag, 'readers', None)
    accounts = [bag.losses] if readers is None else [*(each.losses for each in readers),
                                                     Losses(str(bag.path), unlisted=bag.unlisted)]
    return tuple(losses.sentence for losses in accounts if losses)
