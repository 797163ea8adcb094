"""rclpy for a tool that has work of its own: started, spun in a thread, and shut down cleanly on signals."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Sequence
from types import FrameType, TracebackType
from typing import Any

import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import ok, try_shutdown

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.spinning import spin_for

SPIN_S = 0.2
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class RosProcess:
    """Context manager around one node's life.

    :param ros_arguments: ``--ros-args ...`` as given by the user
    :param stop: called once by the first SIGINT or SIGTERM (a second one has its default effect), and when a
        callback failed, which ``error`` then holds
    """

    def __init__(self, ros_arguments: Sequence[str], stop: Callable[[], None]) -> None:
        self._arguments = list(ros_arguments)
        self._stop = stop
        self._node: Node | None = None
        self._thread: threading.Thread | None = None
        self._closing = False
        self._handlers: dict[int, Any] = {}
        self.signal: int | None = None
        self.error: Exception | None = None

    def __enter__(self) -> RosProcess:
        try:
            # Our own handlers: rclpy's would invalidate the context before the account is told.
            rclpy.init(args=[sys.argv[0], *self._arguments], signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # rcl complains about arguments in exceptions of several kinds
            sentence = str(error).splitlines()[0].split(', at /')[0].rstrip('.')
            raise SemiparamError(f'the ROS arguments are refused: {sentence}.') from None
        if threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._on_signal) for number in _SIGNALS}
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

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        self.signal = number
        self._restore_signals()
        self._stop()

    def _restore_signals(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self._closing = True
        if self._thread is not None:
            self._thread.join()
        if self._node is not None:
            self._node.destroy_node()
        self._restore_signals()
        try_shutdown()
