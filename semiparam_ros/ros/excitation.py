"""Whether the robot has moved enough for its parameters to be identified."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semiparam_ros.core.model import Model
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array

TINY = 1e-300
MOVED_ENOUGH = 0.05
"""[rad, m] A joint whose range is smaller tells next to nothing of what depends on its position."""


class Excitation:
    """Range of every joint since the start."""

    def __init__(self, joints: tuple[str, ...]) -> None:
        self._joints = joints
        self._lowest = np.full(len(joints), np.inf)
        self._highest = np.full(len(joints), -np.inf)

    def add(self, sample: Sample) -> None:
        """Take one sample into account."""
        np.minimum(self._lowest, sample.position, out=self._lowest)
        np.maximum(self._highest, sample.position, out=self._highest)

    def sentences(self) -> list[str]:
        """One for each joint that has not moved enough; none before the first sample."""
        moved = self._highest - self._lowest
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
