"""The records of an MCAP file, read one by one with every length checked.

The record types are those of the ``mcap`` package. Its readers stop at the first damaged byte of a file; here each
chunk stands for itself, and whatever is wrong with it becomes a :class:`Damage`.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

MAGIC = b'\x89MCAP0\r\n'
FOOTER_BYTES = 9 + 20
LARGEST_CHUNK = 2**30  # bytes; a damaged length must not be taken for an order to allocate memory

_PREFIX = struct.Struct('<BQ')
_CHUNK = struct.Struct('<BQQQQII')  # opcode, length, start, end, uncompressed size, CRC, length of compression
_MESSAGE = struct.Struct('<HIQQ')
_U64 = struct.Struct('<Q')


class Damage(Exception):
    """A part of the file that cannot be what it claims; the text says why."""


class Chunk(NamedTuple):
    """Where a chunk lies and how it is packed; log times [ns]; ``end`` is the offset just behind the record."""

    offset: int
    end: int
    data_offset: int
    data_bytes: int
    compression: str
    uncompressed_bytes: int
    crc: int
    start_ns: int
    end_ns: int


class Entry(NamedTuple):
    """A message record: times in ns."""

    log_time: int
    publish_time: int
    channel: int
    raw: bytes


def record_at(buffer: Any, offset: int, limit: int) -> tuple[int, int, int]:
    """(opcode, start of the body, end of the record) at ``offset``; Damage when it does not fit below ``limit``."""
    if offset + 9 > limit:
        raise Damage('the file ends inside a record')
    opcode, length = _PREFIX.unpack_from(buffer, offset)
    if offset + 9 + length > limit:
        raise Damage('a record is longer than the file')
    return opcode, offset + 9, offset + 9 + length


def records(buffer: Any, offset: int, limit: int) -> Iterator[tuple[int, int, int]]:
    """Successive records of ``buffer[offset:limit]``, which they must fill exactly."""
    while offset < limit:
        opcode, start, offset = record_at(buffer, offset, limit)
        yield opcode, start, offset


def parse(kind: Any, body: bytes) -> Any:
    """A record of the ``mcap`` package from its body; one that would be written in another way is Damage."""
    builder = RecordBuilder()
    try:
        record = kind.read(ReadDataStream(BytesIO(body)))
        record.write(builder)
    except Exception as error:  # struct.error, UnicodeDecodeError, EndOfFile ...
        raise Damage(f'a {kind.__name__} record is unreadable') from error
    # A string that claims more bytes than there are is cut off in silence by the reader: only the way back tells.
    if builder.end()[9:] != body:
        raise Damage(f'a {kind.__name__} record contradicts its length')
    return record


def chunk_at(buffer: Any, offset: int, limit: int, strict: bool = True) -> Chunk | None:
    """The chunk that begins at ``offset``, None where its lengths contradict each other or the file.

    The opcode is not looked at: a chunk is known by its lengths and judged by its CRC. ``strict=False`` also accepts
    one whose record length is wrong.
    """
    if offset < 0 or offset + _CHUNK.size + 8 > limit:
        return None
    _, length, start_ns, end_ns, unpacked, crc, name_bytes = _CHUNK.unpack_from(buffer, offset)
    if name_bytes > 8:
        return None
    name = bytes(buffer[offset + _CHUNK.size:offset + _CHUNK.size + name_bytes])
    data = offset + _CHUNK.size + name_bytes + 8
    if name not in (b'', b'zstd', b'lz4') or data > limit:
        return None
    data_bytes = _U64.unpack_from(buffer, data - 8)[0]
    if data + data_bytes > limit or (strict and data + data_bytes != offset + 9 + length):
        return None
    return Chunk(offset, data + data_bytes, data, data_bytes, name.decode(), unpacked, crc, start_ns, end_ns)


def indexed_chunk(buffer: Any, index: ChunkIndex) -> Chunk:
    """The chunk an index entry points to. Lengths come from the index, whose own CRC vouches for them."""
    offset, data = index.chunk_start_offset, index.chunk_start_offset + _CHUNK.size + len(index.compression) + 8
    end = offset + index.chunk_length
    if offset + _CHUNK.size > len(buffer) or data + index.compressed_size > len(buffer):
        raise Damage('the index points behind the end of the file')
    crc = _CHUNK.unpack_from(buffer, offset)[5]
    return Chunk(offset, end, data, index.compressed_size, index.compression, index.uncompressed_size, crc,
                 index.message_start_time, index.message_end_time)


def unpack(buffer: Any, chunk: Chunk, needs_crc: bool) -> bytes:
    """The records inside a chunk; Damage when it does not decompress or its CRC does not match.

    :param needs_crc: whether other chunks of the file have a CRC: one without has lost it.
    """
    if chunk.uncompressed_bytes > LARGEST_CHUNK:
        raise Damage('a chunk claims an impossible size')
    packed = bytes(buffer[chunk.data_offset:chunk.data_offset + chunk.data_bytes])
    try:
        data = _decompress(packed, chunk)
    except Exception as error:  # ZstdError, RuntimeError of lz4, MemoryError ...
        raise Damage('a chunk does not decompress') from error
    if len(data) != chunk.uncompressed_bytes:
        raise Damage('a chunk has the wrong size')
    if (chunk.crc or needs_crc) and zlib.crc32(data) != chunk.crc:
        raise Damage('a chunk does not match its checksum')
    return data


def _decompress(packed: bytes, chunk: Chunk) -> bytes:
    if chunk.compression == 'zstd':
        return zstandard.decompress(packed, max_output_size=chunk.uncompressed_bytes)
    return bytes(lz4.frame.decompress(packed)) if chunk.compression == 'lz4' else packed


def entry(buffer: Any, start: int, end: int) -> Entry:
    """The message record with this body."""
    if end - start < _MESSAGE.size:
        raise Damage('a message record is too short')
    channel, _, log_time, publish_time = _MESSAGE.unpack_from(buffer, start)
    return Entry(log_time, publish_time, channel, bytes(buffer[start + _MESSAGE.size:end]))


class Definitions(NamedTuple):
    """Schemas and channels by their ids."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]

    def learn(self, opcode: int, body: bytes) -> None:
        """Keep a schema or channel record; the first definition of an id stays."""
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, body)
            self.schemas.setdefault(schema.id, schema)
        else:
            channel = parse(Channel, body)
            self.channels.setdefault(channel.id, channel)


def entries(data: Any, definitions: Definitions, start: int = 0, end: int | None = None) -> list[Entry]:
    """The messages among the records ``data[start:end]``; schemas and channels go to ``definitions``."""
    found = []
    for opcode, begin, stop in records(data, start, len(data) if end is None else end):
        if opcode == Opcode.MESSAGE:
            found.append(entry(data, begin, stop))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.learn(opcode, bytes(data[begin:stop]))
    return found
