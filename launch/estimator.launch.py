"""The estimator beside a running robot, which publishes joint states, wrenches and its robot_description.

    ros2 launch semiparam_ros estimator.launch.py params_file:=my_arm.yaml joint_states:=/arm/joint_states
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

TOPICS = ('joint_states', 'wrench', 'joint_accelerations', 'temperature', 'robot_description', 'desired_trajectory')


def generate_launch_description() -> LaunchDescription:
    """Arguments, then the node."""
    default = PathJoinSubstitution([FindPackageShare('semiparam_ros'), 'config', 'estimator.yaml'])
    arguments = [
        DeclareLaunchArgument('params_file', default_value=default, description='ROS parameter file of the node.'),
        DeclareLaunchArgument('namespace', default_value='', description='Namespace, such as left_arm.'),
        DeclareLaunchArgument('name', default_value='estimator', description='Name of the node.'),
        DeclareLaunchArgument('use_sim_time', default_value='false', description='Follow /clock.'),
        *(DeclareLaunchArgument(topic, default_value=topic, description=f'Topic to take for {topic}.')
          for topic in TOPICS),
    ]
    estimator = Node(
        package='semiparam_ros', executable='estimator', name=LaunchConfiguration('name'),
        namespace=LaunchConfiguration('namespace'), output='screen',
        parameters=[LaunchConfiguration('params_file'),
                    {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}],
        remappings=[(topic, LaunchConfiguration(topic)) for topic in TOPICS])
    return LaunchDescription([*arguments, estimator])
