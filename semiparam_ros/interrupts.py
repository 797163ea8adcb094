"""Ctrl-C before a command listens for it: remembered, for Python may lose it.

A KeyboardInterrupt that is raised where Python ignores exceptions, as in the callback by which an import lets go of its
lock, is printed and forgotten. Of a command that loads for seconds it is then as if nobody had pressed the keys. So it
is raised again.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

AGAIN_S = 0.1
"""An ignored Ctrl-C comes again so much later, when what ignored it is over."""


class Interrupt:
    """Python's own handler of SIGINT, which also remembers that one came."""

    def __init__(self) -> None:
        self.came = False
        self.again: threading.Timer | None = None
        self.usual = sys.unraisablehook

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        signal.default_int_handler(number, frame)

    def ignored(self, what: UnraisableHookArgs) -> None:
        """Take the place of ``sys.unraisablehook`` meanwhile."""
        if issubclass(what.exc_type, KeyboardInterrupt):
            # To the main thread: what it waits in would not end for a signal that another one takes.
            self.again = threading.Timer(AGAIN_S, signal.pthread_kill, [threading.main_thread().ident, signal.SIGINT])
            self.again.daemon = True
            self.again.start()
        else:
            self.usual(what)


@contextmanager
def remember_interrupts() -> Iterator[None]:
    """Remember them; in another thread than the main one, which no signal reaches, do nothing."""
    ours = Interrupt()
    if (threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler):
        signal.signal(signal.SIGINT, ours)
        sys.unraisablehook = ours.ignored
    try:
        yield
    finally:
        if ours.again is not None:
            ours.again.cancel()
        if sys.unraisablehook == ours.ignored:
            sys.unraisablehook = ours.usual
        if signal.getsignal(signal.SIGINT) is ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
