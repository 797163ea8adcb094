"""The programs of `make demo`: started, watched and stopped as a user would in three terminals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from semiparam_ros.errors import SemiparamError

POLL_S = 0.1
STOP_S = 15.0
INTERRUPTED = 130


def isolated(domain: int) -> dict[str, str]:
    """An environment in which programs meet each other on this machine, and nobody else."""
    return {**os.environ, 'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'OMP_NUM_THREADS': '1'}


class Program:
    """One `semiparam` sub-command as a process; without a log it writes to the terminal.

    Use as a context manager: it is stopped at the end, whatever happens.
    """

    def __init__(self, arguments: Sequence[object], environment: dict[str, str], log: Path | None = None) -> None:
        self.name, self.log = str(arguments[0]), log
        command = [sys.executable, '-m', 'semiparam_ros.cli.main', *map(str, arguments)]
        stream = log.open('w') if log else None
        # A session of its own: Ctrl-C reaches us, and we stop the others in order.
        self._process = subprocess.Popen(command, env=environment, stdout=stream, stderr=stream,
                                         stdin=subprocess.DEVNULL, start_new_session=True)
        if stream:
            stream.close()

    def wait_for(self, condition: Callable[[], bool], what: str, timeout_s: float) -> None:
        """Until the condition holds; raises SemiparamError when the program ends or the time is over before."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if self._process.poll() is not None:
                raise SemiparamError(f'{self.name} ended (exit code {self._process.returncode}) before {what}'
                                     f'{self._last_words()}')
            if time.monotonic() > deadline:
                raise SemiparamError(f'{self.name}: {what} did not happen within {timeout_s:g} s{self._last_words()}')
            time.sleep(POLL_S)

    def said(self, text: str) -> bool:
        """Whether its log holds a text."""
        return self.log is not None and text in self.log.read_text(errors='replace')

    def check_running(self) -> None:
        """Raise SemiparamError when it has ended."""
        if self._process.poll() is not None:
            raise SemiparamError(f'{self.name} ended early with exit code {self._process.returncode}'
                                 f'{self._last_words()}')

    def finish(self, timeout_s: float, beside: Sequence[Program] = ()) -> None:
        """Wait for its own end while those beside it go on; raises SemiparamError for any failure."""
        self.wait_for(lambda: self._ended(beside), 'its end', timeout_s)
        if self._process.returncode != 0:
            raise SemiparamError(f'{self.name} failed with exit code {self._process.returncode}{self._last_words()}')

    def stop(self) -> None:
        """End it as Ctrl-C does; raises SemiparamError when it does not end well."""
        self._interrupt()
        if self._process.returncode not in (0, INTERRUPTED):
            raise SemiparamError(f'{self.name} ended with exit code {self._process.returncode}{self._last_words()}')

    def _ended(self, beside: Sequence[Program]) -> bool:
        for program in beside:
            program.check_running()
        return self._process.poll() is not None

    def _interrupt(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _last_words(self) -> str:
        lines = self.log.read_text(errors='replace').strip().splitlines() if self.log else []
        return f': {lines[-1]}' if lines else '.'

    def __enter__(self) -> Program:
        return self

    def __exit__(self, *_: object) -> None:
        self._interrupt()
