"""A process beside the node, for what takes seconds: the node goes on receiving, predicting and learning. It builds
estimators from samples, and diagnoses.

A thread would not do: it would share the interpreter's lock with the callbacks, and samples would be late.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import IntEnum
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias, TypeVar, cast

import numpy as np

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.recursion import KEPT
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import transport
from semiparam_ros.online.applied_effects import Contribution, as_measured
from semiparam_ros.online.history import SampleBatch
from semiparam_ros.online.learning import Learning, observe
from semiparam_ros.online.renewal import MOST_WORSE, Errors, RecentWindow, judged, later_window
from semiparam_ros.settings.build import declared_effects, hyperparameter_values, model_options
from semiparam_ros.settings.snapshot import Settings

if TYPE_CHECKING:
    from semiparam_ros.diagnosis.change import NamedChange
    from semiparam_ros.diagnosis.diagnose import Diagnosis
    from semiparam_ros.diagnosis.preparation import Inputs
    from semiparam_ros.effects import Effect

Result = TypeVar('Result')
Done = Callable[[Result | None, BaseException | None], None]
NICENESS = 5
MOST_DEATHS = 2
"""A job whose process dies so many times is given up: it is the job that kills it, by its memory for instance."""

STILL_S = 30.0
"""So long a process may sleep over a job without using the processor; then it is taken for dead, and killed."""
GIVE_UP_S = 0.05
"""How soon a process hears that nobody wants the result of its job any more."""
LOOKS = 30
"""So many looks at it in that time."""

EstimatorJob = Callable[..., Estimator]
"""Gives an estimator, in the background."""

OLDER = 5
"""One of so many samples before a later window is learnt, none from before a change of the robot: hyperparameters of
that window make a model that fits other motion less well than it believes, and where that is most of what it learns the
new motion is fitted the worse."""
OLDER_OF_DRAFT = 1000
"""Of a draft, which is wanted soon, so many at most."""

SAMPLES_AT_MOST, SAMPLES_AT_LEAST = 5000, 1000
"""That a diagnosis looks at, where it gets a whole processor, and however little of one."""
PROBED_S = 0.5
"""So long the share of a processor is measured."""
FIXED_S, EACH_S = 3.5, 4.2e-3
"""[s] Processor time of a diagnosis, and of each of its samples: 24 s for 4688 of a six-joint arm
that lacks 14 effects, 6 s for 600 (measured)."""
LINGERS = 0.2
"""What takes longer than expected takes this share of the time so far yet."""

Later: TypeAlias = Callable[..., object]
"""Takes a function and its arguments, and calls it in the executor's thread."""


class Urgency(IntEnum):
    """Of a job: those of more come first, and a shadow gives way to a model that is to take over."""

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
    """Runs functions elsewhere and hands their results back to the caller's own thread, in order."""

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
    """A worker that has everything loaded and shares this process's memory; only while no other thread runs.

    It costs nothing, where one that is spawned loads for two seconds of processor time.
    """
    usual = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # until the worker has learnt to ignore it
    try:
        fork = multiprocessing.get_context('fork')
        ours, theirs = fork.Pipe()
        process = fork.Process(target=_work, args=(theirs, ours), daemon=True)
        process.start()
        theirs.close()
        return Worker(process, ours)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, usual)


class ProcessBackground:
    """One process, there from the start, warm when it is needed, and replaced should it die or stand still.

    It is given one job at a time: when it dies, just the job that it worked on is to blame, and is tried once more.

    :param later: see :data:`Later`; in that thread all of this runs but the jobs themselves.
    :param told: called there with what a job tells of its progress, see :func:`tell`.
    :param still_s: see :data:`STILL_S`.
    :param first: the first process; spawned if left out, as later ones are, which come while threads run.
    """

    def __init__(self, later: Later, told: Callable[[Any], None] = lambda news: None,
                 still_s: float = STILL_S, first: Worker | None = None) -> None:
        self._later, self._told, self._still_s = later, told, still_s
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
        self._later(function)

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._closed = True
        self._queue.clear()
        self._handed.put(None)
        if self._process is not None:
            self._process.kill()  # a stopped one would not hear anything less
        self._thread.join()

    def _hear(self, job: _ProcessJob, news: Any) -> None:
        if not (self._closed or job.cancelled):
            self._told(news)

    def _start_next(self) -> None:
        while self._running is None and self._queue and not self._closed:
            job = max(self._queue, key=lambda job: job.urgency)  # the first of them
            self._queue.remove(job)
            if not job.cancelled:
                self._running = job
                self._handed.put(job)

    def _finish(self, outcome: _Outcome | None) -> None:
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
        worker = self._watched(self._first or _spawned_worker())
        while (job := self._handed.get()) is not None:
            if not worker.process.is_alive():
                worker.line.close()
                worker = self._watched(_spawned_worker())
            self._later(self._finish, self._ask(worker, job))
            del job  # it holds a history
        worker.line.close()
        worker.process.kill()
        worker.process.join()

    def _watched(self, worker: Worker) -> Worker:
        self._process = worker.process
        if self._closed:
            worker.process.kill()
        threading.Thread(target=self._watch, args=(worker.process,), name='watch', daemon=True).start()
        return worker

    def _ask(self, worker: Worker, job: _ProcessJob) -> _Outcome | None:
        """What comes of a job; None: the process died."""
        (process, line), outcome = worker, None
        try:
            transport.send(line, (job.function, job.arguments))
            while True:
                while not line.poll(GIVE_UP_S):
                    # Again and again: a process that has not begun does not hear.
                    if job.cancelled or self._gives_way(job):
                        os.kill(process.pid or 0, signal.SIGUSR1)
                answer = transport.receive(line)
                if isinstance(answer, _Outcome):
                    return answer
                self._later(self._hear, job, answer)
        except (EOFError, OSError):
            pass
        except Exception as error:
            outcome = _Outcome(error=error, traceback=traceback.format_exc())
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
    """A worker begun anew, from a thread that may not unblock SIGINT later."""
    resource_tracker.ensure_running()  # which would unblock the signal
    # The process inherits this: a Ctrl-C while it is still importing is not for it.
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    spawn = multiprocessing.get_context('spawn')
    ours, theirs = spawn.Pipe()
    process = spawn.Process(target=_work, args=(theirs,), daemon=True)
    process.start()
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
    """The state of its first thread, where jobs run (R: it has a processor or waits for one), and the ticks it used."""
    fields = Path(f'/proc/{process.pid}/stat').read_text().rpartition(')')[2].split()
    return fields[0], int(fields[11]) + int(fields[12])


class _Outcome(NamedTuple):
    """Of a job: its result, or what it raised and where."""

    result: object = None
    error: Exception | None = None
    traceback: str = ''
    given_up: bool = False


def tell(news: object) -> None:
    """Tell of a job's progress, from within the job; nobody hears it where no background runs the job."""
    global _working
    if _line is not None:
        _working = False  # one that is given up half-way through could send nothing more
        with suppress(OSError):
            transport.send(_line, news)
        _working = True


_line: Connection | None = None
"""In a background's process: the way back to the node."""


def _work(line: Connection, other_end: Connection | None = None) -> None:
    """The process: leave Ctrl-C to the node, yield to it, work on one job after the other, and end when it ends."""
    global _line
    _line = line
    if other_end is not None:  # one that was forked has it too, and would never see the line end
        other_end.close()
    gc.freeze()  # pages of what is loaded that the collector does not write stay shared with the node
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGUSR1, _give_up)
    os.nice(NICENESS)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # This module's imports, which unpickling this function needs, bring the numerics but for the optimiser.
    import scipy.optimize  # noqa: F401
    with suppress(EOFError, OSError):
        while True:
            outcome = _run(transport.receive(line))
            try:
                transport.send(line, outcome)
            except (pickle.PicklingError, TypeError, AttributeError) as error:
                transport.send(line, _Outcome(error=error, traceback=traceback.format_exc()))
            del outcome  # while it waits for the next one


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(0)


class _GivenUp(BaseException):
    """In the process: nobody wants the result of the job any more."""


_working = False
"""In the process: whether it is within a job."""


def _run(job: object) -> _Outcome:
    """In the process: a job, which may be given up."""
    global _working
    try:
        try:
            _working = True
            function, arguments = cast('tuple[Callable[..., object], Sequence[object]]', job)
            return _Outcome(function(*arguments))
        except Exception as error:
            return _Outcome(error=error, traceback=traceback.format_exc())
        finally:
            _working = False
    except _GivenUp:
        return _Outcome(given_up=True)


def _give_up(*_: object) -> None:
    if _working:
        raise _GivenUp


class Known(NamedTuple):
    """Hyperparameters that an earlier estimate gave for the same model, with the scaling of its inputs."""

    hyperparameters: Hyperparameters
    input_mean: tuple[float, ...]
    input_scale: tuple[float, ...]
    window: int  # samples that they are from
    others: tuple[Hyperparameters, ...] = ()  # of the variants averaged with it


def finish_window(estimator: Estimator, draft: bool = False) -> Estimator:
    """The estimator whose initial window is full, with its hyperparameters estimated and the window learnt."""
    estimator.finish_window(draft)
    return estimator


def build(settings: Settings, body: RigidBody, batch: SampleBatch, known: Known | None,
          origin: int | None) -> Estimator:
    """A new estimator that has seen all samples of a batch; time counts from ``origin`` [ns]."""
    return absorb(new_estimator(settings, body, known, origin), batch)


def renew(settings: Settings, body: RigidBody, batch: SampleBatch, origin: int | None,
          later: RecentWindow | None = None) -> Estimator:
    """The same with hyperparameters from a later window, see :mod:`semiparam_ros.online.renewal`.

    Raises SemiparamError when the window holds too little to estimate from, or the model predicts it worse than the one
    that it is to beat.
    """
    later = later or RecentWindow(settings.initial_samples)
    gathering, learning, learnt = new_estimator(settings, body, origin=origin), batch.learning, batch.learnt
    window = later_window(learnt, later.samples)
    begin = int(window.argmax())
    start = 0 if settings.effects else begin  # they may remember all that was before
    for (sample, _), chosen in zip(batch.part(start).pairs(), window[start:].tolist(), strict=True):
        gathering.gather(sample, chosen)
    gathering.finish_window(later.draft, learn=False)
    estimator, errors = new_estimator(settings, body, known_of(gathering), origin), Errors(body.n_outputs)
    compared = later_window(learnt, judged(later.samples))
    changed = (learning[:begin] == Learning.AFTER_CHANGE) & (np.cumsum(learnt[:begin]) > KEPT)
    since = int(np.flatnonzero(changed)[-1]) if changed.any() else 0
    every = max(OLDER, -((since - begin) // OLDER_OF_DRAFT)) if later.draft else OLDER
    older = np.zeros(begin, dtype=bool)
    older[since::every] = True
    learning[:begin] = np.minimum(learning[:begin], np.where(older, Learning.YES, Learning.NO))
    parts = [*batch.part(since, start, every).rows, *batch.part(start).rows]
    numbers = np.r_[since:start:every, start:len(batch)]
    each = zip(replace(batch, rows=parts).pairs(), learning[numbers].tolist(), compared[numbers].tolist(),
               strict=True)
    for (sample, _), learns, chosen in each:
        prediction = estimator.predict(sample)
        if chosen:
            errors.add(prediction)
        observe(estimator, prediction, learns)
    if errors.size > MOST_WORSE * later.to_beat:
        raise SemiparamError(f'the model that follows has errors of {errors.size:.3g} over that window where the model '
                             f'in force has {later.to_beat:.3g}.')
    return estimator


def new_estimator(settings: Settings, body: RigidBody, known: Known | None = None,
                  origin: int | None = None) -> Estimator:
    """An estimator that has learnt nothing yet; time counts from ``origin`` [ns]."""
    if known is not None:
        settings = settings.changed(hyperparameter_values(*known[:3]))
    options = replace(model_options(settings), others=known.others if known else ())
    return Estimator(body, options, declared_effects(settings), origin, known.window if known else 0)


def absorb(estimator: Estimator, batch: SampleBatch) -> Estimator:
    """Predict and learn further samples, as the node did when they came."""
    for sample, learnt in batch.pairs():
        observe(estimator, estimator.predict(sample), learnt)
    return estimator


def known_of(estimator: Estimator) -> Known | None:
    """The hyperparameters of an estimator whose initial window is over."""
    if not estimator.ready or estimator.input_scaling is None:
        return None
    mean, scale = estimator.input_scaling
    return Known(estimator.model.hyperparameters, tuple(mean.tolist()), tuple(scale.tolist()),
                 estimator.window_samples, estimator.others)


class Progress(NamedTuple):
    """Of a diagnosis: what is being tried, and how long it is expected to take yet [s]."""

    words: str
    left_s: float


def expected_s(samples: int) -> float:
    """Processor time [s] of a diagnosis of so many samples."""
    return FIXED_S + EACH_S * samples


def left_s(samples: int, passed: float, used: float) -> float:
    """How long [s] a diagnosis is expected to take yet that ``passed`` seconds ago began, and has ``used`` so much of
    a processor."""
    return max(expected_s(samples) - used, LINGERS * used) * passed / max(used, 1e-3)


def processor_share() -> float:
    """The share of a processor that this process gets at present, above 0 and at most 1."""
    begun, used, passed = time.perf_counter(), time.process_time(), 0.0
    while passed < PROBED_S:
        passed = time.perf_counter() - begun
    return min(max((time.process_time() - used) / passed, 0.01), 1.0)


class Outcome(NamedTuple):
    """A diagnosis in words and as the machine-readable report; ``effects`` are all that the model then declares.

    ``summary`` has what was found, line by line, ``words`` all that is to be said of it.
    """

    verdict: str
    summary: list[str]
    words: list[str]
    report: dict[str, object]
    effects: tuple[Effect, ...]


def diagnose(body: RigidBody, batch: SampleBatch, effects: Sequence[Effect],
             taken_off: Sequence[Contribution] = ()) -> Outcome:
    """Diagnose samples with the effects declared so far; raises SemiparamError as the command does.

    :param taken_off: what was taken off the samples before they were kept.
    """
    from semiparam_ros.diagnosis.diagnose import diagnose
    from semiparam_ros.diagnosis.text_report import summary, text_report

    begun, used = time.perf_counter(), time.process_time()
    assert batch.samples is not None
    samples = as_measured(body, batch.samples, taken_off)

    def progress(words: str, share: float) -> None:
        tell(Progress(f'{words} ({share:.0%})', left_s(len(batch), time.perf_counter() - begun,
                                                       time.process_time() - used)))

    found = diagnose(body, samples, effects, progress=progress)
    return Outcome(found.verdict, summary(found), text_report(found), found.as_dict(), declared(found))


def name_change(body: RigidBody, batch: SampleBatch, effects: Sequence[Effect], since: int,
                ended: int | None, inputs: Inputs | None, taken_off: Sequence[Contribution] = ()) -> NamedChange:
    """What began at a stamp [ns], and ended at another; times of the effect as stamps. See
    :func:`~semiparam_ros.diagnosis.change.name_change`.

    :param taken_off: what was taken off the samples before they were kept.
    """
    from semiparam_ros.diagnosis.change import name_change

    samples = batch.samples
    if samples is None:
        raise SemiparamError('there are no samples to name a change from.')
    samples, origin = as_measured(body, samples, taken_off), samples.origin
    found = name_change(body, samples, effects, (since - origin) * 1e-9,
                        None if ended is None else (ended - origin) * 1e-9, inputs)
    return found if found.effect is None else replace(found, effect=found.effect.at_stamps(origin))


def gain_since(body: RigidBody, batch: SampleBatch, since: int, before: Sequence[Effect],
               after: Sequence[Effect], taken_off: Sequence[Contribution] = ()) -> float | None:
    """By how much [nat] other effects predict what came after a stamp [ns] better than those before; None where that
    is too little to tell.

    :param taken_off: what was taken off the samples before they were kept.
    """
    from semiparam_ros.diagnosis.change import gain_since

    samples = batch.samples
    if samples is None:
        return None
    try:
        samples = as_measured(body, samples, taken_off)
        return gain_since(body, samples, (since - samples.origin) * 1e-9, before, after).total
    except SemiparamError:
        return None


def declared(found: Diagnosis) -> tuple[Effect, ...]:
    """The effects of the final model, times as stamps: a node counts time from its own start, which a reset moves."""
    origin = found.recorded.samples.origin
    return tuple(effect.at_stamps(origin) for effect in found.everything.effects)


def thinned(batch: SampleBatch, share: float) -> SampleBatch:
    """As many of them, evenly spread, as a diagnosis looks at that gets a share of a processor."""
    count = len(batch)
    step = min(-(-count // int(share * SAMPLES_AT_MOST)), count // SAMPLES_AT_LEAST)
    return batch.part(0, step=max(step, 1))
