"""State of a node in a file: numbers and JSON in an .npz archive, so that loading one cannot run
code."""

from __future__ import annotations

import json
import math
import os
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeAlias, cast

import numpy as np

from semiparam_ros.atomic_write import remove_leftovers, replacing
from semiparam_ros.core.columns import CoupledColumns, Memories, Memory
from semiparam_ros.core.estimator import Estimator, EstimatorState
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.motion import Motion
from semiparam_ros.core.online_model import ModelState
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array, Codes, Mask, Stamps
from semiparam_ros.effects import effect_from_text
from semiparam_ros.effects.base import place
from semiparam_ros.errors import SemiparamError, listed
from semiparam_ros.online.applied_effects import AppliedEffects
from semiparam_ros.online.contact_gate import ContactGate
from semiparam_ros.online.history import SampleBatch, arrays_of, batch_from
from semiparam_ros.online.learning import ANEW, Learning, observe
from semiparam_ros.online.model_jobs import Known, known_of, new_estimator
from semiparam_ros.online.renewal import Renewal
from semiparam_ros.settings.build import declared_effects
from semiparam_ros.settings.parameter_table import shown
from semiparam_ros.settings.rules import broken_rule
from semiparam_ros.settings.snapshot import Settings

FORMAT, VERSION = 'semiparam_ros state', 33
"""The version changes with every change of what the arrays are or mean; test_state_file.py knows the layout of each."""

ADOPTED = ('variant', 'effects', 'effects_reference', 'joint_friction', 'priors', 'noise', 'forgetting',
           'horizon.length')
"""Parameters that the file brings along."""

MODEL_ARRAYS = ('recursion', 'horizon', 'calibration', 'wandering')
"""Groups of arrays of each model."""

FIXED = ('outputs', 'temperatures', 'features.count', 'features.seed', 'features.frequencies',
         'features.length_scales', 'initial.samples')
"""Parameters that cannot change while a node runs, and so must agree."""

ASIDE = 'aside'
"""What is moved aside has this in its name, and the time."""

TYPES = {'stamps': '<i8', 'origins': '<i8', 'places': '<i8', 'waiting': '<i8', 'renewed': '<i8', 'filled': '<i8',
         'start': '<i8', 'counts': '<i8', 'origin': '<i8', 'learnt': '|i1', 'is_news': '|b1'}
"""Of arrays by the last part of their names; all others hold real numbers."""
MEASURED, MOST_MEASURED = ('bias', 'history', 'motion', 'inputs_learnt', 'kept', 'temperature', 'window'), 1e18
"""What is measured stays within 1e9, its derivatives within that by a nanosecond."""
STAMPS = ('stamps', 'origins', 'origin')
RANGES = {'shares': (0.0, 1.0), 'log_weights': (-math.inf, 0.0), 'inflation': (1e-100, math.inf),
          'learnt': (min(Learning) - ANEW, max(Learning) + ANEW), **dict.fromkeys(STAMPS, (-2**62, 2**62)),
          **dict.fromkeys(('waiting', 'filled', 'start', 'back', 'renewed', 'still'), (0.0, math.inf))}
"""Of arrays by the last part of their names, where only some values make sense."""

TRIED, TRIED_EVERY_NS = 5, 10**7
"""So many of the samples kept are answered and learnt by a copy before a state counts as good."""

MAY_BE_UNKNOWN = ('meta', 'history.temperature', 'temperature')
"""Arrays that are texts, or hold NaN for what is not known."""


Arrays: TypeAlias = dict[str, Array | Stamps | Mask | Codes]


class SavedState(NamedTuple):
    """A learner's model, the settings it was built with, the samples it keeps, the bias (n,) of the tare, the gate,
    when the hyperparameters are estimated again, and the effects that are applied beside the model."""

    settings: Settings
    estimator: Estimator
    batch: SampleBatch
    bias: Array
    gate: Memory
    renewal: Memory
    applied: Memory
    tools: tuple[str, ...] = ()
    """Those that the arm carried then; what it carries now the parameter says."""
    anew: bool = False
    """Whether something else is taken off since the last sample that was news."""
    asked: Settings | None = None
    """Those of a model that was asked for and was not there yet: it is built anew from the samples kept."""

    @property
    def sentence(self) -> str:
        """For people, without a full stop: the model, and what it expects to be there, as a load of before."""
        state = cast('dict[str, tuple[Any, ...]]', self.applied)
        there = [effect_from_text(text) for text, on in zip(state['effects'], state['applied'], strict=True) if on]
        places = ', '.join(place(effect.kind, effect.where) for effect in there)
        expected = f', and expects {places}' if there else ''
        now = listed(self.settings.tools, 3)
        tools = '' if self.tools == self.settings.tools else (
            f'. It was saved with the tools {listed(self.tools, 3)}; the parameter tools says {now}, which holds')
        asked = '' if self.asked is None else f'; the {self.asked.variant} that was being built is built anew'
        return f'{self.settings.variant} with {len(self.batch)} samples{asked}{expected}{tools}'

    def adopted_by(self, settings: Settings) -> SavedState:
        """With what it brings along put into settings that changed while it was read."""
        asked = None if self.asked is None else _adopted(settings, self.asked)
        return self._replace(settings=_adopted(settings, self.settings), asked=asked)


class Snapshot(NamedTuple):
    """Content of a file to be: copies of what samples change, and the samples kept, which nobody
    changes."""

    learnt: Arrays
    batch: SampleBatch

    @property
    def configuration(self) -> Configuration:
        """Configuration that it was learnt with."""
        meta = json.loads(str(self.learnt['meta']))
        return Configuration(meta['version'], meta['joints'], meta['settings'], np.asarray(self.learnt['probe']))

    def arrays(self) -> Arrays:
        """All of it, by the names of the file."""
        return {**self.learnt, **_named('history', arrays_of(self.batch))}


def folder_of(settings: Settings) -> Path:
    """Folder of states: ``state_folder``, or else ``semiparam`` in ROS's own folder for what
    programs keep.

    Raises SemiparamError for the home of a user who does not exist.
    """
    named = settings.state_folder or Path(os.environ.get('ROS_HOME') or '~/.ros', 'semiparam')
    try:
        return Path(named).expanduser().absolute()
    except RuntimeError as error:
        raise SemiparamError(f'state_folder is {named}: {error}') from error


class Configuration(NamedTuple):
    """Configuration that a state was learnt with."""

    version: object
    joints: Sequence[str]
    settings: Mapping[str, Any]  # ADOPTED and FIXED, as JSON has them
    probe: Array

    def difference(self, ours: Configuration, names: Sequence[str] = FIXED) -> str:
        """Sentence of a node of another configuration on this one, its file being the subject; ''
        for the same.

        :param names: the settings that are compared.
        """
        if self.version != ours.version:
            return f'is of version {self.version}; this node reads version {ours.version}.'
        if list(self.joints) != list(ours.joints):
            return f'is of another robot: it has {_other_joints(self.joints, ours.joints)}.'
        differ = [name for name in names if self.settings.get(name) != ours.settings[name]]
        if differ:
            more = f' {listed(differ[1:], 5)} differ{"s" * (len(differ) == 2)} too.' if differ[1:] else ''
            return (f'was learnt with {differ[0]} {shown(self.settings.get(differ[0]))}; this node has '
                    f'{shown(ours.settings[differ[0]])}.{more}')
        if self.probe.shape != ours.probe.shape or not np.allclose(self.probe, ours.probe, rtol=1e-9, atol=1e-9):
            return 'is of another robot: its description, outputs, sensor frame or wrench convention differs.'
        return ''


def _other_joints(theirs: Sequence[str], ours: Sequence[str]) -> str:
    beside, lacking = ([name for name in these if name not in those]
                       for these, those in ((theirs, ours), (ours, theirs)))
    parts = [f'the joints {listed(beside, 3)}, which this node has not'] if beside else []
    if lacking:
        parts.append(f'lacks {listed(lacking, 3)}' if beside else f'not the joints {listed(lacking, 3)}')
    return f'{", and ".join(parts)}' if parts else 'the same joints in another order'


def save(path: Path, state: SavedState) -> str:
    """Write the whole file or nothing. Raises SemiparamError when it cannot be written; see :func:`write`."""
    return write(path, snapshot(state))


def snapshot(state: SavedState) -> Snapshot:
    """A state as it is now, for :func:`write` in another thread. It takes about a millisecond, however many samples are
    kept."""
    learnt = state.estimator.state()
    memory: dict[str, Array] = {}
    gate: dict[str, Array] = {}
    renewal: dict[str, Array] = {}
    applied: dict[str, Array] = {}
    first, *others = learnt.models
    known = known_of(state.estimator)
    meta = {'format': FORMAT, 'version': VERSION, 'joints': list(state.estimator.body.joints),
            'settings': _as_saved(state.settings), 'tools': list(state.tools),
            'known': None if known is None else [asdict(known.hyperparameters), *known[1:4]],
            'origin': learnt.origin, 'newest': learnt.newest, 'window_left': first.window_left,
            'passed_over': first.passed_over,
            'memory': _as_json(learnt.memory, memory), 'gate': _as_json(state.gate, gate),
            'renewal': _as_json(state.renewal, renewal), 'applied': _as_json(state.applied, applied)}
    if state.anew:
        meta['anew'] = True
    if state.asked is not None:
        meta['asked'] = {name: value for name, value in _as_saved(state.asked).items() if name in ADOPTED}
    if others:
        meta['others'] = [{'hyperparameters': asdict(other.hyperparameters), 'window_left': other.window_left,
                           'passed_over': other.passed_over} for other in others]
    groups: dict[str, Mapping[str, Array | Stamps | Mask | Codes]] = {
        'average': learnt.average, **{f'other{index}': _model_arrays(other) for index, other in enumerate(others)},
        **{group: getattr(first, group) for group in MODEL_ARRAYS},
        'memory': memory, 'gate': gate, 'renewal': renewal, 'applied': applied, 'window': learnt.window,
        'motion': _stacked(learnt.motion), 'kept': learnt.kept, 'carried': learnt.carried}
    arrays: Arrays = {'meta': np.array(json.dumps(meta)), 'bias': state.bias,
                      'inputs_learnt': learnt.inputs_learnt, 'temperature': learnt.temperature,
                      'probe': probe(state.estimator.body)}
    for group, members in groups.items():
        arrays |= _named(group, members)
    return Snapshot(arrays, state.batch)


def write(path: Path, state: Snapshot, before_it_replaces: Callable[[], None] = lambda: None) -> str:
    """Write a :func:`snapshot`, and make its folder if it is missing.

    A state of another configuration that has the name is moved aside; a sentence says so, '' without one.

    :param before_it_replaces: called when the disk has it all, before it takes the name.

    Raises SemiparamError when it cannot be written, when a value is not finite, and when something else than a state
    has the name.
    """
    arrays = state.arrays()
    _require_finite('the model', arrays)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SemiparamError(f'cannot write {path}: there is no folder {path.parent} and none can be made: '
                             f'{error.strerror}.') from error
    theirs = replaceable(path)
    difference = '' if theirs is None else theirs.difference(state.configuration)
    remove_leftovers(path)
    moved = ''
    with replacing(path, durable=True) as stream:
        _write_archive(stream, arrays)
        stream.flush()
        os.fsync(stream.fileno())
        if difference:
            moved = move_aside(path, difference)
        before_it_replaces()
    return moved


def replaceable(path: Path) -> Configuration | None:
    """Configuration of the state which has this name, None where no file has it.

    Raises SemiparamError when a state must not take the place of what has it.
    """
    try:
        is_link, exists = path.is_symlink(), path.exists()
    except OSError as error:  # of a folder that may not be looked into
        raise SemiparamError(f'cannot write {path}: {error.strerror}.') from error
    if is_link:
        raise SemiparamError(f'{path} is a link, which is not followed; expected a saved state or no file.')
    if not exists:
        return None
    try:
        return _configuration(path)
    except Exception as error:  # zipfile, numpy and json each raise their own errors for a foreign file
        cause = error.__cause__
        if isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno):
            reason = 'there is no memory for it' if isinstance(cause, MemoryError) else cause.strerror
            raise SemiparamError(f'{path} cannot be read, so it is not replaced: {reason}.') from cause
        raise SemiparamError(f'{path} is no saved state, so it is not replaced; move it away, or choose another '
                             'name.') from None


def move_aside(path: Path, difference: str) -> str:
    """Give a state of another configuration a name of its own, which the sentence returned tells.

    Raises SemiparamError when it cannot be renamed: nothing may take its place then.
    """
    aside = path.with_name(f'{path.stem}.{ASIDE}-{time.time_ns()}{path.suffix}')
    try:
        os.rename(path, aside)
    except OSError as error:
        raise SemiparamError(f'{path} {difference} It cannot be moved aside ({error.strerror}), so it is not '
                             'replaced.') from error
    return f'{path} {difference} It is moved to {aside}.'


def load(path: Path, settings: Settings, body: RigidBody) -> SavedState:
    """Read a state for this robot and these settings; ``settings`` of the result hold what the file brings along.

    Raises SemiparamError when the file cannot be read, is of another kind or version, or of another robot.
    """
    arrays = _read(path)
    try:
        meta = _meta_of(path, arrays)
        theirs = Configuration(meta['version'], meta['joints'], meta['settings'], arrays['probe'])
        difference = theirs.difference(Configuration(VERSION, body.joints, _as_saved(settings), probe(body)))
        if difference:
            raise SemiparamError(f'{path} {difference}')
        asked = _fitting(path, settings, meta['asked']) if 'asked' in meta else None
        settings = _fitting(path, settings, meta['settings'])
        _require_finite(str(path), arrays)
        batch = batch_from(_group(arrays, 'history'), body.n_joints, body.n_outputs)
        bias = arrays['bias']
        if bias.shape != (body.n_outputs,):
            raise SemiparamError(f"{path} holds a 'bias' of shape {bias.shape}; expected ({body.n_outputs},).")
        _check_types(arrays)
        _check_stamps(meta)
        gate, renewal = ContactGate.of(body), Renewal(settings.initial_samples, body.n_outputs)
        for name, part in (('gate', gate), ('renewal', renewal)):
            memory = _from_json(meta[name], _group(arrays, name))
            _check_kinds(name, memory, part.state())
            part.restore(memory)
        applied = AppliedEffects(body)
        applied.restore(_from_json(meta['applied'], _group(arrays, 'applied')))
        saved = SavedState(settings, _estimator(settings, body, arrays, meta), batch, bias, gate.state(),
                           renewal.state(), applied.state(), tuple(map(str, meta['tools'])), 'anew' in meta, asked)
        _check_nothing_else(arrays, meta, saved)
        _try(saved, gate)
        return saved
    except SemiparamError as error:
        raise error if str(error).startswith(str(path)) else SemiparamError(f'{path} is damaged: {error}') from error
    except Exception as error:  # whatever wrong values bring about
        raise SemiparamError(f'{path} is damaged ({error}); expected a file that save_state wrote.') from error


def _adopted(settings: Settings, saved: Settings) -> Settings:
    brought = saved.mapping()
    return settings.changed({name: brought[name] for name in ADOPTED})


def probe(body: RigidBody) -> Array:
    """(1 + 3 n, p) base parameters, and regressors at three fixed states: equal for the same robot, outputs and
    convention, whatever the text of its description."""
    rng = np.random.default_rng(1)
    regressors = [body.regressor(*rng.uniform(-1.0, 1.0, (3, body.n_joints))) for _ in range(3)]
    return np.vstack([body.base_parameters[None], *regressors])


def _fitting(path: Path, ours: Settings, brought: Mapping[str, Any]) -> Settings:
    """Settings with those that a file brings along; raises SemiparamError where both together break a rule."""
    settings = ours.changed({name: brought[name] for name in ADOPTED}, str(path))
    if (sentence := broken_rule(settings)) is not None and broken_rule(ours) is None:  # no more could change
        raise SemiparamError(f'{path} does not fit the parameters of this node: {sentence}')
    return settings


def _as_saved(settings: Settings) -> dict[str, Any]:
    """The parameters that a state keeps, as they are when read back from JSON."""
    values = settings.mapping()
    kept = ((name, values[name]) for name in (*ADOPTED, *FIXED))
    return {name: list(value) if isinstance(value, tuple) else value for name, value in kept}


def _configuration(path: Path) -> Configuration:
    """Configuration of a file; raises whatever zipfile, numpy and json do for a foreign one."""
    arrays = _read(path, ('meta', 'probe'))
    meta = json.loads(str(arrays['meta']))
    if meta.get('format') != FORMAT:
        raise ValueError('it is no saved state')
    joints, settings, given = meta.get('joints', []), meta.get('settings', {}), arrays.get('probe', np.zeros(0))
    if not (isinstance(joints, list) and all(isinstance(name, str) for name in joints)
            and isinstance(settings, dict) and given.dtype.kind == 'f'):
        raise ValueError('it does not say what it was learnt with')
    return Configuration(meta.get('version'), joints, settings, given)


def _write_archive(stream: IO[bytes], arrays: Arrays) -> None:
    """Write as numpy.savez does, which however copies every array while it holds the interpreter's lock."""
    with zipfile.ZipFile(stream, 'w') as archive:
        for name, given in arrays.items():
            values = given if given.flags.f_contiguous else np.ascontiguousarray(given)
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                header = np.lib.format.header_data_from_array_1_0(values)
                np.lib.format.write_array_header_1_0(member, header)
                member.write(values.ravel(order='K').view(np.uint8).data)


def _read(path: Path, names: Sequence[str] | None = None) -> dict[str, Array]:
    """The arrays of a file, or those with these names where it has them.

    Nothing in it is compressed, and no array is larger than its header says: reading takes no more memory than the file
    has bytes. Raises SemiparamError.
    """
    try:
        if path.exists() and not path.is_file():  # opening a pipe would wait for who writes into it
            raise OSError('it is a folder, a device or a pipe')
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            _check_sizes(entries, path.stat().st_size)
            return {name: _read_array(archive, entry) for entry in entries
                    if (name := entry.filename.removesuffix('.npy')) in (names or (name,))}
    except FileNotFoundError as error:
        raise SemiparamError(f'there is no file {path}; save_state writes it.') from error
    except Exception as error:  # zipfile and numpy have many for what is no archive of theirs
        raise SemiparamError(f'{path} cannot be read ({error}); expected a file that save_state wrote.') from error


def _check_sizes(entries: Sequence[zipfile.ZipInfo], file_size: int) -> None:
    """Raise ValueError for what would take more room than the file, or is there twice."""
    names = [entry.filename for entry in entries]
    if len(set(names)) != len(names):
        raise ValueError('an array is there twice')
    packed = [entry.filename for entry in entries if entry.compress_type != zipfile.ZIP_STORED]
    if packed:
        raise ValueError(f'{listed(packed)} is compressed')
    if sum(entry.file_size for entry in entries) > file_size:
        raise ValueError('its arrays are larger than the file')


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Array:
    with archive.open(entry) as member:
        if np.lib.format.read_magic(member) != (1, 0):
            raise ValueError(f'{entry.filename} is no array that numpy writes')
        shape, by_column, dtype = np.lib.format.read_array_header_1_0(member)
        size = entry.file_size - member.tell()
        if dtype.kind not in 'biufU' or math.prod(shape) * dtype.itemsize != size:
            raise ValueError(f'{entry.filename} has {size} bytes for an array {shape} of {dtype}')
        values = np.frombuffer(bytearray(member.read()), dtype)
        return values.reshape(shape, order='F' if by_column else 'C')


def _require_finite(what: str, arrays: Mapping[str, Array | Stamps | Mask | Codes]) -> None:
    for name, values in arrays.items():
        if name not in MAY_BE_UNKNOWN and not np.isfinite(values).all():
            raise SemiparamError(f"{what} holds a value in '{name}' that is not finite.")


def _meta_of(path: Path, arrays: Mapping[str, Array]) -> dict[str, Any]:
    meta = json.loads(str(arrays['meta'])) if 'meta' in arrays else {}
    if not isinstance(meta, dict) or meta.get('format') != FORMAT:
        raise SemiparamError(f'{path} is no saved state; expected a file that save_state wrote.')
    if meta.get('version') != VERSION:
        raise SemiparamError(f'{path} is of version {meta.get("version")}; this node reads version {VERSION}.')
    return meta


def _estimator(settings: Settings, body: RigidBody, arrays: Mapping[str, Array], meta: Mapping[str, Any]) -> Estimator:
    """The estimator as it was."""
    known = None
    if meta['known'] is not None:
        hyperparameters, mean, scale, window = meta['known']
        known = Known(_hyperparameters(hyperparameters, _group(arrays, 'recursion')), tuple(mean), tuple(scale),
                      _count(window))
    _check_effects(settings, body, arrays['recursion.information'])
    estimator = new_estimator(settings, body, known)
    if arrays['inputs_learnt'].shape not in (estimator.inputs_learnt.shape, (2, 3 * body.n_joints)):
        raise ValueError(f"'inputs_learnt' has shape {arrays['inputs_learnt'].shape}")
    models = [_model(arrays, meta, estimator.model.hyperparameters)]
    for index, other in enumerate(meta.get('others', [])):
        its = _group(arrays, f'other{index}')
        models.append(_model(its, other, _hyperparameters(other['hyperparameters'], _group(its, 'recursion'))))
    estimator.restore(EstimatorState(tuple(models), _group(arrays, 'window'), meta['origin'], meta['newest'],
                                     cast('Memories', _from_json(meta['memory'], _group(arrays, 'memory'))),
                                     arrays['inputs_learnt'], _temperature(arrays),
                                     _unstacked(_group(arrays, 'motion'), body),
                                     _group(arrays, 'kept'), _group(arrays, 'carried'), _group(arrays, 'average')))
    return estimator


def _check_effects(settings: Settings, body: RigidBody, information: Array) -> None:
    """Raise ValueError for effects of more columns than the model has: none may make it larger than the file."""
    count = CoupledColumns(body, declared_effects(settings)).n_effects
    if information.ndim != 2 or min(information.shape) <= count:
        raise ValueError(f"its effects have {count} columns, which 'recursion.information' of shape "
                         f'{information.shape} does not hold')


def _temperature(arrays: Mapping[str, Array]) -> Array:
    found, kept = arrays['temperature'], arrays.get('history.temperature', np.zeros((0, 0)))
    if found.shape not in ((0,), kept.shape[1:]):
        raise ValueError(f'the temperature has shape {found.shape}')
    return found


def _hyperparameters(values: Mapping[str, Any], recursion: Mapping[str, Array]) -> Hyperparameters:
    """Raises ValueError for what are none of a model with this recursion: none may make it larger than the file."""
    for name, value in values.items():
        numbers = value if isinstance(value, list) else [value]
        if name == 'features':
            right = value in (0, recursion['array'].shape[1])
        elif name == 'pi' and value is None:
            right = True
        else:
            right = all(type(number) is float and abs(number) <= MOST_MEASURED for number in numbers)
            right = right and (name == 'pi' or min(numbers, default=0.0) >= 0.0)
        if not right:
            raise ValueError(f"the hyperparameter '{name}' is {shown(value)}")
    tuples = {name: None if values[name] is None else tuple(values[name]) for name in ('tau', 'output_scale', 'pi')}
    return Hyperparameters(**{**values, **tuples})


def _model_arrays(model: ModelState) -> Arrays:
    return {f'{group}.{name}': values for group in MODEL_ARRAYS for name, values in getattr(model, group).items()}


def _model(arrays: Mapping[str, Array], meta: Mapping[str, Any], hyperparameters: Hyperparameters) -> ModelState:
    groups = {group: _group(arrays, group) for group in MODEL_ARRAYS}
    return ModelState(hyperparameters, window_left=_count(meta['window_left']),
                      passed_over=_counts(meta['passed_over']), **groups)


def _counts(values: Sequence[int]) -> tuple[int, int]:
    since, total = map(_count, values)
    return since, total


def _count(value: object) -> int:
    """Number of samples; raises ValueError for what is no such number."""
    if not (type(value) is int and 0 <= value < 2**62):
        raise ValueError(f'a number of samples is {shown(value)}')
    return value


def _stacked(motion: Motion | None) -> Arrays:
    if motion is None:
        return {}
    return {'place': motion.place, 'nearby': motion.nearby, 'outputs': motion.outputs,
            'counts': np.array([motion.since, motion.newest, motion.still]), 'is_news': np.array(motion.is_news)}


def _unstacked(arrays: Mapping[str, Array], body: RigidBody) -> Motion | None:
    if not arrays:
        return None
    since, newest, still = arrays['counts'].tolist()
    place, nearby = (arrays[name].reshape(body.n_joints) for name in ('place', 'nearby'))
    outputs = arrays['outputs'].reshape(body.n_outputs)
    return Motion(place, since, newest, nearby, still, outputs, bool(arrays['is_news']))


def _as_json(memory: Memory, arrays: dict[str, Array]) -> object:
    """Return what effects or the gate remember, as JSON that refers to ``arrays`` by number.

    Raises SemiparamError for other objects.
    """
    if memory is None or isinstance(memory, bool | int | float | str):
        return memory
    if isinstance(memory, np.ndarray | np.generic) and memory.dtype.kind in 'biuf':
        name = str(len(arrays))
        arrays[name] = np.array(memory)
        return {'array': name}
    if isinstance(memory, tuple | list):
        return {'tuple' if isinstance(memory, tuple) else 'list': [_as_json(part, arrays) for part in memory]}
    if isinstance(memory, dict) and all(isinstance(name, str) for name in memory):
        return {'dict': {name: _as_json(part, arrays) for name, part in memory.items()}}
    raise SemiparamError(f'an effect remembers a {type(memory).__name__}, which no state file holds; expected None, '
                         'numbers, texts, arrays, and tuples, lists and dicts of them.')


def _from_json(value: object, arrays: Mapping[str, Array]) -> Memory:
    if not isinstance(value, dict):
        return value
    ((kind, parts),) = value.items()
    if kind == 'array':
        return arrays[parts]
    if kind == 'dict':
        return {name: _from_json(part, arrays) for name, part in parts.items()}
    return {'tuple': tuple, 'list': list}[kind](_from_json(part, arrays) for part in parts)


def _named(group: str, arrays: Mapping[str, Array | Stamps | Mask | Codes]) -> Arrays:
    """With the group's name before each; :func:`_group` takes it off."""
    return {f'{group}.{name}': values for name, values in arrays.items()}


def _check_types(arrays: Mapping[str, Array]) -> None:
    """Raise ValueError for an array of another type than its name has, or of values that it cannot have."""
    for name, values in arrays.items():
        last = name.rpartition('.')[2]
        wanted = TYPES.get(last, '<f8')
        if name == 'meta' or last.isdigit():
            continue
        if values.dtype.str != wanted:
            raise ValueError(f"'{name}' is of type {values.dtype}; expected {np.dtype(wanted)}")
        low, high = RANGES.get(last, (-math.inf, math.inf))
        if ((values < low) | (values > high)).any():
            raise ValueError(f"'{name}' holds values outside of {low:g} to {high:g}")
        if name.partition('.')[0] in MEASURED and values.dtype.kind == 'f' and (np.abs(values) > MOST_MEASURED).any():
            raise ValueError(f"'{name}' holds values beyond {MOST_MEASURED:g}")


def _check_stamps(meta: Mapping[str, Any]) -> None:
    """Raise ValueError where time begins, or ended, at no time that a message can have."""
    for name in ('origin', 'newest'):
        stamp = meta[name]
        if stamp is not None and not (type(stamp) is int and abs(stamp) < 2**62):
            raise ValueError(f"'{name}' is {shown(stamp)}; expected a stamp in ns")


def _check_kinds(where: str, given: Memory, own: Memory, rows_of: int = 2) -> None:
    """Raise ValueError where what is remembered is of another kind than what its owner remembers at another time.

    :param rows_of: arrays of so many axes or more may have another number of rows.
    """
    if isinstance(own, np.ndarray):
        grows = own.ndim >= rows_of
        if not isinstance(given, np.ndarray) or (given.dtype, given.ndim) != (own.dtype, own.ndim) or (
                given.shape[grows:] != own.shape[grows:]):
            raise ValueError(f"'{where}' is no array of {own.dtype} like {own.shape}")
    elif isinstance(own, dict):
        if not isinstance(given, dict) or given.keys() != own.keys():
            raise ValueError(f"'{where}' has other entries")
        for name, part in own.items():
            _check_kinds(f'{where}.{name}', given[name], part, rows_of)
    elif isinstance(own, tuple | list) and isinstance(given, tuple | list) and len(given) == len(own):
        for index, part in enumerate(own):
            _check_kinds(f'{where}.{index}', given[index], part, rows_of)
    elif isinstance(own, bool | int | float):
        same = isinstance(given, bool) if isinstance(own, bool) else isinstance(given, int | float)
        if not same:
            raise ValueError(f"'{where}' is {shown(given)}; expected one like {shown(own)}")


def _check_nothing_else(arrays: Mapping[str, Array], meta: Mapping[str, Any], saved: SavedState) -> None:
    """Raise ValueError unless a state that is saved again is the same file: then all of it was understood."""
    again = snapshot(saved).arrays()
    for name in sorted(again.keys() ^ arrays.keys()):
        raise ValueError(f"'{name}' is {'missing' if name in again else 'not of such a state'}")
    for name, values in again.items():
        same = values.dtype == arrays[name].dtype and np.array_equal(values, arrays[name], values.dtype.kind == 'f')
        if not same and name != 'meta':
            raise ValueError(f"'{name}' is {arrays[name].dtype} {arrays[name].shape}; expected what makes sense as "
                             f'{values.dtype} {values.shape}')
    written = json.loads(str(again['meta']))
    if written['known']:  # what the window alone used is not kept by a model that is given its hyperparameters
        written['known'][0] |= {name: float(meta['known'][0][name]) for name in ('drift_share', 'drift_memory')}
    for name, value in written.items():
        if json.dumps(value) != json.dumps(meta.get(name)):  # so that neither 1 and 1.0 nor 1 and true are the same
            raise ValueError(f"'{name}' is {shown(meta.get(name))}; expected what makes sense as {shown(value)}")


def _try(saved: SavedState, gate: ContactGate) -> None:
    """Let copies answer and learn some of the samples kept, as if they came next; raises whatever goes wrong."""
    estimator, gate, body = deepcopy(saved.estimator), deepcopy(gate), saved.estimator.body
    judging = replace(saved.settings, gate_enabled=True)
    zeros = np.zeros(body.n_joints)
    latest = [sample for sample, _ in saved.batch.part(max(len(saved.batch) - TRIED, 0)).pairs()]
    latest = latest or [Sample(0, zeros, zeros, zeros, np.zeros(body.n_outputs))]
    newest = saved.estimator.state().newest or 0
    with np.errstate(all='ignore'):
        for number, sample in enumerate(latest, start=1):
            prediction = estimator.predict(sample._replace(stamp=newest + number * TRIED_EVERY_NS))
            if not (np.isfinite([prediction.mean, prediction.std]).all() and (prediction.std > 0.0).all()):
                raise ValueError('its model predicts values that are not finite')
            gate.judge(prediction, judging)
            observe(estimator, prediction, Learning.YES, finish=False)
    _require_finite('what its model learns', snapshot(saved._replace(estimator=estimator, gate=gate.state())).learnt)
    before, after = (cast('Memory', each.state().memory) for each in (saved.estimator, estimator))
    _check_kinds('memory', before, after, rows_of=1)


def _group(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    return {name.removeprefix(f'{prefix}.'): values for name, values in arrays.items()
            if name.startswith(f'{prefix}.')}
