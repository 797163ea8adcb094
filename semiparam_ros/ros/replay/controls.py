"""The controls of a playback as ROS offers them: parameters and services of its node."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from math import isfinite

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.player import Player

RATE_STEP = 1.1


class ReplayControls:
    """The player's controls as parameters (`rate`, `paused`, `loop`, `seek_to`) and Trigger services.

    Keyboard and services change the parameters, so that there is one way in and every client sees the change.
    """

    def __init__(self, node: Node, player: Player, start_ns: int) -> None:
        self._node = node
        self._player = player
        self._start_ns = start_ns
        self._declared = False
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)
        for name, value, description in self._table():
            self._declare(name, value, description)
        self._declared = True
        for name, action in self._services().items():
            node.create_service(Trigger, f'~/{name}', partial(self._serve, action))

    def _declare(self, name: str, value: object, description: str) -> None:
        """Declare it with the value from ``--ros-args -p``, which SemiparamError refuses."""
        try:
            self._node.declare_parameter(name, value, ParameterDescriptor(description=description))
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            raise SemiparamError(f"the parameter '{name}' is refused: {str(error).rstrip('. ')}.") from None

    def _table(self) -> tuple[tuple[str, float | bool, str], ...]:
        return (('rate', self._player.rate or 0.0,
                 'bag seconds in one second, a double above 0 (0.0: as fast as the follower answers)'),
                ('paused', self._player.paused, 'whether the playback is held'),
                ('loop', self._player.loop, 'whether it starts again at the end'),
                ('seek_to', 0.0, 'setting it goes on from there: seconds after the start of the playback'))

    def _services(self) -> dict[str, Callable[[], str]]:
        return {'pause': partial(self.change, 'paused', True), 'resume': partial(self.change, 'paused', False),
                'toggle_paused': self.toggle_paused, 'play_next': self.play_next, 'seek': self.seek_again,
                'is_paused': self._tell_paused, 'stop': self.stop}

    def keys(self) -> dict[str, Callable[[], object]]:
        """Actions of the keys of ``playback.keyboard``; one without sense now does nothing."""
        actions: dict[str, Callable[[], object]] = {
            'pause': self.toggle_paused, 'next': self.play_next,
            'faster': partial(self.change_rate, RATE_STEP),
            'slower': partial(self.change_rate, 1.0 / RATE_STEP)}
        return {key: partial(self._quietly, action) for key, action in actions.items()}

    @staticmethod
    def _quietly(action: Callable[[], object]) -> None:
        with suppress(SemiparamError):
            action()

    def change(self, name: str, value: object) -> str:
        """Set one parameter; what happened, or SemiparamError with the reason of the refusal."""
        result = self._node.set_parameters([Parameter(name, value=value)])[0]
        if not result.successful:
            raise SemiparamError(result.reason)
        return f'{name} is {value}'

    def toggle_paused(self) -> str:
        """Pause when playing, play when paused."""
        return self.change('paused', not self._player.paused)

    def play_next(self) -> str:
        """Publish the next message of a paused playback."""
        self._player.step()
        return 'the next message is published'

    def seek_again(self) -> str:
        """Go (again) to where the parameter `seek_to` points."""
        return self.change('seek_to', self._node.get_parameter('seek_to').value)

    def stop(self) -> str:
        """End the playback."""
        self._player.stop()
        return 'the playback ends'

    def change_rate(self, factor: float) -> str:
        """Play so many times as fast."""
        return self.change('rate', (self._player.rate or 1.0) * factor)

    def _tell_paused(self) -> str:
        if not self._player.paused:
            raise SemiparamError('playing')
        return 'paused'

    def _serve(self, action: Callable[[], str], _request: Trigger.Request, response: Trigger.Response
               ) -> Trigger.Response:
        try:
            response.success, response.message = True, action()
        except SemiparamError as refusal:
            response.success, response.message = False, str(refusal)
        return response

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                self._check(parameter.name, parameter.value)
        except SemiparamError as refusal:
            return SetParametersResult(successful=False, reason=str(refusal))
        return SetParametersResult(successful=True)

    def _check(self, name: str, value: float) -> None:
        if name == 'rate' and value != (self._player.rate or 0.0):
            self._player.check_rate(value)
        if name == 'seek_to':
            self._player.check_seek(self._bag_time(value))

    def _apply(self, parameters: list[Parameter]) -> None:
        """Apply what differs from the player's state: declaring parameters changes nothing."""
        for parameter in parameters:
            name, value = parameter.name, parameter.value
            if name == 'rate' and value != (self._player.rate or 0.0):
                self._player.set_rate(value)
            elif name == 'paused' and value != self._player.paused:
                self._player.set_paused(value)
            elif name == 'loop':
                self._player.loop = value
            elif name == 'seek_to' and (value or self._declared):
                self._player.seek(self._bag_time(value))

    def _bag_time(self, seconds: float) -> int:
        if not isfinite(seconds):
            raise SemiparamError(f'cannot seek to {seconds:g} s: expected seconds after the start of the playback.')
        return self._start_ns + round(seconds * NANOSECONDS)
