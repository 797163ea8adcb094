"""The node of a recording: one raw subscription for each topic, every message written as it came."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from functools import partial

from rclpy.node import Node
from rclpy.subscription import Subscription

from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.ros import record_topics
from semiparam_ros.ros.record_options import Limits
from semiparam_ros.ros.replay_types import message_class

NAME = 'bag_record'
# They come at their own pace for ever and tell nothing about whether the robot's data still flows.
STEADY = ('/diagnostics', '/diagnostics_agg', '/clock', *record_topics.HOUSEKEEPING)


class RecordNode(Node):
    """Writes what it receives until :attr:`complete`; thread-safe towards the thread that ends the recording."""

    def __init__(self, writer: BagWriter, limits: Limits) -> None:
        super().__init__(NAME)
        self._writer = writer
        self._limits = limits
        self._lock = threading.Lock()
        self._inputs: dict[str, Subscription] = {}
        self._types: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        self.last_message = 0.0
        self.complete = False

    @property
    def topics(self) -> Mapping[str, str]:
        """Topic -> type of every subscription."""
        return self._types

    @property
    def messages(self) -> int:
        """Messages written."""
        return sum(self.counts.values())

    def follow(self, topic: str, type_name: str) -> None:
        """Subscribe, or subscribe anew where a publisher has come that the subscription does not match."""
        known = self._inputs.get(topic)
        if known is not None:
            if record_topics.receives_all(known.qos_profile, record_topics.offers(self, topic)):
                return
            self.destroy_subscription(known)
        self._types[topic] = type_name
        self.counts.setdefault(topic, 0)
        self._inputs[topic] = self.create_subscription(message_class(type_name), topic, partial(self._receive, topic),
                                                       record_topics.best_qos(self, topic), raw=True)

    def connected(self) -> bool:
        """Whether every subscription has found the publishers that the graph knows."""
        return all(subscription.get_publisher_count() >= self.count_publishers(topic)
                   for topic, subscription in self._inputs.items())

    def _receive(self, topic: str, raw: bytes) -> None:
        # The time of reception, or the simulated time: the events executor cannot hand on when it was published.
        stamp = self.get_clock().now().nanoseconds
        with self._lock:
            if self.complete:
                return
            if not self.counts[topic]:
                offers = record_topics.offers(self, topic)
                self._writer.add_topic(topic, self._types[topic], offers[0] if offers else None)
            self._writer.write_raw(topic, raw, stamp)
            self.counts[topic] += 1
            self.complete = self._is_full(topic)
        if topic not in STEADY:
            self.last_message = time.monotonic()

    def _is_full(self, topic: str) -> bool:
        limits = self._limits
        if limits.count is None:
            return False
        if limits.count_topic is None:
            return self.messages >= limits.count
        return topic == limits.count_topic and self.counts[topic] >= limits.count

    def flush(self) -> None:
        """Put everything so far on the disk."""
        with self._lock:
            self._writer.flush()

    def finish(self) -> None:
        """Write nothing more and close the bag."""
        with self._lock:
            self.complete = True
            self._writer.close()
