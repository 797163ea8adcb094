"""Predictions: what the models say of one sample, or of a desired state, before anything is learnt of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from semiparam_ros.core.columns import Memories
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.motion import Motion
from semiparam_ros.core.recursion import Prior
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array

HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)


class Observed(NamedTuple):
    """A sample as every model sees it."""

    sample: Sample
    x: Array  # (m,)
    columns: Array  # (n, p)
    memory: Memories
    motion: Motion
    beyond: float
    begins_step: bool
    measured: Array  # (n,) the outputs, with what tools and other known bodies add


class MemberPrediction(NamedTuple):
    """Prediction by one model, in N, N m."""

    mean: Array  # (n,)
    std: Array  # (n,) predictive, noise included, calibrated
    prior: Prior  # of the model alone, without wandering offset, not calibrated
    columns: Array  # (n, p) all of its C


class Prediction(NamedTuple):
    """Prediction of one sample before it is learnt, by all models together, in N, N m."""

    mean: Array  # (n,)
    std: Array  # (n,) predictive, noise included, calibrated
    model_mean: Array  # (n,) of the models alone, without the wandering offset
    model_std: Array  # (n,) of the models alone, not calibrated: what a gate or a detector of changes compares with
    ready: bool  # the initial window is over
    sample: Sample
    model_covariance: Array  # (n, n) of the models alone
    columns: Array  # (n, p) all of C
    memory: Memories
    motion: Motion
    beyond: float
    """How far the inputs lie outside of those learnt, see :func:`~semiparam_ros.core.input_range.beyond`."""
    begins_step: bool = True
    """Whether a window may take it, see :func:`~semiparam_ros.core.motion.begins_step`."""
    members: tuple[MemberPrediction, ...] = ()
    """By each of the models."""
    off: bool = False
    """Whether the motors are off behind brakes: nothing moves, and all outputs are far smaller than predicted."""
    horizon: HorizonErrors | None = None
    """The one that it completed, once it is learnt."""

    @property
    def log_density(self) -> float:
        """Log density of the measured outputs, by mean and std as published [nat]; NaN outputs give NaN."""
        factor = self.std / self.model_std
        innovation = (self.sample.outputs - self.mean) / factor
        return log_density(innovation, self.model_covariance) - float(np.log(factor).sum())

    def by_member(self, index: int) -> Prediction:
        """The same by one of the models alone."""
        member = self.members[index]
        prior = member.prior
        return self._replace(mean=member.mean, std=member.std, model_mean=prior.mean, model_std=prior.std,
                             model_covariance=prior.covariance, columns=member.columns,
                             members=(member,))


class DesiredOutputs(NamedTuple):
    """Outputs of a desired motion, (n,) each, in N and N m."""

    shown: Array  # by the sensor
    needed: Array  # by the arm: without the sensor's offset and effects
    covariance: Array  # (n, n) of what is shown, noise included
    variance_ratio: float
    """The largest over the outputs: variance of model and noise, over that of twice the noise's standard deviation."""
    distance: float = 0.0
    """From the inputs learnt, over the largest of these: see :mod:`semiparam_ros.core.learnt_inputs`."""


def log_density(innovation: Array, covariance: Array) -> float:
    """Log of N(innovation; 0, covariance), for (n,) and (n, n) [nat]."""
    lower, _ = dpotrf(covariance, lower=1)
    white, _ = dtrtrs(lower, innovation, lower=1)
    return float(-0.5 * white @ white - np.log(lower.diagonal()).sum() - len(white) * HALF_LOG_2PI)
