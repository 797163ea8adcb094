"""Diagnoses of causes that are of no listed kind: ``python benchmarks/unlisted_causes.py``.

Each is to be called unexplained, and no effects are to be told that only imitate it. ``--kinds`` takes listed ones too,
several at once as ``payload+joint_offset``: they are to be found.
"""

from __future__ import annotations

import argparse
import os
from itertools import product

os.environ.setdefault('OMP_NUM_THREADS', '1')

from rich.console import Console
from rich.table import Table

from clean_recordings import told
from semiparam_ros.experiments.scoreboard import TOGETHER, Plan, case
from semiparam_ros.simulation.causes import CAUSES, UNLISTED_KINDS


def main() -> None:
    """Print each verdict, and the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--kinds', nargs='+', default=UNLISTED_KINDS)
    parser.add_argument('--sizes', type=float, nargs='+', default=[1.0, 2.0])
    parser.add_argument('--samples', metavar='N', type=int, default=1500)
    parser.add_argument('--seeds', metavar='N', type=int, default=3)
    parser.add_argument('--first-seed', metavar='N', type=int, default=0)
    args = parser.parse_args()
    console, table = Console(), Table('cause', 'outputs', 'unexplained', 'effects told')
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for outputs, kind in product(('wrench', 'effort'), args.kinds):
        if not all(outputs in CAUSES[name].acts_on for name in kind.split(TOGETHER)):
            continue
        rows = []
        for size, seed in product(args.sizes, seeds):
            rows.append(case(Plan(outputs, (), (), 0, args.samples), kind, size, seed))
            console.print(f'{kind}, {outputs}, size {size:g}, seed {seed}: {told(rows[-1])}', highlight=False)
        table.add_row(kind, outputs, f'{sum(row["verdict"] == "unexplained" for row in rows)} of {len(rows)}',
                      f'{sum(len(row["found"]) for row in rows)}')
    console.print(table)


if __name__ == '__main__':
    main()
