"""The models beside the active one: its successor while that is being built, and the shadow variants.

Each is in one of four states:

    building     the background builds it from the samples so far; those that come meanwhile wait
    catching up  it is built, and learns those that waited: in the background while they are many, then beside the
                 active model; or it has gathered its initial window, and the background ends that
    live         it has seen every sample: a shadow goes on learning, a successor takes over
    retired      nobody needs it any more, or it failed; what the background still returns is dropped
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from typing import Protocol

from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import model_jobs
from semiparam_ros.online.history import History, SampleLog
from semiparam_ros.online.learning import see_again
from semiparam_ros.online.renewal import RecentWindow, has_draft
from semiparam_ros.online.worker import Background, Job, Urgency
from semiparam_ros.settings.snapshot import Settings

MODEL_PARAMETERS = ('variant', 'effects', 'effects_reference', 'joint_friction', 'priors', 'noise', 'forgetting',
                    'horizon_length')
"""Fields whose change needs another model."""

HYPERPARAMETERS_DEPEND_ON = ('variant', 'effects', 'effects_reference', 'joint_friction', 'priors', 'noise')

BESIDE_AT_MOST = 50
"""So many samples are caught up beside the active model, a few between two of its answers; more go to the background
once again."""

FOR_EACH_ANSWER = 2
"""Samples caught up at each answer: one more than come in."""


class State(Enum):
    """State of a model beside the active one; see the module."""

    BUILDING = 'building'
    CATCHING_UP = 'catching up'
    LIVE = 'live'
    RETIRED = 'retired'


class SwitcherListener(Protocol):
    """The owner of the active model."""

    def draft_live(self, estimator: Estimator | None) -> None:
        """The successor's draft from the initial window has seen every sample and takes over now; None: it failed."""

    def successor_live(self, settings: Settings, estimator: Estimator) -> None:
        """The successor has seen every sample and takes over now."""

    def successor_failed(self, settings: Settings, sentence: str) -> None:
        """The successor could not be built."""

    def shadow_failed(self, settings: Settings, sentence: str) -> None:
        """A shadow could not be built, or broke."""


def same_model(one: Settings, other: Settings) -> bool:
    """Tell whether both settings describe the same model."""
    return all(getattr(one, name) == getattr(other, name) for name in MODEL_PARAMETERS)


class StandbyModel:
    """A model that learns beside the active one, built in the background from the samples so far."""

    def __init__(self, settings: Settings, body: RigidBody, background: Background, switcher: ModelSwitcher) -> None:
        self.settings, self.body = settings, body
        self.state = State.BUILDING
        self.estimator: Estimator | None = None
        self._background, self._switcher = background, switcher
        self._log = SampleLog()
        """What comes while the background is at work, until the clock jumps."""
        self._waiting: deque[tuple[Sample, int] | None] = deque()  # what comes after that; None: the clock jumped
        self._job: Job | None = None
        self._in_background = False

    def start(self, history: History, known: model_jobs.Known | None) -> None:
        """Begin to build it."""
        self._submit(model_jobs.build, self.settings, self.body, history.batch(), known, history.origin)

    def start_renewed(self, history: History, window: RecentWindow | None = None) -> None:
        """Begin to build it with hyperparameters from a later window."""
        self._submit(model_jobs.renew, self.settings, self.body, history.batch(), history.origin, window)

    def wait_with(self, estimator: Estimator) -> None:
        """Have an estimator whose initial window is full; :meth:`finish_window` then estimates its hyperparameters."""
        self.estimator, self._in_background = estimator.with_window_alone(), True

    def finish_window(self, draft: bool = False) -> None:
        """See :meth:`wait_with`."""
        estimator, self.estimator = self.estimator, None
        assert estimator is not None
        self._submit(model_jobs.finish_window, estimator, draft)

    def offer(self, sample: Sample, learnt: int) -> None:
        """Let it see the sample that the active model has just answered."""
        if self._in_background and not self._waiting:
            self._log.append(sample, learnt)
            return
        self._waiting.append((sample, learnt))
        self._learn(FOR_EACH_ANSWER)

    def hasten(self) -> None:
        """It is to take over now: what the background does for it comes first."""
        if self._job is not None:
            self._job.urgency = self._switcher.urgency_of(self)

    def clear_pending(self) -> None:
        """Forget half-finished horizons, as after a jump of the clock."""
        self._waiting.append(None)
        self._learn(FOR_EACH_ANSWER)

    def retire(self) -> None:
        """Nobody needs it any more; what the background still does for it is dropped."""
        self.state, self.estimator = State.RETIRED, None
        self._waiting.clear()
        self._log = SampleLog()
        if self._job is not None:
            self._job.cancel()

    def _submit(self, function: model_jobs.EstimatorJob, *arguments: object) -> None:
        while self._waiting and (first := self._waiting[0]) is not None:
            self._log.append(*first)
            self._waiting.popleft()
        self._in_background = True
        self._job = self._background.submit(function, *arguments, done=self._done,
                                            urgency=self._switcher.urgency_of(self))

    def _done(self, estimator: Estimator | None, error: BaseException | None) -> None:
        self._in_background, self._job = False, None
        if self.state is State.RETIRED:
            return
        if estimator is None:
            self._switcher.on_failed(self, error)
            return
        self.estimator, self.state = estimator, State.CATCHING_UP
        log, self._log = self._log.batch(), SampleLog()
        if len(log) > BESIDE_AT_MOST:
            self._submit(model_jobs.absorb, estimator, log)
        else:
            self._waiting.extendleft(reversed(list(log.pairs())))
            self._go_on()

    def _go_on(self) -> None:
        """Learn one of those that wait, whenever there is nothing else to do."""
        self._learn(1)
        if self._waiting and not self._in_background:
            self._background.later(self._go_on)

    def _learn(self, count: int) -> None:
        """Learn up to so many of those that wait; live is who has learnt them all."""
        estimator = self.estimator
        if estimator is None or self._in_background or self.state is State.RETIRED:
            return
        for _ in range(min(count, len(self._waiting))):
            waiting = self._waiting.popleft()
            if waiting is None:
                estimator.clear_pending()
                continue
            sample, learnt = waiting
            try:
                errors = see_again(estimator, sample, learnt, finish=False)
            except Exception as error:  # a model that breaks beside the active one must not keep that from answering
                self._switcher.on_failed(self, error)
                return
            if errors is not None:
                self._switcher.on_horizon(self, errors)
            if estimator.window_full:
                self.state = State.CATCHING_UP
                self._submit(model_jobs.finish_window, estimator)
                return
        if not self._waiting and self.state is State.CATCHING_UP:
            self.state = State.LIVE
            self._switcher.on_live(self)


class ModelSwitcher:
    """Builds, feeds and retires the models beside the active one; there is never more than one
    successor.

    :param horizon_completed: called with a shadow's variant and its horizon errors.
    :param failed: called with a place, and what unexpectedly went wrong there.
    """

    def __init__(self, body: RigidBody, background: Background, listener: SwitcherListener,
                 horizon_completed: Callable[[str, HorizonErrors], None],
                 failed: Callable[[str, BaseException], None]) -> None:
        self.successor: StandbyModel | None = None
        self.draft: StandbyModel | None = None
        """Of the successor whose hyperparameters are estimated from the initial window; it takes over before that."""
        self.shadows: dict[str, StandbyModel] = {}
        self._failed_shadows: set[str] = set()
        self._known: dict[tuple[object, ...], model_jobs.Known] = {}
        self.renewed = False
        """Whether hyperparameters are from a later window than the initial one."""
        self._body, self._background, self._listener = body, background, listener
        self._horizon_completed, self._failed = horizon_completed, failed

    @property
    def models(self) -> list[StandbyModel]:
        """Shadows, draft and successor."""
        return [*self.shadows.values(), *(model for model in (self.draft, self.successor) if model)]

    def urgency_of(self, model: StandbyModel) -> Urgency:
        """Shadows wait for those that are to take over."""
        return Urgency.TAKES_OVER if model in (self.successor, self.draft) else Urgency.SHADOW

    def offer(self, sample: Sample, learnt: int) -> None:
        """Let all of them see a sample."""
        if self.successor is None and self.draft is None and not self.shadows:
            return  # as nearly always
        for model in self.models:
            model.offer(sample, learnt)

    def clear_pending(self) -> None:
        """Forget half-finished horizons, as after a jump of the clock."""
        for model in self.models:
            model.clear_pending()

    def remember(self, settings: Settings, estimator: Estimator) -> None:
        """Keep hyperparameters for the next time the same model is wanted."""
        known = model_jobs.known_of(estimator)
        if known is not None and not settings.hyperparameters_sigma:
            self._known[_key(settings)] = known

    def finish_window(self, settings: Settings, estimator: Estimator) -> None:
        """Build the successor of a provisional model whose initial window is full: its draft first."""
        self.successor = self._new_model(settings)
        self.successor.wait_with(estimator)
        if not has_draft(settings.initial_samples):
            self.successor.finish_window()
            return
        self.draft = self._new_model(settings)
        self.draft.wait_with(estimator)
        self.draft.finish_window(draft=True)

    def renew(self, settings: Settings, history: History, window: RecentWindow) -> None:
        """Build a successor of the same settings with hyperparameters from a later window."""
        self.successor = self._new_model(settings)
        self.successor.start_renewed(history, window)

    def follow_renewed(self, settings: Settings, estimator: Estimator, history: History | None) -> None:
        """It has taken over: nothing else is to be built from the initial window; the shadows follow.

        :param history: None for a draft, which the shadows need not follow.
        """
        self.renewed = True
        self._known.clear()
        self.remember(settings, estimator)
        if history is not None:
            for name in list(self.shadows):
                self.shadows.pop(name).retire()
            self.set_shadows(settings, history)

    def appoint(self, settings: Settings, history: History) -> bool:
        """Let a shadow that learns this very model succeed, or build a successor; True when it took over at once."""
        self.retire_successor()
        shadow = self.shadows.get(settings.variant)
        if shadow is not None and same_model(shadow.settings, settings):
            self.successor = self.shadows.pop(settings.variant)
            shadow.hasten()
            if shadow.state is State.LIVE:
                self.on_live(shadow)
                return True
        else:
            self.successor = self._new_model(settings)
            self._start(self.successor, history)
        return False

    def set_shadows(self, settings: Settings, history: History, retry: bool = False) -> None:
        """Start the shadow variants that are wanted (``retry``: also those that failed), and retire the others."""
        self._failed_shadows = set() if retry else self._failed_shadows
        wanted = {name: replace(settings, variant=name)
                  for name in settings.shadow_variants if name != settings.variant}
        for name in list(self.shadows):
            if name not in wanted or not same_model(self.shadows[name].settings, wanted[name]):
                self.shadows.pop(name).retire()
        for name in [name for name in wanted if name not in self.shadows and name not in self._failed_shadows]:
            self.shadows[name] = self._new_model(wanted[name])
            self._start(self.shadows[name], history)

    def retire_successor(self) -> None:
        """It is no longer wanted, nor is its draft."""
        for model in (self.successor, self.draft):
            if model is not None:
                model.retire()
        self.successor = self.draft = None

    def retire_all(self, forget_hyperparameters: bool = False) -> None:
        """End them all."""
        self.retire_successor()
        for shadow in self.shadows.values():
            shadow.retire()
        self.shadows.clear()
        if forget_hyperparameters:
            self._known.clear()
            self.renewed = False

    def on_live(self, model: StandbyModel) -> None:
        """A model has seen every sample."""
        assert model.estimator is not None
        if model is self.draft:
            self._end_draft(model.estimator)
            return
        self.remember(model.settings, model.estimator)
        if model is self.successor:
            self.successor = None
            self._listener.successor_live(model.settings, model.estimator)

    def on_failed(self, model: StandbyModel, error: BaseException | None) -> None:
        """A model could not be built, or broke: it retires."""
        model.retire()
        if model is self.draft:  # what is wrong with the window the successor will tell
            self._end_draft(None)
            return
        sentence = sentence_of(error)
        if error is not None and not isinstance(error, SemiparamError):
            self._failed(f'the model {model.settings.variant} beside the active one', error)
        if model is self.successor:
            self.successor = None
            self._listener.successor_failed(model.settings, sentence)
        elif self.shadows.get(model.settings.variant) is model:
            del self.shadows[model.settings.variant]
            self._failed_shadows.add(model.settings.variant)
            self._listener.shadow_failed(model.settings, sentence)

    def _end_draft(self, estimator: Estimator | None) -> None:
        self.draft = None
        self._listener.draft_live(estimator)
        if self.successor is not None:
            self.successor.finish_window()

    def on_horizon(self, model: StandbyModel, errors: HorizonErrors) -> None:
        """A model completed horizon errors; those of a successor are of no interest yet."""
        if model is not self.successor and model is not self.draft:
            self._horizon_completed(model.settings.variant, errors)

    def _new_model(self, settings: Settings) -> StandbyModel:
        return StandbyModel(settings, self._body, self._background, self)

    def _start(self, model: StandbyModel, history: History) -> None:
        known = self._known.get(_key(model.settings))
        if known is None and self.renewed:
            model.start_renewed(history)
        else:
            model.start(history, known)


def sentence_of(error: BaseException | None) -> str:
    """Sentence on a failed job: our own sentences as they are, others by their type."""
    if isinstance(error, SemiparamError):
        return str(error).rstrip('.')
    return f'{type(error).__name__}: {error}' if error else 'no result'


def _key(settings: Settings) -> tuple[object, ...]:
    return tuple(getattr(settings, name) for name in HYPERPARAMETERS_DEPEND_ON)
