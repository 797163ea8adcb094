"""The node from its launch file, as `ros2 launch` starts it: it reports, and ends without an error.

launch and launch_testing come with a ROS 2 installation, not from the package index. There, with
the workspace sourced: ``launch_test test/test_launch.py``.
"""

import time
import unittest

import pytest

pytest.importorskip('launch_testing', reason='launch_testing comes with ROS 2, not from PyPI')

import launch_testing
import launch_testing.actions
import launch_testing.asserts
import launch_testing.markers
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

PATIENCE_S = 60.0
TITLES = {'inputs', 'timing', 'learning', 'model', 'parameters', 'feedforward', 'checkpoints',
          'diagnosis', 'changes', 'errors'}
EXPECTED = {f'estimator: {title}' for title in TITLES}


@pytest.mark.launch_test
@launch_testing.markers.keep_alive
def generate_test_description():
    """The bundled arm: robot_state_publisher gives its description, the estimator takes it."""
    robot = PathJoinSubstitution([FindPackageShare('semiparam_ros'), 'launch', 'robot.launch.py'])
    ready = launch_testing.actions.ReadyToTest()
    return LaunchDescription([IncludeLaunchDescription(robot), ready])


class TestWhileItRuns(unittest.TestCase):
    def test_every_status_comes(self):
        rclpy.init()
        node, heard = rclpy.create_node('listener'), set()
        node.create_subscription(
            DiagnosticArray, '/diagnostics',
            lambda message: heard.update(status.name for status in message.status), 10)
        end = time.monotonic() + PATIENCE_S
        while not heard >= EXPECTED and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.5)
        node.destroy_node()
        rclpy.shutdown()
        assert heard >= EXPECTED


@launch_testing.post_shutdown_test()
class TestAfterwards(unittest.TestCase):
    def test_every_process_ended_well(self, proc_info):
        launch_testing.asserts.assertExitCodes(proc_info)
