"""The report of a playback: what was published, what was answered and what could not be read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from semiparam_ros.core.stamps import in_seconds
from semiparam_ros.playback.flow_control import FlowControl

INTERRUPTED = 130


@dataclass(frozen=True)
class Answers:
    """Account of what one follower made of the requests; stamps in ns."""

    topic: str
    request_topic: str
    requests: int
    answers: int
    unexpected: int
    unanswered_stamps: tuple[int, ...]

    @classmethod
    def of(cls, topic: str, flow: FlowControl) -> Answers:
        """The figures of a finished flow control."""
        return cls(topic, flow.request_topic, flow.requests, flow.answers, flow.unexpected,
                   tuple(flow.unanswered_stamps))

    @property
    def complete(self) -> bool:
        """Tell whether every request was answered."""
        return self.answers == self.requests

    @property
    def sentence(self) -> str:
        """Sentence such as ``/estimator/residual answered 9 of 10 messages on /wrench; ...``"""
        text = f'{self.topic} answered {self.answers} of {self.requests} messages on {self.request_topic}'
        if self.unanswered_stamps:
            text += f'; {len(self.unanswered_stamps)} unanswered, the first stamped {_stamp(self.unanswered_stamps[0])}'
        if self.unexpected:
            text += f'; {self.unexpected} answers to nothing that was asked'
        return text + '.'

    def to_dict(self) -> dict[str, object]:
        """Convert to a dictionary for ``--json``; stamps in ns."""
        return {'topic': self.topic, 'request_topic': self.request_topic, 'requests': self.requests,
                'answers': self.answers, 'unexpected': self.unexpected, 'unanswered': len(self.unanswered_stamps),
                'first_unanswered_stamp_ns': self.unanswered_stamps[0] if self.unanswered_stamps else None}


@dataclass(frozen=True)
class ReplayAccount:
    """Account of a playback, told at its end.

    :param ending: 'finished', 'stopped' or 'failed'
    :param failures: what makes the exit code 1, one sentence each
    :param losses: one sentence for each damaged bag
    :param lossless: that every message is answered was promised
    """

    ending: str
    duration_s: float
    published: dict[str, int]
    answers: tuple[Answers, ...] = ()
    failures: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()
    skipped: dict[str, str] = field(default_factory=dict)
    lossless: bool = False

    @property
    def messages(self) -> int:
        """Messages published on all topics."""
        return sum(self.published.values())

    @property
    def exit_code(self) -> int:
        """Exit code: 1 for a failure, 130 where a stop broke the promise to followers, else 0."""
        if self.failures:
            return 1
        return INTERRUPTED if self.ending == 'stopped' and self.lossless else 0

    def sentences(self) -> Sequence[str]:
        """The account for a reader, failures apart."""
        topics = ', '.join(f'{topic} {count}' for topic, count in self.published.items())
        pace = f' ({self.messages / self.duration_s:.0f} messages/s)' if self.duration_s > 0.0 else ''
        verb = 'stopped after' if self.ending == 'stopped' else 'published'
        first = f'{verb} {self.messages} messages in {self.duration_s:.1f} s{pace}: {topics}.'
        return [first, *(each.sentence for each in self.answers), *self.losses]

    def to_dict(self) -> dict[str, object]:
        """Convert to a dictionary for ``--json``."""
        return {'ending': self.ending, 'duration_s': self.duration_s, 'messages': self.messages,
                'published': dict(self.published), 'answers': [each.to_dict() for each in self.answers],
                'failures': list(self.failures), 'losses': list(self.losses), 'skipped': dict(self.skipped)}


def _stamp(stamp: int) -> str:
    return f'{in_seconds(stamp)} s'
