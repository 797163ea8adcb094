"""The reply to a parameter change waits a moment for the model that it asks for, so that it can say what happened."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.service import Service
from rclpy.timer import Timer

PATIENCE_S = 1.0
"""Clients of parameters expect an answer soon; a model that takes longer is announced instead."""

NAMES = ('/set_parameters', '/set_parameters_atomically')


class Held(NamedTuple):
    """A reply that waits, and how to send it."""

    send: Callable[[], None]
    response: Any


class HeldReplies:
    """Holds replies of the parameter services while ``announcement`` is what they say.

    :param announcement: the sentence about the model being built now, '' while none is.
    """

    def __init__(self, node: Node, announcement: Callable[[], str]) -> None:
        self._node, self._announcement = node, announcement
        self._held: list[Held] = []
        self._timer: Timer | None = None
        for service in node.services:
            if service.srv_name.endswith(NAMES):
                self._hold_replies_of(service)

    def settle(self, success: bool, sentence: str) -> None:
        """The model is there, or cannot be built."""
        for held in self._held:
            for result in results_of(held.response):
                if result.successful and result.reason:
                    result.successful, result.reason = success, sentence
        self.release()

    def release(self) -> None:
        """Send what waits as it is."""
        held, self._held = self._held, []
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
        for reply in held:
            reply.send()

    def _hold_replies_of(self, service: Service) -> None:
        send = service.send_response

        def send_or_hold(response: Any, header: Any) -> None:
            announcement = self._announcement()
            if announcement and any(result.reason == announcement for result in results_of(response)):
                self._hold(Held(lambda: send(response, header), response))
            else:
                send(response, header)

        service.send_response = send_or_hold  # type: ignore[method-assign, assignment]

    def _hold(self, reply: Held) -> None:
        self.release()  # an earlier wish is overtaken by this one
        self._held.append(reply)
        self._timer = self._node.create_timer(PATIENCE_S, self.release, clock=Clock(clock_type=ClockType.STEADY_TIME))


def results_of(response: Any) -> Iterator[SetParametersResult]:
    """Of either parameter service."""
    yield from (response.results if hasattr(response, 'results') else [response.result])
