"""Ctrl-C before a command listens for it: remembered, for Python may lose it.

A KeyboardInterrupt that is raised where Python ignores exceptions, as in the callback by which an import lets go of its
lock, is printed and forgotten. Of a command that loads for seconds it is then as if nobody had pressed the keys.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """Python's own handler of SIGINT, which also remembers that one came."""

    def __init__(self) -> None:
        self.came = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        signal.default_int_handler(number, frame)


@contextmanager
def remember_interrupts() -> Iterator[None]:
    """Remember them; in another thread than the main one, which no signal reaches, do nothing."""
    ours = Interrupt()
    if (threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler):
        signal.signal(signal.SIGINT, ours)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
