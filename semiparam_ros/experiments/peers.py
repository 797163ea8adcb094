"""Peers: learners of other packages beside our variants, on the same samples: predict, then learn.

Every learner gets the initial window first, and is scored from its end on. The others get what
their users would give them: inputs, outputs and columns scaled by the window, and the package's own
defaults.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from river.linear_model import BayesianLinearRegression
from sklearn.base import RegressorMixin
from sklearn.kernel_approximation import RBFSampler
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import BayesianRidge, SGDRegressor
from sklearn.multioutput import MultiOutputRegressor

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.initial_window import gathered_from
from semiparam_ros.core.random_features import input_scaling
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import normalised_errors
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator, build_rigid_body, declared_effects, model_options

TURN = 50
"""Samples that a learner takes before it is the next one's turn: a busy moment of the machine hurts them all."""

REFITTED_EVERY, REFITTED_ON = 100, 1000
"""Learners that only know a batch are fitted anew after so many samples, to the latest so many."""


class Score(NamedTuple):
    """Score of one learner."""

    learner: str
    sees: str
    nmse: list[float | None]  # of each output
    nmse_mean: float
    window_s: float  # time that the initial window took, hyperparameters included
    microseconds: float  # a sample, mean: prediction and learning


class PeerWindow(NamedTuple):
    """The initial window: inputs (t, m), coupled columns (t, n, p), outputs (t, n)."""

    inputs: Array
    columns: Array
    outputs: Array


class View(ABC):
    """View that a learner has of a sample: one row of regressors, or one for each output."""

    sees: str
    centred = True
    """Outputs are free of their mean in the window; a rigid body has its own constant."""

    @abstractmethod
    def begin(self, window: PeerWindow) -> None:
        """Take the scales from the initial window."""

    @abstractmethod
    def rows(self, inputs: Array, columns: Array) -> Array:
        """Regressors (t, r, k) of t samples, r being 1 or the number of outputs."""


class RigidBodyView(View):
    """The rows of the coupled columns, scaled."""

    sees, centred = 'rigid body', False

    def begin(self, window: PeerWindow) -> None:
        weighed = window.columns / window.outputs.std(axis=0)[:, None]
        size = np.sqrt(np.mean(weighed**2, axis=(0, 1)))
        self._scale = np.where(size > 1e-12, size, 1.0) * window.outputs.std(axis=0)[:, None]

    def rows(self, inputs: Array, columns: Array) -> Array:
        return np.asarray(columns / self._scale)


class InputView(View):
    """Positions, velocities and accelerations, scaled."""

    sees = 'inputs'

    def begin(self, window: PeerWindow) -> None:
        self._mean, self._scale = input_scaling(window.inputs)

    def rows(self, inputs: Array, columns: Array) -> Array:
        return np.asarray((inputs - self._mean) / self._scale)[:, None]


class FeatureView(InputView):
    """Random features of them, as scikit-learn makes them."""

    def __init__(self, count: int) -> None:
        self.sees = f'D = {count}'
        self._sampler = RBFSampler(gamma='scale', n_components=count, random_state=0)

    def begin(self, window: PeerWindow) -> None:
        super().begin(window)
        self._sampler.fit(super().rows(window.inputs, window.columns)[:, 0])

    def rows(self, inputs: Array, columns: Array) -> Array:
        return np.asarray(self._sampler.transform(super().rows(inputs, columns)[:, 0]))[:, None]


class Peer(ABC):
    """A learner of another package."""

    name: str

    def __init__(self, view: View, n_outputs: int) -> None:
        self.view, self.n_outputs = view, n_outputs

    def begin(self, window: PeerWindow) -> None:
        """Take the scales from the initial window, and learn it."""
        self.view.begin(window)
        self._mean = window.outputs.mean(axis=0) * self.view.centred
        self._scale = window.outputs.std(axis=0)
        self.fit(self.view.rows(window.inputs, window.columns), (window.outputs - self._mean) / self._scale)

    def predict(self, inputs: Array, columns: Array) -> Array:
        """Outputs (n,) of a sample, of inputs (m,) and columns (n, p)."""
        self._rows = self.view.rows(inputs[None], columns[None])[0]
        return np.asarray(self.predict_rows(self._rows) * self._scale + self._mean)

    def learn(self, outputs: Array) -> None:
        """Learn the sample that was predicted last."""
        self.learn_rows(self._rows, (outputs - self._mean) / self._scale)

    def fit(self, rows: Array, outputs: Array) -> None:
        """Learn rows (t, r, k) and their outputs (t, n)."""
        for row, output in zip(rows, outputs, strict=True):
            self.learn_rows(row, output)

    @abstractmethod
    def predict_rows(self, rows: Array) -> Array:
        """Outputs (n,) of rows (r, k)."""

    @abstractmethod
    def learn_rows(self, rows: Array, outputs: Array) -> None:
        """Learn rows (r, k) and outputs (n,)."""


class River(Peer):
    """river's Bayesian linear regression, one for each output."""

    name = 'river BayesianLinearRegression'

    def __init__(self, view: View, n_outputs: int) -> None:
        super().__init__(view, n_outputs)
        self._models = [BayesianLinearRegression() for _ in range(n_outputs)]

    def predict_rows(self, rows: Array) -> Array:
        named = self._named(rows)
        return np.array([model.predict_one(row) for model, row in zip(self._models, named, strict=True)])

    def learn_rows(self, rows: Array, outputs: Array) -> None:
        for model, row, output in zip(self._models, self._named(rows), outputs.tolist(), strict=True):
            model.learn_one(row, output)

    def _named(self, rows: Array) -> list[dict[int, float]]:
        named = [dict(enumerate(row)) for row in rows.tolist()]
        return named * self.n_outputs if len(named) == 1 else named


class Sgd(Peer):
    """scikit-learn's stochastic gradient descent, one for each output."""

    name = 'sklearn SGDRegressor'

    def __init__(self, view: View, n_outputs: int) -> None:
        super().__init__(view, n_outputs)
        self._models = [SGDRegressor(random_state=0) for _ in range(n_outputs)]

    def predict_rows(self, rows: Array) -> Array:
        return np.concatenate([model.predict(rows[min(index, len(rows) - 1)][None])
                               for index, model in enumerate(self._models)])

    def learn_rows(self, rows: Array, outputs: Array) -> None:
        for index, model in enumerate(self._models):
            model.partial_fit(rows[min(index, len(rows) - 1)][None], outputs[index:index + 1])


class Refitted(Peer):
    """A learner of batches, fitted anew again and again to the latest samples."""

    def __init__(self, view: View, n_outputs: int, make: Callable[[], RegressorMixin]) -> None:
        super().__init__(view, n_outputs)
        self._make = make
        self._latest: deque[tuple[Array, Array]] = deque(maxlen=REFITTED_ON)
        self._since = 0

    def fit(self, rows: Array, outputs: Array) -> None:
        self._latest.extend(zip(rows, outputs, strict=True))
        self._fit()

    def predict_rows(self, rows: Array) -> Array:
        return np.asarray(self._model.predict(rows)).ravel()

    def learn_rows(self, rows: Array, outputs: Array) -> None:
        self._latest.append((rows, outputs))
        self._since += 1
        if self._since == REFITTED_EVERY:
            self._fit()

    def _fit(self) -> None:
        """One row for each output: a single set of coefficients; one row for all: one set for each output."""
        rows = np.concatenate([rows for rows, _ in self._latest])
        outputs = np.array([outputs for _, outputs in self._latest])
        self._model: Any = self._make()
        several = self.n_outputs > 1 and len(rows) == len(outputs)
        self._model.fit(rows, outputs if several else outputs.ravel())
        self._since = 0


class RefittedRidge(Refitted):
    """scikit-learn's Bayesian ridge regression."""

    name = 'sklearn BayesianRidge, batch'

    def __init__(self, view: View, n_outputs: int) -> None:
        super().__init__(view, n_outputs, BayesianRidge if n_outputs == 1 or isinstance(view, RigidBodyView)
                         else lambda: MultiOutputRegressor(BayesianRidge()))


class RefittedKernelRidge(Refitted):
    """scikit-learn's kernel ridge regression."""

    name = 'sklearn KernelRidge, batch'

    def __init__(self, view: View, n_outputs: int) -> None:
        super().__init__(view, n_outputs, lambda: KernelRidge(alpha=1e-2, kernel='rbf'))


def peers(n_outputs: int, count: int) -> list[Peer]:
    """Peers of every kind, with ``count`` random features where they have any."""
    return [River(RigidBodyView(), n_outputs), RefittedRidge(RigidBodyView(), n_outputs),
            River(FeatureView(count), n_outputs), Sgd(FeatureView(count), n_outputs),
            RefittedRidge(FeatureView(count), n_outputs), RefittedKernelRidge(InputView(), n_outputs)]


class _Turns:
    """Turns of one learner: what it predicted, and the time that it took."""

    def __init__(self, learner: str, sees: str, begin: Callable[[], None], step: Callable[[int], Array]) -> None:
        self.learner, self.sees, self._step = learner, sees, step
        self.predictions: list[Array] = []
        start = time.perf_counter()
        begin()
        self.window_s, self.seconds = time.perf_counter() - start, 0.0

    def take(self, indices: range) -> None:
        start = time.perf_counter()
        self.predictions += map(self._step, indices)
        self.seconds += time.perf_counter() - start

    def score(self, measured: Array) -> Score:
        nmse, _ = normalised_errors(np.array(self.predictions) - measured, measured)
        known = [value for value in nmse if value is not None]
        return Score(self.learner, self.sees, nmse, float(np.mean(known)), self.window_s,
                     1e6 * self.seconds / len(measured))


def compare_with_peers(settings: Settings, samples: Samples, robot_description: str | None, variants: Sequence[str],
                       tick: Callable[[], None]) -> list[Score]:
    """Scores of our variants and of the peers on one recording.

    :param tick: called once for each learner that has its window, and once for each turn of each.

    Raises SemiparamError when the recording is hardly longer than the initial window.
    """
    gathered = gathered_from(samples, settings.initial_samples)
    if len(samples) - gathered.end < TURN:
        raise SemiparamError(f'the recording holds {len(samples)} samples, of which the initial window takes '
                             f'{gathered.end}; expected at least {TURN} more.')
    body = build_rigid_body(settings, robot_description)
    coupled = CoupledColumns(body, declared_effects(settings), settings.joint_friction)
    columns = np.asarray(coupled.batch(samples)[0])
    window = PeerWindow(samples.inputs[gathered.indices], columns[gathered.indices], samples.outputs[gathered.indices])
    learners: list[_Turns] = []
    for variant in variants:
        learners.append(_ours(replace(settings, variant=variant), samples, robot_description, gathered.end))
        tick()
    for peer in peers(body.n_outputs, model_options(settings).most_features):
        learners.append(_theirs(peer, samples, columns, window))
        tick()
    for start in range(gathered.end, len(samples), TURN):
        for learner in learners:
            learner.take(range(start, min(start + TURN, len(samples))))
            tick()
    return [learner.score(samples.outputs[gathered.end:]) for learner in learners]


def _ours(settings: Settings, samples: Samples, robot_description: str | None, end: int) -> _Turns:
    estimator = build_estimator(settings, robot_description, samples.origin)
    each = list(samples)

    def begin() -> None:
        for sample in each[:end]:
            estimator.step(sample)

    turns = _Turns(settings.variant, '', begin, lambda index: estimator.step(each[index]).mean)
    count = estimator.features_count
    parts = ['rigid body'] * (estimator.variant.pi != 'absent') + [f'D = {count}'] * (count > 0)
    turns.sees = ', '.join(parts)
    return turns


def _theirs(peer: Peer, samples: Samples, columns: Array, window: PeerWindow) -> _Turns:
    inputs, outputs = samples.inputs, samples.outputs

    def step(index: int) -> Array:
        predicted = peer.predict(inputs[index], columns[index])
        peer.learn(outputs[index])
        return predicted

    return _Turns(peer.name, peer.view.sees, lambda: peer.begin(window), step)
