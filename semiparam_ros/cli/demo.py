"""`make demo`: the node and the replay tool on real DDS, on a bundled recording, with a table and a plot at the end."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from semiparam_ros.errors import SemiparamError

SHARE = 'package://semiparam_ros'
DOMAINS = range(30, 60)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demonstration; 1 with a sentence when a sample is lost or a program fails."""
    os.environ.setdefault('OMP_NUM_THREADS', '1')  # read when numpy loads, hence the late imports
    args = _parser().parse_args(argv)
    try:
        from semiparam_ros.cli.demo_run import demonstrate

        demonstrate(args)
        return 0
    except SemiparamError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _parser() -> argparse.ArgumentParser:
    from semiparam_ros.settings.robot_description import resolved

    parser = argparse.ArgumentParser(prog='demo', description=__doc__)
    parser.add_argument('--bag', type=Path, default=resolved(f'{SHARE}/bags/icub_xy.mcap'))
    parser.add_argument('--params', type=Path, default=resolved(f'{SHARE}/config/icub_right_arm.yaml'))
    parser.add_argument('--undeclared', type=Path, default=resolved(f'{SHARE}/bags/icub_undeclared.mcap'),
                        help='recording with an effect that no model declares, for the diagnosis at the end')
    parser.add_argument('--output', type=Path, default=Path('output/demo'), help='folder for the results')
    parser.add_argument('--domain', type=int, default=DOMAINS[os.getpid() % len(DOMAINS)],
                        help='ROS_DOMAIN_ID (default: one that depends on the process)')
    return parser


if __name__ == '__main__':
    sys.exit(main())
