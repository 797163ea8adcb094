"""A model that learns beside the active one: a variant to compare it with, or the one that is to take its place."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.core.model import Estimator
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample
from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros import jobs
from semiparam_ros.ros.background import Background
from semiparam_ros.ros.history import Chapter, chapter_of
from semiparam_ros.settings.snapshot import Settings

INLINE_AT_MOST = 50
"""So many samples are caught up within one callback; more go to the background once again."""


class Understudy:
    """Built in the background from the samples so far; those that come meanwhile wait, and are learnt in order."""

    def __init__(self, settings: Settings, body: RigidBody, background: Background) -> None:
        self.settings, self.body = settings, body
        self.estimator: Estimator | None = None
        self.ready: Callable[[Understudy], None] = lambda _: None
        self.failed: Callable[[Understudy, str], None] = lambda _, sentence: None
        self.horizon: Callable[[str, HorizonErrors], None] = lambda _, errors: None
        self._background = background
        self._waiting: deque[tuple[Sample, bool]] = deque()
        self._working = self._dismissed = self._must_clear = False

    @property
    def live(self) -> bool:
        """Whether it has seen every sample so far."""
        return self.estimator is not None and not self._working

    def start(self, chapter: Chapter, known: jobs.Known | None) -> None:
        """Begin to build it."""
        self._working = True
        self._background.submit(jobs.build, self.settings, self.body, chapter, known, done=self._done)

    def offer(self, sample: Sample, learnt: bool) -> None:
        """Let it see the sample that the active model has just answered."""
        self._waiting.append((sample, learnt))
        if self.live:
            self._catch_up()

    def clear_pending(self) -> None:
        """Forget half-finished horizons, as after a jump of the clock."""
        self._must_clear = True
        self._clear()

    def dismiss(self) -> None:
        """Nobody needs it any more; what the background still does for it is dropped."""
        self._dismissed = True
        self.estimator = None

    def _done(self, estimator: Estimator | None, error: BaseException | None) -> None:
        self._working = False
        if self._dismissed:
            return
        if estimator is None:
            self._dismissed = True
            self.failed(self, sentence_of(error))
            return
        self.estimator = estimator
        self._clear()
        self._catch_up()
        if self.live:
            self.ready(self)

    def _catch_up(self) -> None:
        estimator = self.estimator
        assert estimator is not None
        if len(self._waiting) > INLINE_AT_MOST or completes_window(estimator, len(self._waiting)):
            self._work(estimator)
            return
        while self._waiting:
            sample, learnt = self._waiting.popleft()
            errors = estimator.step(sample, learnt).horizon
            if errors is not None:
                self.horizon(self.settings.variant, errors)

    def _work(self, estimator: Estimator) -> None:
        chapter = chapter_of(list(self._waiting))
        self._waiting.clear()
        self._working = True
        self._background.submit(jobs.absorb, estimator, chapter, done=self._done)

    def _clear(self) -> None:
        if self._must_clear and self.live and self.estimator is not None:
            self.estimator.clear_pending()
            self._must_clear = False


def completes_window(estimator: Estimator, further: int = 1) -> bool:
    """Whether so many further samples would end the initial window, which takes seconds."""
    return not estimator.ready and len(estimator.window) + further >= estimator.options.initial_samples


def sentence_of(error: BaseException | None) -> str:
    """What to tell of a failed job: our own sentences as they are, others by their kind."""
    if isinstance(error, SemiparamError):
        return str(error).rstrip('.')
    return f'{type(error).__name__}: {error}' if error else 'no result'
