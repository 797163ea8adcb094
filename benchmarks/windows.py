"""Diagnoses of windows of recordings: ``python benchmarks/windows.py --data DATA --robots ROBOTS``.

DATA holds the measured arms as ``benchmarks/measured_arms.py`` wants them, ROBOTS is the folder ``robots`` of
example-robot-data. Each recording is diagnosed whole, by its first, middle and last 60 %, by its halves, with rests of
3 and 20 s in it, and joined with another motion. Of twenty recordings MuJoCo knows what was hidden; a cause counts as
visible in a window where a model of all hidden causes needs it (``VISIBLE_NATS``). Held-out errors stand beside those
of the plain least-squares model on the same samples. To measure another state of the package, put it in PYTHONPATH.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

import numpy as np
from joblib import Parallel, delayed
from rich.console import Console
from rich.table import Table

from measured_arms import cases
from mujoco_arms import (
    KINOVA,
    PANDA,
    PANDA_HOME,
    PANDA_URDF,
    UR,
    UR10,
    UR_HOME,
    XARM,
    XARM7,
    XARM_HOME,
    Setting,
    recorded,
)
from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.data.outliers import counted_outputs, excluded
from semiparam_ros.diagnosis.diagnose import Diagnosis, diagnose
from semiparam_ros.diagnosis.evaluation import evaluate_there
from semiparam_ros.effects import Effect, kinds
from semiparam_ros.effects.base import Span
from semiparam_ros.errors import SemiparamError
from support.mujoco_arm import Robot
from support.plain_model import plain_model

VISIBLE_NATS = 12.0
"""Log evidence from which a window shows a cause to whoever knows all the others."""
SURE_DEVIATIONS = 2.0
NEAR_S = 1.0
RESTS_S = (3.0, 20.0)
NAMED_BY = {'coulomb_friction': ('coulomb_friction', 'stribeck_friction', 'asymmetric_friction'),
            'viscous_friction': ('viscous_friction', 'asymmetric_friction')}
"""Kinds that name a hidden one beside itself."""

console = Console(width=200)


class Recording(NamedTuple):
    """A robot, what it recorded by the names of windows, what is hidden, and another recording that judges too."""

    name: str
    body: RigidBody
    windows: dict[str, Samples]
    hidden: tuple[Effect, ...] = ()
    truth: tuple[dict[str, float], ...] = ()
    other: Samples | None = None


# --- windows ---


def windows(whole: Samples, rested: dict[str, Samples], other: Samples | None) -> dict[str, Samples]:
    """All windows of a recording by name."""
    count = len(whole)
    parts = {'whole': (0.0, 1.0), 'first 60 %': (0.0, 0.6), 'middle 60 %': (0.2, 0.8), 'last 60 %': (0.4, 1.0),
             'first half': (0.0, 0.5), 'second half': (0.5, 1.0)}
    found = {name: whole[round(start * count):round(end * count)] for name, (start, end) in parts.items()} | rested
    return found if other is None else found | {'joined': Samples.joined([whole, other])}


def with_rests(samples: Samples, rest_s: float) -> Samples:
    """The arm stands still for ``rest_s`` where it is slowest about a third, and about two thirds, of the recording."""
    step = round(float(np.median(np.diff(samples.stamps))))
    speed = np.linalg.norm(samples.velocity / (np.abs(samples.velocity).max(axis=0) + 1e-12), axis=1)
    count, still = len(samples), round(rest_s * 1e9 / step)
    places = [start + int(speed[start:start + count // 3].argmin()) for start in (count // 6, count // 2)]
    order = np.sort(np.concatenate([np.arange(count), *(np.full(still, place) for place in places)]))
    held = np.diff(order, prepend=-1) == 0
    rng, found = np.random.default_rng(0), {}
    for name in ('position', 'velocity', 'acceleration', 'outputs'):
        values = getattr(samples, name)
        noise = np.diff(values, n=2, axis=0).std(axis=0) / np.sqrt(6.0)  # of white noise; too much where motion is fast
        noise = np.minimum(noise, np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0))
        rested = values[order].copy()
        if name in ('velocity', 'acceleration'):
            rested[held] = 0.0
        rested[held] += noise * rng.standard_normal((int(held.sum()), values.shape[1]))
        found[name] = rested
    added = np.cumsum(held) * step
    return replace(samples, stamps=samples.stamps[order] + added, **found)


# --- recordings ---


def measured(data: Path) -> Iterator[Recording]:
    """The UR3, the Franka and the iCub."""
    with tempfile.TemporaryDirectory() as folder:
        known = {case.name: case for case in cases(data, Path(folder))}
    pairs = [('UR3 id1', 'UR3 id1, judged on id2'), ('UR3 id2', 'UR3 id2, judged on id1'), ('Franka', 'Franka, blocks'),
             ('iCub train', 'iCub train, judged on test'), ('iCub test', 'iCub train, judged on test')]
    for name, key in pairs:
        case = known[key]
        whole, other = case.samples, case.other
        if name == 'iCub test':
            assert other is not None
            whole, other = other, whole
        rested = {f'{rest_s:g} s of rest': with_rests(whole, rest_s) for rest_s in RESTS_S}
        yield Recording(name, case.body, windows(whole, rested, other), other=other)


BASES = {
    'xArm7': Setting('xArm7', XARM7, XARM, XARM_HOME, (3.0, 3.0, 2.0, 2.0, 1.0, 0.8, 0.5), carrier='link7', seed=101),
    'UR10': Setting('UR10', UR10, UR, UR_HOME, (12.0, 12.0, 8.0, 3.0, 3.0, 2.0), carrier='wrist_3_link',
                    noise_colour=0.5, seed=102),
    'Panda': Setting('Panda', PANDA_URDF, PANDA, PANDA_HOME, (0.5, 0.6, 0.4, 0.5, 0.3, 0.3, 0.2), noise_colour=0.8,
                     seed=103),
    'Kinova': Setting('Kinova', 'kinova_description/robots/kinova.urdf', KINOVA, (0.0, 2.6, 1.3, 0.5, 1.0, 0.2),
                      (2.0, 3.0, 2.0, 0.7, 0.7, 0.5), carrier='j2s6s200_link_6', noise=0.02, seed=104)}
LATE: dict[str, Any] = {'late_s': 0.02}


def _at(joint: int, value: float, count: int) -> tuple[float, ...]:
    return tuple(value if number == joint else 0.0 for number in range(count))


HIDDEN: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
    ('xArm7', 'load', 'sines', {'payload_kg': 1.0}), ('UR10', 'gain', 'points', {'gains': _at(2, 0.12, 6)}),
    ('Panda', 'late', 'sines', LATE), ('Kinova', 'zero', 'points', {'zeros': _at(2, 0.05, 6)}),
    ('xArm7', 'late and load', 'points', LATE | {'payload_kg': 1.0}),
    ('UR10', 'cable', 'circles', {'stiffness': _at(2, 40.0, 6)}),
    ('Panda', 'load and zero', 'points', {'payload_kg': 1.0, 'zeros': _at(3, 0.05, 7)}),
    ('Kinova', 'friction', 'sines', {}),
    ('xArm7', 'friction', 'points', {}), ('xArm7', 'late', 'circles', LATE),
    ('xArm7', 'zero', 'sines', {'zeros': _at(1, -0.05, 7)}),
    ('UR10', 'load', 'in turn', {'payload_kg': 3.0}), ('UR10', 'late', 'sines', LATE),
    ('UR10', 'cable and gain', 'sines', {'stiffness': _at(1, 60.0, 6), 'gains': _at(4, -0.15, 6)}),
    ('Panda', 'load', 'points', {'payload_kg': 0.7}), ('Panda', 'cable', 'sines', {'stiffness': _at(3, 6.0, 7)}),
    ('Panda', 'gain', 'circles', {'gains': _at(3, 0.12, 7)}), ('Kinova', 'load', 'sines', {'payload_kg': 0.8}),
    ('Kinova', 'late', 'points', LATE),
    ('Kinova', 'late and cable', 'circles', LATE | {'stiffness': _at(1, 8.0, 6)}))
"""Arm, what is hidden beside friction and rotors, motion, and how."""
OTHER_MOTION = {'sines': 'points', 'points': 'circles', 'circles': 'sines', 'in turn': 'sines'}


def simulated(robots: Path, cache: Path, wanted: re.Pattern[str], seed: int = 0) -> Iterator[Recording]:
    """Those of the twenty recordings whose names match. Another seed: other masses, motions and noise."""
    for number, (arm, hidden, motion, how) in enumerate(HIDDEN):
        name = f'{arm}, {hidden}'
        if not wanted.search(name):
            continue
        setting = replace(BASES[arm], name=name, motion=motion, rate_hz=100,
                          seed=BASES[arm].seed + 10 * number + seed, **how)
        robot = Robot((robots / setting.urdf).read_text(), setting.joints, setting.home)
        other = replace(setting, motion=OTHER_MOTION[motion], seconds=30.0, payload_kg=0.0)
        whole = _cached(cache, setting, robot)
        rested = {f'{rest_s:g} s of rest': _cached(cache, replace(setting, rest_s=rest_s), robot)
                  for rest_s in RESTS_S}
        effects, truth = _causes(setting)
        yield Recording(name, robot.body, windows(whole, rested, _cached(cache, other, robot, 1)), effects, truth)


def _cached(cache: Path, setting: Setting, robot: Robot, take: int = 0) -> Samples:
    """The recording from the folder, or simulated and put there."""
    name = f'{setting.name} {setting.motion} rest {setting.rest_s:g} take {take} seed {setting.seed}'
    key = re.sub(r'\W+', '_', name)
    file = cache / f'{key}.pickle'
    if not file.exists():
        made = recorded(setting, robot, take)
        arrays = (made.stamps, made.position, made.velocity, made.acceleration, made.outputs, made.origin)
        file.write_bytes(pickle.dumps(arrays))
    return Samples(*pickle.loads(file.read_bytes()))


def _causes(setting: Setting) -> tuple[tuple[Effect, ...], tuple[dict[str, float], ...]]:
    """What is hidden: effects with their calibrations, and all values that a diagnosis should give. The load's start
    follows with the window."""
    found: list[tuple[str, str | None, dict[str, float]]] = []
    for number, (joint, dry) in enumerate(zip(setting.joints, setting.friction, strict=True)):
        found += [('coulomb_friction', joint, {'coulomb': dry}),
                  ('viscous_friction', joint, {'viscous': dry * setting.viscous_share}),
                  ('rotor_inertia', joint, {'inertia': setting.armature})]
        for kind, name, values in (('joint_spring', 'stiffness', setting.stiffness),
                                   ('effort_gain', 'gain', setting.gains), ('joint_offset', 'offset', setting.zeros)):
            if values and values[number]:
                found.append((kind, joint, {name: values[number]}))
    if setting.late_s:
        found.append(('time_delay', None, {'delay_s': setting.late_s}))
    if setting.payload_kg:
        found.append(('payload', setting.carrier, {'mass': setting.payload_kg}))
    effects = []
    for kind, where, values in found:
        own = {coefficient.name for coefficient in kinds()[kind].calibrations}
        turn = {'turn_speed': 0.01} if kind == 'coulomb_friction' else {}
        effects.append(kinds()[kind](where, {name: values[name] for name in own & values.keys()} | turn))
    return tuple(effects), tuple(values for _, _, values in found)


# --- what a window shows ---


def in_window(recording: Recording, window: str) -> list[Effect]:
    """The hidden effects, the load with the time at which it is picked up."""
    samples, whole = recording.windows[window], recording.windows['whole']
    base = samples if 'rest' in window else whole
    start_s = 0.5 * len(base) * float(np.median(np.diff(base.stamps))) * 1e-9
    end_s = (samples.breaks[0] - samples.origin) * 1e-9 if samples.breaks else None
    return [replace(effect, span=Span(start_s, end_s=end_s)) if effect.is_load else effect
            for effect in recording.hidden]


def evidence(body: RigidBody, samples: Samples, counted: Mask, effects: Sequence[Effect]) -> list[float]:
    """[nat] for each effect in the model of them all: gain of the likelihood at the effective number of samples, less
    what its coefficients cost (Schwarz)."""
    own, residual = _fitted(body, samples, counted, effects)
    rho = np.array([np.corrcoef(left[:-1], left[1:])[0, 1] for left in residual.T])
    effective = counted.sum(axis=0) * (1.0 - np.maximum(rho, 0.0)) / (1.0 + np.maximum(rho, 0.0))
    left = np.sum(residual**2, axis=0)
    weight = np.sqrt(counted.sum(axis=0) / left)
    found = []
    for index, effect in enumerate(effects):
        others = [one for number, one in enumerate(effects) if number != index]
        fewer, worse = _fitted(body, samples, counted, others, weight)
        spent = len(effect.calibrations) + own - fewer
        gain = 0.5 * float(effective @ np.log(np.sum(worse**2, axis=0) / left))
        found.append(gain - 0.5 * spent * float(np.log(effective.sum())))
    return found


def _fitted(body: RigidBody, samples: Samples, counted: Mask, effects: Sequence[Effect],
            weight: Array | None = None) -> tuple[int, Array]:
    """Rank of least squares, and (N, n) what they leave where outputs count, zero elsewhere."""
    if weight is None:
        _, residual = _fitted(body, samples, counted, effects, 1.0 / samples.outputs.std(axis=0))
        weight = np.sqrt(counted.sum(axis=0) / np.sum(residual**2, axis=0))
    columns, _ = CoupledColumns(body, effects).batch(samples)
    rows = (columns * (counted * weight)[:, :, None]).reshape(-1, columns.shape[2])
    rows = rows / (size := np.linalg.norm(rows, axis=0) + 1e-12)
    moment = rows.T @ (samples.outputs * counted * weight).ravel()
    theta, _, rank, _ = np.linalg.lstsq(rows.T @ rows, moment, rcond=1e-9)
    return int(rank), (samples.outputs - columns @ (theta / size)) * counted


# --- one window ---


def diagnosed(recording: Recording, window: str) -> dict[str, Any]:
    """Diagnosis and judgement of one window."""
    samples = recording.windows[window]
    start = time.perf_counter()
    base = {'recording': recording.name, 'window': window, 'samples': len(samples)}
    try:
        found = diagnose(recording.body, samples)
    except SemiparamError as error:
        return base | {'error': str(error), 'seconds': time.perf_counter() - start}
    seconds = time.perf_counter() - start
    effects = [_effect(finding) for finding in found.findings]
    first, everything = found.first, found.first.train_mask | found.held_out
    hidden = in_window(recording, window)
    counted = everything[:, None] & first.counted
    nats = evidence(recording.body, first.samples, counted, hidden) if hidden else []
    causes = [_cause(effect, truth, nat, effects)
              for effect, truth, nat in zip(hidden, recording.truth, nats, strict=True)]
    return base | {'verdict': found.verdict, 'setup': [problem.what for problem in found.setup], 'seconds': seconds,
                   'motion': found.inputs.motion, 'found': effects, 'hidden': causes,
                   'errors': errors(found, None) | (errors(found, recording.other) if recording.other is not None
                                                    and window != 'joined' else {})}


def _effect(finding: Any) -> dict[str, Any]:
    """Kind, place, values with deviations, and what it cannot be told from."""
    values = {name: {'value': one.value, 'std': one.std} for name, one in finding.parameters.items()}
    return {'kind': finding.effect.kind, 'where': finding.effect.where, 'start_s': finding.effect.start_s,
            'gain': finding.log_evidence_gain, 'values': values,
            'group': [[rival.effect.kind, rival.effect.where] for rival in finding.rivals]}


def _cause(effect: Effect, truth: dict[str, float], nats: float, found: list[dict[str, Any]]) -> dict[str, Any]:
    """Whether a hidden cause is visible, named, in a group, and how many deviations its values are off."""
    named = [one for one in found if _names(effect.kind, effect.where, one['kind'], one['where'])
             and (effect.start_s is None or (one['start_s'] is not None
                  and abs(one['start_s'] - effect.start_s) < NEAR_S))]
    group = any(_names(effect.kind, effect.where, *rival) for one in found for rival in one['group'])
    off = {name: (one['values'][name]['value'] - value) / (one['values'][name]['std'] or np.inf)
           for one in named[:1] if one['kind'] == effect.kind for name, value in truth.items() if name in one['values']}
    return {'kind': effect.kind, 'where': effect.where, 'start_s': effect.start_s, 'truth': truth, 'nats': nats,
            'visible': nats >= VISIBLE_NATS, 'named': bool(named), 'in_group': group,
            'place_right': any(one['where'] == effect.where for one in named), 'deviations_off': off}


def _names(hidden: str, place: str | None, kind: str, where: str | None) -> bool:
    """Whether this kind ``where`` it is names a hidden one at its place. A load may be told at another link."""
    return kind in NAMED_BY.get(hidden, (hidden,)) and (kinds()[hidden].is_load or where == place)


def errors(found: Diagnosis, other: Samples | None) -> dict[str, float]:
    """Held-out errors of the diagnosis and of the plain model, mean over the channels: on the blocks that were held
    out, or on another recording."""
    first = found.first
    plain = plain_model(first.body, first.samples, first.train_mask[:, None] & first.counted)
    if other is None:
        return {'plain': float(plain.nmse(first.samples, found.judged[:, None] & first.counted).mean()),
                'before': float(found.before.nmse.mean()), 'after': float(found.after.nmse.mean())}
    there, valid = found.inputs.prepare(other), found.inputs.mask(~excluded(other))
    judged = evaluate_there(found.final, there, valid)
    return {'plain_other': float(plain.nmse(there, valid[:, None] & counted_outputs(first.body, there)).mean()),
            'after_other': float(judged.nmse.mean())}


# --- report ---


def line(row: dict[str, Any]) -> list[str]:
    """Cells of a row."""
    if 'error' in row:
        return [row['recording'], row['window'], row['error'], '', '', '', '', f'{row["seconds"]:.0f}']
    visible = [cause for cause in row['hidden'] if cause['visible']]
    missed = [f'{cause["kind"]}@{cause["where"]}' for cause in visible if not cause['named'] and not cause['in_group']]
    off = [abs(value) for cause in row['hidden'] for value in cause['deviations_off'].values()]
    names = [f'{one["kind"]}@{one["where"]}' for one in row['found']]
    figures = row['errors']
    ratios = [figures['after'] / figures['plain'], *([figures['after_other'] / figures['plain_other']]
                                                    if 'plain_other' in figures else [])]
    return [row['recording'], row['window'], f'{row["verdict"]}: {", ".join(names)} {" ".join(row["setup"])}',
            f'{len(visible) - len(missed)}/{len(visible)}', ', '.join(missed),
            f'{sum(value <= SURE_DEVIATIONS for value in off)}/{len(off)}',
            f'{figures["after"]:.4f} ' + ' '.join(f'x{ratio:.2f}' for ratio in ratios), f'{row["seconds"]:.0f}']


def single_windows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Effects that appear in one window of a recording and in no other, and are not hidden."""
    seen = Counter((row['recording'], one['kind'], one['where']) for row in rows
                   for one in {(one['kind'], one['where']): one for one in row.get('found', [])}.values())
    return [{'recording': row['recording'], 'window': row['window'], 'kind': one['kind'], 'where': one['where']}
            for row in rows for one in row.get('found', [])
            if seen[row['recording'], one['kind'], one['where']] == 1
            and not any(_names(cause['kind'], cause['where'], one['kind'], one['where']) for cause in row['hidden'])]


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares over all windows."""
    told = [row for row in rows if 'error' not in row]
    visible = [cause for row in told for cause in row['hidden'] if cause['visible']]
    chief = [cause for cause in visible if cause['kind'] not in ('coulomb_friction', 'viscous_friction',
                                                                'rotor_inertia')]
    off = [abs(value) for row in told for cause in row['hidden'] for value in cause['deviations_off'].values()]
    ratios = [row['errors'][f'after{end}'] / row['errors'][f'plain{end}'] for row in told for end in ('', '_other')
              if f'plain{end}' in row['errors']]
    single = single_windows(rows)
    return {'windows': len(rows), 'failed': len(rows) - len(told), 'visible': len(visible),
            'visible_found': _share(cause['named'] or cause['in_group'] for cause in visible),
            'beside_friction_and_rotors': len(chief),
            'beside_friction_and_rotors_found': _share(cause['named'] or cause['in_group'] for cause in chief),
            'values': len(off), 'values_sure': _share(value <= SURE_DEVIATIONS for value in off),
            'at_most_plain': _share(ratio <= 1.0 for ratio in ratios),
            'at_most_1.02_plain': _share(ratio <= 1.02 for ratio in ratios), 'worst_ratio': max(ratios, default=None),
            'single_window_effects': len(single),
            'single_window_share': len(single) / max(sum(len(row['found']) for row in told), 1),
            'single': single, 'median_seconds': float(np.median([row['seconds'] for row in rows]))}


def _share(flags: Any) -> float | None:
    known = list(flags)
    return sum(known) / len(known) if known else None


def main() -> None:
    """Diagnose all windows, print each as it is known, and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--data', type=Path, required=True, help='the measured arms')
    parser.add_argument('--robots', type=Path, help='needed for simulated arms')
    parser.add_argument('--cache', type=Path, default=Path(tempfile.gettempdir()) / 'windows_cache')
    parser.add_argument('--arms', choices=('measured', 'mujoco'), help='both unless given')
    parser.add_argument('--only', type=re.compile, default='', help='recordings whose names match this expression')
    parser.add_argument('--windows', type=re.compile, default='', help='windows whose names match this expression')
    parser.add_argument('--seed', type=int, default=0, help='other simulated recordings of the same causes')
    parser.add_argument('--json', type=Path, help='file of all rows, written after each')
    parser.add_argument('--jobs', type=int, default=1)
    args = parser.parse_args()
    only, chosen = re.compile(args.only), re.compile(args.windows)
    args.cache.mkdir(parents=True, exist_ok=True)
    recordings = [one for one in measured(args.data) if only.search(one.name)] if args.arms != 'mujoco' else []
    if args.arms != 'measured' and args.robots is not None:
        recordings += simulated(args.robots, args.cache, only, args.seed)
    tasks = [(one, window) for one in recordings for window in one.windows if chosen.search(window)]
    table, rows = Table('recording', 'window', 'found', 'visible causes', 'missed', 'values', 'error', '[s]'), []
    for known in Parallel(n_jobs=args.jobs, return_as='generator')(delayed(diagnosed)(*task) for task in tasks):
        rows.append(known)
        console.print(*line(known), sep=' | ', highlight=False, markup=False, soft_wrap=True)
        table.add_row(*line(known))
        if args.json:
            args.json.write_text(json.dumps({'summary': summary(rows), 'rows': rows}, indent=1))
    console.print(table)
    for name, value in summary(rows).items():
        console.print(f'{name}: {value}', highlight=False, markup=False, soft_wrap=True)


if __name__ == '__main__':
    main()
