"""Parts of `semiparam bench`: an arm that moves, other recursions, evidence of a window."""

from __future__ import annotations

import math
import statistics
import time
from pathlib import Path

import numpy as np
from scipy.linalg.blas import dgemv, dger, drot, dsymv, dsyr, dtrsv

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.hyperparameters.marginal_likelihood import Point, Window, evidence
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body

PERIOD_NS = 1_000_000
NOISE = 0.05

SIGMA = 0.1

WINDOW, EVALUATIONS = 1000, 5


def arm(urdf: str | Path, frame: str) -> RigidBody:
    """The wrench regressor of an arm whose joints all move."""
    return build_rigid_body(Settings(robot_description_file=str(urdf), sensor_frame=frame))


def estimator(body: RigidBody, count: int) -> Estimator:
    """SPK with D = ``count`` that is past its initial window: hyperparameters do not change what a sample costs."""
    size = 3 * body.n_joints
    given = Hyperparameters(gamma=1.0, rho=1.0, tau=(1.0, 3.0, 6.0), sigma=0.1, output_scale=(1.0,) * body.n_outputs)
    return Estimator(body, ModelOptions(variant='SPK-ML', features_count=count, length_scales='kind',
                                        hyperparameters=given, input_mean=(0.0,) * size, input_scale=(1.0,) * size))


def motion(body: RigidBody, length: int, seed: int = 0) -> list[Sample]:
    """Sinusoids on every joint at 1 kHz, and the wrenches of the URDF's inertias with white noise."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(2.0, 6.0, body.n_joints), rng.uniform(0.0, 2.0 * np.pi, body.n_joints)
    samples = []
    for index in range(length):
        angle = frequency * index * PERIOD_NS * 1e-9 + phase
        position, velocity, acceleration = np.sin(angle), frequency * np.cos(angle), -(frequency**2) * np.sin(angle)
        outputs = body.regressor(position, velocity, acceleration) @ body.base_parameters
        noise = NOISE * rng.standard_normal(body.n_outputs)
        samples.append(Sample(index * PERIOD_NS, position, velocity, acceleration, outputs + noise))
    return samples


class Covariance:
    """Covariance P alone, as a symmetric matrix: k = P phi, P -= k k' / (sigma^2 + phi'k).
    Cheapest, and the least accurate."""

    def __init__(self, n_features: int) -> None:
        self._covariance = np.asfortranarray(np.eye(n_features))

    def update(self, phi: Array) -> None:
        """Learn that the features (D,) were seen; weights are not kept."""
        gain = dsymv(1.0, self._covariance, phi)
        dsyr(-1.0 / (SIGMA**2 + float(phi @ gain)), gain, a=self._covariance, overwrite_a=1)


class Potter:
    """The square root S of P alone, by Potter's update: what ours does to the features and nothing else."""

    def __init__(self, n_features: int) -> None:
        self._root = np.asfortranarray(np.eye(n_features))

    def update(self, phi: Array) -> None:
        """Learn that the features (D,) were seen; weights are not kept."""
        f = dgemv(1.0, self._root, phi, trans=1)
        s = SIGMA**2 + float(f @ f)
        gain = dgemv(1.0, self._root, f)
        dger(-1.0 / (s + SIGMA * math.sqrt(s)), gain, f, a=self._root, overwrite_a=1)


class Dense:
    """The textbook's recursion on all p + D n unknowns: a Cholesky factor, one rank-1 update for each output.

    The factor R (R'R = information) is stored by rows.

    :param together: pass over the factor once a sample with all n rows, instead of once for each row: the same
        rotations in another order, kinder to the caches than the textbook.
    """

    def __init__(self, n_columns: int, n_features: int, n_outputs: int, together: bool = False) -> None:
        self.size = n_columns + n_features * n_outputs
        self.n_outputs, self.together = n_outputs, together
        self._factor = np.eye(self.size)
        self._rhs = np.zeros(self.size)
        self.unknowns = np.zeros(self.size)

    def update(self, columns: Array, phi: Array, outputs: Array) -> None:
        """Learn one sample: coupled columns (n, p), features (D,), outputs (n,); solve for the unknowns."""
        rows = np.hstack([columns, np.kron(phi, np.eye(self.n_outputs))]) / SIGMA
        self._rhs += rows.T @ outputs / SIGMA
        for several in [rows] if self.together else rows[:, None]:
            self._rotate(several)
        half = dtrsv(self._factor.T, self._rhs, lower=1)
        self.unknowns = dtrsv(self._factor.T, half, lower=1, trans=1)

    def _rotate(self, rows: Array) -> None:
        """Givens rotations of each row of R with the new rows; scipy has no rank-1 update of a Cholesky factor."""
        flat, size = self._factor.reshape(-1), self.size
        for index in range(size):
            start = index * (size + 1)
            for row in rows:
                diagonal, below = flat[start], row[index]
                if below == 0.0:
                    continue
                radius = math.hypot(diagonal, below)
                drot(flat, row, diagonal / radius, below / radius, n=size - index, offx=start, offy=index,
                     overwrite_x=1, overwrite_y=1)


def evidence_seconds(body: RigidBody, count: int) -> float:
    """Median seconds of the log marginal likelihood of SPK and its gradient: 1000 samples, D = ``count``."""
    window, at = _window(body, count)
    seconds = []
    for _ in range(EVALUATIONS):
        start = time.perf_counter()
        evidence(window, at)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def _window(body: RigidBody, count: int) -> tuple[Window, Point]:
    samples = motion(body, WINDOW)
    coupled = np.stack([body.regressor(*sample[1:4]) for sample in samples])
    inputs = np.stack([np.concatenate(sample[1:4]) for sample in samples])
    inputs = (inputs - inputs.mean(axis=0)) / inputs.std(axis=0)
    spectrum = np.random.default_rng(0).standard_normal((count // 2, inputs.shape[1]))
    groups = np.repeat(np.arange(3), body.n_joints)
    outputs = np.stack([sample.outputs for sample in samples])
    at = Point(1.0, 1.0, np.array([1.0, 3.0, 6.0]), 0.1, np.ones(body.n_outputs), 0.1, 100.0)
    return Window(outputs, coupled, inputs, spectrum, groups, np.ones(body.n_parameters)), at
