"""What is called in the executor's thread."""

import subprocess
import sys
import threading
import time

import pytest
import rclpy
from rclpy.node import Node

from semiparam_ros.ros.context import RosProcess, call_in_executor, destroyed_on_failure
from support.node_client import PATIENCE_S
from support.replay_peers import EVERYTHING, Peer


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


def test_spinning_stops_while_more_comes_than_is_handled(ros_domain):
    with RosProcess([], lambda: None) as ros:
        node, begun = Node('busy'), threading.Event()
        end = time.monotonic() + PATIENCE_S / 10

        def again() -> None:
            begun.set()
            if time.monotonic() < end:
                node.executor.create_task(again)

        ros.spin(node)
        node.executor.create_task(again)
        assert begun.wait(PATIENCE_S)
        ros.stop_spinning()
        assert time.monotonic() < end


def test_a_node_whose_construction_fails_is_gone_before_rclpy_is_shut_down(ros_domain):
    class Failing(Node):
        def __init__(self):
            super().__init__('failing')
            with destroyed_on_failure(self):
                fail()

    with RosProcess([], lambda: None) as ros:
        other = Node('other')
        ros.spin(other)
        with pytest.raises(KeyError, match='of the function') as raised:
            Failing()
        assert 'failing' not in other.get_node_names()
    del raised


ACKNOWLEDGED = """
import rclpy
from rclpy.duration import Duration
from std_msgs.msg import Bool
from semiparam_ros.ros.context import RosProcess
from support.replay_peers import EVERYTHING
with RosProcess([], lambda: None) as ros:
    node = rclpy.create_node('ends')
    ros.spin(node)
    publisher = node.create_publisher(Bool, 'last', EVERYTHING)
    print('ready', flush=True)
    input()
    # A busy machine may take longer, once: by itself the middleware asks after 3 s each time.
    for _ in range(10):
        publisher.publish(Bool())
        if publisher.wait_for_all_acked(Duration(seconds=2.5)):
            break
        assert publisher.wait_for_all_acked(Duration(seconds=60))
    else:
        raise AssertionError('never in time')
"""


def test_that_a_message_has_arrived_is_known_before_the_middleware_would_ask_by_itself(ros_domain, repository):
    """Fast DDS asks after 3 s: every end of a node would take as long."""
    with Peer() as peer, subprocess.Popen([sys.executable, '-c', ACKNOWLEDGED], stdin=subprocess.PIPE, text=True,
                                          stdout=subprocess.PIPE, cwd=repository / 'test') as process:
        peer.listen('/last', 'std_msgs/msg/Bool', EVERYTHING)
        assert process.stdout.readline() == 'ready\n'
        peer.meet('/ends')
        process.communicate('\n', timeout=PATIENCE_S)
        assert process.returncode == 0


REPLACED = """
import sys, time
import rclpy
from rclpy.qos import qos_profile_sensor_data, qos_profile_system_default
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from semiparam_ros.ros.context import RosProcess, call_in_executor, destroyed_on_failure
from semiparam_ros.ros.estimator.subscriptions import InputStream
from semiparam_ros.ros.record.node import RecordNode
from semiparam_ros.ros.record.options import Limits
from semiparam_ros.settings.snapshot import Settings
other = rclpy.Context()
rclpy.init(context=other)
source = rclpy.create_node('source', context=other)

def offer():
    publisher = source.create_publisher(WrenchStamped, '/wrench', qos_profile_sensor_data)
    time.sleep(0.3)
    return publisher

def replace():
    follow()
    offer()  # the replaced subscription does not match it, and is not forgotten before this function returns

with RosProcess([], lambda: None) as ros:
    if sys.argv[1] == 'record':
        node = RecordNode(None, Limits())
        follow = lambda: node.follow('/wrench', 'geometry_msgs/msg/WrenchStamped')
        follow()
    else:
        node = Node('node')
        settings = Settings.from_mapping({'sensor_frame': 'tool', 'reliability': 'auto'})
        follow = InputStream(node, settings, None, None).follow_reliability
    ros.spin(node)
    time.sleep(0.3)
    offer()
    call_in_executor(node, replace)
    end = time.monotonic() + 60.0
    while (count := source.count_subscribers('/wrench')) != 1 and time.monotonic() < end:  # one goes, another comes
        time.sleep(0.1)
    print(call_in_executor(node, lambda: 'alive'), count, flush=True)
"""


@pytest.mark.parametrize('who', ['record', 'estimator'])
def test_a_subscription_is_replaced_while_another_publisher_comes(ros_domain, repository, who):
    """rclpy ended the process where an event of the replaced one still waited in its executor's queue."""
    done = subprocess.run([sys.executable, '-c', REPLACED, who], capture_output=True, text=True, timeout=60.0,
                          cwd=repository / 'test', check=False)
    assert done.stdout.splitlines()[-1:] == ['alive 1'], done.stdout + done.stderr
