"""The plain least-squares model that an engineer makes by hand: what a diagnosis must at least reach.

All base parameters; of efforts also offset, viscous friction and tanh-Coulomb friction of every joint, of a wrench the
sensor's offset. Channels are weighed by their own residual, columns scaled, and small singular values cut off; the
cut-off and the speed within which dry friction turns over are those with the smallest error on folds of the fit.
"""

from typing import NamedTuple

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples

FOLDS = 5
CUT_OFFS = 10.0 ** -np.arange(1.0, 7.5, 0.5)
TURN_SHARES = (0.003, 0.01, 0.03, 0.1)
REWEIGHTINGS = 2


class PlainModel(NamedTuple):
    """Fitted; ``top_speed`` (n_joints,) [rad/s] of the samples that fitted."""

    body: RigidBody
    theta: np.ndarray
    turn_share: float
    cut_off: float
    top_speed: np.ndarray

    def residual(self, samples: Samples) -> np.ndarray:
        """(N, n) what it leaves, in the outputs' units."""
        return samples.outputs - columns(self.body, samples, self.turn_share, self.top_speed) @ self.theta

    def nmse(self, samples: Samples, counted: np.ndarray) -> np.ndarray:
        """(n,) mean squared error over the variance of the outputs (N, n) that count."""
        return nmse(self.residual(samples), samples.outputs, counted)


def nmse(residual: np.ndarray, outputs: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """(n,) of the values that count: (N,) or (N, n)."""
    judged = counted.reshape(len(counted), -1).any(axis=1, keepdims=True)
    counted = np.broadcast_to(counted.reshape(len(counted), -1), outputs.shape)
    counted = np.where(counted.any(axis=0), counted, judged)
    return np.array([np.mean(left[use] ** 2) / np.var(values[use])
                     for left, values, use in zip(residual.T, outputs.T, counted.T, strict=True)])


def plain_model(body: RigidBody, samples: Samples, counted: np.ndarray) -> PlainModel:
    """Fitted to the outputs that ``counted`` (N,) or (N, n) says."""
    counted = np.broadcast_to(counted.reshape(len(counted), -1), samples.outputs.shape)
    used = counted.any(axis=1)
    samples, counted = samples[used], counted[used]
    top_speed = np.abs(samples.velocity).max(axis=0)
    fold = np.arange(len(samples)) * FOLDS // len(samples)
    variance = samples.outputs.var(axis=0)
    best = None
    for share in TURN_SHARES if body.outputs == 'effort' else TURN_SHARES[:1]:
        table = columns(body, samples, share, top_speed)
        losses = np.zeros(len(CUT_OFFS))
        for number in range(FOLDS):
            rows, others = fold == number, fold != number
            for index, theta in enumerate(least_squares(table[others], samples.outputs[others], counted[others])):
                left = (samples.outputs[rows] - table[rows] @ theta) * counted[rows]
                losses[index] += np.sum(left**2 / variance)
        if best is None or losses.min() < best[0]:
            best = losses.min(), share, int(losses.argmin()), table
    _, share, index, table = best
    theta = least_squares(table, samples.outputs, counted)[index]
    return PlainModel(body, theta, share, float(CUT_OFFS[index]), top_speed)


def columns(body: RigidBody, samples: Samples, turn_share: float, top_speed: np.ndarray) -> np.ndarray:
    """(N, n, p) rigid body, offset, and of efforts each joint's viscous and dry friction."""
    identity = np.eye(body.n_outputs)
    parts = [np.ones((len(samples), body.n_outputs))]
    if body.outputs == 'effort':
        parts += [samples.velocity, np.tanh(samples.velocity / (turn_share * top_speed + 1e-12))]
    return np.concatenate([body.regressors(samples), *(part[:, :, None] * identity for part in parts)], axis=2)


def least_squares(table: np.ndarray, outputs: np.ndarray, counted: np.ndarray) -> list[np.ndarray]:
    """(p,) for every cut-off."""
    scale = outputs.std(axis=0) + 1e-12
    for _ in range(REWEIGHTINGS):
        weight = counted / scale
        rows, right = (table * weight[:, :, None]).reshape(-1, table.shape[2]), (outputs * weight).ravel()
        size = np.sqrt(np.einsum('ij,ij->j', rows, rows)) + 1e-12
        values, vectors = np.linalg.eigh(rows.T @ rows / np.outer(size, size))
        turned = vectors.T @ (rows.T @ right / size)
        singular = np.sqrt(np.maximum(values, 0.0))
        found = []
        for cut_off in CUT_OFFS:
            keep = singular > cut_off * singular[-1]
            found.append(vectors[:, keep] @ (turned[keep] / values[keep]) / size)
        left = [np.sum((weight * (outputs - table @ theta)) ** 2) for theta in found]
        best = found[int(np.argmin(left))]
        scale = np.sqrt(np.sum(((outputs - table @ best) * counted) ** 2, axis=0) / counted.sum(axis=0)) + 1e-12
    return found
