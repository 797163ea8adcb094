"""Command `semiparam diagnose BAG...`: what the model lacks, and what adding it brings."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from semiparam_ros.atomic_write import write_text
from semiparam_ros.cli import options
from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from semiparam_ros.core.samples import Samples
    from semiparam_ros.diagnosis.diagnose import Diagnosis
    from semiparam_ros.effects import Effect
    from semiparam_ros.experiments.variants_with_effects import VariantErrors
    from semiparam_ros.settings import Settings

OF_BAGS = {'bags': 'BAG', 'params': '--params', 'judge': '--judge', 'inside': '--in', 'split': '--split',
           'output': '--output', 'html': '--html', 'variants': '--variants'}
"""Options that a diagnosis of recordings has and the scoreboard has not, by their names in the arguments."""

SCOREBOARD = {'outputs': 'wrench', 'sizes': [0.5, 1.0, 2.0], 'seeds': 10, 'first_seed': 0, 'samples': 4000,
              'estimate_accelerations': False}
"""Options that the scoreboard has and a diagnosis of recordings has not, by their names in the arguments, with what
they are when not given."""

HELP = 'Find what the model lacks in a recording, name the effect, add it, and show the error before and after.'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `semiparam diagnose`."""
    parser.add_argument('bags', metavar='BAG', nargs='*', type=Path,
                        help='recording (.mcap, rosbag2 directory, .db3, ROS 1 .bag); of several, each has an offset '
                        'of its wrench, and an effect may be in some of them alone')
    options.add_params_option(parser)
    parser.add_argument('--judge', metavar='BAG', type=Path,
                        help='judge before and after on this recording; otherwise on blocks left out of the fit')
    parser.add_argument('--in', metavar=('BAG', 'EFFECT'), nargs=2, action='append', default=[], dest='inside',
                        help='declare an effect in this recording alone, such as a load of known mass: '
                        """--in loaded.mcap 'payload@flange{"mass": 2.0}'; may be repeated""")
    parser.add_argument('--split', metavar='SHARE', type=float,
                        help='fit the first SHARE of the recording and judge on the rest (0.2 to 0.9)')
    parser.add_argument('--kinds', metavar='KIND', nargs='+', default=[], help='consider only these kinds of effects')
    parser.add_argument('--output', '-o', metavar='FILE.yaml', type=Path,
                        help='write the parameters with the effects added')
    parser.add_argument('--html', metavar='FILE.html', type=Path, help='write a page with figures')
    parser.add_argument('--variants', metavar='V', nargs='+', default=[],
                        help='also learn these variants with and without the effects, and judge them')
    parser.add_argument('--jobs', metavar='N', type=int, default=2,
                        help='variants, or diagnoses of the scoreboard, at a time (default: 2)')
    options.add_json_option(parser)
    scoreboard = parser.add_argument_group('scoreboard')
    scoreboard.add_argument('--benchmark', action='store_true',
                            help='diagnose simulated recordings with known hidden effects instead of a bag')
    scoreboard.add_argument('--outputs', choices=('wrench', 'effort'),
                            help='what is simulated (default: wrench)')
    scoreboard.add_argument('--sizes', metavar='S', type=float, nargs='+',
                            help='sizes of the hidden effects, as of semiparam simulate (default: 0.5 1 2)')
    scoreboard.add_argument('--seeds', metavar='N', type=int,
                            help='recordings of each kind and size (default: 10)')
    scoreboard.add_argument('--first-seed', metavar='N', type=int,
                            help='seed of the first of them (default: 0)')
    scoreboard.add_argument('--samples', metavar='N', type=int,
                            help='length of each recording (default: 4000)')
    scoreboard.add_argument('--estimate-accelerations', action='store_true', help='record no accelerations')
    parser.set_defaults(**SCOREBOARD)


def run(args: argparse.Namespace) -> int:
    """Diagnose one recording, or the simulator's."""
    read = [*args.bags, args.judge]
    options.require_places(args.json, args.output, args.html, inputs=read)
    options.require_places(args.json, args.html, inputs=[args.params])
    options.require_counts(args, 'jobs', 'seeds')
    if args.benchmark:
        for name, option in OF_BAGS.items():
            if getattr(args, name) not in (None, []):
                raise SemiparamError('--benchmark diagnoses recordings that it simulates; expected no '
                                     f'{option} beside it.')
        return _benchmark(args)
    if not args.bags:
        raise SemiparamError('diagnose needs a BAG, or --benchmark.')
    for name, default in SCOREBOARD.items():
        if getattr(args, name) != default:
            raise SemiparamError(f'--{name.replace("_", "-")} is for --benchmark, which is missing.')
    options.require_distinct(read)
    from semiparam_ros.cli.evaluate import chosen_variants
    from semiparam_ros.settings import load_params

    settings = load_params(args.params)
    chosen_variants(args.variants, settings)
    diagnosis = diagnose_bag(args, settings)
    variants = _evaluate_variants(args, settings, diagnosis)
    named = ', '.join(map(str, args.bags))
    result = diagnosis.as_dict() | {'command': 'diagnose', 'bag': named, 'variants': variants}
    show(diagnosis, variants, str(args.output or ''))
    if args.json:
        options.write_json(args.json, result)
    if args.output:
        write_parameters(args.output, settings, diagnosis)
    if args.html:
        from semiparam_ros.report.diagnosis_page import diagnosis_page
        write_text(args.html, diagnosis_page(diagnosis, variants, named, str(args.output or '')))
    for path in filter(None, (args.json, args.output, args.html)):
        options.tell(f'written: {path}')
    return 0


def diagnose_bag(args: argparse.Namespace, settings: Settings) -> Diagnosis:
    """Load what the options name and diagnose it, with progress on a terminal."""
    from semiparam_ros.bags.loading import description_in, require_same_robot
    from semiparam_ros.cli.evaluate import load_bags
    from semiparam_ros.core.samples import Samples
    from semiparam_ros.diagnosis.data.outliers import working_factor
    from semiparam_ros.diagnosis.data.recordings import whole_groups
    from semiparam_ros.diagnosis.data.splits import leading_split
    from semiparam_ros.diagnosis.diagnose import diagnose
    from semiparam_ros.diagnosis.preparation import most_samples, of_one_rate
    from semiparam_ros.settings.build import build_rigid_body, declared_effects

    if args.split is not None and not 0.2 <= args.split <= 0.9:
        raise SemiparamError(f'--split is {args.split}; expected a share from 0.2 to 0.9.')
    if args.split is not None and args.judge:
        raise SemiparamError('--split and --judge both say what judges; expected one of them.')
    if args.split is not None and len(args.bags) > 1:
        raise SemiparamError(f'--split cuts one recording in two, but there are {len(args.bags)}; name the one that '
                             'judges with --judge.')
    bags = load_bags(args.bags, settings, lambda rate: most_samples(rate) // len(args.bags))
    judges = load_bags([args.judge], settings, most_samples) if args.judge else []
    require_same_robot(settings, [*bags, *judges])
    for path, bag in zip([*args.bags, args.judge], [*bags, *judges], strict=False):
        if len(bag.stretches) > 1:
            options.console.print(
                f'{path} is long: {len(bag.stretches)} stretches of it are looked at, '
                f'{len(bag.samples)} samples evenly spread over {bag.samples.time[-1]:.0f} s.')
    body = build_rigid_body(settings, description_in([*bags, *judges]))
    options.remark(body)
    recordings, judging = ([whole_groups(bag.samples, working_factor(bag.samples), bag.stretches) for bag in some]
                           for some in (bags, judges))
    samples = recordings[0] if len(recordings) == 1 else Samples.joined(of_one_rate(recordings))
    train_mask = None if args.split is None else leading_split(len(samples), args.split)
    effects = [*declared_effects(settings), *declared_inside(args, samples)]
    with options.progress_bar() as bar:
        task = bar.add_task('reading', total=100)
        return diagnose(body, samples, effects, train_mask, (str(args.judge), judging[0]) if judging else None,
                        args.kinds,
                        lambda words, share: bar.update(task, description=words, completed=int(100 * share)),
                        names=[str(path) for path in args.bags])


def declared_inside(args: argparse.Namespace, samples: Samples) -> list[Effect]:
    """The effects that --in declares, each over the time of its recording."""
    from semiparam_ros.diagnosis.data.recordings import during
    from semiparam_ros.effects import effect_from_text

    effects = []
    for bag, text in args.inside:
        if Path(bag) not in args.bags:
            raise SemiparamError(f'--in names {bag!r}; expected one of the recordings '
                                 f'{", ".join(map(str, args.bags))}.')
        effects.append(during(samples, args.bags.index(Path(bag)), effect_from_text(text)))
    return effects


def write_parameters(path: Path, settings: Settings, diagnosis: Diagnosis) -> None:
    """The parameter file with every effect of the final model that lasts declared, each under what was found of it."""
    from semiparam_ros.diagnosis.text_report import remarks
    from semiparam_ros.effects import effects_to_parameters
    from semiparam_ros.settings import dump_params

    standing = diagnosis.standing
    effects, reference = effects_to_parameters(standing)
    dump_params(replace(settings, effects=effects, effects_reference=reference), path,
                remarks={'effects': [remarks(diagnosis, effect) for effect in standing]})


def _evaluate_variants(args: argparse.Namespace, settings: Settings, diagnosis: Diagnosis) -> dict[str, VariantErrors]:
    if not args.variants:
        return {}
    from semiparam_ros.cli.evaluate import chosen_variants
    from semiparam_ros.experiments.variants_with_effects import evaluate_variants

    with options.progress_bar() as bar:
        task = bar.add_task('variants', total=None)
        return evaluate_variants(settings, diagnosis, chosen_variants(args.variants, settings), args.jobs,
                                 lambda done, total: bar.update(task, completed=done, total=total))


def show(diagnosis: Diagnosis, variants: dict[str, VariantErrors], written: str = '') -> None:
    """Print the report. :param written: the parameter file that declares what was found; '' for none."""
    from semiparam_ros.diagnosis.text_report import error_text, next_step, table_rows, text_report
    from semiparam_ros.report.diagnosis_page import variant_rows

    if diagnosis.findings:
        found = options.plain_table()
        for heading in ('where', 'effect', 'values', 'when'):
            found.add_column(heading, overflow='fold')
        last = ''
        for row in table_rows(diagnosis):
            found.add_row('' if row.where == last else row.where, *row[1:])
            last = row.where
        options.output.print(found)
        options.output.print()
    for line in text_report(diagnosis):
        options.tell(line)
    table = options.plain_table('\noutput', ('nMSE\nbefore', '\nafter', 'RMSE\nbefore', '\nafter',
                                             'noise\nfloor'))
    rows = zip(diagnosis.first.body.output_names, diagnosis.first.body.output_units, diagnosis.before.nmse,
               diagnosis.after.nmse, diagnosis.before.rmse, diagnosis.after.rmse, diagnosis.noise_floor_rmse,
               strict=True)
    for name, unit, *figures, floor in rows:
        table.add_row(f'{name} [{unit}]', *map(error_text, figures), error_text(floor))
    options.output.print(table)
    for name, before, after, lower in variant_rows(variants):
        options.tell(f'{name}: held-out nMSE {before:.5f} without the effects, {after:.5f} with '
                     f'them{lower}.')
    if not variants and diagnosis.structure is not None and diagnosis.structure.significant:
        options.tell('What is left and follows the motion can be learnt all the same: --variants '
                     'SPK-ML judges it.')
    options.tell(f'Next: {next_step(diagnosis, written)}')


def _benchmark(args: argparse.Namespace) -> int:
    from semiparam_ros.experiments.scoreboard import Plan, print_scoreboard, scoreboard

    plan = Plan(args.outputs, tuple(args.kinds), tuple(args.sizes), args.seeds, args.samples, args.first_seed,
                not args.estimate_accelerations)
    with options.progress_bar() as bar:
        task = bar.add_task('diagnoses', total=plan.count)
        result = scoreboard(plan, args.jobs, lambda: bar.advance(task))
    print_scoreboard(options.output, result)
    if args.json:
        options.write_json(args.json, result)
        options.console.print(f'written: {args.json}')
    return 0
