"""The online model of a robot: a single one, or several that learn side by side, averaged by their running evidence.

``variant: auto`` averages variants. What is part of a model is believed only as far as what comes speaks for it (a
spike and slab prior; Mitchell and Beauchamp 1988): random features stand beside the rigid body alone, and the variant
with the declared effects beside the same variant without any.

Dynamic model averaging (Raftery, Karny and Ettler 2010). Every output k weighs the members by itself: w_mk follows the
log density that member m gave to what was measured, forgotten slowly, with Student's t for the densities, so that a
spike decides nothing. The answers meet in a logarithmic pool (see ``opinion_pool``). Each member has its own
hyperparameters from the same initial window, its own wandering offset and bands; those that have the same effects share
their columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from semiparam_ros.core.carry_over import CarryOver
from semiparam_ros.core.columns import ColumnBlock
from semiparam_ros.core.compiled import AVAILABLE, MATRIX, compiled
from semiparam_ros.core.horizon_error import AveragedHorizons, HorizonErrors
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.initial_window import InitialWindow
from semiparam_ros.core.opinion_pool import pool_both, pool_together, pool_weights
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.single_estimator import (
    DesiredOutputs,
    EstimatorState,
    MemberState,
    Model,
    ModelOptions,
    Prediction,
    Seen,
    SingleEstimator,
)
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.core.variants import AVERAGED, MEMBERS, has_both, single
from semiparam_ros.errors import SemiparamError

EVIDENCE_MEMORY = 500.0
"""[samples]"""
_KEEP = 1.0 - 1.0 / EVIDENCE_MEMORY
DEGREES = 5.0
LEAST_LOG_WEIGHT = -6.0
"""The best has 0: who was poor for long still weighs enough to take over within a few samples of a change."""


ELSEWHERE = 2.0
"""Errors on another motion are up to so many times those on a block of the same motion that was left out: on thirteen
pairs of recordings of measured and simulated arms then at most 1 % are beyond three standard deviations."""


class Member(NamedTuple):
    """A model that is averaged with others."""

    variant: str
    has_effects: bool = True
    """Whether it has the effects that are declared."""

    @property
    def name(self) -> str:
        """As told to users."""
        return self.variant if self.has_effects else f'{self.variant} without effects'


def members_of(options: ModelOptions, effects: bool, ready: bool) -> tuple[Member, ...]:
    """What is averaged, the first one first; before the initial window is over, rigid bodies alone.

    :param effects: whether any are declared. :param ready: whether the initial window is over.
    """
    names: tuple[str, ...] = (single(options.variant),)
    if ready and options.variant == AVERAGED:
        names = MEMBERS
    elif ready and options.physical and has_both(options.variant):
        names = (options.variant, 'P')
    return (*(Member(name) for name in names), *[Member(names[0], has_effects=False)][:effects])


def without_features(hyperparameters: Hyperparameters) -> Hyperparameters:
    """Those of the rigid body alone, where only those of a variant with features are given: what features would explain
    is noise to it."""
    sigma = float(np.hypot(hyperparameters.sigma, hyperparameters.rho))
    return replace(hyperparameters, gamma=hyperparameters.gamma or 1.0, rho=0.0, tau=(), sigma=sigma, pi=None,
                   features=0)


class MemberWeights:
    """Log weights (K, n) of K members for n outputs; equal at the start."""

    def __init__(self, n_members: int, n_outputs: int) -> None:
        self._log_weights = np.zeros((n_members, n_outputs))
        self.weights: Array = np.full((n_members, n_outputs), 1.0 / n_members)
        """(K, n), which sum to one over the members."""

    def learn(self, errors: Array, std: Array) -> None:
        """Take in the errors (K, n) of a sample, and the standard deviations (K, n) that were given to it."""
        if AVAILABLE:
            self.weights = np.empty_like(self.weights)
            _weigh(errors, std, self._log_weights, self.weights)
        else:
            self._learn(errors, std)

    def _learn(self, errors: Array, std: Array) -> None:
        ratio = errors / std
        log_weights = _KEEP * self._log_weights - np.log(std)
        log_weights -= 0.5 * (DEGREES + 1.0) * np.log1p(ratio * ratio / DEGREES)
        self._log_weights = np.maximum(log_weights - log_weights.max(axis=0), LEAST_LOG_WEIGHT)
        weights = np.exp(self._log_weights)
        self.weights = weights / weights.sum(axis=0)

    def state(self) -> dict[str, Array]:
        """Copies; :meth:`restore` takes them back bit for bit."""
        return {'log_weights': self._log_weights.copy(), 'shares': self.weights.copy()}

    def restore(self, state: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, for another size."""
        found = [np.array(state.get(name, np.nan), dtype=float) for name in self.state()]
        if any(values.shape != self.weights.shape or not np.isfinite(values).all() for values in found):
            raise SemiparamError(f'the saved weights of the models have shape {found[0].shape}; expected finite '
                                 f'values of shape {self.weights.shape}.')
        self._log_weights, self.weights = found


class Estimator(SingleEstimator):
    """Online semi-parametric model of one robot's outputs.

    The first ``initial_samples`` of motion are answered by the rigid body alone, which starts from the robot
    description's inertias. They then give the hyperparameters, are learnt by the chosen variant, and it takes over.

    Several models learn beside each other (see :func:`members_of`). This is the first of them: its answers are averaged
    with those of the others, and what is asked of a single model (its coefficients, its hyperparameters) is its own.

    :param origin: stamp [ns] from which the time of effects counts, such as the start of a recording; that of the first
        sample unless given. It moves along when the clock jumps, so that time goes on from the last sample.
    :param window: with given hyperparameters, how many samples of the window that they are from come again first. Bands
        are not calibrated meanwhile by samples that are not learnt, as they were not when the window was gathered.
    """

    def __init__(self, body: RigidBody, options: ModelOptions | None = None, effects: Sequence[ColumnBlock] = (),
                 origin: int | None = None, window: int = 0) -> None:
        """Raises SemiparamError when the options or the effects do not fit the robot."""
        super().__init__(body, options, effects, origin, window)
        self._without_effects = self.columns.without_effects()
        self._stand_beside(self.options.others)

    def predict(self, sample: Sample) -> Prediction:
        """Predict the outputs at the sample's inputs; nothing changes. Unknown outputs may be NaN.

        Raises SemiparamError when an input is not finite.
        """
        seen = self._see(sample)
        own = self._answer(seen)
        return self._averaged((own, *self._beside(seen))) if self._others else own

    def _beside(self, seen: Seen) -> list[Prediction]:
        """What the other members say."""
        plain = seen
        if self.columns.effects:
            own = seen.columns[:, :self.columns.n_own] if self.columns.only_add else \
                self._without_effects.one(seen.sample, 0)[0]
            plain = seen._replace(columns=np.ascontiguousarray(own))
        return [other._answer(seen if other.columns.effects else plain) for other in self._others]

    def finish_window(self, draft: bool = False, learn: bool = True) -> None:
        """End the initial window now: estimate hyperparameters from it, learn it, and let the variant take over; where
        several are averaged each has its own. See :meth:`SingleEstimator.finish_window`."""
        members = members_of(self.options, bool(self.columns.effects), ready=True)
        if len(members) == 1:
            return super().finish_window(draft, learn)
        plain = self._window_without_effects()
        others = []
        for member in members[1:]:
            other = SingleEstimator(self.body, replace(self.options, variant=member.variant), self._effects_of(member))
            other.window = self.window if member.has_effects else plain
            other._begin_variant(draft)
            others.append(other)
        self._begin_variant(draft)
        self._others = tuple(others)
        everyone = (self, *others)
        windows = [each.window for each in everyone]
        for each in everyone:
            each._leave_window()
        self._begin_averaging()
        for remembered in zip(*windows, strict=True) if learn else ():
            said = [each._learn_again(its) for each, its in zip(everyone, remembered, strict=True)]
            mean, std = map(np.array, zip(*said, strict=True))
            self._weights.learn(remembered[0].outputs - mean, std)

    def _window_without_effects(self) -> InitialWindow:
        """The window with the columns that it would have without them."""
        if not self.columns.effects:
            return self.window
        n_joints, plain = self.body.n_joints, self._without_effects
        window = InitialWindow(self.window.wanted, 3 * n_joints, self.body.n_outputs, plain.n_columns)
        for inputs, outputs, _ in self.window:
            position, velocity, acceleration = inputs.reshape(3, n_joints)
            sample = Sample(0, position, velocity, acceleration, outputs)
            window.append(sample, plain.one(sample, 0)[0])
        return window

    def with_window_alone(self) -> Estimator:
        """See :meth:`SingleEstimator.with_window_alone`."""
        twin = cast('Estimator', super().with_window_alone())
        twin._stand_beside()
        return twin

    def follow_change(self) -> None:
        """See :meth:`SingleEstimator.follow_change`."""
        super().follow_change()
        self._carried.interrupt()
        for other in self._others:
            other.follow_change()

    def _compare(self, prediction: Prediction) -> None:
        """See :meth:`SingleEstimator._compare`; each member by itself."""
        super()._compare(prediction)
        for other, its in zip(self._others, prediction.members[1:], strict=True):
            returns = other.returns
            other._compare(its)
            if other.returns > returns:
                self.returns += 1
                self.clear_horizons()

    def clear_horizons(self) -> None:
        """See :meth:`SingleEstimator.clear_horizons`."""
        super().clear_horizons()
        self._carried.interrupt()
        for other in self._others:
            other.clear_horizons()
        self._horizons.clear()

    def forget_offset(self) -> None:
        """See :meth:`SingleEstimator.forget_offset`."""
        super().forget_offset()
        for other in self._others:
            other.forget_offset()

    def state(self) -> EstimatorState:
        """See :meth:`SingleEstimator.state`; with the hyperparameters of the other members."""
        carried = self._carried.state()
        if not self._others:
            return super().state()._replace(carried=carried)
        others = []
        for other in self._others:
            learnt = other.state()
            others.append(MemberState(other.model.hyperparameters, learnt.recursion, learnt.horizon,
                                      learnt.calibration, learnt.wandering, learnt.window_left, learnt.passed_over))
        return super().state()._replace(carried=carried, others=tuple(others),
                                        average={**self._weights.state(), **self._horizons.state()})

    def restore(self, state: EstimatorState) -> None:
        """See :meth:`SingleEstimator.restore`; the other members take their hyperparameters from the state."""
        if len(state.others) != len(self._others):
            raise SemiparamError(f'the saved average has {len(state.others)} models beside {self.members[0].name}; '
                                 f'expected {len(self._others)}.')
        super().restore(state)
        if self._others:
            self._restore_others(state)
        models = (self, *self._others)
        self._carried.restore(state.carried, [(len(each.model.theta), each.features_count) for each in models])

    def _restore_others(self, state: EstimatorState) -> None:
        self._stand_beside([other.hyperparameters for other in state.others])
        for other, saved in zip(self._others, state.others, strict=True):
            other._restore_learnt(saved)
        self._weights.restore(state.average or {})
        self._horizons.restore(state.average or {})

    @property
    def others(self) -> tuple[Hyperparameters, ...]:
        """See :attr:`SingleEstimator.others`."""
        return tuple(other.model.hyperparameters for other in self._others)

    @property
    def weights(self) -> dict[str, Array]:
        """See :attr:`SingleEstimator.weights`."""
        if not self._others:
            return {}
        return {member.name: weights for member, weights in zip(self.members, self._weights.weights, strict=True)}

    @property
    def effects_probability(self) -> Array | None:
        """See :attr:`SingleEstimator.effects_probability`."""
        if not self.columns.effects:
            return None
        *having, without = self._weights.weights
        best = np.max(having, axis=0)
        return np.asarray(best / (best + without))

    @property
    def members(self) -> tuple[Member, ...]:
        """What is averaged."""
        return members_of(self.options, bool(self.columns.effects), self.ready)

    @property
    def rigid_body_model(self) -> Model:
        """That of the rigid body alone, with the declared effects, where one is averaged; else the first one's: what
        features explain beside it is not in the coefficients of the first."""
        for member, each in zip(self.members, (self, *self._others), strict=True):
            if member == Member('P'):
                return each.model
        return self.model

    def rigid_body_part(self, prediction: Prediction) -> tuple[Prediction, Model] | None:
        """What the rigid body alone, with the declared effects, says of a sample, and its model; None
        where every model has features, or coefficients that are fixed."""
        model = self.rigid_body_model
        if model.features is not None or model.pi is not None or model.learnt.start:
            return None
        said = prediction.members or (prediction,)
        return next((its for each, its in zip((self, *self._others), said, strict=False) if each.model is model),
                    prediction), model

    def _effects_of(self, member: Member) -> Sequence[ColumnBlock]:
        return self.columns.effects if member.has_effects else ()

    def _stand_beside(self, hyperparameters: Sequence[Hyperparameters] = ()) -> None:
        """Begin the other members, where the initial window is over with given hyperparameters: the first one's unless
        given."""
        mean, scale = ((), ()) if self.input_scaling is None else map(tuple, self.input_scaling)
        members = self.members[1:]
        given: Sequence[Hyperparameters | None] = hyperparameters or [self.options.hyperparameters] * len(members)
        others = []
        for member, each in zip(members, given, strict=True):
            options = replace(self.options, variant=member.variant, others=())
            if self.ready and each is not None:
                if not hyperparameters and options.physical and member.variant == 'P' and self.variant.features:
                    each = without_features(each)
                options = replace(options, hyperparameters=each, input_mean=mean, input_scale=scale,
                                  features_count=each.features or self.options.features_count)
            others.append(SingleEstimator(self.body, options, self._effects_of(member), window=self.window_samples))
        self._others = tuple(others)
        self._begin_averaging()

    def _begin_averaging(self) -> None:
        n_members, n_outputs = len(self.members), self.body.n_outputs
        self._weights = MemberWeights(n_members, n_outputs)
        self._horizons = AveragedHorizons(self.options.horizon, n_outputs, n_members)
        self._carried = CarryOver(n_members, n_outputs)

    def _take_in(self, prediction: Prediction, learn: bool, errors: Array | None = None) -> HorizonErrors | None:
        if not self._others:
            return super()._take_in(prediction, learn, errors)
        own, *beside = prediction.members
        counts = learn or not self._window_left  # as for the bands
        outputs, stamp = prediction.sample.outputs, prediction.sample.stamp
        past = np.zeros((len(prediction.members), self.options.horizon, len(outputs)))
        super()._take_in(own, learn, past[0])
        for other, its, charged in zip(self._others, beside, past[1:], strict=True):
            other._take_in(its, learn, charged)
        std = prediction.member_std
        if prediction.motion.is_news and counts:
            self._weights.learn(outputs - prediction.member_mean, std)
        return self._horizons.advance_average(stamp, past, outputs, self._weights.weights, std)

    def _averaged(self, members: tuple[Prediction, ...]) -> Prediction:
        own = members[0]
        means, deviations = np.array([each.mean for each in members]), np.array([each.std for each in members])
        mean, std, model_mean, covariance = pool_both(
            self._weights.weights, means, deviations, np.array([each.model_mean for each in members]),
            np.array([each.prior.covariance for each in members]))
        prior = own.prior._replace(covariance=covariance)
        return own._replace(mean=mean, std=std, model_mean=model_mean, model_std=np.sqrt(covariance.diagonal()),
                            prior=prior, members=members, member_mean=means, member_std=deviations)

    def _charge_left_out(self, prediction: Prediction) -> None:
        if not (self.ready and prediction.motion.is_news):
            return
        models, stamp = (self, *self._others), prediction.sample.stamp
        if self._carried.next_is_due():
            said = prediction.members or (prediction,)
            self._carried.charge(prediction.sample.outputs,
                                 [its.columns[:, each.model.covered] for each, its in zip(models, said, strict=True)],
                                 [its.prior.features[0] for its in said])
        if self._carried.wants_coefficients(stamp):
            self._carried.begin_block(stamp, [each.coefficients() for each in models])

    def _weights_elsewhere(self, models: Sequence[SingleEstimator]) -> Array:
        """(K, n) by the errors on blocks that were left out. Before the first of these, features are not taken to know
        anything elsewhere: the models without any weigh by their evidence, where there are such."""
        if len(self._carried.squares):
            return self._carried.weights
        without = np.array([each.model.features is None for each in models])
        weights = self._weights.weights * (without | ~without.any())[:, None]
        return np.asarray(weights / weights.sum(axis=0))

    def _desired(self, x: Array, shown: Array, needed: Array) -> DesiredOutputs:
        """Each model with the errors to expect of it on motion that it has not learnt, and weighed by them."""
        plain = shown, needed
        if self.columns.effects:
            position, velocity, acceleration = x.reshape(3, -1)
            plain = self._without_effects.desired(position, velocity, acceleration, now=0, origin=0)
        models = (self, *self._others)
        found = [SingleEstimator._desired(each, x, *((shown, needed) if each.columns.effects else plain))
                 for each in models]
        noise = np.array([each.model.noise_std for each in models])
        beyond = ELSEWHERE**2 * self._carried.expected(noise)**2 - noise**2
        covariances = np.array([each.covariance for each in found])
        covariances += beyond[:, :, None] * np.eye(len(noise[0]))
        weights = self._weights_elsewhere(models)
        means = np.array([each.shown for each in found])
        mean, covariance = pool_together(weights, means, covariances)
        shares = pool_weights(weights, np.sqrt(covariances.diagonal(axis1=1, axis2=2)))
        return DesiredOutputs(mean, (shares * np.array([each.needed for each in found])).sum(axis=0), covariance,
                              float(shares.mean(axis=1) @ [each.variance_ratio for each in found]),
                              self.kept.distance(x))


@compiled(MATRIX, MATRIX, MATRIX, MATRIX)
def _weigh(errors: Array, std: Array, log_weights: Array, weights: Array) -> None:
    """See :meth:`MemberWeights.learn`."""
    members, n = errors.shape
    for k in range(n):
        best = -np.inf
        for m in range(members):
            ratio = errors[m, k] / std[m, k]
            log_weights[m, k] = (_KEEP * log_weights[m, k] - np.log(std[m, k])
                                 - 0.5 * (DEGREES + 1.0) * np.log1p(ratio * ratio / DEGREES))
            best = max(best, log_weights[m, k])
        total = 0.0
        for m in range(members):
            log_weights[m, k] = max(log_weights[m, k] - best, LEAST_LOG_WEIGHT)
            weights[m, k] = np.exp(log_weights[m, k])
            total += weights[m, k]
        for m in range(members):
            weights[m, k] /= total
