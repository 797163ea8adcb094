"""Does an effect help on blocks that did not fit it?"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.blocks import FOLDS, folds
from semiparam_ros.diagnosis.regression import Fit

LEAST_GAIN = 0.003  # the best trial of 48 recordings with nothing hidden gained at most 0.0013
LEAST_RATIO = 3.0


def fold_losses(state: Fit, scale: Array) -> Array:
    """(folds,) squared error of each block in use, predicted by a fit of the other blocks, over ``scale``^2."""
    labels = folds(state.use)
    ridge = 1e-9 * np.eye(state.columns.shape[2])
    grams, rights, powers = [], [], []
    for fold in range(FOLDS):
        rows = labels == fold
        columns = (state.columns[rows] / scale[:, None]).reshape(-1, state.columns.shape[2])
        left = (state.residual[rows] / scale).ravel()
        grams.append(columns.T @ columns)
        rights.append(columns.T @ left)
        powers.append(left @ left)
    total, right = sum(grams), sum(rights)
    size = 1.0 / np.sqrt(np.diag(total) + 1e-300)
    losses = []
    for gram, moment, power in zip(grams, rights, powers, strict=True):
        rest = (total - gram) * np.outer(size, size) + ridge
        change = np.linalg.lstsq(rest, (right - moment) * size, rcond=1e-10)[0] * size
        losses.append(power - 2.0 * change @ moment + change @ gram @ change)
    return np.array(losses)


def carries_over(before: Fit, after: Fit) -> bool:
    """True when the blocks that the added effects help far outweigh those that they harm."""
    losses = fold_losses(before, after.scale)
    gains = losses - fold_losses(after, after.scale)
    helped, harmed = gains[gains > 0].sum(), -gains[gains < 0].sum()
    return bool(helped - harmed > LEAST_GAIN * losses.sum() and helped > LEAST_RATIO * harmed)
