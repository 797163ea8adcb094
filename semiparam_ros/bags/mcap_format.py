"""The records of an MCAP file, read one by one with every length checked, and where they lie from the summary at its
end.

The record types are those of the ``mcap`` package. Its readers stop at the first damaged byte of a file; here each
chunk stands for itself, and whatever is wrong with it becomes a :class:`Damage`.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics

from semiparam_ros.bags.base import Losses

MAGIC = b'\x89MCAP0\r\n'
FOOTER_BYTES = 9 + 20
Buffer: TypeAlias = bytes | bytearray | mmap.mmap


class Readable(Protocol):
    """A record class of the ``mcap`` package."""

    @staticmethod
    def read(stream: ReadDataStream) -> Any:
        """The record whose body is next."""

    def write(self, stream: RecordBuilder) -> None:
        """Append it."""


Record = TypeVar('Record', bound=Readable)

LARGEST_CHUNK = 2**30  # bytes; a damaged length must not be taken for an order to allocate memory

_PREFIX = struct.Struct('<BQ')
_CHUNK = struct.Struct('<BQQQQII')  # opcode, length, start, end, uncompressed size, CRC, length of compression
_MESSAGE = struct.Struct('<HIQQ')
_U64 = struct.Struct('<Q')


class Damage(Exception):
    """A part of the file that cannot be what it claims; the text says why."""


class Chunk(NamedTuple):
    """Place and packing of a chunk; log times [ns]; ``end`` is the offset just behind the record.
    """

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


def record_at(buffer: Buffer, offset: int, limit: int) -> tuple[int, int, int]:
    """Opcode, start of the body and end of the record at ``offset``; Damage if it passes ``limit``.
    """
    if offset + 9 > limit:
        raise Damage('the file ends inside a record')
    opcode, length = _PREFIX.unpack_from(buffer, offset)
    if opcode == 0:
        raise Damage('no record can begin here')
    if offset + 9 + length > limit:
        raise Damage('a record is longer than the file')
    return opcode, offset + 9, offset + 9 + length


def records(buffer: Buffer, offset: int, limit: int) -> Iterator[tuple[int, int, int]]:
    """Successive records of ``buffer[offset:limit]``, which they must fill exactly."""
    while offset < limit:
        opcode, start, offset = record_at(buffer, offset, limit)
        yield opcode, start, offset


def parse(kind: type[Record], body: bytes) -> Record:
    """A record of the ``mcap`` package from its body; one that would be written in another way is Damage."""
    builder = RecordBuilder()
    try:
        record: Record = kind.read(ReadDataStream(BytesIO(body)))
        record.write(builder)
    except Exception as error:  # struct.error, UnicodeDecodeError, EndOfFile ...
        raise Damage(f'a {kind.__name__} record is unreadable') from error
    # A string that claims more bytes than there are is cut off in silence by the reader: only the way back tells.
    if builder.end()[9:] != body:
        raise Damage(f'a {kind.__name__} record contradicts its length')
    return record


def chunk_at(buffer: Buffer, offset: int, limit: int, strict: bool = True) -> Chunk | None:
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


def indexed_chunk(buffer: Buffer, index: ChunkIndex) -> Chunk:
    """The chunk an index entry points to. Lengths come from the index, whose own CRC vouches for them."""
    offset, data = index.chunk_start_offset, index.chunk_start_offset + _CHUNK.size + len(index.compression) + 8
    end = offset + index.chunk_length
    if offset + _CHUNK.size > len(buffer) or data + index.compressed_size > len(buffer):
        raise Damage('the index points behind the end of the file')
    crc = _CHUNK.unpack_from(buffer, offset)[5]
    return Chunk(offset, end, data, index.compressed_size, index.compression, index.uncompressed_size, crc,
                 index.message_start_time, index.message_end_time)


def unpack(buffer: Buffer, chunk: Chunk, needs_crc: bool) -> bytes:
    """The records inside a chunk; Damage when it does not decompress or its CRC does not match.

    :param needs_crc: whether other chunks of the file have a CRC: one without has lost it.
    """
    if chunk.uncompressed_bytes > LARGEST_CHUNK:
        raise Damage('a chunk claims an impossible size')
    packed = bytes(buffer[chunk.data_offset:chunk.data_offset + chunk.data_bytes])
    try:
        data = _decompress(packed, chunk)
    except Damage:
        raise
    except Exception as error:  # ZstdError, RuntimeError of lz4, MemoryError ...
        raise Damage('a chunk does not decompress') from error
    if len(data) != chunk.uncompressed_bytes:
        raise Damage('a chunk has the wrong size')
    if (chunk.crc or needs_crc) and zlib.crc32(data) != chunk.crc:
        raise Damage('a chunk does not match its checksum')
    return data


def _decompress(packed: bytes, chunk: Chunk) -> bytes:
    """No more bytes than the chunk says: what is packed may say otherwise."""
    size = chunk.uncompressed_bytes
    if chunk.compression == 'zstd':
        if zstandard.frame_content_size(packed) not in (-1, size):  # -1: the frame does not tell
            raise Damage('a chunk has the wrong size')
        return zstandard.decompress(packed, max_output_size=size)
    if chunk.compression == 'lz4':
        reader = lz4.frame.LZ4FrameDecompressor()
        data = bytes(reader.decompress(packed, max_length=size + 1))
        if not reader.eof:
            raise Damage('a chunk has the wrong size')
        return data
    return packed


def entry(buffer: Buffer, start: int, end: int) -> Entry:
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


def entries(data: Buffer, definitions: Definitions, start: int = 0, end: int | None = None) -> list[Entry]:
    """The messages among the records ``data[start:end]``; schemas and channels go to ``definitions``."""
    found = []
    for opcode, begin, stop in records(data, start, len(data) if end is None else end):
        if opcode == Opcode.MESSAGE:
            found.append(entry(data, begin, stop))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.learn(opcode, bytes(data[begin:stop]))
    return found


@dataclass(frozen=True)
class Segment:
    """A chunk, or (``chunk`` None) a run of message records outside chunks; log times [ns]."""

    offset: int
    end: int
    start_ns: int
    end_ns: int
    chunk: Chunk | None = None
    channels: frozenset[int] | None = None


@dataclass
class Index:
    """Segments in the order of the file, definitions, messages of each channel, and what is wrong
    so far."""

    segments: list[Segment] = field(default_factory=list)
    definitions: Definitions = field(default_factory=lambda: Definitions({}, {}))
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    losses: Losses = field(default_factory=Losses)


class Incomplete(Exception):
    """The file is not damaged, but its summary leaves out what is needed here."""


def read_summary(buffer: Buffer) -> Index:
    """The index of a whole file; Damage when its end is damaged, Incomplete when it was written without one."""
    footer = _footer(buffer)
    if footer.summary_start == 0:
        raise Incomplete
    index, chunks, statistics = Index(), list[ChunkIndex](), None
    for opcode, start, end in records(buffer, footer.summary_start, len(buffer) - len(MAGIC)):
        body = bytes(buffer[start:end])
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            index.definitions.learn(opcode, body)
        elif opcode == Opcode.CHUNK_INDEX:
            chunks.append(parse(ChunkIndex, body))
        elif opcode == Opcode.STATISTICS:
            statistics = parse(Statistics, body)
    if statistics is None or not _covers(index.definitions, chunks, statistics):
        raise Incomplete
    index.segments = [_segment(buffer, entry) for entry in sorted(chunks, key=lambda c: c.chunk_start_offset)]
    if any(segment.chunk != chunk_at(buffer, segment.offset, len(buffer)) for segment in index.segments):
        index.losses.reasons.append('the header of a chunk contradicts the index')
    index.counts = dict(statistics.channel_message_counts)
    index.losses.intact = statistics.message_count
    index.start_ns, index.end_ns = statistics.message_start_time, statistics.message_end_time
    index.losses.chunks = len(chunks)
    return index


def _footer(buffer: Buffer) -> Footer:
    """The footer, once the CRC of the summary is found right."""
    start = len(buffer) - FOOTER_BYTES - len(MAGIC)
    if start < len(MAGIC) or bytes(buffer[-len(MAGIC):]) != MAGIC:
        raise Damage('the end of the file is missing')
    opcode, begin, end = record_at(buffer, start, len(buffer) - len(MAGIC))
    if opcode != Opcode.FOOTER or end != len(buffer) - len(MAGIC):
        raise Damage('the footer is damaged')
    footer = parse(Footer, bytes(buffer[begin:end]))
    if not (footer.summary_start == 0 or len(MAGIC) <= footer.summary_start <= start):
        raise Damage('the footer is damaged')
    # The CRC reaches from the first summary record to the footer's own CRC field.
    if footer.summary_crc and footer.summary_start \
            and zlib.crc32(buffer[footer.summary_start:end - 4]) != footer.summary_crc:
        raise Damage('the index does not match its checksum')
    return footer


def _covers(definitions: Definitions, chunks: list[ChunkIndex], statistics: Statistics) -> bool:
    """Tell whether every message can be found and named by the summary alone."""
    channels, schemas = definitions.channels, definitions.schemas
    named = all(channel in channels for channel in statistics.channel_message_counts)
    defined = all(channel.schema_id in schemas for channel in channels.values() if channel.schema_id)
    indexed = len(chunks) == statistics.chunk_count and (statistics.message_count == 0 or bool(chunks))
    return named and defined and indexed and sum(statistics.channel_message_counts.values()) == statistics.message_count


def _segment(buffer: Buffer, entry: ChunkIndex) -> Segment:
    chunk = indexed_chunk(buffer, entry)
    channels = frozenset(entry.message_index_offsets) if entry.message_index_offsets else None
    return Segment(chunk.offset, chunk.end, chunk.start_ns, chunk.end_ns, chunk, channels)
