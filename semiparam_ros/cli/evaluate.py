"""Tables of results for the terminal, 80 columns wide."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from semiparam_ros.atomic_write import write_text
from semiparam_ros.cli import options
from semiparam_ros.errors import SemiparamError, shortened

if TYPE_CHECKING:
    from rich.progress import Progress

    from semiparam_ros.bags.loading import LoadedBag
    from semiparam_ros.core.robot.external_wrench import ExternalWrench
    from semiparam_ros.core.types import Array
    from semiparam_ros.experiments.evaluation import OfflineLearner, VariantScores
    from semiparam_ros.online.change_record import ChangeRecord
    from semiparam_ros.online.learner import Answer
    from semiparam_ros.settings import Settings

HEADINGS = {'eps_force': 'eps^F', 'eps_torque': 'eps^T', 'eps_effort': 'eps'}
WRENCH_HEADER = ','.join(['stamp_ns', *(f'{name}{part}' for part in ('', '_std')
                                        for name in ('fx', 'fy', 'fz', 'tx', 'ty', 'tz'))])
MOST_DIGITS = 18
"""Of a number of samples."""
PHASES = {'first_30_s': '< 30 s', 'steady_state': 'steady'}

HELP = 'Predict, then learn, every sample of recordings, and report the errors of one or several variants.'


def print_scores(console: Console, results: Mapping[str, Mapping[str, Any]]) -> None:
    """One row for each variant: nMSE, the horizon indices at first and in steady state, and the update time."""
    indices = [name for name in HEADINGS if any(result.get(name) for result in results.values())]
    phases = [f'{HEADINGS[name]}\n{phase}' for name in indices for phase in PHASES.values()]
    table = options.plain_table('\nvariant', ['\nnMSE', *phases, 'update\n[ms]', '\np99',
                                              '\nsamples'])
    for variant, result in results.items():
        values = [result[name][phase] for name in indices for phase in PHASES]
        times = result['update_ms'] or {'median': None, 'p99': None}
        table.add_row(variant, figure(result['nmse_mean']), *map(figure, values), figure(times['median']),
                      figure(times['p99']), str(result['samples']))
    console.print(table)


def print_outputs(console: Console, results: Mapping[str, Mapping[str, Any]], names: Sequence[str],
                  units: Sequence[str]) -> None:
    """One row for each output: the nMSE of every variant, and of a single variant the root mean square error too."""
    table = options.plain_table()
    table.add_column('\noutput', overflow='ellipsis', no_wrap=True, max_width=24)
    for variant in results:
        table.add_column(f'nMSE\n{variant}', justify='right', no_wrap=True)
    alone = next(iter(results.values())) if len(results) == 1 else None
    if alone:
        table.add_column('\nRMSE', justify='right', no_wrap=True)
    for index, name in enumerate(names):
        cells = [figure(result['nmse'][index]) for result in results.values()]
        table.add_row(name, *cells, *([f'{figure(alone["rmse"][index])} {units[index]}'] if alone else []))
    console.print(table)


def figure(value: float | None) -> str:
    """Text of three significant digits, or a dash where there is no number."""
    if value is None:
        return '-'
    return f'{value:.3g}' if value >= 1e-3 or value == 0.0 else f'{value:.1e}'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `semiparam evaluate`."""
    parser.add_argument('bags', metavar='BAG', nargs='+', type=Path,
                        help='recordings (.mcap, rosbag2 directory, .db3, ROS 1 .bag), one after the other')
    options.add_params_option(parser)
    parser.add_argument('--variant', metavar='V', action='append', dest='variants',
                        help='variant to evaluate instead of the one in the parameters; may be repeated; "all" for all')
    parser.add_argument('--train', metavar='BAG', type=Path, action='append', default=[],
                        help='learn this recording first, without scoring it; may be repeated')
    parser.add_argument('--frozen', action='store_true', help='predict without learning (needs --train)')
    parser.add_argument('--takeover-after', metavar='N[,N...]', default='0',
                        help='samples from the end of each window until the draft and then the model of it take over, '
                             'as in the node while it estimates hyperparameters, whose diagnostics tell them; the last '
                             'N holds for all that follow (default 0: at once)')
    parser.add_argument('--auto', choices=('off', 'report', 'apply'), default='off',
                        help='report: look for changes of the robot, and name them, as the node does with '
                             'diagnosis.auto; apply: and let them predict until they are over; of one variant '
                             '(default off)')
    options.add_json_option(parser)
    parser.add_argument('--series', action='store_true', help='add the indices over time to the JSON file')
    parser.add_argument('--external-wrench', metavar='FILE', type=Path,
                        help='write what acts from outside, as ~/external_wrench, as a table (.csv); of one variant')
    parser.add_argument('--plot', metavar='FILE', type=Path, help='plot both indices over time (.png, .svg or .pdf)')


def run(args: argparse.Namespace) -> int:
    """Evaluate every variant in turn on the same samples."""
    from semiparam_ros.bags.loading import description_in, require_same_robot
    from semiparam_ros.report.horizon_figure import picture_format
    from semiparam_ros.settings import load_params
    from semiparam_ros.settings.build import build_rigid_body

    options.require_places(args.json, args.plot, args.external_wrench,
                           inputs=[*args.bags, *args.train, args.params])
    if args.plot:
        picture_format(args.plot)
    settings = replace(load_params(args.params), diagnosis_auto=args.auto)
    variants = chosen_variants(args.variants, settings)
    waits = takeovers(args.takeover_after)
    check_options(args, len(variants))
    rows: list[str] | None = [] if args.external_wrench else None
    changes: dict[int, ChangeRecord] | None = None if args.auto == 'off' else {}
    training, bags = (load_bags(paths, settings, with_tools=True) for paths in (args.train, args.bags))
    require_same_robot(settings, [*bags, *training])
    body = build_rigid_body(replace(settings, joints=bags[0].joints), description_in([*bags, *training]))
    options.remark(body)
    with options.progress_bar() as progress:
        scores = {variant: evaluate(replace(settings, variant=variant), training, bags, args.frozen, progress,
                                    waits, rows, changes)
                  for variant in variants}
    results = {variant: score.result(args.series) for variant, score in scores.items()}
    print_scores(options.output, results)
    print_outputs(options.output, results, body.output_names, body.output_units)
    options.remark_on_learnt(args.bags, args.train, settings.learning and not args.frozen)
    if settings.features_count == 'auto':
        chosen = ', '.join(f'{result["features"]} ({variant})' for variant, result in results.items()
                           if result['features'])
        options.output.print(f'random features: {chosen or "none"}')
    for record in (changes or {}).values():
        options.output.print(record.sentence, highlight=False)
    write_outputs(args, results, scores, bags, body.output_names, changes)
    if rows is not None:
        write_text(args.external_wrench, '\n'.join([WRENCH_HEADER, *rows]) + '\n')
    return 0


def check_options(args: argparse.Namespace, variants: int) -> None:
    """Raise SemiparamError where an option needs another one, or is for fewer ``variants``."""
    if args.frozen and not args.train:
        raise SemiparamError('--frozen predicts with what was learnt from --train BAG, which is missing.')
    if args.series and not args.json:
        raise SemiparamError('--series adds to what goes to --json FILE, which is missing.')
    if args.external_wrench and variants > 1:
        raise SemiparamError(f'--external-wrench tells what one variant leaves; {variants} are evaluated.')
    if args.auto != 'off' and variants > 1:
        raise SemiparamError(f'--auto {args.auto} tells what changes for one variant; {variants} are evaluated.')


def takeovers(text: str) -> list[int]:
    """The numbers of samples in ``--takeover-after``."""
    numbers = text.split(',')
    if not all(number.isdecimal() and len(number) <= MOST_DIGITS for number in numbers):
        raise SemiparamError(f'--takeover-after is {shortened(text, 60)}; expected numbers of samples, such as 130 or '
                             '130,60.')
    return [int(number) for number in numbers]


def chosen_variants(asked: Sequence[str] | None, settings: Settings) -> list[str]:
    """Names of variants, checked and once each, as asked for; by default that of the settings."""
    from semiparam_ros.core.variants import VARIANTS, variant_named

    names = [name for word in asked or [settings.variant] for name in (VARIANTS if word == 'all' else [word])]
    for name in names:
        variant_named(name)
    return list(dict.fromkeys(names))


def load_bags(paths: Sequence[Path], settings: Settings, most: Callable[[float], int] | None = None,
              with_tools: bool = False) -> list[LoadedBag]:
    """The samples of each recording, without what the known tools add to them; what had to be left out is said on
    standard error.

    :param most: see load_samples. :param with_tools: as recorded, for a learner, which takes tools off itself.
    """
    from semiparam_ros.bags.loading import load_samples

    bags = [load_samples(path, settings, most=most) for path in paths]
    for path, bag in zip(paths, bags, strict=True):
        left_out = ', '.join(f'{count} {reason}' for reason, count in sorted(bag.faults.items()) if count)
        if left_out:
            options.console.print(f'{path}: left out {left_out}.')
        if bag.shared:
            options.console.print(bag.shared)
        if bag.losses:
            options.console.print(bag.losses.sentence)
    return bags if with_tools or not settings.tools else [_without_tools(bag, settings) for bag in bags]


def _without_tools(bag: LoadedBag, settings: Settings) -> LoadedBag:
    from semiparam_ros.core.robot.tools import Tools
    from semiparam_ros.settings.build import build_rigid_body, declared_effects

    body, samples = build_rigid_body(replace(settings, joints=bag.joints), bag.robot_description), bag.samples
    tools = Tools(body, settings.tools)
    tools.shaped_by(declared_effects(settings))
    return bag._replace(samples=replace(samples, outputs=samples.outputs - tools.outputs_of(samples)))


def evaluate(settings: Settings, training: Sequence[LoadedBag], bags: Sequence[LoadedBag], frozen: bool,
             progress: Progress, takeovers: Sequence[int] = (0,), wrenches: list[str] | None = None,
             changes: dict[int, ChangeRecord] | None = None) -> VariantScores:
    """Scores of one variant over ``bags``, from the first sample that it predicts itself.

    :param wrenches: receives a line of a table for each of these samples: what acts from outside.
    :param changes: receives what was told of changes of the robot, by their numbers.

    The initial window is answered by the rigid body alone, whatever the variant, and is not counted.
    Raises SemiparamError when the recordings are over before the initial window is, or none gives hyperparameters.
    """
    from semiparam_ros.core.robot.external_wrench import ExternalWrench
    from semiparam_ros.experiments.evaluation import OfflineLearner, VariantScores

    total = sum(len(bag.samples) for bag in [*training, *bags])
    task = progress.add_task(settings.variant, total=total)
    offline = OfflineLearner(settings, [*bags, *training], lambda: progress.advance(task), takeovers)
    if changes is not None:
        offline.on_change = lambda record: changes.update({record.change.number: record})
    for bag in training:
        offline.take(bag, VariantScores(settings.outputs), learning=True)
    offline.finish(training, frozen)
    scores = VariantScores(settings.outputs)
    if wrenches is not None:
        external = ExternalWrench(offline.estimator.body, settings.external_wrench_frame)
        external.shaped_by(offline.estimator.columns.effects)
        offline.on_answer = _writer_of(wrenches, external)
    for bag in bags:
        offline.take(bag, scores, settings.learning and not frozen)
    if not len(scores):
        raise SemiparamError(_why_none(offline, settings, [*training, *bags], takeovers))
    for reason in offline.learner.failed_windows:
        options.console.print(f'{settings.variant}: an initial window gives no hyperparameters '
                              f'({reason}); another one is gathered.')
    return scores


def _why_none(offline: OfflineLearner, settings: Settings, bags: Sequence[LoadedBag], takeovers: Sequence[int]) -> str:
    """Why the variant itself predicted none of the samples."""
    from semiparam_ros.core.motion import moving

    total = sum(len(bag.samples) for bag in bags)
    if offline.learner.failed_windows:
        return (f'{settings.variant}: no initial window gives hyperparameters, the last one because '
                f'{offline.learner.failed_windows[-1]}.')
    if offline.estimator.ready and any(takeovers):
        return (f'the recordings end, after {total} samples, before the model takes over; expected a smaller '
                f'--takeover-after than {",".join(map(str, takeovers))}.')
    moved = sum(int(moving(bag.samples).sum()) for bag in bags)
    return (f'the robot moves in {moved} of {total} samples, which are too few: the initial window alone takes '
            f'{settings.initial_samples} of motion, one of each 4 ms (parameter initial.samples).')


def _writer_of(rows: list[str], external: ExternalWrench) -> Callable[[Answer, Array], None]:
    """Return a function that appends a line for each answer of the variant's own."""
    def append(answer: Answer, widening: Array) -> None:
        if answer.prediction.ready:
            found = external.of(answer.prediction, answer.residual, widening, answer.followed)
            numbers = [*found.wrench.tolist(), *found.std.tolist()]
            rows.append(','.join([str(answer.prediction.sample.stamp), *map(repr, numbers)]))
    return append


def events_of(records: Iterable[ChangeRecord], scores: VariantScores) -> list[tuple[float, str]]:
    """Times [s] in the series of scores at which something happened to changes of the robot, and what; nothing of
    recordings that were learnt before."""
    return [(time_s, what) for record in records for stamp, what in record.events
            if (time_s := scores.time_of(stamp)) >= 0.0]


def write_outputs(args: argparse.Namespace, results: dict[str, dict[str, Any]], scores: dict[str, VariantScores],
                  bags: Sequence[LoadedBag], channels: Sequence[str],
                  changes: Mapping[int, ChangeRecord] | None = None) -> None:
    """The JSON file and the plot, where asked for."""
    if args.json:
        options.write_json(args.json, {
            'command': 'evaluate', 'bags': [str(path) for path in args.bags],
            'train': [str(path) for path in args.train], 'frozen': args.frozen, 'outputs': list(channels),
            'variants': results,
            'changes': None if changes is None else [record.as_dict() for record in changes.values()],
            'left_out': [dict(bag.faults) for bag in bags],
            'losses': [bag.losses.sentence for bag in bags]})
    if args.plot:
        from semiparam_ros.report.horizon_figure import plot_indices

        first = next(iter(scores.values()))  # changes are told of one variant
        plot_indices(args.plot, scores, events_of((changes or {}).values(), first))
        options.console.print(f'plot: {args.plot}')
