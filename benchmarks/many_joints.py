"""What a sample and the initial window cost as joints grow: the iCub of the package icub-models, joint efforts.

    pip install icub-models
    python benchmarks/many_joints.py

SPK and P predict and learn samples of sines on every joint, in turns; n joints have n outputs. The regressor alone
beside them.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
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


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--features', type=int, default=200)
    parser.add_argument('--window', type=int, default=200, help='samples of the initial window (default: %(default)s)')
    parser.add_argument('--count', type=int, default=300, help='samples that are timed (default: %(default)s)')
    args = parser.parse_args()
    print('| joints | columns | regressor [us] | P [us] | SPK-ML [us] | window of P [s] | window of SPK-ML [s] |')
    print('|---|---|---|---|---|---|---|')
    for joints in JOINTS:
        cost = measure(joints, args.features, args.window, args.count)
        cells = [f'{cost.joints}', f'{cost.columns}', f'{cost.regressor_us:.0f}',
                 *(f'{value:.0f}' for value in cost.sample_us.values()),
                 *(f'{value:.1f}' for value in cost.window_s.values())]
        print(f'| {" | ".join(cells)} |', flush=True)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
