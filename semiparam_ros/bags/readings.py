"""Readings: what a stream of samples needs of a message, whether from a bag or over DDS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from semiparam_ros.bags.alignment import SampleStream
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.stamps import stamp_ns


class Reading(NamedTuple):
    """One message: ``fields`` are what :class:`SampleStream` takes of its kind after the stamp."""

    stamp: int  # [ns]
    frame_id: str
    fields: tuple[Any, ...]


def of_joint_state(message: Any) -> Reading:
    """Reading of a sensor_msgs/JointState."""
    header = message.header
    return Reading(stamp_ns(header.stamp), header.frame_id,
                   (message.name, message.position, message.velocity, message.effort))


def of_wrench(message: Any) -> Reading:
    """Reading of a geometry_msgs/WrenchStamped."""
    header, force, torque = message.header, message.wrench.force, message.wrench.torque
    values = (force.x, force.y, force.z, torque.x, torque.y, torque.z)
    return Reading(stamp_ns(header.stamp), header.frame_id, (header.frame_id, values))


def of_accelerations(message: Any) -> Reading:
    """Reading of a trajectory_msgs/JointTrajectory with one point, else without accelerations."""
    values = message.points[0].accelerations if len(message.points) == 1 else ()
    header = message.header
    return Reading(stamp_ns(header.stamp), header.frame_id, (message.joint_names, values))


def of_temperature(message: Any) -> Reading:
    """Reading of a sensor_msgs/Temperature."""
    header = message.header
    return Reading(stamp_ns(header.stamp), header.frame_id, (header.frame_id, message.temperature))


class Kind(NamedTuple):
    """A kind of message: how it is read, and what of a stream takes its stamp and fields."""

    read: Callable[[Any], Reading]
    feed: Callable[..., list[Sample]]


JOINT_STATE = Kind(of_joint_state, SampleStream.joint_state)
WRENCH = Kind(of_wrench, SampleStream.wrench)
ACCELERATIONS = Kind(of_accelerations, SampleStream.accelerations)
TEMPERATURE = Kind(of_temperature, SampleStream.temperature)
