"""The online model of a robot: a single one, or several that learn side by side, averaged by their running evidence.

``variant: auto`` averages variants. What is part of a model is believed only as far as what comes speaks for it (a
spike and slab prior; Mitchell and Beauchamp 1988): random features stand beside the rigid body alone, and the variant
with the declared effects beside the same variant without any. How they are averaged stands in ``ensemble``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import replace
from math import isnan
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.columns import ColumnBlock, CoupledColumns, Memories
from semiparam_ros.core.ensemble import Ensemble
from semiparam_ros.core.finite import require_finite
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.initial_window import InitialWindow
from semiparam_ros.core.input_range import beyond, widened
from semiparam_ros.core.learnt_inputs import LearntInputs
from semiparam_ros.core.model import (
    InputScaling,
    Model,
    ModelOptions,
    estimated_from,
    model_with,
    provisional_model,
    without_features,
)
from semiparam_ros.core.motion import Motion, at_start, begins_step
from semiparam_ros.core.online_model import ModelState, OnlineModel
from semiparam_ros.core.prediction import DesiredOutputs, Observed, Prediction
from semiparam_ros.core.random_features import input_scaling
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import radians
from semiparam_ros.core.samples import NO_TEMPERATURE, Sample
from semiparam_ros.core.stamps import LONGEST_PAUSE_NS
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.core.variants import AVERAGED, MEMBERS, has_both, single, variant_named
from semiparam_ros.errors import SemiparamError


class Member(NamedTuple):
    """A model that is averaged with others."""

    variant: str
    has_effects: bool = True
    """Whether it has the effects that are declared."""

    @property
    def name(self) -> str:
        """Name as users read it."""
        return self.variant if self.has_effects else f'{self.variant} without effects'


def members_of(options: ModelOptions, effects: bool, ready: bool) -> tuple[Member, ...]:
    """Models that are averaged, the first one first; before the initial window is over, rigid
    bodies alone.

    :param effects: whether any are declared. :param ready: whether the initial window is over.
    """
    names: tuple[str, ...] = (single(options.variant),)
    if options.alone:
        return (Member(names[0]),)
    if ready and options.variant == AVERAGED:
        names = MEMBERS
    elif ready and options.physical and has_both(options.variant):
        names = (options.variant, 'P')
    return (*(Member(name) for name in names), *[Member(names[0], has_effects=False)][:effects])


class EstimatorState(NamedTuple):
    """State of an estimator: what it has learnt and what it remembers, beside its options."""

    models: tuple[ModelState, ...]
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
    average: Mapping[str, Array | Stamps]
    """Weights of the models, and the horizons of their average; empty for one model."""


class Estimator:
    """Online semi-parametric model of one robot's outputs.

    The first ``initial_samples`` of motion are answered by the rigid body alone, which starts from the robot
    description's inertias. They then give the hyperparameters, are learnt by the chosen variant, and it takes over.

    Several models learn beside each other (see :func:`members_of`), and their answers are averaged; what is asked of a
    single model (its coefficients, its hyperparameters) is that of the first.

    :param origin: stamp [ns] from which the time of effects counts, such as the start of a recording; that of the first
        sample unless given. It moves along when the clock jumps, so that time goes on from the last sample.
    :param window: with given hyperparameters, how many samples of the window that they are from come again first. Bands
        are not calibrated meanwhile by samples that are not learnt, as they were not when the window was gathered.
    """

    def __init__(self, body: RigidBody, options: ModelOptions | None = None, effects: Sequence[ColumnBlock] = (),
                 origin: int | None = None, window: int = 0) -> None:
        """Raises SemiparamError when the options or the effects do not fit the robot."""
        self.options = options or ModelOptions()
        self.variant = variant_named(self.options.variant)
        self.columns = CoupledColumns(body, effects, self.options.joint_friction, self.options.physical)
        self._without_effects = self.columns.without_effects() if effects else self.columns
        self.body = body
        self.window = self.new_window()
        self.motion: Motion | None = None
        self.input_scaling: InputScaling | None = None
        self.origin = origin
        self._newest: int | None = None
        self._temperature = NO_TEMPERATURE
        """Of the newest sample: a desired state is as warm."""
        self._memory: Memories = None
        self._radians = radians(body)
        self.kept = LearntInputs(3 * body.n_joints, self._radians)
        self.inputs_learnt: Array = np.zeros((0, 3 * body.n_joints))
        """See :mod:`semiparam_ros.core.input_range`."""
        given = self.options.hyperparameters
        self.ready, self.window_samples = given is not None, window
        self.marks = False
        """Whether what was learnt is copied, so that it can be taken back."""
        if given is None:
            self.ensemble = self._provisional()
        else:
            self.input_scaling = np.array(self.options.input_mean), np.array(self.options.input_scale)
            self.ensemble = self._with_hyperparameters([given, *self._given_others(given)], window)

    def step(self, sample: Sample, learn: bool = True) -> Prediction:
        """Predict the sample, then learn it (unless told not to, or the robot is at rest)."""
        prediction = self.predict(sample)
        return Prediction(*prediction[:-1], self.observe(prediction, learn and prediction.motion.is_news))

    def predict(self, sample: Sample, measured: Array | None = None) -> Prediction:
        """Predict the outputs at the sample's inputs; nothing changes. Unknown outputs may be NaN.

        :param measured: (n,) the outputs before tools and other known bodies were taken off, which tell whether motors
            are off; those of the sample unless given.

        Raises SemiparamError when an input is not finite, or has another shape than the robot.
        """
        return self.ensemble.predict(self._observed(sample, measured))

    def _observed(self, sample: Sample, measured: Array | None = None) -> Observed:
        sample = sample.in_rows(self.body.n_joints, self.body.n_outputs)
        measured = np.array(sample.outputs if measured is None else measured)  # kept, where a caller may fill his anew
        x, outside = beyond(self.inputs_learnt, sample, self._radians)
        if isnan(outside):
            require_finite('positions, velocities and accelerations', x)
        columns, memory = self.columns.one(sample, self._origin_at(sample.stamp), self.remembered(sample.stamp))
        if self.columns.effects:
            require_finite('columns of the effects', columns)
        position = x[:self.body.n_joints]
        motion = self.motion.after(sample.stamp, position, measured) if self.motion else \
            at_start(sample.stamp, position, measured)
        return Observed(sample, x, columns, memory, motion, outside, begins_step(sample.stamp, self._newest), measured)

    def remembered(self, stamp: int) -> Memories:
        """Return what the effects remember of the samples before one at a stamp [ns]; None after a long pause."""
        jumped = self._newest is not None and not 0 <= stamp - self._newest <= LONGEST_PAUSE_NS
        return None if jumped else self._memory

    def holds(self, effect: ColumnBlock) -> bool:
        """Tell whether an effect acts at the newest sample, by its start and its end."""
        now = self.origin if self._newest is None else self._newest
        return now is None or effect.acts(now, self.origin or 0)

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
        found = self.ensemble.predict_desired(x, shown, needed, self.kept)
        found = found._replace(distance=self.kept.distance(x))
        require_finite('predicted outputs of a desired state',
                       np.concatenate([found.shown, found.covariance.diagonal()]))
        return found

    def observe(self, prediction: Prediction, learn: bool = True, finish: bool = True,
                follow: bool = False) -> HorizonErrors | None:
        """Charge a predicted sample to the horizon index, and learn it; the horizon it completed.

        :param learn: let the models learn it, unless ``learn_every`` or ``learn_least_gain`` passes over it; the bands
            and the wandering offset follow all the same.
        :param finish: end the initial window with the sample that makes it full; else the rigid body goes on, until
            :meth:`finish_window` is called.
        :param follow: let the wandering offset follow what is not learnt.

        Every other prediction made before is then stale. Raises SemiparamError, with nothing changed, when this one is,
        or when the measured outputs are not finite.
        """
        sample = prediction.sample
        self.model.recursion.require_current(prediction.members[0].prior)
        require_finite('outputs', sample.outputs)
        self._go_on_from(prediction)
        if learn and (prediction.beyond or not len(self.inputs_learnt)):
            self.inputs_learnt = widened(self.inputs_learnt, sample.inputs)
        of_window = self.ready and self.ensemble.first.window_left  # which holds no others
        counts = prediction.begins_step or (self.ready and not of_window)
        passed_over = self.passed_over
        complete = self.ensemble.take_in(prediction, learn and (prediction.begins_step or not of_window), follow)
        if learn:
            if counts and self.passed_over == passed_over:
                self.kept.add(sample)
            if self.ready and prediction.motion.is_news:
                self.ensemble.charge_left_out(prediction)
            self.ensemble.mark(sample.stamp, self.marks)
        if learn and prediction.begins_step and not self.ready and not self.window.full:
            self.window.append(sample, prediction.columns)
        if finish and self.window_full:
            self.finish_window()
        return complete

    def take_back(self) -> None:
        """Take back what was learnt in the last two seconds, or a little more, where that is :attr:`marks`."""
        self.ensemble.take_back()

    def compare(self, prediction: Prediction) -> bool:
        """Return whether what was known before the last change predicts better, this sample included."""
        return prediction.motion.is_news and self.ensemble.compare(prediction)

    @property
    def as_before_s(self) -> float:
        """[s] How long it does, where the robot is told to have changed; 0 where it does not."""
        return self.ensemble.as_before_s

    def go_back(self) -> None:
        """See :meth:`~semiparam_ros.core.recursion.SemiParametricRecursion.go_back`."""
        self.ensemble.go_back()

    def follow_change(self, directions: Array | None = None) -> None:
        """The robot has changed: see :meth:`~semiparam_ros.core.recursion.SemiParametricRecursion.follow_change`.

        :param directions: (q, k) of the columns without those of effects; None: any change.
        """
        self.ensemble.follow_change(directions)

    def gather(self, sample: Sample, learn: bool = True) -> None:
        """Take a sample into the initial window alone: the rigid body neither answers nor learns it.

        :param learn: False: it only goes by.
        """
        observed = self._observed(sample)
        self._go_on_from(observed)
        if learn:
            self.window.append(sample, observed.columns)

    def _go_on_from(self, observed: Observed | Prediction) -> None:
        stamp = observed.sample.stamp
        self.origin, self._newest = self._origin_at(stamp), stamp
        self._memory, self.motion = observed.memory, observed.motion
        self._temperature = np.array(observed.sample.temperature)  # a caller may fill his anew

    @property
    def window_full(self) -> bool:
        """Tell whether the initial window holds enough, and :meth:`finish_window` has not been
        called yet."""
        return not self.ready and self.window.full

    @property
    def model_comes(self) -> str:
        """When there is a model to rely on, after the word until; '' once it is there."""
        if self.ready:
            return ''
        if self.window.full:
            return f'the hyperparameters of {self.options.variant} are estimated from the initial window'
        return (f'the initial window is over, which has {len(self.window)} of {self.window.wanted} '
                'samples of motion')

    def new_window(self) -> InitialWindow:
        """An empty one, as at the start."""
        return InitialWindow(self.options.initial_samples, 3 * self.body.n_joints, self.body.n_outputs,
                             self.columns.n_columns)

    def discard_window(self) -> None:
        """Gather another initial window, as one that gave no hyperparameters is no good; what P has
        learnt stays. Time goes on, and effects remember nothing: as for a model that is built from
        the samples that follow."""
        self.window = self.new_window()
        self._newest = self._memory = self.motion = None

    def with_window_alone(self) -> Estimator:
        """A copy without what the rigid body has learnt so far: its window can be finished while this one goes on."""
        twin = copy(self)
        twin.kept = deepcopy(self.kept)
        twin.ensemble = twin._provisional()
        return twin

    def finish_window(self, draft: bool = False, learn: bool = True) -> None:
        """End the initial window now: estimate hyperparameters from it, learn it, and let the variant take over; where
        several are averaged each has its own.

        :param draft: estimate from a few hundred of its samples and two starts, in about a tenth of the time.
        :param learn: False: the hyperparameters are all that is wanted of it.

        Raises SemiparamError, with nothing changed, when the window holds too little to estimate from.
        """
        if not len(self.window):
            raise SemiparamError('the initial window holds no samples yet: none were learnt while the robot moved.')
        scaling, plain = input_scaling(self.window.inputs, self._radians), self._window_without_effects()
        members = members_of(self.options, bool(self.columns.effects), ready=True)
        windows = [self.window if member.has_effects else plain for member in members]
        found = [estimated_from(window, member.variant, self._columns_of(member), self.options, scaling, draft)
                 for member, window in zip(members, windows, strict=True)]
        self.input_scaling, self.ready = scaling, True
        self.window_samples, self.window = len(self.window), self.new_window()
        self.ensemble = self._with_hyperparameters(found)
        if learn:
            self.ensemble.learn_windows(windows)

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

    def clear_pending(self) -> None:
        """Forget half-finished horizons and what effects remember, as after a jump of the clock; keep the model."""
        self.clear_horizons()
        self._memory = None
        self.motion = self.motion.interrupted() if self.motion else None
        self.model.recursion.revise()

    def forget_offset(self) -> None:
        """Something else is taken off the outputs from here on: the wandering offset is one of those before."""
        self.ensemble.forget_offsets()

    def clear_horizons(self) -> None:
        """Forget half-finished horizons alone."""
        self.ensemble.clear_horizons()

    def begin_recording(self, origin: int, first: int | None = None) -> None:
        """Go on with another recording, whose time starts at ``origin`` [ns]; what is learnt stays.

        :param first: stamp [ns] of its first sample, where that may be hours after the origin.
        """
        self.clear_pending()
        self.ensemble.leave_motion()
        self.origin, self._newest, self.motion = origin, first, None

    def state(self) -> EstimatorState:
        """Copies of everything that samples have changed; :meth:`restore` takes them back bit for bit."""
        models, carried, average = self.ensemble.state()
        return EstimatorState(models, self.window.state(), self.origin, self._newest, self._memory, self.inputs_learnt,
                              self._temperature, self.motion, self.kept.state(), carried, average)

    def restore(self, state: EstimatorState) -> None:
        """Return to a saved :meth:`state` of an estimator with the same options and effects, and the hyperparameters of
        the first model; the others take theirs from the state.

        Predictions made before are then stale. Raises SemiparamError when it is that of another one.
        """
        if len(state.models) != len(self.members):
            raise SemiparamError(f'the saved average has {len(state.models) - 1} models beside {self.members[0].name}; '
                                 f'expected {len(self.members) - 1}.')
        if self.ready:
            own = self.model.hyperparameters
            self.ensemble = self._with_hyperparameters([own, *(each.hyperparameters for each in state.models[1:])])
        self.ensemble.restore(state.models, state.carried, state.average)
        self.window = self.new_window()
        self.window.restore(state.window)
        self._memory, self.motion = state.memory, state.motion
        self.origin, self._newest = state.origin, state.newest
        self.inputs_learnt, self._temperature = state.inputs_learnt, state.temperature
        self.kept.restore(state.kept)

    @property
    def members(self) -> tuple[Member, ...]:
        """Models that are averaged."""
        return members_of(self.options, bool(self.columns.effects), self.ready)

    @property
    def model(self) -> Model:
        """The first of the models."""
        return self.ensemble.first.model

    @property
    def passed_over(self) -> int:
        """Samples that were to be learnt but were not, by ``learn_every`` and ``learn_least_gain``."""
        return self.ensemble.first.passed_over

    @property
    def others(self) -> tuple[Hyperparameters, ...]:
        """Hyperparameters of the models averaged with the first one."""
        return tuple(each.model.hyperparameters for each in self.ensemble.models[1:])

    @property
    def weights(self) -> dict[str, Array]:
        """(n,) weights of each output, of the models that the answers are an average of; empty for a single one."""
        if len(self.members) == 1:
            return {}
        return {member.name: each for member, each in zip(self.members, self.ensemble.weights, strict=True)}

    @property
    def effects_probability(self) -> Array | None:
        """(n,) how likely the declared effects are, by what each output shows; None where that is not asked."""
        if self.members[-1].has_effects:
            return None
        *having, without = self.ensemble.weights
        best = np.max(having, axis=0)
        return np.asarray(best / (best + without))

    @property
    def rigid_body_model(self) -> Model:
        """Model of the rigid body alone, with the declared effects, where one is averaged; else the
        first one's: what features explain beside it is not in the coefficients of the first."""
        return self.ensemble.models[self.ensemble.rigid_body_index].model

    def rigid_body_part(self, prediction: Prediction) -> tuple[Prediction, Model] | None:
        """Prediction of a sample by the rigid body alone, with the declared effects, and its model;
        None where every model has features, or coefficients that are fixed."""
        index, model = self.ensemble.rigid_body_index, self.rigid_body_model
        if model.features is not None or model.pi is not None or model.learnt.start:
            return None
        return prediction.by_member(index), model

    @property
    def features_count(self) -> int:
        """Number D of random features in use; 0 where the model has none."""
        return self.model.recursion.n_features

    def hyperparameters(self) -> Hyperparameters:
        """Hyperparameters in use, with pi as it stands."""
        pi = tuple(self.model.part(slice(0, self.columns.n_own)).tolist())
        return replace(self.model.hyperparameters, pi=pi or None)

    def _origin_at(self, stamp: int) -> int:
        """Origin of time at a stamp, moved by what the clock jumped."""
        if self.origin is None:
            return stamp
        since = stamp - (self.origin if self._newest is None else self._newest)
        if 0 <= since <= LONGEST_PAUSE_NS:
            return self.origin
        return stamp - LONGEST_PAUSE_NS if self._newest is None else self.origin + since

    def _columns_of(self, member: Member) -> CoupledColumns:
        return self.columns if member.has_effects else self._without_effects

    def _provisional(self) -> Ensemble:
        """Rigid bodies alone, which have learnt nothing."""
        return self._ensemble([provisional_model(self._columns_of(member), self.options) for member in self.members])

    def _with_hyperparameters(self, hyperparameters: Sequence[Hyperparameters], window: int = 0) -> Ensemble:
        """The models of these, which have learnt nothing."""
        assert self.input_scaling is not None
        return self._ensemble([
            model_with(each, member.variant, self._columns_of(member), self.options, self.input_scaling)
            for member, each in zip(self.members, hyperparameters, strict=True)], window)

    def _ensemble(self, models: Sequence[Model], window: int = 0) -> Ensemble:
        online = [OnlineModel(model, self._columns_of(member), self.options, self.ready, window)
                  for member, model in zip(self.members, models, strict=True)]
        return Ensemble(online, self.columns, self.options)

    def _given_others(self, first: Hyperparameters) -> Sequence[Hyperparameters]:
        """Given hyperparameters of the others; those of the first unless given."""
        if self.options.others:
            return self.options.others
        rigid_alone = self.options.physical and self.variant.features
        return [without_features(first) if rigid_alone and member.variant == 'P' else first
                for member in self.members[1:]]
