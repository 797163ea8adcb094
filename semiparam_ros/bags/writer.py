"""Writer of MCAP bags that rosbag2, Foxglove and every other reader of the ros2 profile
understands.

Equal calls give equal bytes: no clock, no random number and no library version enters the file.
(The zstd library does: another version of it may compress the same messages to other bytes.
``compression='none'`` avoids that.)
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO

from mcap.writer import CompressionType, Writer

from semiparam_ros.atomic_write import has_lock
from semiparam_ros.bags import recording_layout, schemas
from semiparam_ros.bags.qos import Qos, dump_profiles
from semiparam_ros.bags.schemas import UNKNOWN, Schema
from semiparam_ros.errors import SemiparamError

# A damaged byte costs the chunk it lies in. Chunks of 64 KiB make a file 9 % larger than the usual ones of 1 MiB.
CHUNK_BYTES = 64 * 1024
_COMPRESSION = {'zstd': CompressionType.ZSTD, 'lz4': CompressionType.LZ4, 'none': CompressionType.NONE}


def partial_path(path: Path) -> Path:
    """Path at which a bag is written until it is complete."""
    return path.with_name(f'{path.name}.partial')


class BagWriter:
    """An MCAP file in the making: ``with BagWriter(path) as bag: bag.write(...)``.

    Messages go to ``PATH.partial`` (what a killed process leaves behind; ``open_bag`` reads that too), which takes the
    name ``path`` when everything is written, and is removed when the ``with`` block ends by an exception.
    """

    def __init__(self, path: str | os.PathLike[str], compression: str = 'zstd', chunk_bytes: int = CHUNK_BYTES,
                 overwrite: bool = False) -> None:
        """Open the file, SemiparamError where that fails; ``compression``: 'zstd', 'lz4' or 'none'.

        :param overwrite: also where a writer that ended left its ``PATH.partial``; one that still writes keeps it.
        """
        if compression not in _COMPRESSION:
            raise SemiparamError(f'bag compression {compression!r} is unknown: expected one of {list(_COMPRESSION)}.')
        self.path = Path(path)
        self.partial_path = partial_path(self.path)
        self.message_count = 0
        self._file = _open_for_writing(self.partial_path, overwrite)
        self._status = os.fstat(self._file.fileno())
        self._writer = Writer(self._file, chunk_size=chunk_bytes, compression=_COMPRESSION[compression])
        self._writer.start(profile='ros2', library='semiparam_ros')
        self._schemas: dict[tuple[str, Schema], int] = {}
        self._topics: dict[str, tuple[str, int, Schema]] = {}
        self._sequences: dict[str, int] = {}

    def add_topic(self, topic: str, type_name: str, qos: Qos | None = None, schema: Schema = UNKNOWN) -> None:
        """Declare a topic; :meth:`write` does so itself for the types that Jazzy has.

        :param qos: written as ``offered_qos_profiles``; by default reliable, and latched for a robot description.
        :param schema: definition of a type that Jazzy lacks. A type known nowhere raises SemiparamError.
        """
        type_name = schemas.full_type(type_name)
        known = self._topics.get(topic)
        if known is not None:
            if known[0] != type_name:
                raise SemiparamError(f'{str(self.path)!r}: topic {topic} holds {known[0]}, not {type_name}.')
            return
        schema = schema if schema.text else schemas.jazzy_schema(type_name)
        metadata = {'offered_qos_profiles': dump_profiles([qos or recording_layout.default_qos(topic)])}
        if digest := schemas.type_hash(type_name):
            metadata['topic_type_hash'] = digest
        channel = self._writer.register_channel(topic, 'cdr', self._schema_id(type_name, schema), metadata)
        self._topics[topic] = (type_name, channel, schema)
        self._sequences[topic] = 0

    def _schema_id(self, type_name: str, schema: Schema) -> int:
        key = (type_name, schema)
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(type_name, schema.encoding, schema.text.encode())
        return self._schemas[key]

    def write(self, topic: str, type_name: str, message: Mapping[str, object] | object, stamp_ns: int,
              publish_ns: int | None = None) -> None:
        """Encode and append a message logged at ``stamp_ns`` [ns since the epoch].

        :param message: a dict (missing fields are zero or empty) or an object with the message's fields; arrays as
            lists, tuples or array.array. What the type does not admit raises SemiparamError.
        :param publish_ns: by default the same as ``stamp_ns``.
        """
        if topic not in self._topics:
            self.add_topic(topic, type_name)
        known, _, schema = self._topics[topic]
        if known != type_name and known != schemas.full_type(type_name):
            raise SemiparamError(f'{str(self.path)!r}: topic {topic} holds {known}, not {type_name}.')
        try:
            raw = schemas.encoder(known, schema)(message)
        except SemiparamError:
            raise
        except Exception as error:  # the encoder raises whatever the unsuitable value happens to cause
            raise SemiparamError(f'message for {topic} does not fit {known}: {error}.') from error
        self._append(topic, raw, stamp_ns, publish_ns)

    def write_raw(self, topic: str, raw: bytes, stamp_ns: int, publish_ns: int | None = None) -> None:
        """Append a message that is CDR already, to a topic declared with :meth:`add_topic`."""
        if topic not in self._topics:
            raise SemiparamError(f'{str(self.path)!r}: topic {topic} has not been declared with its type.')
        self._append(topic, raw, stamp_ns, publish_ns)

    def _append(self, topic: str, raw: bytes, stamp_ns: int, publish_ns: int | None) -> None:
        self._sequences[topic] += 1
        try:
            self._writer.add_message(self._topics[topic][1], stamp_ns, raw, stamp_ns if publish_ns is None
                                     else publish_ns, self._sequences[topic] & 0xFFFFFFFF)
        except OSError as error:
            raise SemiparamError(f'{str(self.path)!r} cannot be written: {error.strerror}.') from error
        self.message_count += 1

    def flush(self) -> None:
        """Put what was written so far on the disk, so that a process killed later loses only what follows."""
        try:
            self._writer.flush()
        except OSError as error:
            raise SemiparamError(f'{str(self.path)!r} cannot be written: {error.strerror}.') from error

    def close(self) -> None:
        """Write the index and give the file its name."""
        try:
            self._writer.finish()
            self._file.close()
            if not self._is_there():
                raise SemiparamError(f'{str(self.path)!r} is not written: {str(self.partial_path)!r} has been removed '
                                     'or replaced meanwhile.')
            os.replace(self.partial_path, self.path)
        except OSError as error:
            raise SemiparamError(f'{str(self.path)!r} cannot be written: {error.strerror}.') from error

    def abort(self) -> None:
        """Remove what was written; an older file named ``path`` stays as it was."""
        with suppress(OSError):  # a full disk refuses what was still to be written
            self._file.close()
        if self._is_there():
            self.partial_path.unlink(missing_ok=True)

    def _is_there(self) -> bool:
        """Tell whether the file of that name is the one that is written here: it may be another's by now."""
        try:
            return os.path.samestat(self._status, self.partial_path.lstat())
        except OSError:
            return False

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.abort()
            return
        try:
            self.close()
        except BaseException:  # a full disk, or Ctrl-C
            self.abort()
            raise


def _open_for_writing(path: Path, overwrite: bool) -> IO[bytes]:
    """The file, with its lock, which ends with this process."""
    try:
        if overwrite:
            _remove(path)
        stream = path.open('xb')
        _lock(stream.fileno(), path)
        return stream
    except FileExistsError:
        raise SemiparamError(f'{str(path)!r} holds a bag that broke off, or is being made: choose another name, or '
                             'remove it.') from None
    except OSError as error:
        raise SemiparamError(f'no bag can be written to {str(path.parent)!r}: {error.strerror}.') from error


def _remove(path: Path) -> None:
    """Remove what another writer left; raises SemiparamError while one writes it."""
    left = None
    with suppress(OSError):  # none, a link, or what may not be read
        left = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if left is not None:
            _lock(left, path)
        path.unlink(missing_ok=True)
    finally:
        if left is not None:
            os.close(left)


def _lock(descriptor: int, path: Path) -> None:
    """Take the lock of a bag in the making. Raises SemiparamError where another has it."""
    if not has_lock(descriptor):
        raise SemiparamError(f'{str(path)!r} is being written by another program: choose another name.')
