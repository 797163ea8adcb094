"""Millions of samples: memory flat, everything finite, and without forgetting the batch solution.

    python benchmarks/long_run.py                    P and SPK, forgetting 1 and 0.998, 20 million samples each
    python benchmarks/long_run.py --variant P --forgetting 0.998 --samples 1000000

What runs is the recursion of the four-joint iCub arm (23 coupled columns, 6 outputs), with D = 50 features for SPK: it
predicts every sample, then learns it. The inputs are a cycle of 5000 states whose regressors and features are computed
once, so that the time goes into the recursion; the outputs have fresh noise in every sample.

As the inputs repeat, the batch solution of all samples is that of the mean outputs at each state, weighted by how often
the state came. It is found from one QR factorisation of those weighted rows and the prior's (no normal equations).
Three relative differences are given, each a Euclidean norm over a norm: of the coefficients theta, of the feature
weights alpha, and of the predictions at the states.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.random_features import RandomFeatures, input_scaling
from semiparam_ros.core.recursion import SemiParametricRecursion
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array

URDF = Path(__file__).resolve().parents[1] / 'config' / 'icub_right_arm.urdf'
JOINTS, SENSOR = ('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow'), 'r_arm_ft_sensor'
STATES = 5000
GAMMA, RHO, SIGMA, TAU = 0.3, 1.0, 0.1, (3.0,)
NOISE = 0.1  # [N], [N m]
REPORTS = 10


class Problem(NamedTuple):
    """A cycle of states and what the model sees of them."""

    columns: Array  # (STATES, n, p)
    phi: Array  # (STATES, D)
    outputs: Array  # (STATES, n) without noise
    prior_std: Array  # (p,)


def problem(features: int) -> Problem:
    """Joints that move by sums of sines; a hand heavier than described, an offset, and a bump no column explains."""
    rng = np.random.default_rng(0)
    body = RigidBody.from_urdf(URDF.read_text(), JOINTS, 'wrench', SENSOR)
    time_s = np.arange(STATES)[:, None, None] * 0.02
    rate, phase = rng.uniform(0.5, 5.0, (1, body.n_joints, 3)), rng.uniform(0.0, 2 * np.pi, (1, body.n_joints, 3))
    angle = rate * time_s + phase
    motion = (0.3 * np.sin(angle).sum(2), 0.3 * (rate * np.cos(angle)).sum(2), -0.3 * (rate**2 * np.sin(angle)).sum(2))
    stamps = (np.arange(STATES) * 20_000_000).astype(np.int64)
    samples = Samples(stamps, *motion, np.zeros((STATES, body.n_outputs)), 0)
    coupled = CoupledColumns(body)
    columns, _ = coupled.batch(samples)
    theta = 1.2 * coupled.prior_mean + np.where(coupled.prior_mean == 0.0, 0.5, 0.0)
    outputs = columns @ theta + 0.5 * np.sin(3.0 * samples.position[:, :1])
    phi = np.zeros((STATES, 0))
    if features:
        phi = RandomFeatures(samples.inputs.shape[1], features, 0, TAU, *input_scaling(samples.inputs)).batch(
            samples.inputs)
    return Problem(columns, phi, outputs, GAMMA * coupled.prior_scale)


def resident_mb() -> float:
    """Resident memory of this process [MB]."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') / 1e6


def run(variant: str, forgetting: float, samples: int, features: int) -> dict[str, Any]:
    """Figures of one run, in SI units."""
    given = problem(features if variant.startswith('SPK') else 0)
    n = given.outputs.shape[1]
    recursion = SemiParametricRecursion(n, given.phi.shape[1], given.prior_std, RHO, SIGMA, forgetting=forgetting)
    rng = np.random.default_rng(1)
    sums, counts = np.zeros_like(given.outputs), np.zeros(STATES)
    memory, error = [], 0.0
    started, cpu, done = time.monotonic(), time.process_time(), 0
    report_at = [samples * (index + 1) // REPORTS for index in range(REPORTS)]
    while done < samples:
        count = min(STATES, samples - done)
        measured = given.outputs[:count] + NOISE * rng.standard_normal((count, n))
        predicted = [_step(recursion, phi, columns, outputs) for phi, columns, outputs in
                     zip(given.phi[:count], given.columns[:count], measured, strict=True)]
        if not np.isfinite(predicted).all():
            raise SystemExit(f'{variant}, forgetting {forgetting}: a prediction of the samples from {done} on is not '
                             'finite.')
        error = float(np.sqrt(np.mean((np.array(predicted) - given.outputs[:count]) ** 2)))
        sums[:count] += measured
        counts[:count] += 1.0
        done += count
        while report_at and done >= report_at[0]:
            memory.append({'samples': done, 'resident_mb': round(resident_mb(), 2)})
            report_at.pop(0)
            print(f'{variant} forgetting {forgetting:g}: {done} samples, {memory[-1]["resident_mb"]} MB, '
                  f'{time.monotonic() - started:.0f} s', file=sys.stderr, flush=True)
    figures = {'variant': variant, 'forgetting': forgetting, 'samples': done, 'features': given.phi.shape[1],
               'duration_s': time.monotonic() - started, 'update_us': 1e6 * (time.process_time() - cpu) / done,
               'memory': memory, 'finite': _finite(recursion), 'rmse_last_cycle': error, 'noise': NOISE,
               'relative_difference': None}
    if forgetting == 1.0:
        seen = counts > 0.0
        weights = batch(given, sums, counts)
        figures['relative_difference'] = differences(recursion, weights, Problem(
            given.columns[seen], given.phi[seen], given.outputs[seen], given.prior_std))
    return figures


def _step(recursion: SemiParametricRecursion, phi: Array, columns: Array, outputs: Array) -> Array:
    """Predict, then learn, one sample."""
    prior = recursion.predict(phi, columns)
    recursion.learn(prior, outputs)
    return prior.mean


def _finite(recursion: SemiParametricRecursion) -> bool:
    return all(bool(np.isfinite(values).all()) for values in recursion.state().values())


def batch(given: Problem, sums: Array, counts: Array) -> Array:
    """(p + n D,) theta, then the feature weights of each output: the least-squares solution of all samples."""
    n, (p, features) = given.outputs.shape[1], (given.columns.shape[2], given.phi.shape[1])
    seen = counts > 0.0
    weight = np.sqrt(counts[seen]) / SIGMA
    each = np.einsum('ij,td->tijd', np.eye(n), given.phi[seen]).reshape(int(seen.sum()), n, n * features)
    rows = weight[:, None, None] * np.concatenate([given.columns[seen], each], axis=2)
    right = weight[:, None] * sums[seen] / counts[seen, None]
    deviation = np.concatenate([given.prior_std, np.full(n * features, RHO)])
    stacked = np.vstack([rows.reshape(-1, p + n * features), np.diag(1.0 / deviation)])
    q, r = np.linalg.qr(stacked)
    return np.asarray(np.linalg.solve(r, q.T @ np.concatenate([right.ravel(), np.zeros(len(deviation))])))


def differences(recursion: SemiParametricRecursion, expected: Array, given: Problem) -> dict[str, float | None]:
    """|ours - batch| / |batch| of theta, of alpha (None without features), and of the predictions at every state."""
    p, n = len(recursion.theta), given.outputs.shape[1]
    alpha, ours = expected[p:].reshape(n, -1), recursion.weights()

    def predictions(theta: Array, weights: Array) -> Array:
        return given.columns @ theta + given.phi @ weights.T

    def relative(mine: Array, theirs: Array) -> float:
        return float(np.linalg.norm(mine - theirs) / np.linalg.norm(theirs))

    return {'theta': relative(recursion.theta, expected[:p]), 'alpha': relative(ours, alpha) if ours.size else None,
            'predictions': relative(predictions(recursion.theta, ours), predictions(expected[:p], alpha))}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--samples', type=int, default=20_000_000, help='samples of each run (default: %(default)s)')
    parser.add_argument('--variant', nargs='+', choices=('P', 'SPK-ML'), default=['P', 'SPK-ML'])
    parser.add_argument('--forgetting', nargs='+', type=float, default=[1.0, 0.998])
    parser.add_argument('--features', type=int, default=50, help='D of SPK (default: %(default)s)')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all figures there')
    args = parser.parse_args()
    runs = [run(variant, forgetting, args.samples, args.features)
            for variant in args.variant for forgetting in args.forgetting]
    text = json.dumps({'command': 'long_run', 'runs': runs}, indent=1)
    print(text)
    if args.json:
        args.json.write_text(text + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
