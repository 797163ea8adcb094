"""Discovery of other nodes: waiting for them, names, proof that they know our endpoints."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.exceptions import InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.validate_full_topic_name import validate_full_topic_name

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.context import call_in_executor, rcl_reason

POLL_S = 0.02
_PARTICIPANT_BYTES = 12
_UNKNOWN = '_NODE_NAME_UNKNOWN_'

HANDSHAKE_S = 3.0
AGAIN_S = 1.0


class Stopped(Exception):
    """The user ended the program while it waited."""


def wait_until(condition: Callable[[], bool], timeout_s: float, stopping: threading.Event) -> bool:
    """Poll ``condition``; False after ``timeout_s`` seconds. Raises Stopped as soon as ``stopping`` is set."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if stopping.wait(POLL_S):
            raise Stopped
        if time.monotonic() > deadline:
            return False
    return True


def owner(info: TopicEndpointInfo) -> str:
    """The full node name behind an endpoint; the participant's number for one that is not of ROS."""
    if not is_named(info):
        return 'participant ' + bytes(info.endpoint_gid[:_PARTICIPANT_BYTES]).hex()
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def is_named(info: TopicEndpointInfo) -> bool:
    """Tell whether the node behind an endpoint is known by name."""
    return bool(info.node_name != _UNKNOWN)


def name_fault(topic: str) -> str:
    """Fault that makes a name none of a topic, in the words of rcl; '' where nothing does."""
    try:
        validate_full_topic_name(expand_topic_name(topic, 'node', '/'))
    except (InvalidTopicNameException, ValueError) as error:
        return rcl_reason(error).split(': ', 1)[1].rstrip(':.')
    return ''


def require_topic_names(names: Iterable[str]) -> None:
    """Raise SemiparamError for the first that is none."""
    for name in names:
        if fault := name_fault(name):
            raise SemiparamError(f'{name!r} is no name of a topic: {fault}.')


def handshake(node: Node, other: str, stopping: threading.Event, parameter: str = '',
              patience_s: float = HANDSHAKE_S) -> int | None:
    """Ask the node ``other`` for a parameter; its value when it is an integer, else None.

    Discovery is not symmetric: that we see its endpoints does not mean that it sees ours, and until it does what either
    side sends is lost to the other (with Fast DDS for up to 3 s, the period of its heartbeat). It learns of our
    publishers and of our subscriptions in the order of their creation, and it cannot answer this call before it knows
    the client, which is younger than all of them. It is asked again: an answer sent before that is lost. Who has no
    parameter services, because it is not of ROS, is trusted.
    """
    if not other.startswith('/'):
        return None
    client = call_in_executor(node, partial(node.create_client, GetParameters, f'{other}/get_parameters'))
    replies, due = [], 0.0

    def answered() -> bool:
        nonlocal due
        if time.monotonic() > due:
            replies.append(client.call_async(GetParameters.Request(names=[parameter] if parameter else [])))
            due = time.monotonic() + AGAIN_S
        return any(reply.done() for reply in replies)

    try:
        if wait_until(client.service_is_ready, HANDSHAKE_S, stopping) and wait_until(answered, patience_s, stopping):
            return _integer(next(reply for reply in replies if reply.done()).result().values)
        return None
    finally:
        call_in_executor(node, partial(node.destroy_client, client))


def _integer(values: Sequence[ParameterValue]) -> int | None:
    """The first value, None when it is not set or no integer."""
    is_one = len(values) > 0 and values[0].type == ParameterType.PARAMETER_INTEGER
    return int(values[0].integer_value) if is_one else None
