"""What the model has learnt, as quantities with names, units and standard deviations, and whether the robot has
moved enough to identify it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.input_range import widen
from semiparam_ros.core.robot.frames import load_transform, loaded_links
from semiparam_ros.core.robot.joint_friction import NAMES, UNITS
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.single_estimator import Model
from semiparam_ros.core.types import Array

TINY = 1e-300
MOVED_ENOUGH = 0.05
"""[rad, m] A joint whose range is smaller tells next to nothing of what depends on its position."""

SMALLEST_MASS = 1e-3
"""[kg] A lighter payload has no centre of mass worth telling."""


class Excitation:
    """Range of every joint since the start."""

    def __init__(self, joints: tuple[str, ...]) -> None:
        self._joints = joints
        self._range: Array = np.array([np.full(len(joints), np.inf), np.full(len(joints), -np.inf)])

    def add(self, sample: Sample) -> None:
        """Take one sample into account."""
        widen(self._range, sample.position)

    def sentences(self) -> list[str]:
        """One for each joint that has not moved enough; none before the first sample."""
        moved = self._range[1] - self._range[0]
        return [f'joint {name} has moved {span:.3f} rad only, not enough to identify what depends on it'
                for name, span in zip(self._joints, moved, strict=True) if 0.0 <= span < MOVED_ENOUGH]


class Conditioning(NamedTuple):
    """How much the samples say of theta.

    ``number``: largest over smallest eigenvalue of theta's covariance in units of its prior; ``undetermined``: how many
    directions of theta are still about as wide as the prior had them; ``columns``: how many there are.
    """

    number: float
    undetermined: int
    columns: int


def conditioning(model: Model, prior_scale: Array) -> Conditioning | None:
    """Of a model whose prior is ``prior_scale`` (p,) times gamma; None when it learns no theta."""
    recursion = model.recursion
    if not recursion.n_columns:
        return None
    prior = model.gamma * prior_scale[model.learnt]
    spread = np.linalg.eigvalsh(recursion.theta_covariance() / np.outer(prior, prior))
    return Conditioning(float(spread[-1] / max(spread[0], TINY)), int(np.sum(spread > 0.25)), len(spread))


class Quantity(NamedTuple):
    """One coefficient of the coupled columns."""

    name: str
    value: float
    std: float
    unit: str


class Payload(NamedTuple):
    """What the arm carries beyond its description, in the frame of ``link``; inertia (3, 3) about its centre."""

    link: str
    mass: float  # [kg]
    centre: Array  # (3,) [m]
    inertia: Array  # (3, 3) [kg m^2]


def quantities(estimator: Estimator) -> list[Quantity]:
    """Every coefficient in its order; of a non-parametric model those of effects alone."""
    model = estimator.model
    labels = _labels(estimator.columns)[model.covered]
    return [Quantity(name, float(value), float(std), unit) for (name, unit), value, std in
            zip(labels, model.theta, model.theta_std(), strict=True)]


def payload(estimator: Estimator) -> Payload | None:
    """The declared payload, or else what the estimate adds to the last link that the outputs feel.

    None while the model learns no base parameters, and where nothing of noticeable weight is there.
    """
    declared = _declared_payload(estimator)
    if declared is not None:
        return declared
    if not estimator.ready or not len(estimator.model.part(slice(0, estimator.body.n_parameters))):
        return None
    link = list(loaded_links(estimator.body))[-1]
    return _payload(link, _added_load(estimator, link))


def _declared_payload(estimator: Estimator) -> Payload | None:
    for index, effect in enumerate(estimator.columns.effects):
        if getattr(effect, 'is_load', False):
            theta = estimator.model.part(estimator.columns.blocks[str(index)])
            return _payload(str(getattr(effect, 'where', '')), theta)
    return None


def _added_load(estimator: Estimator, link: str) -> Array:
    """(10,) inertial parameters at ``link`` that explain best, in posterior standard deviations, what was learnt."""
    body = estimator.body
    learnt = slice(0, body.n_parameters)
    difference = estimator.model.theta[learnt] - body.base_parameters
    index, transform = load_transform(body, link)
    load = body.basis[10 * index:10 * index + 10].T @ transform
    std = np.maximum(estimator.model.theta_std()[learnt], 1e-12)
    solution, *_ = np.linalg.lstsq(load / std[:, None], difference / std, rcond=1e-6)
    return np.asarray(solution)


def _payload(link: str, parameters: Array) -> Payload | None:
    """From mass, first moment and inertia about the link's origin, (10,)."""
    mass = float(parameters[0])
    if mass < SMALLEST_MASS:
        return None
    centre = parameters[1:4] / mass
    xx, xy, yy, xz, yz, zz = parameters[4:]
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Payload(link, mass, centre, about_origin - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre)))


def _labels(columns: CoupledColumns) -> list[tuple[str, str]]:
    """(name, unit) of each coupled column."""
    body = columns.body
    labels = [(f'base_parameter_{index}', 'kg, kg m or kg m^2') for index in range(body.n_parameters)]
    if columns.has_friction:
        labels += [(f'{name}@{joint}', unit) for name, unit in zip(NAMES, UNITS, strict=True)
                   for joint in body.output_names]
    if columns.has_offset:
        labels += [(f'offset_{axis}', unit) for axis, unit in zip(body.output_names, body.output_units, strict=True)]
    for effect in columns.effects:
        labels += _effect_labels(effect, body)
    return labels


def _effect_labels(effect: object, body: RigidBody) -> list[tuple[str, str]]:
    kind, where = getattr(effect, 'kind', 'effect'), getattr(effect, 'where', None)
    head = f'{kind}@{where}' if where else kind
    return [(f'{head}.{coefficient.name}', coefficient.unit)
            for coefficient in effect.coefficients(body)]  # type: ignore[attr-defined]
