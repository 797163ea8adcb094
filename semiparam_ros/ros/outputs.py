"""The topics that carry the answers of the active model, and the horizon errors of all."""

from __future__ import annotations

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.model import Prediction
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.types import Array
from semiparam_ros.ros.answers import Answer
from semiparam_ros.ros.messages import HorizonMessage, ValueMessage

LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
DEPTH = 1000


class Outputs:
    """Publishers, there from the start because a replay waits for them; ``frame_id`` is copied from the input."""

    def __init__(self, node: Node, outputs: str) -> None:
        self.frame_id = ''
        self._node = node
        kind, name = (WrenchStamped, 'wrench') if outputs == 'wrench' else (JointState, 'effort')
        self._mean = node.create_publisher(kind, f'~/predicted_{name}', DEPTH)
        self._std = node.create_publisher(kind, f'~/predicted_{name}_std', DEPTH)
        self._residual = node.create_publisher(kind, '~/residual', DEPTH)
        self._horizon = node.create_publisher(JointState, '~/horizon_error', DEPTH)
        self._shadows: dict[str, Publisher] = {}
        self._contact = node.create_publisher(Bool, '~/contact', LATCHED)
        self._in_contact: bool | None = None

    def open(self, body: RigidBody) -> None:
        """The robot is known: prepare the messages."""
        wrench = body.outputs == 'wrench'
        self._value = ValueMessage(None if wrench else body.joints)
        self._errors = HorizonMessage(body.output_names, wrench)

    def publish(self, answer: Answer) -> None:
        """One answer: the residual goes last, for a replay waits for it."""
        prediction = answer.prediction
        self._send(self._mean, prediction, prediction.mean)
        self._send(self._std, prediction, prediction.std)
        self._send(self._residual, prediction, answer.residual)
        if answer.contact != self._in_contact:
            self._in_contact = answer.contact
            self._contact.publish(Bool(data=answer.contact))

    def publish_errors(self, errors: HorizonErrors) -> None:
        """The horizon errors of the active model."""
        if self._horizon.get_subscription_count():
            self._horizon.publish(self._errors.filled(errors))

    def _send(self, publisher: Publisher, prediction: Prediction, values: Array) -> None:
        """To those who listen: asking for them costs a twentieth of filling and sending a message."""
        if publisher.get_subscription_count():
            publisher.publish(self._value.filled(prediction.sample.stamp, self.frame_id, values))

    def publish_shadow(self, variant: str, errors: HorizonErrors) -> None:
        """The horizon errors of a shadow variant, on ``~/shadow/sp2_ml/horizon_error``."""
        if variant not in self._shadows:
            topic = f'~/shadow/{variant.lower().replace("-", "_")}/horizon_error'
            self._shadows[variant] = self._node.create_publisher(JointState, topic, DEPTH)
        self._shadows[variant].publish(self._errors.filled(errors))
