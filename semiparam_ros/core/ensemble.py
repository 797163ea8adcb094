"""Several models of one robot that learn side by side, averaged by their running evidence.

Dynamic model averaging (Raftery, Karny and Ettler 2010). Every output k weighs the members by
itself: w_mk follows the log density that member m gave to what was measured, forgotten slowly, with
Student's t for the densities and some density of outliers, so that a spike decides nothing. The
answers meet in a logarithmic pool (see ``opinion_pool``). Each member has its own wandering offset
and bands; those that have the same effects share their columns. One model alone is an ensemble of
one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from semiparam_ros.core.carry_over import CarryOver
from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.compiled import Integers, Matrix, Vector, compiled
from semiparam_ros.core.horizon_error import AveragedHorizons, HorizonErrors
from semiparam_ros.core.initial_window import InitialWindow
from semiparam_ros.core.learnt_inputs import LearntInputs
from semiparam_ros.core.mixture import shares, student, weigh
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.online_model import ModelState, OnlineModel
from semiparam_ros.core.opinion_pool import pool_both, pool_desired
from semiparam_ros.core.prediction import DesiredOutputs, Observed, Prediction
from semiparam_ros.core.types import Array, Indices, Stamps
from semiparam_ros.errors import SemiparamError

EVIDENCE_MEMORY = 500.0
"""[samples]"""
LEAST_LOG_WEIGHT = -6.0
"""The best has 0: who was poor for long still weighs enough to take over within a few samples of a
change."""
OUTLIER_DENSITY = 0.05
"""A sample may be an outlier, as where velocities tell too late that a joint turns back: under every
model it has so much of the density that the best of them gives it."""

OFF_SHARE = 0.1
"""Where nothing moves and all outputs are below this share of what is predicted, the motors are
off behind brakes."""

MARK_NS, MARKS = 500_000_000, 5
"""So often what was learnt is copied, and so many copies are kept: the oldest is from two seconds
ago at least."""
ELSEWHERE = 2.0
"""Errors on another motion are up to so many times those on a block of the same motion that was
left out: on thirteen pairs of recordings of measured and simulated arms then at most 1 % are beyond
three standard deviations."""


class Ensemble:
    """The models, their weights, and what follows all of them together.

    :param columns: of the first model, which has the declared effects; the others have them or
        none.
    """

    def __init__(self, models: Sequence[OnlineModel], columns: CoupledColumns, options: ModelOptions) -> None:
        self.models, self._columns = tuple(models), columns
        self._without_features = np.flatnonzero([each.model.features is None for each in models])
        self.rigid_body_index = int(self._without_features[0]) if len(self._without_features) else 0
        """Of the rigid body alone, with the declared effects; of the first model where there is none."""
        self._without_effects = next((each.columns for each in models if not each.columns.effects), columns)
        n_models, n_outputs = len(self.models), columns.body.n_outputs
        self._log_weights = np.zeros((n_models, n_outputs))
        self.weights: Array = np.full((n_models, n_outputs), 1.0 / n_models)
        """(K, n) of the models, one in sum."""
        self.carried = CarryOver(n_models, n_outputs)
        self._horizons = AveragedHorizons(options.horizon, n_outputs, n_models)
        self._marks: deque[tuple[int, list[dict[str, Array | Indices]]]] = deque(maxlen=MARKS)
        """Stamps [ns], and the state of each model's recursion then."""

    @property
    def first(self) -> OnlineModel:
        """The model of which is asked what only one can say."""
        return self.models[0]

    def predict(self, observed: Observed) -> Prediction:
        """Predict a sample; nothing changes."""
        members = tuple([each.predict(observed, columns)
                         for each, columns in zip(self.models, self._columns_of_each(observed), strict=True)])
        own = members[0]
        if len(members) == 1:
            prior = own.prior
            pooled = own.mean, own.std, prior.mean, prior.covariance
            model_std = prior.std
        else:
            pooled = pool_both(
                self.weights, np.array([each.mean for each in members]),
                np.array([each.std for each in members]), np.array([each.prior.mean for each in members]),
                np.array([each.prior.covariance for each in members]))
            model_std = np.sqrt(pooled[3].diagonal())
        mean, std, model_mean, covariance = pooled
        motion, off = observed.motion, False
        if self.first.ready and motion.stays:
            expected = model_mean + (observed.measured - observed.sample.outputs)
            off = bool(np.abs(observed.measured).max() < OFF_SHARE * np.abs(expected).max())
            motion = motion._replace(is_news=motion.is_news and not off)
        return Prediction(mean, std, model_mean, model_std, self.first.ready, observed.sample, covariance,
                          observed.columns, observed.memory, motion, observed.beyond, observed.begins_step,
                          members, off)

    def _columns_of_each(self, observed: Observed) -> list[Array]:
        """The columns (n, p) of each model; those of the first are known."""
        own = plain = observed.columns
        if self._without_effects is not self._columns:
            plain = own[:, :self._columns.n_own] if self._columns.only_add else \
                self._without_effects.one(observed.sample, 0)[0]
            plain = np.ascontiguousarray(plain)
        return [own if each.columns.effects else plain for each in self.models]

    def take_in(self, prediction: Prediction, learn: bool, follow: bool = False) -> HorizonErrors | None:
        """Charge a predicted sample to the horizon index, and learn it; the horizon it completed.

        :param follow: see :meth:`OnlineModel.take_in`.
        """
        sample, members, outputs = prediction.sample, prediction.members, prediction.sample.outputs
        is_news = prediction.motion.is_news
        if len(members) == 1:
            return self.first.take_in(sample, members[0], learn, is_news, None, follow, prediction.begins_step)
        counts = learn or not self.first.window_left  # as for the bands
        charged = np.zeros((len(members), self._horizons.length, len(outputs)))
        for model, its, errors in zip(self.models, members, charged, strict=True):
            model.take_in(sample, its, learn, is_news, errors, follow, prediction.begins_step)
        std = np.array([its.std for its in members])
        if is_news and counts:
            self._weigh(outputs - np.array([its.mean for its in members]), std)
        return self._horizons.advance(sample.stamp, charged, outputs, self.weights, std)

    def _weigh(self, errors: Array, std: Array) -> None:
        """Weigh the models by the errors (K, n) and the standard deviations (K, n) of a sample."""
        self.weights = weigh_models(self._log_weights, errors, std)

    def learn_windows(self, windows: Sequence[InitialWindow]) -> None:
        """Let each model learn the samples of an initial window, which holds its own columns."""
        for remembered in zip(*windows, strict=True):
            found = [model.learn_again(its) for model, its in zip(self.models, remembered, strict=True)]
            if len(found) > 1:
                mean, std = map(np.array, zip(*found, strict=True))
                self._weigh(remembered[0].outputs - mean, std)

    def charge_left_out(self, prediction: Prediction) -> None:
        """Charge a sample that is learnt to the coefficients of a while ago."""
        stamp, members = prediction.sample.stamp, prediction.members
        if self.carried.next_is_due():
            self.carried.charge(
                prediction.sample.outputs,
                [its.columns[:, each.model.covered] for each, its in zip(self.models, members, strict=True)],
                [its.prior.phi for its in members])
        if self.carried.wants_coefficients(stamp):
            self.carried.begin_block(stamp, [each.coefficients() for each in self.models])

    def compare(self, prediction: Prediction) -> bool:
        """Return whether one of the models predicts better by what was known before the last change of the
        robot."""
        return any([model.compare(prediction.sample, its)
                    for model, its in zip(self.models, prediction.members, strict=True)])

    @property
    def as_before_s(self) -> float:
        """[s] How long one of them does, where the robot is told to have changed; 0 where none does."""
        return max(each.model.recursion.as_before_s for each in self.models)

    def go_back(self) -> None:
        """The robot is as before its last change: see :meth:`OnlineModel.go_back`."""
        for each in self.models:
            each.go_back()
        self.clear_horizons()

    def mark(self, stamp: int, keep: bool) -> None:
        """Copy what was learnt until a stamp [ns], where the last copy is old enough.

        :param keep: False: forget the copies, which no longer are from two seconds ago.
        """
        if not keep:
            self._marks.clear()
        elif not self._marks or not 0 <= stamp - self._marks[-1][0] < MARK_NS:
            self._marks.append((stamp, [each.model.recursion.state() for each in self.models]))

    def take_back(self) -> None:
        """Take back what was learnt since the oldest mark."""
        if self._marks:
            for each, state in zip(self.models, self._marks[0][1], strict=True):
                each.model.recursion.restore(state)
            self.clear_horizons()

    def follow_change(self, directions: Array | None) -> None:
        """The robot has changed: see :meth:`OnlineModel.follow_change`; of what was learnt before, nothing
        is taken back.

        Theta moves by more than what samples have brought to it, from which features of half-finished horizons follow.
        """
        if any(each.model.features is not None for each in self.models):
            self.clear_horizons()
        self.carried.interrupt()
        self._marks.clear()
        for each in self.models:
            each.follow_change(directions)

    def clear_horizons(self) -> None:
        """Forget half-finished horizons, and what the models would go back to."""
        self.carried.interrupt()
        self._marks.clear()
        for each in self.models:
            each.horizon.clear()
        self._horizons.clear()

    def leave_motion(self) -> None:
        """Forget what followed the motion that is over: the wandering offsets, and half of the
        weights, for those of blocks that were left out; the next motion may go on or be another."""
        if len(self.models) > 1:
            weights = 0.5 * (self.weights + self._weights_elsewhere())
            self._log_weights = np.maximum(np.log(weights / weights.max(axis=0)), LEAST_LOG_WEIGHT)
            self.weights = shares(self._log_weights)
        self.forget_offsets()

    def forget_offsets(self) -> None:
        """Let the wandering offsets begin anew."""
        for each in self.models:
            if each.wandering is not None:
                each.wandering.forget()

    def predict_desired(self, x: Array, shown: Array, needed: Array, learnt: LearntInputs) -> DesiredOutputs:
        """Outputs at x (m,): each model with the errors to expect of it on motion that it has not
        learnt, and weighed by them.

        Their disagreement, and how unsure they are, count by what left-out blocks alone say.

        :param shown: (n, p) columns of the first model, of what the sensor shows. :param needed: by
            the arm. :param learnt: inputs that features were learnt at.
        """
        plain = shown, needed
        if self._without_effects is not self._columns:
            position, velocity, acceleration = x.reshape(3, -1)
            plain = self._without_effects.desired(position, velocity, acceleration, now=0, origin=0)
        known = np.array([each.known(x, learnt) for each in self.models])
        found = [each.predict_desired(x, *((shown, needed) if each.columns.effects else plain), share)
                 for each, share in zip(self.models, known.tolist(), strict=True)]
        noise = np.array([each.model.noise_std for each in self.models])
        covariances = np.array([each.covariance for each in found])
        beyond = ELSEWHERE**2 * self.carried.expected(noise)**2 - noise**2
        covariances.reshape(len(found), -1)[:, ::len(noise[0]) + 1] += beyond
        return DesiredOutputs(*pool_desired(
            self._weights_elsewhere(known), self._weights_elsewhere(), np.array([each.shown for each in found]),
            np.array([each.needed for each in found]), covariances, np.array([each.variance_ratio for each in found])))

    def _weights_elsewhere(self, known: Array | None = None) -> Array:
        """(K, n) by the errors on blocks that were left out. Before the first of these, features
        are not taken to know anything elsewhere: the models without any weigh by their evidence,
        where there are such.

        :param known: (K,) of each model at a state; None: all.
        """
        if not len(self.carried.squares):
            chosen = self._without_features if len(self._without_features) else np.arange(len(self.models))
            weights = np.zeros(self.weights.shape)
            weights[chosen] = self.weights[chosen]
            return np.asarray(weights / weights.sum(axis=0))
        if known is None or not len(self._without_features):
            return shares(self.carried.log_weights)
        return weigh_elsewhere(self.carried.log_weights, known, self._without_features)

    def state(self) -> tuple[tuple[ModelState, ...], dict[str, Array | Stamps], dict[str, Array | Stamps]]:
        """Copies of what each model has learnt, of the errors of left-out blocks, and of the
        average; the last is empty for one model."""
        average: dict[str, Array | Stamps] = {}
        if len(self.models) > 1:
            average = {'log_weights': self._log_weights.copy(), 'shares': self.weights.copy(),
                       **self._horizons.state()}
        return tuple(each.state() for each in self.models), self.carried.state(), average

    def restore(self, models: Sequence[ModelState], carried: Mapping[str, Array | Stamps],
                average: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state` of models with the same hyperparameters.

        Raises SemiparamError when it is that of another one.
        """
        self._marks.clear()
        for each, saved in zip(self.models, models, strict=True):
            each.restore(saved)
        if len(self.models) > 1:
            self._restore_weights(average)
            self._horizons.restore(average)
        self.carried.restore(carried, [(len(each.model.theta), each.model.recursion.n_features)
                                       for each in self.models])

    def _restore_weights(self, average: Mapping[str, Array | Stamps]) -> None:
        shape = self.weights.shape
        found = [np.array(average.get(name, np.nan), dtype=float)
                 for name in ('log_weights', 'shares')]
        if any(each.shape != shape or not np.isfinite(each).all() for each in found):
            raise SemiparamError(f'the saved weights of the models have shape {found[0].shape}; '
                                 f'expected finite values of shape {shape}.')
        self._log_weights, self.weights = found


@compiled
def weigh_models(log_weights: Matrix, errors: Matrix, std: Matrix) -> Matrix:
    """(K, n) weights after the errors (K, n) of a sample, and the standard deviations (K, n) that
    were given to it."""
    evidence = np.empty(errors.shape)
    for k in range(errors.shape[1]):
        for m in range(len(errors)):
            evidence[m, k] = student(errors[m, k] / std[m, k]) - np.log(std[m, k])
        best = evidence[:, k].max()
        for m in range(len(errors)):
            evidence[m, k] = np.log(np.exp(evidence[m, k] - best) + OUTLIER_DENSITY)
    return weigh(log_weights, evidence, EVIDENCE_MEMORY, LEAST_LOG_WEIGHT)


@compiled
def weigh_elsewhere(log_weights: Matrix, known: Vector, without: Integers) -> Matrix:
    """(K, n) weights at a state of whose features so much (K,) is known, from log weights (K, n) by left-out blocks.

    A model is as likely beforehand, and by the root of it the errors on blocks are its own; else those of the best
    without features are.

    :param without: numbers of the models without features.
    """
    members, n = log_weights.shape
    likely = known / members
    rest = (1.0 - likely.sum()) / len(without)
    for m in without:
        likely[m] += rest
    found = np.empty((members, n))
    for k in range(n):
        best, most = -np.inf, -np.inf
        for m in without:
            best = max(best, log_weights[m, k])
        for m in range(members):
            alike = np.sqrt(known[m])
            found[m, k] = alike * log_weights[m, k] + (1.0 - alike) * best + np.log(likely[m])
            most = max(most, found[m, k])
        found[:, k] -= most
    return shares(found)
