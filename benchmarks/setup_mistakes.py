"""Mistakes of the set-up put into recordings of measured and simulated arms: ``python benchmarks/setup_mistakes.py``.

Any two efforts (of a wrench: channels, or axes of the sensor), positions or velocities swapped; one sign; and with
``--effects`` one gain, one zero, everything 20 ms late, which a diagnosis finds as effects. Each is to be told as what
it is, and of the recordings as they are nothing is to be told.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

import numpy as np
from rich.console import Console
from rich.table import Table

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.setup.checks import setup_problems
from windows import Recording, measured, simulated

SIMULATED = re.compile(r'^(UR10, cable|Panda, load)$')
GAINS, ZERO_RAD, LATE_S = (1.1, 0.5), 0.1, 0.02


class Mistake(NamedTuple):
    """What was done to a recording, and the word and the places with which it is to be told; ``kind`` of effect for
    those that are no check's."""

    group: str
    name: str
    samples: Samples
    what: str
    where: tuple[str | None, ...]
    is_effect: bool = False


def mistakes(body: RigidBody, samples: Samples) -> Iterator[Mistake]:
    """All swaps and signs."""
    wrench = body.outputs == 'wrench'
    rates = ('velocity',) if wrench else ('velocity', 'acceleration')  # only the iCub's accelerations are measured
    yield from _swaps(samples, ('position',), 'position_order', body.joints)
    yield from _swaps(samples, rates, 'velocity_order', body.joints)
    yield from _swaps(samples, ('outputs',), 'wrench_order' if wrench else 'effort_order', body.output_names)
    if wrench:
        for one, other in combinations(range(3), 2):
            order = _exchanged(3, one, other)
            yield Mistake('axes swapped', f'{"xyz"[one]}, {"xyz"[other]}', replace(
                samples, outputs=samples.outputs[:, [*order, *(3 + order)]]), 'wrench_axes', (body.sensor_frame,))
    for channel, name in enumerate(body.output_names):
        yield Mistake('a sign of an output', name, _times(samples, ('outputs',), channel, -1.0),
                      'wrench_sign' if wrench else 'effort_sign', (name,))
    for joint, name in enumerate(body.joints):
        yield Mistake('a sign of a velocity', name, _times(samples, rates, joint, -1.0), 'velocity_sign', (name,))
        yield Mistake('a sign of a position', name, _times(samples, ('position',), joint, -1.0), 'position_sign',
                      (name,))


def effects(body: RigidBody, samples: Samples) -> Iterator[Mistake]:
    """Gains, zeros and a delay."""
    wrench = body.outputs == 'wrench'
    for factor in GAINS:
        for channel, name in enumerate(body.output_names):
            yield Mistake(f'one gain, x{factor:g}', name, _times(samples, ('outputs',), channel, factor),
                          'sensor_gain' if wrench else 'effort_gain', (None if wrench else name,), True)
    for joint, name in enumerate(body.joints):
        position = samples.position.copy()
        position[:, joint] += ZERO_RAD
        yield Mistake('one zero', name, replace(samples, position=position), 'joint_offset', (name,), True)
    outputs = np.column_stack([np.interp(samples.time - LATE_S, samples.time, channel)
                               for channel in samples.outputs.T])
    yield Mistake('20 ms late', '', replace(samples, outputs=outputs), 'time_delay', (None,), True)


def _swaps(samples: Samples, roles: Sequence[str], what: str, names: Sequence[str]) -> Iterator[Mistake]:
    for one, other in combinations(range(len(names)), 2):
        order = _exchanged(len(names), one, other)
        yield Mistake(f'{roles[0]} swapped', f'{names[one]}, {names[other]}', replace(
            samples, **{role: getattr(samples, role)[:, order] for role in roles}), what, (names[one], names[other]))


def _exchanged(count: int, one: int, other: int) -> Array:
    order = np.arange(count)
    order[[one, other]] = other, one
    return order


def _times(samples: Samples, roles: Sequence[str], column: int, factor: float) -> Samples:
    factors = np.where(np.arange(getattr(samples, roles[0]).shape[1]) == column, factor, 1.0)
    return replace(samples, **{role: getattr(samples, role) * factors for role in roles})


def told(body: RigidBody, mistake: Mistake) -> tuple[bool, str]:
    """Whether it is told as what it is and as nothing else, and all that is told."""
    if mistake.is_effect:
        found = diagnose(body, mistake.samples)
        problems = [(problem.what, problem.where) for problem in found.setup]
        named = [(one.effect.kind, one.effect.where) for one in found.findings]
        kinds = (mistake.what, 'sensor_crosstalk') if mistake.what == 'sensor_gain' else (mistake.what,)
        right = not problems and any((kind, place) in named for kind in kinds for place in mistake.where)
        return right, ' '.join(f'{what}@{where}' for what, where in [*problems, *named])
    told = setup_problems(body, mistake.samples)
    right = len(told) == 1 and told[0].what == mistake.what and told[0].where in mistake.where
    if 'swapped' in mistake.group and 'axes' not in mistake.group:
        right = right and all(place in told[0].sentence for place in mistake.where if place)
    return right, ' '.join(f'{problem.what}@{problem.where}' for problem in told)


def chosen(data: Path, robots: Path | None, cache: Path) -> Iterator[Recording]:
    """The measured arms and two simulated ones."""
    yield from measured(data)
    if robots is not None:
        yield from simulated(robots, cache, SIMULATED)


def main() -> None:
    """Print what is not told as what it is, and the share that is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--data', type=Path, required=True, help='the measured arms')
    parser.add_argument('--robots', type=Path, help='needed for simulated arms')
    parser.add_argument('--cache', type=Path, default=Path(tempfile.gettempdir()) / 'windows_cache')
    parser.add_argument('--only', default='', help='recordings whose names match this expression')
    parser.add_argument('--effects', action='store_true', help='gains, zeros and delays in place of swaps and signs')
    parser.add_argument('--json', type=Path)
    args = parser.parse_args()
    console, rows, alarms = Console(width=160), [], []
    args.cache.mkdir(parents=True, exist_ok=True)
    for recording in chosen(args.data, args.robots, args.cache):
        if not re.search(args.only, recording.name):
            continue
        samples = recording.windows['whole']
        alarms.append((recording.name, [problem.what for problem in setup_problems(recording.body, samples)]))
        for mistake in (effects if args.effects else mistakes)(recording.body, samples):
            right, said = told(recording.body, mistake)
            rows.append({'recording': recording.name, 'group': mistake.group, 'name': mistake.name, 'right': right,
                         'told': said})
            if not right:
                console.print(f'{recording.name}, {mistake.group}, {mistake.name}: {said or "nothing"}',
                              highlight=False, soft_wrap=True)
    table = Table('mistake', *dict.fromkeys(row['recording'] for row in rows), 'all')
    for group in [*dict.fromkeys(row['group'] for row in rows), '']:
        own = [row for row in rows if group in ('', row['group'])]
        table.add_row(group or 'all', *(_counted([row for row in own if row['recording'] == name])
                                        for name in dict.fromkeys(row['recording'] for row in rows)), _counted(own))
    table.add_row('as it is: told', *(' '.join(problems) or 'nothing' for _, problems in alarms))
    console.print(table)
    if args.json:
        args.json.write_text(json.dumps({'rows': rows, 'untouched': alarms}, indent=1))


def _counted(rows: list[dict[str, Any]]) -> str:
    return f'{sum(row["right"] for row in rows)}/{len(rows)}' if rows else ''


if __name__ == '__main__':
    main()
