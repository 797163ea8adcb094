"""What a reader should know of a recording before believing what is found in it; the diagnosis goes on all the same."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import typical_step

FINEST_LAG = 0.25
"""Lags are tried in steps of this share of a sample's time."""


def doubts(body: RigidBody, samples: Samples, config: DiagnosisConfig = DEFAULTS) -> list[str]:
    """Sentences about the recorded motion, each with its remedy; empty when all is well."""
    moving = np.ptp(samples.position, axis=0) > config.setup_least_motion
    if len(samples) < config.setup_least_samples or not moving.any():
        return []
    return _together(body, samples, moving, config) + _late_velocities(body, samples, moving, config)


def _together(body: RigidBody, samples: Samples, moving: Mask, config: DiagnosisConfig) -> list[str]:
    """Joints that all follow one or two functions of time."""
    position = samples.position[:, moving]
    sizes = np.linalg.svd(position - position.mean(axis=0), compute_uv=False)
    directions = int(np.sum(sizes > config.direction_share * sizes[0]))
    if directions > config.few_directions or int(moving.sum()) <= directions + 1:
        return []
    how = 'one direction' if directions == 1 else f'{directions} directions'
    return [f'The {int(moving.sum())} joints move along {how} only, as one sine for all of them would: what one joint '
            'lacks looks like what another lacks. Record motion in which each joint has frequencies of its own.']


def _late_velocities(body: RigidBody, samples: Samples, moving: Mask, config: DiagnosisConfig) -> list[str]:
    """Velocities that come later than the positions change, as filters make them."""
    lag = velocity_lag(samples, moving, config)
    if lag < config.lag_steps * typical_step(samples.time):
        return []
    return [f'The recorded velocities lag the positions by {lag:.2g} s, as a filter makes them: publish them '
            f'unfiltered, or declare velocity_filter{{"time_constant_s": {lag:.2g}}}. Until then a friction or a delay '
            'found here may be off.']


def velocity_lag(samples: Samples, moving: Mask, config: DiagnosisConfig = DEFAULTS) -> float:
    """Time [s] by which the velocities of the moving joints follow the change of their positions; 0 when they do not.

    Compares changes of position over ``span_s`` with integrals of the velocity over later spans.
    """
    time, step = samples.time, typical_step(samples.time)
    span = max(config.span_s, 2.0 * step)
    pieces = 0.5 * (samples.velocity[1:] + samples.velocity[:-1]) * np.diff(time)[:, None]
    total = np.zeros(samples.velocity.shape, order='F')  # interpolated joint by joint
    total[1:] = np.cumsum(pieces, axis=0)
    starts = np.linspace(time[0], time[-1] - span - config.longest_lag_s, config.most_spans // 2)
    if time[-1] - time[0] < 4.0 * (span + config.longest_lag_s):
        return 0.0
    changes = _over(time, samples.position, starts, span)[:, moving]
    changes = changes / (changes.std(axis=0) + 1e-300)
    lags = np.arange(0.0, config.longest_lag_s, FINEST_LAG * step)
    left = np.array([_unlike(changes, _over(time, total, starts + lag, span)[:, moving]) for lag in lags])
    best = int(left.argmin())
    return float(lags[best]) if left[best] < config.lag_worth * left[0] else 0.0


def _over(time: Array, values: Array, starts: Array, span: float) -> Array:
    """(M, k) changes of values (N, k) from each start over the span."""
    return np.column_stack([np.interp(starts + span, time, column) - np.interp(starts, time, column)
                            for column in values.T])


def _unlike(changes: Array, others: Array) -> float:
    """Share of the changes (M, k) that no multiple of the others explains, mean over the joints."""
    inner = np.sum(changes * others, axis=0) ** 2
    size = np.sum(changes**2, axis=0) * np.sum(others**2, axis=0)
    return float(np.mean(1.0 - np.divide(inner, size, out=np.zeros_like(inner), where=size > 0.0)))
