"""A node started again and again, with random configurations, over one folder of states.

Each start draws its number and seed of features, its window and its variant, and whether it goes on from a checkpoint.
It learns, saves by itself and when asked, exports, and ends by SIGINT, SIGTERM or SIGKILL; in every fifth another node
of its name runs beside it for a while. After each start every state of another configuration that was there before is
there still, under whatever name.
"""

import json
import random
import signal
from collections import Counter
from dataclasses import replace

import numpy as np

from semiparam_ros.online.state_file import FIXED
from semiparam_ros.settings import dump_params
from support.node_client import Client, NodeProcess
from support.node_helpers import JOINTS, SETTINGS, motion

ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
HOUR_NS = 3600 * 10**9
ANOTHER = 'another node of the name /estimator'


class Restarts:
    """``lost`` holds what must not be; ``done`` counts what was."""

    def __init__(self, folder, seed):
        self.folder, self.states, self.chance = folder, folder / 'states', random.Random(seed)
        self.kept, self.lost, self.done, self.number = {}, [], Counter(), 0

    def start(self):
        """One start, and what is in the folder after it."""
        settings, self.number = self.settings(), self.number + 1
        (self.folder / 'one').mkdir(exist_ok=True)
        dump_params(settings, self.folder / 'p.yaml', node='/**')
        with NodeProcess(self.folder / 'one', self.folder / 'p.yaml') as node, Client() as client:
            client.offer('joint_states', 'joint_accelerations', 'wrench')
            client.connect()
            samples = motion(settings.initial_samples + 40, seed=self.number)
            client.play([sample._replace(stamp=sample.stamp + self.number * HOUR_NS) for sample in samples], JOINTS)
            client.wait_report('checkpoints', lambda level, message, values: int(values['written']) > 0)
            self.call(client)
            if self.number % 5 == 0:
                self.start_another(client, node)
            number = self.chance.choice(ENDS)
            code = node.stop(number)
            output = node.output
        self.done[f'ended by {number.name}'] += 1
        self.done['gone on from a checkpoint'] += 'the checkpoint is loaded' in output
        self.done['internal errors'] += output.count('internal error') + output.count('Traceback')
        if code != (0 if number != signal.SIGKILL else -number):
            self.lost.append(f'start {self.number} ended with {code} after {number.name}')
        self.look(settings)

    def settings(self):
        """A configuration."""
        return replace(
            SETTINGS, acceleration_source='measured', state_folder=str(self.states), checkpoint_period=0.3,
            features_count=self.chance.choice([20, 30]), features_seed=self.chance.choice([0, 1]),
            initial_samples=self.chance.choice([60, 70]), variant=self.chance.choice(['P', 'NP-ML', 'SPK-ML']),
            checkpoint_resume=self.chance.random() < 0.6, state_file=self.chance.choice(['one.npz', 'two.npz']))

    def call(self, client):
        """What a user might, now and then."""
        for service in ('save_state', 'export_model', 'reset', 'load_state'):
            if self.chance.random() < 0.3:
                reply = client.trigger(service)
                self.done[f'~/{service} {"done" if reply.success else "refused"}'] += 1
                if 'internal error' in reply.message or not reply.message.endswith('.'):
                    self.lost.append(f'start {self.number}: ~/{service}: {reply.message}')

    def start_another(self, client, node):
        """One of the same name, which must say so and write nothing."""
        (self.folder / 'another').mkdir(exist_ok=True)
        node.process.send_signal(signal.SIGSTOP)  # what is written now is not its own
        before = {path.name for path in self.states.glob('*.npz')}
        with NodeProcess(self.folder / 'another', self.folder / 'p.yaml') as another:
            client.wait(lambda: ANOTHER in another.output, 'the other one says so')
            saved = another.stop()
            if saved or 'Traceback' in another.output or 'is written' in another.output:
                self.lost.append(f'start {self.number}: the other node of its name did not keep out')
        owner = int((self.states / 'estimator.lock').read_text())
        if owner != node.process.pid or {path.name for path in self.states.glob('*.npz')} - before:
            self.lost.append(f'start {self.number}: the other node of its name wrote')
        node.process.send_signal(signal.SIGCONT)
        self.done['another node of the same name beside it'] += 1

    def look(self, settings):
        """What is kept of each configuration; nothing of another one than that of the last start may be missing."""
        found = {}
        for path in self.states.glob('*.npz'):
            with np.load(path) as archive:
                meta = json.loads(str(archive['meta']))
            key = (*(str(meta['settings'][name]) for name in FIXED), meta['settings']['variant'])
            found[key] = max(found.get(key, 0), meta['newest'] or 0)
        mapping = settings.mapping()
        own = tuple(str(list(value) if isinstance(value, tuple) else value)
                    for value in (mapping[name] for name in FIXED))
        for key, newest in self.kept.items():
            if key[:-1] != own and found.get(key, -1) < newest:
                self.lost.append(f'start {self.number} with {own}: {key} of {newest} is gone, there is '
                                 f'{found.get(key)}')
        self.kept = found

    def tell(self):
        """Print it; True when all is as it must be."""
        for what, count in sorted(self.done.items()):
            print(f'{what:45}{count:6}')
        files = Counter('aside' if 'aside' in path.name else 'unreadable' if 'unreadable' in path.name else 'other'
                        for path in self.states.glob('*.npz'))
        print(f'{self.number} starts of {len(self.kept)} configurations; {sum(files.values())} states, '
              f'{files["aside"]} of them moved aside, {files["unreadable"]} unreadable; '
              f'{len(list(self.states.glob(".*")))} temporary files left.')
        for sentence in self.lost:
            print(f'WRONG: {sentence}')
        return not (self.lost or self.done['internal errors'] or files['unreadable'])
