"""The topics that carry the answers of the active model, and the horizon errors of all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import InertiaStamped, WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.stamps import stamp_fields
from semiparam_ros.core.types import Array
from semiparam_ros.online.identified_parameters import CarriedLoad
from semiparam_ros.online.learner import Answer
from semiparam_ros.ros.cdr import joint_state_layout, wrench_layout

LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
DEPTH = 1000

PARTS = ('predicted', 'std', 'residual', 'contact_level')
"""What ``~/answer`` holds of every output."""


def inertia_message(stamp: int, payload: CarriedLoad) -> InertiaStamped:
    """A payload as geometry_msgs/InertiaStamped: centre of mass in the link's frame, inertia about it; stamp in ns."""
    message = InertiaStamped()
    message.header.stamp, message.header.frame_id = Time(**stamp_fields(stamp)), payload.link
    inertia = message.inertia
    inertia.m = payload.mass
    inertia.com.x, inertia.com.y, inertia.com.z = payload.centre.tolist()
    (inertia.ixx, inertia.ixy, inertia.ixz), (_, inertia.iyy, inertia.iyz), (_, _, inertia.izz) = (
        payload.inertia.tolist())
    return message


class ValueMessage:
    """Wrenches or efforts as serialised messages."""

    def __init__(self, joints: Sequence[str] | None = None) -> None:
        """:param joints: whose efforts sensor_msgs/JointState holds; None for geometry_msgs/WrenchStamped."""
        self._joints = joints
        self._frame_id: str | None = None

    def filled(self, stamp: int, frame_id: str, values: Array) -> bytes:
        """With a stamp [ns], and a wrench (6,) in N and N m or efforts (n,) in N m."""
        if frame_id != self._frame_id:
            self._frame_id, joints = frame_id, self._joints
            self._layout = wrench_layout(frame_id) if joints is None else joint_state_layout(
                frame_id, joints, 0, 0, len(joints))
        return self._layout.write(stamp, values.tolist())


class HorizonMessage:
    """Horizon errors as a serialised sensor_msgs/JointState: names label the channels, positions hold the errors.

    Every plotting tool draws a JointState by its names; arrays without labels they can only number. The channels come
    first, then eps_F and eps_T (for efforts: eps), then the same with the mean of each window removed.
    """

    def __init__(self, channels: Sequence[str], wrench: bool) -> None:
        self._wrench = wrench
        names = [*channels, *(('eps_F', 'eps_T') if wrench else ('eps',))]
        self.names = [*names, *(f'{name}_centred' for name in names)]
        self._layout = joint_state_layout('', self.names, len(self.names), 0, 0)

    def filled(self, errors: HorizonErrors) -> bytes:
        """With the stamp of the origin t of its horizon."""
        values = [*self._with_means(errors.eps), *self._with_means(errors.eps_centred)]
        return self._layout.write(errors.origin, values)

    def _with_means(self, eps: Array) -> list[float]:
        values: list[float] = eps.tolist()
        if self._wrench:
            return [*values, sum(values[:3]) / 3, sum(values[3:]) / 3]
        return [*values, sum(values) / len(values)]


class Outputs:
    """Publishers, there from the start because a replay waits for them; ``frame_id`` is copied from the input."""

    def __init__(self, node: Node, outputs: str) -> None:
        self.frame_id = ''
        self._node = node
        kind, name = (WrenchStamped, 'wrench') if outputs == 'wrench' else (JointState, 'effort')
        self._mean = node.create_publisher(kind, f'~/predicted_{name}', DEPTH)
        self._std = node.create_publisher(kind, f'~/predicted_{name}_std', DEPTH)
        self._residual = node.create_publisher(kind, '~/residual', DEPTH)
        self._answer = node.create_publisher(JointState, '~/answer', DEPTH)
        self._horizon = node.create_publisher(JointState, '~/horizon_error', DEPTH)
        self._shadows: dict[str, Publisher] = {}
        self._contact = node.create_publisher(Bool, '~/contact', LATCHED)
        self._contact_level = node.create_publisher(JointState, '~/contact_level', DEPTH)
        self._in_contact: bool | None = None

    def duplicates(self) -> str:
        """Who else publishes these topics, as a sentence; '' for nobody."""
        count = self._node.count_publishers(self._answer.topic_name)
        if count < 2:
            return ''
        return (f'{count} publish on {self._answer.topic_name}: another node of the name '
                f'{self._node.get_fully_qualified_name()} runs, or one has died and its lease is not over yet. Both '
                'answer, and both do what services are asked for.')

    def open(self, body: RigidBody) -> None:
        """The robot is known: prepare the messages."""
        wrench = body.outputs == 'wrench'
        self.frame_id = self.frame_id or body.sensor_frame or ''  # until the input says how its driver calls it
        self._value = ValueMessage(None if wrench else body.output_names)
        self._errors = HorizonMessage(body.output_names, wrench)
        self._level = joint_state_layout('', body.output_names, body.n_outputs, 0, 0)
        self._parts = joint_state_layout('', [f'{name}_{part}' for part in PARTS for name in body.output_names],
                                         len(PARTS) * body.n_outputs, 0, 0)

    def publish(self, answer: Answer) -> None:
        """One answer: the residual goes last, for a replay waits for it."""
        prediction = answer.prediction
        self._send(self._mean, prediction, prediction.mean)
        self._send(self._std, prediction, prediction.std)
        if is_heard(self._answer):
            parts = prediction.mean, prediction.std, answer.residual, answer.contact_level
            send(self._answer, self._parts.write(prediction.sample.stamp, np.concatenate(parts).tolist()))
        self._send(self._residual, prediction, answer.residual)
        if answer.contact != self._in_contact:
            self._in_contact = answer.contact
            self._contact.publish(Bool(data=answer.contact))
        if is_heard(self._contact_level):
            send(self._contact_level, self._level.write(prediction.sample.stamp, answer.contact_level.tolist()))

    def publish_errors(self, errors: HorizonErrors) -> None:
        """The horizon errors of the active model."""
        if is_heard(self._horizon):
            send(self._horizon, self._errors.filled(errors))

    def _send(self, publisher: Publisher, prediction: Prediction, values: Array) -> None:
        """To those who listen: asking for them costs a twentieth of filling and sending a message."""
        if is_heard(publisher):
            send(publisher, self._value.filled(prediction.sample.stamp, self.frame_id, values))

    def publish_shadow(self, variant: str, errors: HorizonErrors) -> None:
        """The horizon errors of a shadow variant, on ``~/shadow/sp2_ml/horizon_error``."""
        if variant not in self._shadows:
            topic = f'~/shadow/{variant.lower().replace("-", "_")}/horizon_error'
            self._shadows[variant] = self._node.create_publisher(JointState, topic, DEPTH)
        self._shadows[variant].publish(self._errors.filled(errors))


def is_heard(publisher: Publisher) -> bool:
    """Tell whether anybody listens. The publishers last as long as the node, so nothing guards
    their handles against their end meanwhile, which takes rclpy three times as long as asking."""
    return bool(publisher.handle.get_subscription_count())


def send(publisher: Publisher, message: bytes) -> None:
    """A serialised message."""
    publisher.handle.publish_raw(message)
