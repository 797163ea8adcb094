"""The topics that the node listens to, from messages to samples."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from semiparam_ros.bags import readings
from semiparam_ros.bags.alignment import CAPACITY, SampleStream
from semiparam_ros.bags.loading import measured_accelerations, sample_stream
from semiparam_ros.bags.readings import Kind, Reading
from semiparam_ros.core.robot.urdf import MOST_CHARACTERS
from semiparam_ros.core.samples import Sample
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.worker import Scheduler
from semiparam_ros.ros.cdr import MOST_BYTES, Layout, Reader, joint_state_layout_of, wrench_layout
from semiparam_ros.ros.context import REPLACEABLE
from semiparam_ros.ros.discovery import is_named, owner
from semiparam_ros.settings.snapshot import Settings

NEEDED = 5
TURN_S = 0.002
"""How long messages that wait are worked on before anything else has its turn."""
UNNAMED_LOOKS = 5
"""A publisher whose name is not discovered yet gets so many looks to tell it."""
MOST_WAITING = 20_000
"""Messages of a topic that may wait where ``queue_depth`` keeps all: a recording of minutes played at once."""

ROBOT_DESCRIPTION = 'robot_description'
JOINT_STATES, WRENCH, ACCELERATIONS = 'joint_states', 'wrench', 'joint_accelerations'
TEMPERATURE = 'temperature'


class Stopwatch:
    """Between the arrival of the message that completes a sample and the publishing of its answer."""

    SIZE = 1000

    def __init__(self) -> None:
        self._spans: deque[float] = deque(maxlen=self.SIZE)
        self._start = 0.0

    def start(self, arrived: float) -> None:
        """A message is worked on that came in at a time of ``perf_counter``."""
        self._start = arrived

    def stop(self) -> None:
        """An answer has gone out."""
        self._spans.append(time.perf_counter() - self._start)

    def quantiles_ms(self) -> tuple[float, float, float] | None:
        """(median, p99, maximum) in ms, None before the first answer."""
        if not self._spans:
            return None
        median, late, last = np.quantile(self._spans, (0.5, 0.99, 1.0)) * 1e3
        return float(median), float(late), float(last)


class Waiting(NamedTuple):
    """A message that nobody has looked at yet, and when it came by ``perf_counter``."""

    topic: str
    reading: Reading | bytes
    arrived: float


class MessageTurns:
    """Messages in the order in which they came, worked on a few at a time.

    Between two turns the executor serves what has come meanwhile: services, reports, the end. Where it worked on each
    message as it came, all of these would wait behind all messages, for ever where those come faster than they are
    answered.

    :param schedule: see :data:`~semiparam_ros.online.worker.Scheduler`. :param work: must not raise.
    :param most: messages of a topic that may wait; the oldest are lost to newer ones.
    """

    def __init__(self, schedule: Scheduler, work: Callable[[Waiting], None], most: int) -> None:
        self._schedule, self._work, self._most = schedule, work, most
        self._kept: deque[tuple[str, Reading]] = deque()
        self._waiting: deque[Waiting] = deque()
        self._counts: Counter[str] = Counter()
        self._given_up: Counter[str] = Counter()
        self._asked = False
        self.lost = 0

    def __len__(self) -> int:
        return len(self._kept) + self._counts.total()

    @property
    def late_s(self) -> float:
        """Time that the oldest has waited [s]."""
        return time.perf_counter() - self._waiting[0].arrived if self._waiting else 0.0

    def add(self, topic: str, reading: Reading | bytes) -> None:
        """One has come, as its bytes where these are yet to be read: that takes its time of a turn too."""
        self._waiting.append(Waiting(topic, reading, time.perf_counter()))
        self._counts[topic] += 1
        if self._counts[topic] > self._most:
            self._counts[topic] -= 1
            self._given_up[topic] += 1
            self.lost += 1
            self._drop()
        self._ask()

    def add_before_all(self, kept: Iterable[tuple[str, Reading]]) -> None:
        """Messages and their topics that came before those that wait, and could not be worked on yet."""
        self._kept.extend(kept)
        self._ask()

    def _ask(self) -> None:
        if not self._asked and len(self):
            self._asked = True
            self._schedule(self._take_turn)

    def _drop(self) -> None:
        """Drop those given up, which are the oldest of their topics, as far as they are in
        front."""
        while self._waiting and self._given_up[self._waiting[0].topic]:
            self._given_up[self._waiting.popleft().topic] -= 1

    def _take_turn(self) -> None:
        end = time.perf_counter() + TURN_S
        while self._kept or self._waiting:
            if self._kept:
                self._work(Waiting(*self._kept.popleft(), time.perf_counter()))
            else:
                message = self._waiting.popleft()
                self._counts[message.topic] -= 1
                self._work(message)
                self._drop()
            if time.perf_counter() > end:
                break
        self._asked = False
        self._ask()


class ClockWatch:
    """Holds back refused messages until ``NEEDED`` of one topic in a row agree with each other."""

    def __init__(self) -> None:
        self._held: list[tuple[str, Reading]] = []
        """Topics and messages that came with a stamp before the last one."""

    def accepted(self, topic: str) -> None:
        """The topic goes on as before: its messages that went back were wrong."""
        if self._held:
            self._held = [(other, held) for other, held in self._held if other != topic]

    def refused(self, topic: str, reading: Reading) -> list[tuple[str, Reading]]:
        """A message went back in time; once the clock must have jumped, all that were held, in order of arrival."""
        own = [held for other, held in self._held if other == topic]
        if own and reading.stamp <= own[-1].stamp:
            self.accepted(topic)
            own = []
        self._held.append((topic, reading))
        if len(own) + 1 < NEEDED:
            return []
        jumped, self._held = self._held, []
        return jumped


class Feed(NamedTuple):
    """Type of a topic's messages, what a stream does with one, and how it is laid out in bytes (None: looked up)."""

    message_class: type
    kind: Kind
    layout: Callable[[Reading], Layout] | None


FEEDS = {JOINT_STATES: Feed(JointState, readings.JOINT_STATE, joint_state_layout_of),
         WRENCH: Feed(WrenchStamped, readings.WRENCH, lambda reading: wrench_layout(reading.frame_id)),
         ACCELERATIONS: Feed(JointTrajectory, readings.ACCELERATIONS, None),
         TEMPERATURE: Feed(Temperature, readings.TEMPERATURE, None)}


class InputsListener(Protocol):
    """Receives what comes in on the topics."""

    def sample_completed(self, sample: Sample) -> None:
        """The next sample, in order of time."""

    def frame_changed(self, frame_id: str) -> None:
        """The frame of the measured outputs."""

    def described(self, urdf: str) -> None:
        """A robot description."""

    def clock_jumped(self) -> None:
        """Take note that what waited for its counterpart is dropped."""

    def message_failed(self, topic: str, error: Exception) -> None:
        """A message was refused, or could not be handled."""


class InputStream:
    """Subscriptions, and the stream they feed once the robot's joints are known; until then messages are kept.

    :param schedule: see :data:`~semiparam_ros.online.worker.Scheduler`.
    """

    def __init__(self, node: Node, settings: Settings, listener: InputsListener, schedule: Scheduler) -> None:
        self._node, self._settings, self._listener = node, settings, listener
        self.turns = MessageTurns(schedule, self._take, settings.queue_depth or MOST_WAITING)
        self.counts: Counter[str] = Counter()
        self.stopwatch = Stopwatch()
        self.arrived: dict[str, float] = {}
        self.temperatures: dict[str, float] = dict.fromkeys(settings.temperatures, time.monotonic())
        """When the last temperature of each came, or from when on it is waited for."""
        self.has_efforts = False
        """Whether the latest joint state held efforts."""
        self.stream: SampleStream | None = None
        self.best_effort: set[str] = set()
        self._unheard: set[str] = set()
        self._seen_owners: dict[str, tuple[list[str], int]] = {}
        self._owners: dict[str, list[str]] = {}
        self._joints: tuple[str, ...] | None = None
        self._early: list[tuple[str, Reading]] = []
        self._watch = ClockWatch()
        self._frame_topic = WRENCH if settings.outputs == 'wrench' else JOINT_STATES
        self.topics = [JOINT_STATES, *([WRENCH] if settings.outputs == 'wrench' else []),
                       *([ACCELERATIONS] if settings.acceleration_source != 'filter' else []),
                       *([TEMPERATURE] if settings.temperatures else [])]
        self._readers = {topic: Reader(feed.message_class, feed.kind.read, feed.layout)
                         for topic, feed in FEEDS.items()}
        self._subscriptions = {topic: self._subscribe(topic, self._profile()) for topic in self.topics}
        self._oversized = 0
        self._descriptions = [self._listen_to_description(durability) for durability in (
            QoSDurabilityPolicy.TRANSIENT_LOCAL, QoSDurabilityPolicy.VOLATILE)]

    @property
    def needed(self) -> list[str]:
        """Topics without which there are no samples; measured accelerations only where the samples wait for them."""
        waits = self._settings.acceleration_source == 'measured' or (
            self.stream is not None and self.stream.takes_accelerations)
        return [topic for topic in self.topics if topic != TEMPERATURE and (topic != ACCELERATIONS or waits)]

    def open(self, joints: tuple[str, ...]) -> None:
        """The joints are known: messages that came before are handed on first, in turns as all others."""
        self._joints = joints
        early, self._early = self._early, []
        self.turns.add_before_all(early)

    def publishers(self, topic: str) -> int:
        """Number of publishers of a topic that are heard."""
        return int(self._subscriptions[topic].get_publisher_count())

    def follow_reliability(self) -> list[str]:
        """Topics that only best_effort publishers serve, which a reliable subscription does not hear: asked anew."""
        silent = [topic for topic, offers in self._unheard_offers() if not self.publishers(topic) and all(offers)]
        for topic in silent:
            profile = self._subscriptions[topic].qos_profile  # what the parameters have overridden is not to be lost
            profile.reliability = QoSReliabilityPolicy.BEST_EFFORT
            self._node.destroy_subscription(self._subscriptions[topic])
            self._subscriptions[topic] = self._subscribe(topic, profile)
        return silent

    def newly_unheard(self) -> list[str]:
        """Topics that a best_effort publisher serves beside reliable ones, who alone are heard; each once."""
        topics = [topic for topic, offers in self._unheard_offers()
                  if topic not in self._unheard and any(offers) and not all(offers)]
        self._unheard.update(topics)
        return topics

    def newly_shared(self) -> list[tuple[str, list[str]]]:
        """Topics on which several publish, but temperatures, and the nodes that do; the same ones once.

        They are told once two looks in a row find the same; one whose name is not known yet has ``UNNAMED_LOOKS``.
        """
        shared = []
        for topic in self.topics:
            if topic != TEMPERATURE and self.publishers(topic) > 1:
                name = self._node.resolve_topic_name(topic)
                found = self._node.get_publishers_info_by_topic(name)
                owners = sorted(map(owner, found))
                seen, looks = self._seen_owners.get(topic, ([], 0))
                looks = looks + 1 if seen == owners else 0
                if owners != self._owners.get(topic) and looks >= (1 if all(map(is_named, found)) else UNNAMED_LOOKS):
                    self._owners[topic] = owners
                    shared.append((topic, owners))
                self._seen_owners[topic] = owners, looks
        return shared

    def _unheard_offers(self) -> Iterator[tuple[str, list[bool]]]:
        """Return whether each publisher offers best_effort, of topics that may be asked anew."""
        if self._settings.reliability != 'auto':
            return
        for topic in self.topics:
            if topic not in self.best_effort:
                name = self._node.resolve_topic_name(topic)
                offers = [info.qos_profile.reliability == QoSReliabilityPolicy.BEST_EFFORT
                          for info in self._node.get_publishers_info_by_topic(name)]
                if offers:
                    yield topic, offers

    def _profile(self) -> QoSProfile:
        depth, best_effort = self._settings.queue_depth, self._settings.reliability == 'best_effort'
        return QoSProfile(
            history=QoSHistoryPolicy.KEEP_LAST if depth else QoSHistoryPolicy.KEEP_ALL, depth=depth,
            reliability=QoSReliabilityPolicy.BEST_EFFORT if best_effort else QoSReliabilityPolicy.RELIABLE)

    def _subscribe(self, topic: str, profile: QoSProfile) -> Subscription:
        best_effort = profile.reliability == QoSReliabilityPolicy.BEST_EFFORT
        replaceable = self._settings.reliability == 'auto'
        if best_effort:
            self.best_effort.add(topic)
        return self._node.create_subscription(
            FEEDS[topic].message_class, topic, partial(self._came, topic), profile, raw=True,
            event_callbacks=REPLACEABLE if replaceable else None,
            qos_overriding_options=None if replaceable and best_effort
            else QoSOverridingOptions.with_default_policies())

    def _listen_to_description(self, durability: QoSDurabilityPolicy) -> Subscription:
        """Latched, as robot_state_publisher offers it; and plain, as a tool may play it."""
        def receive(raw: bytes) -> None:
            try:
                self._describe(raw)
            except Exception as error:
                self._listener.message_failed(ROBOT_DESCRIPTION, error)

        return self._node.create_subscription(String, ROBOT_DESCRIPTION, receive,
                                              QoSProfile(depth=1, durability=durability), raw=True)

    def _describe(self, raw: bytes) -> None:
        """Refuse what is too long before it is decoded; once, for both subscriptions hear a latched one."""
        if len(raw) > 4 * MOST_CHARACTERS:
            if len(raw) == self._oversized:
                return
            self._oversized = len(raw)
            raise SemiparamError(f'a robot description of {len(raw)} bytes is too long; expected at most '
                                 f'{MOST_CHARACTERS} characters.')
        try:
            text = deserialize_message(raw, String).data
        except Exception as failure:  # of several kinds, from rmw and from the conversion of texts
            raise SemiparamError(f'a robot description of {len(raw)} bytes cannot be read ({type(failure).__name__}).'
                                 ) from None
        if text:
            self._listener.described(text)

    def _came(self, topic: str, raw: bytes) -> None:
        """Let its bytes wait for their turn, but those that are refused unread."""
        if len(raw) > MOST_BYTES:
            self._take(Waiting(topic, raw, time.perf_counter()))
        else:
            self.turns.add(topic, raw)

    def _take(self, message: Waiting) -> None:
        topic, reading, arrived = message
        try:
            self._receive(topic, reading if isinstance(reading, Reading) else self._readers[topic](reading), arrived)
        except Exception as error:
            self._listener.message_failed(topic, error)

    def _receive(self, topic: str, reading: Reading, arrived: float) -> None:
        self.stopwatch.start(arrived)
        if self.stream is None and not self._can_open(topic):
            self.arrived[topic] = time.monotonic()
            self._keep(topic, reading)
        elif self._feed(topic, reading):
            self.counts[topic] += 1
            self.arrived[topic] = time.monotonic()

    def _keep(self, topic: str, reading: Reading) -> None:
        self._early.append((topic, reading))
        if len(self._early) > CAPACITY:
            del self._early[0]
            self.counts['given up'] += 1

    def _can_open(self, topic: str) -> bool:
        """Open the stream with the first joint state: whoever measures accelerations publishes them by then."""
        if self._joints is None or topic != JOINT_STATES:
            return False
        published = ACCELERATIONS in self.topics and (
            self.publishers(ACCELERATIONS) > 0 or any(early == ACCELERATIONS for early, _ in self._early))
        self.stream = sample_stream(self._settings, self._joints, measured_accelerations(self._settings, published),
                                    CAPACITY)
        early, self._early = self._early, []
        for kept, reading in early:
            self._receive(kept, reading, time.perf_counter())
        return True

    def _feed(self, topic: str, reading: Reading) -> bool:
        """False for a message of other joints than ours, which is no sign of life of the robot."""
        stream = self.stream
        assert stream is not None
        ignored, accepted, backward = stream.ignored, stream.accepted, stream.faults['backward_stamp']
        if topic == JOINT_STATES:
            stream.shared = self.publishers(JOINT_STATES) > 1
        samples = FEEDS[topic].kind.feed(stream, reading.stamp, *reading.fields)
        if stream.faults['backward_stamp'] > backward:
            if topic != TEMPERATURE:  # of many publishers: what one of them says of the time is not the robot's clock
                self._went_back(topic, reading)
            return True
        if stream.ignored > ignored:
            return False
        if stream.accepted > accepted:  # what is refused tells nothing of the robot, nor of its clock
            self._accepted(topic, reading)
        for sample in samples:
            self._listener.sample_completed(sample)
        return True

    def _accepted(self, topic: str, reading: Reading) -> None:
        self._watch.accepted(topic)
        if topic == TEMPERATURE:
            self.temperatures[reading.frame_id.lstrip('/')] = time.monotonic()
        if topic == JOINT_STATES:
            self.has_efforts = len(reading.fields[-1]) > 0
        if topic == self._frame_topic:
            self._listener.frame_changed(reading.frame_id)

    def _went_back(self, topic: str, reading: Reading) -> None:
        held = self._watch.refused(topic, reading)
        if not held:
            return
        assert self.stream is not None
        self.stream.reset()
        self._listener.clock_jumped()
        self.stream.faults['backward_stamp'] -= len(held)
        for again in held:
            self._feed(*again)
