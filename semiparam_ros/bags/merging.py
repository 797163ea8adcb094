"""Several files read as one bag: the parts of a split recording, or recordings of the same robot side by side."""

from __future__ import annotations

import heapq
import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

from semiparam_ros.bags import qos
from semiparam_ros.bags.base import BagReader, Message, TopicInfo
from semiparam_ros.bags.losses import Losses
from semiparam_ros.errors import SemiparamError


class MergedBag(BagReader):
    """Readers merged by time; where times are equal, the order of ``readers`` decides. It closes them."""

    def __init__(self, path: str | os.PathLike[str], readers: Sequence[BagReader]) -> None:
        """:param path: what the bag is called in sentences. Different types of one topic raise SemiparamError."""
        super().__init__(path)
        self.readers = tuple(readers)
        filled = [reader for reader in self.readers if reader.message_count]
        self.start_ns = min((reader.start_ns for reader in filled), default=0)
        self.end_ns = max((reader.end_ns for reader in filled), default=0)
        for reader in self.readers:
            for topic, info in reader.topics.items():
                self.topics[topic] = self._added(topic, info, reader)

    def _added(self, topic: str, info: TopicInfo, reader: BagReader) -> TopicInfo:
        before = self.topics.get(topic)
        if before is None:
            return info
        if before.type != info.type:
            raise SemiparamError(f'topic {topic} holds {info.type} in {str(reader.path)!r} but {before.type} in '
                                 'another bag: they cannot be merged.')
        offers = before.offers + info.offers
        return replace(before, count=before.count + info.count, offers=offers, qos=qos.agreed(offers))

    def _log_order(self, topics: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        streams = [reader.messages(topics, 'log', start_ns, end_ns, decode=False) for reader in self.readers]
        return heapq.merge(*streams, key=lambda message: message.log_time)

    @property
    def losses(self) -> Losses:
        parts = [reader.losses for reader in self.readers]
        if len(parts) == 1:
            return replace(parts[0], undecodable=dict(self._undecodable))
        total = Losses(str(self.path), undecodable=dict(self._undecodable))
        total.saved = sum(part.saved for part in parts)
        known = [part.intact for part in parts if part.intact is not None]
        total.intact = sum(known) if len(known) == len(parts) else None
        total.chunks, total.chunks_lost = sum(p.chunks for p in parts), sum(p.chunks_lost for p in parts)
        total.reasons = [part.sentence.rstrip('.') for part in parts if part]
        return total

    def close(self) -> None:
        for reader in self.readers:
            reader.close()
