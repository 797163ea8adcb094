"""What is done to a node beside its input topics: descriptions, trajectories, parameters and services, all of it bad.

Calls go out while samples come, one at a time; each must be refused, in one sentence, and change nothing.
"""

import io
import json
import pickle
import random
import warnings
import zipfile
from collections import Counter, deque

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from support.node_client import messages
from support.node_helpers import URDF

NAN = float('nan')
CALL_EVERY, TRAJECTORY_EVERY, DESCRIPTION_EVERY = 20, 10, 400
REFUSED, DONE = 'refused in its reply', 'done'
UNTYPED = ParameterValue(type=ParameterType.PARAMETER_NOT_SET)

# Each alone by set_parameters, and together with a good one by set_parameters_atomically.
CHANGES = {
    'unknown variant': {'variant': 'SPK'},
    'misspelt parameter': {'varaint': 'P'},
    'parameter of no node': {'zzz.qqq': 1},
    'value out of range': {'forgetting': 2.0},
    'NaN as a value': {'gate__false_alarms_per_hour': NAN},
    'infinite value': {'gate__hold': float('inf')},
    'wrong type': {'horizon__length': '25'},
    'no type at all': {'noise': UNTYPED},
    'read-only parameter': {'features__count': 100},
    'read-only parameter of ROS': {'qos_overrides./parameter_events.publisher.depth': 7},
    'unknown effect': {'effects': ['paylod']},
    'effect at an unknown place': {'effects': ['external_force@nowhere']},
    'effect with broken values': {'effects': ['payload{"mass":']},
    'the same effect twice': {'effects': ['viscous_friction@a', 'viscous_friction@a']},
    'a state file in another folder': {'state_file': '../../etc/passwd'},
    'a hidden state file': {'state_file': '.bashrc'},
    'unknown shadow variant': {'shadow_variants': ['Q']},
    'the same shadow variant twice': {'shadow_variants': ['P', 'P']},
}
GOOD = {'learning': False, 'forgetting': 0.9}
NO_DESCRIPTIONS = {
    'no XML': 'robot', 'XML cut short': URDF[:300], 'no sensor frame': URDF.replace('"ft"', '"hand"'),
    'no joint b': URDF.replace('"b"', '"c"'), 'a mass that is no number': URDF.replace('"1.0"', '"heavy"'),
    'a negative mass': URDF.replace('"0.5"', '"-0.5"'), '100 kB of noise': ''.join(
        chr(code) for code in np.random.default_rng(0).integers(32, 127, 100_000)),
}
SERVICES = ('reset', 'tare', 'save_state', 'load_state', 'diagnose', 'apply_diagnosis', 'cancel_diagnosis',
            'export_model')
WITHOUT_A_MODEL = {'apply_diagnosis': 'there is no diagnosis yet', 'cancel_diagnosis': 'no diagnosis is running'}


class InvalidRequests:
    """Throws by a seed what must be refused; ``wrong`` holds what was not."""

    CHANGES = CHANGES
    CALLS = ('load', 'load', 'load', 'apply', 'pause', 'save', 'save nowhere', 'export', 'export nowhere')

    def __init__(self, client, state_file, seed):
        self.client, self.state_file, self.chance = client, state_file, random.Random(seed + 1)
        self.thrown, self.answers, self.wrong = Counter(), {}, []
        self._calls, self._running, self._files, self._number = deque(), None, {}, 0
        self._counts = Counter()

    def before_the_robot_is_known(self):
        """Descriptions that are none, and every service while there is no model."""
        for name in NO_DESCRIPTIONS:
            self.describe(name, late=False)
        self._wait_for_descriptions()
        for name in SERVICES:
            self._service(f'~/{name} without a model', name, WITHOUT_A_MODEL.get(name, 'there is no model yet'))
        self._drain()

    def wait_until_open(self, clients):
        for client in clients:
            client.wait_report('learning', lambda level, message, values: message.startswith('gathering'))
        self._service('~/tare in the initial window', 'tare', 'no prediction of the last second')
        self._service('~/load_state without a file', 'load_state', 'there is no file')
        self._service('~/apply_diagnosis without a diagnosis', 'apply_diagnosis', 'no diagnosis yet')
        self._drain()

    def throw(self, index, sample):
        """What is due at this sample."""
        if index % TRAJECTORY_EVERY == 0:
            self.wish(sample)
        if index % DESCRIPTION_EVERY == DESCRIPTION_EVERY - 1:
            self.describe(self.chance.choice([*NO_DESCRIPTIONS, 'another robot']), late=True)
        if index % CALL_EVERY == CALL_EVERY - 1:
            self.chance.choice(self.actions(index))()
        self._proceed()

    def actions(self, index):
        """What may be called at this sample."""
        return [self.set_one, self.set_together, self.call_service]

    def finish(self):
        """Wait for the last replies."""
        self._drain()

    def rejections(self):
        """How often the node must have refused, by the names of its diagnostics."""
        return dict(self._counts)

    # Topics

    def describe(self, name, late):
        text = NO_DESCRIPTIONS.get(name, URDF.replace('"two"', '"three"'))
        self._wait_for_descriptions()
        self._number += 1
        self._count(f'robot_description, {"late" if late else "early"}: {name}', 'robot_description')
        self.client.outputs['robot_description'].publish(String(data=f'{text}<!-- {self._number} -->'))

    def _wait_for_descriptions(self):
        """DDS keeps the latest description alone, also of those that got lost on their way and are repeated."""
        if self._number:
            self.client.wait_report('inputs', lambda level, message, values: values.get(
                'refused: robot_description') == str(self._number), heard=True)

    def wish(self, sample):
        """A desired trajectory that cannot be answered."""
        full = {'positions': [0.0, 0.1], 'velocities': [0.0, 0.1], 'accelerations': [0.0, 0.1]}
        name, names, point = self.chance.choice([
            ('a NaN', ['a', 'b'], {**full, 'positions': [NAN, 0.0]}),
            ('an infinite velocity', ['a', 'b'], {**full, 'velocities': [0.0, float('inf')]}),
            ('a joint missing', ['a'], {name: values[:1] for name, values in full.items()}),
            ('other joints', ['x', 'y'], full), ('a joint twice', ['a', 'a'], full), ('no names', [], full),
            ('no accelerations', ['a', 'b'], {**full, 'accelerations': []}),
            ('too many positions', ['a', 'b'], {**full, 'positions': [0.0] * 3})])
        message = JointTrajectory(joint_names=names, points=[JointTrajectoryPoint(**point)])
        message.header.stamp.sec = sample.stamp // 10**9
        self._count(f'desired_trajectory with {name}', 'desired_trajectory')
        self.client.outputs['desired_trajectory'].publish(message)

    # Parameters

    def set_one(self):
        name = self.chance.choice(list(self.CHANGES))
        request = SetParameters.Request(parameters=messages(CHANGES[name]))
        self._count(f'set: {name}', 'parameters', REFUSED)
        self._call(SetParameters, 'set_parameters', request, name, lambda reply: reply.results)

    def set_together(self):
        name = self.chance.choice(list(self.CHANGES))
        both = messages({**GOOD, **CHANGES[name]}) if 'forgetting' not in CHANGES[name] else messages(
            {'learning': False, **CHANGES[name]})
        self.chance.shuffle(both)
        self._count(f'set atomically with good ones: {name}', 'parameters', REFUSED)
        self._call(SetParametersAtomically, 'set_parameters_atomically',
                   SetParametersAtomically.Request(parameters=both), name, lambda reply: [reply.result])

    # Services

    def call_service(self):
        """One that must fail, or that must change nothing."""
        kind = self.chance.choice(self.CALLS)
        if kind == 'load':
            self._load()
        elif kind == 'apply':
            self._service('~/apply_diagnosis without a diagnosis', 'apply_diagnosis', 'no diagnosis yet')
        elif kind == 'pause':
            self._note('~/pause_learning, not to pause', DONE)
            self._call(SetBool, 'pause_learning', SetBool.Request(data=False), 'go on', lambda reply: [], True)
        elif kind == 'export':
            self._note('~/export_model while samples come', 'done, or refused without a rigid body that is learnt')
            self._call(Trigger, 'export_model', Trigger.Request(), 'export', lambda reply: [], None)
        elif kind == 'export nowhere':
            self._set_file(self._other_file().name)
            self._other_file().with_suffix('.urdf').write_text('<robot/>')
            self._service('~/export_model over what is no export', 'export_model', '')
            self._set_file(self.state_file.name)
        elif kind == 'save':
            self._note('~/save_state while samples come', 'done, or refused while hyperparameters are estimated')
            self._call(Trigger, 'save_state', Trigger.Request(), 'save', lambda reply: [], None)
        else:
            self._set_file(self._other_file().name)
            self._service('~/save_state over what is no state', 'save_state', 'is no saved state', b'a letter')
            self._set_file('none.npz')
            self._service('~/load_state of a file that does not exist', 'load_state', 'there is no file')
            self._set_file(self.state_file.name)

    def _other_file(self):
        return self.state_file.with_name('other.npz')

    def _set_file(self, path):
        self._note('state_file changed', DONE)
        request = SetParameters.Request(parameters=[Parameter(name='state_file', value=ParameterValue(
            type=ParameterType.PARAMETER_STRING, string_value=path))])
        self._call(SetParameters, 'set_parameters', request, path, lambda reply: reply.results, True)

    def _load(self):
        """A file that is no state, or none of this robot."""
        if not self._files:
            self._call(Trigger, 'save_state', Trigger.Request(), 'the first state', lambda reply: [], None)
            self._drain()
            if not self.state_file.exists():
                return
            self._files = spoilt(self.state_file.read_bytes())
        name = self.chance.choice(list(self._files))
        self._set_file(self._other_file().name)
        self._service(f'~/load_state of {name}', 'load_state', '', self._files[name])
        self._set_file(self.state_file.name)

    def _service(self, name, service, sentence, content=None):
        self._note(name, REFUSED)
        self._call(Trigger, service, Trigger.Request(), name, lambda reply: [], False, sentence, content)

    # Calls, one after the other

    def _count(self, name, reason, answer=None):
        self._note(name, answer or reason)
        self._counts[reason] += 1

    def _note(self, name, answer):
        self.thrown[name] += 1
        self.answers[name] = answer

    def _call(self, kind, service, request, name, results, success=False, sentence='', content=None):
        """``success``: what the reply must say, None for either. ``content``: what the other file holds then."""
        self._calls.append((kind, service, request, name, results, success, sentence, content))

    def _drain(self):
        while self._calls or self._running:
            self.client.wait(lambda: self._running is None or self._running[0].done(), 'a reply')
            self._proceed()

    def _proceed(self):
        if self._running is not None and self._running[0].done():
            future, call = self._running
            self._running = None
            self._judge(future.result(), *call[3:7])
        if self._running is None and self._calls:
            call = self._calls.popleft()
            if call[7] is not None:
                self._other_file().write_bytes(call[7])
            self._running = self.client.begin(*call[:3]), call

    def _judge(self, reply, name, results, success, sentence):
        said = [(each.successful, each.reason) for each in results(reply)] or [(reply.success, reply.message)]
        for successful, reason in said:
            right = success is None or successful == success
            if not successful:
                right = right and reason.endswith('.') and '\n' not in reason and sentence in reason
            if not right:
                self.wrong.append(f'{name}: {successful}, {reason!r}')


CRAFTED = {
    'of another type': lambda values: values.astype(np.float32 if values.dtype != np.float32 else np.float64),
    'of texts': lambda values: values.astype('U9'), 'with one more axis': lambda values: values[None],
    'of objects': lambda values: np.array([print], dtype=object),
    'twice': lambda values: np.concatenate([values, values]) if values.ndim else np.array([values, values]),
}


def spoilt(data):
    """Files that are not what ``save_state`` wrote, from one that is."""
    arrays = dict(np.load(io.BytesIO(data)))
    meta = json.loads(str(arrays['meta']))

    def packed(**changed):
        stream = io.BytesIO()
        np.savez(stream, **{**arrays, **changed})
        return stream.getvalue()

    def with_meta(**changed):
        return packed(meta=np.array(json.dumps({**meta, **changed})))

    matrix = max((name for name in arrays if name != 'probe'), key=lambda name: arrays[name].size)
    spoilt_matrix = arrays[matrix].copy()
    spoilt_matrix.flat[0] = NAN
    chance = random.Random(1)
    names = sorted(name for name in arrays if name != 'meta' and arrays[name].size)
    crafted = {f'an array {how}': packed(**{name: wrong(arrays[name])}) for how, wrong in CRAFTED.items()
               for name in [chance.choice(names)]}
    return crafted | {
        'an array compressed, 100 MB of zeros': compressed(arrays), 'an array more': packed(more=arrays[matrix]),
        'an array twice in the archive': doubled(data), 'a name that leads out of the archive': packed(
            **{'../../meta': arrays['meta']}), 'a size that is not there': data.replace(
            b"'shape': (", b"'shape': (9", 1),
        'an empty file': b'', 'noise': random.Random(0).randbytes(10_000), 'a pickle': pickle.dumps({'meta': 1}),
        'a file cut short': data[:len(data) // 2], 'a file with a hole': data[:500] + bytes(2000) + data[2500:],
        'no JSON': packed(meta=np.array('{')), 'another version': with_meta(version=99),
        'another format': with_meta(format='something'), 'another robot': with_meta(joints=['x', 'y']),
        'another regressor': packed(probe=arrays['probe'] + 1.0), 'other features': with_meta(
            settings={**meta['settings'], 'features.count': 2}), 'an unknown effect': with_meta(
            settings={**meta['settings'], 'effects': ['paylod']}),
        'objects that would run code': packed(probe=np.array([print], dtype=object)),
        'a matrix of another size': packed(**{matrix: np.zeros((2, 2))}), 'NaN in a matrix': packed(**{
            matrix: spoilt_matrix}), 'a missing array': packed_without(arrays, matrix),
    }


def packed_without(arrays, name):
    stream = io.BytesIO()
    np.savez(stream, **{other: values for other, values in arrays.items() if other != name})
    return stream.getvalue()


def compressed(arrays):
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays, more=np.zeros(12_500_000))
    return stream.getvalue()


def doubled(data):
    """The archive with its last array in it once more."""
    stream = io.BytesIO(data)
    with warnings.catch_warnings(), zipfile.ZipFile(stream, 'a') as archive:
        warnings.simplefilter('ignore')  # of the name that is there already
        name = archive.namelist()[-1]
        archive.writestr(name, archive.read(name))
    return stream.getvalue()
