"""How badly a recording fits a robot description, when its inertias may be wrong by a third but not absurd.

Base parameters alone can absorb a wrong sign or a mirrored joint: with absurd masses. So the misfit is what least
squares leaves of the outputs, in variances, plus a price for every third that an inertial parameter moves away from the
robot description:

    J = min over theta, eta of  mean ((y - psi theta - N eta) / scale)^2  +  price |W (theta - theta_urdf)|^2

with free nuisances N: the sensor's offset, or each joint's offset, friction and rotor inertia.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.config import DiagnosisConfig

RIDGE = 1e-10


class Equations(NamedTuple):
    """Normal equations of the inputs alone, for any outputs."""

    columns: Array  # (N, n, c) psi beside the nuisances
    mean: Array  # (c,) the description's base parameters, then zeros
    price: Array  # (c, c) of moving away from the mean


class Misfit(NamedTuple):
    """J, and the part of it that the outputs leave [mean share of variance]."""

    total: float
    left: float


def equations(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Equations:
    """What the inputs of ``samples`` predict."""
    columns = np.concatenate([body.regressors(samples), nuisances(body, samples, config)], axis=2)
    mean, price = np.zeros(columns.shape[2]), np.zeros((columns.shape[2],) * 2)
    mean[:body.n_parameters] = body.base_parameters
    price_of_one = config.wrench_price if body.outputs == 'wrench' else config.effort_price
    price[:body.n_parameters, :body.n_parameters] = price_of_one * _precision(body, config.inertia_deviation)
    return Equations(columns, mean, price)


def misfit(equal: Equations, outputs: Array, wrench: bool) -> Misfit:
    """J for outputs (N, n)."""
    change, residual = _solved(equal, outputs, wrench)
    squares = float(residual @ residual)
    return Misfit(squares + float(change @ equal.price @ change), squares)


def _solved(equal: Equations, outputs: Array, wrench: bool) -> tuple[Array, Array]:
    """(c,) the least squares' departure from the mean, and (N n,) what it leaves, whose squares sum to a share."""
    scale = channel_scale(outputs, wrench)
    weight = 1.0 / np.sqrt(outputs.size)
    rows = (equal.columns * (weight / scale)[:, None]).reshape(-1, equal.columns.shape[2])
    left = ((outputs - equal.columns @ equal.mean) * (weight / scale)).ravel()
    normal = rows.T @ rows + equal.price
    size = 1.0 / np.sqrt(np.diag(normal) + 1e-300)
    factor = cho_factor(normal * np.outer(size, size) + RIDGE * np.eye(len(size)))
    change = cho_solve(factor, (rows.T @ left) * size) * size
    return change, left - rows @ change


def dissipation(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Array:
    """(n,) how much of each joint's effort is friction that goes with its velocity: 1 all of it, -1 all of it
    with the opposite sign, which would feed energy into the joint."""
    count, moved = body.n_outputs, samples.velocity[:, body.output_index]
    change, _ = _solved(equations(body, samples, config), samples.outputs, False)
    viscous, dry = change[body.n_parameters + count:body.n_parameters + 3 * count].reshape(2, count)
    friction = viscous * moved + dry * np.tanh(moved / _turn(moved, config))
    power = samples.outputs.std(axis=0) * np.sqrt(np.mean(moved**2, axis=0))
    return np.divide(np.mean(friction * moved, axis=0), power, out=np.zeros(count), where=power > 1e-12)


def _turn(velocity: Array, config: DiagnosisConfig) -> Array:
    """(n_joints,) speeds [rad/s] within which dry friction turns over."""
    return np.asarray(config.friction_turn_share * np.abs(velocity).max(axis=0) + 1e-12)


def channel_scale(outputs: Array, wrench: bool) -> Array:
    """(n,) standard deviations: one for all forces and one for all torques, or one for each joint's effort."""
    variance = outputs.var(axis=0)
    if wrench:
        variance = np.repeat([variance[:3].mean(), variance[3:].mean()], 3)
    return np.asarray(np.sqrt(np.maximum(variance, 1e-12 * variance.max() + 1e-300)))


def nuisances(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Array:
    """(N, n, c) a wrench's offset; each joint's offset, dry and viscous friction and rotor inertia."""
    identity = np.eye(body.n_outputs)
    if body.outputs == 'wrench':
        return np.broadcast_to(identity, (len(samples), *identity.shape))
    moved = samples.velocity[:, body.output_index]
    parts = (np.ones_like(moved), moved, np.tanh(moved / _turn(moved, config)),
             samples.acceleration[:, body.output_index])
    return np.concatenate([part[:, :, None] * identity for part in parts], axis=2)


def inertial_spread(body: RigidBody) -> Array:
    """(10 n_bodies,) how large mass, first moments and inertias of each body are, about the body's origin."""
    spread = []
    for parameters in body.inertial_parameters.reshape(-1, 10):
        mass = max(float(parameters[0]), 1e-3)
        reach = np.sqrt(max(float(parameters[[4, 6, 9]].sum()) / 2.0 / mass, 1e-6))
        spread += [mass, *[mass * reach] * 3, *[mass * reach**2] * 6]
    return np.array(spread)


@lru_cache(maxsize=4)
def _precision(body: RigidBody, deviation: float) -> Array:
    """(p, p) of the base parameters when inertial parameters are known to the share ``deviation`` of their size."""
    deviations = deviation * inertial_spread(body)
    covariance = (body.basis.T * deviations**2) @ body.basis
    covariance += 1e-9 * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    return np.asarray(np.linalg.inv(covariance))
