"""Keys of a running playback: read one by one from a real terminal, which is left as it was found."""

from __future__ import annotations

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Mapping

HELP = 'space: pause or go on, right arrow: next message'
RATE_HELP = ', up and down arrow: 10 % faster or slower'
KEYS = {b' ': 'pause', b'\x1b[C': 'next', b'\x1bOC': 'next', b'\x1b[A': 'faster', b'\x1bOA': 'faster',
        b'\x1b[B': 'slower', b'\x1bOB': 'slower'}

_POLL_S = 0.2
_ESCAPE = b'\x1b'


def split_keys(data: bytes) -> list[bytes]:
    """The single keys in what one read returned: an escape sequence of three bytes is one key."""
    keys = []
    while data:
        length = 3 if data.startswith(_ESCAPE) and len(data) >= 3 else 1
        keys.append(data[:length])
        data = data[length:]
    return keys


class Keyboard:
    """Context manager: while it is open, each known key calls its action; does nothing without a terminal.

    :param actions: what to call for 'pause', 'next', 'faster' and 'slower'
    """

    def __init__(self, actions: Mapping[str, Callable[[], object]], enabled: bool) -> None:
        self._actions = actions
        self._descriptor = sys.stdin.fileno() if enabled and is_foreground_terminal() else None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._listen, name='keyboard', daemon=True)
        self._saved: list[int | list[bytes | int]] = []

    @property
    def active(self) -> bool:
        """Tell whether keys are being read."""
        return self._descriptor is not None

    def __enter__(self) -> Keyboard:
        if self._descriptor is not None:
            self._saved = termios.tcgetattr(self._descriptor)
            # Not raw: Ctrl-C still sends SIGINT and the output keeps its line ends.
            tty.setcbreak(self._descriptor, termios.TCSANOW)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        if self._descriptor is not None:
            self._thread.join()
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._saved)

    def _listen(self) -> None:
        assert self._descriptor is not None
        while not self._closing.is_set():
            if not select.select([self._descriptor], [], [], _POLL_S)[0]:
                continue
            data = os.read(self._descriptor, 64)
            if not data:
                return
            for key in split_keys(data):
                action = self._actions.get(KEYS.get(key, ''))
                if action is not None:
                    action()


def is_foreground_terminal() -> bool:
    """Tell whether this process may read standard input, a terminal; a background job may not."""
    try:
        return sys.stdin.isatty() and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except (OSError, ValueError, AttributeError):
        return False
