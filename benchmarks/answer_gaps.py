"""Whether answers ever stop: the largest gap between two of them in each part of a node's life.

The node is a process of its own; this process publishes joint states and wrenches at a steady rate, without a pause.
Meanwhile it asks for what takes seconds: the initial window is estimated, variants and a shadow are built, the samples
are diagnosed, an effect is declared, a state is saved and loaded.

    python benchmarks/answer_gaps.py --rate 500 --features 500

Beside each gap stands that of this process between two sent samples, for a machine pauses by itself, and how much the
answers' gap exceeds two sample times. At the end, the gaps of a loop that does nothing else.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 29))

import numpy as np
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from rich.console import Console
from rich.table import Table
from std_srvs.srv import Trigger

from live_benchmark import JOINTS, SENSOR, URDF, Motion, Peer, connected, empty_loop, node_process
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body

WINDOW = 2000
"""Samples: half of the motion's cycle. After a shorter one the motion leaves it again and again, and jobs that estimate
hyperparameters anew stand before whatever is asked for."""
AFTER_S, LONGEST_S = 1.0, 180.0
BUSY, EMPTY_S = 0.3, 20.0


class Part(NamedTuple):
    """A part of the life: how many samples it took, and the largest gaps [ms] of the answers and of what was sent."""

    name: str
    samples: int
    answered: int
    gap: float
    own_gap: float
    latency: float


class Life:
    """Sends on while the node is asked for something, and keeps where each part began."""

    def __init__(self, peer: Peer, rate_hz: float) -> None:
        self._peer, self._rate = peer, rate_hz
        self._parts: list[tuple[str, int, int]] = []
        self._parameters = peer.create_client(SetParameters, 'estimator/set_parameters')
        self._services = {name: peer.create_client(Trigger, f'estimator/{name}') for name in (
            'diagnose', 'apply_diagnosis', 'save_state', 'load_state', 'reset')}

    def send_until(self, name: str, done: Callable[[], bool]) -> None:
        """One part: until it is done, and a second more."""
        first, end = self._peer.sent, time.monotonic() + LONGEST_S
        while not done():
            if time.monotonic() > end:
                raise SystemExit(f'{name}: not done within {LONGEST_S:g} s ({self._peer.state})')
            self._peer.send(max(1, round(0.1 * self._rate)), self._rate)
        self._peer.send(round(AFTER_S * self._rate), self._rate)
        self._parts.append((name, first, self._peer.sent))

    def call(self, name: str) -> None:
        """A service, until it has answered and the model learns again."""
        self._until_answered(name, self._services[name].call_async(Trigger.Request()))

    def set(self, **values: Any) -> None:
        """Parameters, until they hold."""
        parameters: list[ParameterMessage] = [Parameter(name, value=value).to_parameter_msg()
                                              for name, value in values.items()]
        self._until_answered(', '.join(f'{name} = {value}' for name, value in values.items()),
                             self._parameters.call_async(SetParameters.Request(parameters=parameters)))

    def _until_answered(self, name: str, future: Future) -> None:
        self._peer.state = ''
        self.send_until(name, lambda: future.done() and self.learns)

    @property
    def learns(self) -> bool:
        """Whether the node said so, since it was asked for something."""
        state = self._peer.state
        return state.startswith('learning with') and 'built' not in state

    def parts(self) -> list[Part]:
        """What was measured."""
        peer = self._peer
        stamps = list(peer.sent_at)
        sent = np.array([peer.sent_at[stamp] for stamp in stamps]) * 1e-6
        arrived = sent + 1e3 * np.array([peer.latency.get(stamp, np.nan) for stamp in stamps])
        found = []
        for name, first, end in self._parts:
            part = slice(max(first - 1, 0), end)
            late = arrived[part] - sent[part]
            found.append(Part(name, end - first, int(np.isfinite(late[-(end - first):]).sum()),
                              float(np.nanmax(np.diff(arrived[part]))), float(np.diff(sent[part]).max()),
                              float(np.nanmax(late))))
        return found


def measure(rate_hz: float, features: int) -> list[Part]:
    """A whole life at this rate."""
    settings = Settings(robot_description_file=URDF, joints=JOINTS, sensor_frame=SENSOR, features_count=features,
                        initial_samples=WINDOW, state_file='gaps.npz')
    messages = Motion(build_rigid_body(settings), rate_hz, 2 * WINDOW).serialised()
    with (TemporaryDirectory() as folder, node_process(replace(settings, state_folder=folder)) as process,
          connected(messages, rate_hz) as peer):
        gc.disable()  # a pause of this process would count as the node's
        peer.wait_for_estimator(process)
        life = Life(peer, rate_hz)
        life.send_until('initial window, estimation, takeover', lambda: life.learns)
        life.set(variant='SP-ML')
        life.set(variant='SPK-ML')
        life.set(shadow_variants=['NP-ML'])
        life.set(shadow_variants=[])
        life.call('diagnose')
        life.set(effects=['sensor_drift'])
        life.call('save_state')
        life.call('load_state')
        life.call('reset')
        peer.wait_for_answers(process, 10.0, complain=False)
        return life.parts()


def main() -> int:
    """1 when a sample was not answered."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rate', type=float, default=500.0, help='samples a second (default 500)')
    parser.add_argument('--features', type=int, default=500, help='number of random features (default 500)')
    options = parser.parse_args()
    parts = measure(options.rate, options.features)
    table = Table(title=f'{options.rate:g} samples a second, {options.features} features; milliseconds')
    for column in ('part', 'samples', 'answered', 'largest gap', 'gap of sending', 'over two samples', 'latest answer'):
        table.add_column(column, justify='left' if column == 'part' else 'right')
    two = 2e3 / options.rate
    for part in parts:
        table.add_row(part.name, str(part.samples), str(part.answered), f'{part.gap:.1f}', f'{part.own_gap:.1f}',
                      f'{max(part.gap - two, 0.0):.1f}', f'{part.latency:.1f}')
    console = Console(width=120)
    console.print(table)
    alone = empty_loop(options.rate, BUSY, EMPTY_S)
    late = alone.max() - 1e3 * BUSY / options.rate
    console.print(f'An empty loop, busy for {BUSY:.0%} of its time: at most {late:.1f} ms late in {EMPTY_S:g} s.')
    return int(any(part.answered < part.samples for part in parts))


if __name__ == '__main__':
    sys.exit(main())
