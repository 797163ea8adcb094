"""Causes that act for a part of a recording: ``python benchmarks/put_down.py [--seeds N]``.

Two simulated recordings of one motion and one noise, with and without a cause, are joined to one
in which it is there until a time, between two times, or from a time on.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
from rich.console import Console
from rich.table import Table

from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate

SPANS = {'until': (None, 0.55), 'between': (0.3, 0.6), 'short': (0.4, 0.55), 'since': (0.6, None)}
"""Start and end as shares of the recording."""
NEAR_S = 0.15
"""Three samples."""


def judged(kind: str, outputs: str, seed: int) -> dict[str, bool]:
    """Of each span whether the cause alone is found, with its times."""
    with_it = simulate(Scenario(samples=1500, outputs=outputs, seed=seed,
                                effects=(EffectRequest(kind, start_s=0.0),)))
    plain = samples_of(simulate(Scenario(samples=1500, outputs=outputs, seed=seed)))
    right = {}
    for name, shares in SPANS.items():
        times = [None if share is None else share * float(plain.time[-1]) for share in shares]
        start, end = -np.inf if times[0] is None else times[0], times[1] or np.inf
        inside = (plain.time >= start) & (plain.time < end)
        seen = np.where(inside[:, None], samples_of(with_it).outputs, plain.outputs)
        found = [each.effect for each in diagnose(body_of(with_it), replace(plain, outputs=seen)).findings]
        told = [(effect.kind, effect.start_s, effect.end_s) for effect in found]
        if kind == 'sensor_offset' and name == 'until':
            times = times[::-1]  # the zero of a sensor is free: it jumped then
        right[name] = len(told) == 1 and told[0][0] == kind and all(map(_near, told[0][1:], times))
    return right


def _near(told: float | None, true: float | None) -> bool:
    if told is None or true is None:
        return told is true
    return abs(told - true) < NEAR_S


def main() -> None:
    """Print how many are right."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', metavar='N', type=int, default=2)
    parser.add_argument('--first-seed', metavar='N', type=int, default=1)
    parser.add_argument('--json', metavar='FILE', type=Path)
    options = parser.parse_args()
    runs = []
    table = Table('cause', 'outputs', *SPANS)
    for kind, outputs in (('payload', 'wrench'), ('payload', 'effort'), ('sensor_offset', 'wrench'),
                          ('external_force', 'wrench'), ('external_force', 'effort')):
        rows = [judged(kind, outputs, seed)
                for seed in range(options.first_seed, options.first_seed + options.seeds)]
        right = {name: sum(row[name] for row in rows) for name in SPANS}
        runs.append({'cause': kind, 'outputs': outputs, 'recordings': len(rows), 'right': right})
        table.add_row(kind, outputs, *(f'{count} of {len(rows)}' for count in right.values()))
    Console().print(table)
    if options.json:
        document = json.dumps({'command': 'put_down', 'runs': runs}, indent=1)
        options.json.write_text(document + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
