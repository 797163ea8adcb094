"""``~/diagnose`` looks at the latest samples in the background; ``~/apply_diagnosis`` adds what it found."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros import diagnosis_job
from semiparam_ros.ros.background import ProcessBackground
from semiparam_ros.ros.deferred_service import Reply, create_deferred_trigger
from semiparam_ros.ros.diagnosis_job import Outcome
from semiparam_ros.ros.internal_errors import InternalErrors
from semiparam_ros.ros.learner import Learner
from semiparam_ros.ros.model_switcher import sentence_of
from semiparam_ros.ros.outputs import LATCHED
from semiparam_ros.ros.parameters import Parameters
from semiparam_ros.ros.services import create_trigger


class Diagnosing:
    """The two services, and the report on the latched topic ``~/diagnosis`` (JSON).

    A process of its own does the work, so that a model being built does not wait for it.

    :param later: hands a function over to the executor's thread.
    :param errors: counts what goes wrong unexpectedly.
    """

    def __init__(self, node: Node, parameters: Parameters, learner: Callable[[], Learner],
                 later: Callable[[Callable[[], None]], object], errors: InternalErrors) -> None:
        self._node, self._parameters, self._learner, self._later = node, parameters, learner, later
        self._errors = errors
        self._background: ProcessBackground | None = None
        self._running = False
        self._outcome: Outcome | None = None
        self._examined: tuple[str, ...] = ()
        self._report = node.create_publisher(String, '~/diagnosis', LATCHED)
        create_deferred_trigger(node, '~/diagnose', self._diagnose)
        create_trigger(node, '~/apply_diagnosis', self.apply, errors)

    def close(self) -> None:
        """End the process, whatever it is doing."""
        if self._background is not None:
            self._background.close()

    def apply(self) -> str:
        """Declare the effects of the last diagnosis."""
        if self._running:
            raise SemiparamError('a diagnosis is running; wait for its answer, then apply it.')
        if self._outcome is None:
            raise SemiparamError('there is no diagnosis yet; ~/diagnose makes one.')
        if self._outcome.effects == self._examined:
            return 'the last diagnosis found nothing to add.'
        if self._outcome.effects == self._parameters.settings.effects:
            return f'the effects of the last diagnosis are declared already: {_listed(self._outcome.effects)}.'
        result = self._node.set_parameters_atomically(
            [self._parameters.ros_parameter('effects', self._outcome.effects)])
        if not result.successful:
            raise SemiparamError(result.reason)
        return f'effects are now {_listed(self._outcome.effects)}; {result.reason}'

    def _diagnose(self, reply: Reply) -> None:
        try:
            self._start(reply)
        except SemiparamError as error:
            reply(str(error), success=False)
        except Exception as error:
            reply(self._errors.add('~/diagnose', error), success=False)

    def _start(self, reply: Reply) -> None:
        learner = self._learner()
        if self._running:
            raise SemiparamError('a diagnosis is running already; wait for its answer.')
        samples = learner.history.span(self._parameters.settings.diagnosis_window)
        if samples is None:
            raise SemiparamError('there are no samples to diagnose yet.')
        if self._background is None:
            self._background = ProcessBackground(self._later)
        # Those that are wanted now, whether their model answers already or is still being built.
        effects = self._parameters.settings.effects
        self._background.submit(diagnosis_job.run, learner.body, diagnosis_job.thinned(samples), effects,
                                done=lambda outcome, error: self._done(reply, effects, outcome, error))
        self._running = True

    def _done(self, reply: Reply, effects: tuple[str, ...], outcome: Any, error: BaseException | None) -> None:
        self._running = False
        if outcome is None:
            if error is not None and not isinstance(error, SemiparamError):
                self._errors.add('~/diagnose', error)
            reply(f'{sentence_of(error)}.', success=False)
            return
        self._outcome, self._examined = outcome, effects
        self._report.publish(String(data=json.dumps({'schema': 1, **outcome.report})))
        reply(f'With {_listed(effects) or "no effects"} declared: {" ".join(outcome.words)}')


def _listed(effects: tuple[str, ...]) -> str:
    """Kinds and places, without their values."""
    return ', '.join(text.partition('{')[0] for text in effects)
