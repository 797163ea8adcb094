"""Before and after, on data that did not fit the model: normalised errors, horizon errors, and their confidence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypedDict

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.horizon_error import force_and_torque
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples, variance
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import counted_outputs
from semiparam_ros.diagnosis.data.splits import ranges
from semiparam_ros.diagnosis.regression import Fit


class EvaluationFigures(TypedDict):
    """An evaluation in the machine-readable report: (n,) by output, or means; ``eps_force`` is None for efforts."""

    nmse: list[float]
    rmse: list[float]
    nmse_mean: float
    nmse_mean_interval: list[float]
    eps_force: float | None
    eps_torque: float


@dataclass(frozen=True)
class Evaluation:
    """Errors of one model on held-out samples. ``residual``, ``outputs`` and ``counted``: (N, n) of those alone."""

    outputs: Array
    residual: Array
    counted: Mask  # outputs that tell something
    parts: tuple[tuple[int, int], ...]  # contiguous runs of the held-out samples
    wrench: bool
    config: DiagnosisConfig = DEFAULTS

    @property
    def rmse(self) -> Array:
        """(n,) root mean square error, in the outputs' units."""
        return np.asarray(np.sqrt(np.mean(self._squares, axis=0)))

    @property
    def nmse(self) -> Array:
        """(n,) mean square error over the variance of the channel."""
        return np.asarray(np.mean(self._squares, axis=0) / self.variance)

    @property
    def eps(self) -> Array:
        """(n,) relative squared error over ``config.horizon`` samples, mean over all such horizons inside the parts."""
        residual, outputs = self.residual * self.counted, self.outputs * self.counted
        shares = [_horizon_shares(residual[start:end], outputs[start:end], self.config.horizon)
                  for start, end in self.parts]
        stacked = np.concatenate([share for share in shares if len(share)] or [np.zeros((1, self.outputs.shape[1]))])
        known = np.isfinite(stacked)
        return np.asarray(np.where(known, stacked, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1))

    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the mean normalised error, from a bootstrap of contiguous blocks."""
        share = (self._squares / self.variance).mean(axis=1)
        low, high = self._mean_interval(share)
        return float(low), float(high)

    def square_intervals(self) -> Array:
        """(n, 2) the same of each output's mean squared error, in the output's units squared."""
        return self._mean_interval(self._squares).T

    @property
    def _squares(self) -> Array:
        """(N, n) squared errors, zero where an output does not count and more elsewhere: means are right."""
        counted = self.counted / np.maximum(self.counted.mean(axis=0), 1e-300)
        return np.asarray(self.residual**2 * counted)

    @property
    def variance(self) -> Array:
        """(n,) variance of the outputs that count, in their units squared; infinite where nothing changes, so that no
        error is a share of it."""
        found = np.array([variance(values[use]) if use.any() else 0.0
                          for values, use in zip(self.outputs.T, self.counted.T, strict=True)])
        return np.where(found > 0.0, found, np.inf)

    def _mean_interval(self, values: Array) -> Array:
        """(2, ...) confidence interval of the mean of values (N, ...)."""
        count = max(len(values) // self.config.bootstrap_block, 1)
        means = np.array([block.mean(axis=0) for block in np.array_split(values, count)])
        draws = np.random.default_rng(0).integers(count, size=(self.config.bootstrap_draws, count))
        return np.asarray(np.percentile(means[draws].mean(axis=1), self.config.confidence_percentiles, axis=0))

    def as_dict(self) -> EvaluationFigures:
        """The entry ``before`` or ``after`` of the machine-readable report."""
        eps = self.eps
        force, torque = force_and_torque(eps) if self.wrench else (None, float(eps.mean()))
        return {'nmse': self.nmse.tolist(), 'rmse': self.rmse.tolist(), 'nmse_mean': float(self.nmse.mean()),
                'nmse_mean_interval': list(self.interval()), 'eps_force': force, 'eps_torque': torque}


def _horizon_shares(residual: Array, outputs: Array, horizon: int) -> Array:
    sums = [np.lib.stride_tricks.sliding_window_view(values**2, horizon, axis=0).sum(axis=-1)
            if len(values) >= horizon else np.zeros((0, values.shape[1])) for values in (residual, outputs)]
    return np.asarray(np.divide(sums[0], sums[1], out=np.full_like(sums[0], np.nan), where=sums[1] > 0.0))


def evaluation_of(body: RigidBody, outputs: Array, residual: Array, valid: Mask,
                  config: DiagnosisConfig = DEFAULTS, counted: Mask | None = None) -> Evaluation:
    """The errors (N, n) of the samples ``valid`` (N,), of these the outputs ``counted`` (N, n); all unless given."""
    counted = np.ones(outputs.shape, dtype=bool) if counted is None else counted
    counted = counted | ~counted[valid].any(axis=0)  # of a joint that never moves there, everything is all there is
    ends = np.cumsum([high - low for low, high in ranges(valid)]).astype(int).tolist()
    parts = tuple(pairwise([0, *ends]))
    return Evaluation(outputs[valid], residual[valid], counted[valid], parts,
                      body.outputs == 'wrench', config)


def evaluate_here(fit: Fit, held_out: Mask) -> Evaluation:
    """The model on held-out samples of its own recording."""
    return evaluation_of(fit.body, fit.samples.outputs, fit.residual, held_out, fit.config, fit.counted)


def evaluate_described(fit: Fit, held_out: Mask) -> Evaluation:
    """The same with the inertias of the robot description, and the rest of the model at its best beside them."""
    predicted = fit.design.predicted(fit.theta_beside(fit.body.base_parameters))
    return evaluate_here(replace(fit, residual=fit.samples.outputs - predicted), held_out)


def evaluate_there(fit: Fit, samples: Samples, valid: Mask) -> Evaluation:
    """The model on another recording: what began during the first one counts as there from the start.

    What belongs to the first recording's own clock (a drift, a phase) is left out, and what ended before its end.
    """
    effects = [effect.without_span() for effect in fit.effects]
    assembly = CoupledColumns(fit.body, effects)
    theta = fit.theta.copy()
    for index, effect in enumerate(effects):
        if effect.of_one_recording or fit.effects[index].ends:
            theta[assembly.blocks[str(index)]] = 0.0
    columns, _ = assembly.batch(samples)
    there = replace(fit, samples=samples, residual=samples.outputs - columns @ theta,
                    counted=counted_outputs(fit.body, samples, fit.config))
    return evaluate_here(there, valid)
