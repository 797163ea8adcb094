"""Telling a clock that has jumped back (a recording played in a loop) from single messages with a wrong stamp."""

from __future__ import annotations

from typing import NamedTuple

from semiparam_ros.bags.readings import Reading

NEEDED = 5


class Held(NamedTuple):
    """A message that came with a stamp before the last one."""

    topic: str
    reading: Reading


class ClockWatch:
    """Holds back refused messages until ``needed`` of one topic in a row agree with each other."""

    def __init__(self, needed: int = NEEDED) -> None:
        self._needed = needed
        self._held: list[Held] = []

    def accepted(self, topic: str) -> None:
        """The topic goes on as before: its messages that went back were wrong."""
        if self._held:
            self._held = [held for held in self._held if held.topic != topic]

    def refused(self, topic: str, reading: Reading) -> list[Held]:
        """A message went back in time; once the clock must have jumped, all that were held, in order of arrival."""
        own = [held for held in self._held if held.topic == topic]
        if own and reading.stamp <= own[-1].reading.stamp:
            self.accepted(topic)
            own = []
        self._held.append(Held(topic, reading))
        if len(own) + 1 < self._needed:
            return []
        jumped, self._held = self._held, []
        return jumped

    def clear(self) -> None:
        """Start afresh."""
        self._held.clear()
