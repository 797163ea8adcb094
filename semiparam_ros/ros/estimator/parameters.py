"""The node's parameters, declared from the table: a change is checked as a whole, and its reply waits a moment for
the model that it asks for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.service import Service
from rclpy.timer import Timer

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.context import steady_timer
from semiparam_ros.settings.parameter_table import BY_NAME, PARAMETERS, Parameter
from semiparam_ros.settings.snapshot import Settings, is_foreign, nearest, refusal, unknown_name

PATIENCE_S = 1.0
"""Clients of parameters expect an answer soon; a model that takes longer is announced instead."""

OVERTAKEN = 'another change of the model came before it was there.'
FORGOTTEN = 'a reset or a loaded state came before it was there.'
"""Of a model that is built no more."""

NAMES = ('/set_parameters', '/set_parameters_atomically')
Response: TypeAlias = SetParameters.Response | SetParametersAtomically.Response

ROS_TYPES = {'bool': RosParameter.Type.BOOL, 'integer': RosParameter.Type.INTEGER,
             'double': RosParameter.Type.DOUBLE, 'string': RosParameter.Type.STRING,
             'string_array': RosParameter.Type.STRING_ARRAY, 'double_array': RosParameter.Type.DOUBLE_ARRAY}
LARGEST = {'double': 1.7976931348623157e308, 'integer': 2**63 - 1}


class DelayedReply(NamedTuple):
    """A reply that waits, and how to send it."""

    send: Callable[[], None]
    response: Response


class HeldReplies:
    """Holds replies of the parameter services while ``announcement`` is what they say.

    :param announcement: the sentence about the model being built now, '' while none is.
    """

    def __init__(self, node: Node, announcement: Callable[[], str]) -> None:
        self._node, self._announcement = node, announcement
        self._held: DelayedReply | None = None
        self._timer: Timer | None = None
        for service in node.services:
            if service.srv_name.endswith(NAMES):
                self._hold_replies_of(service)

    def settle(self, success: bool, sentence: str) -> None:
        """The model is there, or cannot be built."""
        for result in results_of(self._held.response) if self._held else ():
            if result.successful and result.reason:
                result.successful, result.reason = success, sentence
        self.release()

    def overtake(self) -> None:
        """Another model is asked for: the one that is waited for is built no more."""
        self.settle(True, OVERTAKEN)

    def forget(self) -> None:
        """Nothing that is waited for is built any more: all is forgotten, or a state is loaded."""
        self.settle(True, FORGOTTEN)

    def release(self) -> None:
        """Send what waits as it is."""
        held, self._held = self._held, None
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
        if held is not None:
            held.send()

    def _hold_replies_of(self, service: Service) -> None:
        send = service.send_response

        def send_or_hold(response: Response, header: object) -> None:
            announcement = self._announcement()
            if announcement and any(result.reason == announcement for result in results_of(response)):
                self._hold(DelayedReply(lambda: send(response, header), response))
            else:
                send(response, header)

        service.send_response = send_or_hold  # type: ignore[method-assign, assignment]

    def _hold(self, reply: DelayedReply) -> None:
        self.release()  # an earlier wish is overtaken by this one
        self._held = reply
        self._timer = steady_timer(self._node, PATIENCE_S, self._expire)

    def _expire(self) -> None:
        if self._announcement():
            self.release()
        else:
            self.forget()


def results_of(response: Response) -> Iterator[SetParametersResult]:
    """Results of either parameter service."""
    yield from [response.result] if isinstance(response, SetParametersAtomically.Response) else response.results


class Parameters:
    """Keeps ``settings`` equal to the node's parameters.

    :param overrides: the values of the command line and parameter files, as rcl read them.
    :param accept: asked before a change is made, with the settings as they would be; a sentence refuses it.
    :param changed: called after a change, with the new settings; its sentence is the answer's reason.
    Raises SemiparamError, before anything is declared, for values that do not fit.
    """

    def __init__(self, node: Node, overrides: dict[str, object], accept: Callable[[Settings], str | None],
                 changed: Callable[[Settings], str]) -> None:
        self._node, self._accept, self._changed = node, accept, changed
        self._log = node.get_logger()
        self.settings = Settings.from_mapping(self._ours(overrides))
        self.news = ''
        self._by_node = True
        node.add_pre_set_parameters_callback(self._convert)
        node.add_on_set_parameters_callback(self._validate)
        for parameter in PARAMETERS:
            self._declare(parameter)
        self._by_node = False
        node.add_post_set_parameters_callback(self._apply)

    def refusal(self, values: dict[str, object]) -> str | None:
        """Why these values together would be refused; None when they are fine."""
        ours = {name: value for name, value in values.items() if not is_foreign(name)}
        try:
            return refusal(self.settings, ours) or self._accept(self.settings.changed(ours))
        except SemiparamError as error:
            return str(error)

    def write(self, settings: Settings) -> None:
        """Let the parameters show settings that the node itself has chosen (a state loaded, a change that failed)."""
        changed = [parameter for parameter in PARAMETERS
                   if getattr(settings, parameter.field) != getattr(self.settings, parameter.field)]
        self.settings = settings
        self._by_node = True
        try:
            self._node.set_parameters([_ros_parameter(row, getattr(settings, row.field)) for row in changed])
        finally:
            self._by_node = False

    def ros_parameter(self, name: str, value: object) -> RosParameter:
        """One of ours, as rclpy wants it."""
        return _ros_parameter(BY_NAME[name], value)

    def _declare(self, parameter: Parameter) -> None:
        """By type first and value afterwards, because an empty list says nothing of its type."""
        if parameter.words:
            self._node.declare_parameter(parameter.name, getattr(self.settings, parameter.field),
                                         descriptor(parameter), ignore_override=True)
            return
        kind = ROS_TYPES[parameter.kind]
        self._node.declare_parameter(parameter.name, kind, ParameterDescriptor(), ignore_override=True)
        self._node.set_parameters([_ros_parameter(parameter, getattr(self.settings, parameter.field))])
        self._node.set_descriptor(parameter.name, descriptor(parameter))

    def _ours(self, overrides: dict[str, object]) -> dict[str, object]:
        """Leave out what a wildcard section meant for other nodes; a misspelt name of ours is refused."""
        ours = {}
        for name, value in overrides.items():
            if name in BY_NAME or is_foreign(name):
                ours[name] = value
            elif nearest(name) is not None:
                raise SemiparamError(unknown_name(name))
            else:
                self._log.warning(f"parameter '{name}' is not one of this node's; it is ignored.")
        return ours

    def _convert(self, parameters: list[RosParameter]) -> list[RosParameter]:
        """1 for 1.0, and lists that are empty and therefore of no type."""
        return [_ros_parameter(BY_NAME[item.name], item.value) if _can_convert(item) else item for item in parameters]

    def _validate(self, parameters: list[RosParameter]) -> SetParametersResult:
        if self._by_node:
            return SetParametersResult(successful=True)
        sentence = self.refusal({item.name: item.value for item in parameters})
        return SetParametersResult(successful=sentence is None, reason=sentence or '')

    def _apply(self, parameters: list[RosParameter]) -> None:
        if self._by_node:
            return
        ours = {item.name: item.value for item in parameters if item.name in BY_NAME}
        if ours:
            before, self.settings = self.settings, self.settings.changed(ours)
            try:
                self.news = self._changed(self.settings)
            except Exception:
                self.write(before)
                raise


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Descriptor that `ros2 param describe` shows."""
    result = ParameterDescriptor(description=parameter.description, read_only=not parameter.live,
                                 type=ROS_TYPES[parameter.kind].value)
    unit = f'[{parameter.unit}]' if parameter.unit else ''
    result.additional_constraints = ' '.join(filter(None, [parameter.permitted, unit]))
    if parameter.words:
        result.dynamic_typing = True  # a number or a word, which no range can describe
    elif parameter.minimum is not None or parameter.maximum is not None:
        low, high = parameter.minimum, parameter.maximum
        if parameter.kind == 'double':
            result.floating_point_range = [FloatingPointRange(
                from_value=-LARGEST['double'] if low is None else float(low),
                to_value=LARGEST['double'] if high is None else float(high))]
        elif parameter.kind == 'integer':
            result.integer_range = [IntegerRange(from_value=-LARGEST['integer'] if low is None else int(low),
                                                 to_value=LARGEST['integer'] if high is None else int(high))]
    return result


def _can_convert(item: RosParameter) -> bool:
    parameter = BY_NAME.get(item.name)
    return parameter is not None and item.value is not None and parameter.refusal(parameter.convert(item.value)) is None


def _ros_parameter(parameter: Parameter, value: object) -> RosParameter:
    converted = parameter.convert(value)
    plain = list(converted) if isinstance(converted, tuple) else converted
    kind = ROS_TYPES['string' if isinstance(plain, str) else parameter.kind]
    return RosParameter(parameter.name, kind, plain)
