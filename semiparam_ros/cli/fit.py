"""Command `semiparam fit BAG`: hyperparameters once, for every later start and command."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semiparam_ros.cli import options
from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
    from semiparam_ros.experiments.initial_window import Estimation
    from semiparam_ros.settings import Settings

OF_SELECTION = {'method': ('quasi-newton', 'ml'), 'starts': (4, 'ml'), 'white_noise': (False, 'ml'),
                'grid_tau': (None, 'vs'), 'grid_ratio': (None, 'vs')}
"""Options of the estimation, by their names in the arguments, with what they are when not given and how a variant
chooses its hyperparameters to which they say something."""

HELP = 'Estimate the hyperparameters from the start of a recording and write a ROS parameter file with them.'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `semiparam fit`."""
    parser.add_argument('bag', metavar='BAG', type=Path,
                        help='recording; its first initial.samples are used (.mcap, rosbag2, .db3, ROS 1 .bag)')
    options.add_params_option(parser)
    parser.add_argument('--output', '-o', metavar='FILE.yaml', type=Path, required=True,
                        help='parameter file to write: those of --params with the hyperparameters filled in')
    parser.add_argument('--variant', metavar='V', help='variant to fit instead of the one in the parameters')
    add_estimation_options(parser)
    parser.add_argument('--jobs', metavar='N', type=int, default=2, help='searches at a time (default: 2)')
    options.add_json_option(parser)


def add_estimation_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the estimation, which `semiparam compare` has too."""
    group = parser.add_argument_group('estimation')
    group.add_argument('--method', choices=('quasi-newton', 'nelder-mead'), default='quasi-newton',
                       help='optimiser of the marginal likelihood (default: quasi-newton; the paper: nelder-mead)')
    group.add_argument('--starts', metavar='N', type=int, default=4, help='searches from different points (default: 4)')
    group.add_argument('--white-noise', action='store_true',
                       help='take the noise for white, as in the paper; otherwise it may drift slowly besides')
    group.add_argument('--grid-tau', metavar='T', type=float, nargs='+',
                       help='length scales that the VS variants try, in standard deviations of the inputs')
    group.add_argument('--grid-ratio', metavar='R', type=float, nargs='+',
                       help='ratios sigma / rho that the VS variants try')


def estimation_of(args: argparse.Namespace, variants: Sequence[str]) -> Estimation:
    """The checked options. Raises SemiparamError for a grid of one point, a count below one, or an option that says
    nothing to any of the variants."""
    from semiparam_ros.core.hyperparameters.validation import Grid
    from semiparam_ros.core.variants import VARIANTS, single
    from semiparam_ros.experiments.initial_window import Estimation

    options.require_counts(args, 'starts', 'jobs')
    selections = {VARIANTS[single(variant)].selection for variant in variants}
    for option, (default, selection) in OF_SELECTION.items():
        if getattr(args, option) != default and selection not in selections:
            heard = ', '.join(name for name, variant in VARIANTS.items() if variant.selection == selection)
            raise SemiparamError(f'--{option.replace("_", "-")} says nothing to {", ".join(variants)}; expected one of '
                                 f'{heard} beside it.')
    grid = Grid()
    if args.grid_tau or args.grid_ratio:
        grid = Grid(tuple(args.grid_tau or grid.tau), tuple(args.grid_ratio or grid.ratio))
    return Estimation(args.method, args.starts, args.jobs, not args.white_noise, grid)


def run(args: argparse.Namespace) -> int:
    """Fit, write the parameter file, and show what was found."""
    from semiparam_ros.cli.evaluate import chosen_variants, load_bags
    from semiparam_ros.core.initial_window import gathered_from
    from semiparam_ros.experiments.initial_window import fitted_settings
    from semiparam_ros.settings import dump_params, load_params
    from semiparam_ros.settings.build import build_rigid_body

    options.require_places(args.output, args.json, inputs=[args.bag])
    options.require_places(args.json, inputs=[args.params])
    settings = load_params(args.params)
    variants = chosen_variants([args.variant] if args.variant else None, settings)
    if len(variants) > 1:
        raise SemiparamError(f'--variant is {args.variant}; expected one of {", ".join(variants)}.')
    settings = replace(settings, variant=variants[0])
    estimation = estimation_of(args, variants)
    bag = load_bags([args.bag], settings)[0]
    options.remark(build_rigid_body(settings, bag.robot_description))
    gathered = gathered_from(bag.samples, settings.initial_samples)
    window = bag.samples[gathered.indices]
    if not gathered.full:
        options.console.print(f'{args.bag} holds {len(window)} samples of a robot that moves, one of each 4 ms, '
                              f'fewer than initial.samples ({settings.initial_samples}): all of them are used.')
    with options.progress_bar() as bar:
        task = bar.add_task(settings.variant, total=None)
        fitted, found = fitted_settings(settings, window, bag.robot_description, estimation,
                                        lambda done, total: bar.update(task, completed=done, total=total))
    dump_params(fitted, args.output)
    if args.json:
        options.write_json(args.json, result(args, settings, found, len(window)))
    _show(settings, found)
    options.tell(f'parameter file: {args.output}')
    return 0


def result(args: argparse.Namespace, settings: Settings, found: Hyperparameters, samples: int) -> dict[str, Any]:
    """Content of the JSON file."""
    from dataclasses import asdict

    return {'command': 'fit', 'bag': str(args.bag), 'variant': settings.variant, 'samples': samples,
            'parameter_file': str(args.output), 'hyperparameters': asdict(found)}


def _show(settings: Settings, found: Hyperparameters) -> None:
    from semiparam_ros.cli.evaluate import figure

    rows = [('variant', settings.variant)]
    for name in ('gamma', 'rho', 'tau', 'sigma', 'output_scale', 'pi'):
        value = getattr(found, name)
        values = value if isinstance(value, tuple) else (value,) if value else ()
        if values:
            rows.append((name, ' '.join(f'{value:.3g}' for value in values)))
    if settings.features_count == 'auto' and found.features:
        rows.append(('features', str(found.features)))
    if found.drift_share > 0.01:
        rows.append(('drift', f'{100 * found.drift_share:.0f} % of the noise variance is slow, with a memory of '
                              f'{figure(found.drift_memory)} samples'))
    if found.autocorrelation_time > 1.0:
        rows.append(('correlation', f'{figure(found.autocorrelation_time)} samples tell as much of the rigid body as '
                                    'one would if noise were white'))
    for name, text in rows:
        options.output.print(f'{name:13s} {text}')
