"""The initial window whose evidence `semiparam bench` times: one evaluation with its gradient."""

from __future__ import annotations

import statistics
import time

import numpy as np

from semiparam_ros.cli.bench_arm import motion
from semiparam_ros.core.evidence import Point, Window, evidence
from semiparam_ros.core.rigid_body import RigidBody

WINDOW, EVALUATIONS = 1000, 5


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
