"""Causes of changes of a robot, and how well each of that explains innovations.

A cause moves some columns C of the model, by coefficients L theta with theta ~ N(0, I). From the
products A = sum L' C' S^-2 C L and h = sum L' C' S^-2 r of a window, with noise kappa S^2,

    log evidence over none    h' (kappa I + A)^-1 h / (2 kappa) - log|I + A / kappa| / 2
    coefficients              (kappa I + A)^-1 h,  with covariance kappa (kappa I + A)^-1
"""

from __future__ import annotations

from math import log
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.robot.frames import last_link, load_transform
from semiparam_ros.core.robot.joint_friction import friction_scale
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import base_scale
from semiparam_ros.core.robot.small_turns import TILTS
from semiparam_ros.core.types import Array, Indices, Mask
from semiparam_ros.effects.geometry import BaseShift, ZeroSlip
from semiparam_ros.effects.loads import Payload

RARE = 1e4
"""A load is picked up or put down so many times as often as anything else changes; and that as
often as something of which the kind is not known."""
OF_FRICTION = SENSOR_OFFSET, EFFORT_OFFSET, FRICTION = 'sensor_offset', 'effort_offset', 'friction'
"""Kinds whose coefficients are those of friction and offsets."""
HAND_M = 0.15
"""[m] How far from the last link the centre of a load may be, and how large it is."""
MASS_SHOWS = 2.5
"""[standard deviations] A load has a mass that is so sure at least."""
ROUNDED = 1e-11


class Cause(NamedTuple):
    """Cause of a change: its kind and place as effects have them ('' for no known kind), its part of
    the directions, and minus the log of its prior probability [nat]."""

    kind: str
    where: str | None
    part: slice
    price: float


LEARNING = Cause('learning', None, slice(0, 0), 0.0)
"""Nothing changed, but the model did not know its coefficients any better."""


def causes_of(columns: CoupledColumns) -> tuple[list[Cause], Array]:
    """Causes that may change on a robot, and the directions L (p + t, K) of all of them in units of their
    priors; p: columns of the model without those of effects, t: small turns."""
    body, blocks = columns.body, columns.blocks
    turns = slice(columns.n_own, columns.n_own + TILTS + len(body.joints))
    zeros = [ZeroSlip(joint).prior_scale(body) for joint in body.joints]
    turn_scale = np.concatenate([BaseShift().prior_scale(body), *zeros])
    own = np.diag(np.append(_change_scale(columns), turn_scale))
    causes, parts = list[Cause](), list[Array]()
    rigid, offset, friction, rotor = (blocks[name] for name in ('rigid_body', 'offset', 'friction', 'rotor'))
    own[rigid, rigid] = np.diag(base_scale(body))

    def add(kind: str, where: str | None, directions: Array, price: float) -> None:
        start = sum(part.shape[1] for part in parts)
        causes.append(Cause(kind, where, slice(start, start + directions.shape[1]), price))
        parts.append(directions)

    load = np.pad(load_directions(columns), ((0, turns.stop - turns.start), (0, 0)))
    add(Payload.kind, last_link(body), load, 0.0)
    of_joints = 2 * body.n_outputs if columns.has_friction else 1
    price = log(RARE * (2 + of_joints + len(body.joints)))
    if body.outputs == 'wrench':
        add(SENSOR_OFFSET, None, own[:, offset], price)
    for number, joint in enumerate(body.output_names if columns.has_friction else ()):
        add(EFFORT_OFFSET, joint, own[:, [offset.start + number]], price)
        add(
            FRICTION,
            joint,
            own[:, friction.start + number : friction.stop : body.n_outputs],
            price,
        )
    add(BaseShift.kind, None, own[:, turns.start : turns.start + TILTS], price)
    for number, joint in enumerate(body.joints, start=turns.start + TILTS):
        add(ZeroSlip.kind, joint, own[:, [number]], price)
    parts.append(own[:, rotor])  # of no cause, but learnt
    add('', None, own[:, rigid], price + log(RARE))
    return causes, np.hstack(parts)


def load_directions(columns: CoupledColumns) -> Array:
    """(q, 10) what a load at the last link adds to the coefficients of a model, in units of its prior;
    q: columns without those of effects."""
    body = columns.body
    link = last_link(body)
    index, transform = load_transform(body, link)
    found = np.zeros((columns.n_own, transform.shape[1]))
    found[columns.blocks['rigid_body']] = (
        body.basis[10 * index : 10 * index + 10].T @ transform * load_scale(body, link)
    )
    return found


def friction_directions(columns: CoupledColumns) -> Array:
    """(q, k) the coefficients of friction and offsets, in units of what they may change by."""
    places = np.r_[columns.blocks['friction'], columns.blocks['offset']]
    return np.diag(_change_scale(columns))[:, places]


def _change_scale(columns: CoupledColumns) -> Array:
    """(q,) what coefficients may change by: as their prior, but a zero that jumps does so as far as friction."""
    scale = columns.prior_scale[: columns.n_own]
    if columns.has_friction:
        scale[columns.blocks['offset']] = friction_scale(columns.body)
    return scale


def load_scale(body: RigidBody, link: str) -> Array:
    """(10,) what the inertial parameters of a load in the hand may be."""
    mass = float(Payload(link).prior_scale(body)[0])
    return mass * np.repeat([1.0, HAND_M, HAND_M**2], (1, 3, 6))


class CauseFit(NamedTuple):
    """One cause over windows: the eigenvalues (S, k) and eigenvectors (S, k, k) of A, and h (S, k)
    along these."""

    cause: Cause
    values: Array
    vectors: Array
    along: Array

    @classmethod
    def of(cls, cause: Cause, grams: Array, sums: Array) -> CauseFit:
        """Take the A (S, k, k) and h (S, k) of a cause."""
        values, vectors = np.linalg.eigh(grams)
        along = np.einsum('skj,sk->sj', vectors, sums)
        return cls(cause, np.maximum(values, 0.0), vectors, along)

    @property
    def explained(self) -> Array:
        """(S,) squares that the cause explains at its best."""
        share = (self.values + 2.0) / (self.values + 1.0) ** 2
        return np.asarray((self.along**2 * share).sum(axis=1))

    def evidence(self, kappa: Array, wider: Array | float = 1.0) -> Array:
        """(S,) log evidence over none, the noise being kappa (S,), and the prior's covariance so
        many times as large (S, 1)."""
        whole = wider * self.values + kappa[:, None]
        explained = (wider * self.along**2 / whole).sum(axis=1) / kappa
        return np.asarray(0.5 * (explained - np.log(whole / kappa[:, None]).sum(axis=1)))

    def theta(self, kappa: Array) -> Array:
        """(S, k) coefficients, in units of their prior."""
        whole = self.values + kappa[:, None]
        return np.asarray(np.einsum('skj,sj->sk', self.vectors, self.along / whole))

    def covariance(self, kappa: Array) -> Array:
        """(S, k, k) of the coefficients."""
        root = self.vectors / np.sqrt(self.values + kappa[:, None])[:, None]
        return np.asarray(kappa[:, None, None] * root @ root.swapaxes(1, 2))


class Judged(NamedTuple):
    """A hypothesis: its cause, how many of the last blocks it explains, its coefficients in units
    of their prior, their covariance, and its evidence [nat] over what is next likely."""

    cause: Cause
    blocks: int
    theta: Array
    covariance: Array
    evidence: float


def likeliest_window(
    fit: CauseFit, evidence: Array, kappa: Array, counts: Indices, grams: Array, sums: Array
) -> Judged:
    """Window in which a cause is likeliest, by its evidence (S,) beside all else over so many blocks each.

    :param grams: (S, K, K) and :param sums: (S, K) of the later half of each window, of which what
        is over explains nothing.
    """
    part, theta = fit.cause.part, fit.theta(kappa)
    evidence = np.where(_explains(theta, grams[:, part, part], sums[:, part]), evidence, -np.inf)
    if fit.cause.kind == Payload.kind:  # it has a mass; what was put down was in the hand before
        mass, variance = theta[:, 0], fit.covariance(kappa)[:, 0, 0]
        evidence = np.where(mass < 0.0, evidence - log(RARE), evidence)
        evidence = np.where(mass**2 > MASS_SHOWS**2 * variance, evidence, -np.inf)
    at = int(evidence.argmax())
    same = np.full(len(kappa), kappa[at])
    since = int(fit.evidence(same).argmax())
    return Judged(
        fit.cause,
        int(counts[since]),
        fit.theta(same)[since],
        fit.covariance(same)[since],
        float(evidence[at]),
    )


def _explains(theta: Array, grams: Array, moments: Array) -> Mask:
    """(S,) whether coefficients (S, k) explain blocks with these sums better than none."""
    gained = theta * (2.0 * moments - np.einsum('skj,sj->sk', grams, theta))
    return np.asarray(gained.sum(axis=1) > 0.0)


def with_prior(gram: Array) -> Array:
    """A + I for (..., k, k), where I is not so small beside A that it would be lost."""
    largest = np.diagonal(gram, axis1=-2, axis2=-1).max(axis=-1)
    return np.asarray(gram + (1.0 + ROUNDED * largest)[..., None, None] * np.eye(gram.shape[-1]))
