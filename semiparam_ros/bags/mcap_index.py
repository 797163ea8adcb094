"""Where everything lies in an MCAP file, from the summary at its end."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Any

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, Statistics

from semiparam_ros.bags import mcap_records
from semiparam_ros.bags.mcap_records import FOOTER_BYTES, MAGIC, Chunk, Damage, Definitions


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
    """Segments in the order of the file, definitions, messages of each channel, and what is wrong.

    ``intact`` is the number of messages before any damage, None where nothing tells.
    """

    segments: list[Segment] = field(default_factory=list)
    definitions: Definitions = field(default_factory=lambda: Definitions({}, {}))
    counts: dict[int, int] = field(default_factory=dict)
    intact: int | None = None
    start_ns: int = 0
    end_ns: int = 0
    chunks: int = 0
    chunks_lost: int = 0
    byte_ranges: list[tuple[int, int]] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)


class Incomplete(Exception):
    """The file is not damaged, but its summary leaves out what is needed here."""


def read_summary(buffer: Any) -> Index:
    """The index of a whole file; Damage when its end is damaged, Incomplete when it was written without one."""
    footer = _footer(buffer)
    if footer.summary_start == 0:
        raise Incomplete
    index, chunks, statistics = Index(), list[ChunkIndex](), None
    for opcode, start, end in mcap_records.records(buffer, footer.summary_start, len(buffer) - len(MAGIC)):
        body = bytes(buffer[start:end])
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            index.definitions.learn(opcode, body)
        elif opcode == Opcode.CHUNK_INDEX:
            chunks.append(mcap_records.parse(ChunkIndex, body))
        elif opcode == Opcode.STATISTICS:
            statistics = mcap_records.parse(Statistics, body)
    if statistics is None or not _covers(index.definitions, chunks, statistics):
        raise Incomplete
    index.segments = [_segment(buffer, entry) for entry in sorted(chunks, key=lambda c: c.chunk_start_offset)]
    if any(segment.chunk != mcap_records.chunk_at(buffer, segment.offset, len(buffer)) for segment in index.segments):
        index.reasons.append('the header of a chunk contradicts the index')
    index.counts, index.intact = dict(statistics.channel_message_counts), statistics.message_count
    index.start_ns, index.end_ns = statistics.message_start_time, statistics.message_end_time
    index.chunks = len(chunks)
    return index


def _footer(buffer: Any) -> Footer:
    """The footer, once the CRC of the summary is found right."""
    start = len(buffer) - FOOTER_BYTES - len(MAGIC)
    if start < len(MAGIC) or bytes(buffer[-len(MAGIC):]) != MAGIC:
        raise Damage('the end of the file is missing')
    opcode, begin, end = mcap_records.record_at(buffer, start, len(buffer) - len(MAGIC))
    if opcode != Opcode.FOOTER or end != len(buffer) - len(MAGIC):
        raise Damage('the footer is damaged')
    footer: Footer = mcap_records.parse(Footer, bytes(buffer[begin:end]))
    if not (footer.summary_start == 0 or len(MAGIC) <= footer.summary_start <= start):
        raise Damage('the footer is damaged')
    # The CRC reaches from the first summary record to the footer's own CRC field.
    if footer.summary_crc and footer.summary_start \
            and zlib.crc32(buffer[footer.summary_start:end - 4]) != footer.summary_crc:
        raise Damage('the index does not match its checksum')
    return footer


def _covers(definitions: Definitions, chunks: list[ChunkIndex], statistics: Statistics) -> bool:
    """Whether every message can be found and named by the summary alone."""
    channels, schemas = definitions.channels, definitions.schemas
    named = all(channel in channels for channel in statistics.channel_message_counts)
    defined = all(channel.schema_id in schemas for channel in channels.values() if channel.schema_id)
    indexed = len(chunks) == statistics.chunk_count and (statistics.message_count == 0 or bool(chunks))
    return named and defined and indexed and sum(statistics.channel_message_counts.values()) == statistics.message_count


def _segment(buffer: Any, entry: ChunkIndex) -> Segment:
    chunk = mcap_records.indexed_chunk(buffer, entry)
    channels = frozenset(entry.message_index_offsets) if entry.message_index_offsets else None
    return Segment(chunk.offset, chunk.end, chunk.start_ns, chunk.end_ns, chunk, channels)
