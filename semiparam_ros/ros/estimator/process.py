"""The node's process: realtime priority, the executor's loop, and a clean end on SIGINT and SIGTERM."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path

from rclpy.experimental.events_executor import EventsExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.task import Future
from rclpy.utilities import ok, try_shutdown

from semiparam_ros.effects import kinds
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.worker import Scheduler, Worker, forked_worker
from semiparam_ros.ros.context import SPIN_S, StopSignals, rcl_reason, spin_for, start_rclpy
from semiparam_ros.ros.estimator.node import EstimatorNode
from semiparam_ros.settings.last_word import last_words

SWITCH_S = 2e-4
"""How long a thread keeps the interpreter's lock while the one that answers samples waits for it."""

RCLError = rclpy_implementation.RCLError


def take_priority(priority: int) -> str:
    """Let every thread of this process, but no process it starts, run by SCHED_FIFO; a sentence when that is refused.

    :param priority: 1 to 99, or 0 to leave everything as it is.
    """
    if not priority:
        return ''
    policy, parameter = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority)
    try:
        for thread in os.listdir('/proc/self/task'):
            with suppress(ProcessLookupError):  # it has ended meanwhile
                os.sched_setscheduler(int(thread), policy, parameter)
    except OSError as error:
        return (f'realtime_priority {priority} is refused by the system ({error.strerror}); the node goes on without. '
                'It needs a line "rtprio" for its user in /etc/security/limits.conf.')
    return ''


def run_estimator(ros_arguments: Sequence[str]) -> int:
    """Run the node until a signal ends it; raises SemiparamError when it cannot start."""
    worker = forked_worker()  # before the first thread
    ended = Future()
    with StopSignals(partial(ended.set_result, None)):
        return _run(ros_arguments, ended, worker)


def _run(ros_arguments: Sequence[str], ended: Future, worker: Worker) -> int:
    start_rclpy(ros_arguments)
    sys.setswitchinterval(SWITCH_S)
    try:
        # This executor takes a third of what rclpy's others take.
        executor = EventsExecutor()
        node = _new_node(executor.create_task, ros_arguments, worker)
        try:
            executor.add_node(node)
            refused = take_priority(node.settings.realtime_priority)
            if refused:
                node.get_logger().warning(refused)
            # Effects of other packages are looked for now, not between two samples.
            with suppress(SemiparamError):  # of a package that is not well: told where it is declared
                kinds(node.settings.outputs)
            gc.collect()
            gc.freeze()  # what is loaded now stays for good: it is not looked at while samples come
            while ok() and not ended.done():
                try:
                    spin_for(executor, SPIN_S, ended)
                except Exception as error:  # of a callback that does not handle its own
                    node.failed('a callback', error)
        finally:
            executor.remove_node(node)
            node.close()
    finally:
        try_shutdown()
    return 0


def parameter_files(ros_arguments: Sequence[str]) -> list[Path]:
    """Files named on the command line, the last one first, for it has the last word."""
    named = [value for option, value in pairwise(ros_arguments) if option == '--params-file']
    return [Path(path) for path in reversed(named)]


def _new_node(schedule: Scheduler, ros_arguments: Sequence[str], worker: Worker) -> EstimatorNode:
    try:
        return EstimatorNode(schedule, parameter_files(ros_arguments), worker, partial(last_words, ros_arguments))
    except RCLError as error:  # such as a security enclave that the middleware refuses
        raise SemiparamError(f'the node cannot start: {rcl_reason(error)}') from None

