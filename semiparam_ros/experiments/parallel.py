"""Runs many calls at a time: in processes of this machine, or on a Dask cluster through joblib's own backend."""

from __future__ import annotations

import asyncio
import signal
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, TypeVar

from joblib import Parallel, delayed, parallel_config

from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from distributed import Client

Result = TypeVar('Result')
ANSWER_S = 10.0
"""Time [s] that a cluster may take to answer."""


@contextmanager
def workers(jobs: int, scheduler: str | None = None) -> Iterator[int]:
    """Provide the workers of :func:`run_all` within a block; yield how many calls run at a time.

    :param scheduler: address of a Dask scheduler, whose workers then do everything.
    :raises SemiparamError: the cluster does not answer, has no worker, goes away, or dask is not
        installed.
    """
    if scheduler is None:
        # one linear algebra thread for each process: two on a core only fight
        with parallel_config(backend='loky', n_jobs=jobs, inner_max_num_threads=1):
            yield jobs
        return
    client = _client(scheduler)
    from distributed import KilledWorker

    try:
        count = sum(client.nthreads().values())
        if not count:
            raise SemiparamError(f'the cluster at {scheduler} has no worker; expected at least one.')
        with parallel_config(backend='dask', n_jobs=count):
            yield count
    except (OSError, asyncio.CancelledError, CancelledError, KilledWorker) as error:
        raise SemiparamError(f'the cluster at {scheduler} went away before the work was done.') from error
    finally:
        client.close()


def run_all(function: Callable[..., Result], arguments: Sequence[tuple[object, ...]],
            done: Callable[[], None] = lambda: None) -> list[Result]:
    """Call ``function(*arguments[i])`` for every i, in any order; return the results in order."""
    results: dict[int, Result] = {}
    calls = (delayed(_numbered)(index, function, call) for index, call in enumerate(arguments))
    with ExitStack() as stack:
        with _interrupts_held():
            answers = Parallel(return_as='generator_unordered')(calls)
            stack.callback(_cancel, answers)
        for index, result in answers:
            results[index] = result
            done()
    return [results[index] for index in range(len(arguments))]


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back until the block ends. Processes that begin in it never see one: a terminal sends it to all, and
    each that was still loading told where it was."""
    resource_tracker.ensure_running()  # which would unblock SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _cancel(answers: Generator[object, None, None]) -> None:
    """End what is not done yet, of which joblib would warn."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', UserWarning)
        answers.close()


def _numbered(index: int, function: Callable[..., Result], call: tuple[object, ...]) -> tuple[int, Result]:
    return index, function(*call)


def _client(address: str) -> Client:
    try:
        from distributed import Client
    except ImportError as error:
        raise SemiparamError("--scheduler needs Dask: pip install 'semiparam_ros[dask]'.") from error
    try:
        asyncio.run(asyncio.wait_for(_greet(address), ANSWER_S))
        return Client(address, timeout=ANSWER_S)
    except (OSError, TimeoutError, asyncio.TimeoutError, ValueError) as error:
        raise SemiparamError(f"no Dask scheduler answers at '{address}'; expected an address such as "
                             'tcp://host:8786.') from error


async def _greet(address: str) -> None:
    """Shake hands once: a client waits for ever for something that listens but is no scheduler."""
    from distributed.comm.core import connect

    comm = await connect(address, timeout=ANSWER_S)
    await comm.close()
