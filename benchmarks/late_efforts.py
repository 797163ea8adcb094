"""Delays told of efforts that are late: ``python benchmarks/late_efforts.py ROBOTS``.

ROBOTS is the folder ``robots`` of example-robot-data. Three arms of MuJoCo with dry and viscous friction and a rotor in
every joint, a minute at 100 Hz. Nine recordings are 20 ms late, others 5 and 10 ms late, 10 ms early, or not at all.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from support.mujoco_arm import Robot
from windows import BASES, SURE_DEVIATIONS, Recording, _cached, _causes, diagnosed

MOTION = {'xArm7': 'circles', 'UR10': 'sines', 'Panda': 'points'}
DELAYS_MS = {20: (0, 1, 2), 10: (3,), 5: (4,), -10: (5,), 0: (6, 7)}
"""Delays, and the seeds of the recordings of each arm that have them."""


def recordings(robots: Path, cache: Path) -> Iterator[tuple[float, Recording]]:
    """Each with its delay [ms]."""
    for delay_ms, seeds in DELAYS_MS.items():
        for seed in seeds:
            for arm, motion in MOTION.items():
                base = BASES[arm]
                setting = replace(base, name=f'{arm}, {delay_ms:g} ms late, seed {seed}', motion=motion, rate_hz=100,
                                  late_s=1e-3 * delay_ms, seed=base.seed + 1000 + 10 * seed)
                robot = Robot((robots / setting.urdf).read_text(), setting.joints, setting.home)
                yield delay_ms, Recording(setting.name, robot.body, {'whole': _cached(cache, setting, robot)},
                                          *_causes(setting))


def judged(delay_ms: float, recording: Recording) -> dict[str, Any]:
    """One diagnosis: the delay told [ms] and its deviation, and how many values of other effects are right."""
    row = diagnosed(recording, 'whole')
    told = next((one['values']['delay_s'] for one in row['found'] if one['kind'] == 'time_delay'), None)
    off = [abs(value) for cause in row['hidden'] if cause['kind'] != 'time_delay'
           for value in cause['deviations_off'].values()]
    hidden = {(cause['kind'], cause['where']) for cause in row['hidden']}
    extra = [f'{one["kind"]}@{one["where"]}' for one in row['found'] if (one['kind'], one['where']) not in hidden]
    delay, std = (1e3 * told['value'], 1e3 * told['std']) if told else (None, None)
    right = delay is None if not delay_ms else delay is not None and abs(delay - delay_ms) <= SURE_DEVIATIONS * std
    return row | {'delay_ms': delay_ms, 'told_ms': delay, 'std_ms': std, 'right': right, 'extra': extra,
                  'values': len(off), 'values_right': sum(value <= SURE_DEVIATIONS for value in off)}


def line(row: dict[str, Any]) -> str:
    """What is shown of one diagnosis."""
    told = f'{row["told_ms"]:.2f} +- {row["std_ms"]:.2f} ms' if row['told_ms'] is not None else 'none'
    errors = row['errors']
    return (f'{row["recording"]} | {told} | {"right" if row["right"] else "WRONG"} | {row["values_right"]}/'
            f'{row["values"]} | {errors["after"]:.5f} x{errors["after"] / errors["plain"]:.2f} | '
            f'{row["seconds"]:.0f} s | {len(row["found"])} | {" ".join(row["extra"])}')


def main() -> None:
    """Diagnose all of them, print each as it is known, then the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('robots', type=Path)
    parser.add_argument('--cache', type=Path, default=Path(tempfile.gettempdir()) / 'windows_cache')
    parser.add_argument('--only', type=re.compile, default='', help='recordings whose names match this expression')
    parser.add_argument('--json', type=Path)
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    only, rows = re.compile(args.only), []
    for delay_ms, recording in recordings(args.robots, args.cache):
        if only.search(recording.name):
            rows.append(judged(delay_ms, recording))
            print(line(rows[-1]), flush=True)
            if args.json:
                args.json.write_text(json.dumps(rows, indent=1))
    for delay_ms in DELAYS_MS:
        own = [row for row in rows if row['delay_ms'] == delay_ms]
        if own:
            print(f'{delay_ms} ms: {sum(row["right"] for row in own)} of {len(own)} delays right, '
                  f'{sum(row["values_right"] for row in own)} of {sum(row["values"] for row in own)} other values, '
                  f'{sum(row["seconds"] for row in own) / len(own):.0f} s each')


if __name__ == '__main__':
    main()
