"""Saves checkpoints while the node runs and when it ends, and goes on from one at the start."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from rclpy.node import Node

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.checkpoint import Checkpoints
from semiparam_ros.online.folder_lock import FolderLock
from semiparam_ros.online.state_file import SavedState, folder_of
from semiparam_ros.online.worker import Scheduler
from semiparam_ros.ros.context import steady_timer
from semiparam_ros.ros.estimator.diagnostics import ERROR, OK, Report
from semiparam_ros.settings.snapshot import Settings

RETRY_S = 0.2


class Autosave:
    """By ``checkpoint.period`` on the machine's own clock, and by ``checkpoint.resume``.

    :param lock: the right to write there.
    :param state: gives what is to be saved, None before the robot is known.
    :param schedule: see :data:`Scheduler`.
    :param say: receives sentences for the log. :param refuse: those about checkpoints that could not be written.
    Raises SemiparamError when there can be no folder for them.
    """

    def __init__(self, node: Node, settings: Settings, lock: FolderLock, state: Callable[[], SavedState | None],
                 schedule: Scheduler, say: Callable[[str], None],
                 refuse: Callable[[str], None]) -> None:
        self.checkpoints = Checkpoints(folder_of(settings), node.get_fully_qualified_name(), lock)
        self._active, self._resumes = settings.checkpoint_period > 0.0, settings.checkpoint_resume
        self._state, self._schedule, self._say, self._refuse = state, schedule, say, refuse
        self._failed = ''
        self._written: float | None = None
        self._count = 0
        if self._active:
            self._retry = steady_timer(node, RETRY_S, self._save)
            self._retry.cancel()
            steady_timer(node, settings.checkpoint_period, self._save)

    def resume(self, settings: Settings, body: RigidBody) -> SavedState | None:
        """The checkpoint to go on from, None where none is asked for or none is good; says which, and why."""
        if not (self._resumes or self._active):
            return None
        try:
            self.checkpoints.lock.take()
        except SemiparamError as error:
            self._saved(error)
            return None
        if not self._resumes:
            return None
        saved = self._loaded(settings, body)
        if saved is None:
            kept = ' What is there is kept: it is moved aside before a checkpoint is written.'
            self._say(f'there is no checkpoint to go on from in {self.checkpoints.path.parent}; learning begins anew.'
                      f'{kept if self.checkpoints.remarks and self._active else ""}')
        else:
            self._say(f'the checkpoint is loaded: {saved.sentence}.')
        return saved

    def newest(self, settings: Settings, body: RigidBody) -> SavedState | None:
        """The newest good checkpoint of a node that saves them; None without one."""
        return self._loaded(settings, body) if self._active else None

    def _loaded(self, settings: Settings, body: RigidBody) -> SavedState | None:
        self.checkpoints.wait()
        saved = self.checkpoints.newest(settings, body)
        for remark in self.checkpoints.remarks:
            self._refuse(remark)
        return saved

    def report(self) -> Report:
        """Report of whether they are written, and when the last one was."""
        values = {'file': self.checkpoints.path, 'written': self._count, 'last failure': self._failed}
        if self._failed:
            return Report(ERROR, f'not written: {self._failed}', values)
        if not self._active:
            return Report(OK, 'not asked for (checkpoint.period is 0).', values)
        if self._written is None:
            return Report(OK, 'none is written yet.', values)
        return Report(OK, f'the last one was written {time.monotonic() - self._written:.0f} s ago.', values)

    def close(self) -> None:
        """Save once more, for the node ends."""
        self.checkpoints.wait()
        if not self._active:
            return
        try:
            if self.checkpoints.busy:
                raise SemiparamError('the one before it is still being written.')
            state = self._state()
            if state is not None:
                self.checkpoints.save(state)
        except Exception as error:  # whatever it is, the node is to end as it does otherwise
            self._refuse(f'there is no checkpoint of the end: {error}')
        self._tell_news()

    def _tell_news(self) -> None:
        while self.checkpoints.news:
            self._say(self.checkpoints.news.pop(0))

    def _save(self) -> None:
        """Now, or a little later while the robot is not known or the last one is still being written."""
        state = None if self.checkpoints.busy else self._state()
        if state is None:
            self._retry.reset()
            return
        self._retry.cancel()
        try:
            self.checkpoints.save_in_thread(state, partial(self._schedule, self._saved))
        except SemiparamError as error:
            self._saved(error)

    def _saved(self, error: SemiparamError | None) -> None:
        """Tell of what was moved aside, of a failure once, and of its end."""
        self._tell_news()
        sentence = '' if error is None else str(error)
        if sentence and sentence != self._failed:
            self._refuse(sentence)
        if not sentence:
            self._written, self._count = time.monotonic(), self._count + 1
        if self._failed and not sentence:
            self._say(f'checkpoints are written again: {self.checkpoints.path}.')
        self._failed = sentence
