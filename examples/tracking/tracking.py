"""An arm follows better with torques that are learnt while it moves: MuJoCo and the live node, over DDS.

    python examples/tracking/tracking.py ROBOTS                     a UR3 and a Panda
    python examples/tracking/tracking.py --urdf config/icub_right_arm.urdf    an arm of your own

ROBOTS is the folder ``robots`` of example-robot-data. MuJoCo moves arms with what their description
lacks: friction in every joint, other masses, a load in the hand, a cable at the second joint. A PD
controller at 500 Hz takes feedforward torques: none, those of the description, or those of the
node. The node starts without any model. It gets the joint states of the controlled arm, and the
desired states 0.2 s before they are due, as ``desired_trajectory``; what is on
``~/feedforward_trajectory`` then is interpolated and cut to the description's limits. Until there
is a model the description answers. Nothing is chosen by hand, nothing diagnosed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / 'benchmarks'))

import numpy as np
import rclpy
from builtin_interfaces.msg import Duration, Time
from matplotlib.figure import Figure
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rich.console import Console
from rich.table import Table
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from mujoco_arms import SETTINGS, Setting
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array
from semiparam_ros.settings import Settings, dump_params
from semiparam_ros.settings.robot_description import moving_joints
from support.mujoco_arm import STEP_S
from tracking import Arm, size

RATE_HZ, POINTS_HZ = 500, 100
SEGMENT_S = 0.2
"""Desired states are sent so long before they are due, and as many at a time."""
START_NS = 10**9
PATIENCE_S = 60.0
PAUSE_S = 1.0
"""Between two motions, by the stamps."""
EARLY_S = 20.0
NAMES = {'none': 'none', 'description': "the description's", 'learnt': 'learnt live'}
COLOURS = {'none': '#52616f', 'description': '#dd8a00', 'learnt': '#2f6fd0'}


class Controller(Node):
    """Publishes joint states, sends desired states ahead, and holds the torques that come back.

    :param speed: times real time. The motion waits where torques do not come in time, and says how long.
    """

    def __init__(self, arm: Arm, speed: float) -> None:
        super().__init__('controller')
        self.arm, self.speed, self.waited = arm, speed, 0.0
        self._torques: dict[int, Array] = {}
        self._came = threading.Condition()
        self._states = self.create_publisher(JointState, 'joint_states', 1000)
        self._wishes = self.create_publisher(JointTrajectory, 'desired_trajectory', 100)
        self.create_subscription(JointTrajectory, 'estimator/feedforward_trajectory', self._receive, 100)

    def meet(self) -> None:
        """Wait for the node."""
        deadline = time.monotonic() + PATIENCE_S
        while not (self._states.get_subscription_count() and self._wishes.get_subscription_count()
                   and self.count_publishers('estimator/feedforward_trajectory')):
            if time.monotonic() > deadline:
                raise SystemExit('the node estimator did not come.')
            time.sleep(0.05)

    def run(self, motion: str, seconds: float, take: int, start_ns: int) -> Array:
        """(N, n) tracking errors of a motion with the node's torques."""
        wanted, speed, change, _ = self.arm.path(motion, seconds, take)
        every = round(1.0 / POINTS_HZ / STEP_S)
        self._points = [part[::every] for part in (wanted, speed, change)]
        self._torques, self._sent, self._start, self._step = {}, 0, start_ns, 0
        self._limits = self.arm.body.effort_limits
        self._send_until(SEGMENT_S)
        self._begun = time.monotonic()
        return self.arm.follow(motion, seconds, take, self._forward, self._heard, start_ns)

    def _forward(self, *_: Array) -> Array:
        """The torques of this control step, between those of the two points about it."""
        now = self._step / RATE_HZ
        self._step += 1
        self._send_until(now + 2 * SEGMENT_S)
        index, share = divmod(now * POINTS_HZ, 1.0)
        before = self._torque(int(index))
        after = self._torque(min(int(index) + 1, len(self._points[0]) - 1))
        self._pace(now)
        return np.clip(before + share * (after - before), -self._limits, self._limits)

    def _pace(self, now: float) -> None:
        ahead = now / self.speed + self.waited - (time.monotonic() - self._begun)
        if ahead > 0.002:
            time.sleep(ahead)

    def _heard(self, sample: Sample) -> None:
        """The encoders and the torques that were commanded."""
        message = JointState(name=list(self.arm.setting.joints), position=sample.position.tolist(),
                             velocity=sample.velocity.tolist(), effort=sample.outputs.tolist())
        message.header.stamp = stamp(sample.stamp)
        self._states.publish(message)

    def _send_until(self, seconds: float) -> None:
        """Desired states that are due before a time, a segment in a message."""
        count = round(SEGMENT_S * POINTS_HZ)
        while self._sent < len(self._points[0]) and self._sent + count <= round(seconds * POINTS_HZ) + 1:
            message = JointTrajectory(joint_names=list(self.arm.setting.joints))
            message.header.stamp = stamp(self._start + self._sent * 10**9 // POINTS_HZ)
            for index in range(self._sent, min(self._sent + count, len(self._points[0]))):
                q, dq, ddq = (part[index].tolist() for part in self._points)
                offset = Duration(nanosec=(index - self._sent) * 10**9 // POINTS_HZ)
                message.points.append(JointTrajectoryPoint(positions=q, velocities=dq, accelerations=ddq,
                                                           time_from_start=offset))
            self._wishes.publish(message)
            self._sent += count

    def _receive(self, message: JointTrajectory) -> None:
        """Torques of a segment, by the number of its points in the motion."""
        first = nanoseconds(message.header.stamp) - self._start
        order = [message.joint_names.index(name) for name in self.arm.setting.joints]
        with self._came:
            for point in message.points:
                index = round((first + nanoseconds(point.time_from_start)) * POINTS_HZ / 10**9)
                self._torques[index] = np.array(point.effort)[order]
            self._came.notify()

    def _torque(self, index: int) -> Array:
        begun = time.monotonic()
        with self._came:
            if index not in self._torques:
                if not self._came.wait_for(lambda: index in self._torques, PATIENCE_S):
                    raise SystemExit(f'no torque came for the desired state {index}.')
                self.waited += time.monotonic() - begun
            return self._torques[index]


def stamp(nanoseconds: int) -> Time:
    return Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def nanoseconds(time: Any) -> int:
    return int(time.sec) * 10**9 + int(time.nanosec)


def live(arm: Arm, urdf: str, folder: Path, speed: float, work: Callable[[Controller], dict[str, Array]]
         ) -> tuple[dict[str, Array], float]:
    """What the work gives while the node runs, and how long [s] the motion waited for torques."""
    settings = Settings(robot_description=urdf, joints=arm.setting.joints, outputs='effort', learn_every=5,
                        feedforward_before_ready='description')
    dump_params(settings, folder / 'params.yaml')
    with (folder / 'node.log').open('wb') as log:
        node = subprocess.Popen([sys.executable, '-m', 'semiparam_ros.cli.main', 'run', '--params',
                                 str(folder / 'params.yaml')], stdout=log, stderr=log)
        rclpy.init(args=[])
        controller, ended = Controller(arm, speed), threading.Event()
        executor = EventsExecutor()
        executor.add_node(controller)

        def spin() -> None:
            while not ended.is_set():
                executor.spin_once(timeout_sec=0.1)

        thread = threading.Thread(target=spin, daemon=True)
        thread.start()
        try:
            controller.meet()
            return work(controller), controller.waited
        finally:
            ended.set()
            thread.join()
            controller.destroy_node()
            rclpy.try_shutdown()
            node.terminate()
            node.wait(timeout=PATIENCE_S)


def compared(setting: Setting, urdf: str, folder: Path, seconds: float, speed: float) -> dict[str, Any]:
    """Tracking errors with each kind of feedforward: while it is learnt, and on another motion after that."""
    arm = Arm(setting, urdf, RATE_HZ)
    kinds: dict[str, Callable[..., Array]] = {
        'none': lambda *row: np.zeros(len(setting.joints)),
        'description': lambda *row: np.asarray(arm.body.regressor(*row) @ arm.body.base_parameters)}
    first = {name: arm.follow('points', seconds, 1, kind) for name, kind in kinds.items()}
    other = {name: arm.follow('sines', seconds / 2, 2, kind) for name, kind in kinds.items()}

    def work(controller: Controller) -> dict[str, Array]:
        learning = controller.run('points', seconds, 1, START_NS)
        later = START_NS + round((seconds + PAUSE_S) * 1e9)
        return {'first': learning, 'other': controller.run('sines', seconds / 2, 2, later)}

    found, waited = live(arm, urdf, folder, speed, work)
    first['learnt'], other['learnt'] = found['first'], found['other']
    early = round(min(EARLY_S, seconds / 2) / STEP_S)
    return {'first': first, 'waited_s': waited, 'figures': {
        'first seconds': {name: 1e3 * size(errors[:early], 1.0) for name, errors in first.items()},
        'after that': {name: 1e3 * size(errors[early:], 0.0) for name, errors in first.items()},
        'another motion': {name: 1e3 * size(errors) for name, errors in other.items()}}}


def drawn(results: dict[str, dict[str, Any]], path: Path) -> None:
    """Errors over the first motion, in blocks of a second."""
    figure = Figure(figsize=(9.0, 2.6 * len(results)), layout='constrained')
    panels = figure.subplots(len(results), squeeze=False)[:, 0]
    block = round(1.0 / STEP_S)
    for panel, (name, result) in zip(panels, results.items(), strict=True):
        for kind, errors in result['first'].items():
            whole = errors[:len(errors) // block * block].reshape(-1, block * errors.shape[1])
            panel.plot(1e3 * np.sqrt(np.mean(whole**2, axis=1)), color=COLOURS[kind], label=NAMES[kind])
        panel.set(title=name, ylabel='tracking error [mrad]', yscale='log')
        panel.grid(alpha=0.25)
        panel.spines[['top', 'right']].set_visible(False)
    panels[0].legend(title='feedforward', fontsize='small', frameon=False, ncols=3)
    panels[-1].set_xlabel('time since the node began without a model [s]')
    figure.savefig(path, dpi=120)


def settings_of(given: argparse.Namespace) -> list[tuple[Setting, str]]:
    """The arms, each with the text of its description."""
    if given.urdf:
        urdf = given.urdf.read_text()
        joints = tuple(given.joints or moving_joints(Settings(outputs='effort'), urdf))
        own = Setting(given.urdf.stem, '', joints, (0.3,) * len(joints), (0.5,) * len(joints), armature=0.02,
                      stiffness=(0.0, 3.0), seed=given.seed)
        return [(own, urdf)]
    if given.robots is None:
        raise SystemExit('expected the folder ROBOTS of example-robot-data, or --urdf FILE.')
    found = {setting.name.split()[0].rstrip(','): setting for setting in SETTINGS}
    arms = (replace(found['UR5'], name='UR3', urdf='ur_description/urdf/ur3_robot.urdf', carrier='tool0',
                    friction=(3.0, 3.0, 2.0, 0.8, 0.8, 0.6)),
            replace(found['Panda'], name='Panda', carrier='panda_hand'))
    return [(replace(arm, late_s=0.0, asymmetry=0.0, rest_s=0.0, gains=(), zeros=(), sensor=None, payload_kg=0.7,
                     stiffness=(0.0, 8.0), seed=given.seed), (given.robots / arm.urdf).read_text())
            for arm in arms if not given.arms or arm.name in given.arms]


def main() -> int:
    """A table, a plot and the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('robots', type=Path, nargs='?', metavar='ROBOTS')
    parser.add_argument('--arms', nargs='+', help='of UR3 and Panda')
    parser.add_argument('--urdf', type=Path, help='another arm')
    parser.add_argument('--joints', nargs='+', help='of that arm; all that move unless given')
    parser.add_argument('--seconds', type=float, default=60.0, help='of the first motion')
    parser.add_argument('--speed', type=float, default=1.0, help='times real time, at most')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--folder', type=Path, default=Path('output/tracking'))
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    table = Table('arm', 'RMS error [mrad]', *NAMES.values(), 'learnt over description')
    results = {}
    for setting, urdf in settings_of(given):
        results[setting.name] = result = compared(setting, urdf, given.folder, given.seconds, given.speed)
        for what, values in result['figures'].items():
            table.add_row(setting.name, what, *(f'{values[name]:.2f}' for name in NAMES),
                          f'{values["learnt"] / values["description"]:.2f}')
    Console(width=110).print(table)
    drawn(results, given.folder / 'tracking.png')
    figures = {name: {'waited_s': result['waited_s'], **result['figures']} for name, result in results.items()}
    (given.folder / 'tracking.json').write_text(json.dumps(figures, indent=1) + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
