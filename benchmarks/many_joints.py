"""What a sample, the initial window and a diagnosis cost as joints grow: the iCub of icub-models, joint efforts.

    pip install icub-models
    python benchmarks/many_joints.py
    python benchmarks/many_joints.py --diagnosis    three minutes at 100 Hz, viscous friction in the second joint

SPK and P predict and learn samples of sines on every joint, in turns; n joints have n outputs. The regressor alone
beside them. Each diagnosis has a process of its own.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator, build_rigid_body

ARM = ('shoulder_pitch', 'shoulder_roll', 'shoulder_yaw', 'elbow', 'wrist_prosup', 'wrist_pitch', 'wrist_yaw')
LEG = ('hip_pitch', 'hip_roll', 'hip_yaw', 'knee', 'ankle_pitch')
BOTH_ARMS = (*(f'r_{name}' for name in ARM), *(f'l_{name}' for name in ARM))
UPPER_BODY = ('torso_pitch', 'torso_roll', 'torso_yaw', 'neck_pitch', 'neck_roll', 'neck_yaw')
MODEL = 'iCubGazeboV2_5'
JOINTS = (BOTH_ARMS[:4], BOTH_ARMS[:7], BOTH_ARMS,
          (*UPPER_BODY, *BOTH_ARMS, *(f'{side}_{name}' for side in 'rl' for name in LEG)))
"""4 and 7 of an arm, both arms, and with torso, neck and the legs' upper joints 30."""


class Cost(NamedTuple):
    """Of one number of joints."""

    joints: int
    columns: int
    regressor_us: float
    sample_us: dict[str, float]
    window_s: dict[str, float]


def settings_of(joints: tuple[str, ...], variant: str, features: int, window: int) -> Settings:
    """Efforts of these joints; the others are locked."""
    import icub_models  # so that --help needs no such package

    return Settings(robot_description_file=str(icub_models.get_model_file(MODEL)), joints=joints, outputs='effort',
                    variant=variant, features_count=features, initial_samples=window)


def motion(body: RigidBody, count: int) -> list[Sample]:
    """Sines on every joint at 100 Hz, with the efforts of the description's inertias and noise."""
    rng = np.random.default_rng(0)
    frequency, phase = rng.uniform(2.0, 6.0, body.n_joints), rng.uniform(0.0, 2.0 * np.pi, body.n_joints)
    samples = []
    for index in range(count):
        angle = frequency * index * 0.01 + phase
        moved = 0.3 * np.sin(angle), 0.3 * frequency * np.cos(angle), -0.3 * frequency**2 * np.sin(angle)
        efforts = body.regressor(*moved) @ body.base_parameters
        samples.append(Sample(index * 10**7, *moved, efforts + 0.05 * rng.standard_normal(body.n_outputs)))
    return samples


def seconds(act: Callable[[], object]) -> float:
    """Of the processor."""
    start = time.process_time()
    act()
    return time.process_time() - start


def measure(joints: tuple[str, ...], features: int, window: int, count: int) -> Cost:
    """Everything of one number of joints."""
    variants = ('P', 'SPK-ML')
    models: dict[str, Estimator] = {name: build_estimator(settings_of(joints, name, features, window))
                                    for name in variants}
    body = build_rigid_body(settings_of(joints, 'P', features, window))
    samples = motion(body, window + count)
    windows = {}
    for name, model in models.items():
        for sample in samples[:window]:
            model.observe(model.predict(sample), finish=False)
        windows[name] = seconds(model.finish_window)
    times: dict[str, list[float]] = {name: [] for name in ('regressor', *variants)}
    for sample in samples[window:]:
        times['regressor'].append(seconds(lambda at=sample[1:4]: body.regressor(*at)))  # type: ignore[misc]
        for name, model in models.items():
            times[name].append(seconds(lambda model=model, sample=sample: model.step(sample)))  # type: ignore[misc]
    median = {name: 1e6 * float(np.median(each)) for name, each in times.items()}
    return Cost(len(joints), body.n_parameters, median.pop('regressor'), median, windows)


def recording(body: RigidBody, seconds: float, rate_hz: float = 100.0) -> Samples:
    """Sums of five slow sines on every joint, noise of encoders, and 2 % of noise on the efforts; the second joint's
    effort has viscous friction of 10 % of it."""
    rng, joints = np.random.default_rng(0), body.n_joints
    time_s = np.arange(int(seconds * rate_hz)) / rate_hz
    frequency, phase = rng.uniform(0.3, 3.0, (5, joints)), rng.uniform(0.0, 2.0 * np.pi, (5, joints))
    angle = time_s[:, None, None] * frequency + phase
    size = 0.15 / np.sqrt(frequency)
    moved = [(size * frequency**order * wave).sum(axis=1)
             for order, wave in enumerate((np.sin(angle), np.cos(angle), -np.sin(angle)))]
    stamps = (1e9 * time_s).astype(np.int64)
    outputs = body.outputs_of(Samples(stamps, *moved, np.zeros((len(stamps), body.n_outputs)), 0),
                              body.base_parameters)
    spread = outputs.std(axis=0)
    outputs[:, 1] += 0.1 * spread[1] * moved[1][:, 1] / moved[1][:, 1].std()
    outputs += 0.02 * spread * rng.standard_normal(outputs.shape)
    position, velocity, acceleration = (values + noise * rng.standard_normal(values.shape)
                                        for values, noise in zip(moved, (1e-4, 2e-3, 2e-2), strict=True))
    return Samples(stamps, position, velocity, acceleration, outputs, 0)


def diagnosed(joints: tuple[str, ...], seconds: float) -> str:
    """The row of the table of diagnoses."""
    body = build_rigid_body(settings_of(joints, 'P', 1, 1))
    samples = recording(body, seconds)
    start = time.process_time()
    found = diagnose(body, samples)
    used = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    named = ', '.join(f'{finding.effect.kind} at {finding.effect.where}' for finding in found.findings) or 'nothing'
    return f'| {len(joints)} | {body.n_parameters} | {used:.0f} | {peak:.2f} | {len(found.steps)} | {named} |'


def diagnoses(seconds: float) -> None:
    """One table row for each number of joints."""
    print('| joints | columns | diagnosis [s] | peak [GB] | rounds | found |')
    print('|---|---|---|---|---|---|')
    for joints in JOINTS:
        with ProcessPoolExecutor(1, multiprocessing.get_context('spawn')) as alone:
            print(alone.submit(diagnosed, joints, seconds).result(), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--features', type=int, default=200)
    parser.add_argument('--window', type=int, default=200, help='samples of the initial window (default: %(default)s)')
    parser.add_argument('--count', type=int, default=300, help='samples that are timed (default: %(default)s)')
    parser.add_argument('--diagnosis', action='store_true', help='diagnose a recording of each instead')
    parser.add_argument('--seconds', type=float, default=180.0, help='of that recording (default: %(default)s)')
    parser.add_argument('--json', type=Path, metavar='FILE')
    args = parser.parse_args()
    if args.diagnosis:
        diagnoses(args.seconds)
        return 0
    runs = []
    print('| joints | columns | regressor [us] | P [us] | SPK-ML [us] | window of P [s] | window of SPK-ML [s] |')
    print('|---|---|---|---|---|---|---|')
    for joints in JOINTS:
        cost = measure(joints, args.features, args.window, args.count)
        runs.append(cost._asdict())
        cells = [f'{cost.joints}', f'{cost.columns}', f'{cost.regressor_us:.0f}',
                 *(f'{value:.0f}' for value in cost.sample_us.values()),
                 *(f'{value:.1f}' for value in cost.window_s.values())]
        print(f'| {" | ".join(cells)} |', flush=True)
    if args.json:
        document = json.dumps({'command': 'many_joints', 'runs': runs}, indent=1)
        args.json.write_text(document + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
