"""Relative squared prediction error over a horizon, the paper's index (Romeres et al. 2016, section V).

    eps_t[k] = sum_{s=1..T} (y_{t+s}[k] - yhat_{t+s|t}[k])^2 / sum_{s=1..T} y_{t+s}[k]^2

with the model as it stood at t and the inputs as they came. Every sample is thus predicted by the last T models, none
of which is kept: learning sample i added g_i E_i to Theta, so that a model of the past says

    phi' Theta_t = phi' Theta_now - sum_{i > t} (phi' g_i) E_i

and T gains and innovations do the work of T models: T (D + n p) operations a sample in place of T D n.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.compiled import AVAILABLE, BLOCKS, INTEGER, MATRIX, NUMBER, VECTOR, compiled
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
        if length < 1:
            raise SemiparamError(f'horizon.length is {length}; expected at least one sample.')
        self.length = length
        rows = 2 * length
        self._gains = np.zeros((rows, n_features))
        self._innovations = np.zeros((rows, n_outputs, n_columns + 1))
        self._theta = np.zeros((rows, n_columns))
        self._squared_error = np.zeros((rows, n_outputs))
        self._nothing, self._no_parts = np.zeros((0, 1)), np.zeros((0, n_outputs))
        self._outputs = np.zeros((rows, n_outputs))
        self._origins = np.zeros(rows, dtype=np.int64)
        self._decay = np.zeros((0, 1)) if decay is None else decay
        self._parts = np.zeros((rows, len(self._decay), n_outputs))
        self.clear()

    def clear(self) -> None:
        """Forget the pending horizons, as after a jump of the clock."""
        self._filled = 0
        self._start = 2 * self.length

    def state(self) -> dict[str, Array | Stamps]:
        """The pending horizons as arrays; :meth:`restore` takes them back bit for bit."""
        used = slice(self._start, self._start + self._filled)
        return {'filled': np.array(self._filled), 'start': np.array(self._start),
                **{name: rows[used].copy() for name, rows in self._rows().items()}}

    def restore(self, state: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, when it is of another size."""
        filled, start = int(state['filled']), int(state['start'])
        if not 0 <= filled <= min(self.length, 2 * self.length - start) or start < 0:
            raise SemiparamError(f'the saved horizons are {filled} from row {start}; expected at most {self.length} in '
                                 f'{2 * self.length} rows.')
        for name, rows in self._rows().items():
            if state[name].shape != (filled, *rows.shape[1:]):
                raise SemiparamError(f"the saved '{name}' of the horizons has shape {state[name].shape}; expected "
                                     f'{(filled, *rows.shape[1:])}.')
        self._filled, self._start = filled, start
        for name, rows in self._rows().items():
            rows[start:start + filled] = state[name]

    def _rows(self) -> dict[str, Array | Stamps]:
        return {'gains': self._gains, 'innovations': self._innovations, 'theta': self._theta,
                'squared_error': self._squared_error, 'outputs': self._outputs, 'origins': self._origins,
                'offsets': self._parts}

    def advance(self, stamp: int, prior: Prior, outputs: Array, theta: Array, innovations: Array | None,
                offsets: Array | None = None, errors: Array | None = None) -> HorizonErrors | None:
        """Charge one sample of ``stamp`` [ns] to the last T models, and keep the model as it stands after it.

        :param prior: of the sample. :param outputs: (n,) measured.
        :param theta: (p,) of the model after the sample. :param innovations: (n, p + 1) what it learnt, None if it did
            not learn it. :param offsets: (K, n) the parts of its offset at the next sample.
        :param errors: (T, n) takes the errors of the last k <= T models at this sample, newest first.
        :return: the errors of the oldest of them when its horizon is now complete.
        """
        learnt = self._nothing if innovations is None else innovations
        parts = self._no_parts if offsets is None else offsets
        self._make_room()
        row, oldest = self._start - 1, self._start + self.length - 1
        if AVAILABLE:
            eps = np.empty((2, len(outputs)))
            _advance(self._start, self._filled, self._gains, self._innovations, self._theta, self._parts, self._decay,
                     self._squared_error, self._outputs, outputs, prior.phi, prior.reach, prior.s, prior.regressed,
                     prior.columns_left, theta, learnt, parts,
                     self._no_parts if errors is None else errors, eps)
        else:
            self._outputs[row] = outputs
            if self._filled:
                self._charge(prior, outputs, errors)
            eps = self._complete() if self._filled == self.length else self._no_parts
            self._theta[row], self._squared_error[row] = theta, 0.0
            self._gains[row] = prior.reach / prior.s if len(learnt) else 0.0
            self._innovations[row] = learnt if len(learnt) else 0.0
            if len(parts):
                self._parts[row] = parts
        return self._moved_on(stamp, eps, oldest)

    def _moved_on(self, stamp: int, eps: Array, oldest: int) -> HorizonErrors | None:
        """The newest model is that of ``stamp``; what a horizon gave, if it was complete, from the oldest one on."""
        found = HorizonErrors(int(self._origins[oldest]), eps[0], eps[1]) if self._filled == self.length else None
        self._start -= 1
        self._filled = min(self._filled + 1, self.length)
        self._origins[self._start] = stamp
        return found

    def _charge(self, prior: Prior, outputs: Array, errors: Array | None) -> None:
        """Add the squared errors of the k models of the past, and let their offsets ebb."""
        models = slice(self._start, self._start + self._filled)
        error = outputs - self._predictions(prior, models)
        if len(self._decay):
            offsets = self._parts[models]
            error -= offsets.sum(axis=1)
            offsets *= self._decay
        if errors is not None:
            errors[:len(error)] = error
        self._squared_error[models] += error * error

    def _predictions(self, prior: Prior, models: slice) -> Array:
        """(k, n) what k models of the past say of a sample."""
        later = self._learnt_later(self._gains[models] @ prior.phi, self._innovations[models])
        left = prior.columns_left + later[:, :, :-1]
        return np.asarray(prior.regressed[:, -1] - later[:, :, -1] + (left @ self._theta[models, :, None])[:, :, 0])

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
            _complete(y, error, eps)
            return eps
        centred = y - y.mean(axis=0)
        power = np.maximum([(values * values).sum(axis=0) for values in (y, centred)], LEAST_POWER * self.length)
        return np.asarray(error / power)

    def _make_room(self) -> None:
        """Move the rows back to the end when they have reached the front: once in T samples."""
        if self._start:
            return
        end = 2 * self.length
        for rows in self._rows().values():
            rows[end - self._filled:] = rows[:self._filled]
        self._start = end - self._filled


@compiled(MATRIX, VECTOR, MATRIX)
def _complete(outputs: Array, error: Array, eps: Array) -> None:
    length = len(outputs)
    for k in range(len(error)):
        mean = power = spread = 0.0
        for row in range(length):
            mean += outputs[row, k] / length
            power += outputs[row, k] * outputs[row, k]
        for row in range(length):
            spread += (outputs[row, k] - mean) ** 2
        eps[0, k] = error[k] / max(power, LEAST_POWER * length)
        eps[1, k] = error[k] / max(spread, LEAST_POWER * length)


@compiled(INTEGER, INTEGER, MATRIX, BLOCKS, MATRIX, BLOCKS, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, VECTOR,
          NUMBER, MATRIX, MATRIX, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX)
def _advance(start: int, filled: int, gains: Array, innovations: Array, thetas: Array, parts: Array, decay: Array,
             squared_error: Array, measured: Array, outputs: Array, phi: Array, reach: Array, s: float,
             regressed: Array, left: Array, theta: Array, learnt: Array, offsets: Array, errors: Array,
             eps: Array) -> None:
    n, p = left.shape
    running = regressed.copy()  # E_C, and the prediction of y without it, of each model in turn
    running[:, :p] = left
    for row in range(start, start + filled):
        for k in range(n):
            error = outputs[k] - running[k, p]
            for c in range(p):
                error -= thetas[row, c] * running[k, c]
            for g in range(len(decay)):
                error -= parts[row, g, k]
                parts[row, g, k] *= decay[g, 0]
            squared_error[row, k] += error * error
            if len(errors):
                errors[row - start, k] = error
        weight = 0.0
        for d in range(len(phi)):
            weight += gains[row, d] * phi[d]
        for k in range(n):
            for c in range(p):
                running[k, c] += weight * innovations[row, k, c]
            running[k, p] -= weight * innovations[row, k, p]
    newest, length = start - 1, len(gains) // 2
    measured[newest] = outputs
    if filled == length:
        _complete(measured[newest:newest + length], squared_error[newest + length], eps)
    squared_error[newest] = 0.0
    thetas[newest] = theta
    if len(learnt):
        innovations[newest] = learnt
        for d in range(len(phi)):
            gains[newest, d] = reach[d] / s
    else:
        innovations[newest] = 0.0
        gains[newest] = 0.0
    if len(offsets):
        parts[newest] = offsets


class AveragedHorizons(HorizonIndex):
    """The running index of a weighted average of models: of each moment's weights, as they stood.

    :param n_models: K, in a fixed order.
    """

    def __init__(self, length: int, n_outputs: int, n_models: int) -> None:
        self._shares = np.zeros((2 * length, n_models, n_outputs))
        super().__init__(length, n_outputs, 0, 0)

    def _rows(self) -> dict[str, Array | Stamps]:
        return {'weights': self._shares, 'squared_error': self._squared_error, 'outputs': self._outputs,
                'origins': self._origins}

    def advance_average(self, stamp: int, errors: Array, outputs: Array, weights: Array) -> HorizonErrors | None:
        """Charge one sample, from the errors (K, T, n) that each model's own index charged it with, and keep the
        weights (K, n) as they stand after it; see :meth:`advance`."""
        self._make_room()
        row, oldest = self._start - 1, self._start + self.length - 1
        self._outputs[row] = outputs
        models = slice(self._start, self._start + self._filled)
        average = np.zeros((self._filled, len(outputs)))
        for index, each in enumerate(errors):
            average += self._shares[models, index] * each[:self._filled]
        self._squared_error[models] += average * average
        eps = self._complete() if self._filled == self.length else self._no_parts
        self._shares[row], self._squared_error[row] = weights, 0.0
        return self._moved_on(stamp, eps, oldest)


def force_and_torque(eps: Array) -> tuple[float, float]:
    """eps^F and eps^T: means over the three forces and the three torques of a wrench (6,)."""
    return float(np.mean(eps[:3])), float(np.mean(eps[3:]))
