"""Relative squared prediction error over a horizon, the paper's index (Romeres et al. 2016, section V).

    eps_t[k] = sum_{s=1..T} (y_{t+s}[k] - yhat_{t+s|t}[k])^2 / sum_{s=1..T} y_{t+s}[k]^2

with the model as it stood at t and the inputs as they came. Every sample is thus predicted by the last T models, none
of which is kept: learning sample i added g_i E_i to Theta, so that a model of the past says

    phi' Theta_t = phi' Theta_now - sum_{i > t} (phi' g_i) E_i

and T gains and innovations do the work of T models: T (D + n p) operations a sample in place of T D n.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import prod
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.compiled import AVAILABLE, INTEGER, MATRIX, NUMBER, STACK, VECTOR, compiled
from semiparam_ros.core.opinion_pool import pool_weights
from semiparam_ros.core.recursion import Prior
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.errors import SemiparamError

LEAST_POWER = 1e-18
"""Floor of a denominator for each sample, in squared outputs: far below any sensor, and keeps the index finite."""


class HorizonErrors(NamedTuple):
    """The index of one origin t, known T samples later."""

    origin: int  # [ns] stamp of sample t
    eps: Array  # (n,)
    eps_centred: Array  # (n,) the same with the window's mean removed from the outputs of the denominator


class HorizonIndex:
    """The running index of a :class:`SemiParametricRecursion` over ``length`` T samples, at least 1.

    One row for each of the last T models, newest first, in buffers of 2 T rows that fill towards their front.

    :param decay: (K, 1) by which the parts of each model's offset shrink with every sample; None where there is none.
    """

    def __init__(self, length: int, n_outputs: int, n_features: int, n_columns: int,
                 decay: Array | None = None) -> None:
        self._decay = np.zeros((0, 1)) if decay is None else decay
        self._begin(length, n_outputs, (n_features,), (n_outputs, n_columns + 1), (n_columns,),
                    (len(self._decay), n_outputs))

    def _begin(self, length: int, n_outputs: int, *shapes: tuple[int, ...]) -> None:
        """Lay out the rows: outputs, squared errors, and what is remembered of each model."""
        if length < 1:
            raise SemiparamError(f'horizon.length is {length}; expected at least one sample.')
        self.length, self._shapes = length, shapes
        self.nothing = np.zeros((0, n_outputs))
        """Stands for errors or innovations that are not asked for or not there."""
        self._ends = np.cumsum([n_outputs, n_outputs, *map(prod, self._shapes)]).tolist()
        self._rows = np.zeros((2 * length, self._ends[-1]))
        self._origins = np.zeros(2 * length, dtype=np.int64)
        self.clear()

    @property
    def _outputs(self) -> Array:
        return self._rows[:, :self._ends[0]]

    @property
    def _squared_error(self) -> Array:
        return self._rows[:, self._ends[0]:self._ends[1]]

    def _remembered(self) -> list[Array]:
        """Of each model: gains (2 T, D), innovations (2 T, n, p + 1), theta (2 T, p), parts of offsets (2 T, K, n)."""
        ends = self._ends[1:]
        return [self._rows[:, start:end].reshape(2 * self.length, *shape)
                for start, end, shape in zip(ends[:-1], ends[1:], self._shapes, strict=True)]

    def clear(self) -> None:
        """Forget the pending horizons, as after a jump of the clock."""
        self._filled = 0
        self._start = 2 * self.length

    def state(self) -> dict[str, Array | Stamps]:
        """The pending horizons as arrays; :meth:`restore` takes them back bit for bit."""
        used = slice(self._start, self._start + self._filled)
        return {'filled': np.array(self._filled), 'start': np.array(self._start), 'rows': self._rows[used].copy(),
                'origins': self._origins[used].copy()}

    def restore(self, state: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, when it is of another size."""
        filled, start = int(state['filled']), int(state['start'])
        if not 0 <= filled <= min(self.length, 2 * self.length - start) or start < 0:
            raise SemiparamError(f'the saved horizons are {filled} from row {start}; expected at most {self.length} in '
                                 f'{2 * self.length} rows.')
        expected = (filled, self._rows.shape[1]), (filled,)
        if (state['rows'].shape, state['origins'].shape) != expected:
            raise SemiparamError(f'the saved horizons have shapes {state["rows"].shape} and {state["origins"].shape}; '
                                 f'expected {expected[0]} and {expected[1]}.')
        self._filled, self._start = filled, start
        used = slice(start, start + filled)
        self._rows[used], self._origins[used] = state['rows'], state['origins']

    def advance(self, stamp: int, prior: Prior, outputs: Array, theta: Array, innovations: Array | None,
                offsets: Array | None = None, errors: Array | None = None) -> HorizonErrors | None:
        """Charge one sample of ``stamp`` [ns] to the last T models, and keep the model as it stands after it.

        :param prior: of the sample. :param outputs: (n,) measured.
        :param theta: (p,) of the model after the sample. :param innovations: (n, p + 1) what it learnt, None if it did
            not learn it. :param offsets: (K, n) the parts of its offset at the next sample.
        :param errors: (T, n) takes the errors of the last k <= T models at this sample, newest first.
        :return: the errors of the oldest of them when its horizon is now complete.
        """
        row = self.make_room()
        learnt = self.nothing if innovations is None else innovations
        offsets = self.nothing if offsets is None else offsets
        if AVAILABLE:
            eps = np.empty((2, len(outputs)))
            advance(*self.advancing, prior.features, prior.s, prior.columns, prior.regressed, outputs, theta, learnt,
                    offsets, self.nothing if errors is None else errors, eps)
        else:
            self._outputs[row] = outputs
            if self._filled:
                self._charge(prior, outputs, errors)
            eps = self._complete() if self._filled == self.length else self.nothing
            gains, added, thetas, parts = self._remembered()
            thetas[row], self._squared_error[row] = theta, 0.0
            gains[row] = prior.features[2] / prior.s if len(learnt) else 0.0
            added[row] = learnt if len(learnt) else 0.0
            if len(offsets):
                parts[row] = offsets
        return self.moved_on(stamp, eps)

    @property
    def advancing(self) -> tuple[Array, int, int, Array]:
        """What :func:`advance` needs of the rows, after :meth:`make_room`; :meth:`moved_on` follows it."""
        return self._rows, self._start, self._filled, self._decay

    def moved_on(self, stamp: int, eps: Array) -> HorizonErrors | None:
        """The newest model is that of ``stamp``; what a horizon gave, if it was complete."""
        found = None
        if self._filled == self.length:
            found = HorizonErrors(int(self._origins[self._start + self.length - 1]), eps[0], eps[1])
        self._start -= 1
        self._filled = min(self._filled + 1, self.length)
        self._origins[self._start] = stamp
        return found

    def _charge(self, prior: Prior, outputs: Array, errors: Array | None) -> None:
        """Add the squared errors of the k models of the past, and let their offsets ebb."""
        models = slice(self._start, self._start + self._filled)
        error = outputs - self._predictions(prior, models)
        if len(self._decay):
            offsets = self._remembered()[3][models]
            error -= offsets.sum(axis=1)
            offsets *= self._decay
        if errors is not None:
            errors[:len(error)] = error
        self._squared_error[models] += error * error

    def _predictions(self, prior: Prior, models: slice) -> Array:
        """(k, n) what k models of the past say of a sample."""
        gains, innovations, thetas, _ = self._remembered()
        later = self._learnt_later(gains[models] @ prior.features[0], innovations[models])
        left = prior.columns_left + later[:, :, :-1]
        return np.asarray(prior.regressed[:, -1] - later[:, :, -1] + (left @ thetas[models, :, None])[:, :, 0])

    @staticmethod
    def _learnt_later(weights: Array, innovations: Array) -> Array:
        """(k, n, p + 1) what learning after each of k models, newest first, added to phi' Theta.

        Sums of ``weights`` (k,) times ``innovations`` (k, n, p + 1), each of those before it.
        """
        added = weights[:, None, None] * innovations
        return np.asarray(np.cumsum(added, axis=0) - added)

    def _complete(self) -> Array:
        """(2, n) the index of the oldest model, and the centred one."""
        y = self._outputs[self._start - 1:self._start - 1 + self.length]
        error = self._squared_error[self._start + self.length - 1]
        if AVAILABLE:
            eps = np.empty((2, len(error)))
            _complete(self._rows, self._start - 1, self.length, eps)
            return eps
        centred = y - y.mean(axis=0)
        power = np.maximum([(values * values).sum(axis=0) for values in (y, centred)], LEAST_POWER * self.length)
        return np.asarray(error / power)

    def make_room(self) -> int:
        """The row of the newest model; all move back to the end when they have reached the front, once in T samples."""
        if not self._start:
            end = 2 * self.length
            self._rows[end - self._filled:] = self._rows[:self._filled]
            self._origins[end - self._filled:] = self._origins[:self._filled]
            self._start = end - self._filled
        return self._start - 1


@compiled(MATRIX, INTEGER, INTEGER, MATRIX)
def _complete(rows: Array, newest: int, length: int, eps: Array) -> None:
    n = eps.shape[1]
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


@compiled(MATRIX, INTEGER, INTEGER, MATRIX, MATRIX, NUMBER, MATRIX, MATRIX, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX,
          MATRIX)
def advance(rows: Array, start: int, filled: int, decay: Array, features: Array, s: float, columns: Array,
            regressed: Array, outputs: Array, theta: Array, learnt: Array, offsets: Array, errors: Array,
            eps: Array) -> None:
    """See :meth:`HorizonIndex.advance`; empty for what is None there."""
    n, p = columns.shape
    size, length, newest = features.shape[1], len(rows) // 2, start - 1
    gains = 2 * n  # where in a row each begins
    innovations = gains + size
    thetas = innovations + n * (p + 1)
    parts = thetas + p
    running = np.empty(n * (p + 1))  # of each model in turn E_C, and less its prediction of y without it
    for k in range(n):
        for c in range(p):
            running[k * (p + 1) + c] = columns[k, c] - regressed[k, c]
        running[k * (p + 1) + p] = -regressed[k, p]
    for model in range(filled):
        row = rows[start + model]
        squared, gain, learnt_then = row[n:gains], row[gains:innovations], row[innovations:thetas]
        coefficients, offset = row[thetas:parts], row[parts:]
        for k in range(n):
            left = running[k * (p + 1):(k + 1) * (p + 1)]
            error = outputs[k] + left[p]
            for c in range(p):
                error -= coefficients[c] * left[c]
            for g in range(len(decay)):
                error -= offset[g * n + k]
                offset[g * n + k] *= decay[g, 0]
            squared[k] += error * error
            if len(errors):
                errors[model, k] = error
        if not size:
            continue
        weight = 0.0
        for d in range(size):
            weight += gain[d] * features[0, d]
        for index in range(len(running)):
            running[index] += weight * learnt_then[index]
    rows[newest, :n] = outputs
    if filled == length:
        _complete(rows, newest, length, eps)
    row = rows[newest]
    row[n:] = 0.0
    row[thetas:parts] = theta
    for k in range(len(learnt)):
        row[innovations + k * (p + 1):innovations + (k + 1) * (p + 1)] = learnt[k]
    for d in range(size if len(learnt) else 0):
        row[gains + d] = features[2, d] / s
    for g in range(len(offsets)):
        row[parts + g * n:parts + (g + 1) * n] = offsets[g]


class AveragedHorizons(HorizonIndex):
    """The running index of several models in a pool (see ``opinion_pool``): of each moment's weights, as they stood.

    :param n_models: K, in a fixed order.
    """

    def __init__(self, length: int, n_outputs: int, n_models: int) -> None:
        self._begin(length, n_outputs, (n_models, n_outputs))

    def advance_average(self, stamp: int, errors: Array, outputs: Array, weights: Array, std: Array,
                        ) -> HorizonErrors | None:
        """Charge one sample, from the errors (K, T, n) that each model's own index charged it with and the standard
        deviations (K, n) of it, and keep the weights (K, n) as they stand after it; see :meth:`advance`."""
        if AVAILABLE:
            self.make_room()
            eps = np.empty((2, len(outputs)))
            _advance_average(self._rows, self._start, self._filled, errors, outputs, weights, std, eps)
            return self.moved_on(stamp, eps)
        return self.moved_on(stamp, self._advance_average(errors, outputs, weights, std))

    def _advance_average(self, errors: Array, outputs: Array, weights: Array, std: Array) -> Array:
        row = self.make_room()
        self._outputs[row] = outputs
        models, (kept,) = slice(self._start, self._start + self._filled), self._remembered()
        shares = pool_weights(kept[models], std)
        average = np.zeros((self._filled, len(outputs)))
        for index, each in enumerate(errors):
            average += shares[:, index] * each[:self._filled]
        self._squared_error[models] += average * average
        eps = self._complete() if self._filled == self.length else self.nothing
        kept[row], self._squared_error[row] = weights, 0.0
        return eps


@compiled(MATRIX, INTEGER, INTEGER, STACK, VECTOR, MATRIX, MATRIX, MATRIX)
def _advance_average(rows: Array, start: int, filled: int, errors: Array, outputs: Array, weights: Array, std: Array,
                     eps: Array) -> None:
    """See :meth:`AveragedHorizons.advance_average`."""
    members, n = weights.shape
    length, newest = len(rows) // 2, start - 1
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
    if filled == length:
        _complete(rows, newest, length, eps)
    rows[newest, n:2 * n] = 0.0
    for m in range(members):
        rows[newest, (2 + m) * n:(3 + m) * n] = weights[m]


def force_and_torque(eps: Array) -> tuple[float, float]:
    """eps^F and eps^T: means over the three forces and the three torques of a wrench (6,)."""
    return float(np.mean(eps[:3])), float(np.mean(eps[3:]))
