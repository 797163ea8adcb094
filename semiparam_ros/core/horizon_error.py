"""Relative squared prediction error over a horizon, the paper's index (Romeres et al. 2016, section
V).

    eps_t[k] = sum_{s=1..T} (y_{t+s}[k] - yhat_{t+s|t}[k])^2 / sum_{s=1..T} y_{t+s}[k]^2

with the model as it stood at t and the inputs as they came. Every sample is thus predicted by the
last T models, none of which is kept: learning sample i added g_i E_i to Theta, so that a model of
the past says

    phi' Theta_t = phi' Theta_now - sum_{i > t} (phi' g_i) E_i

and T gains and innovations do the work of T models: T (D + n p) operations a sample in place of T D
n.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.compiled import Matrix, Stack, Vector, compiled, direct
from semiparam_ros.core.recursion import Prior, Update
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.errors import SemiparamError

LEAST_POWER = 1e-18
"""Floor of a denominator for each sample, in squared outputs: far below any sensor, and keeps the
index finite."""

NO_OFFSETS = np.zeros(0)


class HorizonErrors(NamedTuple):
    """The index of one origin t, known T samples later."""

    origin: int  # [ns] stamp of sample t
    eps: Array  # (n,)
    eps_centred: Array  # (n,) the same with the window's mean removed from the outputs of the denominator


class PendingHorizons:
    """Horizons of ``length`` T samples, at least 1, that are not complete.

    One row for each of the last T models, newest first, in a buffer of 2 T rows that fills towards
    its front: outputs (n,) of the sample that the model learnt last, its squared errors (n,) so
    far, and what its answers need.
    """

    def __init__(self, length: int, width: int) -> None:
        """Raises SemiparamError for an empty horizon."""
        if length < 1:
            raise SemiparamError(f'horizon.length is {length}; expected at least one sample.')
        self.length = length
        self.rows = np.zeros((2 * length, width))
        self._origins = np.zeros(2 * length, dtype=np.int64)
        self.clear()

    def clear(self) -> None:
        """Forget them, as after a jump of the clock."""
        self.filled, self.start = 0, 2 * self.length

    def make_room(self) -> None:
        """Have a row before the newest one; all move back to the end when they have reached the
        front, once in T samples."""
        if not self.start:
            end = 2 * self.length
            for values in (self.rows, self._origins):
                values[end - self.filled:] = values[:self.filled]
            self.start = end - self.filled

    def moved_on(self, stamp: int, eps: Array) -> HorizonErrors | None:
        """Count the row before the newest one as that of ``stamp`` [ns]; what a horizon gave (2,
        n), if it was complete."""
        found = None
        if self.filled == self.length:
            found = HorizonErrors(int(self._origins[self.start + self.length - 1]), eps[0], eps[1])
        self.start -= 1
        self.filled = min(self.filled + 1, self.length)
        self._origins[self.start] = stamp
        return found

    def state(self) -> dict[str, Array | Stamps]:
        """Copies; :meth:`restore` takes them back bit for bit."""
        used = slice(self.start, self.start + self.filled)
        return {'filled': np.array(self.filled), 'start': np.array(self.start),
                'rows': self.rows[used].copy(), 'origins': self._origins[used].copy()}

    def restore(self, state: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, when it is
        of another size."""
        filled, start = int(state['filled']), int(state['start'])
        if not 0 <= filled <= min(self.length, 2 * self.length - start) or start < 0:
            raise SemiparamError(f'the saved horizons are {filled} from row {start}; expected at most {self.length} in '
                                 f'{2 * self.length} rows.')
        expected = (filled, self.rows.shape[1]), (filled,)
        if (state['rows'].shape, state['origins'].shape) != expected:
            raise SemiparamError(f'the saved horizons have shapes {state["rows"].shape} and {state["origins"].shape}; '
                                 f'expected {expected[0]} and {expected[1]}.')
        self.filled, self.start = filled, start
        used = slice(start, start + filled)
        self.rows[used], self._origins[used] = state['rows'], state['origins']


class HorizonIndex(PendingHorizons):
    """The running index of a :class:`SemiParametricRecursion` over ``length`` T samples.

    :param decay: (K,) by which the parts of each model's offset shrink with every sample; none
        where there is none.
    """

    def __init__(self, length: int, n_outputs: int, n_features: int, n_columns: int,
                 decay: Array = NO_OFFSETS) -> None:
        self.decay = decay
        at = starts(n_outputs, n_columns, n_features)
        super().__init__(length, at.offsets + len(decay) * n_outputs)

    def advance(self, stamp: int, prior: Prior, outputs: Array, update: Update, offsets: Array,
                errors: Array) -> HorizonErrors | None:
        """Charge one sample of ``stamp`` [ns] to the last T models, and keep the model as it stands
        after it.

        :param prior: of the sample. :param outputs: (n,) measured. :param update: what it changed;
            without innovations where it was not learnt. :param offsets: (K, n) the parts of the
            model's offset at the next sample.
        :param errors: (T, n) takes the errors of the last k <= T models at this sample, newest
            first; (0, n): none.
        :return: the errors of the oldest of them when its horizon is now complete.
        """
        self.make_room()
        eps = np.empty((2, len(outputs)))
        _advance(self.rows, self.start, self.filled, self.decay, prior, outputs, update, offsets,
                 errors, eps)
        return self.moved_on(stamp, eps)


class AveragedHorizons(PendingHorizons):
    """The running index of several models in a pool (see ``opinion_pool``): of each moment's
    weights, as they stood.

    :param n_models: K, in a fixed order.
    """

    def __init__(self, length: int, n_outputs: int, n_models: int) -> None:
        super().__init__(length, (2 + n_models) * n_outputs)

    def advance(self, stamp: int, errors: Array, outputs: Array, weights: Array,
                std: Array) -> HorizonErrors | None:
        """Charge one sample, from the errors (K, T, n) that each model's own index charged it with
        and the standard deviations (K, n) of it, and keep the weights (K, n) as they stand after
        it; see :meth:`HorizonIndex.advance`.
        """
        self.make_room()
        eps = np.empty((2, len(outputs)))
        advance_average(self.rows, self.start, self.filled, errors, outputs, weights, std, eps)
        return self.moved_on(stamp, eps)


class Starts(NamedTuple):
    """Starts of the parts of a row, after outputs (n,) and squared errors (n,)."""

    gain: int  # (D,) g of the sample that the model learnt last
    innovations: int  # (n, p + 1) E of that sample
    theta: int  # (p,)
    offsets: int  # (K, n) parts of the wandering offset


@compiled
def starts(n: int, p: int, size: int) -> Starts:
    """Return those of rows of models with D = ``size`` features."""
    return Starts(2 * n, 2 * n + size, 2 * n + size + n * (p + 1), 2 * n + size + n * (p + 1) + p)


@compiled
def complete(rows: Matrix, newest: int, eps: Matrix) -> None:
    """The index (2, n) of the oldest of T models, and the centred one."""
    length, n = len(rows) // 2, eps.shape[1]
    for k in range(n):
        mean = power = spread = 0.0
        for row in range(newest, newest + length):
            mean += rows[row, k] / length
            power += rows[row, k] * rows[row, k]
        for row in range(newest, newest + length):
            spread += (rows[row, k] - mean) ** 2
        error = rows[newest + length, n + k]
        eps[0, k] = error / max(power, LEAST_POWER * length)
        eps[1, k] = error / max(spread, LEAST_POWER * length)


@compiled
def remember(row: Vector, n: int, at: Starts, update: Update, offsets: Matrix) -> None:
    """Write the model as it stands after a sample into a row."""
    row[n:at.theta] = 0.0
    row[at.theta:at.offsets] = update.theta
    row[at.offsets:] = offsets.reshape(offsets.size)
    if len(update.innovations):
        row[at.gain:at.innovations] = update.gain
        row[at.innovations:at.theta] = update.innovations.reshape(update.innovations.size)


@compiled
def advance(rows: Matrix, start: int, filled: int, decay: Vector, prior: Prior, outputs: Vector,
            update: Update, offsets: Matrix, errors: Matrix, eps: Matrix) -> None:
    """See :meth:`HorizonIndex.advance`; ``eps`` takes the index (2, n) of a horizon that is
    complete."""
    n, p = prior.columns.shape
    size, newest = len(prior.phi), start - 1
    at, regressed = starts(n, p, size), prior.projection.regressed
    running = np.empty(n * (p + 1))  # of each model in turn E_C, and less its prediction of y without it
    for k in range(n):
        for c in range(p):
            running[k * (p + 1) + c] = prior.columns[k, c] - regressed[k * (p + 1) + c]
        running[k * (p + 1) + p] = -regressed[k * (p + 1) + p]
    for model in range(filled):
        row = rows[start + model]
        squared, gain = row[n:at.gain], row[at.gain:at.innovations]
        learnt = row[at.innovations:at.theta]
        theta, offset = row[at.theta:at.offsets], row[at.offsets:]
        for k in range(n):
            left = running[k * (p + 1):(k + 1) * (p + 1)]
            error = outputs[k] + left[p]
            for c in range(p):
                error -= theta[c] * left[c]
            for g in range(len(decay)):
                error -= offset[g * n + k]
                offset[g * n + k] *= decay[g]
            squared[k] += error * error
            if len(errors):
                errors[model, k] = error
        if not size:
            continue
        weight = 0.0
        for d in range(size):
            weight += gain[d] * prior.phi[d]
        for index in range(len(running)):
            running[index] += weight * learnt[index]
    rows[newest, :n] = outputs
    if filled == len(rows) // 2:
        complete(rows, newest, eps)
    remember(rows[newest], n, at, update, offsets)


_advance = direct(advance)


@compiled
def advance_average(rows: Matrix, start: int, filled: int, errors: Stack, outputs: Vector,
                    weights: Matrix, std: Matrix, eps: Matrix) -> None:
    """See :meth:`AveragedHorizons.advance`; ``eps`` takes the index (2, n) of a horizon that is
    complete."""
    members, n = weights.shape
    newest = start - 1
    for k in range(n):
        least = std[:, k].min()
        for model in range(filled):
            row = rows[start + model]
            total = average = 0.0
            for m in range(members):
                share = row[(2 + m) * n + k] * (least / std[m, k]) ** 2
                total += share
                average += share * errors[m, model, k]
            average /= total
            row[n + k] += average * average
    rows[newest, :n] = outputs
    if filled == len(rows) // 2:
        complete(rows, newest, eps)
    rows[newest, n:2 * n] = 0.0
    for m in range(members):
        rows[newest, (2 + m) * n:(3 + m) * n] = weights[m]


def force_and_torque(eps: Array) -> tuple[float, float]:
    """eps^F and eps^T: means over the three forces and the three torques of a wrench (6,)."""
    return float(np.mean(eps[:3])), float(np.mean(eps[3:]))
