"""Command `semiparam run`: the node `estimator`."""

from __future__ import annotations

import argparse
import gc
from collections.abc import Sequence
from pathlib import Path

HELP = 'Run the node estimator: learn and predict live.'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """One option of ours; remappings and everything else of ROS follow --ros-args."""
    parser.add_argument('--params', metavar='FILE', type=Path,
                        help='ROS parameter file (YAML); the same as --ros-args --params-file FILE. Everything else of '
                        'ROS follows --ros-args: --ros-args -r wrench:=/ft/raw')


def run(args: argparse.Namespace) -> int:
    """Check the file, for rcl says little of what is wrong in one; then start the node."""
    ros_arguments = list(args.ros_args)
    if args.params is not None:
        check_file(args.params, ros_arguments)
        # before the rest: of two values of a parameter rcl takes the later one
        ros_arguments = ['--ros-args', '--params-file', str(args.params), '--', *ros_arguments]
    gc.disable()  # what is loaded stays for good: to look through it meanwhile takes a tenth of the start
    from semiparam_ros.ros.estimator.process import run_estimator  # after the check, which then answers at once

    gc.enable()
    return run_estimator(ros_arguments)


def check_file(path: Path, ros_arguments: Sequence[str]) -> None:
    """Check each value by itself: rules across them are for the node, which has them all.

    Raises SemiparamError, naming the file.
    """
    from semiparam_ros.settings.files import read_params
    from semiparam_ros.settings.snapshot import Settings

    rules = [argument.split(':=', 1) for argument in ros_arguments if ':=' in argument]
    name = next((to for rule, to in rules if rule.removeprefix('estimator:') in ('__node', '__name')), 'estimator')
    namespace = next((to for rule, to in rules if rule.removeprefix(f'{name}:') == '__ns'), '')
    names = [*namespace.split('/'), name]
    Settings().changed(read_params(path, '/' + '/'.join(filter(None, names))), where=str(path))
