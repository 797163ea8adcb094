"""MCAP bags, intact or damaged, read chunk by chunk."""

from __future__ import annotations

import heapq
import mmap
import os
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel

from semiparam_ros.bags import mcap_format, qos, recovery, schemas
from semiparam_ros.bags.base import BagReader, Losses, Message, TopicInfo
from semiparam_ros.bags.mcap_format import MAGIC, Damage, Entry, Incomplete, Index, Segment, read_summary
from semiparam_ros.bags.schemas import UNKNOWN, Layout, Schema
from semiparam_ros.errors import SemiparamError


class McapBag(BagReader):
    """An MCAP file. Damage costs the chunks it lies in and nothing else; :attr:`losses` tells which."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        self._file = self.path.open('rb')
        try:
            self._buffer: mmap.mmap = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError as error:
            self._file.close()
            raise SemiparamError(f'{str(path)!r} is empty: expected an MCAP bag.') from error
        self._index = _index(self._buffer)
        self._has_crcs = any(segment.chunk and segment.chunk.crc for segment in self._index.segments)
        # How many messages each segment read so far held; None for one that is lost.
        self._read: dict[Segment, int | None] = {}
        self._reasons: list[str] = []
        self.start_ns, self.end_ns = self._index.start_ns, self._index.end_ns
        self._channel_topics, self._others = _one_type_each(self._index)
        self.topics = _topics(self._index, self._channel_topics)
        if not self.topics and self._index.losses.reasons:
            self.close()
            raise SemiparamError(f'{str(path)!r} holds no readable message: '
                                 f'{"; ".join(self._index.losses.reasons)}.')

    def _log_order(self, topics: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        info = {channel: (topic, self.topics[topic].type) for channel, topic in self._channel_topics.items()
                if topic in topics}
        low = -1 if start_ns is None else start_ns
        high = 2**64 if end_ns is None else end_ns
        for entry in self._merged(info.keys(), low, high):
            topic, type_name = info[entry.channel]
            yield Message(topic, type_name, entry.log_time, entry.publish_time, None, entry.raw)

    def _merged(self, channels: Collection[int], low: int, high: int) -> Iterator[Entry]:
        """Entries of all segments in order of time. Chunks may overlap: an entry waits for those that begin before."""
        heap: list[tuple[int, int, int, Entry]] = []
        for segment in sorted(self._index.segments, key=lambda s: s.start_ns):
            if segment.start_ns >= high or segment.end_ns < low:
                continue
            if segment.channels is not None and segment.channels.isdisjoint(channels):
                continue
            while heap and heap[0][0] < segment.start_ns:
                yield heapq.heappop(heap)[3]
            for position, entry in enumerate(self._entries(segment)):
                if entry.channel in channels and low <= entry.log_time < high:
                    heapq.heappush(heap, (entry.log_time, segment.offset, position, entry))
        while heap:
            yield heapq.heappop(heap)[3]

    def _entries(self, segment: Segment) -> list[Entry]:
        """The messages of a segment; none, and an entry in the account, when it is damaged."""
        definitions = self._index.definitions
        try:
            if os.fstat(self._file.fileno()).st_size < segment.end:  # to read beyond would end the process by SIGBUS
                raise Damage('the file has become shorter while it was read')
            if segment.chunk is None:
                found = mcap_format.entries(self._buffer, definitions, segment.offset, segment.end)
            else:
                data = mcap_format.unpack(self._buffer, segment.chunk, self._has_crcs)
                found = mcap_format.entries(data, definitions)
        except Damage as damage:
            self._read[segment] = None
            if str(damage) not in self._reasons:
                self._reasons.append(str(damage))
            return []
        self._read[segment] = sum(entry.channel in self._channel_topics for entry in found)
        return found

    @property
    def losses(self) -> Losses:
        for segment in self._index.segments:
            if segment not in self._read:
                self._entries(segment)
        lost = [segment for segment in self._index.segments if self._read[segment] is None]
        known = self._index.losses
        unread = [(segment.offset, segment.end) for segment in lost]
        return replace(known, path=str(self.path),
                       saved=sum(count or 0 for count in self._read.values()),
                       chunks_lost=known.chunks_lost + len(lost),
                       byte_ranges=sorted(known.byte_ranges + unread),
                       reasons=known.reasons + self._others + self._reasons,
                       undecodable=dict(self._undecodable))

    def close(self) -> None:
        self._buffer.close()
        self._file.close()


def _index(buffer: mmap.mmap) -> Index:
    """The summary, or what a walk over the whole file finds."""
    reason = None if bytes(buffer[:len(MAGIC)]) == MAGIC else 'the start of the file is damaged'
    try:
        index = read_summary(buffer)
    except Incomplete:
        return recovery.scan(buffer, reason)
    except Damage as damage:
        return recovery.scan(buffer, '; '.join(filter(None, (reason, str(damage)))))
    index.losses.reasons += [reason] if reason else []
    return index


def _type(index: Index, channel: Channel) -> str:
    schema = index.definitions.schemas.get(channel.schema_id)
    return schemas.full_type(schema.name) if schema else ''


def _schema(index: Index, channel: Channel) -> Schema:
    schema = index.definitions.schemas.get(channel.schema_id)
    return Schema(schema.encoding, schema.data.decode(errors='replace')) if schema else UNKNOWN


class _Kind(NamedTuple):
    """Type, encoding and definition of messages: those of two kinds cannot be read as one."""

    type: str
    encoding: str
    layout: Layout | None

    def beside(self, main: _Kind) -> str:
        """Words for messages that are not of the main kind."""
        if self[:2] == main[:2]:
            return f'{self.type} of another definition'
        return f'{self.type} ({self.encoding}), not {main.type} ({main.encoding})'


def _kind(index: Index, channel: Channel) -> _Kind:
    type_name = _type(index, channel)
    return _Kind(type_name, channel.message_encoding, schemas.layout(type_name, _schema(index, channel)))


def _one_type_each(index: Index) -> tuple[dict[int, str], list[str]]:
    """Topic of each channel that is read, and what is said of the others: a topic is of the type, encoding and
    definition that most of its messages have."""
    kinds = {channel.id: _kind(index, channel) for channel in index.definitions.channels.values()}
    channels = index.definitions.channels.values()
    counts: dict[str, Counter[_Kind]] = defaultdict(Counter)
    for channel in channels:
        counts[channel.topic][kinds[channel.id]] += index.counts.get(channel.id, 0)
    main = {topic: of_topic.most_common(1)[0][0] for topic, of_topic in counts.items()}
    reasons = [f'{count} messages on {topic} are {kind.beside(main[topic])}'
               for topic, of_topic in sorted(counts.items())
               for kind, count in of_topic.items() if count and kind != main[topic]]
    return {channel.id: channel.topic for channel in channels if kinds[channel.id] == main[channel.topic]}, reasons


def _topics(index: Index, read: Mapping[int, str]) -> dict[str, TopicInfo]:
    """Topics by name, of the channels that are read; several channels of one topic are added up."""
    topics: dict[str, TopicInfo] = {}
    for channel in sorted(index.definitions.channels.values(), key=lambda channel: channel.topic):
        if channel.id not in read:
            continue
        type_name = _type(index, channel)
        offers = qos.parse_profiles(channel.metadata.get('offered_qos_profiles'))
        before = topics.get(channel.topic)
        if before:
            offers = before.offers + offers
        count = index.counts.get(channel.id, 0) + (before.count if before else 0)
        topics[channel.topic] = TopicInfo(type_name, count, qos.agreed(offers), offers, _schema(index, channel),
                                          channel.message_encoding)
    return topics


def is_mcap(path: Path, magic: bytes) -> bool:
    """Tell whether a file is MCAP by its first bytes, or by its name where those are damaged."""
    return magic.startswith(MAGIC) or path.name.endswith(('.mcap', '.mcap.partial'))
