"""Command `semiparam bench`: times beside other recursions, scores beside other learners."""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from semiparam_ros.cli import options
from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from semiparam_ros.core.estimator import Estimator
    from semiparam_ros.core.robot.rigid_body import RigidBody
    from semiparam_ros.core.samples import Sample
    from semiparam_ros.core.types import Array
    from semiparam_ros.experiments.peers import Score

HELP = 'Time one sample of SPK against other recursions, or put all variants beside learners of other packages.'

ARM = 'package://semiparam_ros/config/icub_right_arm.urdf'
FRAME = 'r_arm_ft_sensor'
BUNDLED, PARAMS = 'package://semiparam_ros/bags/icub_xy.mcap', 'package://semiparam_ros/config/icub_right_arm.yaml'
RATIOS = {'SPK / (dsymv + dsyr)': 'of_covariance', 'SPK / Potter': 'of_potter', 'dense / SPK': 'dense_over_ours',
          'dense, in one pass / SPK': 'dense_together_over_ours'}
ROUNDS, SAMPLES, BATCH, WARM_UP = 15, 1000, 50, 3
OURS, COVARIANCE, POTTER, DENSE, TOGETHER = 'SPK', 'dsymv + dsyr', 'Potter', 'dense', 'dense, in one pass'
MEANING = {
    OURS: 'prediction with its standard deviation, 25-step horizon error and update, whole estimator',
    COVARIANCE: 'covariance update of the D features alone',
    POTTER: 'square-root update of the D features alone',
    DENSE: 'textbook recursion on all p + D n unknowns, a rank-1 Cholesky update for each output, two '
           'triangular solutions',
    TOGETHER: 'the same with the rank-1 updates of a sample in one pass over the factor',
}


class Case(NamedTuple):
    """One sample, and what every recursion starts from: columns (n, p) and features (D,)."""

    sample: Sample
    columns: Array
    phi: Array


class Contender(NamedTuple):
    """Contender that learns one sample, and how many samples of it a round takes."""

    learn: Callable[[Case], object]
    samples: int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `semiparam bench`."""
    parser.add_argument('--features', metavar='D', type=int, nargs='+',
                        help='numbers of random features (default 200 500 1000; with --peers one number, 200)')
    parser.add_argument('--rounds', metavar='N', type=int, default=ROUNDS,
                        help=f'rounds in which the contenders take turns (default {ROUNDS})')
    parser.add_argument('--urdf', metavar='FILE', type=Path, help='another arm than the bundled iCub arm')
    parser.add_argument('--frame', metavar='NAME', default=FRAME, help=f'its sensor frame (default {FRAME})')
    options.add_json_option(parser)
    options.add_params_option(parser)
    parser.add_argument('--peers', metavar='BAG', nargs='?', const=BUNDLED,
                       help='predict, then learn, this recording (default: the bundled one) with our variants and with '
                            'learners of river and scikit-learn: errors and times in one table')
    parser.add_argument('--variant', metavar='V', action='append', dest='variants',
                       help='with --peers: variant of ours instead of all; may be repeated')


def run(args: argparse.Namespace) -> int:
    """Time every contender for every D in this one process, on one thread."""
    # Before numpy loads: several threads would favour the large dense recursion and hide what a node can afford.
    os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')
    from semiparam_ros.settings.robot_description import resolved

    options.require_places(args.json, inputs=[args.params, args.urdf, resolved(args.peers) if args.peers else None])
    if args.rounds < 1 or any(count < 2 or count % 2 for count in args.features or ()):
        raise SemiparamError('expected at least one round, and even numbers of features from 2 on.')
    if args.variants and not args.peers:
        raise SemiparamError('--variant chooses among those of --peers, which is missing.')
    if args.params and not args.peers:
        raise SemiparamError('--params configures the variants of --peers, which is missing.')
    for option, default in (('urdf', None), ('frame', FRAME), ('rounds', ROUNDS)) if args.peers else ():
        if getattr(args, option) != default:
            raise SemiparamError(f'--{option} is for times beside other recursions; expected none with --peers.')
    return beside_peers(args) if args.peers else timing(args)


def timing(args: argparse.Namespace) -> int:
    """Time every contender for every D."""
    from semiparam_ros.experiments.benchmark import arm

    body = arm(args.urdf or ARM, args.frame)
    with options.progress_bar() as progress:
        counts = args.features or [200, 500, 1000]
        task = progress.add_task('timing', total=args.rounds * len(counts))
        sizes = [size(body, count, args.rounds, lambda: progress.advance(task)) for count in counts]
    show(sizes)
    if args.json:
        options.write_json(args.json, {
            'command': 'bench', 'threads': 1, 'outputs': body.n_outputs,
            'inputs': 3 * body.n_joints, 'meaning': MEANING, 'sizes': sizes})
    return 0


def beside_peers(args: argparse.Namespace) -> int:
    """Score our variants and other packages' learners on one recording."""
    from semiparam_ros.cli.evaluate import chosen_variants, load_bags
    from semiparam_ros.experiments.peers import compare_with_peers
    from semiparam_ros.settings import load_params
    from semiparam_ros.settings.robot_description import resolved

    settings = load_params(args.params or (resolved(PARAMS) if args.peers == BUNDLED else None))
    counts = args.features or [200]
    if len(counts) > 1:
        raise SemiparamError(f'--features holds {len(counts)} numbers; expected one with --peers.')
    settings = replace(settings, features_count=counts[0])
    bag = load_bags([resolved(args.peers)], settings)[0]
    with options.progress_bar() as progress:
        task = progress.add_task('learning', total=None)
        scores = compare_with_peers(settings, bag.samples, bag.robot_description,
                                    chosen_variants(args.variants or ['all'], settings),
                                    lambda: progress.advance(task))
    show_scores(scores)
    if args.json:
        options.write_json(args.json, {
            'command': 'bench', 'threads': 1, 'bag': args.peers, 'features': counts[0],
            'learners': [score._asdict() for score in scores]})
    return 0


def show_scores(scores: Sequence[Score]) -> None:
    """One row for each learner, ours first."""
    from semiparam_ros.cli.evaluate import figure
    from semiparam_ros.experiments.peers import REFITTED_EVERY, REFITTED_ON

    table = options.plain_table()
    table.add_column('learner')
    table.add_column('sees')
    for heading in ('nMSE', 'us', 'window s'):
        table.add_column(heading, justify='right')
    for score in scores:
        table.add_row(score.learner, score.sees, figure(score.nmse_mean), f'{score.microseconds:.0f}',
                      f'{score.window_s:.2f}')
    options.output.print(table)
    for line in ('predict, then learn, from the end of the initial window on; one thread',
                 'nMSE: squared error over the variance of each output, mean over the outputs',
                 'us: prediction and learning of a sample, mean',
                 'window s: learning the initial window, of ours with the hyperparameters',
                 f'batch: fitted anew every {REFITTED_EVERY} samples, to the latest {REFITTED_ON}'):
        options.tell(line)


def size(body: RigidBody, count: int, rounds: int, tick: Callable[[], None]) -> dict[str, Any]:
    """Figures of D = ``count``: micro-seconds a sample of each contender, and the ratios to ours."""
    from semiparam_ros.experiments.benchmark import estimator, evidence_seconds, motion

    model = estimator(body, count)
    cases = [case(model, sample) for sample in motion(body, SAMPLES)]
    seconds = take_turns(contenders(model, count), cases, rounds, tick)
    median = {name: 1e6 * statistics.median(times) for name, times in seconds.items()}
    return {'features': count, 'columns': model.columns.n_columns,
            'unknowns': model.columns.n_columns + count * body.n_outputs, 'microseconds': median,
            'of_potter': median[OURS] / median[POTTER], 'of_covariance': median[OURS] / median[COVARIANCE],
            'dense_over_ours': median[DENSE] / median[OURS],
            'dense_together_over_ours': median[TOGETHER] / median[OURS],
            'evidence_seconds': evidence_seconds(body, count)}


def case(model: Estimator, sample: Sample) -> Case:
    """Columns and features ahead of time: the other recursions are timed without them."""

    features = model.model.features
    assert features is not None
    columns, _ = model.columns.one(sample, sample.stamp)
    return Case(sample, columns, features(sample.inputs))


def contenders(model: Estimator, count: int) -> dict[str, Contender]:
    """Contenders at D = ``count``; the dense one is so slow that one sample a round is enough."""
    from semiparam_ros.experiments.benchmark import Covariance, Dense, Potter

    covariance, potter = Covariance(count), Potter(count)
    dense, together = (Dense(model.columns.n_columns, count, model.body.n_outputs, each) for each in (False, True))
    return {
        OURS: Contender(lambda case: model.step(case.sample), BATCH),
        COVARIANCE: Contender(lambda case: covariance.update(case.phi), BATCH),
        POTTER: Contender(lambda case: potter.update(case.phi), BATCH),
        DENSE: Contender(lambda case: dense.update(case.columns, case.phi, case.sample.outputs), 1),
        TOGETHER: Contender(lambda case: together.update(case.columns, case.phi, case.sample.outputs), 1),
    }


def take_turns(contestants: dict[str, Contender], cases: Sequence[Case], rounds: int,
               tick: Callable[[], None]) -> dict[str, list[float]]:
    """Seconds of each timed sample for each contender; they alternate, so that a busy moment hurts them all."""
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(rounds):
        start = turn * BATCH
        batch = [cases[(start + index) % len(cases)] for index in range(BATCH)]
        for name, (learn, samples) in contestants.items():
            seconds[name] += timed(learn, batch[:samples])
        tick()
    return seconds


def timed(learn: Callable[[Case], object], batch: Sequence[Case]) -> list[float]:
    """Seconds of each sample, without the first ones of a batch, which find the caches full of another's matrices."""
    seconds = []
    for each in batch:
        start = time.perf_counter()
        learn(each)
        seconds.append(time.perf_counter() - start)
    return seconds[WARM_UP:] if len(seconds) > WARM_UP else seconds


def show(sizes: Sequence[dict[str, Any]]) -> None:
    """The figures as a table, one column for each D, with what each contender is."""
    from rich.table import Table

    table = Table(title='one thread, median micro-seconds a sample')
    table.add_column('')
    for row in sizes:
        table.add_column(f'D = {row["features"]}\n{row["unknowns"]} unknowns', justify='right')
    for name in MEANING:
        table.add_row(name, *(f'{row["microseconds"][name]:.0f}' for row in sizes))
    table.add_section()
    for name, key in RATIOS.items():
        table.add_row(name, *(f'{row[key]:.3g}' for row in sizes))
    table.add_section()
    table.add_row('evidence of 1000 samples [s]', *(f'{row["evidence_seconds"]:.2f}' for row in sizes))
    options.output.print(table)
    for name, meaning in MEANING.items():
        options.tell(f'{name}: {meaning}')
    options.tell('evidence: log marginal likelihood of the initial window and its gradient, once')
