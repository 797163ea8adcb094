"""Several variants that learn beside one another and are averaged by their running evidence: ``variant: auto``.

Dynamic model averaging (Raftery, Karny and Ettler 2010). Every output k weighs the members' answers by itself:

    mean_k = sum_m w_mk mean_mk,      var_k = sum_m w_mk (std_mk^2 + (mean_mk - mean_k)^2)

the mean and variance of the mixture. The weights follow the log density that each member gave to what was measured,
forgotten slowly, with Student's t for the densities, so that a spike decides nothing. Each member has its own
hyperparameters from the same initial window, its own wandering offset and bands; columns are computed once for all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from semiparam_ros.core.columns import ColumnBlock
from semiparam_ros.core.estimator import (
    DesiredOutputs,
    Estimator,
    EstimatorState,
    MemberState,
    ModelOptions,
    Prediction,
)
from semiparam_ros.core.horizon_error import AveragedHorizons, HorizonErrors
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.core.variants import AVERAGED, MEMBERS
from semiparam_ros.errors import SemiparamError

EVIDENCE_MEMORY = 500.0
"""[samples]"""
_KEEP = 1.0 - 1.0 / EVIDENCE_MEMORY
DEGREES = 5.0
LEAST_LOG_WEIGHT = -6.0
"""The best has 0: who was poor for long still weighs enough to take over within a few samples of a change."""


class VariantWeights:
    """Log weights (K, n) of K variants for n outputs; equal at the start."""

    def __init__(self, n_variants: int, n_outputs: int) -> None:
        self._log_weights = np.zeros((n_variants, n_outputs))
        self.weights: Array = np.full((n_variants, n_outputs), 1.0 / n_variants)
        """(K, n), which sum to one over the variants."""

    def learn(self, errors: Array, std: Array) -> None:
        """Take in the errors (K, n) of a sample, and the standard deviations (K, n) that were given to it."""
        ratio = errors / std
        log_weights = _KEEP * self._log_weights - np.log(std)
        log_weights -= 0.5 * (DEGREES + 1.0) * np.log1p(ratio * ratio / DEGREES)
        log_weights -= log_weights.max(axis=0)
        self._log_weights = np.maximum(log_weights, LEAST_LOG_WEIGHT)
        weights = np.exp(self._log_weights)
        self.weights = weights / weights.sum(axis=0)

    def state(self) -> dict[str, Array]:
        """Copies; :meth:`restore` takes them back bit for bit."""
        return {'log_weights': self._log_weights.copy(), 'shares': self.weights.copy()}

    def restore(self, state: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, for another size."""
        found = [np.array(state.get(name, np.nan), dtype=float) for name in self.state()]
        if any(values.shape != self.weights.shape or not np.isfinite(values).all() for values in found):
            raise SemiparamError(f'the saved weights of the variants have shape {found[0].shape}; expected finite '
                                 f'values of shape {self.weights.shape}.')
        self._log_weights, self.weights = found


class AveragedEstimator(Estimator):
    """The first of ``MEMBERS``, whose answers are averaged with those of the others once the initial window is over.

    What is asked of a single model, its coefficients and its hyperparameters for instance, is that of the first.
    """

    def __init__(self, body: RigidBody, options: ModelOptions, effects: Sequence[ColumnBlock] = (),
                 origin: int | None = None, window: int = 0) -> None:
        """Raises SemiparamError when the options or the effects do not fit the robot."""
        super().__init__(body, options, effects, origin, window)
        self._others: tuple[Estimator, ...] = ()
        if self.ready:
            same = self.options.hyperparameters
            assert same is not None
            self._stand_beside(self.options.others or (same,) * (len(MEMBERS) - 1))
        self._begin_averaging()

    def predict(self, sample: Sample) -> Prediction:
        """See :meth:`Estimator.predict`."""
        seen = self._see(sample)
        own = self._answer(seen)
        if not self._others:
            return own
        return self._averaged((own, *(other._answer(seen) for other in self._others)))

    def finish_window(self, draft: bool = False, learn: bool = True) -> None:
        """See :meth:`Estimator.finish_window`; every member has its own hyperparameters of the same window."""
        others = []
        for name in MEMBERS[1:]:
            other = Estimator(self.body, replace(self.options, variant=name), self.columns.effects)
            other.window = self.window
            other._begin_variant(draft)
            others.append(other)
        self._begin_variant(draft)
        self._others = tuple(others)
        self._begin_averaging()
        for remembered in self.window if learn else ():
            said = np.array([each._learn_again(remembered) for each in self._members])
            self._weights.learn(remembered.outputs - said[:, 0], said[:, 1])
        for each in self._members:
            each._leave_window()

    def follow_change(self) -> None:
        """See :meth:`Estimator.follow_change`."""
        super().follow_change()
        for other in self._others:
            other.follow_change()

    def _compare(self, prediction: Prediction) -> None:
        """See :meth:`Estimator._compare`; each member by itself."""
        super()._compare(prediction)
        for other, its in zip(self._others, prediction.members[1:], strict=True):
            returns = other.returns
            other._compare(its)
            if other.returns > returns:
                self.returns += 1
                self.clear_horizons()

    def clear_horizons(self) -> None:
        """See :meth:`Estimator.clear_horizons`."""
        super().clear_horizons()
        for other in self._others:
            other.clear_horizons()
        self._horizons.clear()

    def state(self) -> EstimatorState:
        """See :meth:`Estimator.state`; with the hyperparameters of the other members."""
        others = []
        for other in self._others:
            learnt = other.state()
            others.append(MemberState(other.model.hyperparameters, learnt.recursion, learnt.horizon,
                                      learnt.calibration, learnt.wandering, learnt.window_left, learnt.passed_over))
        return super().state()._replace(others=tuple(others),
                                        average={**self._weights.state(), **self._horizons.state()})

    def restore(self, state: EstimatorState) -> None:
        """See :meth:`Estimator.restore`; the other members take their hyperparameters from the state."""
        if len(state.others) != (len(MEMBERS) - 1) * self.ready or state.average is None:
            raise SemiparamError(f'the saved average has {len(state.others)} variants beside {MEMBERS[0]}; expected '
                                 f'{(len(MEMBERS) - 1) * self.ready}.')
        super().restore(state)
        self._stand_beside([other.hyperparameters for other in state.others])
        for other, saved in zip(self._others, state.others, strict=True):
            other._restore_learnt(saved)
        self._begin_averaging()
        self._weights.restore(state.average)
        self._horizons.restore(state.average)

    @property
    def others(self) -> tuple[Hyperparameters, ...]:
        """See :attr:`Estimator.others`."""
        return tuple(other.model.hyperparameters for other in self._others)

    @property
    def weights(self) -> dict[str, Array]:
        """See :attr:`Estimator.weights`."""
        return dict(zip(MEMBERS, self._weights.weights, strict=True)) if self._others else {}

    @property
    def _members(self) -> tuple[Estimator, ...]:
        return self, *self._others

    def _stand_beside(self, hyperparameters: Sequence[Hyperparameters]) -> None:
        """Begin the other members with given hyperparameters."""
        mean, scale = ((), ()) if self.input_scaling is None else map(tuple, self.input_scaling)
        self._others = tuple(
            Estimator(self.body, replace(self.options, variant=name, hyperparameters=each, others=(),
                                         features_count=each.features or self.options.features_count,
                                         input_mean=mean, input_scale=scale),
                      self.columns.effects, window=self.window_samples)
            for name, each in zip(MEMBERS[1:], hyperparameters, strict=bool(hyperparameters)))

    def _begin_averaging(self) -> None:
        n_outputs = self.body.n_outputs
        self._weights = VariantWeights(len(MEMBERS), n_outputs)
        self._horizons = AveragedHorizons(self.options.horizon, n_outputs, len(MEMBERS))

    def _take_in(self, prediction: Prediction, learn: bool, errors: Array | None = None) -> HorizonErrors | None:
        if not self._others:
            return super()._take_in(prediction, learn, errors)
        own, *beside = prediction.members
        counts = learn or not self._window_left  # as for the bands
        outputs, stamp = prediction.sample.outputs, prediction.sample.stamp
        past = np.zeros((len(MEMBERS), self.options.horizon, len(outputs)))
        super()._take_in(own, learn, past[0])
        for other, its, charged in zip(self._others, beside, past[1:], strict=True):
            other._take_in(its, learn, charged)
        if prediction.motion.is_news and counts:
            self._weights.learn(outputs - _stacked(prediction.members, 'mean'), _stacked(prediction.members, 'std'))
        return self._horizons.advance_average(stamp, past, outputs, self._weights.weights)

    def _averaged(self, members: tuple[Prediction, ...]) -> Prediction:
        weights, own = self._weights.weights, members[0]
        mean, std = mixture(weights, _stacked(members, 'mean'), _stacked(members, 'std'))
        means = _stacked(members, 'model_mean')
        model_mean = (weights * means).sum(axis=0)
        covariance = mixture_covariance(weights, means, [each.prior.covariance for each in members])
        prior = own.prior._replace(covariance=covariance)
        return own._replace(mean=mean, std=std, model_mean=model_mean, model_std=np.sqrt(covariance.diagonal()),
                            prior=prior, members=members)

    def _desired(self, x: Array, shown: Array, needed: Array) -> DesiredOutputs:
        own = super()._desired(x, shown, needed)
        if not self._others:
            return own
        found = [own, *(other._desired(x, shown, needed) for other in self._others)]
        weights = self._weights.weights
        means = np.array([each.shown for each in found])
        return DesiredOutputs((weights * means).sum(axis=0),
                              (weights * np.array([each.needed for each in found])).sum(axis=0),
                              mixture_covariance(weights, means, [each.covariance for each in found]),
                              float(weights.mean(axis=1) @ [each.variance_ratio for each in found]))


def mixture(weights: Array, means: Array, std: Array) -> tuple[Array, Array]:
    """(n,) mean and standard deviation of a mixture of K; all (K, n)."""
    mean = (weights * means).sum(axis=0)
    return mean, np.sqrt((weights * (std * std + (means - mean) ** 2)).sum(axis=0))


def mixture_covariance(weights: Array, means: Array, covariances: Sequence[Array]) -> Array:
    """(n, n) with the variances of the mixture; between outputs that weigh differently, the geometric mean weighs."""
    roots, mean = np.sqrt(weights), (weights * means).sum(axis=0)
    total = np.zeros_like(covariances[0])
    for root, each, covariance in zip(roots, means, covariances, strict=True):
        apart = root * (each - mean)
        total += covariance * np.multiply.outer(root, root) + np.multiply.outer(apart, apart)
    return total


def estimator_of(body: RigidBody, options: ModelOptions, effects: Sequence[ColumnBlock] = (),
                 origin: int | None = None, window: int = 0) -> Estimator:
    """The estimator that the options ask for; see :class:`Estimator`."""
    kind = AveragedEstimator if options.variant == AVERAGED else Estimator
    return kind(body, options, effects, origin, window)


def _stacked(members: Sequence[Prediction], name: str) -> Array:
    return np.array([getattr(each, name) for each in members])
