"""Random changes of every live parameter, and the services that change a model, among everything that is refused.

Such changes alter the model, so there is no spared node to compare with. Instead every good sample must be answered
once, in order, by finite numbers; each change must be answered as far as its answer is known before; and nothing may
go wrong inside the node.
"""

import json
import random
import time
from collections import Counter
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from semiparam_ros.core.samples import Samples
from semiparam_ros.core.variants import CHOICES
from semiparam_ros.effects import effect_to_text, kinds
from semiparam_ros.settings import dump_params
from semiparam_ros.settings.parameter_table import PARAMETERS
from support.invalid_requests import NAN, InvalidRequests
from support.node_client import RECENT, Client, Gaps, NodeProcess, messages, resident_mb, stamp_of, values_of
from support.node_faults import ANSWERS, CHECK_EVERY, Fuzzer, counts_of, tell_thrown, with_gaps
from support.node_helpers import BODY, JOINTS, URDF, motion
from support.settings_matrix import TOOL

LIVE = {row.name: row for row in PARAMETERS if row.live}
FILES = ('state.npz', 'second.npz', 'third.npz')
NO_FILES = ('../state.npz', '/etc/passwd', '.npz', 'state', '', 'a/b.npz')
NUMBERS = (0.0, 1.0, -1.0, 0.5, -0.02, 5.0, 1e-9, 1e-300, 1e9, 1e300, -1e300, float(np.finfo(float).max))
WRONG_TYPES = {'bool': [1, 'true'], 'integer': ['5', 0.5, True], 'double': ['1.0', True, NAN, float('inf')],
               'string': [1, True, 2.0], 'string_array': ['P', [1, 2], 7], 'double_array': ['1', ['a']]}
BURST, QUIET = 3000, 1000
"""Samples with changes of the settings, and without, in turns: a model needs seconds to be there."""
MOST_WAITING, RETAINED, MEMORY_MB, GAP_EVERY = 5, 3000, 60.0, 100
MOST_SILENT_S = 1.0
NOT_BUILT = 'could not be built'
TOGETHER = 'several in one atomic set'


class RandomSettings:
    """Values for the live parameters, and what is known of them: True fine, False refused, None either."""

    def __init__(self, chance):
        self.chance = chance
        self._motion = Samples.from_list(motion(400))
        self._effects = self._sensible_effects()

    def one(self):
        """(name, value, known)."""
        name = self.chance.choice([*LIVE, 'effects', 'effects', 'variant'])
        if self.chance.random() < 0.25:
            return (name, *self._wrong(LIVE[name]))
        if name == 'effects':
            return name, *self._some_effects()
        if name == 'shadow_variants':
            return name, self.chance.sample(list(CHOICES), self.chance.randint(0, 3)), True
        if name == 'effects_reference':  # how many numbers fit depends on the robot
            return self.chance.choice([(name, [], True), (name, [self.chance.gauss(0.0, 1.0) for _ in range(3)], None)])
        return name, self._within(LIVE[name]), True

    def _within(self, row):
        if row.name == 'state_file':
            return self.chance.choice(FILES)
        if row.choices:
            return self.chance.choice(row.choices)
        if row.kind == 'bool':
            return self.chance.random() < 0.5
        if row.name == 'forgetting':
            return self.chance.choice(['auto', 0.5, 0.9, 0.99, 0.999, 1.0, 1])
        if row.name == 'external_wrench.frame':
            return self.chance.choice(['', 'ft'])
        if row.name == 'tools':
            return self.chance.choice([[], [TOOL]])
        if row.name == 'horizon.length':
            return self.chance.choice([1, 2, 25, 200, 1000])
        low = row.minimum or 0.0
        high = row.maximum if row.maximum is not None else low + 1e3
        value = self.chance.choice([low, high, low + (high - low) * self.chance.random()])
        return int(value) if row.kind == 'integer' else float(value)

    def _wrong(self, row):
        wrong = [*WRONG_TYPES[row.kind], *(NO_FILES if row.name == 'state_file' else ())]
        if row.minimum is not None:
            wrong.append((int if row.kind == 'integer' else float)(row.minimum - 1))
        if row.maximum is not None:
            wrong.append((int if row.kind == 'integer' else float)(row.maximum + 1))
        if row.choices:
            wrong.append(['SPKK', 'P'] if row.kind == 'string_array' else 'SPKK')
        return self.chance.choice(wrong), False

    def _some_effects(self):
        made = [self._effect() for _ in range(self.chance.choice([0, 1, 1, 1, 2, 3]))]
        known = False if any(known is False for _, known in made) else None
        return [text for text, _ in made], known

    def _effect(self):
        """Text of an effect: with values that fit, bare, with any values at any place, or broken."""
        form = self.chance.choice(['sensible', 'sensible', 'bare', 'bare', 'wild', 'broken'])
        if form == 'sensible':
            return self.chance.choice(self._effects), None
        name = self.chance.choice(list(kinds()))
        where = self.chance.choice(['', '@upper', '@ft', '@a', '@b', '@nowhere', '@fx', '@x'])
        known = None if 'wrench' in kinds()[name].outputs else False
        if form == 'bare':
            return name + where, known
        if form == 'wild':
            names = self.chance.sample(kinds()[name].value_names(), self.chance.randint(0, len(
                kinds()[name].value_names())))
            values = {each: self.chance.choice(NUMBERS) for each in names}
            if self.chance.random() < 0.2:
                values['reference'] = [self.chance.choice(NUMBERS) for _ in range(self.chance.choice([0, 1, 20]))]
            return name + where + json.dumps(values), known
        return self.chance.choice([name + where + '{', name + '{"no_such_value": 1.0}', 'no_such_kind' + where,
                                   name + '{"start_s": NaN}', name + '{"start_s": "soon"}', '@a']), False

    def _sensible_effects(self):
        residual = np.random.default_rng(0).standard_normal((len(self._motion), BODY.n_outputs))
        texts = []
        for kind in kinds('wrench').values():
            for where in kind.places(BODY):
                for shape in kind.searches(BODY, self._motion, where, residual)[:3]:
                    texts += [effect_to_text(kind.from_values(where, values))
                              for values in (shape, {**shape, 'start_s': 3.0})]
        return [*texts, 'terms@fx{"sin(q_a)": 1.2, "time*dq_b": 0.1}']


class SettingsChanges(InvalidRequests):
    """What InvalidRequests throws, and changes that may well be fine. ``done``: how often, by name and answer."""

    # Left out: what the parent expects only of a node whose settings nobody changes.
    CHANGES = MappingProxyType({name: values for name, values in InvalidRequests.CHANGES.items()
                                if name != 'rule across parameters broken'})
    CALLS = tuple(name for name in InvalidRequests.CALLS if name != 'apply')

    def __init__(self, client, state_file, seed):
        super().__init__(client, state_file, seed)
        self.settings, self.done, self.said, self._diagnosis = RandomSettings(self.chance), Counter(), {}, None

    def actions(self, index):
        if len(self._calls) > MOST_WAITING:
            return [lambda: None]
        refused = super().actions(index)
        if index % (BURST + QUIET) >= BURST:
            return refused
        return [*refused, *[self.change_several] * 4, *[self.change_together] * 3, *[self.act] * 2]

    def change_several(self):
        """One by one: each has its own answer."""
        chosen = [self.settings.one() for _ in range(self.chance.choice([1, 1, 2, 4]))]
        request = SetParameters.Request(parameters=[item for name, value, _ in chosen
                                                    for item in messages({name.replace('.', '__'): value})])
        self._call(SetParameters, 'set_parameters', request, [name for name, _, _ in chosen],
                   lambda reply: reply.results, [known for _, _, known in chosen])

    def change_together(self):
        """All or none of them."""
        chosen = {name: (value, known) for name, value, known in (
            self.settings.one() for _ in range(self.chance.choice([1, 2, 3, 5])))}
        known = {known for _, known in chosen.values()}
        request = SetParametersAtomically.Request(parameters=messages(
            {name.replace('.', '__'): value for name, (value, _) in chosen.items()}))
        name = TOGETHER if len(chosen) > 1 else min(chosen)
        self._call(SetParametersAtomically, 'set_parameters_atomically', request, [name],
                   lambda reply: [reply.result], [False if False in known else None if None in known else True])

    def act(self):
        """A service that changes the model, or looks at it."""
        name = self.chance.choice(['reset', *['tare', 'pause', 'save and load', 'diagnose', 'diagnose',
                                              'cancel_diagnosis', 'apply_diagnosis', 'apply_diagnosis'] * 2])
        if name == 'pause':
            self._call(SetBool, 'pause_learning', SetBool.Request(data=self.chance.random() < 0.5), [name],
                       lambda reply: [], [True])
        elif name == 'diagnose' and self._diagnosis is None:
            self._diagnosis = self.client.begin(Trigger, name, Trigger.Request())
        else:
            for service in {'save and load': ('save_state', 'load_state')}.get(name, (name,)):
                self._call(Trigger, service, Trigger.Request(), [service], lambda reply: [],
                           [True if service == 'reset' else None])

    def finish(self):
        super().finish()
        if self._diagnosis is not None:
            self.client.wait(self._diagnosis.done, 'the diagnosis')
            self._proceed()

    def _proceed(self):
        super()._proceed()
        if self._diagnosis is not None and self._diagnosis.done():
            reply, self._diagnosis = self._diagnosis.result(), None
            self._note_answer('diagnose', None, reply.success, reply.message)

    def _judge(self, reply, name, results, success, sentence):
        if not isinstance(success, list):
            super()._judge(reply, name, results, success, sentence)
            return
        said = [(each.successful, each.reason) for each in results(reply)]
        answers = said or [(reply.success, reply.message)]
        for each, known, (successful, reason) in zip(name, success, answers, strict=True):
            self._note_answer(each, known, successful, reason)
            # A model that turned out not to be possible is an answer, but no refusal.
            if said and not successful and NOT_BUILT not in reason:
                self._counts['parameters'] += 1

    def _note_answer(self, name, known, successful, reason):
        self.done[name, successful] += 1
        if not successful:
            self.said[name] = reason
        right = known is None or successful == known or NOT_BUILT in reason
        told = reason.endswith('.') or (successful and not reason)
        several = '\n' in reason and not (name == 'diagnose' and successful)  # a line for each effect
        if not right or not told or several or 'internal error' in reason:
            self.wrong.append(f'{name}: {successful}, {reason!r}')


def fuzz(folder, options, settings):
    """Run it on one node; returns what was found, as a dictionary."""
    samples, memory = with_gaps(motion(round(options.seconds * options.rate)), every=GAP_EVERY), []
    state = folder / 'state.npz'
    dump_params(replace(settings, state_file=state.name, state_folder=str(folder), retained_samples=RETAINED),
                folder / 'p.yaml')
    with NodeProcess(folder, folder / 'p.yaml') as node, Client() as client:
        client.connect()
        client.offer('joint_states', 'joint_accelerations', 'wrench', 'robot_description', 'desired_trajectory')
        fuzzer = Fuzzer(client, JOINTS, samples[0].stamp, options.seed)
        changes = SettingsChanges(client, state, options.seed)
        changes.before_the_robot_is_known()
        client.outputs['robot_description'].publish(String(data=URDF))
        client.wait(lambda: client.node.count_publishers('estimator/residual'), 'the answers')
        changes.wait_until_open([client])
        chance, gaps, start = random.Random(options.seed), Gaps(node), time.monotonic()
        for index, sample in enumerate(samples):
            time.sleep(max(0.0, start + index / options.rate - time.monotonic()))
            gaps.look(index % CHECK_EVERY, len(client.heard['residual']))
            fuzzer.throw(sample, bad=chance.choice([1, 2]))
            changes.throw(index, sample)
            if index % CHECK_EVERY == CHECK_EVERY - 1:
                asked = time.monotonic()
                check_answers(client, samples[index + 1 - CHECK_EVERY:index + 1], gaps)
                start += time.monotonic() - asked  # what was waited for is not made up for in a flood
                memory.append(resident_mb(node.process.pid))
        took = time.monotonic() - start
        changes.finish()
        check_answers(client, samples[len(samples) - len(samples) % CHECK_EVERY:], gaps)
        counted = counts_of(client, {**fuzzer.rejections(), **changes.rejections()})
        last = goes_on(client, samples[-1], options.window + 200)
        memory.append(resident_mb(node.process.pid))
        internal = errors_of(client)
        alive, code = node.process.poll() is None, node.stop()
    return {'samples': len(samples), 'took_s': took, 'fuzzer': fuzzer, 'changes': changes, 'memory': memory,
            'alive': alive, 'gap_s': gaps.worst, 'goes on': last, 'code': code, 'counted': counted, 'internal': internal
            + node.output.count('internal error') + node.output.count('Traceback'), 'log': node.output}


def check_answers(client, samples, gaps):
    """Each of these samples is answered once, in order, by finite numbers, and no other is."""
    wanted = [sample.stamp for sample in samples]
    for topic in ANSWERS:
        heard = client.heard[topic]
        client.wait(lambda heard=heard: gaps.look(len(wanted), len(heard)) or len(heard) >= len(wanted),
                    f'{len(wanted)} answers on {topic}')
        assert [stamp_of(message) for message in heard] == wanted, f'answers on {topic}'
        assert np.isfinite([values_of(message) for message in heard]).all(), f'values on {topic}'
        heard.clear()
    client.heard['horizon_error'].clear()
    client.heard['/diagnostics'][:-RECENT] = []


def errors_of(client):
    """How many internal errors the node reports."""
    client.heard['/diagnostics'].clear()
    return int(client.report('errors')[2]['internal errors'])


def goes_on(client, sample, count):
    """Whether the node learns with a model of the client's choice after all that."""
    client.trigger('reset')
    last = client.set_together(variant='P', effects=[''], shadow_variants=[''], learning=True, forgetting=1.0,
                               noise='output', gate__enabled=False)
    further = [each._replace(stamp=each.stamp + sample.stamp) for each in motion(count)]
    client.play(further, JOINTS)
    client.wait_report('learning', lambda level, message, values: message == 'learning with P.')
    return last.successful


def tell(found):
    """Print it; True when all is as it must be."""
    fuzzer, changes, memory = found['fuzzer'], found['changes'], found['memory']
    print(f'{found["samples"]} good samples in {found["took_s"]:.0f} s '
          f'({found["samples"] / found["took_s"]:.1f} Hz) to one node, each answered once and in order.\n')
    tell_thrown(fuzzer, changes, found['counted'])
    print('\n| changed or called | done | refused | last refusal |\n|---|---|---|---|')
    for name in sorted({name for name, _ in changes.done}):
        print(f'| {name} | {changes.done[name, True]} | {changes.done[name, False]} | {changes.said.get(name, "")} |')
    print(f'\n{changes.done.total()} altogether. Memory: {memory[0]:.1f} MB after {CHECK_EVERY} samples, '
          f'{memory[len(memory) // 2]:.1f} MB halfway, {max(memory):.1f} MB at most, {memory[-1]:.1f} MB with P '
          'afterwards.')
    print(f'longest time without an answer that was due: {found["gap_s"]:.2f} s')
    print(f'alive: {found["alive"]}; learns afterwards: {found["goes on"]}; exit code after SIGINT: {found["code"]}; '
          f'internal errors: {found["internal"]}')
    if found['internal']:
        print(found['log'][-20_000:])
    return (found['alive'] and found['goes on'] and found['code'] == 0 and not found['internal'] and not changes.wrong
            and all(counted == wanted for counted, wanted in found['counted'].values())
            and found['gap_s'] < MOST_SILENT_S and memory[-1] < memory[0] + MEMORY_MB)
