"""A thread for files, so that the one that answers samples never waits for a disk."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar('Result')
PATIENCE_S = 10.0


class FileThread:
    """Does one thing after the other, in the order in which they came.

    :param name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: threading.Thread | None = None

    @property
    def busy(self) -> bool:
        """Tell whether it is doing something."""
        return self._thread is not None and self._thread.is_alive()

    def submit(self, work: Callable[[], Result], done: Callable[[Result | None, Exception | None], object]) -> None:
        """Run ``work()``, then ``done(result, None)`` or ``done(None, error)``, in the thread."""
        before = self._thread

        def run() -> None:
            if before is not None:
                before.join()
            try:
                result = work()
            except Exception as error:
                done(None, error)
            else:
                done(result, None)

        thread = threading.Thread(target=run, name=self._name, daemon=True)
        thread.start()  # or raise where the system has no room for it: then the one before stays the last
        self._thread = thread

    def wait(self) -> None:
        """Return when nothing is being done any more, or when a disk that hangs has been waited for long enough."""
        if self._thread is not None:
            self._thread.join(PATIENCE_S)
