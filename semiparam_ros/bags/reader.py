"""Opening bags of every format that ROS users have, and several files as one bag."""

from __future__ import annotations

import heapq
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml

from semiparam_ros.bags import qos, schemas
from semiparam_ros.bags.base import BagReader, Losses, Message, TopicInfo
from semiparam_ros.bags.mcap_reader import McapBag, is_mcap
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.yaml_file import document


class MergedBag(BagReader):
    """Readers merged by time; where times are equal, the order of ``readers`` decides. It closes them."""

    def __init__(self, path: str | os.PathLike[str], readers: Sequence[BagReader]) -> None:
        """Merge readers; a topic of two types raises SemiparamError, which calls the bag ``path``.
        """
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
        if before.encoding != info.encoding:
            raise SemiparamError(f'topic {topic} is encoded as {info.encoding!r} in {str(reader.path)!r} but '
                                 f'{before.encoding!r} in another bag: they cannot be merged.')
        layouts = {schemas.layout(each.type, each.schema) for each in (before, info)}
        if len(layouts - {None}) > 1:
            raise SemiparamError(f'topic {topic} holds {info.type} in {str(reader.path)!r} by another definition than '
                                 'in another bag: they cannot be merged.')
        offers = before.offers + info.offers
        return replace(before, count=before.count + info.count, offers=offers, qos=qos.agreed(offers))

    def _log_order(self, topics: Collection[str], start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        streams = [reader.messages(topics, 'log', start_ns, end_ns, decode=False) for reader in self.readers]
        return heapq.merge(*streams, key=lambda message: message.log_time)

    @property
    def losses(self) -> Losses:
        parts = [reader.losses for reader in self.readers]
        if len(parts) == 1:
            own = replace(parts[0], undecodable=dict(self._undecodable))
            return replace(own, path=str(self.path), unlisted=self.unlisted) if self.unlisted else own
        total = Losses(str(self.path), undecodable=dict(self._undecodable), unlisted=self.unlisted)
        total.saved = sum(part.saved for part in parts)
        known = [part.intact for part in parts if part.intact is not None]
        total.intact = sum(known) if len(known) == len(parts) else None
        total.chunks, total.chunks_lost = sum(p.chunks for p in parts), sum(p.chunks_lost for p in parts)
        total.reasons = [part.sentence.rstrip('.') for part in parts if part]
        return total

    def close(self) -> None:
        for reader in self.readers:
            reader.close()


def open_bag(path: str | os.PathLike[str]) -> BagReader:
    """Open an MCAP file, a rosbag2 directory, a .db3 file or a ROS 1 .bag.

    A damaged MCAP file is opened as far as it can be read: see ``losses``. What is no bag, or holds no readable
    message because of damage, raises SemiparamError.
    """
    path = Path(path)
    try:
        return _open_directory(path) if path.is_dir() else _open_file(path)
    except OSError as error:
        raise SemiparamError(f'{str(error.filename or path)!r} cannot be opened: {error.strerror or error}.') from error


def is_bag(path: Path) -> bool:
    """Tell whether :func:`open_bag` takes this path: a directory, or a file by first bytes or name.
    """
    if path.is_dir():
        return True
    try:
        magic = _first_bytes(path)
    except OSError as error:
        raise SemiparamError(f'{str(path)!r} cannot be opened: {error.strerror or error}.') from error
    return any(fits(path, magic) for fits, _ in _FORMATS)


def _first_bytes(path: Path) -> bytes:
    """The first bytes of a file, but not of a pipe: what is read of one is gone."""
    if path.exists() and not path.is_file():
        raise SemiparamError(f'{str(path)!r} is a device or a pipe; expected a file.')
    with path.open('rb') as file:
        return file.read(32)


def _open_file(path: Path) -> BagReader:
    magic = _first_bytes(path)
    if not magic:
        raise SemiparamError(f'{str(path)!r} is empty: expected a bag.')
    for fits, opened in _FORMATS:
        if fits(path, magic):
            return opened(path)
    raise SemiparamError(f'{str(path)!r} is no bag: expected an MCAP file, a rosbag2 directory, a .db3 file or a '
                         'ROS 1 .bag.')


def _open_directory(path: Path) -> BagReader:
    """A rosbag2 directory: its MCAP files are read here, whatever else it holds is left to ``rosbags``."""
    description = _metadata(path)
    found = sorted([*path.glob('*.mcap'), *path.glob('*.mcap.partial'), *path.glob('*.db3')])
    # A recorder that was killed has not written its metadata.yaml.
    files = _listed_files(path, description.get('relative_file_paths')) or found
    packed = str(description.get('compression_mode') or 'none').lower() in ('file', 'message')
    if not files:
        raise SemiparamError(f'{str(path)!r} is no bag: expected a directory with metadata.yaml, .mcap or .db3 files.')
    if packed or (description and files[0].suffix == '.db3'):
        bag = _sqlite_bag(path)
    else:
        bag = MergedBag(path, [_open_file(file) for file in files])
    # A player leaves NAME.mcap beside NAME.mcap.zstd, which it has unpacked.
    bag.unlisted = tuple(file.name for file in found if not any(each.name.startswith(file.name) for each in files))
    return bag


def _metadata(path: Path) -> dict[str, Any]:
    """Content of metadata.yaml; nothing where it is missing or damaged: the files tell enough."""
    try:
        return dict(document((path / 'metadata.yaml').read_text(encoding='utf-8'))['rosbag2_bagfile_information'])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError, KeyError, TypeError, ValueError):
        return {}


def _listed_files(path: Path, names: object) -> list[Path]:
    """The files that metadata.yaml names, those of a folder alone; none where it is damaged there."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return []
    return [path / Path(name).name for name in names if Path(name).name and '\0' not in name]


def is_sqlite(path: Path, magic: bytes) -> bool:
    """Tell whether a file is sqlite by its first bytes, or by its name where those are damaged."""
    return magic.startswith(b'SQLite format 3\x00') or path.suffix == '.db3'


def is_ros1(path: Path, magic: bytes) -> bool:
    """Tell whether a file is a ROS 1 bag by its first bytes, or name where those are damaged."""
    return magic.startswith(b'#ROSBAG') or path.suffix == '.bag'


def _sqlite_bag(path: Path) -> BagReader:
    return _rosbags_reader(path, 'rosbag2 bag').SqliteBag(path)


def _ros1_bag(path: Path) -> BagReader:
    return _rosbags_reader(path, 'ROS 1 bag').Ros1Bag(path)


_FORMATS: tuple[tuple[Callable[[Path, bytes], bool], Callable[[Path], BagReader]], ...] = (
    (is_mcap, McapBag), (is_sqlite, _sqlite_bag), (is_ros1, _ros1_bag))


def _rosbags_reader(path: Path, kind: str) -> Any:
    """The module that needs ``rosbags``; one sentence where that is missing, any other import error
    passes."""
    try:
        return import_module('semiparam_ros.bags.rosbags_reader')
    except ModuleNotFoundError as error:
        if error.name != 'rosbags':
            raise
        raise SemiparamError(f"{str(path)!r} is a {kind} that only the Python package 'rosbags' reads, which is not "
                             'installed: pip install rosbags.') from error
