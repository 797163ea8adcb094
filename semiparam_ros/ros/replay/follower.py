"""The follower of a lossless playback: its answers are received here and open the window of the flow control."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

from rclpy.topic_endpoint_info import TopicEndpointInfo

from semiparam_ros.bags.header_stamp import read_stamp
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.flow_control import FlowControl
from semiparam_ros.playback.options import FollowOptions
from semiparam_ros.ros.cdr import begins_with_header
from semiparam_ros.ros.context import call_in_executor
from semiparam_ros.ros.discovery import handshake, is_named, owner, wait_until
from semiparam_ros.ros.message_types import message_class
from semiparam_ros.ros.recorded_qos import from_rclpy, subscription_qos, to_rclpy
from semiparam_ros.ros.replay.node import ReplayNode

NAME_S = 1.0
QUEUE_DEPTH = 'queue_depth'
_REMARK = ('{name} keeps only the last {depth} messages of a topic (its parameter queue_depth) and may lose some; '
           '0 keeps all.')


class Follower:
    """One answering node, connected both ways.

    :param answer_topic: where its answers come
    :param request_topic: the played topic that they answer; None takes the one of the answers' type
    :param wait_s: how long to wait for it [s]
    :param woken: called after each answer, from the executor's thread
    """

    def __init__(self, node: ReplayNode, answer_topic: str, request_topic: str | None, options: FollowOptions,
                 wait_s: float, stopping: threading.Event, woken: Callable[[], None]) -> None:
        self._node = node
        self._woken = woken
        self.answer_topic = node.resolve_topic_name(answer_topic)
        if self.answer_topic in [output.topic_name for output in node.outputs.values()]:
            raise SemiparamError(f'{self.answer_topic} is played itself, so its answers cannot be told from what the '
                                 'bag holds: leave it out with --exclude-topics.')
        info = self._publisher(wait_s, stopping)
        self.name = owner(info)
        request = request_topic or _request_topic(node, info.topic_type, self.answer_topic)
        if request not in node.outputs:
            raise SemiparamError(f'{self.answer_topic} cannot answer {request}, which is not played: '
                                 f'expected one of {", ".join(node.outputs)}.')
        stamped = begins_with_header(node.types[request]) and begins_with_header(info.topic_type)
        self.flow = FlowControl(request, options.window, options.timeout_s, read_stamp if stamped else lambda _: 0,
                                self._is_gone, beside=self._heard_beside(request) if stamped else ())
        self._read = read_stamp if stamped else lambda _: None
        self._subscription = call_in_executor(node, partial(
            node.create_subscription, message_class(info.topic_type), self.answer_topic, self._answer,
            to_rclpy(subscription_qos([from_rclpy(info.qos_profile)])), raw=True))
        depth = self._connect(wait_s, stopping)
        self.remark = _REMARK.format(name=self.name, depth=depth) if depth else ''
        self.flow.fit_queue(depth)

    def _publisher(self, wait_s: float, stopping: threading.Event) -> TopicEndpointInfo:
        """Endpoint information of who answers; raises SemiparamError when nobody does in time."""
        if not wait_until(lambda: self._node.count_publishers(self.answer_topic) > 0, wait_s, stopping):
            raise SemiparamError(f'nobody publishes {self.answer_topic} after {wait_s:g} s: expected the node that '
                                 'answers the playback (start it first, or name its topic with --follow).')
        # The endpoint and the name of its node are announced separately; one that is not of ROS never has a name.
        wait_until(lambda: is_named(self._answering()), NAME_S, stopping)
        return self._answering()

    def _answering(self) -> TopicEndpointInfo:
        found = self._node.get_publishers_info_by_topic(self.answer_topic)
        if not found:
            raise SemiparamError(f'the node that publishes {self.answer_topic} left at once.')
        return found[0]

    def _connect(self, wait_s: float, stopping: threading.Event) -> int | None:
        """Wait until each side has discovered the other's endpoints; the follower's queue depth if it tells."""
        if not wait_until(lambda: self._subscription.get_publisher_count() > 0, wait_s, stopping):
            raise SemiparamError(f'{self.answer_topic} did not connect within {wait_s:g} s.')
        # Who answers the playback answers this too, be it late: played before, its answers are lost, or its queue runs
        # over.
        return handshake(self._node, self.name, stopping, QUEUE_DEPTH, wait_s)

    def _heard_beside(self, request: str) -> list[str]:
        """Other played topics with stamps that the follower subscribes to."""
        return [topic for topic, output in self._node.outputs.items()
                if topic != request and begins_with_header(self._node.types[topic])
                and self.name in map(owner, self._node.get_subscriptions_info_by_topic(output.topic_name))]

    def _is_gone(self) -> bool:
        return bool(self._subscription.get_publisher_count() == 0)

    def _answer(self, raw: bytes) -> None:
        self.flow.answered(self._read(raw))
        self._woken()


def _request_topic(node: ReplayNode, answer_type: str, answer_topic: str) -> str:
    """The one played topic whose type is that of the answers."""
    fitting = [topic for topic, type_name in node.types.items() if type_name == answer_type]
    if len(fitting) == 1:
        return fitting[0]
    raise SemiparamError(f'which topic {answer_topic} answers is not clear: {len(fitting)} of the played topics are '
                         f'{answer_type} (name it: --follow {answer_topic}=TOPIC).')
