"""How far a recording is: one changing line on a terminal, a line now and then everywhere else."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Protocol

from rich.console import Console
from rich.status import Status

LINE_S = 10.0


class Recording(Protocol):
    """What is shown."""

    @property
    def messages(self) -> int:
        """Messages written."""


class RecordProgress:
    """Context manager; :meth:`update` is to be called every now and then."""

    def __init__(self, recording: Recording, console: Console, shown: bool = True) -> None:
        self._recording = recording
        self._console = console
        self._shown = shown
        self._status: Status | None = console.status('') if shown and console.is_terminal else None
        self._began = self._told = time.monotonic()

    def __enter__(self) -> RecordProgress:
        if self._status is not None:
            self.update()
            self._status.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._status is not None:
            self._status.stop()

    def update(self) -> None:
        """Show the present figures."""
        if self._status is not None:
            self._status.update(f'recording, Ctrl-C ends: {self._line()}')
        elif self._shown and time.monotonic() - self._told > LINE_S:
            self._told = time.monotonic()
            self._console.print(self._line(), highlight=False, soft_wrap=True)

    def _line(self) -> str:
        return f'{time.monotonic() - self._began:.0f} s, {self._recording.messages} messages'
