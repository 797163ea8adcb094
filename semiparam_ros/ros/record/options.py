"""Options of a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from semiparam_ros.bags.writer import partial_path
from semiparam_ros.errors import SemiparamError
from semiparam_ros.playback.timeline import Selection

DEFAULT_NODE = '/estimator'


@dataclass(frozen=True)
class Limits:
    """Limits at which a recording ends by itself; None: only by a signal.

    :param count: after so many messages, on ``count_topic`` or on all topics together
    :param idle_s: when nothing arrived for so long [s], after something did
    :param duration_s: so long after the start [s]
    """

    count: int | None = None
    count_topic: str | None = None
    idle_s: float | None = None
    duration_s: float | None = None

    def __post_init__(self) -> None:
        for what, value in (('count', self.count), ('idle time', self.idle_s), ('duration', self.duration_s)):
            if value is not None and not 0 < value < float('inf'):
                raise SemiparamError(f'the {what} must be a finite number above 0, got {value:g}.')


@dataclass(frozen=True)
class RecordOptions:
    """Options of a recording: where to, what and how long.

    :param nodes: record what these nodes publish and what they subscribe to
    :param topics: and these topics, whoever publishes them
    :param everything: or every topic there is
    :param selection: leaves some of them out
    """

    path: Path
    nodes: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    everything: bool = False
    selection: Selection = field(default_factory=Selection)
    limits: Limits = field(default_factory=Limits)
    compression: str = 'zstd'
    wait_s: float = 30.0
    progress: bool = True
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.path.exists() and not self.overwrite:
            raise SemiparamError(f'{str(self.path)!r} exists already: choose another name or say --overwrite.')
        if not 0.0 <= self.wait_s < float('inf'):
            raise SemiparamError(f'the time to wait must be a finite number of at least 0, got {self.wait_s:g}.')
        partial = partial_path(self.path)
        if partial.exists() and not self.overwrite:
            raise SemiparamError(f'{str(partial)!r} holds a recording that broke off, or is being made: choose another '
                                 'name or say --overwrite.')
        if not (self.nodes or self.topics or self.everything):
            raise SemiparamError('nothing to record: expected a node, a topic or everything.')


def parse_count(text: str) -> tuple[int, str | None]:
    """Parse ``N`` or ``TOPIC=N``."""
    topic, _, number = text.rpartition('=')
    if not number.isdecimal():
        raise SemiparamError(f"'{text}' is no count: expected N or TOPIC=N.")
    return int(number), topic or None
