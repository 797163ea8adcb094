"""The active estimator and what happens around it: answers in order, learning, gating, and changes of the model.

No ROS here. Work that takes seconds goes to a background, and the model in force answers and learns on meanwhile. What
the background gives then learns the samples that came, and takes over between two of them: from there on the answers
are those of an estimator that did everything at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.finite import are_finite
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.external_wrench import ExternalWrench
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.tools import Tools
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import model_jobs
from semiparam_ros.online.change_record import ChangeRecord
from semiparam_ros.online.change_watch import QUIET, ChangeWatch
from semiparam_ros.online.compensation import Compensation, bodies_and_bias
from semiparam_ros.online.contact_gate import ContactGate, standardised_innovation
from semiparam_ros.online.history import History, SampleBatch
from semiparam_ros.online.learning import APPLY, OFF, Learning, begins_anew, learning_of, observe
from semiparam_ros.online.model_switcher import (
    MODEL_PARAMETERS,
    ModelSwitcher,
    same_model,
    sentence_of,
)
from semiparam_ros.online.renewal import RecentWindow, Renewal, has_draft
from semiparam_ros.online.state_file import SavedState
from semiparam_ros.online.tare import Tare
from semiparam_ros.online.worker import Background
from semiparam_ros.settings.rules import hyperparameters_suffice
from semiparam_ros.settings.snapshot import Settings

MOST_WINDOWS = 1000
"""So many windows are accounted for one by one; of a robot whose outputs are constant there is one after another."""
FAILURES_AT_MOST = 3
"""So many samples in a row that the active model cannot answer, and it counts as broken."""


class Answer(NamedTuple):
    """Answer to one sample, as it is published."""

    prediction: Prediction
    residual: Array  # (n,) outputs minus prediction, in N and N m
    innovation: float  # root mean square of the residual in predictive standard deviations
    learning: int
    """See :class:`Learning`, marked by :func:`begins_anew`."""
    contact: bool
    contact_level: Array  # (n,) residual over the gate's threshold; 0 where it does not judge
    places: Array  # (n_links,) how likely the contact is at each link of the gate's places
    contact_s: float  # since the contact began
    followed: Array  # (n,) what was predicted and may be a push, by the offset without a gate, or ahead of what is told

    @property
    def learnt(self) -> bool:
        """Tell whether the model is to learn it."""
        return self.learning > 0


class LearnerListener:
    """Receives what a learner has to tell, in the learner's own thread, and makes nothing of it unless a method says
    otherwise."""

    def answered(self, answer: Answer) -> None:
        """The answer to one sample, in the order of the samples."""

    def horizon_completed(self, errors: HorizonErrors) -> None:
        """The horizon errors of the active model."""

    def shadow_horizon_completed(self, variant: str, errors: HorizonErrors) -> None:
        """The horizon errors of a shadow variant."""

    def announce(self, sentence: str) -> None:
        """News for the log."""

    def model_switched(self, success: bool, sentence: str) -> None:
        """Take note of whether a change of the model came about, with a sentence about it."""

    def settings_reverted(self, settings: Settings) -> None:
        """The settings that hold from now on, after a change that failed or a model that broke."""

    def change_reported(self, record: ChangeRecord) -> None:
        """The robot has changed, or more is known of a change."""

    def failed(self, place: str, error: BaseException) -> None:
        """Something unexpected went wrong at ``place``; the learner goes on."""


class Learner:
    """Answers every sample once, in order.

    :param listener: told of every answer and of what happens to the model.
    :param checkpoint: gives the newest good saved state to replace a model that broke; None without one.
    Raises SemiparamError where the settings name links that the robot does not have.
    """

    def __init__(self, settings: Settings, body: RigidBody, background: Background, listener: LearnerListener,
                 checkpoint: Callable[[], SavedState | None] = lambda: None) -> None:
        self.settings, self.body = settings, body
        self._turns = 0
        """Of what is applied, when the residuals of the tare began."""
        self._anew = False
        """Whether something else is taken off the outputs since the last sample that was news."""
        ExternalWrench(body, settings.external_wrench_frame)  # raises for a link that is none
        self.gate = ContactGate.of(body)
        self.tare, self.tools = Tare(body.n_outputs), Tools(body, settings.tools)
        self.learnt = self.answered = self.lost = 0
        self.passed_over = 0
        """Of the samples answered, by the model then in force (``learn.every``, ``learn.least_gain``)."""
        self.renewals = 0
        """How often the model of a whole later window took over."""
        self.failed_windows: deque[str] = deque(maxlen=MOST_WINDOWS)
        """Of the last initial windows that gave no hyperparameters the reason."""
        self._listener, self._checkpoint = listener, checkpoint
        self.switcher = ModelSwitcher(body, background, self, listener.shadow_horizon_completed,
                                      listener.failed)
        self.changes = ChangeWatch(body, background, listener.change_reported, listener.failed)
        self._begin(settings, model_jobs.new_estimator(settings, body))

    def _begin(self, settings: Settings, estimator: Estimator, past: SampleBatch | None = None,
               renewal: Memory = None) -> None:
        """Go on with an estimator that has seen a past, and with nothing else."""
        self.switcher.retire_all(forget_hyperparameters=True)
        self._renewal = Renewal(settings.initial_samples, self.body.n_outputs)
        if renewal is not None:
            self._renewal.restore(renewal)
            self.switcher.renewed = self._renewal.done
        self.gate.forget()
        self.changes.begin()
        self._anew = False
        self.estimator, self.built = estimator, settings
        self.changes.applied.shaped_by(estimator.columns.effects)
        self.history = History(settings.initial_samples, settings.retained_samples, self.body.n_joints,
                               estimator.origin)
        if past is not None:
            self.history.refill(past)
        self._seen = len(self.history)
        self._failures = 0
        self._newest_of_state: int | None = None
        """[ns] That of the state that was loaded, until the next sample comes."""
        self._asked: int | None = None
        self._recent: RecentWindow | None = None
        """That hyperparameters are estimated from; None: the initial window."""
        self._before_renewal: Memory = None
        """State of the renewal from before that."""
        self._awaits_draft = False
        self.takeovers: list[int] = []
        """Samples from the end of each of the first windows until the model of it answered."""
        if not self._renewal.refines:  # a draft's hyperparameters are not those that follow it
            self.switcher.remember(settings, estimator)
        self._follow_settings(retry=True)

    @property
    def estimator(self) -> Estimator:
        """The active one."""
        return self._estimator

    @estimator.setter
    def estimator(self, estimator: Estimator) -> None:
        self._estimator = estimator
        if self._anew:
            estimator.forget_offset()
        self._predicts_otherwise()

    def _predicts_otherwise(self) -> None:
        """Begin with another model, or another part taken off: residuals of before are none to tare or judge by."""
        self.tare.begin_anew()
        self.gate.begin_rest()

    def takes_off_otherwise(self) -> None:
        """The outputs are others from here on: as above, and the wandering offset holds nothing of them."""
        self._anew = True
        self._estimator.forget_offset()
        self._predicts_otherwise()

    def take_tare(self) -> int:
        """See :meth:`Tare.take`; what it takes off is no contact, and in no offset any more."""
        count = self.tare.take()
        self.takes_off_otherwise()
        return count

    # Samples

    @property
    def estimating(self) -> bool:
        """Tell whether hyperparameters are estimated from the initial window."""
        successor = self.switcher.successor
        return self.estimator.window_full and successor is not None and same_model(successor.settings, self.built)

    def offer(self, sample: Sample) -> None:
        """Answer a sample, then learn it."""
        self._go_on_from_state(sample.stamp)
        found = self._predict(sample)
        if found is None:
            return
        prediction, added = found
        sample = prediction.sample
        changes, ahead = self.gate.changes, self.changes.applied.taken_ahead  # a hand may do what is ahead
        as_told = prediction._replace(sample=sample._replace(outputs=sample.outputs + ahead))
        contact = self.gate.judge(as_told, self.settings, self._renewal.unsettled)
        if self.gate.changes > changes:
            learnt = 'is learnt once it is told' if self.changes.holds else 'is learnt'
            self._listener.announce(
                f'the contact gate opens after {self.settings.gate_timeout:g} s: what lasts so long is '
                f'a change of the robot, and {learnt}.')
        learns = self.settings.learning and not contact
        learning = learning_of(self.estimator, prediction, learns, self.gate, self.changes)
        if learning >= Learning.AFTER_CHANGE:
            self.changes.began_anew(learning, told=not self.gate.changed)
        self.gate.changed &= learning in (Learning.NO_NEWS, Learning.NO)
        self.changes.follows = self.changes.follows if learning in (Learning.NO_NEWS, Learning.NO) else None
        self.changes.begins_to_hold &= learning != Learning.TAKEN_BACK
        followed = (prediction.mean - prediction.model_mean) * (not self.settings.gate_enabled) + ahead
        answer = Answer(self._as_measured(prediction, *added), sample.outputs - prediction.mean,
                        standardised_innovation(prediction), self._marked(learning), contact, self.gate.level,
                        *self.gate.places(), followed)
        self._emit(answer)  # before learning, which takes as long as predicting
        self._look_for_changes(prediction)
        if self._observe(prediction, learning):
            renews = answer.learnt and not self.settings.hyperparameters_sigma and self._renews(prediction)
            self.switcher.offer(sample, answer.learning)
            if self._asked is None and self.estimator.window_full:
                self._end_window()
            elif renews:
                self._renew()

    def _marked(self, learning: Learning) -> int:
        """The fate of a sample as it is kept: the first news since something else is taken off is marked."""
        if not self._anew or learning == Learning.NO_NEWS:
            return learning
        self._anew = False
        return begins_anew(learning)

    def _go_on_from_state(self, stamp: int) -> None:
        """The clock was set back where the first sample is older than the state: as of a simulation that began anew,
        whose topics know no other time."""
        newest, self._newest_of_state = self._newest_of_state, None
        if newest is not None and stamp < newest:
            self.clear_pending()

    def _look_for_changes(self, prediction: Prediction) -> None:
        """Whatever goes wrong there, the sample is learnt."""
        self.changes.applies = self.settings.diagnosis_auto == APPLY
        self.estimator.marks = self.settings.diagnosis_auto != OFF
        if self.settings.diagnosis_auto == OFF:
            self.changes.forget()
            return
        try:
            self.changes.see(self.estimator, prediction, self.history)
        except Exception as error:
            self.changes.forget()
            self._listener.failed('looking for changes', error)

    def compensated(self, answer: Answer, compensation: Compensation) -> Array:
        """(6,) the measured wrench of an answer that was just given, without weight, inertia and bias of the tool."""
        prediction = answer.prediction
        bodies, bias = bodies_and_bias(self.estimator, prediction)
        more, further = self.changes.applied.bodies_and_bias()
        taken_off = compensation.taken_off(prediction, bodies + self.tools.parameters + more,
                                           bias + self.tare.bias + further)
        return answer.residual + prediction.mean - taken_off

    def added_to_desired(self, position: Array, velocity: Array, acceleration: Array) -> tuple[Array, Array] | None:
        """(n,) what tools and applied changes add to a desired state, as the sensor shows it, and as the arm needs it;
        None where there are none."""
        applied = self.changes.applied
        if not (self.tools.texts or applied.acts):
            return None
        self.tools.shaped_by(self.estimator.columns.effects)
        shown, needed = (of_tools + of_changes for of_tools, of_changes in zip(
            self.tools.desired(position, velocity, acceleration),
            applied.desired(position, velocity, acceleration), strict=True))
        return shown, needed

    def clear_pending(self) -> None:
        """Forget half-finished horizons after a jump of the clock; the models stay."""
        self.gate.reset()
        self.changes.reset()
        self.switcher.clear_pending()
        self.estimator.clear_pending()

    def _taken_off(self, sample: Sample) -> tuple[Sample, Array, list[Array | None]]:
        """The sample as the model sees it; its outputs (n,) with tools and changes, and what each of these adds."""
        if self.tare.active:
            sample = sample._replace(outputs=sample.outputs - self.tare.bias)
        measured = sample.outputs
        self.tools.shaped_by(self.estimator.columns.effects)
        self.changes.applied.shaped_by(self.estimator.columns.effects)
        sample, of_tools = self.tools.taken_off(sample, self.estimator.remembered(sample.stamp))
        sample, of_changes = self.changes.applied.taken_off(sample)
        return sample, measured, [of_tools, of_changes]

    def _predict(self, sample: Sample) -> tuple[Prediction, list[Array | None]] | None:
        """See :meth:`Estimator.predict`, and what was taken off; None where the active model fails, but is not yet
        known to be broken."""
        seen, measured, added = self._taken_off(sample)
        try:
            prediction = self.estimator.predict(seen, measured)
            if not (are_finite(prediction.mean) and are_finite(prediction.std)):
                raise FloatingPointError('it predicts values that are not finite')
        except Exception as error:
            self._failures += 1
            broken = isinstance(error, FloatingPointError) or self._failures >= FAILURES_AT_MOST
            self._listener.failed('the active model', error)
            if not broken:
                self.lost += 1
                return None
            self._fall_back(error)
            seen, measured, added = self._taken_off(sample)  # of what goes on, another bias may be known
            return self.estimator.predict(seen, measured), added
        self._failures = 0
        return prediction, added

    def _observe(self, prediction: Prediction, learning: Learning) -> bool:
        """Tell whether the active model has taken it in; it is broken where it has not."""
        turns = self.changes.applied.turns
        if turns != self._turns or learning >= Learning.AFTER_CHANGE or learning == Learning.RETURNED:
            self._turns = turns
            self._predicts_otherwise()
        passed_over, since = self.estimator.passed_over, round(self.estimator.as_before_s * NANOSECONDS)
        try:
            errors = observe(self.estimator, prediction, learning, finish=False)
        except SemiparamError:
            raise  # of the sample: the model is as it was
        except Exception as error:  # who knows how much of it was learnt
            self._listener.failed('learning', error)
            self._fall_back(error)
            return False
        passed = self.estimator.passed_over - passed_over
        self.passed_over += passed
        self.learnt -= passed
        if learning == Learning.RETURNED:
            self.changes.returned(prediction.sample.stamp - since)
            self._listener.announce(
                'the robot is again as it was before its last change: what was learnt then goes on.')
        if errors is not None:
            self._listener.horizon_completed(errors)
        return True

    def _as_measured(self, prediction: Prediction, *added: Array | None) -> Prediction:
        """With what tools and changes add (n,), and the bias of the tare, which the sensor still has."""
        for more in added:
            if more is not None:
                prediction = prediction._replace(mean=prediction.mean + more)
        return prediction._replace(mean=prediction.mean + self.tare.bias) if self.tare.active else prediction

    def _emit(self, answer: Answer) -> None:
        prediction, sample = answer.prediction, answer.prediction.sample
        self.answered += 1
        self._seen += 1
        self.learnt += answer.learnt
        self.tare.add(sample.stamp, sample.outputs - prediction.model_mean, prediction.ready and not prediction.off)
        self._listener.answered(answer)
        self.history.append(sample, answer.learning)

    def _end_window(self) -> None:
        """Let the background estimate hyperparameters, unless the settings want another model than this."""
        self._asked, self._recent = self.answered, None
        self._awaits_draft = has_draft(self.built.initial_samples)
        if self.switcher.successor is None:
            self._listener.announce(f'the initial window holds {len(self.estimator.window)} samples of motion: the '
                                f'hyperparameters of {self.built.variant} are estimated; the rigid body answers on.')
            self.switcher.finish_window(self.built, self.estimator)

    def draft_live(self, estimator: Estimator | None) -> None:
        """It takes over from the provisional model, between two samples; the hyperparameters are estimated yet."""
        waited, self._awaits_draft = self.waited, False
        self._note_takeovers(1, waited)
        if estimator is not None:
            self.estimator = estimator
            self._renewal.go_on_with_draft()
            self._listener.announce(f'{self.built.variant} takes over with a draft of its hyperparameters, {waited} '
                                'samples after the end of the initial window.')

    def _window_live(self, estimator: Estimator) -> None:
        """The model whose window is over takes over from the provisional one or its draft, between two samples."""
        self.estimator = estimator
        self._renewal.clear()
        self._listener.announce(f'{self.built.variant} has its hyperparameters and takes over, '
                            f'{self._taken_over()} samples after the end of the initial window.')

    def _taken_over(self) -> int:
        """End the wait for what was asked of a window, which is there or cannot be; samples
        answered since."""
        waited, self._asked = self.waited, None
        self._note_takeovers(1 + self._awaits_draft, waited)  # it was built without
        self._awaits_draft = False
        return waited

    def _note_takeovers(self, number: int, waited: int) -> None:
        self.takeovers = [*self.takeovers, *[waited] * number][:MOST_WINDOWS]

    @property
    def waited(self) -> int:
        """Samples answered since the end of the window that a model is asked of."""
        return 0 if self._asked is None else self.answered - self._asked

    def _renews(self, prediction: Prediction) -> bool:
        """Tell whether motion has left what the hyperparameters are from, and no successor is built
        but one that has none of the motion of a draft that is due: that is given up."""
        if not self._renewal.see(self.estimator, prediction):
            return False
        successor = self.switcher.successor
        if successor is None:
            return True
        outdated = self._renewal.outdates(self._recent) and same_model(successor.settings, self.built)
        if outdated:
            self._taken_over()
            self.switcher.retire_successor()
        return outdated

    def _renew(self) -> None:
        """Estimate the hyperparameters again."""
        self._before_renewal = self._renewal.state()
        self._recent = self._renewal.begin()
        if self._recent.draft or not has_draft(self.built.initial_samples):
            self._listener.announce(f'the hyperparameters of {self.built.variant} are estimated again, from the latest '
                                f'{self._recent.samples} samples, as the robot moves otherwise than in the window that '
                                'they are from; it answers on.')
        self._asked = self.answered
        self.switcher.renew(self.built, self.history, self._recent)

    def _renewed(self, estimator: Estimator, later: RecentWindow) -> None:
        """The model with hyperparameters of a later window takes over, between two samples."""
        self.estimator, self._renewal.done = estimator, True
        self.switcher.follow_renewed(self.settings, estimator, None if later.draft else self.history)
        if later.draft:
            self._renewal.go_on_with_draft()
            self._listener.announce(
                f'{self.built.variant} goes on with a draft of them, from {later.samples} '
                f'samples, the last of which {self._taken_over()} samples ago.')
            return
        self._renewal.clear()
        self.renewals += 1
        self._listener.announce(
            f'{self.built.variant} has new hyperparameters and takes over after {self._seen} samples, '
            f'{self._taken_over()} of them since the end of the window.')

    def _discard_window(self, reason: str) -> None:
        """Gather another initial window; nothing is built from the one that gave no hyperparameters."""
        self.failed_windows.append(reason)
        self._listener.announce(f'the initial window gives no hyperparameters ({reason}); another one is gathered.')
        self.estimator.discard_window()
        self._taken_over()
        self.history.discard(self.estimator.origin)
        self.switcher.retire_all()
        self._follow_settings(retry=True)

    # Changes of the model

    def check(self, settings: Settings) -> None:
        """Raise SemiparamError if a model of these settings cannot be built on this robot, or has no such links."""
        Tools(self.body, settings.tools)
        ExternalWrench(self.body, settings.external_wrench_frame)
        if same_model(settings, self.built):
            return
        latest = self.history.latest() or self._at_rest()
        model_jobs.new_estimator(settings, self.body).predict(latest)

    def _at_rest(self) -> Sample:
        zeros = np.zeros(self.body.n_joints)
        return Sample(0, zeros, zeros, zeros, np.zeros(self.body.n_outputs))

    def change(self, settings: Settings) -> str:
        """Take over new, already validated settings; returns a sentence on what happens to the model now, '' where they
        ask for no other one."""
        before, self.settings = self.settings, settings
        if settings.tools != self.tools.texts:
            self.tools = Tools(self.body, settings.tools)
            self.takes_off_otherwise()
        sentence = self._change_model(settings)
        self.switcher.set_shadows(settings, self.history, retry=True)
        return '' if same_model(before, settings) else sentence

    def _change_model(self, settings: Settings) -> str:
        successor = self.switcher.successor
        if successor is not None and same_model(settings, successor.settings):
            return ''
        self.switcher.retire_successor()
        if same_model(settings, self.built):
            self._follow_settings()
            return '' if successor is None else f'{settings.variant} goes on.'
        if self.switcher.appoint(settings, self.history):
            return f'{settings.variant} learnt as a shadow and answers from the next sample on.'
        return (f'{settings.variant} is being built from {len(self.history)} samples; {self.built.variant} answers '
                'until it takes over, between two samples.')

    @property
    def disturbed(self) -> bool:
        """Return whether the outputs show more than the model holds: a contact, or a change."""
        return self.gate.closed or self.changes.state not in QUIET

    def reset(self) -> None:
        """Forget everything learnt."""
        self.tare = Tare(self.body.n_outputs)
        self.changes.applied.clear()
        self._begin(self.settings, model_jobs.new_estimator(self.settings, self.body, origin=self.history.origin))

    def restore(self, saved: SavedState) -> None:
        """Go on with a state that was saved."""
        self.settings = saved.asked or saved.settings
        self.tare, self.tools = Tare(self.body.n_outputs, saved.bias), Tools(self.body, saved.settings.tools)
        self._begin(saved.settings, saved.estimator, saved.batch, saved.renewal)
        self.gate.restore(saved.gate)
        self._anew = saved.anew
        if saved.tools != self.tools.texts:
            self.takes_off_otherwise()
        self.changes.applied.restore(saved.applied)
        latest = self.history.latest()
        self._newest_of_state = None if latest is None else latest.stamp

    def state(self) -> SavedState:
        """State that :meth:`restore` takes back."""
        asked = None if same_model(self.settings, self.built) else self.settings
        estimating = self._asked is not None and self._recent is not None  # which begins anew after loading
        renewal = self._before_renewal if estimating else self._renewal.state()
        return SavedState(self.built, self.estimator, self.history.batch(), self.tare.bias, self.gate.state(),
                          renewal, self.changes.applied.state(), self.tools.texts, self._anew, asked)

    def _fall_back(self, error: Exception) -> None:
        """The active model is broken: go on with the last checkpoint, else with P and no effects; where hyperparameters
        were given that P does not suffice with, without effects alone."""
        broken, saved = self.built.variant, self._newest_checkpoint()
        if saved is not None:
            self.restore(saved._replace(asked=None))  # it may be the one that broke
            instead = f'{self.built.variant} of the last checkpoint goes on'
        else:
            plain = replace(self.settings, effects=(), shadow_variants=())
            simplest = replace(plain, variant='P')
            self.settings = simplest if hyperparameters_suffice(simplest) is None else plain
            estimator = model_jobs.new_estimator(self.settings, self.body, origin=self.history.origin)
            self._begin(self.settings, estimator)
            instead = f'{self.built.variant} begins anew'
        self._listener.settings_reverted(self.settings)
        self._listener.model_switched(False, f'{broken} is broken ({sentence_of(error)}); {instead}.')

    def _newest_checkpoint(self) -> SavedState | None:
        try:
            return self._checkpoint()
        except Exception as error:
            self._listener.failed('the checkpoint', error)
            return None

    # What the switcher tells

    def successor_live(self, settings: Settings, estimator: Estimator) -> None:
        """It takes over, between two samples."""
        self._failures = 0
        if same_model(settings, self.built):
            if self._recent is not None:
                self._renewed(estimator, self._recent)
            else:
                self._window_live(estimator)
            return
        if not self.estimator.ready and self._asked is not None:
            self._taken_over()
        before, self.built, self.estimator, self._asked = self.built, settings, estimator, None
        self._renewal.clear()
        changed = f' from {before.variant}' if before.variant != settings.variant else ', changed,'
        self._listener.model_switched(True, f'{settings.variant} takes over{changed} after {self._seen} samples.')
        self._follow_settings()

    def successor_failed(self, settings: Settings, sentence: str) -> None:
        """The active model goes on, and so do its settings."""
        if same_model(settings, self.built):
            if self.estimator.ready:
                self._taken_over()
                if self._recent is None:
                    self._renewal.clear()
                self._listener.announce(f'the window gives no hyperparameters ({sentence}); {settings.variant} goes '
                                    'on with those it has.')
            else:
                self._discard_window(sentence)
            return
        self.settings = replace(self.settings, **{name: getattr(self.built, name) for name in MODEL_PARAMETERS})
        self._listener.settings_reverted(self.settings)
        self._listener.model_switched(False, self._not_built(settings, sentence))
        self._follow_settings()

    def shadow_failed(self, settings: Settings, sentence: str) -> None:
        """The others go on."""
        self._listener.announce(self._not_built(settings, sentence))

    def _not_built(self, settings: Settings, sentence: str) -> str:
        return f'{settings.variant} could not be built ({sentence}); {self.built.variant} goes on.'

    def _follow_settings(self, retry: bool = False) -> None:
        """Build what the settings ask for and is not there."""
        if same_model(self.settings, self.built):
            if (self.estimator.window_full or self._renewal.refines) and self.switcher.successor is None:
                self._asked = self.answered if self._asked is None else self._asked
                self.switcher.appoint(self.settings, self.history)
            elif self._asked is not None and self._recent is not None and self.switcher.successor is None:
                self.switcher.renew(self.built, self.history, self._recent)  # it gave way to a model that did not come
            self.switcher.set_shadows(self.settings, self.history, retry)
        elif self.switcher.successor is None:
            self.switcher.appoint(self.settings, self.history)
