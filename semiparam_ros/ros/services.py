"""The services of the node; each answers in a sentence, also when it cannot do what it was asked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros import state_file
from semiparam_ros.ros.internal_errors import InternalErrors
from semiparam_ros.ros.learner import Learner
from semiparam_ros.ros.parameters import Parameters


class Services:
    """``~/reset``, ``~/pause_learning``, ``~/tare``, ``~/save_state`` and ``~/load_state``.

    :param learner: gives the learner, or raises SemiparamError while there is none.
    :param errors: counts what goes wrong unexpectedly.
    """

    def __init__(self, node: Node, parameters: Parameters, learner: Callable[[], Learner],
                 errors: InternalErrors) -> None:
        self._node, self._parameters, self._learner = node, parameters, learner
        for name, action in (('reset', self.reset), ('tare', self.tare), ('save_state', self.save_state),
                             ('load_state', self.load_state)):
            create_trigger(node, f'~/{name}', action, errors)
        node.create_service(SetBool, '~/pause_learning', self._pause)

    def reset(self) -> str:
        """Forget everything learnt."""
        learner = self._learner()
        learner.reset()
        return f'all is forgotten; a new initial window of {learner.built.initial_samples} samples begins.'

    def tare(self) -> str:
        """Take the present bias off the measured outputs."""
        learner = self._learner()
        count = learner.tare.take()
        values = np.array2string(learner.tare.bias, precision=4, separator=', ')
        return f'the bias is now {values} ({", ".join(learner.body.output_units)}), from {count} samples.'

    def save_state(self) -> str:
        """Write what was learnt to ``state_file``."""
        path = state_file.path_of(self._parameters.settings)
        state_file.save(path, self._learner().state())
        return f'{path} is written.'

    def load_state(self) -> str:
        """Go on from what ``state_file`` holds."""
        path = state_file.path_of(self._parameters.settings)
        learner = self._learner()
        saved = state_file.load(path, self._parameters.settings, learner.body)
        learner.restore(saved)
        self._parameters.write(saved.settings)
        return f'{path} is loaded: {saved.settings.variant} with {len(saved.chapter)} samples.'

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """``data`` true: predict without learning."""
        result = self._node.set_parameters_atomically([self._parameters.ros_parameter('learning', not request.data)])
        response.success = result.successful
        response.message = result.reason or ('learning is paused.' if request.data else 'learning goes on.')
        return response


def create_trigger(node: Node, name: str, action: Callable[[], str], errors: InternalErrors) -> None:
    """A std_srvs/Trigger service from a function that returns a sentence or raises; it always answers."""
    def callback(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message, response.success = action(), True
        except SemiparamError as error:
            response.message, response.success = str(error), False
        except Exception as error:
            response.message, response.success = errors.add(name, error), False
        return response

    node.create_service(Trigger, name, callback)
