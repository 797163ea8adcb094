"""What could not be read from a damaged bag, as figures and as a sentence."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Losses:
    """The account of a bag: falsy when nothing is wrong with it.

    ``intact`` is the number of messages the bag held before it was damaged, None where nothing tells;
    ``byte_ranges`` are the half-open ranges of the file that could not be used.
    """

    path: str
    saved: int = 0
    intact: int | None = None
    chunks: int = 0
    chunks_lost: int = 0
    byte_ranges: list[tuple[int, int]] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    undecodable: dict[str, int] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.chunks_lost or self.byte_ranges or self.reasons or self.undecodable)

    @property
    def messages_lost(self) -> int | None:
        """How many messages are missing; None where nothing tells."""
        return None if self.intact is None else max(self.intact - self.saved, 0)

    @property
    def sentence(self) -> str:
        """The whole account in one sentence, '' when nothing is wrong."""
        if not self:
            return ''
        of = '' if self.intact is None else f' of {self.intact}'
        parts = [*self.reasons, f'{self.saved}{of} messages read']
        if self.chunks_lost:
            parts.append(f'{self.chunks_lost} of {self.chunks} chunks lost')
        if self.byte_ranges:
            parts.append('unreadable bytes ' + _ranges(self.byte_ranges))
        parts += [f'{count} messages on {topic} do not decode' for topic, count in sorted(self.undecodable.items())]
        return f'{self.path!r} is damaged: ' + '; '.join(parts) + '.'

    def __str__(self) -> str:
        return self.sentence


def _ranges(ranges: list[tuple[int, int]], shown: int = 4) -> str:
    text = ', '.join(f'{start}-{end}' for start, end in ranges[:shown])
    return text if len(ranges) <= shown else f'{text} and {len(ranges) - shown} more ranges'
