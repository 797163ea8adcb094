"""Joint motion from a whole recording: a Gaussian-process smoother on positions, velocities and accelerations.

Each joint is an integrated Wiener process (white snap, or a higher derivative that is white: one arm moves more
smoothly than another) seen through noisy positions, velocities and, where they are measured, accelerations. Its
posterior mean is the Kalman smoother's, computed here as one banded linear system; the standard deviations are those of
greatest marginal likelihood. A causal filter at 20 Hz misses several times the sensor's noise; this does not. The error
of a posterior mean is independent of it, so regressors of the smoothed motion are not pulled towards zero, as noisy
ones are (Berkson 1950).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from math import factorial

import numpy as np
import scipy  # it loads scipy.optimize, which takes a fifth of a second, with the first use
from scipy.linalg import cho_solve_banded

from semiparam_ros.core.compiled import Matrix, Stack, Vector, compiled
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

ORDER = 4
"""Which derivative of the positions is white noise, unless it is given."""
TUNING_SAMPLES = 1200
FIRST_RATIOS = (3.0, 0.3, 1.0, 1.0)
"""Snap, and noise of position, velocity and acceleration, over that of the velocity: where the search begins."""
SEEN = 150
"""Samples on either side that an acceleration's error is computed from: many more than it depends on."""
LONGEST_STEP = 20.0
"""A gap in the recording counts as this many steps: beyond it the blocks would be singular."""
FORGOTTEN = 1e-6
"""Share that a gap leaves of the precision of so many steps: what it joins may have nothing to do with each other."""
LEAST_SIZE = 1e-24
"""Least squared size of the noise, over that of third differences: exact numbers have no noise at all."""
LEAST_STEP = 0.2
"""Steps shorter than this share of the median add noise as if they were not: their precision would overflow."""

MOST_DOUBLED = 60
"""From the smoothest motion that is tried to the liveliest."""


def smoothed(samples: Samples, measured: int = 2, order: int = ORDER) -> Samples:
    """The same samples with positions, velocities and accelerations as the smoother sees them.

    Each recording by itself, where several are one.

    :param measured: what is used: 1 positions, 2 velocities too, which does harm where they lag, 3 accelerations too.
    :param order: which derivative of the positions is white noise; the higher, the smoother the motion.
    """
    if samples.breaks:
        return _joined(samples, [smoothed(replace(samples[part], breaks=()), measured, order)
                                 for part in samples.recordings])
    return _with_noise(samples, samples, np.zeros((measured, 1, samples.position.shape[1])), measured, order)


def smoothed_again(samples: Samples, smooth: Samples, measured: int = 2, order: int = ORDER,
                   seed: int = 0) -> tuple[Samples, Samples]:
    """The smoothed motion seen through noise as large as that of the recording, and smoothed once more: with drawn
    noise and with its opposite, between which whatever is linear in the noise cancels.

    What errors of the motion do to a fit shows between the fits on ``smooth`` and on these, as far as the errors are
    those of the model (Cook and Stefanski 1994, Journal of the American Statistical Association 89).

    :param smooth: :func:`smoothed` of the recording with the same ``measured`` and ``order``.
    """
    if samples.breaks:
        pairs = [smoothed_again(replace(samples[part], breaks=()), replace(smooth[part], breaks=()), measured, order,
                                seed) for part in samples.recordings]
        return _joined(smooth, [one for one, _ in pairs]), _joined(smooth, [other for _, other in pairs])
    noise = np.random.default_rng(seed).standard_normal((measured, *samples.position.shape))
    return (_with_noise(samples, smooth, noise, measured, order),
            _with_noise(samples, smooth, -noise, measured, order))


def _joined(whole: Samples, parts: Sequence[Samples]) -> Samples:
    """The samples with the motion of their parts."""
    position, velocity, acceleration = (np.concatenate([getattr(part, name) for part in parts])
                                        for name in ('position', 'velocity', 'acceleration'))
    return replace(whole, position=position, velocity=velocity, acceleration=acceleration)


def _with_noise(samples: Samples, motion: Samples, noise: Array, measured: int, order: int) -> Samples:
    """A motion smoothed with the hyperparameters of the recording, after noise (measured, N, n_joints), in units of the
    recording's own, was added to what is measured of it. So few samples that a white derivative explains any stay."""
    if len(motion) <= order:
        return motion
    columns = []
    for joint, logs in enumerate(_hyperparameters(samples, measured, order)):
        problem, step, centre = _problem(motion.time, _measured(motion, joint, measured), order)
        for values, log, drawn in zip(problem.motion, logs[1:], noise[:, :, joint], strict=True):
            values += np.exp(log) * drawn
        states = problem.states(logs)
        columns.append((states[:, 0] + centre, states[:, 1] / step, states[:, 2] / step**2))
    position, velocity, acceleration = (np.column_stack(part) for part in zip(*columns, strict=True))
    return replace(motion, position=position, velocity=velocity, acceleration=acceleration)


@lru_cache(maxsize=8)
def _hyperparameters(samples: Samples, measured: int, order: int) -> list[Array]:
    """Return :meth:`_SmoothingProblem.best` of each joint."""
    return [_problem(samples.time, _measured(samples, joint, measured), order)[0].liveliest(TUNING_SAMPLES).best()
            for joint in range(samples.position.shape[1])]


def _measured(samples: Samples, joint: int, count: int) -> list[Array]:
    """(N,) each, the first ``count`` of a joint's positions, velocities and accelerations."""
    return [values[:, joint] for values in (samples.position, samples.velocity, samples.acceleration)[:count]]


def _problem(time: Array, motion: list[Array], order: int) -> tuple[_SmoothingProblem, float, float]:
    """One joint's motion (N,) in units of its typical step, that step [s], and the middle of its positions."""
    step, centre = float(np.median(np.diff(time))), float(motion[0].mean())
    scaled = [values * step**power for power, values in enumerate([motion[0] - centre, *motion[1:]])]
    return _SmoothingProblem(_steps(time), scaled, order), step, centre


def _steps(time: Array) -> Array:
    """(N-1,) differences of the times over their median; gaps at their limit."""
    steps = np.diff(time)
    return np.asarray(np.minimum(steps / np.median(steps), LONGEST_STEP))


def acceleration_errors(samples: Samples, measured: int = 2, order: int = ORDER,
                        times: Sequence[float] = (1.0,)) -> Array:
    """(K, n_joints) standard deviations [rad/s^2] of the smoothed accelerations' errors, as the model of the motion has
    them; if the same motion were recorded at each of K ``times`` the rate, with encoders as good. NaN where rounding
    hides it. Of several recordings, their root mean square, zero of what is hidden in one.

    :param measured: and ``order`` as for :func:`smoothed`.
    """
    if samples.breaks:
        parts = [replace(samples[part], breaks=()) for part in samples.recordings if part.stop - part.start > order]
        squares = [len(part) * np.nan_to_num(acceleration_errors(part, measured, order, times)) ** 2 for part in parts]
        return np.asarray(np.sqrt(np.sum(squares, axis=0) / sum(map(len, parts))))
    errors = []
    for joint, logs in enumerate(_hyperparameters(samples, measured, order)):
        problem, step, _ = _problem(samples.time, _measured(samples, joint, measured), order)
        errors.append([problem.acceleration_error(logs, each) / step**2 for each in times])
    return np.array(errors).T


class _SmoothingProblem:
    """One joint in units of its typical step, so that the blocks are well conditioned.

    :param steps: (N-1,) steps of time. :param order: which derivative is white.
    :param motion: positions, velocities and accelerations (N,), or the first of these.
    """

    def __init__(self, steps: Array, motion: list[Array], order: int) -> None:
        self.steps, self.motion, self.order = steps, motion, order
        self._gaps = steps >= LONGEST_STEP
        self._transition, self._precision, logdets = _transitions(steps, order)
        self._precision[self._gaps] *= FORGOTTEN
        self._noise_logdet = float(logdets.sum()) - order * int(self._gaps.sum()) * float(np.log(FORGOTTEN))
        back = np.swapaxes(self._transition, 1, 2) @ self._precision
        self._prior = _diagonals(back @ self._transition, -back, self._precision)
        self._workspace = np.empty_like(self._prior)

    def liveliest(self, count: int) -> _SmoothingProblem:
        """The ``count`` samples in a row that hold most motion: a joint at rest says nothing of its snap."""
        steps = np.where(self._gaps, 0.0, np.abs(np.diff(self.motion[0])))
        travelled = np.concatenate([[0.0], np.cumsum(steps)])
        first = int(np.argmax(travelled[count - 1:] - travelled[:1 - count])) if count < len(travelled) else 0
        part = slice(first, first + count)
        return _SmoothingProblem(self.steps[part][:count - 1], [values[part] for values in self.motion],
                        self.order)

    def best(self) -> Array:
        """Logarithms of the standard deviations of greatest likelihood: the white derivative's, those of position,
        velocity and acceleration.

        Their common size follows from the misfit in closed form, so a search over their ratios to one of them is left.
        """
        rough = np.diff(np.diff(self.motion[0]) if len(self.motion) < 2 else self.motion[1], 3)
        noise = np.log(float(np.sqrt(np.mean(rough**2) / 20.0)) + 1e-12)
        start = np.log(FIRST_RATIOS[:1 + len(self.motion)])
        searched = np.delete(np.arange(len(start)), min(len(self.motion), 2))

        def at(ratios: Array) -> Array:
            logs = noise + start
            logs[searched] = noise + ratios
            return logs

        first = start[searched]
        # Rounding may leave more than any tolerance between likelihoods of the same ratios: those alone tell the end.
        options = {'fatol': np.inf, 'xatol': 0.001, 'initial_simplex': np.vstack([first, first + np.eye(len(first))])}
        with np.errstate(invalid='ignore'):  # two ratios of infinite cost may be compared
            found = scipy.optimize.minimize(lambda ratios: self.cost(at(ratios))[0], first, method='Nelder-Mead',
                                            options=options)
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
        determinant = 2.0 * float(np.log(factor[:, 0]).sum())
        count = len(self.motion[0])
        snap = self._noise_logdet + 2.0 * self.order * (count - 1) * float(logs[0])
        measured = 2.0 * count * float(logs[1:].sum())
        freedom = count * len(self.motion) - self.order
        size = max(self._misfit(states, logs) / freedom, LEAST_SIZE)
        return 0.5 * (determinant + snap + measured + freedom * (float(np.log(size)) + 1.0)), 0.5 * float(np.log(size))

    def _misfit(self, states: Array, logs: Array) -> float:
        """Squares of the measurements' errors and of the snap, over their variances.

        Summed square by square: the short form |y|^2 - x'A'y loses all digits to cancellation where a long stretch is
        smooth, and then praises states that are wrong by more than the motion.
        """
        snap, weights = np.exp(-2.0 * logs[0]), np.exp(-2.0 * logs[1:])
        return float(snap * _jumps(states, self._transition, self._precision)
                     + sum(weight * np.sum((values - states[:, order]) ** 2)
                           for order, (weight, values) in enumerate(zip(weights, self.motion, strict=True))))

    def states(self, logs: Array) -> Array:
        """(N, order) smoothed position and derivatives, in units of the step.

        With snap so small beside the noise that rounding spoils the factor, as where positions jump between two
        samples, the snap is doubled until it does not. Raises SemiparamError where that never is.
        """
        logs = np.clip(logs, -40.0, 20.0)
        for _ in range(MOST_DOUBLED):
            try:
                return self._solve(logs)[1]
            except np.linalg.LinAlgError:
                logs[0] += np.log(2.0)
        raise SemiparamError('the motion cannot be smoothed: its positions jump, as in a recording that is cut '
                             'together; expected the motion of one robot without jumps.')

    def acceleration_error(self, logs: Array, times: float) -> float:
        """Standard deviation of an acceleration far from the ends, of measurements at ``times`` the rate; NaN where
        the motion is so small beside the noise, as of a joint at rest, that rounding spoils the factor."""
        powers = np.array([self.order - 0.5, *range(len(self.motion))])
        count = 2 * SEEN + 1
        problem = _SmoothingProblem(np.ones(count - 1), [np.zeros(count)] * len(self.motion), self.order)
        finer, middle = logs - np.log(times) * powers, SEEN * self.order + 2  # in units of the shorter step
        one = np.zeros(count * self.order)
        one[middle] = 1.0
        try:
            factor, _ = problem._solve(finer)
        except np.linalg.LinAlgError:
            return float('nan')
        variance = cho_solve_banded((factor.T, True), one)[middle]
        return float(np.sqrt(variance)) * times**2

    def _solve(self, logs: Array) -> tuple[Array, Array]:
        """Cholesky factor of the states' precision, its diagonals as columns until the next call, and their posterior
        mean (N, order)."""
        snap, weights = np.exp(-2.0 * logs[0]), np.exp(-2.0 * logs[1:])
        diagonals, right = np.multiply(self._prior, snap, out=self._workspace), np.zeros(len(self._prior))
        for order, (weight, values) in enumerate(zip(weights, self.motion, strict=True)):
            diagonals[order::self.order, 0] += weight
            right[order::self.order] = weight * values
        diagonals[:, 0] += 1e-12
        factor, solution = _solved(diagonals, right)
        return factor, solution.reshape(-1, self.order)


def _transitions(steps: Array, order: int) -> tuple[Array, Array, Array]:
    """F (N-1, order, order) of the integrated Wiener process over ``steps``, the inverse of its Q, log det Q (N-1,).

    Over a step h Q is that over 1 with rows and columns scaled by powers of h, and so is its inverse.
    """
    powers = np.arange(order)
    ahead = powers - powers[:, None]
    factorials = np.array([float(factorial(power)) for power in range(order)])
    later = np.maximum(ahead, 0)
    transition = np.where(ahead >= 0, steps[:, None, None] ** later / factorials[later], 0.0)
    left = order - 1 - powers
    noise = 1.0 / ((left + left[:, None] + 1) * factorials[left] * factorials[left][:, None])
    scale = np.maximum(steps, LEAST_STEP)[:, None] ** (left + 0.5)
    precision = np.linalg.inv(noise) / (scale[:, :, None] * scale[:, None, :])
    return transition, precision, np.linalg.slogdet(noise)[1] + 2.0 * np.log(scale).sum(axis=1)


def _diagonals(before: Array, across: Array, after: Array) -> Array:
    """(N order, 2 order) diagonals of the block tridiagonal precision of all states, from the main one on, as columns:
    row r holds what stands in row r of the matrix from there to the right. From its (N-1, order, order) pieces."""
    count, order = len(before) + 1, before.shape[1]
    blocks = np.zeros((count, order, order))
    blocks[:-1] += before
    blocks[1:] += after
    diagonals = np.zeros((count * order, 2 * order))
    for i in range(order):
        for j in range(order):
            if j >= i:
                diagonals[i::order, j - i] = blocks[:, i, j]
            diagonals[i:-order:order, order + j - i] = across[:, i, j]
    return diagonals


@compiled
def _jumps(states: Matrix, transition: Stack, precision: Stack) -> float:
    """Sum of squares, over their variance at a white derivative of 1, of what the states (N, order) do beside their
    transitions (N-1, order, order)."""
    order, total = states.shape[1], 0.0
    jump = np.empty(order)
    for step in range(len(transition)):
        for i in range(order):
            jump[i] = states[step + 1, i]
            for j in range(i, order):
                jump[i] -= transition[step, i, j] * states[step, j]
        for i in range(order):
            for j in range(order):
                total += jump[i] * precision[step, i, j] * jump[j]
    return total


def _solved(diagonals: Array, right: Array) -> tuple[Array, Array]:
    """Cholesky factor U of A = U'U, both by their diagonals, and the solution of A x = right; overwrites its arguments.
    A is block tridiagonal, with blocks of half as many rows as there are diagonals.

    LAPACK has the same, but takes four times as long where there are so few diagonals.
    Raises LinAlgError where A is not positive definite.
    """
    if _factor_and_solve(diagonals, right):
        raise np.linalg.LinAlgError
    return diagonals, right


@compiled
def _factor_and_solve(diagonals: Matrix, right: Vector) -> int:
    """:func:`_solved` in place; 0, or 1 where it fails."""
    count, width = diagonals.shape
    order = width // 2
    for row in range(count):
        reach = width - row % order  # further right all is zero
        pivot = diagonals[row, 0]
        if not pivot > 0.0:
            return 1
        inverse = 1.0 / np.sqrt(pivot)
        right[row] *= inverse
        for column in range(reach):
            diagonals[row, column] *= inverse
        for below in range(1, min(reach, count - row)):
            share = diagonals[row, below]
            right[row + below] -= share * right[row]
            for column in range(below, reach):
                diagonals[row + below, column - below] -= share * diagonals[row, column]
    for row in range(count - 1, -1, -1):
        total = right[row]
        for after in range(1, min(width - row % order, count - row)):
            total -= diagonals[row, after] * right[row + after]
        right[row] = total / diagonals[row, 0]
    return 0
