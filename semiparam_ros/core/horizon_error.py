"""Relative squared prediction error over a horizon, the paper's index (Romeres et al. 2016, section V).

    eps_t[k] = sum_{s=1..T} (y_{t+s}[k] - yhat_{t+s|t}[k])^2 / sum_{s=1..T} y_{t+s}[k]^2

with the model as it stood at t and the inputs as they came. Every sample is thus predicted by the last T models, none
of which is kept: learning sample i added g_i E_i' to Theta, so that a model of the past says

    phi' Theta_t = phi' Theta_now - sum_{i > t} (phi' g_i) E_i'

and T gains and innovations do the work of T models: T (D + n p) operations a sample in place of T D n.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.compiled import AVAILABLE, BLOCKS, MATRIX, VECTOR, compiled
from semiparam_ros.core.recursion import Correction, Prior
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.errors import SemiparamError

LEAST_POWER = 1e-18
"""Floor of a denominator for each sample, in squared outputs: far below any sensor, and keeps the index finite."""
TRIANGLE = np.tri(32, k=-1)


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
        self._innovations = np.zeros((rows, (n_columns + 1) * n_outputs))
        self._theta = np.ones((rows, n_columns + 1))  # [-theta, 1], which takes phi' Theta to the outputs
        self._squared_error = np.zeros((rows, n_outputs))
        self._no_errors = np.zeros((0, n_outputs))
        self._outputs = np.zeros((rows, n_outputs))
        self._origins = np.zeros(rows, dtype=np.int64)
        self._ones = np.ones(length)
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

    def score(self, prior: Prior, fixed: Array, outputs: Array, errors: Array | None = None) -> HorizonErrors | None:
        """Charge one sample to the last T models; the errors of the oldest when its horizon is now complete.

        :param prior: of the sample. :param fixed: (n,) the part that no model learns. :param outputs: (n,) measured.
        :param errors: (T, n) takes the errors of the last k <= T models at this sample, newest first.
        Call it before the sample is learnt, then :meth:`remember` afterwards.
        """
        self._make_room()
        self._outputs[self._start - 1] = outputs
        if self._filled:
            models = slice(self._start, self._start + self._filled)
            self._charge(prior, outputs - fixed, models, self._no_errors if errors is None else errors)
        return self._complete() if self._filled == self.length else None

    def remember(self, stamp: int, theta: Array, correction: Correction | None, offsets: Array | None = None) -> None:
        """Keep the model as it stands after the sample of ``stamp`` [ns], and let go of the oldest.

        :param theta: (p,) its coefficients. :param correction: what learning the sample did, None if it did not.
        :param offsets: (K, n) the parts of its offset at the next sample.
        """
        self._start -= 1
        self._filled = min(self._filled + 1, self.length)
        self._gains[self._start] = 0.0 if correction is None else correction.gain
        self._innovations[self._start] = 0.0 if correction is None else correction.innovations.ravel()
        np.negative(theta, out=self._theta[self._start, :-1])
        self._squared_error[self._start] = 0.0
        if offsets is not None:
            self._parts[self._start] = offsets
        self._origins[self._start] = stamp

    def _charge(self, prior: Prior, outputs: Array, models: slice, errors: Array) -> None:
        """Add the squared errors of k models of the past, and let their offsets ebb."""
        if AVAILABLE:
            _charge(self._gains[models], self._innovations[models], self._theta[models], self._parts[models],
                    self._decay, self._squared_error[models], outputs, prior.phi, prior.regressed,
                    np.ascontiguousarray(prior.columns_left), errors)
            return
        error = outputs - self._predictions(prior, models)
        if len(self._decay):
            offsets = self._parts[models]
            error -= offsets.sum(axis=1)
            offsets *= self._decay
        if len(errors):
            errors[:len(error)] = error
        self._squared_error[models] += error * error

    def _predictions(self, prior: Prior, models: slice) -> Array:
        """(k, n) what k models of the past say of a sample."""
        theta = self._theta[models]
        later = self._learnt_later(self._gains[models] @ prior.phi, self._innovations[models])
        now = prior.regressed[-1] - theta[:, :-1] @ prior.columns_left.T
        return np.asarray(now - (theta[:, None] @ later.reshape(len(theta), *prior.regressed.shape))[:, 0])

    def _learnt_later(self, weights: Array, innovations: Array) -> Array:
        """(k, q) what learning after each of k models, newest first, added to phi' Theta.

        Running sums of ``weights`` (k,) times ``innovations`` (k, q), a block at a time by a triangle of ones.
        """
        later = np.empty_like(innovations)
        for start in range(0, len(weights), len(TRIANGLE)):
            block = slice(start, start + len(TRIANGLE))
            size = len(weights[block])
            np.matmul(TRIANGLE[:size, :size] * weights[block], innovations[block], out=later[block])
            if start:
                later[block] += later[start - 1] + weights[start - 1] * innovations[start - 1]
        return later

    def _complete(self) -> HorizonErrors:
        oldest = self._start + self.length - 1
        y = self._outputs[self._start - 1:oldest]
        if AVAILABLE:
            eps, eps_centred = np.empty((2, y.shape[1]))
            _complete(y, self._squared_error[oldest], eps, eps_centred)
            return HorizonErrors(int(self._origins[oldest]), eps, eps_centred)
        ones = self._ones
        centred = y - ones @ y / self.length
        floor = LEAST_POWER * self.length
        power, spread = (np.maximum(ones @ (values * values), floor) for values in (y, centred))
        error = self._squared_error[oldest]
        return HorizonErrors(int(self._origins[oldest]), error / power, error / spread)

    def _make_room(self) -> None:
        """Move the rows back to the end when they have reached the front: once in T samples."""
        if self._start:
            return
        end = 2 * self.length
        for rows in self._rows().values():
            rows[end - self._filled:] = rows[:self._filled]
        self._start = end - self._filled


@compiled(MATRIX, MATRIX, MATRIX, BLOCKS, MATRIX, MATRIX, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX)
def _charge(gains: Array, innovations: Array, theta: Array, parts: Array, decay: Array, squared_error: Array,
            outputs: Array, phi: Array, regressed: Array, left: Array, errors: Array) -> None:
    n, p = left.shape
    running = np.zeros((p + 1) * n)  # E_C, and what was learnt after a model
    for c in range(p):
        for k in range(n):
            running[c * n + k] = left[k, c]
    error = np.empty(n)
    for row in range(len(gains)):
        for k in range(n):
            error[k] = outputs[k] - regressed[p, k]
        for c in range(p + 1):
            for k in range(n):
                error[k] += theta[row, c] * running[c * n + k]
        for g in range(len(decay)):
            for k in range(n):
                error[k] -= parts[row, g, k]
                parts[row, g, k] *= decay[g, 0]
        for k in range(n):
            squared_error[row, k] += error[k] * error[k]
        if len(errors):
            for k in range(n):
                errors[row, k] = error[k]
        weight = 0.0
        for d in range(len(phi)):
            weight += gains[row, d] * phi[d]
        for q in range(len(running)):
            running[q] += weight * innovations[row, q]


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

    def score_average(self, errors: list[Array], outputs: Array) -> HorizonErrors | None:
        """Charge one sample, from the errors (T, n) that each model's own index charged it with; see :meth:`score`."""
        self._make_room()
        self._outputs[self._start - 1] = outputs
        models = slice(self._start, self._start + self._filled)
        average = np.zeros((self._filled, len(outputs)))
        for index, each in enumerate(errors):
            average += self._shares[models, index] * each[:self._filled]
        self._squared_error[models] += average * average
        return self._complete() if self._filled == self.length else None

    def remember_weights(self, stamp: int, weights: Array) -> None:
        """Keep the weights (K, n) as they stand after the sample of ``stamp`` [ns], and let go of the oldest."""
        self._start -= 1
        self._filled = min(self._filled + 1, self.length)
        self._shares[self._start] = weights
        self._squared_error[self._start] = 0.0
        self._origins[self._start] = stamp


@compiled(MATRIX, VECTOR, VECTOR, VECTOR)
def _complete(outputs: Array, error: Array, eps: Array, eps_centred: Array) -> None:
    length = len(outputs)
    for k in range(len(error)):
        mean = power = spread = 0.0
        for row in range(length):
            mean += outputs[row, k] / length
            power += outputs[row, k] * outputs[row, k]
        for row in range(length):
            spread += (outputs[row, k] - mean) ** 2
        eps[k] = error[k] / max(power, LEAST_POWER * length)
        eps_centred[k] = error[k] / max(spread, LEAST_POWER * length)


def force_and_torque(eps: Array) -> tuple[float, float]:
    """eps^F and eps^T: means over the three forces and the three torques of a wrench (6,)."""
    return float(np.mean(eps[:3])), float(np.mean(eps[3:]))
