"""Bags of any format: topics, times, messages in an order, and an account of damage."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from semiparam_ros.bags import schemas
from semiparam_ros.bags.header_stamp import read_stamp
from semiparam_ros.bags.qos import Qos
from semiparam_ros.bags.schemas import UNKNOWN, Decoder, Schema
from semiparam_ros.errors import SemiparamError, listed

SHOWN = 4
"""Ranges of bytes that a sentence names."""
PLAIN_CDR = (b'\0\0', b'\0\1')
"""First bytes of a message in XCDR1, whose numbers decoders look for; those of XCDR2 stand at other places."""
ORDERS = ('log', 'publish', 'header')


@dataclass
class Losses:
    """The account of a bag: falsy when nothing is wrong with it.

    ``intact`` is the number of messages the bag held before it was damaged, None where nothing tells;
    ``byte_ranges`` are the half-open ranges of the file that could not be used. ``unlisted`` are the files of a folder
    that its metadata.yaml does not name.
    """

    path: str = ''
    saved: int = 0
    intact: int | None = None
    chunks: int = 0
    chunks_lost: int = 0
    byte_ranges: list[tuple[int, int]] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    undecodable: dict[str, int] = field(default_factory=dict)
    unlisted: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self._damaged or self.unlisted)

    @property
    def _damaged(self) -> bool:
        return bool(self.chunks_lost or self.byte_ranges or self.reasons or self.undecodable)

    @property
    def sentence(self) -> str:
        """The whole account, '' when nothing is wrong."""
        left = f'{self.path!r} also holds {listed(self.unlisted)}, which its metadata.yaml does not name: not read.'
        return ' '.join([self._damage] * self._damaged + [left] * bool(self.unlisted))

    @property
    def _damage(self) -> str:
        of = '' if self.intact is None else f' of {self.intact}'
        parts = [*self.reasons, f'{self.saved}{of} messages read']
        if self.chunks_lost:
            parts.append(f'{self.chunks_lost} of {self.chunks} chunks lost')
        if self.byte_ranges:
            parts.append('unreadable bytes ' + _ranges(self.byte_ranges))
        parts += [f'{count} messages on {topic} do not decode' for topic, count in sorted(self.undecodable.items())]
        return f'{self.path!r} is damaged: ' + '; '.join(parts) + '.'


def _ranges(ranges: list[tuple[int, int]]) -> str:
    text = ', '.join(f'{start}-{end}' for start, end in ranges[:SHOWN])
    return text if len(ranges) <= SHOWN else f'{text} and {len(ranges) - SHOWN} more ranges'


class Message(NamedTuple):
    """One message. Times in ns since the epoch; ``raw`` is CDR with its 4-byte header.

    ``data`` has the message's fields as attributes (arrays are lists); it is None where no definition of the type is
    known, or where ``decode=False`` asked for the bytes alone.
    """

    topic: str
    type: str
    log_time: int
    publish_time: int
    data: Any
    raw: bytes


@dataclass(frozen=True)
class TopicInfo:
    """One topic: full type name, number of messages, the agreed QoS and all recorded offers, the definition."""

    type: str
    count: int
    qos: Qos
    offers: tuple[Qos, ...] = ()
    schema: Schema = UNKNOWN
    encoding: str = 'cdr'


class BagReader(ABC):
    """A bag opened for reading. Use it in a ``with`` block, or call :meth:`close`."""

    topics: dict[str, TopicInfo]
    start_ns: int
    end_ns: int

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.topics = {}
        self.start_ns = self.end_ns = 0
        self.unlisted: tuple[str, ...] = ()
        self._undecodable: dict[str, int] = {}

    @property
    def duration_ns(self) -> int:
        """Log time of the last message less that of the first [ns]."""
        return self.end_ns - self.start_ns

    @property
    def message_count(self) -> int:
        """Messages of all topics, counted before any damage where the bag tells."""
        return sum(info.count for info in self.topics.values())

    @property
    @abstractmethod
    def losses(self) -> Losses:
        """Account of what cannot be read: parts not read so far are checked first."""

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    @abstractmethod
    def _log_order(self, topics: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        """Messages (``data`` None) of ``topics`` in order of log time, start_ns <= log_time < end_ns."""

    def messages(self, topics: Collection[str] | None = None, order: str = 'log', start_ns: int | None = None,
                 end_ns: int | None = None, decode: bool | Collection[str] = True) -> Iterator[Message]:
        """Messages in order of time; those of equal times in the order in which they were recorded.

        :param topics: only these (all of them by default).
        :param order: 'log', 'publish' or 'header', as of :meth:`timed`. The last two hold what is chosen in memory.
        :param start_ns: only messages at or after this log time; ``end_ns``: only before it.
        :param decode: False leaves ``data`` None, which is several times faster; a collection decodes those alone.
        """
        if order not in ORDERS:
            raise SemiparamError(f'message order {order!r} is unknown: expected one of {list(ORDERS)}.')
        wanted = set(self.topics) if topics is None else set(topics) & set(self.topics)
        found = self._log_order(wanted, start_ns, end_ns)
        if order != 'log':
            found = (message for _, message in sorted(self.timed(found, order), key=itemgetter(0)))
        return self._decoded(found, self.topics if decode is True else decode) if decode else found

    def timed(self, messages: Iterable[Message], order: str) -> Iterator[tuple[int, Message]]:
        """Each of some messages in order of log time, and its time [ns]: of being logged, published, or its header's
        stamp. One without a stamp has its log time by the clock of the stamps: as the last one before it, or the
        first of all.
        """
        ahead: int | None = None
        unstamped = list[Message]()
        for message in messages:
            stamp = message.log_time if order == 'log' else message.publish_time if order == 'publish' else \
                self._stamp(message)
            if stamp is not None:
                ahead = stamp - message.log_time
            unstamped.append(message)
            if ahead is not None:
                yield from ((each.log_time + ahead, each) for each in unstamped)
                unstamped.clear()
        yield from ((each.log_time, each) for each in unstamped)

    def has_header(self, message: Message) -> bool:
        """Tell whether a message begins with a header, without decoding it."""
        info = self.topics[message.topic]
        plain = info.encoding == 'cdr' and message.raw[:2] in PLAIN_CDR and len(message.raw) >= 12
        return plain and schemas.has_header(info.type, info.schema)

    def _stamp(self, message: Message) -> int | None:
        """Stamp of the message's header [ns]; None without a header, or one that is not set."""
        return read_stamp(message.raw) or None if self.has_header(message) else None

    def _decoded(self, found: Iterator[Message], topics: Collection[str]) -> Iterator[Message]:
        decoders = {topic: self._decoder(info) if topic in topics else None for topic, info in self.topics.items()}
        for message in found:
            decode = decoders[message.topic]
            if decode is None:
                yield message
                continue
            try:
                if message.raw[:2] not in PLAIN_CDR:
                    raise ValueError('it is laid out otherwise')
                data = decode(message.raw)
            except Exception:  # bytes that do not fit their type fail in any way: struct, Unicode, memory ...
                self._undecodable[message.topic] = self._undecodable.get(message.topic, 0) + 1
                continue
            yield message._replace(data=data)

    def decodes(self, topic: str) -> bool:
        """Tell whether the messages of a topic can be decoded at all."""
        return self._decoder(self.topics[topic]) is not None

    @staticmethod
    def _decoder(info: TopicInfo) -> Decoder | None:
        return schemas.decoder(info.type, info.schema) if info.encoding == 'cdr' else None

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
