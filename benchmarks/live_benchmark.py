"""How the node bears a fast robot: joint states and wrenches at a steady rate over real DDS, every answer timed.

The node is a process of its own; this process publishes, receives the predictions and watches the node's memory.

    python benchmarks/live_benchmark.py --rate 1000 --seconds 60 --features 500
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.context import Context
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSHistoryPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import try_shutdown
from sensor_msgs.msg import JointState

from semiparam_ros.bags.header_stamp import read_stamp, with_stamp
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.cdr import joint_state_layout, wrench_layout
from semiparam_ros.ros.context import spin_for
from semiparam_ros.settings import Settings, dump_params
from semiparam_ros.settings.build import build_rigid_body

CYCLE = 4000
JOINTS = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow')
SENSOR = 'r_arm_ft_sensor'

READY_S, QUIET_S, EMPTY_S = 300.0, 30.0, 30.0
SWITCH_S = 1e-4
"""A thread of this process that receives waits so long for the one that sends, lest that be the node's latency."""
KEEP_ALL = QoSProfile(history=QoSHistoryPolicy.KEEP_ALL, depth=0)
URDF = 'package://semiparam_ros/config/icub_right_arm.urdf'


def empty_loop(rate_hz: float, share: float, seconds: float) -> Array:
    """How late [ms] this machine is with nothing but a loop that is busy for ``share`` of every period.

    Each value is the end of a period's work after its beginning, as a node's answer: no program that works as much is
    earlier here.
    """
    period = 1.0 / rate_hz
    late, start = [], time.perf_counter()
    for index in range(round(rate_hz * seconds)):
        due = start + index * period
        time.sleep(max(0.0, due - time.perf_counter()))
        end = time.perf_counter() + share * period
        while time.perf_counter() < end:
            pass
        late.append(1e3 * (time.perf_counter() - due))
    return np.array(late)


def quantiles(milliseconds: Array) -> dict[str, float]:
    """Median, 99 % quantile and maximum; NaN of nothing."""
    values = np.quantile(milliseconds, (0.5, 0.99, 1.0)) if len(milliseconds) else (np.nan,) * 3
    return dict(zip(('median', 'p99', 'max'), map(float, values), strict=True))


class Motion:
    """A smooth motion that comes again after ``cycle`` samples, and the wrench that a rigid body with some noise would
    measure."""

    def __init__(self, body: RigidBody, rate_hz: float, cycle: int) -> None:
        rng = np.random.default_rng(0)
        time_s = np.arange(cycle)[:, None] / rate_hz
        turns = np.arange(1, 5) / (cycle / rate_hz) * 2.0 * np.pi
        amplitude, phase = rng.uniform(0.1, 0.3, (4, body.n_joints)), rng.uniform(0, 2 * np.pi, (4, body.n_joints))
        angle = turns[:, None] * time_s[:, :, None] + phase
        self.position = np.sum(amplitude * np.sin(angle), axis=1)
        self.velocity = np.sum(amplitude * turns[:, None] * np.cos(angle), axis=1)
        acceleration = -np.sum(amplitude * turns[:, None]**2 * np.sin(angle), axis=1)
        rows = zip(self.position, self.velocity, acceleration, strict=True)
        wrench = np.array([body.regressor(*row) @ body.base_parameters for row in rows])
        self.wrench: Array = wrench + 0.01 * rng.standard_normal(wrench.shape)

    def serialised(self) -> list[tuple[bytes, bytes]]:
        """Joint state and wrench of each instant as they go over the wire, to be stamped.

        The two processors of a virtual machine may share one core: this process must not slow the node down.
        """
        states, wrenches = joint_state_layout('', JOINTS, len(JOINTS), len(JOINTS), 0), wrench_layout(SENSOR)
        return [(states.write(0, position.tolist(), velocity.tolist()), wrenches.write(0, wrench.tolist()))
                for position, velocity, wrench in zip(self.position, self.velocity, self.wrench, strict=True)]


def run_live(rate_hz: float = 1000.0, seconds: float = 60.0, features: int = 500,
             priority: int = 0, window: int = CYCLE) -> dict[str, Any]:
    """Publish for ``seconds`` at ``rate_hz``; what was sent, answered and lost, latencies [ms], memory [MB], cpu [%].

    The node has its hyperparameters by then; ``while_estimating`` are the latencies before, when the background process
    worked beside it. ``empty_loop``: how late the same machine is, right afterwards, with an empty loop that is busy
    for as long.

    :param window: samples of the initial window, and of the motion, which no later motion leaves so.
    Raises SemiparamError when the node does not start or does not answer.
    """
    settings = Settings(robot_description_file=URDF, joints=JOINTS, sensor_frame=SENSOR,
                        features_count=features, initial_samples=window, realtime_priority=priority)
    messages = Motion(build_rigid_body(settings), rate_hz, window).serialised()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 29))
    with node_process(settings) as process, connected(messages, rate_hz) as peer:
        gc.disable()  # a pause of this process would send a burst, and count as the node's latency
        sys.setswitchinterval(SWITCH_S)
        peer.wait_for_estimator(process)
        peer.send(window, rate_hz)
        peer.send_until_learning(process, rate_hz)
        peer.wait_for_answers(process, READY_S)
        before = _usage(process.pid)
        first = peer.sent
        peer.send(round(rate_hz * seconds), rate_hz, watch=lambda: _usage(process.pid))
        peer.wait_for_answers(process, QUIET_S, complain=False)
        result = peer.account(window, first, before, _usage(process.pid), rate_hz, features)
    share = min(result['cpu_percent'] / 100.0, 0.95)
    late = empty_loop(rate_hz, share, min(seconds, EMPTY_S))
    return result | {'empty_loop': {'busy_share': share, **quantiles(late)}}


class Peer(Node):
    """Publishes the motion and times the predictions."""

    def __init__(self, context: Context, messages: list[tuple[bytes, bytes]], rate_hz: float) -> None:
        super().__init__('live_benchmark', context=context, start_parameter_services=False)
        self._messages, self._step = messages, round(NANOSECONDS / rate_hz)
        self.sent = 0
        self._states = self.create_publisher(JointState, 'joint_states', KEEP_ALL)
        self._wrenches = self.create_publisher(WrenchStamped, 'wrench', KEEP_ALL)
        self.sent_at: dict[int, int] = {}
        """[ns] by stamp."""
        self.latency: dict[int, float] = {}
        """[s] by stamp."""
        self._memory: list[float] = []
        self.state = ''
        """What the node says of its learning."""
        self.create_subscription(WrenchStamped, 'estimator/predicted_wrench', self._receive, KEEP_ALL, raw=True)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._note_state, KEEP_ALL)

    def wait_for_estimator(self, process: subprocess.Popen[bytes]) -> None:
        """Until both sides have found each other."""
        self._wait(lambda: self.count_publishers('estimator/predicted_wrench') > 0
                   and self._states.get_subscription_count() > 0 and self._wrenches.get_subscription_count() > 0,
                   process, READY_S, 'the node did not appear')
        # The node must have found us too, or its first answers would go nowhere: whose reports are heard knows their
        # subscription, and so the one of before.
        self._wait(lambda: self.state, process, READY_S, 'the node gives no diagnostics')

    def wait_for_answers(self, process: subprocess.Popen[bytes], timeout_s: float, complain: bool = True) -> None:
        """Until everything sent is answered."""
        self._wait(lambda: len(self.latency) >= self.sent, process, timeout_s, 'the node does not answer', complain)

    def send(self, count: int, rate_hz: float, watch: Any = None) -> None:
        """Publish ``count`` joint states and wrenches, evenly in time; ``watch`` is called once a second."""
        period = 1.0 / rate_hz
        start = time.perf_counter()
        for index in range(count):
            pause = start + index * period - time.perf_counter()
            if pause > 0.0:
                time.sleep(pause)
            if watch is not None and index % round(rate_hz) == 0:
                self._memory.append(watch()[0])
            self._send_one()

    def send_until_learning(self, process: subprocess.Popen[bytes], rate_hz: float) -> None:
        """Go on until the variant has its hyperparameters and has taken over, and nothing is built beside it."""
        end = time.monotonic() + READY_S
        while True:
            self.send(max(1, round(0.1 * rate_hz)), rate_hz)
            if self.state.startswith('learning with') and 'being built' not in self.state:
                return
            if process.poll() is not None or time.monotonic() > end:
                raise SemiparamError(f'the variant did not take over within {READY_S:g} s.')

    def _note_state(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'estimator: learning':
                self.state = status.message

    def account(self, window: int, first: int, before: tuple[float, float], after: tuple[float, float],
                rate_hz: float, features: int) -> dict[str, Any]:
        """The result, of the messages from number ``first`` on; hyperparameters were estimated from ``window`` on."""
        stamps = list(self.sent_at)
        latency, estimating = (np.array([self.latency[stamp] for stamp in some if stamp in self.latency]) * 1e3
                               for some in (stamps[first:], stamps[window:first]))
        stamps = stamps[first:]
        span = (self.sent_at[stamps[-1]] - self.sent_at[stamps[0]]) * 1e-9
        half = len(self._memory) // 2
        return {
            'rate_hz': rate_hz, 'reached_rate_hz': (len(stamps) - 1) / span, 'features': features,
            'seconds': span, 'sent': len(stamps), 'answered': len(latency), 'lost': len(stamps) - len(latency),
            'latency_ms': quantiles(latency), 'while_estimating': quantiles(estimating),
            'memory_mb': {'start': before[0], 'middle': self._memory[half], 'end': after[0]},
            'cpu_percent': 100.0 * (after[1] - before[1]) / span}

    def _send_one(self) -> None:
        state, wrench = self._messages[self.sent % len(self._messages)]
        stamp = NANOSECONDS + self.sent * self._step
        self._states.publish(with_stamp(state, stamp))
        self.sent += 1
        wrench = with_stamp(wrench, stamp)
        self.sent_at[stamp] = time.perf_counter_ns()
        self._wrenches.publish(wrench)

    def _receive(self, message: bytes) -> None:
        now = time.perf_counter_ns()
        stamp = read_stamp(message)
        self.latency[stamp] = (now - self.sent_at[stamp]) * 1e-9

    def _wait(self, condition: Any, process: subprocess.Popen[bytes], timeout_s: float, complaint: str,
              complain: bool = True) -> None:
        end = time.monotonic() + timeout_s
        while not condition():
            if process.poll() is not None:
                raise SemiparamError(f'the node ended with code {process.returncode} during the benchmark.')
            if time.monotonic() > end:
                if complain:
                    raise SemiparamError(f'{complaint} within {timeout_s:g} s.')
                return
            time.sleep(0.02)


@contextmanager
def node_process(settings: Settings) -> Iterator[subprocess.Popen[bytes]]:
    """The estimator in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'live.yaml')
        dump_params(settings, path)
        process = subprocess.Popen([sys.executable, '-m', 'semiparam_ros.cli.main', 'run', '--params', str(path)],
                                   env={**os.environ, 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'})
        try:
            yield process
        finally:
            process.terminate()
            process.wait(timeout=20)


@contextmanager
def connected(messages: list[tuple[bytes, bytes]], rate_hz: float) -> Iterator[Peer]:
    """A peer that receives in a thread of its own."""
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    peer, executor = Peer(context, messages, rate_hz), EventsExecutor(context=context)
    executor.add_node(peer)
    stop = Future()

    def spin() -> None:
        while not stop.done():
            spin_for(executor, 0.2, stop)

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield peer
    finally:
        stop.set_result(None)
        thread.join()
        executor.remove_node(peer)
        peer.destroy_node()
        try_shutdown(context=context)


def _usage(process_id: int) -> tuple[float, float]:
    """(resident memory [MB], processor time [s]) of a process, as Linux tells them."""
    status = Path(f'/proc/{process_id}/status').read_text(encoding='ascii')
    resident = next(int(line.split()[1]) for line in status.splitlines() if line.startswith('VmRSS'))
    fields = Path(f'/proc/{process_id}/stat').read_text(encoding='ascii').rpartition(')')[2].split()
    return resident / 1024.0, (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def main() -> int:
    """The result as JSON; 1 when something was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rate', type=float, default=1000.0, help='joint states and wrenches a second (default 1000)')
    parser.add_argument('--seconds', type=float, default=60.0, help='length of the measurement (default 60)')
    parser.add_argument('--features', type=int, default=500, help='number of random features (default 500)')
    parser.add_argument('--realtime-priority', type=int, default=0, help='of the node (default 0: none)')
    parser.add_argument('--window', type=int, default=CYCLE,
                        help=f'samples of the initial window, and of the motion that repeats (default {CYCLE})')
    options = parser.parse_args()
    result = run_live(options.rate, options.seconds, options.features, options.realtime_priority, options.window)
    print(json.dumps(result, indent=2))
    return int(result['lost'] > 0)


if __name__ == '__main__':
    sys.exit(main())
