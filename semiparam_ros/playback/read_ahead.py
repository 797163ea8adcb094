"""Reading ahead in a thread of its own, so that unpacking a chunk of the bag delays no message."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterable
from itertools import islice
from queue import Full, Queue
from typing import NamedTuple

from semiparam_ros.playback.player import Item, Timeline

NAME = 'read ahead'
BATCH = 64
BATCHES = 64
_POLL_S = 0.1


class _End(NamedTuple):
    """The last entry of a queue; ``error`` is what ended the reading early."""

    error: Exception | None


class ReadAhead:
    """A timeline that keeps up to ``BATCH * BATCHES`` messages ready."""

    def __init__(self, timeline: Timeline) -> None:
        self._timeline = timeline
        self.start_ns, self.end_ns = timeline.start_ns, timeline.end_ns

    def play(self, from_ns: int) -> Generator[Item, None, None]:
        """Generate items from ``from_ns`` on; closing ends the thread, whose errors come here."""
        queue: Queue[list[Item] | _End] = Queue(BATCHES)
        closing = threading.Event()
        thread = threading.Thread(target=_fill, args=(self._timeline.play(from_ns), queue, closing), name=NAME,
                                  daemon=True)
        thread.start()
        try:
            while not isinstance(batch := queue.get(), _End):
                yield from batch
            if batch.error is not None:
                raise batch.error
        finally:
            closing.set()
            thread.join()


def _fill(items: Iterable[Item], queue: Queue[list[Item] | _End], closing: threading.Event) -> None:
    source = iter(items)
    try:
        # The first message alone: the playback begins with it.
        size = 1
        while batch := list(islice(source, size)):
            if not _put(queue, batch, closing):
                return
            size = BATCH
        _put(queue, _End(None), closing)
    except Exception as error:  # raised again where the items are used
        _put(queue, _End(error), closing)


def _put(queue: Queue[list[Item] | _End], entry: list[Item] | _End, closing: threading.Event) -> bool:
    """Wait for room; False when nobody takes any more."""
    while not closing.is_set():
        try:
            queue.put(entry, timeout=_POLL_S)
            return True
        except Full:
            continue
    return False
