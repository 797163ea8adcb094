"""A small arm with a motion of its own, for the tests of the node."""

import pickle
import queue
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from semiparam_ros.bags import sample_messages
from semiparam_ros.bags.conversion import write_description
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.core.samples import Sample
from semiparam_ros.experiments.evaluation import AtOnce
from semiparam_ros.online.worker import ProcessBackground, Urgency
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body

JOINTS = ('a', 'b')
URDF = """<robot name="two">
  <link name="base"/>
  <link name="upper"><inertial><mass value="1.0"/><origin xyz="0 0 0.1"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="ft"><inertial><mass value="0.5"/><origin xyz="0.02 0 0.1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="a" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="10" velocity="10"/></joint>
  <joint name="b" type="revolute"><parent link="upper"/><child link="ft"/><origin xyz="0 0 0.3"/><axis xyz="1 0 0"/>
    <limit lower="-3" upper="3" effort="10" velocity="10"/></joint>
</robot>"""
SETTINGS = Settings(robot_description=URDF, joints=JOINTS, sensor_frame='ft', features_count=40, initial_samples=60,
                    horizon_length=5)
BODY = build_rigid_body(SETTINGS)
PERIOD_NS = 20_000_000
START_NS = 1_000_000_000
InlineBackground = AtOnce


def motion(count: int, seed: int = 0, body=BODY) -> list[Sample]:
    """Samples at 50 Hz: smooth motion, a heavier hand than described, an unmodelled bump, and noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(count)[:, None] * PERIOD_NS * 1e-9
    rate, phase = rng.uniform(1.0, 4.0, (3, body.n_joints)), rng.uniform(0, 6.3, (3, body.n_joints))
    angle = time[:, None, :] * rate + phase
    position = 0.5 * np.sin(angle).sum(axis=1)
    velocity = 0.5 * (rate * np.cos(angle)).sum(axis=1)
    acceleration = -0.5 * (rate**2 * np.sin(angle)).sum(axis=1)
    inertia = body.base_parameters * 1.2
    samples = []
    for index, row in enumerate(zip(position, velocity, acceleration, strict=True)):
        outputs = body.regressor(*row) @ inertia + 0.3 * np.sin(3.0 * row[0][0]) \
            + 0.01 * rng.standard_normal(body.n_outputs)
        samples.append(Sample(START_NS + index * PERIOD_NS, *row, outputs))
    return samples


def at_period(samples, period_ns):
    """The same samples, which come so often."""
    return [sample._replace(stamp=number * period_ns) for number, sample in enumerate(samples)]


def faster(samples, factor):
    """The same places passed at another speed, with the outputs that this takes."""
    found = []
    for sample in samples:
        state = sample.position, factor * sample.velocity, factor**2 * sample.acceleration
        change = (BODY.regressor(*state) - BODY.regressor(*sample[1:4])) @ (1.2 * BODY.base_parameters)
        found.append(sample._replace(velocity=state[1], acceleration=state[2], outputs=sample.outputs + change))
    return found


@dataclass
class DelayedJob:
    packed: bytes
    done: Callable[[object, BaseException | None], None]
    urgency: Urgency = Urgency.SHADOW
    cancelled: bool = False

    def cancel(self):
        self.cancelled = True


class DelayedBackground:
    """A background whose jobs run when the test says so; arguments and results are pickled, as between processes."""

    def __init__(self):
        self.jobs = deque()
        self.tasks = deque()

    def submit(self, function, *arguments, done, urgency=Urgency.SHADOW):
        self.jobs.append(DelayedJob(pickle.dumps((function, arguments)), done, urgency))
        return self.jobs[-1]

    def later(self, function):
        self.tasks.append(function)

    def run(self, count=1000):
        """Run up to ``count`` jobs and all tasks, those included that they bring about."""
        while (self.jobs and count) or self.tasks:
            while self.tasks:
                self.tasks.popleft()()
            if self.jobs and count:
                count -= 1
                job = self.jobs.popleft()
                if job.cancelled:
                    continue
                function, arguments = pickle.loads(job.packed)
                try:
                    result, error = pickle.loads(pickle.dumps(function(*arguments))), None
                except Exception as caught:
                    result, error = None, caught
                job.done(result, error)


class ServedProcess(ProcessBackground):
    """The node's process, whose tasks run while the test waits; what its jobs gave, with what went wrong."""

    def __init__(self, **options):
        self.tasks, self.results = queue.Queue(), []
        super().__init__(lambda *task: self.tasks.put(partial(*task)), **options)

    def begin(self, function, *arguments, urgency=Urgency.SHADOW):
        return self.submit(function, *arguments, done=lambda *result: self.results.append(result), urgency=urgency)

    def serve(self, until):
        while not until():
            self.tasks.get()()  # a busy machine hardly lets a process of low priority load: pytest has a limit

    def results_of(self, count):
        """So many results, waited for."""
        self.serve(lambda: len(self.results) >= count)
        return self.results


def write_bag(path, samples, joints=JOINTS, description=URDF, frame='ft', measured=True, wrench_late_ns=0):
    """The recording of a robot that measures accelerations or not, its wrenches between the joint states or not."""
    with BagWriter(path) as bag:
        if description:
            write_description(bag, description, samples[0].stamp)
        for sample in samples:
            sample_messages.joint_state(
                bag, sample.stamp, joints, sample.position.tolist(), sample.velocity.tolist())
            if measured:
                sample_messages.accelerations(
                    bag, sample.stamp, joints, accelerations=sample.acceleration.tolist())
            if not wrench_late_ns or sample is not samples[-1]:
                sample_messages.wrench(bag, sample.stamp + wrench_late_ns, frame, sample.outputs.tolist())
    return path


def damage_every_chunk(path):
    """Change a byte in the middle of each chunk of a bag."""
    data = bytearray(path.read_bytes())
    with open_bag(path) as bag:
        for segment in bag._index.segments:
            data[(segment.offset + segment.end) // 2] ^= 0xff
    path.write_bytes(data)
