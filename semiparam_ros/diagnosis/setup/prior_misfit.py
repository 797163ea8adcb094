"""Evidence of a recording under one labelling, when inertias may be wrong by a third but not absurd.

Base parameters alone can absorb a wrong sign or a mirrored joint: with absurd masses. So two labellings
compare by their evidence: the likelihood with theta ~ N(theta_urdf, W^-2) and free nuisances (the sensor's offset, or
each joint's offset, friction, rotor inertia and spring) integrated out, at the number of samples whose residuals are
independent. The noise of each channel has its most likely size, beside a share of the channel's variance
by which any description is wrong. Friction takes energy out of a joint, but for what that share could put in: that is
part of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import log_ndtr

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import inertial_scale
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.config import DiagnosisConfig


@dataclass(frozen=True, eq=False)
class Equations:
    """Normal equations of the inputs alone, for any outputs."""

    columns: Array  # (N, n, c) psi beside the nuisances
    mean: Array  # (c,) the description's base parameters, then zeros
    precision: Array  # (c, c) of the parameters about the mean; zero for the nuisances
    config: DiagnosisConfig
    speed: Array  # (n,) root mean square speed of the joints; (0,) of a wrench
    power: Array  # (n, c) mean power of each joint's friction; (0, c) of a wrench

    @cached_property
    def size(self) -> Array:
        """(c,) of each column, the largest of all channels."""
        size = np.sqrt(np.max(np.mean(self.columns**2, axis=0), axis=0))
        return np.where(size > 0.0, size, 1.0)

    @cached_property
    def scaled(self) -> Array:
        """(n, N, c) columns over their size."""
        return np.ascontiguousarray((self.columns / self.size).transpose(1, 0, 2))

    @cached_property
    def grams(self) -> Array:
        """(n, c, c) products of each channel's scaled columns."""
        return self.scaled.transpose(0, 2, 1) @ self.scaled


def equations(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Equations:
    """Equations by which the inputs of ``samples`` predict."""
    own, free = body.n_parameters, nuisances(body, samples, config)
    columns = np.concatenate([body.regressors(samples), free], axis=2)
    mean, precision = np.zeros(columns.shape[2]), np.zeros((columns.shape[2],) * 2)
    mean[:own], precision[:own, :own] = body.base_parameters, _precision(body, config.inertia_deviation)
    if body.outputs == 'wrench':
        return Equations(columns, mean, precision, config, np.zeros(0), np.zeros((0, len(mean))))
    count, power = body.n_outputs, np.zeros((body.n_outputs, len(mean)))
    moved = samples.velocity[:, body.output_index]
    friction = slice(own + count, own + 3 * count)  # viscous, then dry
    power[:, friction] = np.mean(columns[:, :, friction] * moved[:, :, None], axis=0)
    return Equations(columns, mean, precision, config, np.sqrt(np.mean(moved**2, axis=0)), power)


class MisfitEvidence(NamedTuple):
    """Log evidence [nat] of the outputs, and the parameters' (c,) most likely departure from the mean."""

    log: float
    change: Array


def evidence(equal: Equations, outputs: Array, share: float = 1.0) -> MisfitEvidence:
    """Log evidence of outputs (N, n) when ``share`` of the samples count; -inf where no inertias can be estimated."""
    deviation, telling = channel_scale(outputs, not len(equal.power)), np.ptp(outputs, axis=0) > 0.0
    size, count = equal.size, len(outputs)
    precision = equal.precision + np.diag(_nuisance_precision(equal, size, deviation))
    left = outputs - equal.columns @ equal.mean
    grams, squares = equal.grams[telling], np.sum(left[:, telling] ** 2, axis=0)
    moments = np.matmul(left.T[telling, None], equal.scaled[telling])[:, 0]
    noise = deviation[telling]
    for _ in range(equal.config.rounds):
        weight = share / noise**2
        try:
            factor = cho_factor(np.tensordot(weight, grams, 1) + precision / np.outer(size, size))
        except np.linalg.LinAlgError:  # the motion is so large that doubles do not hold what inertias change
            return MisfitEvidence(-np.inf, np.zeros(len(size)))
        scaled = cho_solve(factor, weight @ moments)
        residual = squares - 2.0 * moments @ scaled + (grams @ scaled) @ scaled
        noise = np.sqrt(np.maximum(residual, 0.0) / count + equal.config.model_error * deviation[telling] ** 2)
    change = scaled / size
    likelihood = -share * count * float(np.log(noise).sum()) - 0.5 * float(change @ precision @ change)
    likelihood += 0.5 * float(np.linalg.slogdet(precision)[1]) - float(np.log(np.diag(factor[0]) * size).sum())
    return MisfitEvidence(likelihood + _braking(equal, change, deviation, factor, size), change)


def share_left(equal: Equations, outputs: Array) -> float:
    """Share of the variance of outputs (N, n) that the likeliest inertias and nuisances leave, mean of the channels
    that vary; all of it where none does."""
    telling = np.ptp(outputs, axis=0) > 0.0
    if not telling.any():
        return 1.0
    left = outputs - equal.columns @ (equal.mean + evidence(equal, outputs).change)
    return float(np.mean((left / channel_scale(outputs, not len(equal.power)))[:, telling] ** 2))


def independent(equal: Equations, outputs: Array, change: Array) -> float:
    """Share of the samples whose residuals are independent."""
    residual = outputs - equal.columns @ (equal.mean + change)
    residual = residual[:, np.ptp(outputs, axis=0) > 0.0]
    alike = np.clip(np.sum(residual[1:] * residual[:-1], axis=0) / np.sum(residual**2, axis=0), 0.0, 1.0)
    return float(np.mean((1.0 - alike) / (1.0 + alike)))


def _nuisance_precision(equal: Equations, size: Array, deviation: Array) -> Array:
    """(c,) that of nuisances which may be as large as what their channel shows; zero for the others."""
    free = np.diag(equal.precision) == 0.0
    channel = np.abs(equal.columns).max(axis=0).argmax(axis=0)
    return np.where(free, (size / deviation[channel]) ** 2, 0.0)


def _braking(equal: Equations, change: Array, deviation: Array, factor: tuple[Array, bool], size: Array) -> float:
    """Log of how much likelier friction takes energy than before the outputs were known, over all joints."""
    power = equal.power.T / size[:, None]
    variance = np.sum(power * cho_solve(factor, power), axis=0) if power.size else np.zeros(0)
    variance = variance + equal.config.model_error * (deviation[:len(variance)] * equal.speed) ** 2 + 1e-300
    return float(np.sum(np.log(2.0) + log_ndtr(equal.power @ change / np.sqrt(variance))))


def channel_scale(outputs: Array, wrench: bool) -> Array:
    """(n,) standard deviations: one for all forces and one for all torques, or one for each joint's effort."""
    variance = outputs.var(axis=0)
    if wrench:
        variance = np.repeat([variance[:3].mean(), variance[3:].mean()], 3)
    return np.asarray(np.sqrt(np.maximum(variance, 1e-12 * variance.max() + 1e-300)))


def nuisances(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Array:
    """(N, n, c) a wrench's offset; each joint's offset, dry and viscous friction, rotor inertia and spring."""
    identity = np.eye(body.n_outputs)
    if body.outputs == 'wrench':
        return np.broadcast_to(identity, (len(samples), *identity.shape))
    moved = samples.velocity[:, body.output_index]
    turn = config.friction_turn_share * np.abs(moved).max(axis=0) + 1e-12  # [rad/s] of dry friction
    parts = (np.ones_like(moved), moved, np.tanh(moved / turn),
             samples.acceleration[:, body.output_index], samples.position[:, body.output_index])
    return np.concatenate([part[:, :, None] * identity for part in parts], axis=2)


@lru_cache(maxsize=4)
def _precision(body: RigidBody, deviation: float) -> Array:
    """(p, p) of the base parameters when inertial parameters are known to the share ``deviation`` of their size."""
    deviations = deviation * inertial_scale(body)
    covariance = (body.basis.T * deviations**2) @ body.basis
    covariance += 1e-9 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    return np.asarray(np.linalg.inv(covariance))
