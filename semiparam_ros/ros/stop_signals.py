"""Ctrl-C and SIGTERM: the first asks for an orderly end, a further one ends the process at once."""

from __future__ import annotations

import os
import signal
import termios
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
ONE_KEY_S = 0.5
"""Signals within this time are one wish: a terminal and a launcher both pass on the same Ctrl-C."""


class StopSignals:
    """While it is open, ``stop`` is called once, in a thread, by the first SIGINT or SIGTERM.

    Python calls a signal's handler in the main thread between two instructions, whatever that thread holds: a handler
    that sets the very Event which the main thread is polling can wait for ever for the Event's lock. So the handler
    does nothing, and the signal's number goes through a pipe to a thread, which may wait.

    A signal that comes more than half a second after the first one ends the process with 128 plus its number, whatever
    the main thread is doing. That stays so once a signal has come, until the process has ended.
    """

    def __init__(self, stop: Callable[[], None] = lambda: None) -> None:
        self.signal: int | None = None
        self._stop = stop
        self._first = 0.0
        self._thread = threading.Thread(target=self._listen, name='signals', daemon=True)
        self._usual: dict[int, Any] = {}
        self._terminal = _terminal()

    @property
    def asked(self) -> bool:
        """Whether a signal has come."""
        return self.signal is not None

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():  # only there may handlers be set
            self._read, self._write = os.pipe()
            os.set_blocking(self._write, False)
            self._usual_wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
            self._usual = {number: signal.signal(number, lambda *_: None) for number in SIGNALS}
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
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
        while number := os.read(self._read, 1)[0]:
            if number in SIGNALS:
                self._take(number)

    def _take(self, number: int) -> None:
        if self.signal is None:
            self.signal, self._first = number, time.monotonic()
            self._stop()
        elif time.monotonic() - self._first > ONE_KEY_S:
            self._restore_terminal()
            os._exit(128 + number)

    def _restore_terminal(self) -> None:
        """As it was found: keys are shown again, and the cursor."""
        if self._terminal is not None:
            with suppress(OSError, termios.error):
                if os.tcgetpgrp(0) == os.getpgrp():  # from the background it would stop this process
                    termios.tcsetattr(0, termios.TCSANOW, self._terminal)
        with suppress(OSError):
            if os.isatty(2):
                os.write(2, b'\x1b[?25h')


def _terminal() -> list[Any] | None:
    try:
        return termios.tcgetattr(0)
    except (OSError, termios.error):
        return None
