"""One model of the outputs: predict a sample, then learn it, for every model class of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from math import isnan, log
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from semiparam_ros.core.band_calibration import BandCalibration, calibrate
from semiparam_ros.core.carry_over import Coefficients
from semiparam_ros.core.columns import ColumnBlock, CoupledColumns, Memories
from semiparam_ros.core.compiled import AVAILABLE, INTEGER, INTEGERS, MATRIX, NUMBER, VECTOR, compiled
from semiparam_ros.core.finite import require_finite
from semiparam_ros.core.horizon_error import HorizonErrors, HorizonIndex, advance
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters, estimate
from semiparam_ros.core.hyperparameters.feature_count import MOST
from semiparam_ros.core.hyperparameters.window import LengthScales, Noise
from semiparam_ros.core.initial_window import InitialWindow, Remembered
from semiparam_ros.core.input_range import beyond, widened
from semiparam_ros.core.learnt_inputs import LearntInputs
from semiparam_ros.core.motion import Motion, at_start
from semiparam_ros.core.random_features import FREQUENCIES, RandomFeatures, input_scaling, spectrum
from semiparam_ros.core.recursion import Prior, SemiParametricRecursion, learn
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import output_scale
from semiparam_ros.core.samples import NO_TEMPERATURE, Sample
from semiparam_ros.core.stamps import LONGEST_PAUSE_NS, NANOSECONDS
from semiparam_ros.core.types import Array, Indices, Stamps
from semiparam_ros.core.variants import VARIANTS, Variant, variant_named
from semiparam_ros.core.wandering_offset import DECAY, WanderingOffset, follow
from semiparam_ros.errors import SemiparamError

HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)
AUTO = 'auto'
"""Forgetting: the model forgets nothing, and what it leaves is followed at the pace that is seen. Number of features:
as few as the initial window asks for."""

EFFECT_GAMMA = 1.0
"""Standard deviation of effects over their prior scale, in the variants that have no gamma."""

PRIORS = ('physical', 'paper')
"""``physical``: theta is near the robot description, as far as the robot is large; features explain no more than the
rigid body leaves, and may not be there at all. ``paper``: theta has one variance about zero, and nothing else is held.
"""

OFF_SHARE = 0.1
"""Where nothing moves and all outputs are below this share of what is predicted, the motors are off behind brakes."""

PROVISIONAL_GAMMA, PROVISIONAL_SIGMA = 0.3, 0.1
"""Of the model before the first window is over, with the paper's priors. With physical ones gamma is 1, and the noise
is so large a share of what an output may be beside the described body (``robot.size.output_scale``)."""

COMPARED_EVERY_NS, LONGEST_COMPARED_NS = NANOSECONDS // 100, NANOSECONDS // 10
"""A model is compared with the one from before the last change no more often, and a pause counts for no more."""


class Model:
    """One variant with its hyperparameters: features, a fixed mean where pi is fixed, the recursion.

    Of the columns of C, those of the rigid body and the offset are learnt, fixed or absent, as the variant has it;
    those of effects, which stand last, are learnt in every variant.

    :param prior_scale: (p,) prior standard deviations of theta over gamma. :param prior_mean: (p,), zero unless given.
    :param n_effects: how many of the columns are effects'.
    """

    def __init__(self, variant: Variant, hyperparameters: Hyperparameters, features: RandomFeatures | None,
                 prior_scale: Array, prior_mean: Array | None = None, forgetting: float = 1.0,
                 n_effects: int = 0) -> None:
        self.variant, self.hyperparameters, self.features = variant, hyperparameters, features
        self.n_effects = n_effects
        own, everything = len(prior_scale) - n_effects, len(prior_scale)
        learnt = variant.pi == 'learnt'
        self.gamma = hyperparameters.gamma if learnt else EFFECT_GAMMA
        self.learnt = slice(0 if learnt else own, everything)
        """Columns of C that the recursion learns."""
        self.covered = slice(own if variant.pi == 'absent' else 0, everything)
        """Columns of C that ``theta`` has coefficients for."""
        self.pi = np.asarray(hyperparameters.pi, dtype=float) if variant.pi == 'fixed' else None
        self.recursion = SemiParametricRecursion(
            len(hyperparameters.output_scale), features.count if features else 0,
            self.gamma * prior_scale[self.learnt], hyperparameters.rho, hyperparameters.sigma,
            None if prior_mean is None else prior_mean[self.learnt], forgetting,
            np.array(hyperparameters.output_scale))
        self._no_features = np.zeros(0)

    @property
    def theta(self) -> Array:
        """Coefficients, learnt or fixed, of the ``covered`` columns: of all, or of the effects where pi is absent."""
        return self.recursion.theta if self.pi is None else np.concatenate([self.pi, self.recursion.theta])

    def theta_std(self) -> Array:
        """Their posterior standard deviations; zero where pi is fixed."""
        std = np.zeros(len(self.theta))
        if self.recursion.n_columns:
            std[-self.recursion.n_columns:] = np.sqrt(np.diag(self.recursion.theta_covariance()))
        return std

    def part(self, block: slice) -> Array:
        """Coefficients of a block of columns; empty where the model has none for it."""
        start = self.covered.start
        return self.theta[block.start - start:block.stop - start] if block.start >= start else np.zeros(0)

    @property
    def noise_std(self) -> Array:
        """(n,) standard deviation of each output's noise, in N and N m."""
        return self.recursion.sigma * self.recursion.scale

    def predict(self, x: Array, columns: Array) -> Prior:
        """What the recursion says at x (m,), of which the columns (n, p) are all of C."""
        return self.predict_by(self.recursion, self.features(x) if self.features else self._no_features, columns)

    def predict_by(self, recursion: SemiParametricRecursion, phi: Array, columns: Array) -> Prior:
        """What a recursion of this variant says with features phi (D,)."""
        known = None if self.pi is None else columns[:, :len(self.pi)] @ self.pi
        learnt = columns[:, self.learnt] if self.learnt.start else columns
        return recursion.predict(phi, learnt, known)


def log_density(innovation: Array, covariance: Array) -> float:
    """Log of N(innovation; 0, covariance), for (n,) and (n, n) [nat]."""
    lower, _ = dpotrf(covariance, lower=1)
    white, _ = dtrtrs(lower, innovation, lower=1)
    return float(-0.5 * white @ white - np.log(lower.diagonal()).sum() - len(white) * HALF_LOG_2PI)


def information_gain(prior: Prior, noise_std: Array) -> float:
    """What learning a sample can tell of the model at most [nat]: the log of predictive over noise deviation (n,),
    summed over the outputs, whose correlation is left out."""
    return sum(map(log, (prior.std / noise_std).tolist()))


@dataclass(frozen=True)
class ModelOptions:
    """What a user chooses of the model; see docs/parameters.md. ``hyperparameters`` None: from the initial window."""

    variant: str = 'SPK-ML'
    features_count: int | str = 200
    features_seed: int = 0
    features_frequencies: str = FREQUENCIES[0]
    length_scales: LengthScales = 'kind'
    noise: Noise = 'output'
    initial_samples: int = 1000
    horizon: int = 25
    forgetting: float | str = AUTO
    learn_every: int = 1
    learn_least_gain: float = 0.0
    hyperparameters: Hyperparameters | None = None
    input_mean: tuple[float, ...] = ()
    input_scale: tuple[float, ...] = ()
    joint_friction: bool = True
    """Whether friction and offset of every joint are part of the rigid body's model, with joint efforts."""
    priors: str = 'physical'
    """What is held of the model before anything is measured: see :data:`PRIORS`."""
    others: tuple[Hyperparameters, ...] = ()
    """With given hyperparameters: those of the variants averaged with the first one; none: they have the same."""

    @property
    def physical(self) -> bool:
        """Whether the priors are."""
        return self.priors == 'physical'

    @property
    def most_features(self) -> int:
        """Features that hyperparameters are estimated with; ``auto`` then chooses of them."""
        return self.features_count if isinstance(self.features_count, int) else MOST


NO_MEMBERS: Array = np.zeros((0, 0))


class Prediction(NamedTuple):
    """What the model said of one sample before learning it, in N, N m."""

    mean: Array  # (n,)
    std: Array  # (n,) predictive, noise included, calibrated
    model_mean: Array  # (n,) of the model alone, without the wandering offset
    model_std: Array  # (n,) of the model alone, not calibrated: what a gate or a detector of changes compares with
    ready: bool  # the initial window is over
    sample: Sample
    prior: Prior
    columns: Array  # (n, p) all of C
    memory: Memories
    motion: Motion
    beyond: float
    """How far the inputs lie outside of those learnt, see :func:`~semiparam_ros.core.input_range.beyond`."""
    members: tuple[Prediction, ...] = ()
    """Of the variants that it is the average of, where it is one."""
    member_mean: Array = NO_MEMBERS  # (K, n) theirs
    member_std: Array = NO_MEMBERS  # (K, n)
    off: bool = False
    """Whether the motors are off behind brakes: nothing moves, and all outputs are far smaller than predicted."""
    horizon: HorizonErrors | None = None
    """The one that it completed, once it is learnt."""

    @property
    def log_density(self) -> float:
        """Of the measured outputs, by mean and std as published [nat]; NaN outputs give NaN."""
        factor = self.std / self.model_std
        innovation = (self.sample.outputs - self.mean) / factor
        return log_density(innovation, self.prior.covariance) - float(np.log(factor).sum())


class DesiredOutputs(NamedTuple):
    """What a desired motion brings about, (n,) each, in N and N m."""

    shown: Array  # by the sensor
    needed: Array  # by the arm: without the sensor's offset and effects
    covariance: Array  # (n, n) of what is shown, noise included
    variance_ratio: float  # largest variance of the model itself over that of the noise, over the outputs
    distance: float = 0.0
    """From the inputs learnt, over the largest of these: see :mod:`semiparam_ros.core.learnt_inputs`."""


class MemberState(NamedTuple):
    """What an averaged variant has learnt, with its hyperparameters."""

    hyperparameters: Hyperparameters
    recursion: Mapping[str, Array | Indices]
    horizon: Mapping[str, Array | Stamps]
    calibration: dict[str, Array]
    wandering: dict[str, Array]
    window_left: int  # samples
    passed_over: tuple[int, int]  # samples passed over since the last one learnt, and altogether


class EstimatorState(NamedTuple):
    """What an estimator has learnt and what it remembers, beside its options and hyperparameters."""

    recursion: Mapping[str, Array | Indices]
    horizon: Mapping[str, Array | Stamps]
    calibration: dict[str, Array]
    wandering: dict[str, Array]  # empty where the forgetting is a number
    window_left: int  # samples
    passed_over: tuple[int, int]  # samples passed over since the last one learnt, and altogether
    window: Mapping[str, Array | Stamps]
    origin: int | None  # [ns]
    newest: int | None  # [ns] stamp of the last sample
    memory: Memories
    inputs_learnt: Array
    temperature: Array  # [deg C] of the last sample
    motion: Motion | None
    kept: Mapping[str, Array | Stamps]
    """Of the inputs learnt."""
    carried: Mapping[str, Array | Stamps]
    """Errors of left-out blocks."""
    others: tuple[MemberState, ...] = ()  # the variants averaged with it
    average: Mapping[str, Array | Stamps] | None = None  # their weights, and the horizons of the average


class Seen(NamedTuple):
    """A sample as every variant sees it."""

    sample: Sample
    x: Array  # (m,)
    columns: Array  # (n, p)
    memory: Memories
    motion: Motion
    beyond: float


class SingleEstimator:
    """One model of one robot's outputs: a variant, which has all effects that are declared.

    See :class:`~semiparam_ros.core.estimator.Estimator` for its life and its parameters.
    """

    def __init__(self, body: RigidBody, options: ModelOptions | None = None, effects: Sequence[ColumnBlock] = (),
                 origin: int | None = None, window: int = 0) -> None:
        """Raises SemiparamError when the options or the effects do not fit the robot."""
        self.options = options or ModelOptions()
        self.variant = variant_named(self.options.variant)
        self.columns = CoupledColumns(body, effects, self.options.joint_friction, self.options.physical)
        self.body = body
        self.window = self.new_window()
        self.motion: Motion | None = None
        self.input_scaling: tuple[Array, Array] | None = None
        self.origin = origin
        self._newest: int | None = None
        self._temperature = NO_TEMPERATURE
        """Of the newest sample: a desired state is as warm."""
        self._memory: Memories = None
        self.kept = LearntInputs(3 * body.n_joints)
        self.inputs_learnt: Array = np.zeros((0, 3 * body.n_joints))
        """See :mod:`semiparam_ros.core.input_range`."""
        given = self.options.hyperparameters
        self.ready = given is not None
        self.model = self._provisional() if given is None else self._given(given)
        self.window_samples = self._window_left = window
        self._since_learnt = 0
        self.returns = 0
        """How often the robot was again as before its last change."""
        self.passed_over = 0
        """Samples that were to be learnt but were not, by ``learn_every`` and ``learn_least_gain``."""
        self._begin_following()

    def step(self, sample: Sample, learn: bool = True) -> Prediction:
        """Predict the sample, then learn it (unless told not to, or the robot is at rest)."""
        prediction = self.predict(sample)
        return Prediction(*prediction[:-1], self.observe(prediction, learn and prediction.motion.is_news))

    def predict(self, sample: Sample) -> Prediction:
        """Predict the outputs at the sample's inputs; nothing changes. Unknown outputs may be NaN.

        Raises SemiparamError when an input is not finite.
        """
        return self._answer(self._see(sample))

    def _see(self, sample: Sample) -> Seen:
        x, outside = beyond(self.inputs_learnt, sample)
        if isnan(outside):
            require_finite('positions, velocities and accelerations', x)
        memory = None if self._has_jumped(sample.stamp) else self._memory
        columns, memory = self.columns.one(sample, self._origin_at(sample.stamp), memory)
        if self.columns.effects:
            require_finite('columns of the effects', columns)
        position = x[:self.body.n_joints]
        motion = self.motion.after(sample.stamp, position, sample.outputs) if self.motion else \
            at_start(sample.stamp, position, sample.outputs)
        return Seen(sample, x, columns, memory, motion, outside)

    def _answer(self, seen: Seen) -> Prediction:
        prior = self.model.predict(seen.x, seen.columns)
        mean = prior.mean if self.wandering is None else prior.mean + self.offset
        motion, off = seen.motion, False
        if self.ready and motion.still > 1:
            off = bool(np.abs(seen.sample.outputs).max() < OFF_SHARE * np.abs(prior.mean).max())
            motion = motion._replace(is_news=motion.is_news and not off)
        return Prediction(mean, self.calibration.factor * prior.std, prior.mean, prior.std, self.ready,
                          seen.sample, prior, seen.columns, seen.memory, motion, seen.beyond, off=off)

    @property
    def offset(self) -> Array:
        """(n,) the wandering offset; zeros where there is none."""
        if self.wandering is None:
            return np.zeros(self.body.n_outputs)
        return self.wandering.offset

    def holds(self, effect: ColumnBlock) -> bool:
        """Whether an effect acts at the newest sample, by its start and its end."""
        span = getattr(effect, 'span', None)
        now = self.origin if self._newest is None else self._newest
        return span is None or now is None or bool(span.holds(now, self.origin or 0))

    def predict_desired(self, position: Array, velocity: Array, acceleration: Array) -> DesiredOutputs:
        """Outputs of a desired state (n_joints,) as of the newest sample; nothing changes.

        A desired state is exact and has no past, so its stamp does not matter: see :meth:`CoupledColumns.desired`.
        Raises SemiparamError when a value, or what follows from it, is not finite.
        """
        x = np.concatenate([position, velocity, acceleration])
        require_finite('desired positions, velocities and accelerations', x)
        origin = self.origin or 0
        now = origin if self._newest is None else self._newest
        shown, needed = self.columns.desired(position, velocity, acceleration, now, origin, self._temperature)
        found = self._desired(x, shown, needed)
        require_finite('predicted outputs of a desired state',
                       np.concatenate([found.shown, found.covariance.diagonal()]))
        return found

    def _desired(self, x: Array, shown: Array, needed: Array) -> DesiredOutputs:
        """Without the wandering offset, which is that of the last moments' motion."""
        model = self.model
        prior = model.predict(x, shown)
        of_sensor = (shown - needed)[:, model.covered] @ model.theta
        ratio = float((prior.std / model.noise_std).max()) ** 2 - 1.0
        return DesiredOutputs(prior.mean, prior.mean - of_sensor, prior.covariance, ratio)

    def coefficients(self) -> Coefficients:
        """Of the model as it stands."""
        alpha = self.model.recursion.weights() if self.model.features else np.zeros((self.body.n_outputs, 0))
        return Coefficients(self.model.theta.copy(), alpha)

    def observe(self, prediction: Prediction, learn: bool = True, finish: bool = True) -> HorizonErrors | None:
        """Charge a predicted sample to the horizon index, and learn it; the horizon it completed.

        :param learn: let the model learn it, unless ``learn_every`` or ``learn_least_gain`` passes over it; the bands
            and the wandering offset follow all the same.
        :param finish: end the initial window with the sample that makes it full; else the rigid body goes on, until
            :meth:`finish_window` is called.

        Every other prediction made before is then stale. Raises SemiparamError, with nothing changed, when this one is,
        or when the measured outputs are not finite.
        """
        sample = prediction.sample
        self.model.recursion.require_current(prediction.prior)
        require_finite('outputs', sample.outputs)
        self._go_on_from(prediction)
        if learn and (prediction.beyond or not len(self.inputs_learnt)):
            self.inputs_learnt = widened(self.inputs_learnt, sample.inputs)
        complete = self._take_in(prediction, learn)
        if learn:
            self.kept.add(sample)
            self._charge_left_out(prediction)
        self._compare(prediction)
        if learn and not self.ready and not self.window.full:
            self.window.append(sample, prediction.columns)
        if finish and self.window_full:
            self.finish_window()
        return complete

    def _charge_left_out(self, prediction: Prediction) -> None:
        """Charge a sample that is learnt to the coefficients of a while ago."""

    def follow_change(self) -> None:
        """The robot has changed: see :meth:`~semiparam_ros.core.recursion.SemiParametricRecursion.follow_change`."""
        self.model.recursion.follow_change()

    def _compare(self, prediction: Prediction) -> None:
        """Go on from what was known before the last change of the robot, if that predicts the last seconds better."""
        recursion = self.model.recursion
        if recursion.before is None or not prediction.motion.is_news:
            return
        stamp, outputs = prediction.sample.stamp, prediction.sample.outputs
        since = stamp - recursion.compared_at
        if 0 <= since < COMPARED_EVERY_NS:
            return
        recursion.compared_at = stamp
        then = self.model.predict_by(recursion.before, prediction.prior.features[0], prediction.columns).mean
        seconds = min(max(since, 0), LONGEST_COMPARED_NS) / NANOSECONDS
        if recursion.compare(seconds, outputs - prediction.prior.mean, outputs - then):
            self.returns += 1
            self.clear_horizons()

    def gather(self, sample: Sample, learn: bool = True) -> None:
        """Take a sample into the initial window alone: the rigid body neither answers nor learns it.

        :param learn: False: it only goes by.
        """
        seen = self._see(sample)
        self._go_on_from(seen)
        if learn:
            self.window.append(sample, seen.columns)

    def _go_on_from(self, seen: Seen | Prediction) -> None:
        stamp = seen.sample.stamp
        self.origin, self._newest = self._origin_at(stamp), stamp
        self._memory, self.motion, self._temperature = seen.memory, seen.motion, seen.sample.temperature

    def _take_in(self, prediction: Prediction, learn: bool, errors: Array | None = None) -> HorizonErrors | None:
        """What a sample changes of what is learnt. :param errors: see :meth:`HorizonIndex.advance`."""
        sample, prior, recursion = prediction.sample, prediction.prior, self.model.recursion
        outputs = np.ascontiguousarray(sample.outputs, dtype=float)
        due = learn and self._is_due(prior)
        if AVAILABLE and due and prediction.motion.is_news and self.wandering is not None:
            self._window_left -= min(self._window_left, 1)
            self.horizon.make_room()
            eps = np.empty((2, len(outputs)))
            recursion.has_learnt(_learn_and_follow(
                *recursion.learning(prior), *self.horizon.advancing, outputs, prior.mean, prior.std,
                self.wandering.table, self.calibration.table, self.horizon.nothing if errors is None else errors, eps))
            return self.horizon.moved_on(sample.stamp, eps)
        innovations = recursion.learn(prior, outputs) if due else None
        if not due:
            recursion.revise()  # what effects remember has changed, and so have the pending horizons
        if prediction.motion.is_news:  # at rest nothing tells how wide the bands of motion are
            self._follow(outputs, prior, learn)
        parts = None if self.wandering is None else self.wandering.parts
        return self.horizon.advance(sample.stamp, prior, outputs, recursion.theta, innovations, parts, errors)

    def _is_due(self, prior: Prior) -> bool:
        """Whether a sample that is to be learnt is the next of so many, and tells enough; the initial window is whole.

        Never by its outputs: to learn the surprising ones alone would bias the model.
        """
        options = self.options
        if not self.ready or self._window_left:
            return True
        self._since_learnt += 1
        if self._since_learnt < options.learn_every or (
                options.learn_least_gain and information_gain(prior, self.model.noise_std)
                < options.learn_least_gain):
            self.passed_over += 1
            return False
        self._since_learnt = 0
        return True

    @property
    def window_full(self) -> bool:
        """Whether the initial window holds enough, and :meth:`finish_window` has not been called yet."""
        return not self.ready and self.window.full

    def new_window(self) -> InitialWindow:
        """An empty one, as at the start."""
        return InitialWindow(self.options.initial_samples, 3 * self.body.n_joints, self.body.n_outputs,
                             self.columns.n_columns)

    def discard_window(self) -> None:
        """Gather another initial window, as one that gave no hyperparameters is no good; what P has learnt stays."""
        self.window, self.motion = self.new_window(), None

    def with_window_alone(self) -> SingleEstimator:
        """A copy without what the rigid body has learnt so far: its window can be finished while this one goes on."""
        twin = copy(self)
        twin.kept = deepcopy(self.kept)
        twin.model = twin._provisional()
        twin._begin_following()
        return twin

    def finish_window(self, draft: bool = False, learn: bool = True) -> None:
        """End the initial window now: estimate hyperparameters from it, learn it, and let the variant take over.

        :param draft: estimate from a few hundred of its samples and two starts, in about a tenth of the time.
        :param learn: False: the hyperparameters are all that is wanted of it.

        Raises SemiparamError, with nothing changed, when the window holds too little to estimate from.
        """
        self._begin_variant(draft)
        for remembered in self.window if learn else ():
            self._learn_again(remembered)
        self._leave_window()

    def _begin_variant(self, draft: bool) -> None:
        """Estimate the hyperparameters from the window, and begin the variant that has them."""
        window = self.window
        if not len(window):
            raise SemiparamError('the initial window holds no samples yet: none were learnt while the robot moved.')
        scaling = input_scaling(window.inputs)
        hyperparameters = self._estimate(window, scaling, draft)
        self.input_scaling = scaling
        self.model = self._build(hyperparameters)
        self._begin_following()

    def _learn_again(self, remembered: Remembered) -> tuple[Array, Array]:
        """Learn a sample of the window; mean and standard deviation (n,) that were predicted for it, in N and N m."""
        model, (inputs, outputs, columns) = self.model, remembered
        prior = model.predict(inputs, columns)
        mean = prior.mean if self.wandering is None else prior.mean + self.offset
        said = mean, self.calibration.factor * prior.std
        self._follow(outputs, prior, learn=True)
        model.recursion.learn(prior, outputs)
        return said

    def _leave_window(self) -> None:
        self.window_samples, self.ready, self.window = len(self.window), True, self.new_window()

    def clear_pending(self) -> None:
        """Forget half-finished horizons and what effects remember, as after a jump of the clock; keep the model."""
        self.clear_horizons()
        self._memory = None
        self.motion = self.motion.interrupted() if self.motion else None
        self.model.recursion.revise()

    def clear_horizons(self) -> None:
        """Forget half-finished horizons alone."""
        self.horizon.clear()

    def begin_recording(self, origin: int) -> None:
        """Go on with another recording, whose time starts at ``origin`` [ns]; what is learnt stays."""
        self.clear_pending()
        self.forget_offset()
        self.origin, self._newest, self.motion = origin, None, None

    def forget_offset(self) -> None:
        """Begin the wandering offset at zero again."""
        if self.wandering is not None:
            self.wandering.forget()

    def state(self) -> EstimatorState:
        """Copies of everything that samples have changed; :meth:`restore` takes them back bit for bit."""
        wandering = {} if self.wandering is None else self.wandering.state()
        return EstimatorState(self.model.recursion.state(), self.horizon.state(), self.calibration.state(), wandering,
                              self._window_left, (self._since_learnt, self.passed_over), self.window.state(),
                              self.origin, self._newest, self._memory, self.inputs_learnt, self._temperature,
                              self.motion, self.kept.state(), {})

    def restore(self, state: EstimatorState) -> None:
        """Return to a saved :meth:`state` of an estimator with the same options, effects and hyperparameters.

        Predictions made before are then stale. Raises SemiparamError when it is that of another one.
        """
        self._restore_learnt(state)
        self.window = self.new_window()
        self.window.restore(state.window)
        self._memory, self.motion = state.memory, state.motion
        self.origin, self._newest = state.origin, state.newest
        self.inputs_learnt, self._temperature = state.inputs_learnt, state.temperature
        self.kept.restore(state.kept)

    def _restore_learnt(self, state: EstimatorState | MemberState) -> None:
        self.model.recursion.restore(state.recursion)
        self.horizon.restore(state.horizon)
        self.calibration.restore(state.calibration)
        if self.wandering is not None:
            self.wandering.restore(state.wandering)
        self._window_left = state.window_left
        self._since_learnt, self.passed_over = state.passed_over

    @property
    def others(self) -> tuple[Hyperparameters, ...]:
        """Those of the variants averaged with this one."""
        return ()

    @property
    def weights(self) -> dict[str, Array]:
        """(n,) weights of each output, of the variants that the answers are an average of; empty for a single one."""
        return {}

    @property
    def effects_probability(self) -> Array | None:
        """(n,) how likely the declared effects are, by what each output shows; None where that is not asked."""
        return None

    @property
    def features_count(self) -> int:
        """Number D of random features in use; 0 where the model has none."""
        return self.model.features.count if self.model.features else 0

    def hyperparameters(self) -> Hyperparameters:
        """Those in use, with pi as it stands."""
        pi = tuple(self.model.part(slice(0, self.columns.n_own)).tolist())
        return replace(self.model.hyperparameters, pi=pi or None)

    def _has_jumped(self, stamp: int) -> bool:
        return self._newest is not None and not 0 <= stamp - self._newest <= LONGEST_PAUSE_NS

    def _origin_at(self, stamp: int) -> int:
        """Where time counts from at a stamp: the origin, moved by what the clock jumped."""
        if self.origin is None:
            return stamp
        since = stamp - (self.origin if self._newest is None else self._newest)
        if 0 <= since <= LONGEST_PAUSE_NS:
            return self.origin
        return stamp - LONGEST_PAUSE_NS if self._newest is None else self.origin + since

    def _estimate(self, window: InitialWindow, scaling: tuple[Array, Array], draft: bool) -> Hyperparameters:
        options, inputs = self.options, (window.inputs - scaling[0]) / scaling[1]
        omega = spectrum(inputs.shape[1], options.most_features, options.features_seed, options.features_frequencies)
        return estimate(options.variant, window.outputs, window.columns, inputs, omega,
                        length_scales=options.length_scales, noise=options.noise,
                        prior_scale=self.columns.prior_scale, n_effects=self.columns.n_effects,
                        fewest=options.features_count == AUTO, draft=draft, prior_mean=self.columns.expected,
                        physical=options.physical)

    def _given(self, hyperparameters: Hyperparameters) -> Model:
        options, size = self.options, 3 * self.body.n_joints
        mean, scale = np.array(options.input_mean), np.array(options.input_scale)
        if self.variant.features and not len(mean) == len(scale) == size:
            raise SemiparamError(f'hyperparameters.input_mean and .input_scale hold {len(mean)} and {len(scale)} '
                                 f'values; expected {size}, three for each joint.')
        if self.variant.features and options.features_count == AUTO and not hyperparameters.features:
            raise SemiparamError('features.count is auto, but hyperparameters are given; expected the number of '
                                 'features that they were estimated with.')
        if self.variant.pi == 'fixed' and len(hyperparameters.pi or ()) != self.columns.n_own:
            raise SemiparamError(f'hyperparameters.pi holds {len(hyperparameters.pi or ())} values; expected '
                                 f'{self.columns.n_own} for {options.variant}: base parameters and offset.')
        if len(hyperparameters.output_scale) != self.body.n_outputs:
            raise SemiparamError(f'hyperparameters.output_scale holds {len(hyperparameters.output_scale)} values; '
                                 f'expected {self.body.n_outputs}.')
        self.input_scaling = (mean, scale)
        return self._build(hyperparameters)

    def _build(self, hyperparameters: Hyperparameters) -> Model:
        assert self.input_scaling is not None
        features, count = None, 0
        if self.variant.features:
            chosen = self.options.features_count
            count = chosen if isinstance(chosen, int) else hyperparameters.features
            features = RandomFeatures(3 * self.body.n_joints, count, self.options.features_seed, hyperparameters.tau,
                                      *self.input_scaling, self.options.features_frequencies)
        hyperparameters = replace(hyperparameters, features=count)  # given ones do not know it, and are handed on
        given = self.options.forgetting
        return Model(self.variant, hyperparameters, features, self.columns.prior_scale, self.columns.expected,
                     forgetting=given if isinstance(given, float) else 1.0, n_effects=self.columns.n_effects)

    def _provisional(self) -> Model:
        gamma, scale = PROVISIONAL_GAMMA, np.ones(self.body.n_outputs)
        if self.options.physical:
            gamma, scale = 1.0, output_scale(self.body)
        hyperparameters = Hyperparameters(gamma=gamma, rho=1.0, tau=(1.0,), sigma=PROVISIONAL_SIGMA,
                                          output_scale=tuple(scale.tolist()), pi=None)
        return Model(VARIANTS['P'], hyperparameters, None, self.columns.prior_scale, self.columns.prior_mean,
                     n_effects=self.columns.n_effects)

    def _begin_following(self) -> None:
        """What follows the model's errors starts anew with each model."""
        recursion, n_outputs = self.model.recursion, self.body.n_outputs
        self.calibration = BandCalibration(n_outputs)
        self.wandering = WanderingOffset(n_outputs) if self.options.forgetting == AUTO else None
        self.horizon = HorizonIndex(self.options.horizon, n_outputs, recursion.n_features, recursion.n_columns,
                                    None if self.wandering is None else DECAY)

    def _follow(self, outputs: Array, prior: Prior, learn: bool) -> None:
        """Let wandering offset and bands follow what ``prior`` left of a sample (n,), in N and N m."""
        self._window_left -= min(self._window_left, learn)
        if AVAILABLE and learn and self.wandering is not None:
            _follow(outputs, prior.mean, prior.std, self.wandering.table, self.calibration.table)
            return
        residual = outputs - prior.mean
        innovation = residual - self.offset
        if self.wandering is not None and learn:
            self.wandering.learn(residual, self.calibration.factor * prior.std)
        elif self.wandering is not None:
            self.wandering.rest()
        if learn or not self._window_left:
            self.calibration.learn(innovation, prior.std)


@compiled(VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, calls=(follow, calibrate))
def _follow(outputs: Array, mean: Array, std: Array, wandering: Array, calibration: Array) -> None:
    """See :meth:`SingleEstimator._follow`, of a sample that is learnt."""
    residual, width, innovation = np.empty_like(mean), np.empty_like(mean), np.empty_like(mean)
    for k in range(len(mean)):
        residual[k], width[k] = outputs[k] - mean[k], calibration[-1, k] * std[k]
        innovation[k] = residual[k] - wandering[-1, k]
    follow(residual, width, wandering)
    calibrate(innovation, std, calibration)


@compiled(MATRIX, NUMBER, MATRIX, MATRIX, VECTOR, NUMBER, MATRIX, VECTOR, MATRIX, MATRIX, INTEGER, NUMBER, INTEGERS,
          INTEGER, MATRIX, INTEGER, INTEGER, MATRIX, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX,
          returns=INTEGER, calls=(learn, follow, calibrate, advance))
def _learn_and_follow(
        features: Array, s: float, columns: Array, regressed: Array, scale: Array, sigma: float, information: Array,
        theta: Array, left_changes: Array, right_changes: Array, waiting: int, inflation: float, places: Indices,
        placed: int, rows: Array, start: int, filled: int, decay: Array, outputs: Array, mean: Array, std: Array,
        wandering: Array, calibration: Array, errors: Array, eps: Array) -> int:
    """See :meth:`SingleEstimator._take_in`, of a sample that is learnt and followed; what :func:`learn` gives."""
    innovations = np.empty_like(regressed)
    placed = learn(features, s, columns, regressed, scale, sigma, information, theta, left_changes, right_changes,
                   waiting, inflation, places, placed, outputs, innovations)
    _follow(outputs, mean, std, wandering, calibration)
    paces = len(decay)
    advance(rows, start, filled, decay, features, s, columns, regressed, outputs, theta, innovations,
            wandering[2 * paces:3 * paces], errors, eps)
    return placed
