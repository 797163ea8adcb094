"""Demonstration of `make demo`: programs started as in three terminals, real DDS, what was
published judged, compared and diagnosed."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from semiparam_ros.bags.loading import LoadedBag, load_samples
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.recording_layout import JOINT_STATES, WRENCH
from semiparam_ros.cli.evaluate import evaluate, events_of, print_scores
from semiparam_ros.cli.options import console, output, progress_bar, write_json
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.initial_window import gathered_from
from semiparam_ros.core.stamps import stamp_ns
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import VariantScores, update_times
from semiparam_ros.online.change_record import ChangeRecord
from semiparam_ros.report.horizon_figure import plot_indices
from semiparam_ros.settings import Settings, load_params

POLL_S = 0.1
STOP_S = 15.0
INTERRUPTED = 130

RESIDUAL, HORIZON = '/estimator/residual', '/estimator/horizon_error'
START_S, PLAY_S, DIAGNOSE_S = 60.0, 600.0, 600.0
SEAM_S = 1e-4
COMPARED = ('P', 'NP-ML')
LOADED_S = 80, 120
"""When a load is picked up and put down."""


def isolated(domain: int) -> dict[str, str]:
    """An environment in which programs meet each other on this machine, and nobody else."""
    return {**os.environ, 'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'OMP_NUM_THREADS': '1'}


class Program:
    """One `semiparam` sub-command as a process; without a log it writes to the terminal.

    Use as a context manager: it is stopped at the end, whatever happens.
    """

    def __init__(self, arguments: Sequence[object], environment: dict[str, str], log: Path | None = None) -> None:
        self.name, self.log = str(arguments[0]), log
        command = [sys.executable, '-m', 'semiparam_ros.cli.main', *map(str, arguments)]
        stream = log.open('w') if log else None
        # A session of its own: Ctrl-C reaches us, and we stop the others in order.
        self._process = subprocess.Popen(command, env=environment, stdout=stream, stderr=stream,
                                         stdin=subprocess.DEVNULL, start_new_session=True)
        if stream:
            stream.close()

    def wait_for(self, condition: Callable[[], bool], what: str, timeout_s: float) -> None:
        """Wait for the condition; SemiparamError when the program or the time ends before."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if self._process.poll() is not None:
                raise SemiparamError(f'{self.name} ended (exit code {self._process.returncode}) before {what}'
                                     f'{self._last_words()}')
            if time.monotonic() > deadline:
                raise SemiparamError(f'{self.name}: {what} did not happen within {timeout_s:g} s{self._last_words()}')
            time.sleep(POLL_S)

    def has_logged(self, text: str) -> bool:
        """Tell whether the program's log holds a text."""
        return self.log is not None and text in self.log.read_text(errors='replace')

    def check_running(self) -> None:
        """Raise SemiparamError when it has ended."""
        if self._process.poll() is not None:
            raise SemiparamError(f'{self.name} ended early with exit code {self._process.returncode}'
                                 f'{self._last_words()}')

    def finish(self, timeout_s: float, beside: Sequence[Program] = ()) -> None:
        """Wait for its own end while those beside it go on; raises SemiparamError for any failure."""
        self.wait_for(lambda: self._ended(beside), 'its end', timeout_s)
        if self._process.returncode != 0:
            raise SemiparamError(f'{self.name} failed with exit code {self._process.returncode}{self._last_words()}')

    def stop(self) -> None:
        """End it as Ctrl-C does; raises SemiparamError when it does not end well."""
        self._interrupt()
        if self._process.returncode not in (0, INTERRUPTED):
            raise SemiparamError(f'{self.name} ended with exit code {self._process.returncode}{self._last_words()}')

    def _ended(self, beside: Sequence[Program]) -> bool:
        for program in beside:
            program.check_running()
        return self._process.poll() is not None

    def _interrupt(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _last_words(self) -> str:
        lines = self.log.read_text(errors='replace').strip().splitlines() if self.log else []
        return f': {lines[-1]}' if lines else '.'

    def __enter__(self) -> Program:
        return self

    def __exit__(self, *_: object) -> None:
        self._interrupt()


def demonstrate(args: argparse.Namespace) -> None:
    """Play, judge, compare, diagnose, and follow a change."""
    try:
        args.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SemiparamError(f'{args.output} cannot be made a folder: {error.strerror}.') from error
    settings = load_params(args.params)
    bag = load_samples(args.bag, settings)
    live, recording = f'{settings.variant} live', args.output / 'live.mcap'
    window = gathered_from(bag.samples, settings.initial_samples).end
    play(args, isolated(args.domain), seam_s(args.bag, int(bag.samples.stamps[window - 1])))
    scores = {live: live_scores(recording, bag, settings)}
    say_pace(args, bag)
    results = {live: scores[live].result() | {'update_ms': answer_times(recording, window)}}
    with progress_bar() as progress:
        for variant in COMPARED:
            scores[variant] = evaluate(replace(settings, variant=variant), [], [bag], False, progress)
            results[variant] = scores[variant].result()
    report(args, scores, results)
    diagnose(args)
    carry(args)


def seam_s(path: Path, stamp: int) -> float:
    """Seconds from the start of a recording to just behind the message of a header stamp [ns]."""
    with open_bag(path) as bag:
        times = [message.log_time for message in bag.messages([JOINT_STATES, WRENCH])
                 if stamp_ns(message.data.header.stamp) <= stamp]
        return 1e-9 * (max(times) - bag.start_ns) + SEAM_S


def play(args: argparse.Namespace, environment: dict[str, str], seam: float) -> None:
    """Node, recorder and replay as three processes.

    The replay is held at ``seam`` [s], the end of the initial window, until the variant has its hyperparameters: at
    this pace the rigid body would answer most of the recording meanwhile.
    """
    folder = args.output
    node = ['run', '--params', args.params]
    record = ['record', folder / 'live.mcap', '--overwrite', '--quiet', '--node', '/estimator',
              '--topics', RESIDUAL, HORIZON]
    replay = ['replay', args.bag, '--as-fast-as-followed', '--disable-keyboard-controls', '--json']
    with (Program(node, environment, folder / 'estimator.log') as estimator,
          Program(record, environment, folder / 'record.log') as recorder):
        recorder.wait_for(lambda: recorder.has_logged('recording'), 'the estimator was found', START_S)
        say(f'{args.bag.name} is played into the live node; the hyperparameters are estimated from its first '
            f'{seam:.0f} s.')
        with Program([*replay, folder / 'window.json', '--until', seam], environment) as player:
            player.finish(PLAY_S, beside=(estimator, recorder))
        estimator.wait_for(lambda: estimator.has_logged('has its hyperparameters and takes over'),
                           'its hyperparameters were estimated', PLAY_S)
        say('they are estimated; the rest is predicted and learnt sample by sample.')
        with Program([*replay, folder / 'replay.json', '--start-offset', seam], environment) as player:
            player.finish(PLAY_S, beside=(estimator, recorder))
        estimator.stop()  # it ends when the recorder has received everything
        recorder.stop()


def say_pace(args: argparse.Namespace, bag: LoadedBag) -> None:
    """Say how fast it went, by the account of the replay."""
    seconds = sum(json.loads((args.output / name).read_text())['duration_s'] for name in ('window.json', 'replay.json'))
    recorded = float(bag.samples.time[-1])
    say(f'{recorded:.0f} s of recording in {seconds:.0f} s, {recorded / seconds:.0f} times real time; '
        f'all {len(bag.samples)} samples answered.')


def live_scores(path: Path, bag: LoadedBag, settings: Settings) -> VariantScores:
    """Score what the node published; a sample without its answer raises SemiparamError."""
    residuals, horizons = published(path)
    samples, first = bag.samples, gathered_from(bag.samples, settings.initial_samples).end
    lost = [stamp for stamp in samples.stamps.tolist() if stamp not in residuals]
    if lost:
        raise SemiparamError(f'{len(lost)} of {len(samples)} samples were lost: no prediction for the one at '
                             f'{1e-9 * (lost[0] - samples.origin):.3f} s of {str(path)!r}.')
    if len(samples) <= first:
        raise SemiparamError(f'the recording holds {len(samples)} samples; expected more than the initial window of '
                             f'{first} (parameter initial.samples).')
    scores = VariantScores(settings.outputs)
    scores.start_recording(samples.origin)
    for sample in samples[first:]:
        scores.add(sample.outputs, sample.outputs - residuals[sample.stamp])
    for horizon in horizons:
        # Those that began in the initial window are the provisional model's.
        if horizon.origin >= samples.stamps[first]:
            scores.add_horizon(horizon)
    return scores


def published(path: Path) -> tuple[dict[int, Array], list[HorizonErrors]]:
    """Residuals (6,) by stamp [ns], and the horizon errors in order, of a recording of the node."""
    residuals, horizons = {}, []
    with open_bag(path) as bag:
        for message in bag.messages([RESIDUAL, HORIZON]):
            stamp = stamp_ns(message.data.header.stamp)
            if message.topic == RESIDUAL:
                force, torque = message.data.wrench.force, message.data.wrench.torque
                residuals[stamp] = np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])
            else:
                half = len(message.data.position) // 2
                values = np.array(message.data.position)
                horizons.append(HorizonErrors(stamp, values[:6], values[half:half + 6]))
    return residuals, horizons


def answer_times(path: Path, first: int) -> dict[str, float] | None:
    """Times from one answer to the next [ms], from the ``first`` on, with all that a node does.

    The replay keeps samples waiting, so that there is no idle time between two answers. (The
    latency that the node's diagnostics tell would be that of the queue.)
    """
    with open_bag(path) as bag:
        arrivals = np.array([message.log_time for message in bag.messages([RESIDUAL])])
    return update_times(1e-9 * np.diff(arrivals[first:]))


def report(args: argparse.Namespace, scores: dict[str, VariantScores], results: dict[str, dict[str, Any]]) -> None:
    """The table, and the files beside it."""
    print_scores(output, results)
    say(f'{" and ".join(COMPARED)}: the same recording through `semiparam evaluate`, without DDS.')
    say('update: for the live node from one answer to the next, receiving and publishing included.')
    write_json(args.output / 'demo.json', {'command': 'demo', 'bag': str(args.bag), 'variants': results})
    plot_indices(args.output / 'indices.png', scores)
    say(f'plot of both indices over time: {args.output / "indices.png"}')
    say(f"the node's inputs and outputs: {args.output / 'live.mcap'}")


def diagnose(args: argparse.Namespace) -> None:
    """Diagnose what the model lacks on a recording with something undeclared."""
    if not args.undeclared.exists():
        return
    say(f'semiparam diagnose {args.undeclared.name}')
    arguments = ['diagnose', args.undeclared, '--params', args.params, '--json', args.output / 'diagnosis.json']
    with Program(arguments, isolated(args.domain)) as program:
        program.finish(DIAGNOSE_S)


def carry(args: argparse.Namespace) -> None:
    """Pick up a load and put it down again: learnt like everything else, and named and applied."""
    if not args.undeclared.exists():
        return
    path, (start, end) = args.output / 'load.mcap', LOADED_S
    say(f'a load is picked up after {start} s, and put down after {end} s ({path}).')
    options = ['--motion', 'mixed', '--seconds', 180, '--robot-seed', 6, '--seed', 2019]
    load = ['--effect', 'payload', '--start', start, '--end', end]
    with Program(['simulate', path, *options, *load], isolated(args.domain)) as program:
        program.finish(DIAGNOSE_S)
    settings = load_params(args.params)
    bag = load_samples(path, settings)
    scores: dict[str, VariantScores] = {}
    records: dict[int, ChangeRecord] = {}
    with progress_bar() as progress:
        for auto, label in (('off', 'learnt'), ('apply', 'applied')):
            records = {}
            chosen = replace(settings, diagnosis_auto=auto)
            scores[label] = evaluate(chosen, [], [bag], False, progress, changes=records)
    for record in records.values():
        output.print(record.sentence, highlight=False)
    print_scores(output, {label: score.result() for label, score in scores.items()})
    events = events_of(records.values(), scores['applied'])
    plot_indices(args.output / 'load.png', dict(reversed(scores.items())), events)
    say(f'plot of both: {args.output / "load.png"}')


def say(sentence: str) -> None:
    """A remark on standard error."""
    console.print(sentence, soft_wrap=True)
