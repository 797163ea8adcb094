"""sqlite3 bags of rosbag2 and bags of ROS 1, read with ``rosbags`` and handed on as CDR of ROS 2 types.

``rosbags`` is an optional dependency: only :mod:`semiparam_ros.bags.reader` imports this module, when it is needed.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import rosbags.rosbag1
import rosbags.rosbag2
from rosbags.convert.converter import STATIC_MSGTYPE_RENAMES, is_same_wireformat, migrate_bytes
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semiparam_ros.bags import qos, schemas
from semiparam_ros.bags.base import BagReader, Losses, Message, TopicInfo
from semiparam_ros.bags.qos import LATCHED, Qos
from semiparam_ros.bags.schemas import UNKNOWN, Schema
from semiparam_ros.errors import SemiparamError

_ENCODINGS = {MessageDefinitionFormat.MSG: 'ros2msg', MessageDefinitionFormat.IDL: 'ros2idl'}


class Ros1Types:
    """The types of one bag. A type that Jazzy has too is migrated to it, others keep their own definition."""

    def __init__(self, definitions: dict[str, str]) -> None:
        """Register ``definitions``, texts by type name in ROS 2 form, as the bag's connections hold
        them."""
        self._source = get_typestore(Stores.EMPTY)
        for type_name, text in definitions.items():
            self._source.register(get_types_from_msg(text, type_name))
        self._target = get_typestore(Stores.ROS2_JAZZY)
        self._target.register({name: self._source.fielddefs[name]
                               for name in self._source.fielddefs.keys() - self._target.fielddefs.keys()})
        self._cache: dict[str, object] = {}
        self._to_cdr: dict[str, Callable[[bytes], Any]] = {}

    def ros2_name(self, type_name: str) -> str:
        """Name of a type in ROS 2: most stay, a few types moved to another package."""
        return str(STATIC_MSGTYPE_RENAMES.get(type_name, type_name))

    def schema(self, type_name: str) -> Schema:
        """The definition of the type in ROS 2, UNKNOWN where there is none."""
        name = self.ros2_name(type_name)
        if schemas.is_jazzy_type(name):
            return schemas.jazzy_schema(name)
        try:
            return Schema('ros2msg', self._target.generate_msgdef(name, ros_version=2)[0])
        except Exception:  # a definition that cannot be told in ROS 2 leaves the topic without one
            return UNKNOWN

    def cdr(self, type_name: str, raw: bytes) -> bytes:
        """CDR of ROS 2 from the bytes of ROS 1."""
        if type_name not in self._to_cdr:
            self._to_cdr[type_name] = self._converter(type_name, self.ros2_name(type_name))
        return bytes(self._to_cdr[type_name](raw))

    def _converter(self, source: str, target: str) -> Callable[[bytes], Any]:
        """Byte by byte where the fields are the same (but for the header's ``seq``), else field by field."""
        if is_same_wireformat(self._source, self._target, source, target):
            return partial(self._target.ros1_to_cdr, typename=target)
        return partial(migrate_bytes, self._source, self._target, source, target, self._cache, src_is2=False,
                       dst_is2=True)


class _RosbagsBag(BagReader):
    """Bag that a reader of ``rosbags`` opens, whose two formats have the same shape."""

    kind: str

    def __init__(self, path: str | os.PathLike[str], reader: Callable[[Path], Any]) -> None:
        super().__init__(path)
        self._saved: int | None = None
        self._reasons: list[str] = []
        self._main: dict[str, str] = {}
        """Type that most messages of each topic have, and no others are read."""
        try:
            self._reader = reader(self.path)
            self._reader.open()
        except Exception as error:  # ReaderError, apsw errors, struct.error, KeyError ...
            raise self._refusal(error) from error
        if self._reader.message_count:
            self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1

    def _refusal(self, error: Exception) -> SemiparamError:
        text = str(error).strip().rstrip('.')
        return SemiparamError(f'{str(self.path)!r} cannot be read as {self.kind}, it is damaged or was not finished: '
                              f'{text or type(error).__name__}.')

    def _log_order(self, topics: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        connections = [connection for connection in self._reader.connections
                       if connection.topic in topics and self._is_read(connection)]
        if not connections:
            return
        try:
            for connection, time, raw in self._reader.messages(connections, start=start_ns, stop=end_ns):
                yield Message(connection.topic, self.topics[connection.topic].type, time, time, None,
                              self._cdr(connection, raw))
        except Exception as error:
            raise self._refusal(error) from error

    def _is_read(self, connection: Connection) -> bool:
        """Tell whether messages of a connection are of the type that its topic is read as."""
        return bool(connection.msgtype == self._main[connection.topic])

    def _topics(self) -> Iterator[tuple[str, int, list[Any]]]:
        """Topics in order, of one type each: the number of their messages, and the connections that hold these."""
        topics: dict[str, list[Any]] = defaultdict(list)
        for connection in self._reader.connections:
            topics[connection.topic].append(connection)
        for topic, connections in sorted(topics.items()):
            counts: Counter[str] = Counter()
            for each in connections:
                counts[each.msgtype] += each.msgcount
            (main, count), *others = counts.most_common()
            self._main[topic] = main
            self._reasons += [f'{number} messages on {topic} are {other}, not {main}'
                              for other, number in others if number]
            yield topic, count, [each for each in connections if self._is_read(each)]

    def _cdr(self, connection: Connection, raw: bytes) -> bytes:
        return bytes(raw)

    @property
    def losses(self) -> Losses:
        """Account of undecodable messages: these formats have no checksums and end at any damage.
        """
        if self._saved is None:
            self._saved = sum(1 for _ in self._log_order(self.topics.keys(), None, None))
        return Losses(str(self.path), self._saved, self.message_count, reasons=list(self._reasons),
                      undecodable=dict(self._undecodable), unlisted=self.unlisted)

    def close(self) -> None:
        self._reader.close()


class SqliteBag(_RosbagsBag):
    """A .db3 file, or a rosbag2 directory of any storage that ``rosbags`` knows."""

    kind = 'a rosbag2 bag'

    def __init__(self, path: str | os.PathLike[str]) -> None:
        _refuse_cut_database(Path(path))
        super().__init__(path, rosbags.rosbag2.Reader)
        for topic, count, connections in self._topics():
            offers = tuple(_offer(profile) for each in connections for profile in each.ext.offered_qos_profiles)
            schema = Schema(_ENCODINGS.get(connections[0].msgdef.format, ''), connections[0].msgdef.data)
            self.topics[topic] = TopicInfo(schemas.full_type(self._main[topic]), count, qos.agreed(offers), offers,
                                           schema)


class Ros1Bag(_RosbagsBag):
    """A bag of ROS 1. Types get their ROS 2 names and definitions; latched topics become transient local."""

    kind = 'a ROS 1 bag'

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path, rosbags.rosbag1.Reader)
        try:
            self._types = Ros1Types({each.msgtype: each.msgdef.data for each in self._reader.connections})
        except Exception as error:  # definitions that do not parse
            raise self._refusal(error) from error
        for topic, count, connections in self._topics():
            offers = tuple(LATCHED if each.ext.latching else Qos() for each in connections)
            main = self._main[topic]
            self.topics[topic] = TopicInfo(self._types.ros2_name(main), count, qos.agreed(offers), offers,
                                           self._types.schema(main))

    def _cdr(self, connection: Connection, raw: bytes) -> bytes:
        return self._types.cdr(connection.msgtype, raw)


def _offer(profile: Any) -> Qos:
    """A profile as ``rosbags`` holds it."""
    return qos.parse_profiles([{
        'history': profile.history.name, 'depth': profile.depth, 'reliability': profile.reliability.name,
        'durability': profile.durability.name, 'liveliness': profile.liveliness.name,
        **{name: {'sec': getattr(profile, name).sec, 'nsec': getattr(profile, name).nsec}
           for name in ('deadline', 'lifespan', 'liveliness_lease_duration')}}])[0]


def _refuse_cut_database(path: Path) -> None:
    """sqlite reads what is missing at the end of a file as zeros, without a word: ask its header for the length."""
    for file in sorted(path.glob('*.db3')) if path.is_dir() else [path]:
        with file.open('rb') as stream:
            header = stream.read(32)
        if len(header) < 32:
            raise SemiparamError(f'{str(file)!r} cannot be read as a rosbag2 bag: it has {len(header)} bytes.')
        # A page size of 65536 does not fit its two bytes and is written as 1.
        page_bytes = int.from_bytes(header[16:18], 'big')
        expected = (65536 if page_bytes == 1 else page_bytes) * int.from_bytes(header[28:32], 'big')
        if file.stat().st_size < expected:
            raise SemiparamError(f'{str(file)!r} cannot be read as a rosbag2 bag: it is cut off, {expected} bytes were '
                                 f'expected and {file.stat().st_size} are there.')
