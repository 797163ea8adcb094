"""Ctrl-C, sent to real processes: an orderly end by the first, an end at once by a later one, never a hang."""

import os
import pty
import signal
import subprocess
import sys
import termios
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semiparam_ros.settings import dump_params
from support.node_client import PATIENCE_S, Client
from support.node_helpers import SETTINGS, motion, write_bag

ENDED = (0, 130, -signal.SIGINT)
"""Orderly, at once, or by the signal itself (130 for a shell too) where Python has already let go of its handlers."""
READY = """
import os, sys, threading, time
from semiparam_ros.ros.context import StopSignals
stopping = threading.Event()
"""


class Group:
    """A command in a process group of its own, which Ctrl-C reaches as a whole."""

    def __init__(self, folder, *command, **options):
        self.log = folder / 'log'
        with self.log.open('wb') as stream:
            self.process = subprocess.Popen(
                [sys.executable, *map(str, command)], start_new_session=True, stdout=stream, stderr=stream,
                **{'stdin': subprocess.DEVNULL, **options})

    def wait_for(self, text):
        """Without a line's end it may be half a line: Python without buffers writes that end by itself."""
        end = time.monotonic() + PATIENCE_S
        while text not in self.output:
            assert time.monotonic() < end and self.process.poll() is None, self.output
            time.sleep(0.01)

    def send(self, number=signal.SIGINT):
        os.killpg(self.process.pid, number)

    def send_twice(self):
        """Ctrl-C, and a launcher's SIGTERM at the same time, however long this process stands still meanwhile."""
        self.send(signal.SIGSTOP)
        self.send()
        self.process.terminate()
        self.send(signal.SIGCONT)

    def code(self):
        """The exit code, when every process of the group is gone."""
        code = self.process.wait(PATIENCE_S)
        end = time.monotonic() + PATIENCE_S
        while alive(self.process.pid):
            assert time.monotonic() < end, 'a process stays behind'
            time.sleep(0.01)
        return code

    @property
    def output(self):
        return self.log.read_text()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if alive(self.process.pid):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def alive(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_signal_that_comes_while_the_event_is_being_polled(tmp_path):
    """Event.wait holds the Event's lock for some instants; here it holds it until the signal has come."""
    program = READY + """
with StopSignals(stopping.set) as signals:
    with stopping._cond:
        print('ready', flush=True)
        time.sleep(1.0)
    sys.exit(0 if stopping.wait(30.0) and signals.asked else 1)
"""
    with Group(tmp_path, '-c', program) as group:
        group.wait_for('ready\n')
        group.send()
        assert group.code() == 0, group.output


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_later_signal_ends_what_hangs(tmp_path, number):
    program = READY + """
with StopSignals(lambda: print('asked', flush=True)):
    print('ready', flush=True)
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()
"""
    with Group(tmp_path, '-c', program) as group:
        group.wait_for('ready\n')
        group.send_twice()
        group.wait_for('asked\n')
        time.sleep(0.1)
        assert group.process.poll() is None, 'signals at the same time are one'
        time.sleep(0.6)
        group.send(number)
        assert group.code() == 128 + number
        assert group.output == 'ready\nasked\n'


def test_what_waits_together_is_one_wish_however_late_it_is_looked_at():
    """The second of two signals ended a node at once where it had its turn half a second after the first."""
    program = READY + """
with StopSignals(lambda: time.sleep(0.7)) as signals:
    os.write(signals._write, bytes([2, 15]))
    time.sleep(1.5)
    print(signals.signal, 'alive')
"""
    found = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True)
    assert found.stdout == '2 alive\n'


def test_without_a_signal_everything_is_as_before():
    program = READY + """
import signal

def held():
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)], os.listdir('/proc/self/fd')

before = held()
with StopSignals(stopping.set):
    assert held() != before
assert held() == before
assert not stopping.is_set() and threading.active_count() == 1
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(5)
except KeyboardInterrupt:
    print('as usual')
"""
    found = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True)
    assert found.stdout == 'as usual\n'


def run_node(folder, **changes):
    dump_params(replace(SETTINGS, acceleration_source='measured', state_folder=str(folder), **changes),
                folder / 'p.yaml')
    return Group(folder, '-m', 'semiparam_ros.cli.main', 'run', '--params', folder / 'p.yaml')


@pytest.mark.parametrize('pauses', [(), (0.2, 0.6)], ids=str)
def test_ctrl_c_ends_the_node_and_its_processes(tmp_path, ros_domain, pauses):
    """Also while a model is being built, with as many more of them as somebody likes to press."""
    with (run_node(tmp_path, features_count=1000, initial_samples=400, checkpoint_period=60.0) as group,
          Client() as client):
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        client.connect()
        samples = motion(400)
        client.play(samples[:-1], SETTINGS.joints)
        client.state(samples[-1], SETTINGS.joints)
        client.accelerations(samples[-1], SETTINGS.joints)
        client.wrench(samples[-1])
        client.wait(lambda: len(client.heard['residual']) == 400, 'the window is evaluated')
        group.send() if pauses else group.send_twice()
        for pause in pauses:
            time.sleep(pause)
            if alive(group.process.pid):
                group.send()
        assert group.code() in (ENDED if pauses else (0,)), group.output
        assert 'Traceback' not in group.output


def test_ctrl_c_ends_a_node_that_is_given_more_than_it_answers(tmp_path, ros_domain):
    """What waits then is left: it would be answered for many seconds."""
    slow = {'horizon_length': 1000, 'features_count': 600, 'initial_samples': 20, 'checkpoint_period': 60.0}
    with run_node(tmp_path, **slow) as group, Client() as client:
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        client.connect()
        samples = motion(3000)
        client.play(samples[:50], SETTINGS.joints)
        client.take_over()
        for sample in samples[50:]:
            client.state(sample, SETTINGS.joints)
            client.accelerations(sample, SETTINGS.joints)
            client.wrench(sample)
        group.send()
        assert group.code() == 0, group.output
    with np.load(tmp_path / 'estimator.checkpoint.npz') as checkpoint:
        assert 50 <= len(checkpoint['history.stamps']) < len(samples)


@pytest.mark.parametrize('loaded', ['_yaml', '_rclpy', 'libllvmlite'])
def test_ctrl_c_while_the_node_starts(tmp_path, ros_domain, loaded):
    """As soon as the process has a library in its memory: with the first of them the command reads its parameters."""
    with run_node(tmp_path) as group:
        maps, end = Path(f'/proc/{group.process.pid}/maps'), time.monotonic() + PATIENCE_S
        while loaded not in maps.read_text():
            assert time.monotonic() < end and group.process.poll() is None, group.output
            time.sleep(0.01)
        group.send()
        assert group.code() in ENDED, group.output
        assert 'Traceback' not in group.output


def test_ctrl_c_that_an_import_has_swallowed_ends_the_node(tmp_path, ros_domain):
    """Python ignores exceptions in the callback by which an import lets go of its lock: the node never ended."""
    dump_params(replace(SETTINGS, state_folder=str(tmp_path)), tmp_path / 'p.yaml')
    program = """
import os, signal, sys
from semiparam_ros.cli.main import main

class Swallow:
    def find_spec(self, name, path, target=None):
        if name == 'rclpy':
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                print('swallowed', flush=True)

sys.meta_path.insert(0, Swallow())
sys.exit(main(['run', '--params', sys.argv[1]]))
"""
    with Group(tmp_path, '-c', program, tmp_path / 'p.yaml') as group:
        assert group.code() == 0 and 'swallowed' in group.output, group.output


@pytest.mark.parametrize(('lasts_s', 'wanted'), [(60.0, 'interrupted'), (0.0, 'over before')])
def test_ctrl_c_that_python_ignores_comes_again(lasts_s, wanted):
    """It was printed as 'Exception ignored in ...' with a traceback, and the command went on: until what the main
    thread waited in was over, where another thread got it."""
    program = """
import os, signal, time, weakref
from semiparam_ros.interrupts import remember_interrupts

class Thing:
    pass

thing = Thing()
reference = weakref.ref(thing, lambda _: os.kill(os.getpid(), signal.SIGINT))
try:
    with remember_interrupts():
        del thing
        time.sleep(LASTS_S)
    time.sleep(0.5)
    print('over before')
except KeyboardInterrupt:
    print('interrupted')
""".replace('LASTS_S', str(lasts_s))
    found = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=50.0)
    assert (found.stdout, found.stderr) == (f'{wanted}\n', '')


def test_a_second_ctrl_c_gives_the_terminal_back(tmp_path, ros_domain):
    write_bag(tmp_path / 'a.mcap', motion(500))
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    with Group(tmp_path, '-m', 'semiparam_ros.cli.main', 'replay', tmp_path / 'a.mcap', '--start-paused', stdin=theirs,
               preexec_fn=lambda: os.tcsetpgrp(0, os.getpgrp()) if take_terminal() else None) as group:
        group.wait_for('space: pause')
        assert not termios.tcgetattr(theirs)[3] & termios.ICANON
        os.kill(group.process.pid, signal.SIGSTOP)
        os.write(ours, b'\x03')
        os.kill(group.process.pid, signal.SIGCONT)
        os.write(ours, b'\x03')
        time.sleep(0.7)
        if alive(group.process.pid):
            os.write(ours, b'\x03')
        assert group.code() in ENDED, group.output
        assert termios.tcgetattr(theirs)[3] == before[3]
        assert 'Traceback' not in group.output
    os.close(ours)
    os.close(theirs)


def take_terminal():
    """Standard input becomes the controlling terminal, as in a shell."""
    import fcntl
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    return True
