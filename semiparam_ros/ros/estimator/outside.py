"""Topics of what acts from outside: the wrench, the sensor's wrench without its tool, and the link
that is touched."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState

from semiparam_ros.core.robot.external_wrench import External, ExternalWrench
from semiparam_ros.core.types import Array
from semiparam_ros.online.compensation import Compensation
from semiparam_ros.online.learner import Answer, Learner
from semiparam_ros.ros.cdr import Layout, joint_state_layout
from semiparam_ros.ros.estimator.publishers import DEPTH, ValueMessage, is_heard, send

SINCE = 'since'
"""Name of the seconds since the contact began, after those of the links."""


class Outside:
    """``~/external_wrench`` with ``~/external_wrench_std``, ``~/compensated_wrench`` of robots with a sensor, and
    ``~/contact_place``; nothing is computed for what nobody listens to.

    :param learner: gives the learner. :param frame_id: gives the frame of the measured wrench.
    """

    def __init__(self, node: Node, outputs: str, learner: Callable[[], Learner], frame_id: Callable[[], str]) -> None:
        self._learner, self._frame_id = learner, frame_id
        self._wrench = node.create_publisher(WrenchStamped, '~/external_wrench', DEPTH)
        self._std = node.create_publisher(WrenchStamped, '~/external_wrench_std', DEPTH)
        self._compensated = node.create_publisher(WrenchStamped, '~/compensated_wrench', DEPTH) \
            if outputs == 'wrench' else None
        self._place = node.create_publisher(JointState, '~/contact_place', DEPTH)
        self._message, self._place_layouts = ValueMessage(), dict[str, Layout]()
        self._external: ExternalWrench | None = None
        self._of_frame: str | None = None
        self._compensation: Compensation | None = None
        self._latest: Answer | None = None

    def publish(self, answer: Answer) -> None:
        """Publish what one answer says of it."""
        self._latest = answer
        stamp = answer.prediction.sample.stamp
        heard = is_heard(self._wrench), is_heard(self._std)
        if any(heard):
            external = self._external_of(answer)
            for publisher, values in ((self._wrench, external.wrench), (self._std, external.std)):
                self._send(publisher, stamp, self._frame_name(), values)
        if self._compensated is not None:
            self._compensate(self._compensated, answer)
        if is_heard(self._place):
            self._send_place(answer, stamp)

    def unseen(self) -> str:
        """The direction of the external wrench that the outputs did not feel at the latest sample, in words."""
        if self._latest is None:
            return ''
        found = self._external_of(self._latest)
        return '' if self._external is None else self._external.unseen(found)

    def _external_of(self, answer: Answer) -> External:
        learner = self._learner()
        frame = learner.settings.external_wrench_frame
        if self._external is None or frame != self._of_frame:
            self._external, self._of_frame = ExternalWrench(learner.body, frame), frame
        self._external.shaped_by(learner.estimator.columns.effects)
        return self._external.of(answer.prediction, answer.residual, learner.gate.widening, answer.followed)

    def _frame_name(self) -> str:
        """Name that the sensor's driver gives it, where it is told there."""
        assert self._external is not None
        at_sensor = not self._of_frame and self._compensated is not None
        return self._frame_id() if at_sensor else self._external.frame

    def _compensate(self, publisher: Publisher, answer: Answer) -> None:
        if not is_heard(publisher):
            self._compensation = None  # it begins with the next listener
            return
        learner = self._learner()
        seconds = learner.settings.compensated_wrench_time_constant
        if self._compensation is None:
            self._compensation = Compensation(seconds)
        self._compensation.time_constant = seconds
        self._send(publisher, answer.prediction.sample.stamp, self._frame_id(),
                   learner.compensated(answer, self._compensation))

    def _send_place(self, answer: Answer, stamp: int) -> None:
        place = self._learner().gate.place
        assert place is not None
        touched = place.links[int(np.argmax(answer.places))] if answer.places.any() else ''
        if touched not in self._place_layouts:
            names = [*place.links, SINCE]
            self._place_layouts[touched] = joint_state_layout(touched, names, len(names), 0, 0)
        send(self._place, self._place_layouts[touched].write(stamp, [*answer.places.tolist(), answer.contact_s]))

    def _send(self, publisher: Publisher, stamp: int, frame_id: str, values: Array) -> None:
        if is_heard(publisher):
            send(publisher, self._message.filled(stamp, frame_id, values))
