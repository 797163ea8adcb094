"""How well an arm follows with feedforward from what was learnt: ``python benchmarks/tracking.py ROBOTS``.

ROBOTS is the folder ``robots`` of example-robot-data. MuJoCo moves arms whose masses, friction and rotors differ from
the description. A PD controller, tuned by the inertia that each motor moves (described links and true rotor, as its
maker tunes it), takes feedforward efforts: none, those of the description, or those of the default model after a
minute of another motion, which goes on learning. No diagnosis, nothing chosen by hand. A desired state that is not
valid by the model is counted, and its feedforward is used all the same.
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

from mujoco_arms import ENCODER, MOTIONS, SETTINGS, Setting, _as_it_is
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.core.types import Array
from semiparam_ros.online.desired_state import desired
from semiparam_ros.online.feedforward import is_doubtful
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import model_options
from support.mujoco_arm import STEP_S, Robot, built

ARMS = ('UR5 at', 'Panda, efforts')
RATE_HZ = 200
STIFFNESS, DAMPING = 100.0, 20.0
"""[1/s^2], [1/s] times the inertia of each joint with its rotor."""
SHARE_OF_START_S = 2.0
"""What a motion takes to be followed; not judged."""

Forward = Callable[[Array, Array, Array], Array]


class Arm:
    """One simulated arm, its controller and its driver.

    :param urdf: text of its description. A load of the setting is in the hand from the start.
    """

    def __init__(self, setting: Setting, urdf: str, rate_hz: int = RATE_HZ) -> None:
        robot = Robot(urdf, setting.joints, setting.home)
        self.setting, self.body, self.rate_hz = setting, robot.body, rate_hz
        self.model = built(robot, lambda spec: _as_it_is(spec, setting, np.random.default_rng(setting.seed)))
        if setting.payload_kg:
            self.model.body('load').mass, self.model.body('load').inertia = setting.payload_kg, [2e-3] * 3
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        self.dofs = np.array([self.model.joint(name).dofadr[0] for name in setting.joints])
        self.gains = np.diag(self._described_inertia(np.array(setting.home))) + setting.armature

    def _described_inertia(self, position: Array) -> Array:
        """(n, n) by unit accelerations of the description at rest."""
        body, zero = self.body, np.zeros(len(position))
        held = body.regressor(position, zero, zero) @ body.base_parameters
        rows = [body.regressor(position, zero, unit) @ body.base_parameters - held for unit in np.eye(len(position))]
        return np.array(rows)

    def follow(self, motion: str, seconds: float, take: int, forward: Forward,
               heard: Callable[[Sample], None] = lambda sample: None, start_ns: int = 0,
               before: Callable[[float], None] = lambda seconds: None) -> Array:
        """(N, n) tracking errors [rad] of every step of ``STEP_S``.

        :param before: called before each sample with the time [s] since the start; may change the model.
        """
        wanted, speed, change, rng = self.path(motion, seconds, take)
        data, every = mujoco.MjData(self.model), round(1.0 / self.rate_hz / STEP_S)
        data.qpos[self.dofs], data.qvel[self.dofs] = wanted[0], speed[0]
        rates, errors, effort = CausalDifferentiator(len(self.dofs), Settings().acceleration_cutoff), [], None
        for step, (q, dq, ddq) in enumerate(zip(wanted, speed, change, strict=True)):
            if step % every == 0:
                before(step * STEP_S)
                position = data.qpos[self.dofs] + ENCODER * rng.standard_normal(len(self.dofs))
                velocity = data.qvel[self.dofs] + 1e-3 * rng.standard_normal(len(self.dofs))
                stamp = start_ns + round(step * STEP_S * 1e9)
                if effort is not None:  # as commanded since the last sample
                    heard(Sample(stamp, position, velocity, rates.update(stamp, velocity).copy(), effort))
                feedback = self.gains * (STIFFNESS * (q - position) + DAMPING * (dq - velocity))
                effort = forward(q, dq, ddq) + feedback
            data.qfrc_applied[self.dofs] = effort
            mujoco.mj_step(self.model, data)
            errors.append(data.qpos[self.dofs] - q)
        return np.array(errors)

    def path(self, motion: str, seconds: float, take: int) -> tuple[Array, Array, Array, np.random.Generator]:
        """(N, n) positions, velocities and accelerations wanted at every step, and what draws the noise."""
        setting = replace(self.setting, seconds=seconds)
        rng = np.random.default_rng((setting.seed, take))
        wanted = MOTIONS[motion](setting, rng) + np.array(setting.home)
        speed = np.gradient(wanted, STEP_S, axis=0)
        return wanted, speed, np.gradient(speed, STEP_S, axis=0), rng


def size(errors: Array, start_s: float = SHARE_OF_START_S) -> float:
    """Root mean square [rad], all joints, from a time on."""
    return float(np.sqrt(np.mean(np.square(errors[round(start_s / STEP_S):]))))


def compared(setting: Setting, robots: Path) -> dict[str, float]:
    """Tracking errors [mrad] on the second motion, and the share of its states that were valid."""
    arm = Arm(setting, (robots / setting.urdf).read_text())
    body: RigidBody = arm.body
    estimator = Estimator(body, model_options(Settings(outputs='effort')))

    def described(*row: Array) -> Array:
        return np.asarray(body.regressor(*row) @ body.base_parameters)

    arm.follow('points', 60.0, 1, described, lambda sample: estimator.step(sample) and None)
    valid: list[bool] = []

    def learnt(*row: Array) -> Array:
        answer = desired(estimator, *row)
        valid.append(not is_doubtful(answer))
        return answer.efforts

    nothing = np.zeros(len(arm.dofs))
    errors = {'none': arm.follow('sines', 20.0, 2, lambda *row: nothing),
              'description': arm.follow('sines', 20.0, 2, described),
              'learnt': arm.follow('sines', 20.0, 2, learnt, lambda sample: estimator.step(sample) and None,
                                   start_ns=61 * 10**9)}
    return {**{name: 1e3 * size(value) for name, value in errors.items()}, 'valid': float(np.mean(valid))}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('robots', type=Path)
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--json', type=Path, metavar='FILE')
    args = parser.parse_args()
    runs: list[dict[str, object]] = []
    console, table = Console(width=120), Table('arm', 'seed', 'none', 'description', 'learnt', 'ratio', 'valid')
    for key in ARMS:
        chosen = next(setting for setting in SETTINGS if setting.name.startswith(key))
        for seed in range(args.seeds):
            setting = replace(chosen, late_s=0.0, payload_kg=0.0, asymmetry=0.0, seed=seed)
            found, arm = compared(setting, args.robots), key.split(',')[0].split(' at')[0]
            runs.append({'arm': arm, 'seed': seed, **found})
            cells = (arm, str(seed), *(f'{found[name]:.2f}' for name in
                     ('none', 'description', 'learnt')), f'{found["learnt"] / found["description"]:.3f}',
                     f'{found["valid"]:.0%}')
            console.print(*cells, sep=' | ')
            table.add_row(*cells)
    console.print(table)
    if args.json:
        document = json.dumps({'command': 'tracking', 'runs': runs}, indent=1)
        args.json.write_text(document + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
