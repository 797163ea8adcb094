"""Kills a learner that saves checkpoints, again and again at random times, and looks at what is left.

Each process goes on from the newest checkpoint of the one before. What must hold after every kill: the newest
checkpoint can be loaded, and is no older than the last one that the process reported as written. And at the end: what
the last process says is what a learner says that was never killed, bit for bit.
"""

import os
import pickle
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')  # read when numpy is loaded

import numpy as np

from semiparam_ros.online.checkpoint import Checkpoints

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for a start by its path

from support.learner_stage import Stage
from support.node_helpers import BODY, SETTINGS, InlineBackground, motion

NAME, MOST_SAMPLES = 'estimator', 4000
EFFECTS = ('time_delay{"delay_s": 0.005}',)


class Options(NamedTuple):
    """Where, how large a model, and how often it is saved [s]; ``pause_s``: between two samples."""

    folder: Path
    features: int
    period: float
    pause_s: float = 0.002


def settings_of(options):
    return replace(SETTINGS, features_count=options.features, initial_samples=100, effects=EFFECTS,
                   checkpoint_period=options.period, retained_samples=3000)


def new_learner(settings):
    return Stage(settings, InlineBackground()).learner


def learn(options):
    """The process that is killed: learns at up to 500 Hz, tells when a checkpoint is begun and when it is written."""
    settings, samples = settings_of(options), pickle.loads((options.folder / 'samples').read_bytes())
    checkpoints, learner = Checkpoints(options.folder / 'states', NAME), new_learner(settings)
    saved = checkpoints.newest(settings, BODY)
    if saved is not None:
        learner.restore(saved)
    done = 0 if saved is None else count_of(saved)
    tell('ready', done)
    due = time.monotonic() + settings.checkpoint_period
    for count, sample in enumerate(samples[done:], start=done + 1):
        learner.offer(sample)
        if time.monotonic() >= due and not checkpoints.busy:
            due += settings.checkpoint_period
            tell('begun', count)
            checkpoints.save_in_thread(learner.state(), lambda error, count=count: tell(error or 'written', count))
        time.sleep(options.pause_s)
    checkpoints.wait()
    tell('begun', len(samples))
    checkpoints.save(learner.state())
    tell('written', len(samples))
    tell('finished', len(samples))


def count_of(saved):
    """How many samples a state has seen: their stamps are evenly spaced."""
    first, last = saved.estimator.origin, saved.batch.samples.stamps[-1]
    return (int(last) - first) // 20_000_000 + 1


def tell(what, count):
    os.write(1, f'{what} {count} {time.monotonic()}\n'.encode())


def lines_until(process, stop):
    """What it tells until ``stop(what)``, or until it is gone."""
    for line in process.stdout:
        what, count, when = line.rsplit(' ', 2)
        yield what, int(count), float(when)
        if stop(what):
            return


def kill_once(options, chance):
    """Start one and kill it; what it told until then, and when it was killed [s]."""
    with start(options) as process:
        told = list(lines_until(process, lambda what: what == 'ready'))
        begins = chance.randint(1, 3)
        for event in lines_until(process, lambda what: what == 'begun'):
            told.append(event)
            begins -= event[0] == 'begun'
            if not begins or event[0] == 'finished':
                break
        time.sleep(chance.choice([chance.uniform(0.0, 0.03), chance.uniform(0.0, options.period)]))
        killed = time.monotonic()
        os.kill(process.pid, signal.SIGKILL)
        told += list(lines_until(process, lambda what: False))
    return told, killed


def start(options):
    return subprocess.Popen([sys.executable, __file__, *map(str, options)], stdout=subprocess.PIPE, text=True)


def kill(options, kills, seed=3):
    """Whether all holds after so many kills; prints the figures."""
    settings, chance = settings_of(options), random.Random(seed)
    samples = motion(min(400 + 100 * kills, MOST_SAMPLES))
    (options.folder / 'states').mkdir()
    (options.folder / 'samples').write_bytes(pickle.dumps(samples))
    checkpoints = Checkpoints(options.folder / 'states', NAME)
    unloadable = older = interrupted = left = 0
    lost = []
    for _ in range(kills):
        told, killed = kill_once(options, chance)
        errors = [what for what, _, _ in told if what not in ('ready', 'begun', 'written', 'finished')]
        assert not errors, errors
        written = max((count for what, count, _ in told if what in ('written', 'ready')), default=0)
        interrupted += told[-1][0] == 'begun'
        left += any(name.startswith('.') for name in os.listdir(options.folder / 'states'))
        saved = checkpoints.newest(settings, BODY)
        unloadable += len(checkpoints.remarks) + (saved is None and written > 0)
        have = 0 if saved is None else count_of(saved)
        older += have < written
        begun = [when for what, count, when in told if what in ('begun', 'ready') and count == have]
        lost.append(killed - begun[0])
        if have >= len(samples) - 200:  # the motion is over: from the start again
            for path in (checkpoints.path, checkpoints.previous):
                path.unlink(missing_ok=True)
    with start(options._replace(pause_s=0.0)) as process:
        list(lines_until(process, lambda what: False))
    finished = checkpoints.newest(settings, BODY)
    whole = new_learner(settings)
    for sample in samples:
        whole.offer(sample)
    expected, found = (estimator.predict(samples[-1]) for estimator in (whole.estimator, finished.estimator))
    equal = np.array_equal(expected.mean, found.mean) and np.array_equal(expected.std, found.std)
    size = checkpoints.path.stat().st_size
    hidden = [name for name in os.listdir(options.folder / 'states') if name.startswith('.')]
    print(f'{kills} kills, {interrupted} of them while a checkpoint of {size / 1e6:.1f} MB was being written, '
          f'{left} left a temporary file, {len(hidden)} of which are there at the end')
    print(f'checkpoints that cannot be loaded: {unloadable}; older than the last one written: {older}')
    print(f'lost at a period of {options.period:g} s: {np.mean(lost):.3f} s on average, {max(lost):.3f} s at most')
    print(f'predictions at the end equal to those of a learner that was never killed: {equal}')
    return not unloadable and not older and not hidden and equal


if __name__ == '__main__':
    learn(Options(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])))
