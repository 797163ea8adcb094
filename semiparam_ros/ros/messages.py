"""From numbers to messages; those that are published at the rate of the sensor are made as bytes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import InertiaStamped

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.types import Array
from semiparam_ros.ros.estimates import Payload
from semiparam_ros.ros.serialised import Layout, joint_state_layout, wrench_layout


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


class ValueMessage:
    """Wrenches or efforts as serialised messages."""

    def __init__(self, joints: Sequence[str] | None = None) -> None:
        """:param joints: whose efforts sensor_msgs/JointState holds; None for geometry_msgs/WrenchStamped."""
        self._joints = joints
        self._frame_id: str | None = None

    def filled(self, stamp: int, frame_id: str, values: Array) -> bytes:
        """With a stamp [ns], and a wrench (6,) in N and N m or efforts (n_joints,) in N m."""
        if frame_id != self._frame_id:
            self._frame_id, self._layout = frame_id, self._laid_out(frame_id)
        return self._layout.write(stamp, values.tolist())

    def _laid_out(self, frame_id: str) -> Layout:
        if self._joints is None:
            return wrench_layout(frame_id)
        return joint_state_layout(frame_id, self._joints, 0, 0, len(self._joints))


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
