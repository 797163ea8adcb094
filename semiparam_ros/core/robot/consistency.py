"""Inertial parameters of bodies that can be, as near to a description as an estimate allows.

The second moments of a body's mass about its origin form its pseudo-inertia (Wensing, Kim and
Slotine 2018),

    P = [[Sigma, m c], [m c', m]],      Sigma = tr(I) / 2 1 - I,

which is linear in the parameters (m, m c, I) and positive definite for every body that has a
volume. How far it is from another one is told by the entropic (log-determinant Bregman) distance of
Lee, Wensing and Park 2019,

    D(P | P0) = tr(P0^-1 P) - log det(P0^-1 P) - 4,

which no choice of units or axes changes, and which grows without bound towards bodies that cannot
be. Of an estimate theta ~ N(mean, information^-1) to which bodies contribute sum_i A_i pi_i, the
bodies are those that minimise

    (theta - mean)' information (theta - mean) / 2 + sum_i D(P_i | P0_i).

It is the most probable answer where exp(-D), a Wishart density with its mode at the description,
is what is held of each body before: what the samples do not show stays as described. Both terms are
convex in pi, so there is one minimum. -log det P is a self-concordant barrier: Newton's method with
shortened steps, which fall by enough from 1 / (1 + lambda) on, finds the minimum from the description,
while everything but the barrier counts for ten times as much with each round (Nesterov and
Nemirovskii 1994). No change of variables is needed, such as the log-Cholesky one (Rucker and Wensing
2022), which would give up the convexity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

_ROWS, _COLUMNS = np.triu_indices(4)
SYMMETRIC = np.zeros((10, 4, 4))
"""Orthonormal basis of the symmetric matrices."""
SYMMETRIC[np.arange(10), _ROWS, _COLUMNS] = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(0.5))
SYMMETRIC[np.arange(10), _COLUMNS, _ROWS] = SYMMETRIC[np.arange(10), _ROWS, _COLUMNS]
THICKNESS = 0.01
"""Of the arm's length, the standard deviation of a body's mass along each axis, where the
description has a body that cannot be."""
FLAT = 1e-12
"""See :func:`is_consistent`: what is less of a described body is rounding, as of a plate without a
thickness."""
DECREMENT = 1e-10
"""Newton's method ends where a step promises less, over the value or 1 nat."""
MOST_STEPS = 200
SUFFICIENT = 0.1
"""Share of the promised decrease that a step must bring."""
INSIDE = 0.8
"""Share of the way to the next body that cannot be, which a step may go."""


class Body(NamedTuple):
    """A body whose parameters are looked for.

    :param reference: (10,) m, m c and inertia about the origin (xx, xy, yy, xz, yz, zz), of a body
        that can be.
    :param columns: (p, 10) how they enter theta.
    :param reach: [m] the mass lies, by its second moment, within so far of the origin; None:
        anywhere.
    """

    reference: Array
    columns: Array
    reach: float | None = None


def pseudo_inertia(parameters: Array) -> Array:
    """(..., 4, 4) of inertial parameters (..., 10)."""
    mass, x, y, z, xx, xy, yy, xz, yz, zz = np.moveaxis(np.asarray(parameters, dtype=float), -1, 0)
    half = 0.5 * (xx + yy + zz)
    rows = np.array([[half - xx, -xy, -xz, x], [-xy, half - yy, -yz, y], [-xz, -yz, half - zz, z],
                     [x, y, z, mass]])
    return np.moveaxis(rows, (0, 1), (-2, -1))


def inertial_parameters(pseudo: Array) -> Array:
    """(..., 10) of pseudo-inertias (..., 4, 4)."""
    sigma = pseudo[..., :3, :3]
    inertia = np.trace(sigma, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - sigma
    return np.stack([pseudo[..., 3, 3], *np.moveaxis(pseudo[..., :3, 3], -1, 0),
                     inertia[..., 0, 0], inertia[..., 0, 1], inertia[..., 1, 1],
                     inertia[..., 0, 2], inertia[..., 1, 2], inertia[..., 2, 2]], axis=-1)


def is_consistent(parameters: Array, least: float = 0.0) -> bool:
    """Tell whether a body with these parameters (10,) can be.

    :param least: second moment along any axis through its centre, over those about its origin.
    """
    pseudo = pseudo_inertia(parameters)
    smallest = np.linalg.eigvalsh(_central(pseudo)).min()
    return bool(smallest > least * np.trace(pseudo[:3, :3]))


def distance(parameters: Array, reference: Array) -> float:
    """The entropic distance [nat] of two bodies (10,) that can be."""
    ratio = np.linalg.solve(pseudo_inertia(reference), pseudo_inertia(parameters))
    return float(np.trace(ratio) - np.linalg.slogdet(ratio)[1] - 4.0)


def made_consistent(parameters: Array, length: float) -> Array:
    """(10,) the same body, made as thick as ``THICKNESS`` of an arm of this length [m] where it
    cannot be.

    Raises SemiparamError unless the mass is above 0.
    """
    if not parameters[0] > 0.0:
        raise SemiparamError(f'a body has a mass of {parameters[0]:g} kg; expected more than 0.')
    if is_consistent(parameters, FLAT):
        return parameters
    central = _central(pseudo_inertia(parameters))
    values, axes = np.linalg.eigh(central[:3, :3])
    thick = parameters[0] * (THICKNESS * length) ** 2
    central[:3, :3] = (axes * np.maximum(values, thick)) @ axes.T
    shift = np.eye(4)
    shift[:3, 3] = parameters[1:4] / parameters[0]
    return inertial_parameters(shift @ central @ shift.T)


def ball(mass: float, radius: float) -> Array:
    """(10,) a body about the origin whose mass has this standard deviation [m] along each axis."""
    return inertial_parameters(mass * np.diag([radius**2] * 3 + [1.0]))


def consistent_bodies(mean: Array, root: Array, bodies: Sequence[Body]) -> Array:
    """(n, 10) the bodies that an estimate (p,) with the information R'R asks for; see above.

    :param root: R (q, p). Of a sensor without noise R'R spans more digits than a number has.

    Raises SemiparamError when the estimate is not finite.
    """
    if not (np.isfinite(mean).all() and np.isfinite(root).all()):
        raise SemiparamError('the estimate holds values that are not finite; expected a model that '
                             'has learnt.')
    if not bodies:
        return np.zeros((0, 10))
    pseudo = pseudo_inertia(np.array([body.reference for body in bodies]))
    try:
        problem = _Problem(mean, root, bodies)
        loss = max(problem.value(pseudo), 1.0)
    except np.linalg.LinAlgError:
        loss = np.inf
    if not np.isfinite(loss):
        raise SemiparamError('a mass is described so far from its link that its own inertia is lost '
                             'in the digits; check the units of the inertials\' origins.')
    for share in np.geomspace(1.0 / loss, 1.0, 1 + int(np.ceil(np.log10(loss)))).tolist():
        pseudo = _minimum(problem, pseudo, share)
    return inertial_parameters(pseudo)


def _minimum(problem: _Problem, pseudo: Array, share: float) -> Array:
    """(n, 4, 4) by Newton's method, where all but the barrier counts by ``share``."""
    value = problem.value(pseudo, share)
    for _ in range(MOST_STEPS):
        roots = np.asarray(np.linalg.cholesky(pseudo), dtype=np.float64)
        gradient, curvature = problem.derivatives(pseudo, roots, share)
        step = -_solved(curvature[:-len(gradient)], gradient)
        promised = -float(gradient @ step)
        if promised < DECREMENT * max(1.0, value):
            break
        inside = np.einsum('ki,iab->kab', step.reshape(-1, 10), SYMMETRIC)
        move = roots @ inside @ np.swapaxes(roots, 1, 2)
        length = 1.0 / max(1.0, -np.linalg.eigvalsh(inside).min() / INSIDE)
        shortest = 0.5 / (1.0 + np.sqrt(promised))  # a self-concordant function falls by enough with twice that
        tried = problem.value(pseudo + length * move, share)
        while (falls_short := not tried <= value - SUFFICIENT * length * promised) and length > shortest:
            length *= 0.5
            tried = problem.value(pseudo + length * move, share)
        if tried < value:
            pseudo, value = pseudo + length * move, tried
        if falls_short:
            break  # rounding
    return pseudo


def _solved(root: Array, right: Array) -> Array:
    """(N,) the solution x of (1 + R'R) x = right (N,), with R (m, N), by rotations.

    What an estimate knows has fewer directions than many links have parameters: only along these is there anything to
    solve.
    """
    along, inner = np.linalg.qr(root.T)  # (N, k), (k, m) of R' = Q T, so that 1 + R'R = 1 + Q T T' Q'
    seen = along.T @ right
    triangle = np.linalg.qr(np.vstack([inner.T, np.eye(len(inner))]), mode='r')
    return np.asarray(right - along @ seen + along @ cho_solve((triangle, False), seen))


class _Problem:
    """Function that is minimised, of the pseudo-inertias (n, 4, 4)."""

    def __init__(self, mean: Array, root: Array, bodies: Sequence[Body]) -> None:
        self._mean, self._root = mean, root
        self._columns = np.array([body.columns for body in bodies])  # (n, p, 10)
        references = pseudo_inertia(np.array([body.reference for body in bodies]))
        self._inverse = np.linalg.inv(references)
        self._constant = np.linalg.slogdet(references)[1].sum() - 4.0 * len(bodies)
        self._bound = np.array([body.reach is not None for body in bodies])
        reach = [body.reach for body in bodies if body.reach is not None]
        # tr(Q P) > 0
        self._inside = np.array([np.diag([-1.0, -1.0, -1.0, length**2]) for length in reach])
        self._inside = self._inside.reshape(-1, 4, 4)
        self._room = np.einsum('kab,kba->k', self._inside, references[self._bound])
        if (self._room <= 0.0).any():
            raise SemiparamError('a body reaches further in its reference than it may.')

    def value(self, pseudo: Array, share: float = 1.0) -> float:
        """[nat], infinite outside of what bodies can be."""
        try:
            roots = np.linalg.cholesky(pseudo)
        except np.linalg.LinAlgError:
            return np.inf
        left = np.einsum('kab,kba->k', self._inside, pseudo[self._bound]) / self._room
        if not (left > 0.0).all():
            return np.inf
        error = self._root @ self._error(pseudo)
        pull = (0.5 * error @ error + np.einsum('kab,kba->', self._inverse, pseudo)
                + (left - 1.0).sum())
        barrier = 2.0 * np.log(np.diagonal(roots, axis1=1, axis2=2)).sum() + np.log(left).sum()
        return float(share * pull + self._constant - barrier)

    def derivatives(self, pseudo: Array, roots: Array, share: float = 1.0) -> tuple[Array, Array]:
        """(10 n,) gradient and (m, 10 n) a root of the Hessian at P = L L' in the coordinates of
        L^-1 P L^-T in ``SYMMETRIC``, in which that of -log det P is the identity, however thin a
        body is: the last 10 n rows."""
        sizes = roots[:, None] @ SYMMETRIC @ np.swapaxes(roots, 1, 2)[:, None]
        columns = np.hstack(list(self._columns @ np.swapaxes(inertial_parameters(sizes), 1, 2)))
        slope = share * np.einsum('kab,kiba->ki', self._inverse, sizes)
        slope -= np.trace(SYMMETRIC, axis1=1, axis2=2)
        toward = np.einsum('kab,kiba->ki', self._inside, sizes[self._bound])
        left = np.einsum('kab,kba->k', self._inside, pseudo[self._bound])
        slope[self._bound] += (share / self._room - 1.0 / left)[:, None] * toward
        seen = self._root @ columns
        bounds = np.zeros((len(toward), *slope.shape))
        bounds[np.arange(len(toward)), np.flatnonzero(self._bound)] = toward / left[:, None]
        curvature = np.vstack([np.sqrt(share) * seen, bounds.reshape(-1, slope.size),
                               np.eye(slope.size)])
        return share * seen.T @ (self._root @ self._error(pseudo)) + slope.ravel(), curvature

    def _error(self, pseudo: Array) -> Array:
        """(p,) of theta from its mean."""
        parameters = inertial_parameters(pseudo)
        return np.asarray(np.einsum('kpi,ki->p', self._columns, parameters) - self._mean)


def _central(pseudo: Array) -> Array:
    """(4, 4) about the centre of mass, where the mass is not zero: as positive as the one given."""
    shift = np.eye(4)
    if pseudo[3, 3] != 0.0:
        shift[:3, 3] = -pseudo[:3, 3] / pseudo[3, 3]
    return np.asarray(shift @ pseudo @ shift.T)
