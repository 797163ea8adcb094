"""A bag as a timeline: cut to the wanted part, chosen topics only, under the names that they are published with."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter

from semiparam_ros.bags.base import BagReader
from semiparam_ros.bags.qos import Qos
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.player import Item

_TIME = attrgetter('time')


@dataclass(frozen=True)
class Selection:
    """Selection of topics: named or matched, all where neither is given, less those excluded."""

    topics: tuple[str, ...] = ()
    regex: str | None = None
    exclude: tuple[str, ...] = ()
    exclude_regex: str | None = None

    def __post_init__(self) -> None:
        for pattern in (self.regex, self.exclude_regex):
            try:
                re.compile(pattern or '')
            except re.error as error:
                raise SemiparamError(f"'{pattern}' is not a regular expression: {error}.") from None

    def of(self, available: Sequence[str]) -> list[str]:
        """The chosen ones of ``available``; a named topic that is not there raises SemiparamError."""
        missing = [topic for topic in self.topics if topic not in available]
        if missing:
            raise SemiparamError(f'the bag has no topic {", ".join(missing)}: it has {", ".join(available) or "none"}.')
        return [topic for topic in available if self._wanted(topic)]

    def _wanted(self, topic: str) -> bool:
        if topic in self.exclude or (self.exclude_regex is not None and re.search(self.exclude_regex, topic)):
            return False
        if not self.topics and self.regex is None:
            return True
        return topic in self.topics or (self.regex is not None and re.search(self.regex, topic) is not None)


@dataclass(frozen=True)
class Cut:
    """Part of a bag: seconds after its start; ``until_stamp_s`` in seconds since the epoch."""

    start_offset_s: float = 0.0
    duration_s: float | None = None
    until_s: float | None = None
    until_stamp_s: float | None = None

    def __post_init__(self) -> None:
        for what, value in (('start offset', self.start_offset_s), ('duration', self.duration_s),
                            ('end', self.until_s), ('end stamp', self.until_stamp_s)):
            if value is not None and not 0.0 <= value < float('inf'):
                raise SemiparamError(f'the {what} of the playback must be a number of seconds of at least 0, got '
                                     f'{value:g}.')

    def bounds(self, start_ns: int, end_ns: int) -> tuple[int, int]:
        """Bag times [ns] of the part, first and last; SemiparamError when nothing is left."""
        first = start_ns + _nanoseconds(self.start_offset_s)
        ends = [end_ns]
        if self.duration_s is not None:
            ends.append(first + _nanoseconds(self.duration_s))
        if self.until_s is not None:
            ends.append(start_ns + _nanoseconds(self.until_s))
        if self.until_stamp_s is not None:
            ends.append(_nanoseconds(self.until_stamp_s))
        if first > min(ends):
            raise SemiparamError(f'nothing is left to play: the part would begin {self.start_offset_s:g} s after the '
                                 f'start and end {(min(ends) - start_ns) * 1e-9:g} s after it.')
        return first, min(ends)


@dataclass(frozen=True)
class PlayedTopic:
    """A topic as it is published: its type, and what to offer."""

    name: str
    type: str
    qos: Qos


@dataclass
class BagTimeline:
    """The messages of a bag between two times, playable from anywhere (see ``player.Timeline``).

    :param topics: topic in the bag -> how it is published
    :param order: 'log', 'publish' or 'header': which time a message is due at. The last two are sorted in memory.
    """

    bag: BagReader
    topics: Mapping[str, PlayedTopic]
    order: str = 'log'
    cut: Cut = field(default_factory=Cut)

    def __post_init__(self) -> None:
        self._names = {topic: played.name for topic, played in self.topics.items()}
        self._latched = {topic for topic, played in self.topics.items() if played.qos.latched}
        self._sorted = None if self.order == 'log' else sorted(self._stream(self.topics), key=_TIME)
        first, last = self._extent()
        self.start_ns, self.end_ns = self.cut.bounds(first, last)

    def _extent(self) -> tuple[int, int]:
        """Times [ns] of the first and last message of the bag."""
        if self._sorted:
            return self._sorted[0].time, self._sorted[-1].time
        if not any(self.bag.topics[topic].count for topic in self.topics):
            raise SemiparamError('there is nothing to play: the chosen topics hold no message.')
        return self.bag.start_ns, self.bag.end_ns

    def play(self, from_ns: int) -> Generator[Item, None, None]:
        """Generate every message due from ``from_ns`` on, after the last latched ones before it."""
        yield from self._latched_before(from_ns)
        for item in self._items(from_ns):
            if item.time > self.end_ns:
                return
            yield item

    def _items(self, from_ns: int) -> Iterator[Item]:
        if self._sorted is None:
            return self._stream(self.topics, start_ns=from_ns)
        return iter(self._sorted[bisect_left(self._sorted, from_ns, key=_TIME):])

    def _latched_before(self, from_ns: int) -> list[Item]:
        """Latched messages that a subscriber at ``from_ns`` would have received on connecting."""
        last = {item.topic: item for item in self._latched_items(end_ns=from_ns) if item.time < from_ns}
        return [item._replace(time=from_ns) for item in last.values()]

    def _latched_items(self, end_ns: int | None = None) -> Iterator[Item]:
        """All messages on latched topics; of log times, only those before ``end_ns``."""
        if self._sorted is None:
            return self._stream(self._latched, end_ns=end_ns)
        names = {self._names[topic] for topic in self._latched}
        return (item for item in self._sorted if item.topic in names)

    def announcements(self) -> list[Item]:
        """The first message on each latched topic, which a node may need before it can do anything, due at the start:
        the time of the bag must not run ahead with them."""
        first = {item.topic: item for item in self._latched_before(self.start_ns)}
        for item in self._latched_items():
            if item.time >= self.start_ns:
                first.setdefault(item.topic, item)
            if len(first) == len(self._latched):
                break
        return [item._replace(time=self.start_ns) for item in first.values()]

    def _stream(self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
                ) -> Iterator[Item]:
        messages = self.bag.messages(topics, 'log', start_ns, end_ns, decode=False)
        for time, message in self.bag.timed(messages, self.order):
            yield Item(time, self._names[message.topic], message.raw)


def _nanoseconds(seconds: float) -> int:
    return round(seconds * NANOSECONDS)
