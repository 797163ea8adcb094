"""One recording from the first look at the graph to the finished file, and how far it is."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from rich.console import Console
from rich.status import Status

from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.errors import SemiparamError, listed
from semiparam_ros.ros.context import DELIVER_S, RosProcess, call_in_executor
from semiparam_ros.ros.discovery import Stopped, handshake, require_topic_names, wait_until
from semiparam_ros.ros.record import topics
from semiparam_ros.ros.record.node import RecordNode
from semiparam_ros.ros.record.options import RecordOptions

LINE_S = 10.0

LOOK_S = 0.2
FLUSH_S = 2.0
POLL_S = 0.05
QUIET_S = 0.5


class RecordProgress:
    """Context manager; :meth:`update` is to be called every now and then."""

    def __init__(self, recording: RecordNode, console: Console, shown: bool) -> None:
        self._recording = recording
        self._console = console
        self._shown = shown
        self._status: Status | None = console.status('') if shown and console.is_terminal else None
        self._began = self._reported_at = time.monotonic()

    def __enter__(self) -> RecordProgress:
        if self._status is not None:
            self.update()
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is not None:
            self._status.stop()

    def update(self) -> None:
        """Show the present figures."""
        if self._status is not None:
            self._status.update(f'recording, Ctrl-C ends: {self._line()}')
        elif self._shown and time.monotonic() - self._reported_at > LINE_S:
            self._reported_at = time.monotonic()
            self._console.print(self._line(), soft_wrap=True)

    def _line(self) -> str:
        return f'{time.monotonic() - self._began:.0f} s, {self._recording.messages} messages'


@dataclass(frozen=True)
class RecordAccount:
    """Account of a recording."""

    path: str
    duration_s: float
    recorded: dict[str, int]
    skipped: tuple[str, ...] = ()

    @property
    def messages(self) -> int:
        """Messages of all topics."""
        return sum(self.recorded.values())

    @property
    def sentence(self) -> str:
        """Account in one sentence."""
        topics = ', '.join(f'{topic} {count}' for topic, count in sorted(self.recorded.items()))
        return f'recorded {self.messages} messages in {self.duration_s:.1f} s to {self.path}: {topics}.'

    def to_dict(self) -> dict[str, object]:
        """Convert to a dictionary for ``--json``."""
        return {'path': self.path, 'duration_s': self.duration_s, 'messages': self.messages,
                'recorded': dict(self.recorded), 'skipped': list(self.skipped)}


class RecordSession:
    """Records what the options name. Use :meth:`run` once."""

    def __init__(self, options: RecordOptions, console: Console, ros_arguments: Sequence[str]) -> None:
        self._options = options
        self._console = console
        self._ros_arguments = ros_arguments
        self._stopping = threading.Event()
        self._skipped: dict[str, str] = {}
        self._began = time.monotonic()

    def run(self) -> RecordAccount:
        """Record until a limit or a signal; raises SemiparamError when nothing was received.

        A file of the name appears only when the recording is whole. What fails later leaves the part so far as
        ``NAME.partial``, which every command of this package reads.
        """
        counted = self._options.limits.count_topic
        require_topic_names([*self._options.topics, *([] if counted is None else [counted])])
        writer = BagWriter(self._options.path, self._options.compression, overwrite=self._options.overwrite)
        try:
            return self._record(writer)
        finally:
            if not writer.message_count:
                writer.abort()

    def _record(self, writer: BagWriter) -> RecordAccount:
        with RosProcess(self._ros_arguments, self._stopping.set) as ros:
            node = RecordNode(writer, self._options.limits)
            ros.spin(node)
            try:
                self._find(node)
                self._wait_for_the_end(node, writer)
            except Stopped:
                pass
            self._let_the_last_arrive(ros, node)
            node.write_arrived()
            _check(ros, node, writer)
            self._require_name(writer)
            writer.close()
            if node.went_back:
                self._say('the clock went back meanwhile: messages of before and after it share log times, and are '
                          'played mixed.')
            return RecordAccount(str(self._options.path), time.monotonic() - self._began, dict(node.counts),
                                 tuple(self._skipped.values()))

    def _require_name(self, writer: BagWriter) -> None:
        """Raise SemiparamError where a file has got the name meanwhile that nobody said to replace."""
        if os.path.lexists(writer.path) and not self._options.overwrite:
            writer.flush()
            raise SemiparamError(f'{str(writer.path)!r} has appeared meanwhile and is not replaced; '
                                 f'{str(writer.partial_path)!r} holds the recording.')

    def _find(self, node: RecordNode) -> None:
        """Subscribe to everything named, and say so once it is connected."""
        missing: list[str] = []

        def ready() -> bool:
            nonlocal missing
            missing = self._look(node) + ['/clock'] * (not node.now())
            return not missing and node.connected()

        if not wait_until(ready, self._options.wait_s, self._stopping):
            raise SemiparamError(f'{", ".join(missing) or "some publisher"} was not found within '
                                 f'{self._options.wait_s:g} s.')
        met: set[str] = set()
        while new := topics.sources(node, node.topics) - met:
            for name in new:
                handshake(node, name, self._stopping)
            met |= new
            self._look(node)  # a node's readers are told apart from its writers: of one that answered both are known
        self._say(f'recording {len(node.topics)} topics: {", ".join(sorted(node.topics))}.' if node.topics else
                  'there is no topic to record yet; each is recorded from when it appears.')
        if node.counted not in (None, *node.topics):
            self._say(f'{node.counted}, of which messages are counted, is not among them yet.')
        self._began = time.monotonic()

    def _look(self, node: RecordNode) -> list[str]:
        """Subscribe to what the graph has now; the names that are still missing."""
        found, missing = topics.find(node, self._options)
        for topic, types in found.items():
            published = [each for each in types if topics.offers(node, topic, each)]
            type_name = node.topics.get(topic, (published or types)[0])
            obstacle = topics.obstacle(type_name)
            if not obstacle:
                call_in_executor(node, partial(node.follow, topic, type_name))
            others = [each for each in published if each != type_name]
            if obstacle or others:
                self._skip(topic, f'{topic} is not recorded: {obstacle}.' if obstacle else
                           f'what is published on {topic} as {listed(others)} is not recorded: its messages are '
                           f'recorded as {type_name}.')
        return missing

    def _skip(self, topic: str, sentence: str) -> None:
        """Tell once for each topic what of it is left out."""
        if topic not in self._skipped:
            self._skipped[topic] = sentence
            self._say(sentence)

    def _wait_for_the_end(self, node: RecordNode, writer: BagWriter) -> None:
        """Write until a limit is reached, doing what is due meanwhile; raises Stopped on a signal."""
        with RecordProgress(node, self._console, self._options.progress) as progress:
            due = [(LOOK_S, lambda: self._look(node)), (LOOK_S, progress.update), (FLUSH_S, writer.flush)]
            last = [time.monotonic()] * len(due)
            while not self._is_over(node):
                if self._stopping.wait(POLL_S):
                    raise Stopped
                node.write_arrived()
                for index, (period, action) in enumerate(due):
                    if time.monotonic() - last[index] > period:
                        last[index] = time.monotonic()
                        action()

    def _is_over(self, node: RecordNode) -> bool:
        limits, now = self._options.limits, time.monotonic()
        idle = limits.idle_s is not None and node.last_message > 0.0 and now - node.last_message > limits.idle_s
        late = limits.duration_s is not None and now - self._began > limits.duration_s
        return node.complete or idle or late

    def _let_the_last_arrive(self, ros: RosProcess, node: RecordNode) -> None:
        """Wait for what was published before the end: DDS sends again after 3 s what a busy
        recorder missed, in parts where that was much.

        A topic comes in order, so nothing of it is missing once a message arrives that was
        published after the end.
        """
        end, last, reported = time.time_ns(), time.monotonic(), False
        ros.stop_spinning()
        later: set[str] = set()
        while not node.complete:
            for topic, published in node.take_late():
                if published <= end:
                    last = time.monotonic()
                elif node.count_publishers(topic) == 1:
                    later.add(topic)
            waited, missing = time.monotonic() - last, node.repeated() - later
            if waited > (DELIVER_S if missing else QUIET_S):
                return
            if waited > QUIET_S and not reported:
                reported = True
                self._say(f'what was published so far on {", ".join(sorted(missing))} may still arrive, for '
                          f'{DELIVER_S:g} s.')
            time.sleep(POLL_S)

    def _say(self, sentence: str) -> None:
        self._console.print(sentence, soft_wrap=True)


def _check(ros: RosProcess, node: RecordNode, writer: BagWriter) -> None:
    """Raise SemiparamError for a recording that broke off or holds nothing."""
    if ros.error is not None:
        reason = str(ros.error).rstrip('.')
        raise SemiparamError(f'the recording broke off: {reason}; {str(writer.partial_path)!r} holds what came before.')
    if not node.messages:
        raise SemiparamError(f'nothing was recorded: no message arrived on {", ".join(node.topics) or "any topic"}.')
