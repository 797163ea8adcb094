"""Mistakes of the set-up that the samples show: a sign, a unit or an order that is wrong, before anybody asks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from semiparam_ros.effects import Effect
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import diagnosis_jobs
from semiparam_ros.online.history import History
from semiparam_ros.online.learner import Learner
from semiparam_ros.online.worker import Background, Job
from semiparam_ros.settings.build import declared_effects

Problem = tuple[str, str | None]
"""What is wrong, and where."""


class SetupCheck:
    """Asks the process beside the node to look at the samples once a model answers, and again whenever there are twice
    as many of them, or other effects are declared.

    ``checked`` is how many samples the last look was given.

    :param failed: told of an error that is not expected.
    """

    def __init__(self, background: Background, failed: Callable[[str, BaseException], object]) -> None:
        self._background, self._failed = background, failed
        self._history: History | None = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._told: Mapping[Problem, str] = {}
        self._latest: Mapping[Problem, str] = {}
        self.checked = self._looked_at = 0
        self._declared = tuple[Effect, ...]()
        self._job: Job | None = None

    @property
    def problems(self) -> list[str]:
        """A sentence for each problem that two looks in a row have found: a short motion shows little."""
        return list(self._told.values())

    def look(self, learner: Learner) -> None:
        """Ask for a look, if one is due."""
        history, count = learner.history, len(learner.history)
        if history is not self._history or 2 * count < self._looked_at:  # after a reset; a full one lets a part go
            if self._job is not None:
                self._job.cancel()
            self._history = history
            self._begin_anew()
        declared = tuple(declared_effects(learner.settings))
        due = count >= 2 * self._looked_at or declared != self._declared
        if self._job is not None or not learner.estimator.ready or not (count and due):
            return
        samples = diagnosis_jobs.thinned(history.span(learner.settings.diagnosis_window), 1.0)
        if 2 * len(samples) < self.checked:  # the clock has jumped: so few would forget what more of them showed
            return
        if count < 2 * self._looked_at:  # the same samples are no second look
            self._latest = self._told
        self._looked_at, self._declared, changes = count, declared, learner.changes
        self._job = self._background.submit(
            diagnosis_jobs.setup_problems, learner.body, samples, declared, tuple(changes.applied.contributions),
            changes.contacts, done=partial(self._done, history, len(samples)))

    def _done(self, history: History, checked: int, found: Mapping[Problem, str] | None,
              error: BaseException | None) -> None:
        if history is not self._history:
            return
        self._job = None
        if error is not None and not isinstance(error, SemiparamError):
            self._failed('the check of the set-up', error)
        if found is not None:
            self.checked = checked
            self._told = {problem: found[problem] for problem in found if problem in self._latest}
            self._latest = found
