"""Saved states: a learner that goes on from one was never interrupted, and no other file is touched."""

import json
import math
import os
import pickle
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import tracemalloc
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import state_file
from semiparam_ros.online.checkpoint import Checkpoints
from semiparam_ros.online.file_thread import FileThread
from semiparam_ros.online.folder_lock import FolderLock
from semiparam_ros.settings.build import build_rigid_body
from support.learner_stage import Stage
from support.node_helpers import BODY, SETTINGS, InlineBackground, motion

EFFORT = replace(SETTINGS, outputs='effort', sensor_frame='')
REMEMBERS = {
    'none': SETTINGS,
    'delay': replace(SETTINGS, effects=('time_delay{"delay_s": 0.005}',)),
    'cable': replace(SETTINGS, effects=('cable_hysteresis@a{"slip": 0.3}', 'time_delay{"delay_s": -0.003}')),
    'backlash': replace(EFFORT, effects=('backlash@b{"gap": 0.2}', 'coulomb_friction@a{"presliding": 0.05}')),
    'load': replace(EFFORT, effects=('load_friction@a{"turn_speed": 0.1}',), effects_reference=(0.1 + 0.2,) * 10),
    'start': replace(SETTINGS, effects=('payload@ft{"start_s": 3.0}',)),
    'SP': replace(SETTINGS, variant='SP-ML', effects=('sensor_drift',)),
    'averaged': replace(SETTINGS, variant='auto', effects=('sensor_drift',)),
    'forgetting': replace(SETTINGS, variant='P', forgetting=0.99),
}


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A disk that is busy is waited for, as long as pytest lets a test run."""
    monkeypatch.setattr('semiparam_ros.online.file_thread.PATIENCE_S', None)


def stage_of(settings, samples=()):
    stage = Stage(settings, InlineBackground(), build_rigid_body(settings))
    stage.offer(samples)
    return stage


def answers(stage):
    return [(answer.prediction.mean.tolist(), answer.prediction.std.tolist(), answer.learnt, answer.contact)
            for answer in stage.answers]


@pytest.mark.parametrize(('settings', 'count'), [
    pytest.param(settings, count, id=f'{name}-{count}',
                 marks=pytest.mark.long if count in (0, 60) and name not in ('none', 'averaged') else ())
    for name, settings in REMEMBERS.items() for count in (0, 40, 60, 200)])
def test_saved_and_loaded_is_not_interrupted_bit_for_bit(tmp_path, settings, count):
    settings = replace(settings, retained_samples=3, gate_enabled=True, gate_false_alarms_per_hour=3600.0,
                       gate_hold=0.3)
    body = build_rigid_body(settings)
    samples, before = motion(count + 120, body=body), stage_of(settings)
    before.offer(samples[:count])
    state_file.save(tmp_path / 's.npz', before.learner.state())
    saved = state_file.load(tmp_path / 's.npz', replace(settings, variant='NP-ML', effects=()), body)
    assert saved.settings == settings, 'variant and effects come with the file'
    after = stage_of(replace(settings, variant='P', effects=()), motion(80, seed=1, body=body))
    after.learner.restore(saved)
    del after.answers[:], after.errors[:]
    assert same(saved.estimator, before.learner.estimator)
    del before.answers[:], before.errors[:]
    for stage in (before, after):
        stage.offer(samples[count:])
    assert answers(after) == answers(before)
    assert [errors.origin for errors in after.errors] == [errors.origin for errors in before.errors]
    for ours, theirs in zip(after.errors, before.errors, strict=True):
        np.testing.assert_array_equal(ours.eps, theirs.eps)
    assert same(after.learner.estimator, before.learner.estimator)
    for ours, theirs in zip(after.learner.history.batch().pairs(), before.learner.history.batch().pairs(),
                            strict=True):
        assert ours[0].stamp == theirs[0].stamp and ours[1] == theirs[1]
    assert after.learner.history.batch().samples.origin == before.learner.history.batch().samples.origin
    assert not any(name.startswith('.') for name in os.listdir(tmp_path))


def same(one, other):
    """Whether two objects hold the same bits, however deep; tuples of any class are equal to plain ones.

    So an attribute that the estimator gains and the file does not hold is found.
    """
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, tuple | list):
        names = getattr(one, '_fields', range(len(one)))
        return len(one) == len(other) and all(name in SCRATCH or same(mine, its)
                                              for name, mine, its in zip(names, one, other, strict=True))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    if type(one).__module__.startswith('semiparam_ros') and hasattr(one, '__dict__'):
        return all(same(value, vars(other)[name]) for name, value in vars(one).items() if name not in SCRATCH)
    if type(one).__module__.startswith('pinocchio'):
        return True
    return one == other


SCRATCH = {
    'body',  # built from the description, not from the file; with pinocchio's own work space
    'left', 'right',  # changes that wait no longer
    '_rows', 'rows', '_origins',  # of horizons that are over
    '_metric',  # of the inputs kept, when it is first asked for
    '_marks',  # what would be taken back; a detector that knows nothing yet takes nothing back
    'revision',  # another one with every change, so that predictions made before are refused
    'options', '_options', 'hyperparameters',  # estimated the first time, given the second
}


LAYOUT = {
    33: {
        'meta': 'applied format gate joints known memory newest origin others passed_over renewal settings tools '
                'version window_left',
        'gate': 'awake bands calm_since changed closed closed_at closed_ratio closed_since closures counts familiar '
                'free level mean newest resting speed tails turns within',
        'known': 'gamma rho tau sigma output_scale pi drift_share drift_memory features autocorrelation_time',
        'settings': 'effects effects_reference features.count features.frequencies features.length_scales '
                    'features.seed forgetting horizon.length initial.samples joint_friction noise outputs priors '
                    'temperatures variant',
        'bias': 'f8 (6,)', 'probe': 'f8 (19, 10)', 'inputs_learnt': 'f8 (2, 6)', 'temperature': 'f8 (0,)',
        'history.stamps': 'i8 (70,)', 'history.position': 'f8 (70, 2)', 'history.velocity': 'f8 (70, 2)',
        'history.acceleration': 'f8 (70, 2)', 'history.outputs': 'f8 (70, 6)', 'history.learnt': 'i1 (70,)',
        'history.origin': 'i8 ()', 'history.temperature': 'f8 (70, 0)',
        'recursion.array': 'f8 (178, 40)', 'recursion.left': 'f8 (8, 40)', 'recursion.right': 'f8 (8, 178)',
        'recursion.places': 'i8 (138,)', 'recursion.waiting': 'i8 ()', 'recursion.inflation': 'f8 ()',
        'recursion.renewed': 'i8 (2,)', 'recursion.back': 'f8 (3,)',
        'recursion.information': 'f8 (23, 23)', 'recursion.theta': 'f8 (22,)',
        'recursion.prior_information': 'f8 (22, 22)',
        'horizon.filled': 'i8 ()', 'horizon.start': 'i8 ()', 'horizon.rows': 'f8 (5, 242)',
        'horizon.origins': 'i8 (5,)', 'calibration.table': 'f8 (11, 6)', 'wandering.table': 'f8 (16, 6)',
        'average.log_weights': 'f8 (3, 6)', 'average.shares': 'f8 (3, 6)', 'average.filled': 'i8 ()',
        'average.start': 'i8 ()', 'average.rows': 'f8 (5, 30)', 'average.origins': 'i8 (5,)',
        # the rigid body alone, and the same variant without effects
        'other0.recursion.array': 'f8 (138, 0)', 'other0.recursion.left': 'f8 (8, 0)',
        'other0.recursion.right': 'f8 (8, 138)', 'other0.recursion.places': 'i8 (138,)',
        'other0.recursion.information': 'f8 (23, 23)', 'other0.recursion.theta': 'f8 (22,)',
        'other0.recursion.prior_information': 'f8 (22, 22)',
        'other0.horizon.rows': 'f8 (5, 202)',
        'other1.recursion.array': 'f8 (142, 40)', 'other1.recursion.left': 'f8 (8, 40)',
        'other1.recursion.right': 'f8 (8, 142)', 'other1.recursion.places': 'i8 (102,)',
        'other1.recursion.information': 'f8 (17, 17)', 'other1.recursion.theta': 'f8 (16,)',
        'other1.recursion.prior_information': 'f8 (16, 16)',
        'other1.horizon.rows': 'f8 (5, 200)',
        **{f'other{index}.{name}': layout for index in (0, 1) for name, layout in (
            ('recursion.waiting', 'i8 ()'), ('recursion.inflation', 'f8 ()'), ('recursion.renewed', 'i8 (2,)'),
            ('recursion.back', 'f8 (3,)'), ('horizon.filled', 'i8 ()'),
            ('horizon.start', 'i8 ()'), ('horizon.origins', 'i8 (5,)'), ('calibration.table', 'f8 (11, 6)'),
            ('wandering.table', 'f8 (16, 6)'))},
        'kept.kept': 'f8 (70, 6)', 'kept.counts': 'i8 (2,)',
        'carried.blocks': 'f8 (32, 3, 6)', 'carried.sums': 'f8 (3, 6)', 'carried.counts': 'i8 (4,)',
        'carried.theta0': 'f8 (22,)', 'carried.alpha0': 'f8 (6, 40)', 'carried.theta1': 'f8 (22,)',
        'carried.alpha1': 'f8 (6, 0)', 'carried.theta2': 'f8 (16,)', 'carried.alpha2': 'f8 (6, 40)',
        'gate.0': 'f8 (6,)', 'gate.1': 'f8 (6,)', 'gate.2': 'f8 (6,)',  # level, mean, ratio of a closure
        'gate.3': 'f8 (0, 6)', 'gate.4': 'f8 (0, 6)',  # tails
        'gate.23': 'f8 (6,)', 'gate.24': 'f8 (6,)',  # bands of free motion
        **{f'gate.{number}': 'f8 (0, 6)' if number % 3 == 2 else 'f8 (6,)' for number in range(5, 23)},  # six bands
        'renewal.0': 'f8 (4, 6)', 'renewal.1': 'f8 (4, 6)',  # errors over a whole window and a draft's
        'window.rows': 'f8 (0, 144)', 'motion.place': 'f8 (2,)',
        'motion.nearby': 'f8 (2,)', 'motion.outputs': 'f8 (6,)', 'motion.counts': 'i8 (3,)', 'motion.is_news': 'b1 ()',
    },
}
"""What a file of each version holds, of an SPK model with an effect after 70 samples. When this changes, so must
VERSION: an older node would misread the file."""


def test_the_layout_changes_only_with_the_version(tmp_path):
    stage = stage_of(replace(SETTINGS, effects=('sensor_drift',)), motion(70))
    assert layout_of(state_file.snapshot(stage.learner.state()).arrays()) == LAYOUT[state_file.VERSION]


def layout_of(arrays):
    meta = json.loads(str(arrays['meta']))
    found = {'meta': ' '.join(sorted(meta)), 'gate': ' '.join(sorted(meta['gate']['dict'])),
             'known': ' '.join(meta['known'][0]), 'settings': ' '.join(sorted(meta['settings']))}
    return found | {name: f'{values.dtype.str[1:]} {values.shape}' for name, values in arrays.items() if name != 'meta'}


def test_a_number_of_features_chosen_by_itself_is_kept_by_a_state_of_a_state(tmp_path):
    settings = replace(SETTINGS, features_count='auto')
    stage = stage_of(settings, motion(70))
    chosen = stage.learner.estimator.features_count
    for _ in range(2):
        state_file.save(tmp_path / 's.npz', stage.learner.state())
        stage.learner.restore(state_file.load(tmp_path / 's.npz', settings, BODY))
        assert stage.learner.estimator.features_count == chosen >= 50
    stage.learner.change(replace(settings, effects=('sensor_drift',)))
    stage.learner.change(settings)
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    assert state_file.load(tmp_path / 's.npz', settings, BODY).estimator.features_count == chosen


def test_temperatures_are_kept_and_must_be_those_of_the_node(tmp_path):
    """Those that are not known as well."""
    warm = replace(SETTINGS, temperatures=('ft',), effects=('temperature_drift',))
    samples = [sample._replace(temperature=np.array([math.nan if index < 20 else 20.0 + 0.1 * index]))
               for index, sample in enumerate(motion(70))]
    stage = stage_of(warm, samples)
    state_file.save(tmp_path / 's.npz', stage.learner.state())
    found = state_file.load(tmp_path / 's.npz', warm, BODY)
    np.testing.assert_array_equal(found.batch.samples.temperature[:, 0], [each.temperature[0] for each in samples])
    for sample, (kept, _) in zip(samples, found.batch.pairs(), strict=True):
        np.testing.assert_array_equal(kept.temperature, sample.temperature)
    desired = [each.predict_desired(*samples[9][1:4]).shown for each in (found.estimator, stage.learner.estimator)]
    np.testing.assert_array_equal(*desired)  # as warm as the last sample
    with pytest.raises(SemiparamError, match=r"was learnt with temperatures \['ft'\]; this node has \[\]"):
        state_file.load(tmp_path / 's.npz', replace(warm, temperatures=()), BODY)


def held(samples):
    """What a file holds after these samples: the arrays, and the JSON text among them decoded."""
    arrays = state_file.snapshot(stage_of(SETTINGS, samples).learner.state()).arrays()
    return arrays, json.loads(str(arrays['meta']))


def write(path, arrays, meta):
    np.savez(path, **arrays | {'meta': np.array(json.dumps(meta))})


def test_other_versions_are_refused(tmp_path):
    path, (arrays, meta) = tmp_path / 's.npz', held(motion(70))
    for version in (1, state_file.VERSION - 1, state_file.VERSION + 1, None):
        write(path, arrays, {**meta, 'version': version})
        with pytest.raises(SemiparamError, match=f'version {version}; this node reads version {state_file.VERSION}'):
            state_file.load(path, SETTINGS, BODY)


def link_to(target):
    def spoil(path):
        (path.parent / 'letter').write_text('a letter')
        path.symlink_to(target)
    return spoil


@pytest.mark.parametrize(('words', 'values'), [
    ({'joints': 5}, {}), ({'joints': [1, 2]}, {}), ({'settings': None}, {}), ({}, {'probe': np.full((19, 10), 'x')})])
def test_a_state_that_does_not_say_of_what_it_is_stops_no_saving(tmp_path, words, values):
    """To compare it with another was an internal error."""
    checkpoints, state = Checkpoints(tmp_path, 'arm'), stage_of(SETTINGS, motion(3)).learner.state()
    arrays, meta = held(motion(3))
    write(checkpoints.path, arrays | values, meta | words)
    with pytest.raises(SemiparamError, match='is no saved state, so it is not replaced'):
        state_file.save(checkpoints.path, state)
    assert checkpoints.newest(SETTINGS, BODY) is None
    checkpoints.save(state)
    assert checkpoints.newest(SETTINGS, BODY) is not None


@pytest.mark.parametrize('spoil', [
    lambda path: path.write_text('a letter to my mother'), lambda path: np.savez(path, thesis=np.arange(3)),
    lambda path: np.savez(path, meta=np.array('{"format": "mine"}')), link_to('letter'), link_to('/nowhere/at/all'),
    Path.mkdir, Path.touch, os.mkfifo])
def test_nothing_but_a_state_is_replaced(tmp_path, spoil):
    path, state = tmp_path / 's.npz', stage_of(SETTINGS, motion(3)).learner.state()
    state_file.save(path, state)
    state_file.save(path, state)
    path.unlink()
    spoil(path)
    before = contents(tmp_path)
    with pytest.raises(SemiparamError, match=r's\.npz is (no saved state|a link)'):
        state_file.save(path, state)
    if not path.is_symlink():
        with pytest.raises(SemiparamError, match=r'cannot be read|no saved state'):
            state_file.load(path, SETTINGS, BODY)
    assert contents(tmp_path) == before


def test_a_folder_that_may_not_be_looked_into_is_told(tmp_path, monkeypatch):
    """It was an internal error."""
    def is_symlink(path):
        raise PermissionError(13, 'Permission denied')

    with monkeypatch.context() as patch:
        patch.setattr(Path, 'is_symlink', is_symlink)
        with pytest.raises(SemiparamError, match=r'cannot write .*s\.npz: Permission denied\.'):
            state_file.save(tmp_path / 's.npz', stage_of(SETTINGS).learner.state())


def contents(folder):
    return {path.name: path.read_bytes() if path.is_file() else path.lstat().st_mode for path in folder.iterdir()
            if path.suffix != '.lock'}


def test_a_model_that_is_not_finite_is_not_saved(tmp_path):
    stage = stage_of(SETTINGS, motion(100))
    checkpoints = Checkpoints(tmp_path, '/arm/estimator')
    checkpoints.save(stage.learner.state())
    good = checkpoints.path.read_bytes()
    stage.learner.estimator.model.recursion.theta[0] = np.nan
    for save in (checkpoints.save, lambda state: state_file.save(tmp_path / 's.npz', state)):
        with pytest.raises(SemiparamError, match=r"a value in 'recursion\.theta' that is not finite"):
            save(stage.learner.state())
    assert contents(tmp_path) == {'arm.estimator.checkpoint.npz': good}


def test_what_no_file_can_hold_is_refused(tmp_path):
    state = stage_of(SETTINGS, motion(100)).learner.state()
    state.estimator._memory = [(1, {'a': object()})]
    with pytest.raises(SemiparamError, match='an effect remembers a object'):
        state_file.save(tmp_path / 's.npz', state)
    state.estimator._memory = memory = [(None, (1, 2.5, 'x')), {'a': np.arange(3), 'b': [np.float64(0.1), True]}]
    state_file.save(tmp_path / 's.npz', state)
    assert same(state_file.load(tmp_path / 's.npz', SETTINGS, BODY).estimator._memory, memory)


def test_states_lie_in_one_folder(tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.delenv('ROS_HOME', raising=False)
    assert state_file.folder_of(SETTINGS) == tmp_path / '.ros/semiparam'
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))
    assert state_file.folder_of(SETTINGS) == tmp_path / 'home/semiparam'
    assert state_file.folder_of(replace(SETTINGS, state_folder='~/mine')) == tmp_path / 'mine'
    with pytest.raises(SemiparamError, match='state_folder is ~nobody_of_this_name'):
        state_file.folder_of(replace(SETTINGS, state_folder='~nobody_of_this_name/x'))
    state_file.save(state_file.folder_of(SETTINGS) / 's.npz', stage_of(SETTINGS).learner.state())
    (tmp_path / 'file').touch()
    with pytest.raises(SemiparamError, match=r'there is no folder .*/file/x and none can be made: Not a directory'):
        state_file.save(tmp_path / 'file/x/s.npz', stage_of(SETTINGS).learner.state())


@pytest.mark.parametrize('name', [
    '', 'a', '.npz', '.a.npz', '../a.npz', 'b/a.npz', '/a.npz', 'a.npz/', 'a\\b.npz', 'a b.npz', 'a\n.npz', 'a.npz\n',
    'a\0.npz', '-a.npz', 'ä.npz', 'a' * 97 + '.npz', '~a.npz'])
def test_a_state_file_is_a_plain_name(name):
    with pytest.raises(SemiparamError, match='expected a plain name'):
        SETTINGS.from_mapping({**SETTINGS.mapping(), 'state_file': name})
    SETTINGS.from_mapping({**SETTINGS.mapping(), 'state_file': 'arm-2_b.1.npz'})


def test_two_generations_of_checkpoints(tmp_path):
    checkpoints, stage = Checkpoints(tmp_path, 'estimator'), stage_of(SETTINGS)
    assert checkpoints.newest(SETTINGS, BODY) is None and not checkpoints.remarks
    for sample in motion(3):
        stage.offer([sample])
        checkpoints.save(stage.learner.state())
    assert sorted(contents(tmp_path)) == ['estimator.checkpoint.npz', 'estimator.checkpoint.previous.npz']
    assert len(checkpoints.newest(SETTINGS, BODY).batch) == 3
    checkpoints.path.write_bytes(checkpoints.path.read_bytes()[:5000])
    assert len(checkpoints.newest(SETTINGS, BODY).batch) == 2
    assert len(checkpoints.remarks) == 1 and 'cannot be read' in checkpoints.remarks[0]
    checkpoints.save(stage.learner.state())
    assert len(checkpoints.newest(SETTINGS, BODY).batch) == 3 and not checkpoints.remarks
    checkpoints.path.unlink()
    assert len(checkpoints.newest(SETTINGS, BODY).batch) == 2, 'a damaged one does not take the place of a good one'
    aside = [name for name in os.listdir(tmp_path) if 'unreadable' in name]
    assert len(aside) == 1 and (tmp_path / aside[0]).stat().st_size == 5000
    checkpoints.previous.write_bytes(b'')
    assert checkpoints.newest(SETTINGS, BODY) is None and len(checkpoints.remarks) == 1


@contextmanager
def no_file_can_be_opened():
    """The process has as many files as it may."""
    limits, taken = resource.getrlimit(resource.RLIMIT_NOFILE), []
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir('/proc/self/fd'))), limits[1]))
    try:
        with suppress(OSError):
            while True:
                taken.append(os.open(os.devnull, os.O_RDONLY))
        yield
    finally:
        for descriptor in taken:
            os.close(descriptor)
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_good_checkpoints_stay_where_the_process_can_open_no_file(tmp_path):
    """They were taken for damaged and moved aside without a word: the node then went on from none."""
    checkpoints, state = Checkpoints(tmp_path, 'estimator'), stage_of(SETTINGS, motion(3)).learner.state()
    for _ in range(2):
        checkpoints.save(state)
    before = contents(tmp_path)
    with no_file_can_be_opened():
        for save in (checkpoints.save, partial(state_file.save, checkpoints.path)):
            with pytest.raises(SemiparamError, match=r'cannot be read, so it is not replaced: Too many open files\.$'):
                save(state)
    assert contents(tmp_path) == before and not checkpoints.news
    checkpoints.path.write_bytes(b'')
    checkpoints.save(state)
    assert len(checkpoints.news) == 1 and 'is no saved state that can be read. It is moved to' in checkpoints.news[0]


def test_a_lock_that_cannot_be_opened_for_a_while_is_no_other_nodes(tmp_path):
    """The checkpoint of the life before was moved aside as that of another node."""
    state = stage_of(SETTINGS, motion(70)).learner.state()
    before = Checkpoints(tmp_path, 'estimator')
    before.save(state)
    before.lock.release()
    checkpoints = Checkpoints(tmp_path, 'estimator')
    assert checkpoints.newest(SETTINGS, BODY) is not None
    with no_file_can_be_opened(), pytest.raises(SemiparamError, match=r'estimator\.lock cannot be opened \(Too many'):
        checkpoints.save(state)
    checkpoints.save(state)
    assert not checkpoints.news and checkpoints.previous.exists()


def test_a_checkpoint_is_written_in_a_thread_as_the_state_was(tmp_path):
    checkpoints, stage, done = Checkpoints(tmp_path, 'estimator'), stage_of(SETTINGS, motion(100)), []
    expected = pickle.dumps(state_file.snapshot(stage.learner.state()).arrays())
    checkpoints.save_in_thread(stage.learner.state(), done.append)
    stage.offer(motion(200)[100:])
    checkpoints.wait()
    assert done == [None]
    assert same(pickle.loads(expected), dict(np.load(checkpoints.path)))
    elsewhere = Checkpoints(checkpoints.path, 'estimator')
    elsewhere.save_in_thread(stage.learner.state(), done.append)
    elsewhere.wait()
    assert 'there is no folder' in str(done[1])


def test_files_wait_for_each_other_and_nobody_for_them():
    thread, disk, done = FileThread('states'), threading.Event(), []
    thread.submit(disk.wait, lambda result, error: done.append(result))
    thread.submit(lambda: done[0] / 0, lambda result, error: done.append(type(error)))
    assert thread.busy and not done
    disk.set()
    thread.wait()
    assert done == [True, ZeroDivisionError] and not thread.busy


def test_what_follows_work_for_which_there_was_no_thread_is_done(monkeypatch):
    """It waited for a thread that had never begun, and ended without a word."""
    def refuse(thread):
        raise RuntimeError("can't start new thread")

    files, done = FileThread('test'), []
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, 'start', refuse)
        with pytest.raises(RuntimeError):
            files.submit(lambda: 'never', lambda *outcome: done.append(outcome))
    files.submit(lambda: 'second', lambda *outcome: done.append(outcome))
    files.wait()
    assert done == [('second', None)]


def features_of(path):
    with np.load(path) as archive:
        return json.loads(str(archive['meta']))['settings']['features.count']


def test_a_state_of_another_configuration_is_moved_aside_and_found_again(tmp_path):
    """As after a typo in a launch file, which is mended a moment later."""
    mistyped = replace(SETTINGS, features_count=30)
    before, stage = Checkpoints(tmp_path, 'arm'), stage_of(SETTINGS, motion(70))
    for _ in range(2):
        before.save(stage.learner.state())
    before.lock.release()
    checkpoints = Checkpoints(tmp_path, 'arm')
    assert checkpoints.newest(mistyped, BODY) is None
    assert checkpoints.remarks == [f'{checkpoints.path} was learnt with features.count 40; this node has 30.']
    for _ in range(3):
        checkpoints.save(stage_of(mistyped, motion(3)).learner.state())
    aside = sorted(name for name in os.listdir(tmp_path) if 'aside' in name)
    assert [features_of(tmp_path / name) for name in aside] == [40, 40]
    assert [features_of(path) for path in (checkpoints.path, checkpoints.previous)] == [30, 30]
    news = ' '.join(checkpoints.news)
    assert all(name in news for name in aside) and 'features.count 40; this node has 30' in news
    checkpoints.lock.release()
    mended = Checkpoints(tmp_path, 'arm')
    assert len(mended.newest(SETTINGS, BODY).batch) == 70 and len(mended.remarks) == 1
    for _ in range(3):
        mended.save(stage.learner.state())
    kept = [features_of(path) for path in tmp_path.glob('*.npz')]
    assert sorted(kept) == [30, 30, 40, 40, 40, 40]


def test_what_was_refused_is_moved_aside_also_after_that_failed_once(tmp_path, monkeypatch):
    """The reason was forgotten with the first attempt, and the second one replaced the file."""
    arrays, meta = held(motion(70))
    checkpoints, stage = Checkpoints(tmp_path, 'arm'), stage_of(SETTINGS, motion(3))
    write(checkpoints.path, {**arrays, 'history.outputs': np.full_like(arrays['history.outputs'], np.nan)}, meta)
    refused = checkpoints.path.read_bytes()
    assert checkpoints.newest(SETTINGS, BODY) is None and len(checkpoints.remarks) == 1
    with monkeypatch.context() as patch:
        patch.setattr(os, 'rename', lambda *_: (_ for _ in ()).throw(PermissionError(13, 'Permission denied')))
        with pytest.raises(SemiparamError, match='Permission denied'):
            checkpoints.save(stage.learner.state())
    for _ in range(3):
        checkpoints.save(stage.learner.state())
    aside = [path for path in tmp_path.iterdir() if 'aside' in path.name]
    assert [path.read_bytes() for path in aside] == [refused] and str(aside[0]) in checkpoints.news[0]


def test_what_is_begun_anew_does_not_replace_another_variant(tmp_path):
    """A state brings its variant along, but a node that did not go on from it has its own."""
    before = Checkpoints(tmp_path, 'arm')
    before.save(stage_of(SETTINGS, motion(70)).learner.state())
    before.lock.release()
    other, stage = Checkpoints(tmp_path, 'arm'), stage_of(replace(SETTINGS, variant='P'), motion(3))
    other.save(stage.learner.state())
    other.save(stage_of(SETTINGS, motion(3)).learner.state())  # changed while it runs: its own is replaced
    assert len(contents(tmp_path)) == 3 and "variant 'SPK-ML'; this node has 'P'" in other.news[0]


def test_saving_by_hand_moves_another_configuration_aside(tmp_path):
    path = tmp_path / 's.npz'
    state_file.save(path, stage_of(SETTINGS, motion(70)).learner.state())
    assert not state_file.save(path, stage_of(replace(SETTINGS, variant='P'), motion(3)).learner.state())
    said = state_file.save(path, stage_of(replace(SETTINGS, features_count=30), motion(3)).learner.state())
    (aside,) = (each for each in tmp_path.iterdir() if each != path)
    assert features_of(aside) == 40 and str(aside) in said


def test_what_differs_is_told_and_nothing_else(tmp_path):
    joints = tuple(f'joint_{index}' for index in range(7))
    arrays, meta = held(motion(3))
    for change, expected in (
            ({'joints': ['a', *joints]}, 'is of another robot: it has the joints joint_0, joint_1, joint_2 and 4 more, '
                                         'which this node has not, and lacks b.'),
            ({'joints': ['b', 'a']}, 'is of another robot: it has the same joints in another order.'),
            ({'settings': {**meta['settings'], 'features.count': 7, 'outputs': 'effort', 'features.seed': 3,
                           'initial.samples': 8}},
             "was learnt with outputs 'effort'; this node has 'wrench'. features.count, features.seed, initial.samples "
             'differ too.')):
        path = tmp_path / 's.npz'
        write(path, arrays, meta | change)
        with pytest.raises(SemiparamError) as caught:
            state_file.load(path, SETTINGS, BODY)
        assert str(caught.value) == f'{path} {expected}'


def test_a_state_whose_variant_lacks_given_hyperparameters_is_refused(tmp_path):
    """It was loaded, and from then on every change of a parameter was refused, also the end of a pause."""
    path = tmp_path / 's.npz'
    state_file.save(path, stage_of(SETTINGS, motion(70)).learner.state())
    given = replace(SETTINGS, variant='P', hyperparameters_gamma=(1.0,), hyperparameters_sigma=(0.1,),
                    hyperparameters_output_scale=(1.0,) * 6)
    with pytest.raises(SemiparamError) as caught:
        state_file.load(path, given, BODY)
    assert str(caught.value) == (
        f'{path} does not fit the parameters of this node: hyperparameters.rho is empty, but SPK-ML needs it once any '
        'is given; expected all of them, or none to estimate them.')
    assert state_file.load(path, SETTINGS, BODY).settings.variant == 'SPK-ML'


def test_sizes_are_checked_before_anything_is_unpacked(tmp_path):
    path, (arrays, _) = tmp_path / 's.npz', held(motion(70))
    np.savez_compressed(path, **{**arrays, 'recursion.array': np.zeros((30_000, 1000))})
    assert path.stat().st_size < 10**6
    with pytest.raises(SemiparamError, match=r'cannot be read \(.* is compressed\)'):
        state_file.load(path, SETTINGS, BODY)
    np.savez(path, **arrays)
    longer = path.read_bytes().replace(b"'shape': (178, 40)", b"'shape': (178,999)").replace(
        b"'shape': (142, 40)", b"'shape': (142,999)")
    path.write_bytes(longer)
    with pytest.raises(SemiparamError, match=r'bytes for an array \(1.., ?999\)'):
        state_file.load(path, SETTINGS, BODY)


def test_a_file_that_names_many_effects_makes_no_large_model(tmp_path):
    """Room grows with the square of their columns: two thousand, half a megabyte of text, took gigabytes."""
    path, (arrays, meta) = tmp_path / 's.npz', held(motion(70))
    meta['settings']['effects'] = [f'payload@ft{{"start_s": {second}.0}}' for second in range(120)]
    write(path, arrays, meta)
    tracemalloc.start()
    with pytest.raises(SemiparamError, match='its effects have 1200 columns'):
        state_file.load(path, SETTINGS, BODY)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


WRONG_ARRAYS = {
    'float32': lambda values: values.astype(np.float32),
    'int32': lambda values: values.astype(np.int32),
    'float64': lambda values: values.astype(np.float64),
    'bool': lambda values: values.astype(bool),
    'text': lambda values: values.astype('U9'),
    'flat': lambda values: values[None],
    'empty': lambda values: values[:0] if values.ndim else np.zeros(0),
    'longer': lambda values: np.concatenate([values, values]) if values.ndim else np.array([values, values]),
    'wider': lambda values: np.concatenate([values, values], axis=-1) if values.ndim else values[None, None],
    'minus one': lambda values: np.full_like(values, -1),
    'large': lambda values: np.full_like(values, 127 if values.dtype == np.int8 else 2**62),
    'huge': lambda values: np.full_like(values, 1e300 if values.dtype.kind == 'f' else 100),
    'infinite': lambda values: np.full_like(values, np.inf) if values.dtype.kind == 'f' else np.full_like(values, -100),
}
SPOILT = {
    'averaged': replace(SETTINGS, variant='auto', effects=('sensor_drift',)),
    'effort': replace(EFFORT, effects=('backlash@b{"gap": 0.2}', 'coulomb_friction@a{"presliding": 0.05}')),
}


@pytest.mark.parametrize('settings', SPOILT.values(), ids=SPOILT)
def test_what_is_loaded_can_answer_and_learn(tmp_path, settings, long):
    """Right checksums, wrong values: each array and each entry of the JSON text, one after the other."""
    body = build_rigid_body(settings)
    samples, path = motion(80, body=body), tmp_path / 's.npz'
    stage = stage_of(settings, samples[:70])
    arrays = state_file.snapshot(stage.learner.state()).arrays()
    meta = json.loads(str(arrays['meta']))
    spoilt = [(f'{name}: {how}', arrays | {name: wrong(values)}) for name, values in arrays.items() if name != 'meta'
              for how, wrong in WRONG_ARRAYS.items() if not same(values, wrong(values))]
    spoilt += [(f'{name}x: added', {**arrays, f'{name}x': values}) for name, values in arrays.items()]
    spoilt += [(f'{name}: missing', {other: arrays[other] for other in arrays if other != name}) for name in arrays]
    spoilt += [(f'meta {where}', arrays | {'meta': np.array(json.dumps(wrong))}) for where, wrong in misquoted(meta)]
    accepted = []
    for what, these in spoilt[::1 if long else 41]:
        np.savez(path, **these)
        try:
            saved = state_file.load(path, settings, body)
        except SemiparamError as error:
            assert str(error).startswith(str(path)) and 'Traceback' not in str(error)
            continue
        stage.learner.restore(saved)
        stage.offer(samples[70:])
        assert not stage.failures, (what, stage.failures)
        accepted.append(what)
    wrong_kinds = {'float32', 'float64', 'int32', 'bool', 'text', 'flat', 'added', 'missing'}
    assert not [what for what in accepted if what.split(': ')[-1] in wrong_kinds]


@pytest.mark.parametrize(('name', 'wrong'), [('changed', None), ('changed', 2.5), ('closed_since', 'x'), ('speed', [])])
def test_a_word_of_the_gate_that_is_of_another_kind_is_refused(tmp_path, name, wrong):
    """It was loaded, and every sample from then on was an internal error."""
    path, (arrays, meta) = tmp_path / 's.npz', held(motion(70))
    meta['gate']['dict'][name] = wrong
    write(path, arrays, meta)
    with pytest.raises(SemiparamError, match=f'gate.{name}'):
        state_file.load(path, SETTINGS, BODY)


@pytest.mark.parametrize(('name', 'wrong'), [
    ('closed_since', math.inf), ('closed_since', 1e300), ('closed_since', 10**30), ('calm_since', 2.5),
    ('newest', -math.inf), ('closures', 0.5), ('closures', None), ('closures', {'tuple': ['x']})])
def test_a_time_of_the_gate_that_is_none_is_refused(tmp_path, name, wrong):
    """It was loaded: a contact had lasted since for ever, and the next one was an internal error."""
    path, (arrays, meta) = tmp_path / 's.npz', held(motion(70))
    meta['gate']['dict'][name] = wrong
    write(path, arrays, meta)
    with pytest.raises(SemiparamError, match='is damaged'):
        state_file.load(path, SETTINGS, BODY)


def misquoted(value, where=''):
    """The JSON value with one entry wrong, for each entry; and where it is."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from ((place, {**value, name: wrong}) for place, wrong in misquoted(part, f'{where}/{name}'))
    elif isinstance(value, list) and len(value) < 40:
        for index, part in enumerate(value[:3]):
            yield from ((place, [*value[:index], wrong, *value[index + 1:]])
                        for place, wrong in misquoted(part, f'{where}/{index}'))
    for wrong in (None, True, -1, 3, 10**30, 2.5, math.nan, 'x', [], {}, {'list': 3}):
        if type(wrong) is not type(value) or wrong != value:
            yield f'{where}: {wrong}', wrong


def test_another_process_of_the_same_name_does_not_write(tmp_path):
    stage, path = stage_of(SETTINGS, motion(70)), tmp_path / 's.npz'
    checkpoints = Checkpoints(tmp_path, '/left/arm')
    with other_process(tmp_path, 'left.arm') as other:
        for lock in (checkpoints.lock, FolderLock(tmp_path, '/left/arm')):
            with pytest.raises(SemiparamError, match=rf'process {other.pid}, another node of the name /left/arm'):
                lock.take()
        with pytest.raises(SemiparamError, match='another node of the name'):
            checkpoints.save(stage.learner.state())
        assert not checkpoints.path.exists()
        FolderLock(tmp_path, '/right/arm').take()
        state_file.save(checkpoints.path, stage.learner.state())
    checkpoints.save(stage.learner.state())  # the other one is gone, and what it wrote is not lost
    assert sum('aside' in name for name in os.listdir(tmp_path)) == 1
    assert 'written by another node' in checkpoints.news[0]
    FolderLock(path / 'no folder', 'arm').take()
    (tmp_path / 'file').touch()
    FolderLock(tmp_path / 'file', 'arm').take()  # writing tells what is wrong there


@pytest.mark.parametrize('make', [Path.mkdir, os.mkfifo, lambda path: path.touch(mode=0o444)])
def test_whatever_has_the_name_of_a_lock_is_one_or_is_an_error(tmp_path, make):
    """A lock that could not be opened for writing was passed over, and two nodes of a name wrote."""
    folder = Path(tempfile.mkdtemp(dir='/tmp'))
    try:
        make(folder / 'arm.lock')
        folder.chmod(0o777)
        first, second = FolderLock(folder, 'arm'), FolderLock(folder, 'arm')
        with another_user():
            first.take()
            with pytest.raises(SemiparamError, match='another node of the name arm'):
                second.take()
        first.release()
        (folder / 'arm.lock').rename(folder / 'away')
        (folder / 'arm.lock').symlink_to(tmp_path / 'elsewhere')
        with pytest.raises(SemiparamError, match=r'arm\.lock cannot be opened .* expected a file that this user may'):
            first.take()
    finally:
        shutil.rmtree(folder)


@contextmanager
def another_user():
    """A user who may not write this one's files, where this one may become another."""
    if os.getuid():
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_a_lock_whose_folder_was_removed_is_taken_anew(tmp_path):
    """A second node of the name wrote beside the first one, into the folder that this had made anew."""
    folder, other = tmp_path / 'states', tmp_path / 'other'
    first, second = FolderLock(folder, 'arm'), FolderLock(folder, 'arm')
    first.take()
    folder.rename(other)
    first.take()
    with pytest.raises(SemiparamError, match='another node of the name arm'):
        second.take()
    folder.rename(tmp_path / 'third')
    second.take()
    with pytest.raises(SemiparamError, match='another node of the name arm'):
        first.take()


def test_two_threads_take_a_lock_anew_at_once(tmp_path):
    """Each closed what the other had opened: a state and a checkpoint are written in two threads."""
    failed, lock = [], FolderLock(tmp_path / 'states', 'arm')

    def take(barrier):
        barrier.wait()
        try:
            lock.take()
        except Exception as error:
            failed.append(error)

    lock.take()
    for number in range(20):
        (tmp_path / 'states').rename(tmp_path / str(number))
        threads = [threading.Thread(target=take, args=(barrier,)) for barrier in [threading.Barrier(2)] * 2]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert not failed


@contextmanager
def other_process(folder, name):
    """One that has the lock, however it ends."""
    code = (f'from pathlib import Path; from semiparam_ros.online.folder_lock import FolderLock; '
            f'FolderLock(Path({str(folder)!r}), {name.replace(".", "/")!r}).take(); print(flush=True); input()')
    with subprocess.Popen([sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


def test_thirty_restarts_with_random_configurations_lose_no_state_of_another(tmp_path):
    """Each start saves a few times; what the one before had learnt is then there, or was gone on from or begun anew."""
    chance, last = np.random.default_rng(7), {}
    for number in range(30):
        settings = replace(SETTINGS, features_count=int(chance.choice([20, 30, 40])), features_seed=number % 2,
                           variant=str(chance.choice(['P', 'NP-ML'])), initial_samples=60)
        stage, checkpoints = stage_of(settings), Checkpoints(tmp_path, 'arm')
        saved = checkpoints.newest(settings, BODY) if chance.random() < 0.7 else None
        if saved is not None:
            stage.learner.restore(saved)
        newest = 1 + max(0, *(sample.stamp for sample, _ in saved.batch.pairs())) if saved is not None else 0
        stage.offer([sample._replace(stamp=sample.stamp + newest) for sample in motion(5, seed=number)])
        for _ in range(int(chance.integers(1, 4))):
            checkpoints.save(stage.learner.state())
        checkpoints.lock.release()
        last[settings.features_count, settings.features_seed, stage.learner.built.variant] = len(stage.learner.history)
        found = set()
        for path in tmp_path.glob('*.npz'):
            with np.load(path) as archive:
                kept = json.loads(str(archive['meta']))['settings']
                found.add((kept['features.count'], kept['features.seed'], kept['variant'],
                           len(archive['history.learnt'])))
        assert {(*configuration, count) for configuration, count in last.items()} <= found
