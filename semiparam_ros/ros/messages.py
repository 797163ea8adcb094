"""Between numbers and messages. Messages that are published at the rate of the sensor are made once and reused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import InertiaStamped, WrenchStamped
from sensor_msgs.msg import JointState

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.types import Array
from semiparam_ros.ros.estimates import Payload

NANOSECONDS = 1_000_000_000


def inertia_message(stamp: Any, payload: Payload) -> InertiaStamped:
    """A payload as geometry_msgs/InertiaStamped: centre of mass in the link's frame, inertia about it."""
    message = InertiaStamped()
    message.header.stamp, message.header.frame_id = stamp, payload.link
    inertia = message.inertia
    inertia.m = payload.mass
    inertia.com.x, inertia.com.y, inertia.com.z = payload.centre.tolist()
    (inertia.ixx, inertia.ixy, inertia.ixz), (_, inertia.iyy, inertia.iyz), (_, _, inertia.izz) = (
        payload.inertia.tolist())
    return message


def set_stamp(stamp: Any, nanoseconds: int) -> None:
    """Write nanoseconds into a builtin_interfaces/Time (five times faster than by way of rclpy's Time)."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)


class WrenchMessage:
    """A reused geometry_msgs/WrenchStamped."""

    def __init__(self) -> None:
        self.message = WrenchStamped()

    def filled(self, stamp: int, frame_id: str, values: Array) -> WrenchStamped:
        """With a stamp [ns] and force and torque (6,) in N and N m."""
        message = self.message
        set_stamp(message.header.stamp, stamp)
        message.header.frame_id = frame_id
        force, torque = message.wrench.force, message.wrench.torque
        force.x, force.y, force.z, torque.x, torque.y, torque.z = values.tolist()
        return message


class EffortMessage:
    """A reused sensor_msgs/JointState that holds efforts."""

    def __init__(self, joints: Sequence[str]) -> None:
        self.message = JointState(name=list(joints))

    def filled(self, stamp: int, frame_id: str, values: Array) -> JointState:
        """With a stamp [ns] and efforts (n_joints,) in N m."""
        message = self.message
        set_stamp(message.header.stamp, stamp)
        message.header.frame_id = frame_id
        message.effort = values.tolist()
        return message


class HorizonMessage:
    """A reused sensor_msgs/JointState whose names label the channels and whose positions hold the errors.

    Every plotting tool draws a JointState by its names; arrays without labels they can only number. The channels come
    first, then eps_F and eps_T (for efforts: eps), then the same with the mean of each window removed.
    """

    def __init__(self, channels: Sequence[str], wrench: bool) -> None:
        self._wrench = wrench
        names = [*channels, *(('eps_F', 'eps_T') if wrench else ('eps',))]
        self.message = JointState(name=[*names, *(f'{name}_centred' for name in names)])

    def filled(self, errors: HorizonErrors) -> JointState:
        """With the stamp of the origin t of its horizon."""
        message = self.message
        set_stamp(message.header.stamp, errors.origin)
        message.position = [*self._with_means(errors.eps), *self._with_means(errors.eps_centred)]
        return message

    def _with_means(self, eps: Array) -> list[float]:
        values: list[float] = eps.tolist()
        if self._wrench:
            return [*values, sum(values[:3]) / 3, sum(values[3:]) / 3]
        return [*values, sum(values) / len(values)]
