"""rclpy started, spun and shut down cleanly on signals, the same way for every process."""

from __future__ import annotations

import concurrent.futures
import os
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TypeVar

import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import Executor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.timer import Timer
from rclpy.utilities import ok, try_shutdown

from semiparam_ros.errors import SemiparamError
from semiparam_ros.interrupts import Interrupt

SIGNALS = (signal.SIGINT, signal.SIGTERM)
ONE_KEY_S = 0.5
"""Signals within this time are one wish: a terminal and a launcher both pass on the same Ctrl-C."""

SPIN_S = 0.2
CALL_S = 10.0
DELIVER_S = 3.5
"""Time [s] that subscribers may take at the end to receive the last messages: Fast DDS sends again
after 3 s, or with our profile after 0.2 s, what was missed."""

PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
"""Variables of the environment that Fast DDS reads in ROS 2 Jazzy, and in later ones."""

Result = TypeVar('Result')


class StopSignals:
    """While it is open, ``stop`` is called once, in a thread, by the first SIGINT or SIGTERM.

    Python calls a signal's handler in the main thread between two instructions, whatever that thread holds: a handler
    that sets the very Event which the main thread is polling can wait for ever for the Event's lock. So the handler
    does nothing, and the signal's number goes through a pipe to a thread, which may wait.

    A signal that comes more than half a second after the first one ends the process with 128 plus its number, whatever
    the main thread is doing. That stays so once a signal has come, until the process has ended. A Ctrl-C of before
    counts too, see :mod:`semiparam_ros.interrupts`.
    """

    def __init__(self, stop: Callable[[], None] = lambda: None) -> None:
        self.signal: int | None = None
        self._stop = stop
        self._first = 0.0
        self._thread = threading.Thread(target=self._listen, name='signals', daemon=True)
        self._usual: dict[int, Callable[[int, FrameType | None], object] | int | None] = {}
        self._terminal = _terminal()

    @property
    def asked(self) -> bool:
        """Tell whether a signal has come."""
        return self.signal is not None

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():  # only there may handlers be set
            self._read, self._write = os.pipe()
            os.set_blocking(self._write, False)
            self._usual_wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
            self._usual = {number: signal.signal(number, lambda *_: None) for number in SIGNALS}
            self._thread.start()
            before = self._usual[signal.SIGINT]
            if isinstance(before, Interrupt) and before.came:
                os.write(self._write, bytes([signal.SIGINT]))
        return self

    def __exit__(self, *_: object) -> None:
        if self.asked or not self._usual:
            return
        for number, handler in self._usual.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._usual_wakeup)
        os.write(self._write, b'\0')
        self._thread.join()
        for descriptor in (self._read, self._write):
            os.close(descriptor)

    def _listen(self) -> None:
        came = b''
        while 0 not in came:
            came = os.read(self._read, 64)  # what waits came at the same time, however late this thread has its turn
            number = next(filter(SIGNALS.__contains__, came), None)
            if number is not None:
                self._take(number)

    def _take(self, number: int) -> None:
        if self.signal is None:
            self.signal, self._first = number, time.monotonic()
            self._stop()
        elif time.monotonic() - self._first > ONE_KEY_S:
            self._restore_terminal()
            os._exit(128 + number)

    def _restore_terminal(self) -> None:
        """Restore the terminal as it was found: keys are shown again, and the cursor."""
        if self._terminal is not None:
            with suppress(OSError, termios.error):
                if os.tcgetpgrp(0) == os.getpgrp():  # from the background it would stop this process
                    termios.tcsetattr(0, termios.TCSANOW, self._terminal)
        with suppress(OSError):
            if os.isatty(2):
                os.write(2, b'\x1b[?25h')


def _terminal() -> list[int | list[bytes | int]] | None:
    try:
        return termios.tcgetattr(0)
    except (OSError, termios.error):
        return None


REPLACEABLE = SubscriptionEventCallbacks(use_default_callbacks=False)
"""What a subscription is made with that may be destroyed while an EventsExecutor spins: no events.

An event (here of a publisher whose quality of service does not match) that still waits in the
executor's queue when its subscription is gone is let go of without the interpreter's lock, a
segmentation fault (rclpy 7.1.6). Messages, timers and clients may wait there.
"""


def spin_for(executor: Executor, seconds: float, ended: Future) -> None:
    """Handle whatever comes within so many seconds, or until ``ended`` is done, whatever waits then.

    The EventsExecutor looks at the time only when nothing waits: while messages come faster than they are handled
    ``ended`` alone ends it.

    Its spin() never sleeps without a timeout, and spin_once() returns after each message, which costs a fifth of taking
    it; waiting for a future does neither.
    """
    executor.spin_until_future_complete(ended, timeout_sec=seconds)


def steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """A timer by the machine's own clock: a simulated one follows a recording's speed, or stands
    still."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def call_in_executor(node: Node, function: Callable[[], Result]) -> Result:
    """Call it in the thread in which the node's executor spins, and return what it returns or raise what it raises.

    Whatever a node gets or loses while an EventsExecutor spins goes this way: a subscription that another thread makes
    can end the process with a segmentation fault. So does a task that raises, hence the future. Before the node has an
    executor the function is called directly. Raises SemiparamError when the executor does not come to it.
    """
    if node.executor is None:
        return function()
    outcome: concurrent.futures.Future[Result] = concurrent.futures.Future()

    def call() -> None:
        try:
            outcome.set_result(function())
        except BaseException as error:
            outcome.set_exception(error)

    node.executor.create_task(call)
    concurrent.futures.wait([outcome], CALL_S)
    if not outcome.done():
        raise SemiparamError(f'the executor of {node.get_name()} has not answered for {CALL_S:g} s.')
    return outcome.result()


@contextmanager
def destroyed_on_failure(node: Node) -> Iterator[None]:
    """Destroy a node whose construction fails. The error would keep it until rclpy is shut down, and
    its end after that may be a segmentation fault."""
    try:
        yield
    except BaseException:
        node.destroy_node()
        raise


def start_rclpy(ros_arguments: Sequence[str]) -> None:
    """Start rclpy with the user's ``--ros-args ...``; raises SemiparamError with rcl's reason where it refuses them.

    Fast DDS gets our profile unless the user has one of his own; other middlewares do not know it.
    """
    if not any(name in os.environ for name in PROFILES):
        os.environ[PROFILES[0]] = str(Path(__file__).parent / 'fast_dds.xml')
    try:
        # Our own handlers: rclpy's would end the context before the node has left the graph or told its account.
        rclpy.init(args=[sys.argv[0], *ros_arguments], signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl complains about arguments in exceptions of several kinds
        raise SemiparamError(f'the ROS arguments are refused: {rcl_reason(error)}') from None


def rcl_reason(error: Exception) -> str:
    """rcl's message without the places in its own sources."""
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    return text.split(', at /')[0].rstrip('.') + '.'


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
        self._closing = Future()
        self._signals = StopSignals(stop)
        self.error: Exception | None = None

    def __enter__(self) -> RosProcess:
        start_rclpy(self._arguments)
        self._signals.__enter__()
        return self

    def spin(self, node: Node) -> None:
        """Serve the node's callbacks in a thread of their own from now on; the node is destroyed at the end."""
        self._node, executor = node, EventsExecutor()
        executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, args=(executor,), name='executor', daemon=True)
        self._thread.start()

    def _spin(self, executor: Executor) -> None:
        try:
            while ok() and not self._closing.done():
                spin_for(executor, SPIN_S, self._closing)
        except Exception as error:  # raised by a callback: told by whoever runs the tool, not by this thread
            self.error = error
            self._stop()
        finally:
            executor.shutdown()

    def stop_spinning(self) -> None:
        """Stop serving callbacks; what arrives stays with the subscriptions."""
        self._closing.set_result(None)
        if self._thread is not None:
            self._thread.join()

    def __exit__(self, *_: object) -> None:
        self.stop_spinning()
        if self._node is not None:
            self._node.destroy_node()
        try_shutdown()
        self._signals.__exit__()
