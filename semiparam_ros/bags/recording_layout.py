"""Layout of this package's recordings: topic names and message types."""

from __future__ import annotations

from semiparam_ros.bags.qos import LATCHED, Qos

JOINT_STATES = '/joint_states'
WRENCH = '/wrench'
JOINT_ACCELERATIONS = '/joint_accelerations'
TEMPERATURE = '/temperature'
ROBOT_DESCRIPTION = '/robot_description'

TYPES = {JOINT_STATES: 'sensor_msgs/msg/JointState', WRENCH: 'geometry_msgs/msg/WrenchStamped',
         JOINT_ACCELERATIONS: 'trajectory_msgs/msg/JointTrajectory', TEMPERATURE: 'sensor_msgs/msg/Temperature',
         ROBOT_DESCRIPTION: 'std_msgs/msg/String'}


def default_qos(topic: str) -> Qos:
    """Latched for a robot description (in any namespace), reliable with depth 10 for everything else."""
    return LATCHED if topic.rsplit('/', 1)[-1] == 'robot_description' else Qos()
