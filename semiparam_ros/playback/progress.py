"""Progress of a playback: a bar on a terminal, a line now and then everywhere else."""

from __future__ import annotations

import threading
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from semiparam_ros.playback.player import Player

REFRESH_S = 0.2
LINE_S = 10.0
_SECONDS = 1e-9


def describe(playback: Player) -> str:
    """Pace in words: 'paused', '1.5 x' or, unpaced, 'as followed'."""
    if playback.paused:
        return 'paused'
    return 'as followed' if playback.rate is None else f'{playback.rate:.4g} x'


class ReplayProgress:
    """Context manager that shows ``playback`` between two bag times [ns] from a thread of its own.

    :param answers: what the followers have answered so far, '' where nobody is followed
    :param quiet: show nothing
    """

    def __init__(self, playback: Player, start_ns: int, end_ns: int, console: Console,
                 answers: Callable[[], str], quiet: bool) -> None:
        self._playback = playback
        self._answers = answers
        self._start = start_ns
        self._length = (end_ns - start_ns) * _SECONDS
        self._console = console
        self._quiet = quiet
        self._closing = threading.Event()
        self._bar = _bar(console) if console.is_terminal and not quiet else None
        self._thread = threading.Thread(target=self._show, name='progress', daemon=True)

    def __enter__(self) -> ReplayProgress:
        if self._bar is not None:
            self._task = self._bar.add_task('', total=max(self._length, 1e-9), position='', count='')
            self._update_bar()
            self._bar.start()
        if not self._quiet:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._bar is not None:
            self._update_bar()
            self._bar.stop()

    def _show(self) -> None:
        while not self._closing.wait(LINE_S if self._bar is None else REFRESH_S):
            if self._bar is None:
                self._console.print(self._line(), soft_wrap=True)
            else:
                self._update_bar()

    def _position(self) -> float:
        """Seconds since the start of the playback."""
        return max((self._playback.now() - self._start) * _SECONDS, 0.0)

    def _update_bar(self) -> None:
        assert self._bar is not None
        position = self._position()
        self._bar.update(self._task, completed=position, description=describe(self._playback),
                         position=f'{position:.1f} of {self._length:.1f} s',
                         count=self._count())

    def _line(self) -> str:
        return f'{self._position():.1f} of {self._length:.1f} s, {self._count()}, {describe(self._playback)}'

    def _count(self) -> str:
        answers = self._answers()
        return f'{self._playback.published} messages' + (f', {answers}' if answers else '')


def _bar(console: Console) -> Progress:
    columns = (TextColumn('{task.description:>11}'), BarColumn(bar_width=None), TaskProgressColumn(),
               TextColumn('{task.fields[position]}'), TextColumn('{task.fields[count]}'))
    return Progress(*columns, console=console, refresh_per_second=1.0 / REFRESH_S, expand=True)
