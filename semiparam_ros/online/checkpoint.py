"""States that the node saves by itself, so that a killed one can go on: the newest and the one before it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import state_file
from semiparam_ros.online.file_thread import FileThread
from semiparam_ros.online.state_file import SavedState, Snapshot
from semiparam_ros.settings.snapshot import Settings


class Checkpoints:
    """``NODE.checkpoint.npz`` and ``NODE.checkpoint.previous.npz`` in one folder.

    A new one is written beside them and flushed to the disk before either changes its name, so that whenever the
    process is killed one of the two is whole, and no older than the last one that was finished.

    :param node_name: fully qualified; slashes become dots.
    """

    def __init__(self, folder: Path, node_name: str) -> None:
        stem = node_name.strip('/').replace('/', '.')
        self.path = folder / f'{stem}.checkpoint.npz'
        self.previous = folder / f'{stem}.checkpoint.previous.npz'
        self.remarks: list[str] = []
        self._thread = FileThread('checkpoint')

    @property
    def busy(self) -> bool:
        """Whether one is being written."""
        return self._thread.busy

    def save(self, state: SavedState) -> None:
        """Write one now. Raises SemiparamError when it cannot be written; the older ones are then as they were."""
        self._write(state_file.snapshot(state))

    def save_in_thread(self, state: SavedState, done: Callable[[SemiparamError | None], object]) -> None:
        """Copy the state and write it in a thread, which then calls ``done(None)`` or ``done(error)``.

        The thread computes nothing in Python: it copies, checks and writes whole arrays without the interpreter's lock.
        """
        def written(_: None, error: Exception | None) -> None:
            if error is not None and not isinstance(error, SemiparamError):
                error = SemiparamError(f'{self.path} was not written: {type(error).__name__}: {error}')
            done(error)

        self._thread.submit(partial(self._write, state_file.snapshot(state)), written)

    def wait(self) -> None:
        """Return when nothing is being written any more, or when a disk that hangs has been waited for long enough."""
        self._thread.wait()

    def newest(self, settings: Settings, body: RigidBody) -> SavedState | None:
        """The newest that can be loaded for this robot; ``remarks`` then say what is wrong with newer ones.

        None if there is no checkpoint.
        """
        self.remarks = []
        for path in (self.path, self.previous):
            if not os.path.lexists(path):
                continue
            try:
                return state_file.load(path, settings, body)
            except SemiparamError as error:
                self.remarks.append(str(error))
        return None

    def _write(self, state: Snapshot) -> None:
        for path in (self.path, self.previous):
            _move_away_if_foreign(path)
        state_file.write(self.path, state, self._make_previous)

    def _make_previous(self) -> None:
        with suppress(FileNotFoundError):
            os.replace(self.path, self.previous)


def _move_away_if_foreign(path: Path) -> None:
    """A damaged state, or another's file: it keeps its content under another name, and must not stop the saving."""
    try:
        state_file.require_replaceable(path)
    except SemiparamError:
        with suppress(OSError):
            os.rename(path, path.with_name(f'{path.stem}.unreadable-{time.time_ns()}{path.suffix}'))
