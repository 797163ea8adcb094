"""States that the node saves by itself, so that a killed one can go on: the newest and the one before it."""

from __future__ import annotations

import errno
import glob
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
from semiparam_ros.online.folder_lock import AnotherHasIt, FolderLock, stem
from semiparam_ros.online.state_file import SavedState, Snapshot
from semiparam_ros.settings.snapshot import Settings

NOT_THE_FILES_FAULT = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""What the process, or the machine, has not enough of to open any file."""


class Checkpoints:
    """``NODE.checkpoint.npz`` and ``NODE.checkpoint.previous.npz`` in one folder.

    A new one is written beside them and flushed to the disk before either changes its name, so that whenever the
    process is killed one of the two is whole, and no older than the last one that was finished.

    The first one replaces nothing that was learnt with another configuration, nor what this node did not want to go on
    from: that is moved aside (``NODE.checkpoint.aside-...``), and :meth:`newest` still finds it.

    :param node_name: fully qualified; slashes become dots. :param lock: the node's, a new one unless given.
    """

    def __init__(self, folder: Path, node_name: str, lock: FolderLock | None = None) -> None:
        self.path = folder / f'{stem(node_name)}.checkpoint.npz'
        self.previous = folder / f'{stem(node_name)}.checkpoint.previous.npz'
        self.lock = lock or FolderLock(folder, node_name)
        self.remarks: list[str] = []
        self.news: list[str] = []
        """What was moved aside; whoever tells it empties it."""
        self._first, self._went_on, self._was_locked = True, False, False
        self._refused: dict[Path, str] = {}
        """What the files of these names have that this node cannot go on from."""
        self._thread = FileThread('checkpoint')

    @property
    def busy(self) -> bool:
        """Tell whether one is being written."""
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
        """The newest that can be loaded for this robot, those moved aside included; ``remarks`` then say what is wrong
        with newer ones.

        None if there is no checkpoint.
        """
        self.remarks, self._refused = [], {}
        for path in (self.path, self.previous, *self._aside()):
            if not os.path.lexists(path):
                continue
            try:
                saved = state_file.load(path, settings, body)
            except SemiparamError as error:
                self._refuse(path, str(error).removeprefix(f'{path} '))
            else:
                self._went_on = True
                return saved
        return None

    def _refuse(self, path: Path, reason: str) -> None:
        """Remember why it cannot be gone on from; once is enough of the same, and of what is aside already."""
        if path in (self.path, self.previous):
            if reason not in self._refused.values():
                self.remarks.append(f'{path} {reason}')
            self._refused[path] = reason

    def _aside(self) -> list[Path]:
        """The latest first."""
        found = self.path.parent.glob(f'{glob.escape(self.path.name.removesuffix(".npz"))}*.{state_file.ASIDE}-*.npz')
        return sorted(found, key=lambda path: path.name.rpartition('-')[2], reverse=True)

    def _write(self, state: Snapshot) -> None:
        try:
            self.lock.take()
        except AnotherHasIt:
            self._was_locked = True
            raise
        for path in (self.path, self.previous):
            self._move_away_if_foreign(path)
        self._move_others_aside(state)
        state_file.write(self.path, state, self._make_previous)
        self._first = False

    def _move_away_if_foreign(self, path: Path) -> None:
        """A damaged state, or another's file: it keeps its content under another name, and must not stop the saving.

        Raises SemiparamError where it is not the file's fault that it cannot be read.
        """
        try:
            state_file.replaceable(path)
        except SemiparamError as error:
            cause = error.__cause__
            if isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno in NOT_THE_FILES_FAULT):
                raise
            away = path.with_name(f'{path.stem}.unreadable-{time.time_ns()}{path.suffix}')
            with suppress(OSError):
                os.rename(path, away)
                self.news.append(f'{path} is no saved state that can be read. It is moved to {away}.')

    def _move_others_aside(self, state: Snapshot) -> None:
        names = state_file.FIXED if self._went_on else (*state_file.ADOPTED, *state_file.FIXED)
        for path in (self.previous, self.path):
            reason = self._refused.get(path, '')
            theirs = state_file.replaceable(path) if reason or self._first else None
            if theirs is not None:
                reason = reason or theirs.difference(state.configuration, names)
                if self._first and self._was_locked:
                    reason = 'was written by another node of this name, while this one ran.'
                if reason:
                    self.news.append(state_file.move_aside(path, reason))
            self._refused.pop(path, None)  # not before it is aside, which may fail

    def _make_previous(self) -> None:
        with suppress(FileNotFoundError):
            os.replace(self.path, self.previous)
