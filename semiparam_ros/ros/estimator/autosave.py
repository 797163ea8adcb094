"""Saves checkpoints while the node runs and when it ends, and goes on from one at the start."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.checkpoint import Checkpoints
from semiparam_ros.online.state_file import SavedState, folder_of
from semiparam_ros.online.worker import Later
from semiparam_ros.settings.snapshot import Settings

RETRY_S = 0.2


class Autosave:
    """By ``checkpoint.period`` on the machine's own clock, and by ``checkpoint.resume``.

    :param state: gives what is to be saved, None before the robot is known.
    :param later: see :data:`Later`.
    :param say: receives sentences for the log. :param refuse: those about checkpoints that could not be written.
    Raises SemiparamError when there can be no folder for them.
    """

    def __init__(self, node: Node, settings: Settings, state: Callable[[], SavedState | None],
                 later: Later, say: Callable[[str], None],
                 refuse: Callable[[str], None]) -> None:
        self.checkpoints = Checkpoints(folder_of(settings), node.get_fully_qualified_name())
        self._active, self._resumes = settings.checkpoint_period > 0.0, settings.checkpoint_resume
        self._state, self._later, self._say, self._refuse = state, later, say, refuse
        self._failed = ''
        if self._active:
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            self._retry = node.create_timer(RETRY_S, self._save, clock=clock)
            self._retry.cancel()
            self._timer = node.create_timer(settings.checkpoint_period, self._save, clock=clock)

    def resume(self, settings: Settings, body: RigidBody) -> SavedState | None:
        """The checkpoint to go on from, None where none is asked for or none is good; says which, and why."""
        if not self._resumes:
            return None
        saved = self._loaded(settings, body)
        if saved is None:
            kept = ' What is there is kept: it is moved aside before a checkpoint is written.'
            self._say(f'there is no checkpoint to go on from in {self.checkpoints.path.parent}; learning begins anew.'
                      f'{kept if self.checkpoints.remarks and self._active else ""}')
        else:
            self._say(f'the checkpoint is loaded: {saved.settings.variant} with {len(saved.batch)} samples.')
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

    def close(self) -> None:
        """Save once more, for the node ends."""
        self.checkpoints.wait()
        if not self._active or self.checkpoints.busy:
            return
        try:
            state = self._state()
            if state is not None:
                self.checkpoints.save(state)
        except SemiparamError as error:
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
            self.checkpoints.save_in_thread(state, partial(self._later, self._saved))
        except SemiparamError as error:
            self._saved(error)

    def _saved(self, error: SemiparamError | None) -> None:
        """Tell of what was moved aside, of a failure once, and of its end."""
        self._tell_news()
        sentence = '' if error is None else str(error)
        if sentence and sentence != self._failed:
            self._refuse(sentence)
        elif self._failed and not sentence:
            self._say(f'checkpoints are written again: {self.checkpoints.path}.')
        self._failed = sentence
