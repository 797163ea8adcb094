"""A model that is learnt sample by sample, with what follows its errors: offset, bands, and index
over the horizon."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.band_calibration import BandCalibration, calibrate
from semiparam_ros.core.carry_over import Coefficients
from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.compiled import Matrix, Vector, compiled, direct
from semiparam_ros.core.horizon_error import NO_OFFSETS, HorizonErrors, HorizonIndex, advance
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.initial_window import Remembered
from semiparam_ros.core.learnt_inputs import LearntInputs
from semiparam_ros.core.model import AUTO, Model, ModelOptions, information_gain
from semiparam_ros.core.prediction import DesiredOutputs, MemberPrediction, Observed
from semiparam_ros.core.recursion import Prior, Regression, Update, learn
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.square_root_filter import Root
from semiparam_ros.core.types import Array, Indices, Stamps
from semiparam_ros.core.wandering_offset import DECAY, WanderingOffset, follow

MOST_DEVIATION = 2.0
"""Over that of the noise: a desired state that is more uncertain is not one to follow unasked. Where one of 23 pairs of
motions covers the range of the other, at least 80 % of the states are below."""


class ModelState(NamedTuple):
    """State of a model: what it has learnt, with its hyperparameters."""

    hyperparameters: Hyperparameters
    recursion: Mapping[str, Array | Indices]
    horizon: Mapping[str, Array | Stamps]
    calibration: dict[str, Array]
    wandering: dict[str, Array]  # empty where the forgetting is a number
    window_left: int  # samples
    passed_over: tuple[int, int]  # samples passed over since the last one learnt, and altogether


class OnlineModel:
    """A model, the offset that wanders beside it, the width of its bands, and its index over the
    horizon.

    :param columns: of C that it has. :param ready: whether its hyperparameters are those of an
        initial window.
    :param window: how many samples of that window come again first.
    """

    def __init__(self, model: Model, columns: CoupledColumns, options: ModelOptions, ready: bool,
                 window: int = 0) -> None:
        recursion = model.recursion
        self.model, self.columns, self.ready, self._options = model, columns, ready, options
        self.calibration = BandCalibration(recursion.n_outputs)
        self.wandering = WanderingOffset(recursion.n_outputs) if options.forgetting == AUTO else None
        self.horizon = HorizonIndex(options.horizon, recursion.n_outputs, recursion.n_features, recursion.n_columns,
                                    NO_OFFSETS if self.wandering is None else DECAY)
        self._nothing = np.zeros((0, recursion.n_outputs))
        self.window_left = window
        self._since_learnt = 0
        self.passed_over = 0
        """Samples that were to be learnt but were not: see :meth:`_is_due`."""

    def predict(self, observed: Observed, columns: Array) -> MemberPrediction:
        """Predict a sample, whose columns (n, p) are those of this model; nothing changes."""
        prior = self.model.predict(observed.x, columns)
        std = self.calibration.factor * prior.std
        return MemberPrediction(self._mean(prior), std, prior, columns)

    def _mean(self, prior: Prior) -> Array:
        return prior.mean if self.wandering is None else prior.mean + self.wandering.offset

    def known(self, x: Array, learnt: LearntInputs) -> float:
        """Share of the variance of the features at x (m,) that the inputs ``learnt`` take away; 1
        without features."""
        recursion, features = self.model.recursion, self.model.features
        return 1.0 if features is None else learnt.known(x, features, (recursion.sigma / recursion.rho)**2)

    def predict_desired(self, x: Array, shown: Array, needed: Array, known: float) -> DesiredOutputs:
        """Outputs at x (m,), from the columns (n, p) of what the sensor shows and of what the arm
        needs.

        Without the wandering offset, which is that of the last moments' motion. Features fade as
        little is :meth:`known`.
        """
        model, recursion, features = self.model, self.model.recursion, self.model.features
        phi = np.zeros(0) if features is None else np.sqrt(known) * features(x)
        prior = model.predict_by(recursion, phi, shown)
        variances = prior.covariance.reshape(-1)[::recursion.n_outputs + 1]
        variances += (1.0 - known) * recursion.rho**2 * recursion.scale**2
        ratio = ((variances - prior.extra_variance) / (MOST_DEVIATION * model.noise_std) ** 2).max()
        own = prior.mean if needed is shown else prior.mean - (shown - needed)[:, model.covered] @ model.theta
        return DesiredOutputs(prior.mean, own, prior.covariance, float(ratio))

    def coefficients(self) -> Coefficients:
        """Coefficients of the model as it stands."""
        alpha = self.model.recursion.weights() if self.model.features else \
            np.zeros((self.model.recursion.n_outputs, 0))
        return Coefficients(self.model.theta.copy(), alpha)

    def take_in(self, sample: Sample, prediction: MemberPrediction, learn: bool, is_news: bool,
                errors: Array | None = None, follow: bool = False, begins_step: bool = True) -> HorizonErrors | None:
        """Charge a predicted sample to the horizon index, and learn it where it is due; the horizon
        it completed.

        :param is_news: let bands follow it, and the wandering offset where it is learnt.
        :param errors: see :meth:`HorizonIndex.advance`. :param follow: let the wandering offset
            follow it all the same. :param begins_step: whether a window may take it.
        """
        prior, recursion = prediction.prior, self.model.recursion
        errors = self._nothing if errors is None else errors
        outputs = np.ascontiguousarray(sample.outputs, dtype=float)
        due = learn and self._is_due(prior, begins_step)
        if due and is_news and self.wandering is not None:
            self.window_left -= min(self.window_left, 1)
            horizon = self.horizon
            theta, eps = np.empty(len(recursion.theta)), np.empty((2, len(outputs)))
            horizon.make_room()
            placed = _learn_and_follow(
                *recursion.arrays, prior, outputs, self.wandering.table, self.calibration.table,
                horizon.rows, horizon.start, horizon.filled, horizon.decay, theta, errors, eps)
            recursion.take_over(theta, placed)
            return horizon.moved_on(sample.stamp, eps)
        if due:
            update = recursion.learn(prior, outputs)
        else:
            recursion.revise()  # what effects remember has changed, and so have the pending horizons
            update = Update(recursion.theta, self._nothing, recursion.theta[:0])
        # At rest nothing tells how wide the bands of motion are; the window held what was learnt.
        if is_news and (learn or not self.window_left):
            self.window_left -= min(self.window_left, learn)
            self._follow(outputs, prior, learn or follow)
        parts = self._nothing if self.wandering is None else self.wandering.parts
        return self.horizon.advance(sample.stamp, prior, outputs, update, parts, errors)

    def _is_due(self, prior: Prior, begins_step: bool) -> bool:
        """Tell whether a sample that is to be learnt is the next of so many, and tells enough; the
        initial window is whole.

        Where noise stays alike, one sample of each step is learnt: how much it tells is known of such samples.
        Never by its outputs: to learn the surprising ones alone would bias the model.
        """
        options = self._options
        if not self.ready or self.window_left:
            return True
        self._since_learnt += 1
        if self._since_learnt < options.learn_every or (self.model.by_steps and not begins_step) or (
                options.learn_least_gain and information_gain(prior, self.model.noise_std)
                < options.learn_least_gain):
            self.passed_over += 1
            return False
        self._since_learnt = 0
        return True

    def _follow(self, outputs: Array, prior: Prior, follow: bool) -> None:
        """Let bands, and the wandering offset where it is to follow, follow what ``prior`` left of
        a sample (n,), in N and N m."""
        residual = outputs - prior.mean
        if self.wandering is None:
            self.calibration.learn(residual, prior.std)
        elif follow:
            _follow(residual, prior.std, self.wandering.table, self.calibration.table)
        else:
            innovation = residual - self.wandering.offset
            self.wandering.rest()
            self.calibration.learn(innovation, prior.std)

    def learn_again(self, remembered: Remembered) -> tuple[Array, Array]:
        """Learn a sample of the window; mean and standard deviation (n,) that were predicted for
        it, in N and N m."""
        inputs, outputs, columns = remembered
        prior = self.model.predict(inputs, columns)
        mean, std = self._mean(prior), self.calibration.factor * prior.std
        self.window_left -= min(self.window_left, 1)
        self._follow(outputs, prior, follow=True)
        self.model.recursion.learn(prior, outputs)
        return mean, std

    def compare(self, sample: Sample, prediction: MemberPrediction) -> bool:
        """Return whether what was known before the last change of the robot predicts better."""
        recursion = self.model.recursion
        if recursion.before is None:
            return False
        if not (seconds := recursion.alternative.elapsed(sample.stamp)):
            return False
        prior = prediction.prior
        then = self.model.predict_by(recursion.before, prior.phi, prediction.columns).mean
        return recursion.alternative.charge(seconds, sample.outputs - prior.mean, sample.outputs - then, prior.std)

    def follow_change(self, directions: Array | None = None) -> None:
        """See :meth:`~semiparam_ros.core.recursion.SemiParametricRecursion.follow_change`.

        A model that does not learn these columns has nothing to follow directions by, and follows any change.

        :param directions: (q, k) of the first q of C.
        """
        recursion = self.model.recursion
        if directions is not None:
            of_effects = recursion.n_columns - len(directions)
            directions = None if self.model.learnt.start else np.pad(directions, ((0, of_effects), (0, 0)))
        recursion.follow_change(directions)

    def go_back(self) -> None:
        """Go on with what was known before the last change, without the offset that followed the other
        model's errors."""
        self.model.recursion.go_back()
        if self.wandering is not None:
            self.wandering.forget()

    def state(self) -> ModelState:
        """Copies of everything that samples have changed; :meth:`restore` takes them back bit for
        bit."""
        wandering = {} if self.wandering is None else self.wandering.state()
        return ModelState(self.model.hyperparameters, self.model.recursion.state(), self.horizon.state(),
                          self.calibration.state(), wandering, self.window_left,
                          (self._since_learnt, self.passed_over))

    def restore(self, state: ModelState) -> None:
        """Return to a saved :meth:`state` of a model with the same hyperparameters.

        Raises SemiparamError when it is that of another one.
        """
        self.model.recursion.restore(state.recursion)
        self.horizon.restore(state.horizon)
        self.calibration.restore(state.calibration)
        if self.wandering is not None:
            self.wandering.restore(state.wandering)
        self.window_left = state.window_left
        self._since_learnt, self.passed_over = state.passed_over


@compiled
def _follow(residual: Vector, std: Vector, wandering: Matrix, calibration: Matrix) -> None:
    """See :meth:`OnlineModel._follow`, of a sample that is learnt."""
    width, innovation = calibration[-1] * std, residual - wandering[-1]
    follow(residual, width, wandering)
    calibrate(innovation, std, calibration)


@compiled
def learn_and_follow(
        root: Root, regression: Regression, prior: Prior, outputs: Vector, wandering: Matrix,
        calibration: Matrix, rows: Matrix, start: int, filled: int, decay: Vector, theta: Vector,
        errors: Matrix, eps: Matrix) -> int:
    """See :meth:`OnlineModel.take_in`, of a sample that is learnt and followed; what :func:`learn`
    gives."""
    update = Update(theta, np.empty((len(outputs), len(theta) + 1)), np.empty(len(prior.phi)))
    placed = learn(root, regression, prior, outputs, update)
    _follow(outputs - prior.mean, prior.std, wandering, calibration)
    paces = len(decay)
    parts = wandering[2 * paces:3 * paces]
    advance(rows, start, filled, decay, prior, outputs, update, parts, errors, eps)
    return placed


_learn_and_follow = direct(learn_and_follow)
