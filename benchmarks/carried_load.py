"""How well an arm follows while a load comes and goes: ``python benchmarks/carried_load.py ROBOTS``.

ROBOTS is the folder ``robots`` of example-robot-data. The arms, their controller and the feedforward
are those of ``tracking.py``. A minute of one motion is learnt. Then the arm follows another one; a
load is put into its hand, taken out of it and put into it again, half a minute each. Feedforward comes
from the description, or from the learner of the node with ``diagnosis.auto`` ``report`` and ``apply``.
A change is named four seconds after that is asked for, as in the node's process beside. ``known at
once`` and ``known after 0.2 s`` are bounds: no change is looked for, and whether the load is there is
told so long after it came or went, with its exact torques; all else is learnt as ever.

*Before* is the error of the twenty seconds before the first change. After each change: the error of
the next thirty seconds, that of their worst second, and that of the last ten, over the one before.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault('OMP_NUM_THREADS', '1')

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from mujoco_arms import SETTINGS, Setting
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array
from semiparam_ros.experiments.evaluation import AtOnce
from semiparam_ros.online.diagnosis_jobs import name_change
from semiparam_ros.online.feedforward import Feedforward
from semiparam_ros.online.learner import Learner
from semiparam_ros.settings import Settings
from support.mujoco_arm import STEP_S
from tracking import ARMS, Arm, size

LEARNT_S, CHANGES_S, END_S = 60.0, (20.0, 50.0, 80.0), 110.0
NAMING_S = 4.0
CARRIERS = dict(zip(ARMS, ('wrist_3_link', 'panda_link7'), strict=True))
EMPTY_KG = 1e-6
KNOWN_AFTER_S = {'known at once': 0.0, 'known after 0.2 s': 0.2}
MODES = ('description', 'report', 'apply', *KNOWN_AFTER_S)


class Later(AtOnce):
    """A background that names a change ``NAMING_S`` of the robot's time after that was asked for."""

    def __init__(self) -> None:
        self.now = 0
        self._waiting: list[tuple[float, Callable[[], None]]] = []

    def submit(self, function: Callable[..., Any], *arguments: object, done: Any, **urgency: Any) -> Any:
        """See :class:`~semiparam_ros.online.worker.Background`."""
        if function is not name_change:
            return super().submit(function, *arguments, done=done)

        def deliver(result: Any, error: BaseException | None) -> None:
            self._waiting.append((self.now + NAMING_S * 1e9, lambda: done(result, error)))

        return super().submit(function, *arguments, done=deliver)

    def arrive(self, now: int) -> None:
        """Hand over what is due at a stamp [ns]."""
        self.now = now
        while self._waiting and self._waiting[0][0] <= now:
            self._waiting.pop(0)[1]()


class Silent:
    """Hears what a learner tells, and keeps its decisions."""

    def __init__(self) -> None:
        self.records: dict[int, Any] = {}

    def change_reported(self, record: Any) -> None:
        """Keep the latest of each change."""
        self.records[record.change.number] = record

    def failed(self, what: str, error: BaseException) -> None:
        """Let nothing that goes wrong pass."""
        raise RuntimeError(what) from error

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_: None


class Load:
    """A load in the hand, and the torques that it asks for."""

    def __init__(self, arm: Arm, kilograms: float) -> None:
        self._model, self._dofs, self._kilograms = arm.model, arm.dofs, kilograms
        models = copy(arm.model), copy(arm.model)
        for model, mass in zip(models, (kilograms, EMPTY_KG), strict=True):
            put_on(model, mass)
        self._with_and_without = [(model, mujoco.MjData(model)) for model in models]

    def change(self, seconds: float) -> None:
        """Put it on or take it off, as is due at a time."""
        mass = self._kilograms if is_on(seconds) else EMPTY_KG
        if self._model.body('load').mass[0] != mass:
            put_on(self._model, mass)

    def torques(self, *row: Array) -> Array:
        """(n,) [N m] at a position, velocity and acceleration (n,) each."""
        found = []
        for model, data in self._with_and_without:
            data.qpos[self._dofs], data.qvel[self._dofs], data.qacc[self._dofs] = row
            mujoco.mj_inverse(model, data)
            found.append(data.qfrc_inverse[self._dofs])
        return np.asarray(found[0] - found[1])


def put_on(model: mujoco.MjModel, kilograms: float) -> None:
    """Give the load of a model this mass."""
    model.body('load').mass, model.body('load').inertia = kilograms, [2e-3 * kilograms] * 3
    mujoco.mj_setConst(model, mujoco.MjData(model))


def is_on(seconds: float) -> bool:
    """Tell whether the hand holds the load."""
    return sum(seconds >= change for change in CHANGES_S) % 2 == 1


def followed(setting: Setting, urdf: str, mode: str, kilograms: float) -> tuple[Array, list[str]]:
    """(N, n) errors [rad] of every step of the second motion, and what was decided."""
    arm, background, silent = Arm(setting, urdf), Later(), Silent()
    settings = Settings(outputs='effort', joints=setting.joints, robot_description=urdf)
    auto = {'description': 'report', **dict.fromkeys(KNOWN_AFTER_S, 'off')}.get(mode, mode)
    learner = Learner(replace(settings, diagnosis_auto=auto), arm.body, background, silent)
    feedforward, load = Feedforward(), Load(arm, kilograms)
    start = round((LEARNT_S + 1.0) * 1e9)
    seconds = 0.0

    def described(*row: Array) -> Array:
        return np.asarray(arm.body.regressor(*row) @ arm.body.base_parameters)

    def forward(*row: Array) -> Array:
        efforts = feedforward.answer(learner, *row).efforts
        told = mode in KNOWN_AFTER_S and is_on(seconds - KNOWN_AFTER_S[mode])
        return efforts + load.torques(*row) if told else efforts

    def heard(sample: Sample) -> None:
        if mode in KNOWN_AFTER_S and is_on((sample.stamp - start) * 1e-9):
            sample = sample._replace(outputs=sample.outputs - load.torques(*sample[1:4]))
        background.arrive(sample.stamp)
        learner.offer(sample)

    def before(now: float) -> None:
        nonlocal seconds
        seconds = now
        load.change(now)

    load.change(0.0)
    arm.follow('points', LEARNT_S, 1, described, heard)
    chosen = described if mode == 'description' else forward
    errors = arm.follow('sines', END_S, 2, chosen, heard, start, before)
    told = [f'{(each.stamp - start) * 1e-9:.1f} s: {each.what}' for record in silent.records.values()
            for each in record.decisions]
    return errors, told


def judged(errors: Array) -> dict[str, Any]:
    """Figures [mrad] of one run."""
    def part(start: float, end: float) -> float:
        return 1e3 * size(errors[round(start / STEP_S):round(end / STEP_S)], 0.0)

    before = part(2.0, CHANGES_S[0])
    after = [[part(change, change + 30.0),
              max(part(second, second + 1.0) for second in np.arange(change, change + 29.5, 0.5)),
              part(change + 20.0, change + 30.0)] for change in CHANGES_S]
    return {'before': before, 'after': after}


def main() -> None:
    """A row for each arm, seed and kind of feedforward."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('robots', type=Path)
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--modes', nargs='+', choices=MODES, default=MODES, metavar='MODE')
    parser.add_argument('--kilograms', type=float, default=1.0)
    parser.add_argument('--json', type=Path, metavar='FILE')
    args = parser.parse_args()
    runs, console = [], Console(width=150)
    table = Table('arm', 'seed', 'feedforward', 'before [mrad]', 'picked up', 'put down', 'picked up again')
    for key in ARMS:
        chosen = next(setting for setting in SETTINGS if setting.name.startswith(key))
        for seed in range(args.seeds):
            setting = replace(chosen, late_s=0.0, asymmetry=0.0, seed=seed, carrier=CARRIERS[key],
                              payload_kg=args.kilograms)
            urdf, arm = (args.robots / setting.urdf).read_text(), key.split(',')[0].split(' at')[0]
            for mode in args.modes:
                errors, told = followed(setting, urdf, mode, args.kilograms)
                found = judged(errors)
                runs.append({'arm': arm, 'seed': seed, 'mode': mode, 'decisions': told, **found})
                over = [', '.join(f'{value / found["before"]:.2f}' for value in row) for row in found['after']]
                cells = (arm, str(seed), mode, f'{found["before"]:.2f}', *over)
                console.print(*cells, *told, sep=' | ')
                table.add_row(*cells)
    console.print(table)
    if args.json:
        document = json.dumps({'command': 'carried_load', 'runs': runs}, indent=1)
        args.json.write_text(document + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
