"""Command `semiparam compare TRAIN TEST`: the paper's experiment on two recordings, as one page."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from semiparam_ros.atomic_write import write_text
from semiparam_ros.cli import options
from semiparam_ros.cli.fit import add_estimation_options, estimation_of

if TYPE_CHECKING:
    from semiparam_ros.experiments.comparison import Comparison, ComparisonScenario

SHORT = {'first 60 s': '< 60 s', 'after 30 s': '> 30 s', 'learning': 'learn', 'frozen': 'frozen'}
"""Details of columns as a terminal has room for them; the others are on the page."""

HELP = 'Compare all models on a pair of recordings and write one HTML page with the figures and a verdict.'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `semiparam compare`."""
    parser.add_argument('train', metavar='TRAIN', type=Path,
                        help='recording whose start gives the hyperparameters and whose rest is learnt')
    parser.add_argument('test', metavar='TEST', type=Path, help='recording that is then predicted, in subsets')
    options.add_params_option(parser)
    parser.add_argument('--variant', metavar='V', action='append', dest='variants',
                        help='compare only this one; may be repeated (default: all seven)')
    parser.add_argument('--output', '-o', metavar='FILE.html', type=Path, default=Path('comparison.html'),
                        help='page to write (default: comparison.html)')
    options.add_json_option(parser)
    split = parser.add_argument_group('scenario')
    split.add_argument('--subsets', metavar='N', type=int, default=5,
                       help='parts of TEST, each started from the model that TRAIN left (default: 5)')
    split.add_argument('--subset-samples', metavar='N', type=int, help='length of each part (default: all of TEST)')
    split.add_argument('--train-samples', metavar='N', type=int, help='how much of TRAIN to use (default: all)')
    split.add_argument('--test-from', metavar='N', type=int, default=0,
                       help='first sample of TEST to use, so that one recording may serve as both (default: 0)')
    split.add_argument('--seeds', metavar='N', type=int, default=3,
                       help='feature draws, from features.seed on: a single one proves nothing (default: 3)')
    add_estimation_options(parser)
    work = parser.add_argument_group('work')
    work.add_argument('--jobs', metavar='N', type=int, default=2, help='processes at a time (default: 2)')
    work.add_argument('--scheduler', metavar='ADDRESS', help='Dask scheduler whose workers do it all (tcp://host:8786)')


def run(args: argparse.Namespace) -> int:
    """Compare, write the page, and show the table and the verdict."""
    from semiparam_ros.experiments.comparison import compare, steps
    from semiparam_ros.experiments.parallel import workers
    from semiparam_ros.report.comparison_page import as_dictionary, page

    options.require_places(args.output, args.json, inputs=[args.train, args.test, args.params])
    scenario = scenario_of(args)
    with workers(args.jobs, args.scheduler), options.progress_bar() as bar:
        task = bar.add_task('comparing', total=steps(scenario))
        comparison = compare(scenario, lambda: bar.advance(task))
    command = shlex.join(['semiparam', 'compare', *command_line(args)])
    text = page(comparison, args.train.name, args.test.name, command)
    if args.json:
        options.write_json(args.json, {'train': str(args.train), 'test': str(args.test),
                                       **as_dictionary(comparison)})
    write_text(args.output, text)
    show(comparison)
    if scenario.subsets[0][0] < len(scenario.train):
        options.remark_on_learnt([args.test], [args.train])
    options.tell(f'page: {args.output}')
    return 0


def scenario_of(args: argparse.Namespace) -> ComparisonScenario:
    """The checked scenario of the command line."""
    from semiparam_ros.cli.evaluate import chosen_variants, load_bags
    from semiparam_ros.experiments.comparison import scenario_from
    from semiparam_ros.settings import load_params

    options.require_counts(args, 'seeds')
    settings = load_params(args.params)
    variants = chosen_variants(args.variants or ['all'], settings)
    estimation = estimation_of(args, variants)
    train, test = load_bags([args.train, args.test], settings)
    seeds = range(settings.features_seed, settings.features_seed + args.seeds)
    return scenario_from(settings, train, test, subsets=args.subsets, subset_samples=args.subset_samples,
                         train_samples=args.train_samples, test_from=args.test_from, variants=variants, seeds=seeds,
                         estimation=estimation)


def command_line(args: argparse.Namespace) -> list[str]:
    """Words that give the same page again; the number of processes changes nothing."""
    words = [str(args.train), str(args.test)]
    for option, value in (('--params', args.params), ('--subset-samples', args.subset_samples),
                          ('--train-samples', args.train_samples)):
        words += [option, str(value)] if value is not None else []
    for variant in args.variants or []:
        words += ['--variant', variant]
    words += ['--subsets', str(args.subsets), '--seeds', str(args.seeds)]
    words += ['--test-from', str(args.test_from)] if args.test_from else []
    words += ['--method', args.method] if args.method != 'quasi-newton' else []
    words += ['--starts', str(args.starts)] if args.starts != 4 else []
    words += ['--white-noise'] if args.white_noise else []
    for option, values in (('--grid-tau', args.grid_tau), ('--grid-ratio', args.grid_ratio)):
        words += [option, *map(str, values)] if values else []
    return words


def show(comparison: Comparison) -> None:
    """The main columns of the table, the findings and the verdict, for a terminal of 80 columns."""
    from semiparam_ros.experiments.comparison import PARAMETRIC, verdict
    from semiparam_ros.report.comparison_page import cells, columns

    chosen = [column for column in columns(comparison)
              if column.detail in SHORT and column.heading != 'log density']
    table = options.plain_table('\nvariant', [f'{column.heading}\n{SHORT[column.detail]}'
                                              for column in chosen])
    for variant in comparison.figures:
        table.add_row(variant, *(cells(comparison, column)[variant].text for column in chosen))
    options.output.print(table)
    for finding in comparison.findings:
        word = 'open' if finding.holds is None else 'holds' if finding.holds else 'does not hold'
        options.output.print(f'{word}: {finding.statement} {finding.evidence}')
    options.output.print(verdict(comparison.figures, comparison.findings))
    if len(comparison.scenario.seeds) == 1 and set(comparison.figures) != {PARAMETRIC}:
        options.console.print('One feature draw proves little: --seeds 3 shows the spread.')
