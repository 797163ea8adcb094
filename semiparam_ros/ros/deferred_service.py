"""A service whose answer comes later, while the executor goes on with other callbacks.

rclpy's coroutines would do, but the executor of the node does not await those of services.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.service import Service
from std_srvs.srv import Trigger


class Reply:
    """What a request waits for: call it once, with the sentence and whether it went well, from the same thread."""

    def __init__(self) -> None:
        self._header: Any = None
        self._send: Callable[[Any, Any], None] | None = None
        self._response: Trigger.Response | None = None

    def __call__(self, message: str, success: bool = True) -> None:
        """Answer the request."""
        self._response = Trigger.Response(success=success, message=message)
        self._deliver()

    def expect(self, header: Any, send: Callable[[Any, Any], None]) -> None:
        """Where the answer goes."""
        self._header, self._send = header, send
        self._deliver()

    def _deliver(self) -> None:
        if self._response is not None and self._send is not None:
            self._send(self._response, self._header)
            self._send = None


def create_deferred_trigger(node: Node, name: str, action: Callable[[Reply], None]) -> Service:
    """A std_srvs/Trigger service; ``action`` starts the work and sees to it that the reply is called."""
    def begin(_request: Trigger.Request, _response: Trigger.Response) -> Reply:
        reply = Reply()
        action(reply)
        return reply

    service = node.create_service(Trigger, name, begin)
    send = service.send_response

    def send_later(reply: Any, header: Any) -> None:
        reply.expect(header, send)

    service.send_response = send_later  # type: ignore[method-assign, assignment]
    return service
