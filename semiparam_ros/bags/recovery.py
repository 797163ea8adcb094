"""A damaged MCAP file, read as far as it goes.

Without a usable index the records are walked from the start of the file. Where the chain of lengths is broken, the
next chunk is searched for; every chunk has to pass its CRC before a message of it counts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from mcap.opcode import Opcode
from mcap.records import Attachment, Header, Metadata

from semiparam_ros.bags import mcap_format
from semiparam_ros.bags.mcap_format import MAGIC, Buffer, Chunk, Damage, Entry, Index, Readable, Segment

# Records that are kept for nothing, but have to be what they claim before their length is believed.
_PASSED_BY: dict[int, type[Readable]] = {Opcode.HEADER: Header, Opcode.ATTACHMENT: Attachment,
                                         Opcode.METADATA: Metadata}
_LAST_RECORDS: dict[int, int] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}
_PRIVATE_OPCODES = 0x80
_LONGEST_RUN = 4096  # messages outside chunks that are read at once
_MARKERS = (b'\x04\x00\x00\x00zstd', b'\x03\x00\x00\x00lz4')
_MARKER_OFFSET = 37  # of the compression's name in a chunk record


def scan(buffer: Buffer, reason: str | None) -> Index:
    """Find every readable segment of the file.

    :param reason: why there is no index; None for an undamaged file that was written without one.
    """
    return _Scan(buffer, reason).index


class _Scan:
    """One walk over the records of a file; the result is ``index``."""

    def __init__(self, buffer: Buffer, reason: str | None) -> None:
        self.buffer = buffer
        self.index = Index()
        self.losses = self.index.losses
        self.losses.reasons += [] if reason is None else [reason]
        self._counts: Counter[int] = Counter()
        self._loose: list[tuple[int, int, Entry]] = []
        self._lost_chunk = False
        self._has_crcs = False
        self._whole = False
        self._broken = False
        self._indexed_loss = 0
        offset: int | None = len(MAGIC)
        while offset is not None and offset < len(buffer):
            offset = self._step(offset)
        self._finish()

    def _step(self, offset: int) -> int | None:
        """Read the record at ``offset``; return where the next one begins, None behind the last."""
        chunk = mcap_format.chunk_at(self.buffer, offset, len(self.buffer))
        if chunk is not None:
            self._add_chunk(chunk)
            return chunk.end
        try:
            opcode, start, end = mcap_format.record_at(self.buffer, offset, len(self.buffer))
            return self._record(opcode, start, end)
        except Damage:
            return self._search(offset)

    def _record(self, opcode: int, start: int, end: int) -> int | None:
        if _LAST_RECORDS.get(opcode) == end - start:
            self._whole = True
            return None
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.index.definitions.learn(opcode, bytes(self.buffer[start:end]))
        elif opcode == Opcode.MESSAGE:
            self._add_message(start, end)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._count_lost(start, end)
        elif opcode in _PASSED_BY:
            mcap_format.parse(_PASSED_BY[opcode], bytes(self.buffer[start:end]))
        elif opcode < _PRIVATE_OPCODES:
            raise Damage('no record can begin here')
        return end

    def _add_message(self, start: int, end: int) -> None:
        """A message outside chunks: no CRC guards it, but its channel must be known."""
        entry = mcap_format.entry(self.buffer, start, end)
        if entry.channel not in self.index.definitions.channels:
            raise Damage('a message of an unknown channel')
        self._loose.append((start - 9, end, entry))
        if len(self._loose) >= _LONGEST_RUN:
            self._close_run()

    def _add_chunk(self, chunk: Chunk) -> bool:
        """Add a chunk and return whether it is readable; a lost one is entered in the account."""
        self._close_run()
        self.losses.chunks += 1
        self._lost_chunk = False
        try:
            data = mcap_format.unpack(self.buffer, chunk, self._has_crcs)
            found = mcap_format.entries(data, self.index.definitions)
        except Damage as damage:
            self._lose(chunk.offset, chunk.end, str(damage))
            self.losses.chunks_lost += 1
            self._lost_chunk = True
            return False
        self._has_crcs |= chunk.crc != 0
        if found:
            self._add_segment(chunk.offset, chunk.end, found, chunk)
        return True

    def _add_segment(self, offset: int, end: int, found: list[Entry], chunk: Chunk | None) -> None:
        times = [entry.log_time for entry in found]
        counts = Counter(entry.channel for entry in found)
        self._counts.update(counts)
        self.index.segments.append(Segment(offset, end, min(times), max(times), chunk, frozenset(counts)))

    def _close_run(self) -> None:
        if self._loose:
            found = [entry for _, _, entry in self._loose]
            self._add_segment(self._loose[0][0], self._loose[-1][1], found, None)
            self._loose = []

    def _count_lost(self, start: int, end: int) -> None:
        """A message index behind a lost chunk still tells how many messages were in it."""
        body = bytes(self.buffer[start:end])
        if len(body) < 6 or int.from_bytes(body[2:6], 'little') != len(body) - 6:
            raise Damage('a message index has the wrong length')
        if self._lost_chunk:
            self._indexed_loss += (len(body) - 6) // 16

    def _search(self, offset: int) -> int | None:
        """Find where reading can go on from a broken record; the bytes between are lost."""
        self._close_run()
        self._broken = True
        following = _next_chunk(self.buffer, offset)
        if following is None or following.offset > offset:
            lost = _begins_like_a_chunk(self.buffer, offset)
            self.losses.chunks += lost
            self.losses.chunks_lost += lost
        if following is None:
            self._lose(offset, len(self.buffer), 'the file ends inside a record')
            return None
        self._lose(offset, following.offset, 'a record is damaged')
        # The length of a chunk that fails its CRC may be the very thing that is damaged: look on inside it.
        return following.end if self._add_chunk(following) else following.offset + _MARKER_OFFSET

    def _lose(self, start: int, end: int, reason: str) -> None:
        ranges = self.losses.byte_ranges
        if ranges and start <= ranges[-1][1]:
            start = ranges.pop()[0]
        if end > start:
            ranges.append((start, end))
        if reason not in self.losses.reasons:
            self.losses.reasons.append(reason)

    def _finish(self) -> None:
        self._close_run()
        index, known = self.index, self.index.definitions.channels
        unnamed = sum(count for channel, count in self._counts.items() if channel not in known)
        if unnamed:
            self.losses.reasons.append(f'{unnamed} messages belong to topics whose definitions are '
                                       'lost')
        index.counts = {channel: count for channel, count in self._counts.items() if channel in known}
        index.start_ns = min((segment.start_ns for segment in index.segments), default=0)
        index.end_ns = max((segment.end_ns for segment in index.segments), default=0)
        if self._whole and not self._broken:
            self.losses.intact = sum(self._counts.values()) + self._indexed_loss


def _begins_like_a_chunk(buffer: Buffer, offset: int) -> bool:
    marker = bytes(buffer[offset + _MARKER_OFFSET:offset + _MARKER_OFFSET + 8])
    return buffer[offset] == Opcode.CHUNK or any(marker.startswith(known) for known in _MARKERS)


def _next_chunk(buffer: Buffer, offset: int) -> Chunk | None:
    """The first chunk at or after ``offset``: found by its compression's name, or by lengths that agree."""
    found = [*_packed_chunks(buffer, offset), *_plain_chunks(buffer, offset)]
    return min(found, default=None, key=lambda chunk: chunk.offset)


def _packed_chunks(buffer: Buffer, offset: int) -> Iterator[Chunk]:
    for marker in _MARKERS:
        position = buffer.find(marker, offset + _MARKER_OFFSET)
        while position >= 0:
            chunk = mcap_format.chunk_at(buffer, position - _MARKER_OFFSET, len(buffer), strict=False)
            if chunk is not None:
                yield chunk
                break
            position = buffer.find(marker, position + 1)


def _plain_chunks(buffer: Buffer, offset: int) -> Iterator[Chunk]:
    position = buffer.find(b'\x06', offset)
    while position >= 0:
        chunk = mcap_format.chunk_at(buffer, position, len(buffer))
        if chunk is not None:
            yield chunk
            return
        position = buffer.find(b'\x06', position + 1)
