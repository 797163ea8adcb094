"""Announcement of changes of the robot: ``~/change``, its log, and a file of records."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from semiparam_ros.atomic_write import append_line
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.change_record import ChangeRecord
from semiparam_ros.online.change_watch import QUIET, STATES
from semiparam_ros.online.file_thread import FileThread
from semiparam_ros.online.folder_lock import FolderLock
from semiparam_ros.online.learner import Learner
from semiparam_ros.ros.estimator.diagnostics import OK, WARN, Report, status_message
from semiparam_ros.ros.estimator.publishers import LATCHED

FILE = 'changes.jsonl'


class Changing:
    """``~/change``, a latched DiagnosticArray of one status: whether the robot is as it was, and
    the latest change.

    :param learner: gives the learner, None before the robot is known. :param folder: where the file
        of records lies. :param lock: the right to write there.
    :param say: receives sentences for the log. :param schedule: see :data:`Scheduler`. :param failed:
        receives an error and its place.
    """

    def __init__(
        self,
        node: Node,
        learner: Callable[[], Learner | None],
        folder: Path,
        lock: FolderLock,
        say: Callable[[str], None],
        schedule: Callable[..., object],
        failed: Callable[[str, Exception], object],
    ) -> None:
        self._node, self._learner, self._say, self._schedule, self._failed = (
            node,
            learner,
            say,
            schedule,
            failed,
        )
        self._path, self._file, self._lock = folder / FILE, FileThread('changes'), lock
        self._publisher = node.create_publisher(DiagnosticArray, '~/change', LATCHED)
        self._state = ''

    def close(self) -> None:
        """Return when every record is written."""
        self._file.wait()

    def update(self) -> None:
        """After each answer: tell when the state is another one."""
        learner = self._learner()
        if learner is not None and learner.changes.state != self._state:
            self._publish(learner)

    def announce(self, record: ChangeRecord) -> None:
        """A change is new, or more is known of it."""
        self._say(record.sentence)
        try:
            self._lock.take()
        except SemiparamError as error:
            self._failed('the file of changes', error)
        else:
            line = json.dumps({'node': self._node.get_fully_qualified_name(), **record.as_dict()})
            self._file.submit(partial(append_line, self._path, line), partial(self._schedule, self._written))
        learner = self._learner()
        if learner is not None:
            self._publish(learner)

    def report(self) -> Report:
        """The state, and the latest change."""
        learner = self._learner()
        if learner is None:
            return Report(OK, f'changes: {STATES[0]}.', {})
        changes = learner.changes
        state, latest = changes.state, changes.latest
        level = OK if state in QUIET else WARN
        if latest is None:
            return Report(level, changes.sentence, {'state': state})
        change, named = latest.change, latest.named
        values: dict[str, object] = {
            'state': state,
            'number': change.number,
            'since [s]': change.since / NANOSECONDS,
            'noticed [s]': change.noticed / NANOSECONDS,
            'over [s]': '' if change.ended is None else change.ended / NANOSECONDS,
            'kind': change.kind,
            'where': change.where or '',
            'evidence [nat]': round(change.evidence, 1),
            'outputs': ', '.join(change.outputs),
        }
        if named is not None and named.effect is not None:
            values |= {
                'kind': named.effect.kind,
                'where': named.effect.where or '',
                'evidence [nat]': round(named.gain.total - named.price, 1),
                'error without it': named.without['nmse_mean'],
                'error with it': named.after['nmse_mean'],
            }
            values |= {
                f'{name} [{value.unit}]': f'{value.value:.6g} +- {value.std or 0.0:.2g}'
                for name, value in named.parameters.items()
            }
        return Report(level, changes.sentence, values)

    def _publish(self, learner: Learner) -> None:
        self._state = learner.changes.state
        self._publisher.publish(status_message(self._node, 'change', '', self.report()))

    def _written(self, _: None, error: Exception | None) -> None:
        if error is not None:
            self._failed('the file of changes', error)
