"""Joint motion from a whole recording: a Gaussian-process smoother on positions and velocities.

Each joint is a four times integrated Wiener process (white snap) seen through noisy positions and velocities. Its
posterior mean is the Kalman smoother's, computed here as one banded linear system; the three standard deviations are
those of greatest marginal likelihood. A causal filter at 20 Hz misses several times the sensor's noise; this does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import factorial

import numpy as np
import scipy  # it loads scipy.optimize, which takes a fifth of a second, with the first use
from scipy.linalg import cho_solve_banded, cholesky_banded

from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array

ORDER = 4
TUNING_SAMPLES = 1200
SEEN = 150
"""Samples on either side that an acceleration's error is computed from: many more than it depends on."""
BAND = 2 * ORDER
LONGEST_STEP = 20.0
"""A gap in the recording counts as this many steps: beyond it the blocks would be singular."""
FORGOTTEN = 1e-6
"""Share that a gap leaves of the precision of so many steps: what it joins may have nothing to do with each other."""
LEAST_SIZE = 1e-24
"""Least squared size of the noise, over that of third differences: exact numbers have no noise at all."""
LEAST_STEP = 0.2
"""Steps shorter than this share of the median add noise as if they were not: their precision would overflow."""


def smoothed(samples: Samples, with_velocities: bool = True) -> Samples:
    """The same samples with positions, velocities and accelerations as the smoother sees them.

    Each recording by itself, where several are one.

    :param with_velocities: use the measured velocities too; not where they lag the positions.
    """
    if samples.breaks:
        parts = [smoothed(replace(samples[part], breaks=()), with_velocities) for part in samples.recordings]
        position, velocity, acceleration = (np.concatenate([getattr(part, name) for part in parts])
                                            for name in ('position', 'velocity', 'acceleration'))
        return replace(samples, position=position, velocity=velocity, acceleration=acceleration)
    columns = [_smooth_joint(samples.time, samples.position[:, joint], samples.velocity[:, joint], with_velocities)
               for joint in range(samples.position.shape[1])]
    position, velocity, acceleration = (np.column_stack(part) for part in zip(*columns, strict=True))
    return replace(samples, position=position, velocity=velocity, acceleration=acceleration)


def _smooth_joint(time: Array, position: Array, velocity: Array,
                  with_velocities: bool) -> tuple[Array, Array, Array]:
    step = float(np.median(np.diff(time)))
    centre = float(position.mean())
    problem = _Problem(_steps(time), position - centre, velocity * step, with_velocities)
    short = problem.liveliest(TUNING_SAMPLES)
    states = problem.states(short.best())
    return states[:, 0] + centre, states[:, 1] / step, states[:, 2] / step**2


def _steps(time: Array) -> Array:
    """(N-1,) differences of the times over their median; gaps at their limit."""
    steps = np.diff(time)
    return np.asarray(np.minimum(steps / np.median(steps), LONGEST_STEP))


def acceleration_errors(samples: Samples, with_velocities: bool = True, times: Sequence[float] = (1.0,)) -> Array:
    """(K, n_joints) standard deviations [rad/s^2] of the smoothed accelerations' errors, as the model of the motion has
    them; if the same motion were recorded at each of K ``times`` the rate, with encoders as good. NaN where rounding
    hides it.

    :param with_velocities: as for :func:`smoothed`.
    """
    step = float(np.median(np.diff(samples.time)))
    errors = []
    for position, velocity in zip(samples.position.T, samples.velocity.T, strict=True):
        problem = _Problem(_steps(samples.time), position - position.mean(), velocity * step, with_velocities)
        logs = problem.liveliest(TUNING_SAMPLES).best()
        errors.append([problem.acceleration_error(logs, each) / step**2 for each in times])
    return np.array(errors).T


class _Problem:
    """One joint in units of its typical step, so that the blocks are well conditioned."""

    def __init__(self, steps: Array, position: Array, velocity: Array, with_velocities: bool) -> None:
        self.steps, self.position, self.velocity = steps, position, velocity
        self.use = (1.0, float(with_velocities))
        self._gaps = steps >= LONGEST_STEP
        self._transition, noise = _transitions(steps)
        noise[self._gaps] /= FORGOTTEN
        self._precision = np.asarray(np.linalg.inv(noise), dtype=float)
        self._noise_logdet = float(np.linalg.slogdet(noise)[1].sum())
        back = np.swapaxes(self._transition, 1, 2) @ self._precision
        self._prior = _banded(back @ self._transition, -back, self._precision)

    def liveliest(self, count: int) -> _Problem:
        """The ``count`` samples in a row that hold most motion: a joint at rest says nothing of its snap."""
        travelled = np.concatenate([[0.0], np.cumsum(np.where(self._gaps, 0.0, np.abs(np.diff(self.position))))])
        first = int(np.argmax(travelled[count - 1:] - travelled[:1 - count])) if count < len(travelled) else 0
        part = slice(first, first + count)
        return _Problem(self.steps[part][:count - 1], self.position[part], self.velocity[part], bool(self.use[1]))

    def best(self) -> Array:
        """Logarithms of the standard deviations of greatest likelihood: snap, position, velocity.

        Their common size follows from the misfit in closed form, so a search over their ratios is left: of two, of one
        without velocities.
        """
        rough = np.diff(self.velocity, 3)
        noise = np.log(float(np.sqrt(np.mean(rough**2) / 20.0)) + 1e-12)
        searched = 1 + int(self.use[1])
        first, held = np.split(np.log([3.0, 0.3, 1.0]), [searched])

        def at(ratios: Array) -> Array:
            return noise + np.concatenate([ratios, held])

        found = scipy.optimize.minimize(lambda ratios: self.cost(at(ratios))[0], first, method='Nelder-Mead', options={
            'fatol': 0.01, 'xatol': 0.001, 'initial_simplex': np.vstack([first, first + np.eye(searched)])})
        best = at(found.x)
        return best + self.cost(best)[1]

    def cost(self, logs: Array) -> tuple[float, float]:
        """Negative log marginal likelihood, up to a constant, at the best common size of the standard deviations, and
        the logarithm of that size."""
        logs = np.clip(logs, -40.0, 20.0)
        try:
            factor, states = self._solve(logs)
        except np.linalg.LinAlgError:  # noise so small that rounding spoils the factor
            return float('inf'), 0.0
        determinant = 2.0 * float(np.log(factor[-1]).sum())
        count = len(self.position)
        snap = self._noise_logdet + 2.0 * ORDER * (count - 1) * float(logs[0])
        measured = 2.0 * count * float(logs[1] * self.use[0] + logs[2] * self.use[1])
        freedom = count * sum(self.use) - ORDER
        size = max(self._misfit(states, logs) / freedom, LEAST_SIZE)
        return 0.5 * (determinant + snap + measured + freedom * (float(np.log(size)) + 1.0)), 0.5 * float(np.log(size))

    def _misfit(self, states: Array, logs: Array) -> float:
        """Squares of the measurements' errors and of the snap, over their variances.

        Summed square by square: the short form |y|^2 - x'A'y loses all digits to cancellation where a long stretch is
        smooth, and then praises states that are wrong by more than the motion.
        """
        snap, weights = np.exp(-2.0 * logs[0]), np.exp(-2.0 * logs[1:]) * self.use
        jumps = states[1:] - np.einsum('tij,tj->ti', self._transition, states[:-1])
        return float(snap * np.einsum('ti,tij,tj->', jumps, self._precision, jumps, optimize=True)
                     + weights[0] * np.sum((self.position - states[:, 0]) ** 2)
                     + weights[1] * np.sum((self.velocity - states[:, 1]) ** 2))

    def states(self, logs: Array) -> Array:
        """(N, ORDER) smoothed position and derivatives, in units of the step."""
        return self._solve(np.clip(logs, -40.0, 20.0))[1]

    def acceleration_error(self, logs: Array, times: float) -> float:
        """Standard deviation of an acceleration far from the ends, of measurements at ``times`` the rate; NaN where
        the noise is so small beside the motion that rounding spoils the factor."""
        finer = logs - np.log(times) * np.array([ORDER - 0.5, 0.0, 1.0])  # in units of the shorter step
        count = 2 * SEEN + 1
        problem = _Problem(np.ones(count - 1), np.zeros(count), np.zeros(count), bool(self.use[1]))
        one = np.zeros(count * ORDER)
        one[SEEN * ORDER + 2] = 1.0
        try:
            factor, _ = problem._solve(finer)
        except np.linalg.LinAlgError:
            return float('nan')
        variance = cho_solve_banded((factor, False), one)[SEEN * ORDER + 2]
        return float(np.sqrt(variance)) * times**2

    def _solve(self, logs: Array) -> tuple[Array, Array]:
        """Cholesky factor of the states' precision, and their posterior mean (N, ORDER)."""
        snap, weights = np.exp(-2.0 * logs[0]), np.exp(-2.0 * logs[1:]) * self.use
        band = self._prior * snap
        band[-1, 0::ORDER] += weights[0]
        band[-1, 1::ORDER] += weights[1]
        band[-1] += 1e-12
        right = np.zeros(band.shape[1])
        right[0::ORDER] = weights[0] * self.position
        right[1::ORDER] = weights[1] * self.velocity
        factor = cholesky_banded(band, check_finite=False)
        solution = cho_solve_banded((factor, False), right, check_finite=False)
        return factor, solution.reshape(-1, ORDER)


def _transitions(steps: Array) -> tuple[Array, Array]:
    """F (N-1, 4, 4) and Q (N-1, 4, 4) of the integrated Wiener process over ``steps``."""
    transition = np.zeros((len(steps), ORDER, ORDER))
    noise = np.zeros_like(transition)
    felt = np.maximum(steps, LEAST_STEP)
    for i in range(ORDER):
        for j in range(ORDER):
            if j >= i:
                transition[:, i, j] = steps ** (j - i) / factorial(j - i)
            power = 2 * ORDER - 1 - i - j
            noise[:, i, j] = felt**power / (power * factorial(ORDER - 1 - i) * factorial(ORDER - 1 - j))
    return transition, noise


def _banded(before: Array, across: Array, after: Array) -> Array:
    """Upper banded form of the block tridiagonal precision of all states, from its (N-1, 4, 4) pieces."""
    count = len(before) + 1
    diagonal = np.zeros((count, ORDER, ORDER))
    diagonal[:-1] += before
    diagonal[1:] += after
    band = np.zeros((BAND, count * ORDER))
    for i in range(ORDER):
        for j in range(ORDER):
            if j >= i:
                band[BAND - 1 + i - j, j::ORDER] = diagonal[:, i, j]
            band[BAND - 1 + i - j - ORDER, ORDER + j::ORDER] = across[:, i, j]
    return band
