"""The node of a recording: one raw subscription for each topic, every message written as it came."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from functools import partial

from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.subscription import Subscription

from semiparam_ros.bags.qos import Qos, agreed
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.ros.answering import AnsweringNode
from semiparam_ros.ros.cdr import begins_with_header
from semiparam_ros.ros.context import REPLACEABLE
from semiparam_ros.ros.message_types import message_class
from semiparam_ros.ros.record import topics
from semiparam_ros.ros.record.options import Limits

NAME = 'bag_record'
# They come at their own pace for ever and tell nothing about whether the robot's data still flows.
STEADY = ('/diagnostics', '/diagnostics_agg', '/clock', *topics.HOUSEKEEPING)


class RecordNode(AnsweringNode):
    """Receives in the executor's thread, as fast as it comes, and writes where :meth:`write_arrived` is called.

    Writing takes longer than receiving, and a publisher's queue is short: so nothing is lost in a burst.
    """

    def __init__(self, writer: BagWriter, limits: Limits) -> None:
        super().__init__(NAME)
        self._writer = writer
        self._limits = limits
        if limits.count_topic is not None:
            self._limits = replace(limits, count_topic=self.resolve_topic_name(limits.count_topic))
        self._sim_time = bool(self.get_parameter('use_sim_time').value)
        self._arrived: deque[tuple[str, bytes, int]] = deque()
        self._inputs: dict[str, Subscription] = {}
        self.topics: dict[str, str] = {}
        """Topic -> type of every subscription."""
        # A robot description may come long before the data that is waited for.
        self._latched: set[str] = set()
        self._stamps: dict[str, bytes] = {}
        self.counts: dict[str, int] = {}
        self.last_message = 0.0
        self.complete = False
        self.went_back = False
        """Whether the time of reception ever went back, as a simulated one does where a recording starts again."""
        self._newest = 0

    @property
    def counted(self) -> str | None:
        """The topic whose messages end the recording."""
        return self._limits.count_topic

    @property
    def messages(self) -> int:
        """Messages written."""
        return sum(self.counts.values())

    def follow(self, topic: str, type_name: str) -> None:
        """Subscribe, or subscribe anew where a publisher has come that the subscription does not match."""
        known = self._inputs.get(topic)
        if known is not None:
            if topics.receives_all(known.qos_profile, self._offers(topic)):
                return
            self._take(topic, known)
            self.destroy_subscription(known)
        self.topics[topic] = type_name
        self.counts.setdefault(topic, 0)
        profile = topics.best_qos(self, topic, type_name)
        if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            self._latched.add(topic)
        self._inputs[topic] = self.create_subscription(
            message_class(type_name), topic, partial(self._receive, topic), profile, raw=True,
            event_callbacks=REPLACEABLE)

    def now(self) -> int:
        """The time of reception [ns], or the simulated one: 0 until that has come."""
        # The events executor cannot hand on when a message was published.
        return int(self.get_clock().now().nanoseconds) if self._sim_time else time.time_ns()

    def connected(self) -> bool:
        """Tell whether every subscription has found the publishers that the graph knows."""
        return all(subscription.get_publisher_count() >= len(self._offers(topic))
                   for topic, subscription in self._inputs.items())

    def _offers(self, topic: str) -> list[Qos]:
        return topics.offers(self, topic, self.topics[topic])

    def _receive(self, topic: str, raw: bytes) -> None:
        stamp = self.now()
        self.went_back |= stamp < self._newest
        self._newest = stamp
        self._arrived.append((topic, raw, stamp))
        if self._is_news(topic, raw):
            self.last_message = time.monotonic()

    def _is_news(self, topic: str, raw: bytes) -> bool:
        """Tell whether the robot's data still flows: what has the stamp of the message before again is sent by a node
        that hears nothing new, as `~/payload` each second."""
        if topic in STEADY or topic in self._latched:
            return False
        stamp = raw[4:12] if begins_with_header(self.topics[topic]) else b''
        before, self._stamps[topic] = self._stamps.get(topic), stamp
        return stamp != before or not any(stamp)

    def repeated(self) -> set[str]:
        """Topics with a reliable publisher, who sends again what did not arrive."""
        return {topic for topic, subscription in self._inputs.items()
                if subscription.qos_profile.reliability == ReliabilityPolicy.RELIABLE and self.count_publishers(topic)}

    def take_late(self) -> list[tuple[str, int]]:
        """Take what has arrived since the executor stopped: topic, and when each message was published [ns]."""
        return [(topic, published) for topic, subscription in self._inputs.items()
                for published in self._take(topic, subscription)]

    def _take(self, topic: str, subscription: Subscription) -> list[int]:
        """Take what waits at a subscription; when each message was published [ns]."""
        published = []
        with subscription.handle:
            while (message := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                raw, info = message
                self._receive(topic, raw)
                published.append(int(info['source_timestamp']))
        return published

    def write_arrived(self) -> None:
        """Write what has arrived so far, before the simulated time as of its beginning; raises SemiparamError when the
        disk refuses it."""
        later, dated = 0, list[tuple[str, bytes, int]]()  # taken out first: others arrive meanwhile
        for topic, raw, stamp in reversed([self._arrived.popleft() for _ in range(len(self._arrived))]):
            later = stamp or later
            dated.append((topic, raw, later or self.now()))
        for message in reversed(dated):
            if self.complete:
                return
            self._write(*message)

    def _write(self, topic: str, raw: bytes, stamp: int) -> None:
        if not self.counts[topic]:
            offers = self._offers(topic)
            self._writer.add_topic(topic, self.topics[topic], agreed(offers) if offers else None)
        self._writer.write_raw(topic, raw, stamp)
        self.counts[topic] += 1
        self.complete = self._is_full(topic)

    def _is_full(self, topic: str) -> bool:
        limits = self._limits
        if limits.count is None:
            return False
        if limits.count_topic is None:
            return self.messages >= limits.count
        return topic == limits.count_topic and self.counts[topic] >= limits.count
