"""Waiting until those who listen are really connected, so that the first message is not lost to discovery."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from typing import NamedTuple

from rclpy.qos import QoSCompatibility, qos_check_compatible

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.discovery import owner, wait_until
from semiparam_ros.ros.recorded_qos import to_rclpy
from semiparam_ros.ros.replay.node import ReplayNode

SETTLE_S = 0.3
NAMED_S = 3.0
"""A node's name comes after its subscriptions; who is not of ROS never tells one."""


class Subscriber(NamedTuple):
    """One subscription of another node: who, and why it receives nothing, '' where it does."""

    owner: str
    topic: str
    reliable: bool
    mismatch: str


def subscribers(node: ReplayNode) -> list[Subscriber]:
    """Subscriptions that were discovered to what ``node`` publishes."""
    found = []
    for topic, output in node.outputs.items():
        offered = to_rclpy(node.offers[topic])
        for info in node.get_subscriptions_info_by_topic(output.topic_name):
            verdict, reason = qos_check_compatible(offered, info.qos_profile)
            mismatch = reason if verdict == QoSCompatibility.ERROR else ''
            if info.topic_type != node.types[topic]:
                mismatch = f'it is published as {node.types[topic]}, and subscribed to as {info.topic_type}'
            found.append(Subscriber(owner(info), topic, info.qos_profile.reliability.name == 'RELIABLE', mismatch))
    return found


class SubscriberCheck:
    """Check that at least ``count`` nodes listen, all connected, and nothing changes."""

    def __init__(self, node: ReplayNode, count: int) -> None:
        self._node = node
        self._count = count
        self._seen: list[Subscriber] = []
        self._since = 0.0

    def __call__(self) -> bool:
        found = subscribers(self._node)
        if found != self._seen or not self._connected(found):
            self._seen, self._since = found, time.monotonic()
            return False
        settle_s = SETTLE_S if all(each.owner.startswith('/') for each in found) else NAMED_S
        return len({each.owner for each in found}) >= self._count and time.monotonic() - self._since > settle_s

    def _connected(self, found: Iterable[Subscriber]) -> bool:
        expected = dict.fromkeys(self._node.outputs, 0)
        for each in found:
            expected[each.topic] += not each.mismatch
        return all(output.get_subscription_count() >= expected[topic] for topic, output in self._node.outputs.items())


def wait_for_subscribers(node: ReplayNode, count: int, timeout_s: float,
                         stopping: threading.Event) -> None:
    """Return once ``count`` nodes are connected with all their subscriptions. Raises SemiparamError after a while."""
    if wait_until(SubscriberCheck(node, count), timeout_s, stopping):
        return
    found = sorted({each.owner for each in subscribers(node)})
    names = f': {", ".join(found)}' if found else ''
    raise SemiparamError(f'{len(found)} of {count} subscribing nodes are connected after {timeout_s:g} s{names} '
                         f'(topics: {", ".join(node.outputs) or "none"}).')


def warnings(found: Iterable[Subscriber], lossless: bool) -> list[str]:
    """Sentences about subscriptions that will receive nothing, or not everything."""
    found = list(found)
    sentences = [f'{each.owner} receives nothing on {each.topic}: {each.mismatch.rstrip(";. ")}.'
                 for each in found if each.mismatch]
    if lossless:
        sentences += [f'{each.owner} subscribes to {each.topic} with best-effort reliability: it may lose messages.'
                      for each in found if not each.reliable and not each.mismatch]
    return sentences
