"""The process of the node: rclpy started, the executor's loop, and a clean end on SIGINT and SIGTERM."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, try_shutdown

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.estimator_node import EstimatorNode
from semiparam_ros.ros.realtime import take_priority
from semiparam_ros.ros.spinning import spin_for
from semiparam_ros.ros.stop_signals import StopSignals

RCLError = rclpy_implementation.RCLError
SPIN_S = 0.2


def run_estimator(ros_arguments: Sequence[str]) -> int:
    """Run the node until a signal ends it; raises SemiparamError when it cannot start."""
    with StopSignals() as stop:
        return _run(ros_arguments, stop)


def _run(ros_arguments: Sequence[str], stop: StopSignals) -> int:
    _start(ros_arguments)
    try:
        # This executor takes a third of what rclpy's others take.
        executor = EventsExecutor()
        node = _new_node(executor.create_task)
        try:
            executor.add_node(node)
            refused = take_priority(node.settings.realtime_priority)
            if refused:
                node.get_logger().warning(refused)
            _keep_collector_out()
            while ok() and not stop.asked:
                try:
                    spin_for(executor, SPIN_S)
                except Exception as error:  # of a callback that does not handle its own
                    node.failed('a callback', error)
        finally:
            executor.remove_node(node)
            node.close()
    finally:
        try_shutdown()
    return 0


def _start(ros_arguments: Sequence[str]) -> None:
    try:
        # Our own handlers: rclpy's would end the context before the node has left the graph.
        rclpy.init(args=[sys.argv[0], *ros_arguments], signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl complains about arguments in exceptions of several kinds
        raise SemiparamError(f'the ROS arguments are refused: {_sentence(error)}') from None


def _new_node(later: Callable[[Callable[[], None]], object]) -> EstimatorNode:
    try:
        return EstimatorNode(later)
    except RCLError as error:  # such as a security enclave that the middleware refuses
        raise SemiparamError(f'the node cannot start: {_sentence(error)}') from None


def _sentence(error: Exception) -> str:
    """rcl's message without the places in its own sources."""
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    return text.split(', at /')[0].rstrip('.') + '.'


def _keep_collector_out() -> None:
    """What is loaded now stays for good: the cyclic garbage collector need not look at it while samples come."""
    gc.collect()
    gc.freeze()
