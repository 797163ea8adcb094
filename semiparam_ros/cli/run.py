"""`semiparam run`: the node `estimator`."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = 'Run the node estimator: learn and predict live.'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """One option of ours; remappings and everything else of ROS follow --ros-args."""
    parser.add_argument('--params', metavar='FILE', type=Path,
                        help='ROS parameter file (YAML); the same as --ros-args --params-file FILE')


def run(args: argparse.Namespace) -> int:
    """Check the file, for rcl says little of what is wrong in one; then start the node."""
    from semiparam_ros.ros.process import run_estimator
    from semiparam_ros.settings.files import read_params

    ros_arguments = list(args.ros_args)
    if args.params is not None:
        if not any(argument.startswith('__node:=') for argument in ros_arguments):
            read_params(args.params)
        ros_arguments += ['--ros-args', '--params-file', str(args.params)]
    return run_estimator(ros_arguments)
