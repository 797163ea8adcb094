"""Parameters that the model has learnt, as quantities with names, units and standard deviations,
and whether the robot has moved enough to identify them."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg import eigh, null_space

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.input_range import widen
from semiparam_ros.core.model import Model
from semiparam_ros.core.robot.frames import last_link, load_seen_from, load_transform
from semiparam_ros.core.robot.joint_friction import NAMES, UNITS
from semiparam_ros.core.robot.rigid_body import RigidBody, remembered
from semiparam_ros.core.robot.size import base_scale, inertial_scale
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array
from semiparam_ros.effects.base import spelling

TINY = 1e-300
MOVED_ENOUGH = 0.05
"""[rad, m] A joint whose range is smaller tells next to nothing of what depends on its position."""

SMALLEST_MASS = 1e-3
"""[kg] A lighter payload has no centre of mass worth telling."""
BROAD = 100.0
"""[kg, kg m, kg m^2] Standard deviation of a load's parameters before anything is known of them."""
KNOWN_AT_BEST, SHARES = 1e-12, 200
"""Of the prior's, the variance that a combination of parameters has at least; number of shares tried."""
EXCLUDED = 3.84
"""Twice the log of a ratio of likelihoods that excludes a value, at 95 %."""


class Excitation:
    """Range of every joint since the start."""

    def __init__(self, joints: tuple[str, ...]) -> None:
        self._joints = joints
        self._range: Array = np.array([np.full(len(joints), np.inf), np.full(len(joints), -np.inf)])

    def add(self, sample: Sample) -> None:
        """Take one sample into account."""
        widen(self._range, sample.position)

    def sentences(self, prismatic: Collection[str] = ()) -> list[str]:
        """One for each joint that has not moved enough; none before the first sample."""
        moved = self._range[1] - self._range[0]
        units = ['m' if name in prismatic else 'rad' for name in self._joints]
        return [f'joint {name} has moved {span:.3f} {unit} only, not enough to identify what depends on it'
                for name, span, unit in zip(self._joints, moved, units, strict=True) if 0.0 <= span < MOVED_ENOUGH]


class Conditioning(NamedTuple):
    """Conditioning of theta by the samples.

    ``number``: largest over smallest eigenvalue of theta's covariance in units of its prior; ``undetermined``: how many
    directions of theta are still about as wide as the prior had them; ``columns``: how many there are.
    """

    number: float
    undetermined: int
    columns: int


def conditioning(model: Model, prior_scale: Array) -> Conditioning | None:
    """Conditioning of a model whose prior is ``prior_scale`` (p,) times gamma; None when it learns
    no theta."""
    recursion = model.recursion
    if not recursion.n_columns:
        return None
    prior = model.gamma * prior_scale[model.learnt]
    spread = np.linalg.eigvalsh(recursion.theta_covariance() / np.outer(prior, prior))
    return Conditioning(float(spread[-1] / max(spread[0], TINY)), int(np.sum(spread > 0.25)), len(spread))


class LearntCoefficient(NamedTuple):
    """One coefficient of the coupled columns."""

    name: str
    value: float
    std: float
    unit: str


class CarriedLoad(NamedTuple):
    """Load that the arm carries beyond its description, in the frame of ``link``; inertia (3, 3)
    about its centre.

    ``std`` is of the same kind and has the standard deviations. What cannot be told is not a number: the centre and the
    inertia of a mass that is smaller than two standard deviations, and an inertia that no body has.
    """

    link: str
    mass: float  # [kg]
    centre: Array  # (3,) [m]
    inertia: Array  # (3, 3) [kg m^2]
    std: CarriedLoad | None = None


def quantities(estimator: Estimator, model: Model | None = None) -> list[LearntCoefficient]:
    """Every coefficient in its order; of a non-parametric model those of effects alone.

    :param model: one of the estimator's, in place of the one that answers.
    """
    model = model or estimator.model
    labels = _labels(estimator.columns)[model.covered]
    return [LearntCoefficient(name, float(value), float(std), unit) for (name, unit), value, std in
            zip(labels, model.theta, model.theta_std(), strict=True)]


class Load(NamedTuple):
    """Ten inertial parameters in the frame of ``link``, and their covariance."""

    link: str
    parameters: Array  # (10,)
    covariance: Array  # (10, 10)


def carried_load(estimator: Estimator, before: Array | None = None, picked: Load | None = None) -> Load | None:
    """The declared loads that are there now, or else what the estimate adds to the last link that the outputs feel;
    and what was picked up since.

    :param before: (n_parameters,) base parameters of the model from before a change, in place of those learnt since.
    :param picked: a load that came with the change and is not declared.

    None while the initial window is not over, and while the model learns no base parameters.
    """
    if not estimator.ready:
        return None
    body = estimator.body
    theta, covariance = _posterior(estimator.model)
    if not covariance.any():
        return None
    carried = _declared_load(estimator, theta, covariance)
    if carried is None:
        own = slice(0, body.n_parameters)
        if not covariance[own, own].any():
            return None
        link = last_link(body)
        learnt = theta[own] if before is None else before
        carried = Load(link, *_added_load(body, link, learnt, covariance[own, own]))
    there = None if picked is None else load_seen_from(body, carried.link, picked.link)
    if picked is None or there is None:
        return carried
    return Load(carried.link, carried.parameters + there @ picked.parameters,
                carried.covariance + there @ picked.covariance @ there.T)


def _posterior(model: Model) -> tuple[Array, Array]:
    """Coefficients (p,) of all columns and their covariance (p, p); zeros where the model learns none."""
    learnt, absent, n = model.recursion.n_columns, model.covered.start, model.covered.stop
    theta, covariance = np.zeros(n), np.zeros((n, n))
    theta[absent:] = model.theta
    if learnt:
        covariance[-learnt:, -learnt:] = model.recursion.theta_covariance()
    return theta, covariance


def _declared_load(estimator: Estimator, theta: Array, covariance: Array) -> Load | None:
    """All declared loads that are there now, where the first of them is; None without any."""
    columns = estimator.columns
    acting = [(str(effect.where), columns.blocks[str(index)]) for index, effect in enumerate(columns.effects)
              if effect.is_load and estimator.holds(effect)]
    if not acting:
        return None
    (link, _), weights = acting[0], np.zeros((10, len(theta)))
    for other, block in acting:
        there = load_seen_from(estimator.body, link, other)
        if there is not None:
            weights[:, block] = there
    return Load(link, weights @ theta, weights @ covariance @ weights.T)


def _added_load(body: RigidBody, link: str, theta: Array, covariance: Array) -> tuple[Array, Array]:
    """(10,) inertial parameters at ``link`` that explain best what was learnt beyond the description, by generalised
    least squares, and their covariance (10, 10): what the motion does not tell keeps a deviation of ``BROAD``.

    The deviations hold that the description is as wrong elsewhere as what no load explains.
    """
    load, free, prior = _load_and_description(body, link)
    beyond = theta - body.base_parameters
    wrong = _wrong_by(free.T @ beyond, free.T @ covariance @ free, free.T @ prior @ free)
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-24))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    whitened = vectors.T / np.sqrt(np.maximum(values, 1e-12))[:, None]
    rows = whitened @ (load / std[:, None])
    spread = np.linalg.inv(rows.T @ rows + np.eye(10) / BROAD**2)
    gain = spread @ rows.T @ (whitened / std)
    return gain @ beyond, spread + wrong * gain @ prior @ gain.T


@remembered
def _load_and_description(body: RigidBody, link: str) -> tuple[Array, Array, Array]:
    """(p, 10) what a load at ``link`` adds to the base parameters, (p, k) directions in which it adds nothing, over
    their scales, and (p, p) the prior covariance of the base parameters."""
    index, transform = load_transform(body, link)
    load = body.basis[10 * index:10 * index + 10].T @ transform
    scale = base_scale(body)
    prior = (body.basis.T * inertial_scale(body)**2) @ body.basis
    return load, null_space((load / scale[:, None]).T) / scale[:, None], prior


def _wrong_by(beyond: Array, covariance: Array, prior: Array) -> float:
    """Share s of the prior covariance (k, k) by which a description errs, where what was learnt beyond it (k,) is of
    N(0, covariance + s prior): the largest that the ratio of likelihoods does not exclude."""
    if not len(beyond):
        return 0.0
    values, vectors = eigh(covariance, prior)
    known, seen = np.maximum(values, KNOWN_AT_BEST), (vectors.T @ beyond)**2
    shares = np.append(0.0, np.geomspace(known.min(), max(seen.max(), known.min()), SHARES))
    variance = known + shares[:, None]
    unlikely = (np.log(variance) + seen / variance).sum(axis=1)
    return float(shares[unlikely <= unlikely.min() + EXCLUDED].max())


def is_shown(load: Load) -> bool:
    """Tell whether its mass is one for certain."""
    return bool(load.parameters[0] > max(SMALLEST_MASS, 2.0 * np.sqrt(load.covariance[0, 0])))


def reported_load(link: str, parameters: Array, covariance: Array) -> CarriedLoad:
    """From mass, first moment and inertia about the link's origin, (10,), and their covariance (10, 10)."""
    mass, mass_std = float(parameters[0]), float(np.sqrt(covariance[0, 0]))
    unknown = CarriedLoad(link, mass, np.full(3, np.nan), np.full((3, 3), np.nan))
    if not is_shown(Load(link, parameters, covariance)):
        return unknown._replace(std=unknown._replace(mass=mass_std))
    step = 1e-6 * mass
    jacobian = np.array([(_centred(parameters + step * unit) - _centred(parameters - step * unit)) / (2.0 * step)
                         for unit in np.eye(10)])
    found, std = _centred(parameters), np.sqrt(np.maximum(np.diag(jacobian.T @ covariance @ jacobian), 0.0))
    inertia, inertia_std = found[3:].reshape(3, 3), std[3:].reshape(3, 3)
    if not _has_a_body(inertia):
        inertia = unknown.inertia
    return CarriedLoad(link, mass, found[:3], inertia, CarriedLoad(link, mass_std, std[:3], inertia_std))


def _centred(parameters: Array) -> Array:
    """(12,) centre of mass and inertia about it, row by row, from parameters about the origin (10,)."""
    body = pin.Inertia.FromDynamicParameters(parameters)
    return np.concatenate([body.lever, body.inertia.ravel()])


def _has_a_body(inertia: Array) -> bool:
    """Tell whether some distribution of mass has this inertia about its centre: no principal moment
    is larger than the sum of the two others."""
    moments = np.linalg.eigvalsh(inertia)
    return bool(moments[0] >= 0.0 and moments[0] + moments[1] >= moments[2])


def _labels(columns: CoupledColumns) -> list[tuple[str, str]]:
    """(name, unit) of each coupled column."""
    body = columns.body
    labels = [(f'base_parameter_{index}', 'kg, kg m or kg m^2') for index in range(body.n_parameters)]
    if columns.has_friction:
        labels += [(f'{name}@{joint}', body.joint_unit(joint, unit)) for name, unit in zip(NAMES, UNITS, strict=True)
                   for joint in body.output_names]
    if columns.has_offset:
        labels += [(f'offset_{axis}', unit) for axis, unit in zip(body.output_names, body.output_units, strict=True)]
    for effect in columns.effects:
        head = spelling(effect.kind, effect.where)
        labels += [(f'{head}.{name}', unit) for name, unit in effect.coefficients(body)]
    return labels
