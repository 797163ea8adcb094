"""Services that answer, and a clock that goes on, whatever happens: where a callback raises, rclpy sends no response
and its executor ends."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.service import Service
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from semiparam_ros.errors import SemiparamError, shortened

KNOWN_TYPES = {kind.value for kind in Parameter.Type}


class AnsweringNode(Node):
    """A node whose services, those of its parameters included, send a response whatever is asked of them; a simulated
    time before 1970 is refused, where rclpy raises an exception."""

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any],
                       **options: Any) -> Service:
        """Create a service as every node does, but whatever the callback raises, a response is sent."""
        return super().create_service(srv_type, srv_name, answering(callback, partial(self.failure, srv_name)),
                                      **options)

    def create_subscription(self, msg_type: Any, topic: str, callback: Callable[..., Any], qos_profile: Any,
                            **options: Any) -> Subscription:
        """Subscribe as every node does, but a simulated time that rclpy cannot take goes to :meth:`message_failed`."""
        if msg_type is Clock and not options.get('raw'):
            callback = partial(self._take_time, callback)
        return super().create_subscription(msg_type, topic, callback, qos_profile, **options)

    def _take_time(self, take: Callable[[Clock], Any], message: Clock) -> None:
        if message.clock.sec < 0:
            self.message_failed('/clock', SemiparamError(f'/clock has the time {message.clock.sec} s; '
                                                         'expected one from 0 on.'))
        else:
            take(message)

    def message_failed(self, place: str, error: Exception) -> None:
        """A message could not be taken; the node goes on."""
        self.get_logger().error(str(error), throttle_duration_sec=1.0)

    def failure(self, service: str, error: Exception) -> str:
        """Sentence for who called a service whose callback raised an error."""
        sentence = f'internal error at {service}, {type(error).__name__}: {error}'
        self.get_logger().error(sentence)
        return sentence


def answering(callback: Callable[[Any, Any], Any], failed: Callable[[Exception], str]) -> Callable[[Any, Any], Any]:
    """A service's callback that returns a response whatever it raises, and one of the parameter services that refuses a
    value of a type that there is not, where rclpy raises an exception.

    :param failed: takes in what was raised; returns its sentence.
    """
    def answer(request: Any, response: Any) -> Any:
        try:
            if isinstance(request, SetParameters.Request):
                response.results = [_set_one(callback, parameter) for parameter in request.parameters]
                return response
            if isinstance(request, SetParametersAtomically.Request):
                refused = next(filter(None, map(wrong_type, request.parameters)), None)
                if refused is not None:
                    response.result = SetParametersResult(successful=False, reason=refused)
                    return response
            return callback(request, response)
        except Exception as error:
            return _filled(type(response)(), request, failed(error))

    return answer


def wrong_type(parameter: ParameterMessage) -> str | None:
    """A sentence for a value of a type that there is not."""
    if parameter.value.type in KNOWN_TYPES:
        return None
    return (f"'{parameter.name}' has a value of the type {parameter.value.type}; expected one of rcl_interfaces/"
            f'ParameterType, 0 to {max(KNOWN_TYPES)}.')


def _set_one(callback: Callable[[Any, Any], Any], parameter: ParameterMessage) -> SetParametersResult:
    """Each for itself, so that one that is refused keeps no other back."""
    refused = wrong_type(parameter)
    if refused is not None:
        return SetParametersResult(successful=False, reason=shortened(refused))
    response = callback(SetParameters.Request(parameters=[parameter]), SetParameters.Response())
    return response.results[0]


def _filled(response: Any, request: Any, sentence: str) -> Any:
    """A response that says what went wrong, where it has room for that."""
    if isinstance(response, SetParameters.Response):
        response.results = [SetParametersResult(successful=False, reason=sentence) for _ in request.parameters]
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = SetParametersResult(successful=False, reason=sentence)
    elif hasattr(response, 'message'):
        response.message = sentence
    return response
