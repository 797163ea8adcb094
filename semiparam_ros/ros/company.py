"""The models beside the active one: its successor while that is being built, and the shadow variants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.model import Estimator
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.ros import jobs
from semiparam_ros.ros.background import Background
from semiparam_ros.ros.history import History
from semiparam_ros.ros.understudy import Understudy
from semiparam_ros.settings.snapshot import Settings

MODEL_PARAMETERS = ('variant', 'effects', 'noise', 'forgetting', 'horizon_length')
"""Fields whose change needs another model."""

HYPERPARAMETERS_DEPEND_ON = ('variant', 'effects', 'noise')


def same_model(one: Settings, other: Settings) -> bool:
    """Whether both settings describe the same model."""
    return all(getattr(one, name) == getattr(other, name) for name in MODEL_PARAMETERS)


class Company:
    """Builds and feeds understudies.

    :param takes_over: receives the successor once it has caught up.
    :param failed: receives the settings that could not be built, and why.
    :param horizon: receives a shadow variant and the horizon errors that it completed.
    """

    def __init__(self, body: RigidBody, background: Background, takes_over: Callable[[Understudy], None],
                 failed: Callable[[Settings, str], None], horizon: Callable[[str, HorizonErrors], None]) -> None:
        self.successor: Understudy | None = None
        self.shadows: dict[str, Understudy] = {}
        self._hopeless: set[str] = set()
        self._known: dict[tuple[object, ...], jobs.Known] = {}
        self._body, self._background = body, background
        self._takes_over, self._failed, self._horizon = takes_over, failed, horizon

    @property
    def all(self) -> list[Understudy]:
        """Successor and shadows."""
        return [*self.shadows.values(), *([self.successor] if self.successor else [])]

    def offer(self, sample: Sample, learnt: bool) -> None:
        """Let all of them see a sample."""
        for understudy in self.all:
            understudy.offer(sample, learnt)

    def remember(self, settings: Settings, estimator: Estimator) -> None:
        """Keep hyperparameters for the next time the same model is wanted."""
        known = jobs.known_of(estimator)
        if known is not None and not settings.hyperparameters_sigma:
            self._known[_key(settings)] = known

    def appoint(self, settings: Settings, history: History) -> Understudy:
        """The successor: a shadow that already learns the same model, or one to be built now."""
        shadow = self.shadows.get(settings.variant)
        if shadow is not None and same_model(shadow.settings, settings):
            del self.shadows[settings.variant]
            successor = shadow
        else:
            successor = Understudy(settings, self._body, self._background)
        self.successor = successor
        successor.ready, successor.failed = self._takes_over, self._successor_failed
        if successor.live:
            self._takes_over(successor)
        elif successor is not shadow:
            self._start(successor, history)
        return successor

    def set_shadows(self, settings: Settings, history: History, retry: bool = False) -> None:
        """Start the shadow variants that are wanted (``retry``: also those that failed), and end the others."""
        self._hopeless = set() if retry else self._hopeless
        wanted = {name: replace(settings, variant=name)
                  for name in settings.shadow_variants if name != settings.variant}
        for name in list(self.shadows):
            if name not in wanted or not same_model(self.shadows[name].settings, wanted[name]):
                self.shadows.pop(name).dismiss()
        for name in wanted.keys() - self.shadows.keys() - self._hopeless:
            self.shadows[name] = shadow = Understudy(wanted[name], self._body, self._background)
            shadow.ready, shadow.failed, shadow.horizon = self._shadow_ready, self._shadow_failed, self._horizon
            self._start(shadow, history)

    def dismiss_successor(self) -> None:
        """It is no longer wanted."""
        if self.successor is not None:
            self.successor.dismiss()
            self.successor = None

    def dismiss(self, forget_hyperparameters: bool = False) -> None:
        """End them all."""
        for understudy in self.all:
            understudy.dismiss()
        self.successor = None
        self.shadows.clear()
        if forget_hyperparameters:
            self._known.clear()

    def _start(self, understudy: Understudy, history: History) -> None:
        understudy.start(history.chapter(), self._known.get(_key(understudy.settings)))

    def _successor_failed(self, understudy: Understudy, sentence: str) -> None:
        self.successor = None
        self._failed(understudy.settings, sentence)

    def _shadow_ready(self, understudy: Understudy) -> None:
        if understudy.estimator is not None:
            self.remember(understudy.settings, understudy.estimator)

    def _shadow_failed(self, understudy: Understudy, sentence: str) -> None:
        self.shadows.pop(understudy.settings.variant, None)
        self._hopeless.add(understudy.settings.variant)
        self._failed(understudy.settings, sentence)


def _key(settings: Settings) -> tuple[object, ...]:
    return tuple(getattr(settings, name) for name in HYPERPARAMETERS_DEPEND_ON)
