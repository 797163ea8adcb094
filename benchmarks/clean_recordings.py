"""Diagnoses of simulated recordings in which nothing is hidden: ``python benchmarks/clean_recordings.py``.

Every rate with every colour of noise, of wrench and effort, with measured and with estimated accelerations. Whatever is
found there is a false alarm. What is found is printed as it comes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from itertools import product

from joblib import Parallel, delayed
from rich.console import Console
from rich.table import Table

from semiparam_ros.experiments.scoreboard import NOTHING, Plan, ScoreboardRow, case

console = Console()


def main() -> None:
    """Diagnose them all and print the share of false alarms, in all and by what differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rates', metavar='HZ', type=float, nargs='+', default=[20.0, 50.0, 100.0, 200.0])
    parser.add_argument('--correlations', metavar='S', type=float, nargs='+', default=[0.0, 0.2, 2.0],
                        help='times over which the noise of the outputs is correlated [s]; 0: white')
    parser.add_argument('--seconds', metavar='S', type=float, default=100.0, help='length of a recording')
    parser.add_argument('--seeds', metavar='N', type=int, default=3, help='recordings of each')
    parser.add_argument('--first-seed', metavar='N', type=int, default=0)
    parser.add_argument('--jobs', metavar='N', type=int, default=1)
    args = parser.parse_args()
    plans = [(Plan(outputs, (), (), 0, round(args.seconds * rate), accelerations=measured, rate_hz=rate,
                   noise_correlation_s=correlation), seed)
             for seed, rate, correlation, outputs, measured in product(
                 range(args.first_seed, args.first_seed + args.seeds), args.rates, args.correlations,
                 ('wrench', 'effort'), (True, False))]
    rows = Parallel(n_jobs=args.jobs, return_as='generator')(delayed(case)(plan, NOTHING, 0.0, seed)
                                                             for plan, seed in plans)
    count, alarms = Counter[str](), Counter[str]()
    for (plan, seed), row in zip(plans, rows, strict=True):
        labels = ('all', plan.outputs, f'{plan.rate_hz:g} Hz', f'noise correlated over {plan.noise_correlation_s:g} s',
                  f'accelerations {"measured" if plan.accelerations else "estimated"}')
        count.update(labels)
        if row['verdict'] != 'nothing_missing':
            alarms.update(labels)
            console.print(f'seed {seed}, {", ".join(labels[1:])}: {told(row)}', highlight=False)
    table = Table('recordings', 'number', 'false alarms')
    for label in count:
        table.add_row(label, str(count[label]), str(alarms[label]))
    console.print(table)


def told(row: ScoreboardRow) -> str:
    """The verdict and what was found."""
    places = [f'{kind}@{where}' for kind, where in zip(row['found'], row['found_where'], strict=True)]
    return ' '.join([row['verdict'], *places])


if __name__ == '__main__':
    main()
