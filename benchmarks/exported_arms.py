"""What `semiparam export` makes of arms whose truth is known: ``python benchmarks/exported_arms.py ROBOTS``.

ROBOTS is the folder ``robots`` of example-robot-data. MuJoCo moves arms whose masses and inertias
are 10 to 30 % off, whose centres of mass are 6 mm off, and whose joints rub; half a minute at 100 Hz
is recorded. Judged are the torques of the exported description on another motion with accelerations
drawn at random, without friction, against MuJoCo's inverse dynamics of the true arm.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from mujoco_arms import SETTINGS, Setting
from semiparam_ros.core.robot.consistency import is_consistent
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.export.estimate import from_recording
from semiparam_ros.export.identified import identify
from semiparam_ros.export.report import remark
from semiparam_ros.export.urdf import changed_links, described_links, identified_urdf
from support.mujoco_arm import Robot, built, recording

SHIFT_M, SEED = 0.006, 5
FRICTION = {'SO-100': 0.03}
"""[N m, N m s/rad] Dry and viscous of each joint, where it is not the usual one."""
USUAL_FRICTION = 0.3
Prepare = Callable[[mujoco.MjSpec], None]


def another(seed: int) -> Prepare:
    """Makes bodies differ from their description, always in the same way."""
    def prepare(spec: mujoco.MjSpec) -> None:
        rng = np.random.default_rng(seed)
        for body in spec.bodies[1:]:
            factor = 1.0 + rng.choice([-1, 1]) * rng.uniform(0.1, 0.3)
            body.mass *= factor
            body.inertia *= factor
            body.ipos += SHIFT_M * rng.standard_normal(3) * (body.mass > 0.0)
    return prepare


def rubbing(prepare: Prepare, robot: Robot, friction: float) -> Prepare:
    """The same with friction in the joints."""
    def rub(spec: mujoco.MjSpec) -> None:
        prepare(spec)
        for joint in spec.joints:
            if joint.name in robot.joints:
                joint.damping, joint.frictionloss = [friction, 0.0, 0.0], friction
    return rub


def true_torques(robot: Robot, prepare: Prepare, samples: Samples) -> Array:
    """(N, n) by MuJoCo's inverse dynamics."""
    model = built(robot, prepare)
    data, rows = mujoco.MjData(model), []
    dofs = np.array([model.joint(name).dofadr[0] for name in robot.joints])
    for sample in samples:
        data.qpos[dofs], data.qvel[dofs], data.qacc[dofs] = (
            sample.position, sample.velocity, sample.acceleration)
        mujoco.mj_inverse(model, data)
        rows.append(data.qfrc_inverse[dofs].copy())
    return np.array(rows)


def cells(setting: Setting, robots: Path) -> list[str]:
    """One row of the table."""
    robot = Robot((robots / setting.urdf).read_text(), setting.joints, setting.home)
    name = setting.name.split(',')[0].split(' at')[0]
    prepare = another(SEED)
    rub = rubbing(prepare, robot, FRICTION.get(name, USUAL_FRICTION))
    estimate = from_recording(robot.body, [], recording(robot, 1, rub), True, False, name)
    found = identify(estimate, described_links(robot.urdf))
    urdf = identified_urdf(robot.urdf, found, remark(found))
    test = recording(robot, 9, rub)[::10]
    drawn = np.random.default_rng(0).standard_normal(test.position.shape)
    test = replace(test, acceleration=drawn)
    true = true_torques(robot, prepare, test)

    def error(text: str) -> str:
        body = RigidBody.from_urdf(text, robot.joints, 'effort')
        apart = body.outputs_of(test, body.base_parameters) - true
        return f'{np.sqrt(np.mean(apart**2) / np.mean(true**2)):.2%}'

    assert found.price is not None
    bodies = [values for values in described_links(urdf).values() if values[0] > 0.0]
    return [name, error(robot.urdf), error(urdf), f'{found.price.unconstrained:.5f}',
            f'{found.price.consistent:.5f}', f'{len(changed_links(found))} of {len(found.links)}',
            str(all(map(is_consistent, bodies)))]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('robots', type=Path)
    parser.add_argument('--json', type=Path, metavar='FILE')
    args = parser.parse_args()
    robots, rows = args.robots, []
    table = Table('arm', 'description', 'exported', 'held out, unconstrained', 'consistent',
                  'links changed', 'bodies exist')
    arms = {(setting.urdf, setting.joints): setting for setting in reversed(SETTINGS)}
    for setting in reversed(arms.values()):
        row = cells(setting, robots)
        print(*row, sep=' | ', flush=True)
        rows.append(row)
        table.add_row(*row)
    Console(width=120).print(table)
    if args.json:
        names = [str(column.header) for column in table.columns]
        runs = [dict(zip(names, row, strict=True)) for row in rows]
        document = json.dumps({'command': 'exported_arms', 'runs': runs}, indent=1)
        args.json.write_text(document + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
