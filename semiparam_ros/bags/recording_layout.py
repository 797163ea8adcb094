"""Where a recording of this package keeps what: topic names, message types, and conversions of time stamps."""

from __future__ import annotations

from typing import Any

from semiparam_ros.bags.qos import LATCHED, Qos

JOINT_STATES = '/joint_states'
WRENCH = '/wrench'
JOINT_ACCELERATIONS = '/joint_accelerations'
ROBOT_DESCRIPTION = '/robot_description'

TYPES = {JOINT_STATES: 'sensor_msgs/msg/JointState', WRENCH: 'geometry_msgs/msg/WrenchStamped',
         JOINT_ACCELERATIONS: 'trajectory_msgs/msg/JointTrajectory', ROBOT_DESCRIPTION: 'std_msgs/msg/String'}


def default_qos(topic: str) -> Qos:
    """Latched for a robot description (in any namespace), reliable with depth 10 for everything else."""
    return LATCHED if topic.rsplit('/', 1)[-1] == 'robot_description' else Qos()


def stamp_ns(stamp: Any) -> int:
    """A builtin_interfaces/Time in ns."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_fields(stamp: int) -> dict[str, int]:
    """The fields of builtin_interfaces/Time for ``stamp`` [ns]."""
    return {'sec': stamp // 1_000_000_000, 'nanosec': stamp % 1_000_000_000}
