"""Flexible regression of a residual: what any smooth function of the motion and of time could still explain.

Ridge regression on families of features, judged on blocks left out of the fit: many short ones, interleaved, so that
every fold sees the whole recording. The families follow one another, each on what the ones before have left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask, Stamps
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.recordings import without_pauses

Family = tuple[str, Callable[[], Array]]


class StandardisedInputs:
    """Standardised inputs of M samples: variables (M, k) with names, time last [-1, 1]."""

    def __init__(self, joints: tuple[str, ...], samples: Samples, config: DiagnosisConfig = DEFAULTS) -> None:
        self.config = config
        self.names = (*(f'{role}_{joint}' for role in ('q', 'dq', 'ddq') for joint in joints), 'time')
        self.n_joints = len(joints)
        time = without_pauses(samples)
        span = max(float(time[-1] - time[0]), 1e-9)
        inputs = samples.inputs
        spread = inputs.std(axis=0)
        moved = np.divide(inputs - inputs.mean(axis=0), spread, out=np.zeros_like(inputs), where=spread > 1e-9)
        self.values = np.column_stack([moved, 2.0 * (time - time[0]) / span - 1.0])

    def families(self, with_time: bool = True) -> Iterator[Family]:
        """Features by family, from the plainest on."""
        if with_time:
            yield 'time', partial(self.of_time, self.config.waves)
        yield 'single variables', self.of_single_variables
        if with_time:
            yield 'time and motion', self.of_time_and_motion
        for number, scale in enumerate(self.config.motion_scales):
            yield f'motion {scale:g}', partial(random_features, self.values[:, :-1], self.config.motion_features,
                                               scale, number)

    def of_time(self, waves: int) -> Array:
        """(M, 2 waves + 2) a line, and waves that need not close over the recording."""
        angles = np.pi * 0.8 * np.outer(self.values[:, -1], np.arange(1, waves + 1))
        return np.column_stack([np.ones(len(angles)), self.values[:, -1], np.cos(angles), np.sin(angles)])

    def of_single_variables(self) -> Array:
        """(M, .) a function of every variable, and of every joint's position and velocity together."""
        count = self.config.bells
        singles = [bells(column, count) for column in self.values[:, :-1].T]
        joints = [random_features(self.values[:, [joint, self.n_joints + joint]], 3 * count,
                                  self.config.motion_scales[0], joint)
                  for joint in range(self.n_joints)]
        return np.column_stack([*singles, *joints])

    def of_time_and_motion(self) -> Array:
        """(M, .) what is plain in every variable, with a coefficient that changes slowly."""
        moved = self.values[:, :-1]
        speeds = moved[:, self.n_joints:2 * self.n_joints]
        plain = np.column_stack([moved, np.tanh(5.0 * speeds)])
        slow = self.of_time(self.config.slow_waves)
        return np.asarray((plain[:, :, None] * slow[:, None, :]).reshape(len(plain), -1))


def random_features(inputs: Array, count: int, scale: float, seed: int) -> Array:
    """(M, count) random Fourier features of a Gaussian kernel; its length is ``scale`` sqrt(number of inputs)."""
    rng = np.random.default_rng(seed)
    frequencies = rng.standard_normal((inputs.shape[1], count // 2)) / (scale * np.sqrt(inputs.shape[1]))
    angles = inputs @ frequencies
    return np.hstack([np.cos(angles), np.sin(angles)])


def bells(values: Array, count: int) -> Array:
    """(M, count + 1) the variable itself, and Gaussian bells across its range."""
    low, high = np.quantile(values, (0.005, 0.995))
    centres = np.linspace(low, high, count)
    width = max(float(high - low) / (count - 1), 1e-9)
    return np.column_stack([values, np.exp(-0.5 * ((values[:, None] - centres) / width) ** 2)])


def fold_labels(count: int, blocks: int, folds: int) -> Stamps:
    """(M,) fold of each sample: blocks dealt out in turn."""
    return np.arange(count) * blocks // max(count, 1) % folds


def predictions(features: Array, targets: Array, config: DiagnosisConfig = DEFAULTS,
                counted: Mask | None = None) -> Array:
    """(M, n) each sample's target as the other folds predict it, each channel with the penalty that serves it best.

    :param counted: (M, n) targets that tell something, all unless given; the others are predicted as zero.
    """
    labels = fold_labels(len(targets), config.structure_blocks, config.structure_folds)
    if counted is None or counted.all():
        return _predicted(features, targets, labels, config)
    found, alike = np.zeros_like(targets), dict[bytes, list[int]]()
    for channel, mask in enumerate(counted.T):
        alike.setdefault(mask.tobytes(), []).append(channel)
    for channels in alike.values():  # of which the same samples count
        mask = counted[:, channels[0]]
        each = np.ix_(np.flatnonzero(mask), np.array(channels))
        found[each] = _predicted(features[mask], targets[each], labels[mask], config)
    return found


def _predicted(features: Array, targets: Array, labels: Stamps, config: DiagnosisConfig) -> Array:
    """(M, n) the same of samples that all count, in the folds ``labels`` (M,)."""
    penalties = 10.0 ** np.array(config.penalty_exponents)
    size = np.sqrt(np.mean(features**2, axis=0) * features.shape[1]) + 1e-12
    scaled = features / size
    total, right = scaled.T @ scaled, scaled.T @ targets
    everywhere = np.zeros((len(penalties), *targets.shape))
    for fold in range(config.structure_folds):
        rows = labels == fold
        held = scaled[rows]
        values, vectors = np.linalg.eigh(total - held.T @ held)
        turned = vectors.T @ (right - held.T @ targets[rows])
        shrunk = turned / (np.maximum(values, 0.0)[:, None] + penalties[:, None, None])
        everywhere[:, rows] = (held @ vectors) @ shrunk
    losses = np.sum((targets - everywhere) ** 2, axis=1)
    best = losses.argmin(axis=0)
    chosen = everywhere[best, :, np.arange(targets.shape[1])].T
    return np.asarray(np.where(losses.min(axis=0) < np.sum(targets**2, axis=0), chosen, 0.0))


def explained(motion: StandardisedInputs, targets: Array, with_time: bool = True,
              counted: Mask | None = None) -> tuple[Array, dict[str, float]]:
    """(M, n) what all families together predict of unseen blocks, and the share of the targets that each adds.

    :param counted: (M, n) targets that tell something, all unless given; the others are zero.
    """
    found, shares = np.zeros_like(targets), {}
    power = float(np.sum(targets**2)) + 1e-300
    for name, features in motion.families(with_time):
        before = targets - found
        found = found + predictions(features(), before, motion.config, counted)
        shares[name] = float(np.sum(before**2) - np.sum((targets - found) ** 2)) / power
    return found, shares
