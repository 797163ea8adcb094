"""Proof that another node knows our endpoints, by a question that it cannot answer before."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node

from semiparam_ros.ros.replay_discovery import wait_until

HANDSHAKE_S = 3.0


def handshake(node: Node, other: str, stopping: threading.Event, parameter: str = '') -> int | None:
    """Ask the node ``other`` for a parameter; its value when it is an integer, else None.

    Discovery is not symmetric: that we see its endpoints does not mean that it sees ours, and until it does what either
    side sends is lost to the other (with Fast DDS for up to 3 s, the period of its heartbeat). It learns of our
    publishers and of our subscriptions in the order of their creation, and it cannot answer this call before it knows
    the client, which is younger than all of them. Who has no parameter services, because it is not of ROS, is trusted.
    """
    if not other.startswith('/'):
        return None
    client = node.create_client(GetParameters, f'{other}/get_parameters')
    try:
        if wait_until(client.service_is_ready, HANDSHAKE_S, stopping):
            reply = client.call_async(GetParameters.Request(names=[parameter] if parameter else []))
            if wait_until(reply.done, HANDSHAKE_S, stopping):
                return _integer(reply.result().values)
        return None
    finally:
        node.destroy_client(client)


def _integer(values: Sequence[ParameterValue]) -> int | None:
    """The first value, None when it is not set or no integer."""
    is_one = len(values) > 0 and values[0].type == ParameterType.PARAMETER_INTEGER
    return int(values[0].integer_value) if is_one else None
