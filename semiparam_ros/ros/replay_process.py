"""rclpy for a tool that has work of its own: started, spun in a thread, and shut down cleanly on signals."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from types import TracebackType

import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, try_shutdown

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.spinning import spin_for
from semiparam_ros.ros.stop_signals import StopSignals

SPIN_S = 0.2


class RosProcess:
    """Context manager around one node's life.

    :param ros_arguments: ``--ros-args ...`` as given by the user
    :param stop: called by the first SIGINT or SIGTERM (see :class:`StopSignals`), and when a callback failed, which
        ``error`` then holds; always in a thread other than the main one
    """

    def __init__(self, ros_arguments: Sequence[str], stop: Callable[[], None]) -> None:
        self._arguments = list(ros_arguments)
        self._stop = stop
        self._node: Node | None = None
        self._thread: threading.Thread | None = None
        self._closing = False
        self._signals = StopSignals(stop)
        self.error: Exception | None = None

    def __enter__(self) -> RosProcess:
        try:
            # Our own handlers: rclpy's would invalidate the context before the account is told.
            rclpy.init(args=[sys.argv[0], *self._arguments], signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # rcl complains about arguments in exceptions of several kinds
            sentence = str(error).splitlines()[0].split(', at /')[0].rstrip('.')
            raise SemiparamError(f'the ROS arguments are refused: {sentence}.') from None
        self._signals.__enter__()
        return self

    def spin(self, node: Node) -> None:
        """Serve the node's callbacks in a thread of their own from now on; the node is destroyed at the end."""
        self._node = node
        self._thread = threading.Thread(target=self._spin, args=(node,), name='executor', daemon=True)
        self._thread.start()

    def _spin(self, node: Node) -> None:
        executor = EventsExecutor()
        executor.add_node(node)
        try:
            while ok() and not self._closing:
                spin_for(executor, SPIN_S)
        except Exception as error:  # raised by a callback: told by whoever runs the tool, not by this thread
            self.error = error
            self._stop()
        finally:
            executor.shutdown()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._closing = True
        if self._thread is not None:
            self._thread.join()
        if self._node is not None:
            self._node.destroy_node()
        try_shutdown()
        self._signals.__exit__(kind, error, trace)
