"""The estimator on a recording, without losing a sample; everything ends with the recording.

    ros2 launch semiparam_ros replay.launch.py bag:=recording.mcap params_file:=my_arm.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, IncludeLaunchDescription, RegisterEventHandler
from launch.conditions import IfCondition, UnlessCondition
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare('semiparam_ros')
PARAMS = PathJoinSubstitution([SHARE, 'config', 'icub_right_arm.yaml'])


def generate_launch_description() -> LaunchDescription:
    """Arguments, the estimator, and the replay in one of its two paces."""
    arguments = [
        DeclareLaunchArgument('bag', default_value=PathJoinSubstitution([SHARE, 'bags', 'icub_xy.mcap']),
                              description='Recording to play.'),
        DeclareLaunchArgument('params_file', default_value=PARAMS,
                              description='ROS parameter file of the estimator.'),
        DeclareLaunchArgument('rate', default_value='1.0', description='Recorded seconds played in a second.'),
        DeclareLaunchArgument('lossless', default_value='true',
                              description='As fast as the estimator follows, whatever the rate.'),
    ]
    bag, rate, lossless = (LaunchConfiguration(name) for name in ('bag', 'rate', 'lossless'))
    estimator = IncludeLaunchDescription(
        PathJoinSubstitution([SHARE, 'launch', 'estimator.launch.py']),
        launch_arguments={'params_file': LaunchConfiguration('params_file')}.items())
    followed = replay([bag, '--as-fast-as-followed'], IfCondition(lossless))
    timed = replay([bag, '--rate', rate, '--wait-for-subscribers'], UnlessCondition(lossless))
    ends = [RegisterEventHandler(OnProcessExit(target_action=player, on_exit=[EmitEvent(event=Shutdown())]))
            for player in (followed, timed)]
    return LaunchDescription([*arguments, *ends, estimator, followed, timed])


def replay(arguments: list, condition: IfCondition) -> Node:
    """The tool as a process; the keyboard belongs to `ros2 launch`."""
    return Node(package='semiparam_ros', executable='bag_replay', output='screen', condition=condition,
                arguments=[*arguments, '--disable-keyboard-controls'])
