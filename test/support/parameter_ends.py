"""Every live parameter at both ends of its range, one after the other, while samples come at a rate.

A node learns a history first, which a changed model has to learn again. Each change must be accepted, or
refused in one sentence where it depends on others; every sample is answered, a parameter is read in between, and the
change is undone.
"""

import time
from dataclasses import replace

from semiparam_ros.core.variants import CHOICES
from semiparam_ros.effects import kinds
from semiparam_ros.settings import dump_params
from semiparam_ros.settings.parameter_table import PARAMETERS
from support.node_client import Client, NodeProcess, resident_mb, stamp_of
from support.node_helpers import BODY, JOINTS, SETTINGS, motion
from support.settings_matrix import TOOL

PERIODS = 2.0
"""Half of the answers come within so many, whatever the value."""
EVERY_KIND = [f'{name}@{place}' if place else name for name, kind in kinds('wrench').items()
              for place in kind.places(BODY)[:1]]
SPECIAL = {'state_file': ('a.npz', f'{"a" * 96}.npz'),
           'shadow_variants': ([''], list(CHOICES)),
           'effects': ([''], EVERY_KIND),
           'external_wrench.frame': ('', 'ft'), 'tools': ([''], [TOOL]),
           'effects_reference': ([], [1e3] * BODY.n_parameters)}


def ends():
    """(name, value) of every live parameter: all choices, both ends of a range, the least and the most of a list."""
    for row in (row for row in PARAMETERS if row.live):
        if row.name in SPECIAL:
            values = SPECIAL[row.name]
        elif row.choices:
            values = row.choices
        elif row.kind == 'bool':
            values = (False, True)
        else:
            assert row.minimum is not None and row.maximum is not None, f'{row.name} has no end'
            values = [(int if row.kind == 'integer' else float)(end) for end in (row.minimum, row.maximum)]
        yield from ((row.name, value) for value in (*values, *row.words))


class Ends:
    """Tries them on a live node. ``rows``: of each its name, value, answer, and lateness [s] of its samples."""

    def __init__(self, client, samples, rate, each):
        self.client, self.samples, self.rate, self.each, self.rows = client, samples, rate, each, []
        self.wrong = []

    def learn(self, count):
        """So many samples as fast as they are answered."""
        self.client.play(self.next(count), JOINTS)
        self.client.forget()

    def next(self, count):
        """The next samples."""
        found, self.samples = self.samples[:count], self.samples[count:]
        return found

    def try_all(self):
        for name, value in ends():
            key = name.replace('.', '__')
            (before,) = self.client.get(name)
            answer = self.change(key, value)
            late = self.play()
            undone = self.change(key, before)
            sentence = answer.reason.endswith('.') if not answer.successful else True
            known = answer.successful or name in ('effects', 'effects_reference')
            if not (undone.successful and self.client.get(name) == [before] and known and sentence):
                self.wrong.append(f'{name} {value!r:.60}: {answer.reason!r}, undone: {undone.reason!r}')
            self.rows.append((name, value, answer.reason if not answer.successful else 'yes', late))

    def change(self, key, value):
        """The answer, once a model that it asks for answers."""
        (answer,) = self.client.set(**{key: value})
        if 'is being built' in answer.reason:
            self.client.take_over()
        return answer

    def play(self):
        """Some samples at the rate; how late each was answered [s]."""
        samples, published, heard = self.next(self.each), {}, {}

        def note():
            for message in self.client.heard['residual']:
                heard.setdefault(stamp_of(message), time.monotonic())

        begun = time.monotonic()
        for index, sample in enumerate(samples):
            while time.monotonic() < begun + index / self.rate:
                note()
                time.sleep(0.0005)
            self.client.state(sample, JOINTS)
            self.client.accelerations(sample, JOINTS)
            self.client.wrench(sample)
            published[sample.stamp] = time.monotonic()
        while len(heard) < len(samples):
            self.client.wait(lambda: len(self.client.heard['residual']) > len(heard), 'every sample is answered')
            note()
        assert list(heard) == list(published)
        self.client.forget()
        return [heard[stamp] - at for stamp, at in published.items()]


def run(folder, rate, history, each, features):
    """Try them; the rows, what was wrong, and what the node says at its end."""
    settings = replace(SETTINGS, acceleration_source='measured', state_folder=str(folder), features_count=features,
                       initial_samples=max(60, min(1000, history // 2)))
    dump_params(settings, folder / 'p.yaml')
    with NodeProcess(folder, folder / 'p.yaml') as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'joint_accelerations', 'wrench')
        found = Ends(client, motion(history + each * (sum(1 for _ in ends()) + 2)), rate, each)
        found.learn(history)
        client.take_over()
        found.try_all()
        internal = int(client.wait_report('errors', lambda level, message, values: True)[2]['internal errors'])
        memory = resident_mb(node.process.pid)
        code = node.stop()
    return found.rows, found.wrong, internal + node.output.count('Traceback'), code, memory
