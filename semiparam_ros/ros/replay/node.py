"""The node of a playback: its publishers and the clock. It owns the topics, the player owns the time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Mapping

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock as ClockMessage

from semiparam_ros.bags.header_stamp import with_stamp
from semiparam_ros.bags.qos import Qos
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.player import Item
from semiparam_ros.ros.answering import AnsweringNode
from semiparam_ros.ros.cdr import begins_with_header
from semiparam_ros.ros.context import steady_timer
from semiparam_ros.ros.message_types import message_class
from semiparam_ros.ros.recorded_qos import to_rclpy

NAME = 'bag_replay'


class ReplayNode(AnsweringNode):
    """Publishes what the player hands to :meth:`publish`, and lets services and parameters steer the player."""

    def __init__(self, topics: Mapping[str, tuple[str, Qos]], stopping: threading.Event, *,
                 restamp: bool, clock_before_each: bool, blocked_s: float) -> None:
        """Make the node.

        :param topics: topic -> (type, what to offer)
        :param stopping: set when the playback is to stop
        :param restamp: replace header stamps by the present time
        :param clock_before_each: publish the bag time on /clock before every message
        :param blocked_s: how long a subscriber that takes nothing may hold up the playback [s]
        """
        super().__init__(NAME)
        self.offers = {topic: qos for topic, (_, qos) in topics.items()}
        self.types = {topic: type_name for topic, (type_name, _) in topics.items()}
        self.outputs: dict[str, Publisher] = {
            topic: self.create_publisher(message_class(type_name), topic, to_rclpy(qos))
            for topic, (type_name, qos) in topics.items()}
        self.counts = dict.fromkeys(topics, 0)
        self._restamped = {topic for topic in topics if restamp and begins_with_header(self.types[topic])}
        self._clock_before_each = clock_before_each
        self._blocked_s = blocked_s
        self._announced: dict[str, bytes] = {}
        self._stopping = stopping
        self._clock_output: Publisher | None = None
        if clock_before_each:
            self._clock_output = self.create_publisher(ClockMessage, '/clock', 10)

    def announce(self, items: Iterable[Item]) -> None:
        """Publish latched messages ahead of the playback, which then leaves them out once."""
        for item in items:
            self.publish(item)
            self._announced[item.topic] = item.raw

    def publish(self, item: Item) -> None:
        """Send one message, as the bytes that the bag holds unless its header is restamped."""
        if self._announced and self._announced.get(item.topic) == item.raw:
            del self._announced[item.topic]
            return
        if self._clock_before_each:
            self._publish_clock(item.time)
        raw = item.raw
        if item.topic in self._restamped:
            raw = with_stamp(raw, self.get_clock().now().nanoseconds)
        if self._send(item.topic, raw):
            self.counts[item.topic] += 1

    def _send(self, topic: str, raw: bytes) -> bool:
        """Publish, waiting while a subscriber's full queue refuses more (keep-all only); False when it is stopped."""
        deadline = time.monotonic() + self._blocked_s
        while True:
            try:
                self.outputs[topic].publish(raw)
                return True
            except RuntimeError:  # RCLError, which rclpy does not export: the writer has waited for 0.1 s in vain
                if self._stopping.is_set():
                    return False
                if time.monotonic() > deadline:
                    raise SemiparamError(f'{topic} cannot be published: a reliable subscriber has taken nothing for '
                                         f'{self._blocked_s:g} s.') from None

    def start_clock(self, rate_hz: float, bag_time: Callable[[], int]) -> None:
        """Publish the bag time on /clock, ``rate_hz`` times a second of this machine."""
        if self._clock_output is None:
            self._clock_output = self.create_publisher(ClockMessage, '/clock', 10)
        steady_timer(self, 1.0 / rate_hz, lambda: self._publish_clock(bag_time()))

    def _publish_clock(self, bag_time: int) -> None:
        message = ClockMessage()
        message.clock.sec, message.clock.nanosec = divmod(bag_time, NANOSECONDS)
        assert self._clock_output is not None
        self._clock_output.publish(message)

    def wait_for_all_acked(self, topics: Collection[str], timeout_s: float) -> list[str]:
        """Wait until every reliable subscriber has everything; those of ``topics`` where one has not in time."""
        deadline = time.monotonic() + timeout_s
        return [topic for topic, output in self.outputs.items()
                if topic in topics and self.offers[topic].reliability == 'reliable'
                and not output.wait_for_all_acked(Duration(seconds=max(deadline - time.monotonic(), 0.0)))]
