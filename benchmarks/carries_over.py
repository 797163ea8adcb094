"""What is learnt on one motion, on another motion of the same robot: frozen, learning, and as feedforward.

    python benchmarks/carries_over.py --data FOLDER --robots ROBOTS

FOLDER holds the measured recordings as ``benchmarks/bands.py`` wants them, ROBOTS is the folder ``robots`` of the
package example-robot-data. Motion A is learnt, whole or its first seconds; motion B is predicted without learning from
it (``frozen``) and while it is learnt (``learning``), then its states are asked for as feedforward. Beside that stand
the robot description alone, the variant P with the same columns, and the plain least-squares model that an engineer
fits to A by hand (``test/support/plain_model.py``), on the same samples with the same causal inputs. Judged is where
the robot moves.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

import numpy as np
from rich.console import Console
from rich.table import Table

from bands import BAND, follow
from bands import pairs as recorded_pairs
from mujoco_arms import SETTINGS, SO100, UR, UR10, UR_HOME, Setting, recorded, robot_of
from semiparam_ros.core.motion import moving
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.core.types import Array
from semiparam_ros.core.variants import CHOICES
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online.feedforward import is_doubtful
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body
from support.mujoco_arm import Robot
from support.plain_model import plain_model

ARMS = (('xArm7, sines', 'sines', 'points'), ('UR5 at', 'points', 'circles'), ('UR10', 'sines', 'circles'),
        ('Panda, efforts', 'circles', 'sines'), ('Kinova', 'points', 'sines'), ('Talos', 'sines', 'points'),
        ('PR2', 'circles', 'points'), ('SO-100', 'points', 'sines'))
"""Settings of ``mujoco_arms``, without their further causes: motion A of a minute, motion B of half a minute."""
Z1, G1 = 'z1_description/urdf/z1.urdf', 'g1_description/urdf/g1_29dof_rev_1_0.urdf'
TIAGO = tuple(f'arm_{number}_joint' for number in range(1, 8))
TIAGO_PRO = tuple(f'arm_left_{number}_joint' for number in range(1, 8))
BAXTER = tuple(f'left_{name}' for name in ('s0', 's1', 'e0', 'e1', 'w0', 'w1', 'w2'))
ROMEO = tuple(f'L{name}' for name in ('ShoulderPitch', 'ShoulderYaw', 'ElbowRoll', 'ElbowYaw', 'WristRoll',
                                      'WristYaw', 'WristPitch'))
CENTAURO = tuple(f'j_arm1_{number}' for number in range(1, 7))
G1_ARM = tuple(f'left_{name}_joint' for name in ('shoulder_pitch', 'shoulder_roll', 'shoulder_yaw', 'elbow',
                                                 'wrist_roll', 'wrist_pitch', 'wrist_yaw'))
HUMANOID = tuple(f'RARM_{name}' for name in ('SHOULDER_P', 'SHOULDER_R', 'SHOULDER_Y', 'ELBOW', 'WRIST_Y',
                                             'WRIST_P', 'WRIST_R'))
HUMAN = tuple(f'left_{name}' for name in ('shoulder_Z', 'shoulder_X', 'shoulder_Y', 'elbow_Z', 'elbow_Y', 'wrist_Z',
                                          'wrist_X'))
DOWN, WALL = (3.14159, 0.0), (0.0, 1.5708)
Z1_HOME, Z1_FRICTION = (0.0, 1.3, -1.4, 0.2, 0.1, 0.0), (1.0, 1.5, 1.0, 0.5, 0.4, 0.3)
WIDE = (0.7, 1.3)
OTHERS = (
    (Setting('z1, coarse encoders', Z1, tuple(f'joint{number}' for number in range(1, 7)), Z1_HOME, Z1_FRICTION,
             rate_hz=250, encoder=3.8e-4, velocity_filter_hz=30.0, masses=WIDE, seed=201), 'points', 'sines'),
    (Setting('z1 at a wall, slow to quick', Z1, tuple(f'joint{number}' for number in range(1, 7)), Z1_HOME,
             Z1_FRICTION, rate_hz=100, mounted=WALL, stribeck=0.5, seed=202), 'slow', 'quick'),
    (Setting('TIAGo with its lift', 'tiago_description/robots/tiago.urdf', ('torso_lift_joint', *TIAGO),
             (0.15, 1.2, -0.4, -1.0, 1.2, 0.0, 0.0, 0.0), (60.0, 2.0, 2.0, 1.5, 1.5, 0.4, 0.4, 0.2), rate_hz=100,
             reach=(0.15, *(1.0 for _ in TIAGO)), masses=WIDE, seed=203), 'points', 'sines'),
    (Setting('TIAGo, a sample late, a joint at a time', 'tiago_description/robots/tiago.urdf', TIAGO,
             (1.2, -0.4, -1.0, 1.2, 0.0, 0.0, 0.0), (2.0, 2.0, 1.5, 1.5, 0.4, 0.4, 0.2), rate_hz=50, late_s=0.02,
             asymmetry=0.3, seed=204), 'in turn', 'points'),
    (Setting('TIAGo Pro at 1 kHz', 'tiago_pro_description/robots/tiago_pro.urdf', TIAGO_PRO,
             (1.5, -0.6, 0.0, -0.8, 0.0, 0.3, 0.0), (2.0, 2.0, 1.5, 1.5, 0.8, 0.8, 0.5), rate_hz=1000,
             velocity_filter_hz=50.0, noise=0.03, masses=WIDE, seed=205), 'spiral', 'points'),
    (Setting('Baxter, friction with the load', 'baxter_description/urdf/baxter.urdf', BAXTER,
             (0.0, -0.5, 0.0, 1.2, 0.0, 0.6, 0.0), (1.5, 2.0, 1.0, 1.0, 0.3, 0.3, 0.2), rate_hz=100, rubbing=0.1,
             noise_colour=0.9, noise=0.02, masses=WIDE, seed=206), 'sines', 'points'),
    (Setting('Romeo at 20 Hz', 'romeo_description/urdf/romeo.urdf', ROMEO, (0.4, 0.4, 0.0, -0.8, -1.5, 0.0, 0.0),
             (0.5, 0.4, 0.3, 0.2, 0.1, 0.05, 0.05), rate_hz=20, armature=0.01, masses=WIDE, seed=207),
     'circles', 'sines'),
    (Setting('Centauro, a joint at a time', 'centauro_description/urdf/centauro.urdf', CENTAURO,
             (0.2, 0.8, 0.0, -1.2, 0.0, 0.2), (6.0, 6.0, 4.0, 4.0, 2.0, 2.0), rate_hz=250, rubbing=0.05, stribeck=0.3,
             velocity_filter_hz=20.0, masses=WIDE, seed=208), 'in turn', 'sines'),
    (Setting('G1, coarse currents', G1, G1_ARM, (0.2, 0.3, 0.0, 0.8, 0.0, 0.0, 0.0),
             (0.8, 0.8, 0.6, 0.6, 0.2, 0.2, 0.1), rate_hz=500, armature=0.02, late_s=0.002, effort_step=0.1,
             encoder=1e-4, velocity_filter_hz=40.0, masses=WIDE, seed=209), 'points', 'quick'),
    (Setting('humanoid, one side alone', 'simple_humanoid_description/urdf/simple_humanoid.urdf', HUMANOID,
             (0.3, 0.6, 0.0, -1.2, 0.0, 0.0, 0.0), (3.0, 2.0, 1.5, 1.5, 0.5, 0.4, 0.4), rate_hz=100, stribeck=0.5,
             seed=210), 'part', 'sines'),
    (Setting('UR3 at a ceiling, quick to wide', 'ur_description/urdf/ur3_robot.urdf', UR, UR_HOME,
             (3.0, 3.0, 2.0, 0.6, 0.6, 0.5), rate_hz=125, mounted=DOWN, masses=WIDE, asymmetry=0.3, seed=211),
     'quick', 'sines'),
    (Setting('human arm, spiral', 'human_description/robots/human.urdf', HUMAN, (0.2, 0.5, 0.0, 0.8, 0.3, 0.0, 0.0),
             (0.5, 0.5, 0.3, 0.3, 0.2, 0.1, 0.1), rate_hz=100, noise=0.02, seed=212), 'spiral', 'points'),
    (Setting('UR10 five times as heavy', UR10, UR, UR_HOME, (60.0, 60.0, 40.0, 15.0, 15.0, 10.0), rate_hz=200,
             heavier=5.0, armature=0.5, masses=WIDE, noise_colour=0.5, seed=213), 'slow', 'points'),
    (Setting('SO-101 at 30 Hz', 'so_arm_description/urdf/so101.urdf', SO100, (0.0, 0.3, 0.2, 0.3, 0.0),
             (0.12, 0.12, 0.1, 0.06, 0.05), rate_hz=30, armature=0.01, encoder=1.5e-3, velocity_filter_hz=10.0,
             noise=0.03, effort_step=0.05, masses=WIDE, seed=214), 'circles', 'points'))
"""Arms and motions that no other benchmark has, with what measured arms have: coarse encoders, friction of other laws,
efforts that come late, masses that are far off, other mounts."""
FILTER_HZ = 20.0
"""Velocities are filtered no lower than that: lag is another question."""
FEEDFORWARD_STATES = 250
RANGE_MARGIN = 0.05


class Pair(NamedTuple):
    """Two motions of one robot; the second one is judged in so many parts."""

    name: str
    settings: Settings
    first: Samples
    second: Samples
    parts: int = 1

    @property
    def body(self) -> RigidBody:
        """The robot as described."""
        return build_rigid_body(self.settings)


def pairs(data: Path | None, robots: Path | None) -> Iterator[Pair]:
    """All that the folders hold, and the bundled recordings."""
    for pair in recorded_pairs(data):
        settings = replace(pair.settings, robot_description=pair.bag.robot_description or '', robot_description_file='')
        yield Pair(pair.name, settings, pair.train, pair.test, pair.parts)
        if pair.name == 'UR3':
            yield Pair('UR3, back', settings, pair.test, pair.train)
    for key, first, second in ARMS if robots is not None else ():
        chosen = next(setting for setting in SETTINGS if setting.name.startswith(key))
        setting = replace(chosen, late_s=0.0, payload_kg=0.0, asymmetry=0.0, rate_hz=min(chosen.rate_hz, 200),
                          velocity_filter_hz=chosen.velocity_filter_hz and max(chosen.velocity_filter_hz, FILTER_HZ))
        assert robots is not None
        urdf = (robots / setting.urdf).read_text()
        robot = Robot(urdf, setting.joints, setting.home)
        motions = [causal(recorded(replace(setting, motion=motion, seconds=seconds), robot, take))
                   for take, (motion, seconds) in enumerate(((first, 60.0), (second, 30.0)), start=1)]
        settings = Settings(outputs='effort', joints=setting.joints, robot_description=urdf)
        yield Pair(f'{key.split(",")[0].split(" at")[0]} (simulated)', settings, *motions)


def other_pairs(robots: Path, seed: int) -> Iterator[Pair]:
    """The arms of ``OTHERS``; another seed has other masses and motions."""
    for setting, first, second in OTHERS:
        setting = replace(setting, seed=setting.seed + 100 * seed)
        robot = robot_of(setting, robots)
        settings = Settings(outputs='effort', joints=setting.joints, robot_description=robot.urdf)
        motions = [causal(recorded(replace(setting, motion=motion, seconds=seconds), robot, take))
                   for take, (motion, seconds) in enumerate(((first, 60.0), (second, 30.0)), start=1)]
        yield Pair(f'{setting.name} (simulated)', settings, *motions)


def causal(samples: Samples) -> Samples:
    """With the accelerations that the node estimates as samples come."""
    filtered = CausalDifferentiator(samples.position.shape[1], Settings().acceleration_cutoff)
    rates = [filtered.update(stamp, velocity).copy()
             for stamp, velocity in zip(samples.stamps.tolist(), samples.velocity, strict=True)]
    return replace(samples, acceleration=np.array(rates))


def nmse(errors: Array, measured: Array) -> float:
    """Mean over the outputs that vary."""
    variance = measured.var(axis=0)
    return float(np.mean(np.mean(errors**2, axis=0)[variance > 0.0] / variance[variance > 0.0]))


def shortened(samples: Samples, seconds: float | None) -> Samples:
    """Its first seconds, or all."""
    if seconds is None:
        return samples
    return samples[:int(np.searchsorted(samples.stamps, samples.stamps[0] + round(seconds * 1e9)))]


def references(pair: Pair, seconds: float | None) -> dict[str, float]:
    """Errors on B of the rigid body as described, and of the plain model."""
    body, second = pair.body, pair.second[moving(pair.second)]
    left = second.outputs - body.regressors(second) @ body.base_parameters
    first = shortened(pair.first, seconds)
    first = first[moving(first)]
    plain = plain_model(body, first, np.ones(len(first), dtype=bool))
    return {'description': nmse(left, second.outputs), 'plain': nmse(plain.residual(second), second.outputs)}


def judged(pair: Pair, variant: str, features: int, seconds: float | None,
           ways: Sequence[str] = ('frozen', 'learning')) -> dict[str, Any]:
    """Figures of one variant that learnt A, on B."""
    settings = replace(pair.settings, variant=variant, features_count=features)
    learner = OfflineLearner(settings, [], lambda: None)
    follow(learner, shortened(pair.first, seconds), learn=True)
    length = len(pair.second) // pair.parts
    found: dict[str, Any] = {}
    for name in ways:
        parts = (pair.second[part * length:(part + 1) * length] for part in range(pair.parts))
        said = [prediction for part in parts
                for prediction in _predicted(deepcopy(learner), part, name == 'learning')]
        measured = np.array([each.sample.outputs for each in said])
        errors = measured - np.array([each.mean for each in said])
        over_std = errors / np.array([each.std for each in said])
        found[name] = {'nmse': nmse(errors, measured), 'band': float((np.abs(over_std) <= BAND).mean()),
                       'rms_over_std': float(np.sqrt((over_std**2).mean())),
                       'log_density': float(np.mean([each.log_density for each in said]))}
    if learner.estimator.ready:
        found['feedforward'] = feedforward(learner, pair)
    return found


def _predicted(learner: OfflineLearner, samples: Samples, learn: bool) -> list[Any]:
    """As ``bands.follow``, before the initial window is over too."""
    learner.begin(samples.origin)
    return [prediction for prediction in (learner.step(sample, learn) for sample in samples)
            if prediction.motion.is_news]


def feedforward(learner: OfflineLearner, pair: Pair) -> dict[str, Any] | None:
    """Desired states of B that no effort limit cuts: error, and what ``valid`` is worth.

    None where all are cut.
    """
    from semiparam_ros.online.desired_state import desired

    second = pair.second[moving(pair.second)]
    second = second[::max(1, len(second) // FEEDFORWARD_STATES)]
    answers = [desired(learner.estimator, *row) for row in
               zip(second.position, second.velocity, second.acceleration, strict=True)]
    uncut = np.array([not answer.limited.any() for answer in answers])
    if not uncut.any():
        return None
    second, answers = second[uncut], [answer for answer in answers if not answer.limited.any()]
    errors = second.outputs - np.array([answer.outputs for answer in answers])
    beyond = np.abs(errors) > 3.0 * np.array([answer.outputs_std for answer in answers])
    valid = np.array([not is_doubtful(answer) for answer in answers])
    lowest, highest = learner.estimator.inputs_learnt
    margin = RANGE_MARGIN * (highest - lowest)
    covered = ((second.inputs >= lowest - margin) & (second.inputs <= highest + margin)).all(axis=1)
    return {'nmse': nmse(errors, second.outputs), 'valid': float(valid.mean()), 'covered': float(covered.mean()),
            'valid_where_covered': float(valid[covered].mean()) if covered.any() else None,
            'beyond_three_std_where_valid': float(beyond[valid].mean()) if valid.any() else None}


def row(result: dict[str, Any]) -> list[str]:
    """Cells of the table."""
    frozen, learning, ahead = result['frozen'], result['learning'], result.get('feedforward')
    seconds = 'all' if result['seconds'] is None else f'{result["seconds"]:g} s'
    cells = [result['pair'], seconds, result['variant'], f'{result["description"]:.3f}', f'{result["plain"]:.4f}',
             f'{frozen["nmse"]:.4f}', f'{frozen["nmse"] / result["plain"]:.2f}',
             f'{frozen["band"]:.1%} ({frozen["rms_over_std"]:.2f})', f'{frozen["log_density"]:.2f}',
             f'{learning["nmse"]:.4f}']
    if ahead is None:
        return [*cells, '', '', '']
    worst = ahead['beyond_three_std_where_valid']
    return [*cells, f'{ahead["nmse"]:.4f}', f'{ahead["valid"]:.0%} ({ahead["covered"]:.0%})',
            '' if worst is None else f'{worst:.2%}']


HEADINGS = ('A to B', 'learnt', 'variant', 'description', 'plain', 'frozen', 'over plain', 'band (rms over std)',
            'log density', 'learning',
            'feedforward', 'valid (covered)', 'beyond 3 std where valid')


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--data', type=Path, metavar='FOLDER')
    parser.add_argument('--robots', type=Path, metavar='ROBOTS')
    parser.add_argument('--variant', nargs='+', choices=CHOICES, default=[Settings().variant])
    parser.add_argument('--features', type=int, default=Settings().features_count, help='D (default: %(default)s)')
    parser.add_argument('--seconds', nargs='*', type=float, default=[],
                        help='also after so many seconds of A, beside all of it')
    parser.add_argument('--only', default='', help='pairs whose names hold this')
    parser.add_argument('--others', type=int, metavar='SEED', help='arms and motions that no other benchmark has')
    parser.add_argument('--json', type=Path, metavar='FILE')
    args = parser.parse_args()
    console, table, results = Console(width=180), Table(*HEADINGS), []
    chosen = pairs(args.data, args.robots) if args.others is None else other_pairs(args.robots, args.others)
    for pair in chosen:
        if args.only not in pair.name:
            continue
        span = 1e-9 * float(pair.first.stamps[-1] - pair.first.stamps[0])
        for seconds in [*(each for each in args.seconds if each < span), None]:
            beside = references(pair, seconds)
            for variant in args.variant:
                result = {'pair': pair.name, 'seconds': seconds, 'variant': variant, **beside,
                          **judged(pair, variant, args.features, seconds)}
                results.append(result)
                table.add_row(*row(result))
                console.print(*row(result), sep=' | ', highlight=False, markup=False, soft_wrap=True)
    console.print(table)
    if args.json:
        document = json.dumps({'command': 'carries_over', 'runs': results}, indent=1)
        args.json.write_text(document + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
