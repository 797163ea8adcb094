"""A node under fire for minutes, beside a node that gets only the good samples.

Every kind of bad message, robot descriptions that are none, parameter changes that must be refused and services called
in bad moments reach one node; both get the same good samples. At the end stand the counts, the memory, and how far the
two nodes differ in what they said and in what they learnt.

For random changes of every live parameter, valid or not, and the services that change the model are thrown
too, at one node, for nothing is left to compare with: see node_settings.py.
"""

import json
import random
import time
from contextlib import ExitStack
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from std_msgs.msg import String

from semiparam_ros.settings import dump_params
from semiparam_ros.settings.parameter_table import PARAMETERS
from support import node_settings
from support.invalid_requests import InvalidRequests
from support.node_client import RECENT, Client, Gaps, NodeProcess, resident_mb, stamp_of, values_of
from support.node_faults import ANSWERS, CHECK_EVERY, Fuzzer, counts_of, tell_thrown, with_gaps
from support.node_helpers import JOINTS, SETTINGS, URDF, motion

TOPICS = ('joint_states', 'joint_accelerations', 'wrench', 'robot_description', 'desired_trajectory')


class Pair:
    """The node under fire and the other, each with a client in its namespace."""

    def __init__(self, folder, settings):
        self.nodes, self.clients, self.states = [], [], []
        self.answered, self.worst, self.memory = 0, dict.fromkeys(ANSWERS, 0.0), []
        self.window = settings.initial_samples
        with ExitStack() as opened:
            for name in ('fuzzed', 'spared'):
                own = folder / name
                own.mkdir()
                self.states.append(own / 'state.npz')
                dump_params(replace(settings, state_file='state.npz', state_folder=str(own)), own / 'p.yaml',
                            node='/**')
                node = NodeProcess(own, own / 'p.yaml', '-r', f'__ns:=/{name}')
                self.nodes.append(opened.enter_context(node))
                self.clients.append(opened.enter_context(Client('estimator', f'/{name}')))
            for client in self.clients:
                client.connect()
                client.offer(*TOPICS)
            self.gaps = [Gaps(node) for node in self.nodes]
            self.opened = opened.pop_all()

    def compare(self, count):
        """Wait until both have answered so many samples in all; how far apart the answers are.

        At the end of the initial window, until the variant has taken over in both: what watches for changes has learnt
        with the model before until then, and would differ by how long that took.
        """
        for client, gaps in zip(self.clients, self.gaps, strict=True):
            client.wait(lambda heard=client.heard, gaps=gaps: gaps.look(
                count, self.answered + len(heard['residual'])) or all(
                self.answered + len(heard[topic]) >= count for topic in ANSWERS), f'{count} answers')
        if count == self.window:
            for client in self.clients:
                client.take_over()
        for topic in ANSWERS:
            ours, theirs = (client.heard[topic] for client in self.clients)
            assert [stamp_of(message) for message in ours] == [stamp_of(message) for message in theirs]
            apart = np.subtract([values_of(message) for message in ours], [values_of(message) for message in theirs])
            self.worst[topic] = max(self.worst[topic], float(np.abs(apart).max(initial=0.0)))
        self.answered = count
        for client in self.clients:
            for topic, heard in client.heard.items():
                heard[:-RECENT if topic == '/diagnostics' else None] = []
        self.memory.append([resident_mb(node.process.pid) for node in self.nodes])

    def states_apart(self):
        """Largest difference of all numbers of the two saved states, and how many numbers those are."""
        for client in self.clients:
            saved = client.trigger('save_state')
            assert saved.success, saved.message
        ours, theirs = (dict(np.load(path)) for path in self.states)
        assert ours.keys() == theirs.keys()
        metas = [json.loads(str(arrays.pop('meta'))) for arrays in (ours, theirs)]
        if metas[0] != metas[1]:
            return np.inf, metas
        apart = [np.abs(np.subtract(values, theirs[name], dtype=float)) for name, values in ours.items()]
        return max(float(each.max(initial=0.0)) for each in apart), sum(each.size for each in apart)

    def parameters_equal(self):
        """Whether a read of every parameter gives the same from both, their folders apart."""
        names = [row.name for row in PARAMETERS if row.name != 'state_folder']
        ours, theirs = (client.get(*names) for client in self.clients)
        return ours == theirs

    def stop(self):
        return [node.stop() for node in self.nodes]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.opened.close()


MOST_LEAKED_MB = 10.0
"""So much more than the spared node may the fuzzed one come to hold: both keep the latest samples."""


class Options(NamedTuple):
    """How long [s], at what rate [Hz] good samples come, the choice of the others, and the size of the model."""

    seconds: float
    features: int
    window: int
    rate: float = 200.0
    seed: int = 2


def settings_of(options):
    return replace(SETTINGS, robot_description='', acceleration_source='measured', features_count=options.features,
                   initial_samples=options.window, horizon_length=25)


def fuzz(folder, options):
    """Run it; returns what was found, as a dictionary."""
    settings = settings_of(options)
    samples = with_gaps(motion(round(options.seconds * options.rate)))
    with Pair(folder, settings) as pair:
        fuzzed, spared = pair.clients
        fuzzer = Fuzzer(fuzzed, JOINTS, samples[0].stamp, options.seed)
        invalid_requests = InvalidRequests(fuzzed, pair.states[0], options.seed)
        invalid_requests.before_the_robot_is_known()
        for client in pair.clients:
            client.outputs['robot_description'].publish(String(data=URDF))
            client.wait(lambda node=client.node: node.count_publishers('estimator/residual'), 'the answers')
            client.get('variant')
        invalid_requests.wait_until_open(pair.clients)
        chance, start = random.Random(options.seed), time.monotonic()
        for index, sample in enumerate(samples):
            time.sleep(max(0.0, start + index / options.rate - time.monotonic()))
            pair.gaps[0].look(index, pair.answered + len(fuzzed.heard['residual']))
            fuzzer.throw(sample, bad=chance.choice([1, 2]))
            for publish in (spared.state, spared.accelerations):
                publish(sample, JOINTS)
            spared.wrench(sample)
            invalid_requests.throw(index, sample)
            if index % CHECK_EVERY == CHECK_EVERY - 1 or index + 1 == options.window:
                pair.compare(index + 1)
        took = time.monotonic() - start
        pair.compare(len(samples))
        invalid_requests.finish()
        counted = counts_of(fuzzed, {**fuzzer.rejections(), **invalid_requests.rejections()})
        alive, same = [node.process.poll() is None for node in pair.nodes], pair.parameters_equal()
        apart, numbers = pair.states_apart()
        codes = pair.stop()
        log = pair.nodes[0].output
    return {'samples': len(samples), 'took_s': took, 'fuzzer': fuzzer, 'invalid_requests': invalid_requests,
            'counted': counted, 'memory': pair.memory, 'alive': alive, 'codes': codes, 'gap_s': pair.gaps[0].worst,
            'worst': pair.worst, 'apart': apart, 'numbers': numbers, 'parameters equal': same,
            'internal': log.count('internal error') + log.count('Traceback')}


def tell(found):
    """Print it; True when all is as it must be."""
    fuzzer, invalid_requests, memory = found['fuzzer'], found['invalid_requests'], np.array(found['memory'])
    print(f'{found["samples"]} good samples in {found["took_s"]:.0f} s '
          f'({found["samples"] / found["took_s"]:.1f} Hz) to each of two nodes, all answered by both.\n')
    tell_thrown(fuzzer, invalid_requests, found['counted'])
    early, middle, late = floors = held_at_least(memory)
    for name, start, *least, most in zip(('fuzzed', 'spared'), memory[0], *floors, memory.max(axis=0), strict=True):
        print(f'memory of the {name} node: {start:.1f} MB after {CHECK_EVERY} samples, at least {least[0]:.1f} MB in '
              f'the second tenth, {least[1]:.1f} MB halfway, {least[2]:.1f} MB in the last; at most {most:.1f} MB')
    print(f'deaths: {found["alive"].count(False)}; exit codes after SIGINT: {found["codes"]}; internal errors in the '
          f'log: {found["internal"]}; parameters equal to those of the other node: {found["parameters equal"]}')
    print(f'longest time without an answer that was due: {found["gap_s"]:.2f} s')
    print('largest difference from the node that got only the good samples: '
          + ', '.join(f'{worst:.1e} ({topic})' for topic, worst in found['worst'].items())
          + f', {found["apart"]:.1e} (saved state, {found["numbers"]} numbers)')
    return (all(found['alive']) and found['codes'] == [0, 0] and not found['internal'] and not invalid_requests.wrong
            and found['gap_s'] < node_settings.MOST_SILENT_S and found['parameters equal']
            and all(counted == wanted for counted, wanted in found['counted'].values())
            and max(*found['worst'].values(), found['apart']) == 0.0
            and np.subtract(*(late - early)) < MOST_LEAKED_MB and np.subtract(*(middle - early)) < MOST_LEAKED_MB)


def held_at_least(memory):
    """(3, 2) least of the memory [MB] of each node in the second tenth, around the middle, and in the last tenth.

    Now and then a node holds a state that is being written or read: what it holds at one moment tells of no leak.
    """
    tenth = max(len(memory) // 10, 1)
    return [memory[start:start + tenth].min(axis=0)
            for start in (min(tenth, len(memory) - 1), len(memory) // 2, len(memory) - tenth)]
