"""The report of a playback: what was published, what was answered and what could not be read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from semiparam_ros.core.stamps import in_seconds
from semiparam_ros.playback.flow_control import FlowControl

INTERRUPTED = 130


@dataclass(frozen=True)
class ReplayAccount:
    """Account of a playback, told at its end.

    :param ending: 'finished', 'stopped' or 'failed'
    :param answers: the finished flow control of each topic of answers
    :param failures: what makes the exit code 1, one sentence each
    :param losses: one sentence for each damaged bag
    :param lossless: that every message is answered was promised
    """

    ending: str
    duration_s: float
    published: dict[str, int]
    answers: Mapping[str, FlowControl] = field(default_factory=dict)
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
        answers = [_answered(topic, flow) for topic, flow in self.answers.items()]
        return [first, *answers, *self.losses]

    def to_dict(self) -> dict[str, object]:
        """Convert to a dictionary for ``--json``."""
        answers = [_as_dict(topic, flow) for topic, flow in self.answers.items()]
        return {'ending': self.ending, 'duration_s': self.duration_s, 'messages': self.messages,
                'published': dict(self.published), 'answers': answers,
                'failures': list(self.failures), 'losses': list(self.losses), 'skipped': dict(self.skipped)}


def _answered(topic: str, flow: FlowControl) -> str:
    """Sentence such as ``/estimator/residual answered 9 of 10 messages on /wrench; ...``"""
    text = f'{topic} answered {flow.answers} of {flow.requests} messages on {flow.request_topic}'
    unanswered = flow.unanswered_stamps
    if unanswered:
        text += f'; {len(unanswered)} unanswered, the first stamped {in_seconds(unanswered[0])} s'
    if flow.unexpected:
        text += f'; {flow.unexpected} answers to nothing that was asked'
    return text + '.'


def _as_dict(topic: str, flow: FlowControl) -> dict[str, object]:
    unanswered = flow.unanswered_stamps
    return {'topic': topic, 'request_topic': flow.request_topic, 'requests': flow.requests,
            'answers': flow.answers, 'unexpected': flow.unexpected, 'unanswered': len(unanswered),
            'first_unanswered_stamp_ns': unanswered[0] if unanswered else None}
