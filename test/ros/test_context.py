"""What is called in the executor's thread."""

import threading

import pytest
import rclpy
from rclpy.node import Node

from semiparam_ros.ros.context import RosProcess, call_in_executor


def thread_name() -> str:
    return threading.current_thread().name


def fail() -> None:
    raise KeyError('of the function')


def test_a_function_runs_in_the_executors_thread_and_what_it_raises_comes_back(ros_domain):
    with RosProcess([], lambda: None) as ros:
        node = Node('called')
        assert call_in_executor(node, thread_name) == thread_name()
        ros.spin(node)
        assert call_in_executor(node, thread_name) == 'executor'
        for _ in range(3):  # a task that raises would end the process
            with pytest.raises(KeyError, match='of the function'):
                call_in_executor(node, fail)
        assert call_in_executor(node, thread_name) == 'executor'
        assert ros.error is None
    assert not rclpy.ok()
