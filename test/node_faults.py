"""Every kind of bad message, thrown at a live node between good ones.

    python test/node_faults.py --seconds 600 --rate 200 --seed 1

tells what was thrown and refused, and compares the node's predictions with those of an estimator that saw only the good
samples.
"""

import argparse
import os
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

NAN, INFINITE = float('nan'), float('inf')


class Fuzzer:
    """Publishes good samples, and bad messages of all kinds among them, chosen by a seed."""

    def __init__(self, client, joints, first_stamp, seed):
        self.client, self.joints, self.first_stamp = client, list(joints), first_stamp
        self.chance, self.thrown, self.last = random.Random(seed), Counter(), {}
        self.kinds = {
            'NaN position': ('not_finite', lambda sample: self.state(sample, position=[NAN, 0.0])),
            'infinite velocity': ('not_finite', lambda sample: self.state(sample, velocity=[0.0, INFINITE])),
            'joint missing': ('missing_joint', lambda sample: client.state(sample, self.joints[:1], position=[0.0],
                                                                           velocity=[0.0])),
            'joint twice': ('missing_joint', lambda sample: client.state(sample, [self.joints[0]] * 2)),
            'no joint': ('missing_joint', lambda sample: client.state(sample, [], position=[], velocity=[])),
            'no velocities': ('wrong_length', lambda sample: self.state(sample, velocity=[])),
            'too many positions': ('wrong_length', lambda sample: self.state(sample, position=[0.0] * 3)),
            'joint state of the past': ('backward_stamp', lambda sample: self.state(self.past(sample))),
            'joint state again': ('duplicate_stamp', lambda sample: self.state(self.again(sample))),
            'NaN force': ('not_finite', lambda sample: self.wrench(sample, 0, NAN)),
            'infinite torque': ('not_finite', lambda sample: self.wrench(sample, 5, -INFINITE)),
            'other frame': ('wrong_frame', lambda sample: client.wrench(sample, frame='elsewhere')),
            'wrench of the past': ('backward_stamp', lambda sample: client.wrench(self.past(sample))),
            'wrench again': ('duplicate_stamp', lambda sample: client.wrench(self.again(sample))),
            'NaN acceleration': ('not_finite', lambda sample: self.accelerations(sample, [[NAN, 1.0]])),
            'no point': ('wrong_length', lambda sample: self.accelerations(sample, [])),
            'two points': ('wrong_length', lambda sample: self.accelerations(sample, [[0.0, 0.0]] * 2)),
        }

    def throw(self, sample, bad):
        """So many bad messages, then a good sample whose topics come in any order, its joints in any order too."""
        names = list(self.kinds) if self.last else [name for name in self.kinds if 'again' not in name
                                                    and 'past' not in name]
        for name in self.chance.sample(names, bad):
            self.thrown[name] += 1
            self.kinds[name][1](sample)
        good = [lambda: self.shuffled_state(sample), lambda: self.client.accelerations(sample, self.joints),
                lambda: self.client.wrench(sample)]
        self.chance.shuffle(good)
        for publish in good:
            publish()
        self.last = sample

    def refusals(self):
        """How often the node must have refused for each reason."""
        counts = Counter()
        for name, count in self.thrown.items():
            counts[self.kinds[name][0]] += count
        return dict(counts)

    def shuffled_state(self, sample):
        order = self.chance.sample(range(len(self.joints)), len(self.joints))
        self.client.state(sample, [self.joints[index] for index in order], position=sample.position[order].tolist(),
                          velocity=sample.velocity[order].tolist())

    def state(self, sample, **fields):
        self.client.state(sample, self.joints, **fields)

    def wrench(self, sample, index, value):
        outputs = sample.outputs.copy()
        outputs[index] = value
        self.client.wrench(sample._replace(outputs=outputs))

    def accelerations(self, sample, points):
        message = JointTrajectory(joint_names=self.joints,
                                  points=[JointTrajectoryPoint(accelerations=point) for point in points])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(sample.stamp, 10**9)
        self.client.outputs['joint_accelerations'].publish(message)

    def past(self, sample):
        return sample._replace(stamp=self.chance.choice([5, self.first_stamp - 1]))

    def again(self, sample):
        return sample._replace(stamp=self.last.stamp)


def main(argv=None):
    """Fuzz a node for some minutes; 0 when it is alive, flat in memory, and equal to one that saw only good samples."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=600.0)
    parser.add_argument('--rate', type=float, default=200.0)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args(argv)
    os.environ.setdefault('ROS_DOMAIN_ID', '59')
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with tempfile.TemporaryDirectory() as folder:
        return fuzz(Path(folder), options)


def fuzz(folder, options):
    from dataclasses import replace

    from node_client import Client, NodeProcess, values_of
    from node_helpers import JOINTS, SETTINGS, motion

    from semiparam_ros.settings import dump_params
    from semiparam_ros.settings.build import build_estimator

    settings = replace(SETTINGS, acceleration_source='measured')
    dump_params(settings, folder / 'p.yaml')
    samples, estimator = motion(round(options.seconds * options.rate)), build_estimator(settings)
    worst, memory = 0.0, []
    with NodeProcess(folder, folder / 'p.yaml') as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        fuzzer, start, answered = Fuzzer(client, JOINTS, samples[0].stamp, options.seed), time.monotonic(), 0
        for index, sample in enumerate(samples):
            time.sleep(max(0.0, start + index / options.rate - time.monotonic()))
            fuzzer.throw(sample, bad=1)
            client.heard['/diagnostics'][:-1] = []
            if index % 2000 == 1999 or index == len(samples) - 1:
                client.wait(lambda: len(client.heard['residual']) + answered > index, 'answers')  # noqa: B023
                heard = client.heard['predicted_wrench'][:index + 1 - answered]
                for message, seen in zip(heard, samples[answered:index + 1], strict=True):
                    worst = max(worst, float(np.abs(estimator.step(seen).mean - values_of(message)).max()))
                answered = index + 1
                client.forget()
                memory.append(resident_mb(node.process.pid))
        client.wait(lambda: client.heard['/diagnostics'], 'diagnostics')
        wanted = fuzzer.refusals()
        _, _, values = client.wait_report('inputs', lambda level, message, values: all(
            int(values.get(f'refused: {reason}', 0)) >= count for reason, count in wanted.items()))
        refused = {reason: int(values[f'refused: {reason}']) for reason in wanted}
        alive = node.process.poll() is None
        code, _ = node.stop()
    print(f'{len(samples)} good samples at {options.rate:g} Hz, seed {options.seed}, all answered; largest difference '
          f'from an estimator that saw only them: {worst:.1e} N or N m')
    for name in fuzzer.kinds:
        print(f'{fuzzer.thrown[name]:>7}  {name} ({fuzzer.kinds[name][0]})')
    print(f'refused by the node: {refused}, as thrown: {refused == wanted}')
    print(f'memory {memory[0]:.1f} MB after 2000 samples, {memory[len(memory) // 2]:.1f} MB halfway, '
          f'{memory[-1]:.1f} MB at the end; exit code {code}')
    return int(not (alive and code == 0 and refused == wanted and worst < 1e-9))


def resident_mb(process_id):
    status = Path(f'/proc/{process_id}/status').read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith('VmRSS')) / 1024


if __name__ == '__main__':
    sys.exit(main())
