"""Commands as processes of their own that have nothing to load: one process loads the node, and is forked for each.

A node takes a second of processor time to load, a fork a hundredth. That commands start from nothing is looked at by
test_stop_signals.py, test_demo.py, test_examples.py, test_node_errors.py and test_packaging.py.

These nodes tell their status three times a second, for tests wait for it hundreds of times; those that start from
nothing tell it once.
"""

import atexit
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from functools import cache

REPORTS_S = 0.3


def start(arguments, log, environment, folder=None):
    """`semiparam` with these arguments as a process, in a folder or in this one's.

    Coverage does not count what is forked: there it loads.
    """
    if 'COVERAGE_PROCESS_CONFIG' in os.environ:
        return subprocess.Popen([sys.executable, '-m', 'semiparam_ros.cli.main', *arguments], env=environment,
                                cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)
    return ForkedProcess(arguments, log, environment, folder or os.getcwd())


class ForkedProcess:
    """`semiparam ...`, with what the tests use of ``subprocess.Popen``."""

    def __init__(self, arguments, log, environment, folder):
        self.returncode = None
        self._line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        request = json.dumps([arguments, environment, str(folder)]).encode()
        with theirs:
            socket.send_fds(_server(), [request], [theirs.fileno(), log.fileno()])
        self.pid = int(self._line.recv(20))

    def poll(self):
        """The exit code, None while it runs."""
        with suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout=None):
        """The exit code, as soon as there is one."""
        if self.returncode is None:
            self._line.settimeout(timeout)
            try:
                self.returncode = int(self._line.recv(20))
            except (TimeoutError, BlockingIOError):
                raise subprocess.TimeoutExpired('semiparam', timeout) from None
        return self.returncode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(15)

    def kill(self):
        self.send_signal(9)


@cache
def _server():
    """The line to the process that is forked; it ends with this one."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        process = subprocess.Popen([sys.executable, __file__, str(theirs.fileno())], stdin=subprocess.DEVNULL,
                                   pass_fds=[theirs.fileno()])
    atexit.register(lambda: (ours.close(), process.wait()))
    return ours


def serve(control):
    """Fork for each request, until nobody can ask any more."""
    from semiparam_ros.cli.main import main
    from semiparam_ros.ros.estimator import diagnostics, process  # noqa: F401  (what a node loads)

    diagnostics.PERIOD_S = REPORTS_S
    gc.freeze()
    while True:
        request, descriptors, *_ = socket.recv_fds(control, 1 << 20, 2)
        if not request:
            return 0
        if os.fork() == 0:
            control.close()
            return main(_forked(*json.loads(request), *descriptors))
        for descriptor in descriptors:
            os.close(descriptor)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


def _forked(arguments, environment, folder, line, log):
    """In a process of its own, whose parent tells its number and at last its exit code: the arguments."""
    started = os.fork()
    if started:
        os.close(log)
        os.write(line, str(started).encode())
        _end_with(line, started)
        with suppress(BrokenPipeError):
            os.write(line, str(os.waitstatus_to_exitcode(os.waitpid(started, 0)[1])).encode())
        os._exit(0)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(line)
    os.close(log)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = ['semiparam', *arguments]
    return arguments


def _end_with(line, started):
    """Wait for a process; kill it where who asked for it is gone: it would answer in the domains of other tests."""
    ended = os.pidfd_open(started)
    ends = select.poll()
    ends.register(ended, select.POLLIN)
    ends.register(line, 0)  # a hang-up is always told
    if all(descriptor == line for descriptor, _ in ends.poll()):
        os.kill(started, signal.SIGKILL)


if __name__ == '__main__':
    sys.exit(serve(socket.socket(fileno=int(sys.argv[1]))))
