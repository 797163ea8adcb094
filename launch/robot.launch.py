"""A robot's URDF on robot_description, and the estimator that takes it from there.

    ros2 launch semiparam_ros robot.launch.py urdf:=my_arm.urdf params_file:=my_arm.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import Command, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('semiparam_ros')
PARAMS = PathJoinSubstitution([SHARE, 'config', 'icub_right_arm.yaml'])


def generate_launch_description() -> LaunchDescription:
    """Arguments, the publisher of the description and of tf, and the estimator."""
    arguments = [
        DeclareLaunchArgument('urdf', default_value=PathJoinSubstitution([SHARE, 'config', 'icub_right_arm.urdf']),
                              description='URDF file of the robot.'),
        DeclareLaunchArgument('params_file', default_value=PARAMS,
                              description='ROS parameter file of the estimator.'),
    ]
    # Command splits its text as a shell does: a path may hold blanks.
    description = ParameterValue(Command(['cat "', LaunchConfiguration('urdf'), '"']), value_type=str)
    publisher = Node(package='robot_state_publisher', executable='robot_state_publisher', output='screen',
                     parameters=[{'robot_description': description}])
    estimator = IncludeLaunchDescription(
        PathJoinSubstitution([SHARE, 'launch', 'estimator.launch.py']),
        launch_arguments={'params_file': LaunchConfiguration('params_file')}.items())
    return LaunchDescription([*arguments, publisher, estimator])
