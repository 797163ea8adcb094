"""Inputs x = [q, dq, ddq] that a model has learnt, taken together: how unlike them a state is.

Each joint within its range does not make a posture that was met: joints that moved together say little of how the
robot is when they do not. So the distance of a state from the mean, in the covariance of what was learnt (Mahalanobis
1936), is compared with the largest of the inputs learnt themselves; 1 is as far as these went.

Every so-many-th input is kept. Where there is no more room, every other one is dropped, and half as many are kept from
then on: they are spread over all that was learnt.

From them also follows what random features can know of a state. Their kernel fades with the distance from what was
learnt; a few hundred of them do not, for they are periodic. Of the variance 1 that the kernel k has at a state x before
anything is learnt, the kept inputs z, each of which stands for s learnt ones with noise, take away

    k(x, z)' (k(z, z) + (sigma / rho)^2 / s I)^-1 k(z, x)
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dtrtrs

from semiparam_ros.core.random_features import RandomFeatures, input_scaling
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.errors import SemiparamError

LARGEST_DISTANCE = 1.0
"""A state further from what was learnt, taken together, than any input learnt itself is unlike all of them."""
ROOM = 512
LEAST_VARIANCE = 0.01
"""Of an input's own variance, what is added in every direction: noise of the inputs."""
ROUNDING = 1e-9
"""Of a kernel's variance."""
RENEWED_EVERY = 64
"""Mean and covariance are those of so many more inputs kept, so that they are seldom taken anew."""


class LearntInputs:
    """The inputs that are kept, (k, m).

    :param radians: (n_joints,) what of each joint's unit is as much as a radian.
    """

    def __init__(self, n_inputs: int, radians: Array | float = 1.0) -> None:
        self._kept, self._radians = np.zeros((ROOM, n_inputs)), radians
        self._count, self._stride, self._passed = 0, 1, 0
        self._metric: tuple[tuple[int, int], Array, Array, float] | None = None
        self._kernels: dict[RandomFeatures, tuple[tuple[int, int], Array]] = {}

    def add(self, sample: Sample) -> None:
        """One more was learnt."""
        self._passed += 1
        if self._passed % self._stride:
            return
        if self._count == ROOM:
            self._kept[:ROOM // 2] = self._kept[1::2]
            self._count, self._stride = ROOM // 2, 2 * self._stride
            if self._passed % self._stride:
                return
        self._kept[self._count] = sample.inputs
        self._count += 1

    def distance(self, x: Array) -> float:
        """Distance of a state (m,) from what was learnt over the largest in it; infinite before anything was."""
        if not self._count:
            return np.inf
        if self._metric is None or self._metric[0] != (self._used, self._stride):
            self._metric = self._measured(self._used)
        _, mean, whitening, largest = self._metric
        white = whitening @ (x - mean)
        return float(np.sqrt(white @ white)) / largest

    def known(self, x: Array, features: RandomFeatures, noise: float) -> float:
        """Share of the variance of features at a state (m,) that what was learnt takes away, 0 to 1.

        :param noise: variance of the noise over that of the features.
        """
        if not self._count:
            return 0.0
        kept, version = self._kept[:self._used], (self._used, self._stride)
        if self._kernels.get(features, (None,))[0] != version:
            self._kernels = {each: held for each, held in self._kernels.items() if held[0] == version}
            covariance = features.kernel(kept, kept) + (noise / self._stride + ROUNDING) * np.eye(len(kept))
            self._kernels[features] = version, cholesky(covariance, lower=True)
        white, _ = dtrtrs(self._kernels[features][1], features.kernel(x[None], kept)[0], lower=1)
        return min(float(white @ white), 1.0)

    @property
    def _used(self) -> int:
        return self._count - (self._count % RENEWED_EVERY if self._count > RENEWED_EVERY else 0)

    def _measured(self, used: int) -> tuple[tuple[int, int], Array, Array, float]:
        """Their number, mean (m,), what whitens (m, m) the difference from it, and the largest distance."""
        kept = self._kept[:used]
        mean, scale = input_scaling(kept, self._radians)
        z = (kept - mean) / scale
        factor = cholesky(z.T @ z / len(z) + LEAST_VARIANCE * np.eye(z.shape[1]), lower=True)
        whitening = solve_triangular(factor, np.diag(1.0 / scale), lower=True)
        farthest = np.linalg.norm((kept - mean) @ whitening.T, axis=1).max()
        return (used, self._stride), mean, whitening, max(float(farthest), 1.0)

    def state(self) -> dict[str, Array | Stamps]:
        """Copies; :meth:`restore` takes them back bit for bit."""
        return {'kept': self._kept[:self._count].copy(), 'counts': np.array([self._stride, self._passed])}

    def restore(self, state: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, when it cannot be one."""
        kept = np.array(state.get('kept', np.nan), dtype=float)
        stride, passed = np.asarray(state.get('counts', (0, 0))).tolist()
        if kept.ndim != 2 or kept.shape[1] != self._kept.shape[1] or len(kept) > ROOM or not (
                np.isfinite(kept).all() and stride >= 1 and passed >= len(kept)):
            raise SemiparamError(f'the saved inputs have shape {kept.shape}; expected at most {ROOM} finite rows of '
                                 f'{self._kept.shape[1]}.')
        self._kept[:len(kept)], self._count = kept, len(kept)
        self._stride, self._passed, self._metric = int(stride), int(passed), None
        self._kernels = {}
