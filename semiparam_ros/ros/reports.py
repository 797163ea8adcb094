"""Publishes what the node says of itself: every status once a second on /diagnostics, and the payload."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from semiparam_ros.ros import diagnostics
from semiparam_ros.ros.diagnostics import WARN, Report, Tally
from semiparam_ros.ros.estimates import payload
from semiparam_ros.ros.inputs import Inputs
from semiparam_ros.ros.internal_errors import InternalErrors
from semiparam_ros.ros.learner import Learner
from semiparam_ros.ros.messages import inertia_message
from semiparam_ros.ros.refusals import Refusals

PERIOD_S = 1.0


class Reports:
    """One status after another, evenly over the second: a sample that comes meanwhile waits for one of them only.

    :param learner: gives the learner, None before the robot is known.
    """

    def __init__(self, node: Node, inputs: Inputs, refusals: Refusals, errors: InternalErrors,
                 learner: Callable[[], Learner | None]) -> None:
        self.tally = Tally(())
        self._news = self._robot_name = ''
        self._errors = errors
        self._node, self._inputs, self._learner = node, inputs, learner
        self._name = node.get_fully_qualified_name().lstrip('/')
        self._statuses = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._payload = node.create_publisher(InertiaStamped, '~/payload', 10)
        turns = {'inputs': diagnostics.InputReport(inputs, refusals).make,
                 'timing': lambda: diagnostics.timing_report(inputs), 'learning': self._learning,
                 'model': self._model, 'parameters': self._parameters,
                 'errors': lambda: diagnostics.errors_report(errors)}
        turn = cycle(turns.items())
        # By the machine's own clock: with a simulated one the reports would follow the recording's speed.
        node.create_timer(PERIOD_S / len(turns), lambda: self._publish(*next(turn)),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def open(self, robot_name: str, joints: tuple[str, ...]) -> None:
        """The robot is known: count its answers."""
        self._robot_name, self.tally = robot_name, Tally(joints)
        self.say(f'{robot_name or "the robot"} is known by its description and moves {", ".join(joints)}.')

    def say(self, sentence: str) -> None:
        """Into the log, and into the status of learning as the last news."""
        self._news = sentence
        self._node.get_logger().info(sentence)

    def _publish(self, title: str, make: Callable[[], Report | None]) -> None:
        try:
            report = make()
        except Exception as error:  # a status that cannot be told must not keep the others back
            self._errors.add(f'the status of {title}', error)
            return
        if report is None:
            return
        message = DiagnosticArray()
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.status = [diagnostics.status(f'{self._name}: {title}', self._robot_name, report)]
        self._statuses.publish(message)

    def _learning(self) -> Report:
        for topic in self._inputs.follow_reliability():
            self.say(f'{topic} is offered as best_effort only, and received so.')
        learner = self._learner()
        if learner is None:
            return Report(WARN, 'waiting for a robot description.', {})
        return diagnostics.learning_report(learner, self._news)

    def _model(self) -> Report | None:
        learner = self._learner()
        return None if learner is None else diagnostics.model_report(learner, self.tally)

    def _parameters(self) -> Report | None:
        learner = self._learner()
        if learner is None:
            return None
        carried = payload(learner.estimator) if self._payload.get_subscription_count() else None
        if carried is not None:
            self._payload.publish(inertia_message(self._node.get_clock().now().to_msg(), carried))
        return diagnostics.parameters_report(learner)
