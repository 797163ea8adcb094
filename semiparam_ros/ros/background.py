"""A process beside the node, for what takes seconds: the node goes on receiving, predicting and learning.

A thread would not do: it would share the interpreter's lock with the callbacks, and samples would be late.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

Done = Callable[[Any, BaseException | None], None]
NICENESS = 5


class Background(Protocol):
    """Runs functions elsewhere and hands their results back to the caller's own thread, in order."""

    def submit(self, function: Callable[..., Any], *arguments: Any, done: Done) -> None:
        """Run ``function(*arguments)``, then ``done(result, None)`` or ``done(None, error)``."""

    def later(self, function: Callable[[], None]) -> None:
        """Run ``function`` in the caller's thread as soon as what already waits there is done."""


class ProcessBackground:
    """One process, started at once so that it is warm when it is needed, and replaced should it die.

    :param later: hands a function over to the executor's thread.
    """

    def __init__(self, later: Callable[[Callable[[], None]], object]) -> None:
        self._later = later
        self._pool = _new_pool()

    def submit(self, function: Callable[..., Any], *arguments: Any, done: Done) -> None:
        """See :class:`Background`."""
        try:
            future = self._pool.submit(function, *arguments)
        except BrokenProcessPool:
            self._pool = _new_pool()
            future = self._pool.submit(function, *arguments)
        future.add_done_callback(lambda finished: self._later(lambda: _finish(finished, done)))

    def later(self, function: Callable[[], None]) -> None:
        """See :class:`Background`."""
        self._later(function)

    def close(self) -> None:
        """End the process, whatever it is doing."""
        for process in list((self._pool._processes or {}).values()):
            process.terminate()
        # Waiting costs nothing now, and spares the interpreter's end a pool that is half closed.
        self._pool.shutdown(wait=True, cancel_futures=True)


class InlineBackground:
    """The same interface without a process: everything happens at once. For tests and for offline use."""

    def submit(self, function: Callable[..., Any], *arguments: Any, done: Done) -> None:
        """See :class:`Background`."""
        try:
            result = function(*arguments)
        except Exception as error:
            done(None, error)
        else:
            done(result, None)

    def later(self, function: Callable[[], None]) -> None:
        """See :class:`Background`."""
        function()


def _finish(future: Future[Any], done: Done) -> None:
    if future.cancelled():
        return
    error = future.exception()
    done(None if error else future.result(), error)


def _new_pool() -> ProcessPoolExecutor:
    pool = ProcessPoolExecutor(1, multiprocessing.get_context('spawn'), initializer=_prepare)
    pool.submit(_warm)
    return pool


def _prepare() -> None:
    """In the process: leave Ctrl-C to the node, yield to it, and end when it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(0)


def _warm() -> None:
    """Import the numerics."""
    import semiparam_ros.ros.jobs  # noqa: F401
