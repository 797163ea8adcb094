"""One topic's rows by time, read at any stamp in between."""

from __future__ import annotations

from collections import deque

from semiparam_ros.core.types import Array


class Track:
    """Rows (n,) at strictly increasing stamps [ns], interpolated linearly.

    Rows are read at strictly increasing stamps too, so that those behind the last reading can be forgotten.
    """

    def __init__(self, longest_gap_ns: int) -> None:
        """:param longest_gap_ns: two rows further apart are not interpolated."""
        self._longest_gap = longest_gap_ns
        self._stamps: deque[int] = deque()
        self._rows: deque[Array] = deque()

    def __len__(self) -> int:
        return len(self._stamps)

    def append(self, stamp: int, row: Array) -> None:
        """Add the row that follows."""
        self._stamps.append(stamp)
        self._rows.append(row)

    def forget_oldest(self) -> None:
        """Drop one row."""
        self._stamps.popleft()
        self._rows.popleft()

    def clear(self) -> None:
        """Drop all rows."""
        self._stamps.clear()
        self._rows.clear()

    def decided(self, stamp: int) -> bool:
        """Whether no further row can change what :meth:`at` returns for ``stamp``; forgets rows before it."""
        stamps = self._stamps
        while len(stamps) > 1 and stamps[1] <= stamp:
            self.forget_oldest()
        return bool(stamps) and (stamps[0] >= stamp or len(stamps) > 1)

    def at(self, stamp: int) -> Array | None:
        """The row at ``stamp``, once that is decided; None before the first row and inside a gap that is too long."""
        first = self._stamps[0]
        if first == stamp:
            return self._rows[0]
        if first > stamp:
            return None
        second = self._stamps[1]
        if second - first > self._longest_gap:
            return None
        row = self._rows[0]
        return row + (stamp - first) / (second - first) * (self._rows[1] - row)
