"""A process beside the node, for what takes seconds: the node goes on receiving, predicting and
learning.

A thread would not do: it would share the interpreter's lock with the callbacks, and samples would
be late.
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from queue import SimpleQueue
from types import FrameType
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias, TypeVar, cast

from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import transport

Result = TypeVar('Result')
Done = Callable[[Result | None, BaseException | None], None]
NICENESS = 5
MOST_DEATHS = 2
"""A job whose process dies so many times is given up: it is the job that kills it, by its memory
for instance."""

STILL_S = 30.0
"""So long a process may sleep over a job without using the processor; then it is taken for dead,
and killed."""
GIVE_UP_S = 0.05
"""How soon a process hears that nobody wants the result of its job any more."""
LOOKS = 30
"""So many looks at it in that time."""
NOT_YET = (signal.SIGINT, signal.SIGUSR1)
"""A process inherits that these are blocked: a Ctrl-C while it is still importing is not for it, and
that its job is to give way must not end it."""

Scheduler: TypeAlias = Callable[..., object]
"""Takes a function and its arguments, and calls it in the executor's thread."""


class Urgency(IntEnum):
    """Urgency of a job: the more urgent come first, and all give way to a model that is to take
    over."""

    SHADOW = 0
    ASKED = 1
    """Somebody waits for the answer."""
    TAKES_OVER = 2


class Job(Protocol):
    """Work that was handed to a background."""

    urgency: Urgency

    def cancel(self) -> None:
        """Its result is of no interest any more; it need not begin, or end."""


class Background(Protocol):
    """Runs functions elsewhere and hands their results back to the caller's own thread, in
    order."""

    def submit(self, function: Callable[..., Result], *arguments: object, done: Done[Result],
               urgency: Urgency = Urgency.SHADOW) -> Job:
        """Run ``function(*arguments)``, then ``done(result, None)`` or ``done(None, error)``.

        :param urgency: a job that gives way is begun anew later.
        """

    def later(self, function: Callable[[], None]) -> None:
        """Run ``function`` in the caller's thread as soon as what already waits there is done."""


class Worker(NamedTuple):
    """A process that waits for jobs, and this end of the line to it."""

    process: BaseProcess
    line: Connection


def forked_worker() -> Worker:
    """A worker that has everything loaded and shares this process's memory; only while no other
    thread runs.

    It costs nothing, where one that is spawned loads for two seconds of processor time.
    """
    return _started('fork')


class ProcessBackground:
    """One process, there from the start, warm when it is needed, and replaced should it die or
    stand still.

    It is given one job at a time: when it dies, just the job that it worked on is to blame, and is
    tried once more.

    :param schedule: see :data:`Scheduler`; in that thread all of this runs but the jobs themselves.
    :param on_progress: called there with what a job tells of its progress, see
        :func:`report_progress`.
    :param still_s: see :data:`STILL_S`.
    :param first: the first process; spawned if left out, as later ones are, which come while
        threads run.
    """

    def __init__(self, schedule: Scheduler, on_progress: Callable[[Any], None] = lambda news: None,
                 still_s: float = STILL_S, first: Worker | None = None) -> None:
        self._schedule, self._on_progress, self._still_s = schedule, on_progress, still_s
        self._closed = False
        self._queue: deque[_ProcessJob] = deque()
        self._running: _ProcessJob | None = None
        self._handed: SimpleQueue[_ProcessJob | None] = SimpleQueue()
        self._first, self._process = first, first and first.process
        self._thread = threading.Thread(target=self._serve, name='background', daemon=True)
        self._thread.start()

    def submit(self, function: Callable[..., Result], *arguments: object, done: Done[Result],
               urgency: Urgency = Urgency.SHADOW) -> Job:
        """See :class:`Background`."""
        job = _ProcessJob(function, arguments, done, urgency)
        # Those that were cancelled hold a history each, and may lie behind a job of many seconds.
        self._queue = deque(waiting for waiting in (*self._queue, job) if not waiting.cancelled)
        self._start_next()
        return job

    def later(self, function: Callable[[], None]) -> None:
        """See :class:`Background`."""
        self._schedule(function)

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._closed = True
        self._queue.clear()
        self._handed.put(None)
        if self._process is not None:
            self._process.kill()  # a stopped one would not hear anything less
        self._thread.join()

    def _pass_on(self, job: _ProcessJob, news: Any) -> None:
        if not (self._closed or job.cancelled):
            self._on_progress(news)

    def _start_next(self) -> None:
        while self._running is None and self._queue and not self._closed:
            job = max(self._queue, key=lambda job: job.urgency)  # the first of them
            self._queue.remove(job)
            if not job.cancelled:
                self._running = job
                self._handed.put(job)

    def _finish(self, outcome: JobResult | None) -> None:
        job, self._running = self._running, None
        if job is None or self._closed:
            return
        try:
            if outcome is None:
                self._died(job)
            elif outcome.given_up and not job.cancelled:
                self._queue.appendleft(job)
            elif not job.cancelled:
                error = outcome.error
                if isinstance(error, MemoryError):
                    error = SemiparamError('the background process had not memory enough for it.')
                elif error is not None:
                    error.__cause__ = RuntimeError(outcome.traceback)
                job.done(outcome.result, error)
        finally:
            self._start_next()

    def _died(self, job: _ProcessJob) -> None:
        job.deaths += 1
        if job.cancelled:
            return
        if job.deaths < MOST_DEATHS:
            self._queue.appendleft(job)
        else:
            job.done(None, SemiparamError(f'the background process died {job.deaths} times over it; it was killed, or '
                                          'memory ran out.'))

    # In the thread that talks with the process

    def _serve(self) -> None:
        worker, trouble = self._begun(self._first)
        while (job := self._handed.get()) is not None:
            if worker is None or not worker.process.is_alive():
                if worker is not None:
                    worker.line.close()
                worker, trouble = self._begun()
            self._schedule(self._finish, JobResult(error=trouble) if worker is None else self._ask(worker, job))
            del job  # it holds a history
        if worker is not None:
            worker.line.close()
            worker.process.kill()
            worker.process.join()

    def _begun(self, first: Worker | None = None) -> tuple[Worker | None, SemiparamError | None]:
        """The first worker, or a new one; None where the system has no room for it, and a sentence on that."""
        try:
            worker = first or _spawned_worker()
            self._process = worker.process
            if self._closed:
                worker.process.kill()
            threading.Thread(target=self._watch, args=(worker.process,), name='watch', daemon=True).start()
            return worker, None
        except (OSError, RuntimeError) as error:  # no process, or no thread that watches it
            return None, SemiparamError(f'no process can be begun beside the node ({error}).')

    def _ask(self, worker: Worker, job: _ProcessJob) -> JobResult | None:
        """Have a job done, and return its result; None: the process died."""
        (process, line), outcome = worker, None
        try:
            transport.send(line, (job.function, job.arguments))
            while True:
                while not line.poll(GIVE_UP_S):
                    # Again and again: a process that has not begun does not hear.
                    if job.cancelled or self._gives_way(job):
                        os.kill(process.pid or 0, signal.SIGUSR1)
                answer = transport.receive(line)
                if isinstance(answer, JobResult):
                    return answer
                self._schedule(self._pass_on, job, answer)
        except (EOFError, OSError):
            pass
        except Exception as error:
            outcome = JobResult(error=error, traceback=traceback.format_exc())
        process.kill()  # who knows how much has gone either way
        process.join()
        return outcome

    def _gives_way(self, job: _ProcessJob) -> bool:
        return job.urgency < Urgency.TAKES_OVER and any(
            waiting.urgency == Urgency.TAKES_OVER and not waiting.cancelled for waiting in tuple(self._queue))

    def _watch(self, process: BaseProcess) -> None:
        """Kill a process that stands still over a job.

        Looks are counted, not seconds, so that a time in which nothing ran at all is no reason.
        """
        still, used = 0, -1
        with suppress(OSError):
            while not wait([process.sentinel], self._still_s / LOOKS):
                before, (state, used) = used, _activity(process)
                still = still + 1 if self._running is not None and state != 'R' and used == before else 0
                if still > LOOKS:
                    process.kill()


def _spawned_worker() -> Worker:
    """A worker begun anew."""
    resource_tracker.ensure_running()  # which would unblock SIGINT
    return _started('spawn')


def _started(method: Literal['fork', 'spawn']) -> Worker:
    context: Any = multiprocessing.get_context(method)
    ours, theirs = context.Pipe()
    inherited = (ours,) if method == 'fork' else ()
    process = context.Process(target=_work, args=(theirs, *inherited), daemon=True)
    usual = signal.pthread_sigmask(signal.SIG_BLOCK, NOT_YET)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, usual)
    theirs.close()  # the process has its own: when it ends, nobody waits for the other half of a result
    return Worker(process, ours)


@dataclass(eq=False)
class _ProcessJob:
    function: Callable[..., object]
    arguments: tuple[object, ...]
    done: Done[Any]
    urgency: Urgency
    deaths: int = 0
    cancelled: bool = False

    def cancel(self) -> None:
        self.cancelled = True


def _activity(process: BaseProcess) -> tuple[str, int]:
    """The state of its first thread, where jobs run (R: it has a processor or waits for one), and
    the ticks it used."""
    fields = Path(f'/proc/{process.pid}/stat').read_text().rpartition(')')[2].split()
    return fields[0], int(fields[11]) + int(fields[12])


class JobResult(NamedTuple):
    """Result of a job, or what it raised and where."""

    result: object = None
    error: Exception | None = None
    traceback: str = ''
    given_up: bool = False


def report_progress(news: object) -> None:
    """Tell of a job's progress, from within the job; nobody hears it where no background runs the
    job."""
    global _working
    if _line is not None:
        _working = False  # one that is given up half-way through could send nothing more
        with suppress(OSError):
            transport.send(_line, news)
        _working = True


_line: Connection | None = None
"""In a background's process: the way back to the node."""


def _work(line: Connection, other_end: Connection | None = None) -> None:
    """The process: leave Ctrl-C to the node, yield to it, work on one job after the other, and end
    when it ends."""
    global _line
    _line = line
    if other_end is not None:  # one that was forked has it too, and would never see the line end
        other_end.close()
    gc.freeze()  # pages of what is loaded that the collector does not write stay shared with the node
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGUSR1, _give_up)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGUSR1])
    os.nice(NICENESS)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import scipy.optimize  # noqa: F401

    import semiparam_ros.online.diagnosis_jobs
    import semiparam_ros.online.model_jobs  # noqa: F401 - before the first job comes
    with suppress(EOFError, OSError):
        while True:
            outcome = _run(transport.receive(line))
            try:
                transport.send(line, outcome)
            except (pickle.PicklingError, TypeError, AttributeError) as error:
                transport.send(line, JobResult(error=error, traceback=traceback.format_exc()))
            del outcome  # while it waits for the next one
            with suppress(AttributeError, OSError):  # glibc keeps what was freed: a gigabyte after a few namings
                ctypes.CDLL(None).malloc_trim(0)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(0)


class _GivenUp(BaseException):
    """In the process: nobody wants the result of the job any more."""


_working = False
"""In the process: whether it is within a job."""


def _run(job: object) -> JobResult:
    """In the process: a job, which may be given up."""
    global _working
    try:
        try:
            _working = True
            function, arguments = cast('tuple[Callable[..., object], Sequence[object]]', job)
            return JobResult(function(*arguments))
        except Exception as error:
            return JobResult(error=error, traceback=traceback.format_exc())
        finally:
            _working = False
    except _GivenUp:
        return JobResult(given_up=True)


def _give_up(_number: int, frame: FrameType | None) -> None:
    """Not within an import, which could never be done again in this process; the node asks until it is over."""
    if _working and not _imports(frame):
        raise _GivenUp


def _imports(frame: FrameType | None) -> bool:
    while frame is not None and not frame.f_code.co_filename.startswith('<frozen importlib'):
        frame = frame.f_back
    return frame is not None
