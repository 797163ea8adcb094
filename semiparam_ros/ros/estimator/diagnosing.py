"""The services around a diagnosis of the latest samples: begin one, cancel it, declare what it found."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

from rclpy.node import Node
from std_msgs.msg import String

from semiparam_ros.effects import Effect, effects_to_parameters
from semiparam_ros.effects.base import spelling
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import diagnosis_jobs
from semiparam_ros.online.applied_effects import Contribution
from semiparam_ros.online.diagnosis_jobs import DiagnosisOutcome, Progress
from semiparam_ros.online.history import SampleBatch
from semiparam_ros.online.learner import Learner
from semiparam_ros.online.worker import Job, ProcessBackground, Scheduler
from semiparam_ros.ros.estimator.diagnostics import OK, InternalErrors, Report
from semiparam_ros.ros.estimator.parameters import Parameters
from semiparam_ros.ros.estimator.publishers import LATCHED
from semiparam_ros.ros.estimator.services import Reply, create_deferred_trigger, create_trigger, reason
from semiparam_ros.settings.build import declared_effects

Result = TypeVar('Result')
SURE = 12.0
"""[nat] So much worse must the effects of a diagnosis predict what came after it, and they are refused."""


class Running(NamedTuple):
    """A diagnosis that somebody waits for: of which samples, what was taken off them, beside which declared effects."""

    reply: Reply
    samples: SampleBatch
    taken_off: tuple[Contribution, ...]
    effects: tuple[Effect, ...]
    begun: float  # by time.monotonic
    job: Job


class Diagnosing:
    """``~/diagnose``, ``~/cancel_diagnosis`` and ``~/apply_diagnosis``; a report on the latched topic ``~/diagnosis``
    (JSON), and what is being tried on ``~/diagnosis_progress``.

    A process of its own does the work, so that a model being built does not wait for it. Before it begins it looks how
    much of a processor it gets, and takes as many samples as that allows.

    :param schedule: see :data:`Scheduler`.
    :param errors: counts what goes wrong unexpectedly.
    """

    def __init__(self, node: Node, parameters: Parameters, learner: Callable[[], Learner],
                 schedule: Scheduler, errors: InternalErrors) -> None:
        self._node, self._parameters, self._learner, self._schedule = node, parameters, learner, schedule
        self._errors = errors
        self._background: ProcessBackground | None = None
        self._running: Running | None = None
        self._stage, self._left_s = 'none has been asked for.', 0.0
        self._outcome: DiagnosisOutcome | None = None
        self._examined: tuple[Effect, ...] = ()
        self._until = 0
        """[ns] Stamp of the last sample that the last diagnosis looked at."""
        self._report = node.create_publisher(String, '~/diagnosis', LATCHED)
        self._progress = node.create_publisher(String, '~/diagnosis_progress', 10)
        create_deferred_trigger(node, '~/diagnose', self._diagnose)
        create_trigger(node, '~/cancel_diagnosis', self.cancel)
        self._end_applying = create_deferred_trigger(node, '~/apply_diagnosis', self._apply)

    def close(self) -> None:
        """End the process, whatever it is doing."""
        if self._running is not None:
            self.cancel()
        self._end_applying()
        if self._background is not None:
            self._background.close()

    def report(self) -> Report:
        """Report of how far one is, or how the last one ended."""
        if self._running is None:
            return Report(OK, self._stage, {'running': False})
        elapsed = time.monotonic() - self._running.begun
        return Report(OK, self._stage, {'running': True, 'elapsed [s]': round(elapsed, 1),
                                        'expected to take yet [s]': round(self._left_s, 1)})

    def _apply(self, reply: Reply) -> None:
        """Declare the effects of the last diagnosis, unless what came since is better predicted without them."""
        found = self._found()
        if isinstance(found, str):
            reply(found)
            return
        learner = self._learner()
        samples = learner.history.span(self._parameters.settings.diagnosis_window)
        assert self._background is not None  # it has made the diagnosis
        looked_at = diagnosis_jobs.thinned(samples, 1.0)
        self._background.submit(diagnosis_jobs.gain_since, learner.body, looked_at, self._until, self._examined,
                                found.effects, tuple(learner.changes.applied.contributions),
                                learner.changes.contacts,
                                done=partial(self._declare, reply, found))

    def _declare(self, reply: Reply, found: DiagnosisOutcome, gain: float | None, error: BaseException | None) -> None:
        try:
            if error is not None:
                raise error
            now = self._found()
            if isinstance(now, str):
                reply(now)
                return
            if now is not found:
                raise SemiparamError('there is another diagnosis by now; look at it, then apply it.')
            if gain is not None and gain < -SURE:
                raise SemiparamError(f'what came since the diagnosis is better predicted without the effects that it '
                                     f'found, by {-gain:.0f} nat: the robot has changed, or they held for '
                                     'the motion before alone; ~/diagnose looks again.')
            reply(self._applied(found))
        except Exception as failure:
            reply(reason('~/apply_diagnosis', failure, self._errors), success=False)

    def _found(self) -> DiagnosisOutcome | str:
        """The last diagnosis that can be applied, or a sentence where nothing is left to do."""
        if self._running is not None:
            raise SemiparamError('a diagnosis is running; wait for its answer, then apply it.')
        if self._outcome is None:
            raise SemiparamError('there is no diagnosis yet; ~/diagnose makes one.')
        if self._outcome.effects == self._examined:
            return 'the last diagnosis found nothing to add.'
        declared = tuple(declared_effects(self._parameters.settings))
        if self._outcome.effects == declared:
            return f'the effects of the last diagnosis are declared already: {_listed(declared)}.'
        if declared != self._examined:
            raise SemiparamError('the effects have changed since the last diagnosis, which looked for what is missing '
                                 f'beside {_listed(self._examined)}; ~/diagnose looks again.')
        return self._outcome

    def _applied(self, found: DiagnosisOutcome) -> str:
        values = zip(('effects', 'effects_reference'), effects_to_parameters(found.effects), strict=True)
        result = self._node.set_parameters_atomically([self._parameters.ros_parameter(*value) for value in values])
        if not result.successful:
            raise SemiparamError(result.reason)
        return f'effects are now {_listed(found.effects)}; {result.reason}'

    def cancel(self) -> str:
        """Give up the one that is running; what the one before found stays."""
        if self._running is None:
            raise SemiparamError('no diagnosis is running.')
        self._running.job.cancel()
        self._end('the last one was cancelled.')('the diagnosis was cancelled.', success=False)
        return f'the diagnosis is cancelled; {"there is none" if self._outcome is None else "that before it stays"}.'

    def _diagnose(self, reply: Reply) -> None:
        learner = self._learner()
        if self._running is not None:
            raise SemiparamError('a diagnosis is running already; wait for its answer, or call ~/cancel_diagnosis.')
        samples = learner.history.span(self._parameters.settings.diagnosis_window)
        if not len(samples):
            raise SemiparamError('there are no samples to diagnose yet.')
        if self._background is None:
            self._background = ProcessBackground(self._schedule, self._tell)
        job = self._background.submit(diagnosis_jobs.processor_share, done=partial(self._then, self._look))
        # Those that are wanted now, whether their model answers already or is still being built.
        effects = tuple(declared_effects(self._parameters.settings))
        taken_off = tuple(learner.changes.applied.contributions)
        self._running = Running(reply, samples, taken_off, effects, time.monotonic(), job)
        self._tell(Progress('begins', diagnosis_jobs.expected_s(min(len(samples), diagnosis_jobs.SAMPLES_AT_MOST))))

    def _then(self, follow: Callable[[Result], None], result: Result | None, error: BaseException | None) -> None:
        """Go on with what the process gave; whatever goes wrong is the answer."""
        try:
            if result is None:
                raise error or SemiparamError('the background process gave no result.')
            follow(result)
        except Exception as failure:
            sentence = reason('~/diagnose', failure, self._errors)
            self._node.get_logger().info(f'the diagnosis is over: {sentence}')
            self._end(f'nothing came of the last one: {sentence}')(sentence, success=False)

    def _look(self, share: float) -> None:
        """At as many of the samples as the share of a processor allows."""
        assert self._running is not None and self._background is not None
        samples = self._running.samples
        part = diagnosis_jobs.thinned(samples, share)
        looked = _looked(samples, part)
        if len(part) < len(diagnosis_jobs.thinned(samples, 1.0)):
            looked += f', as it gets {share:.0%} of a processor'
        learner = self._learner()
        contacts = learner.changes.contacts
        looked += _left_out(samples, contacts)
        job = self._background.submit(diagnosis_jobs.diagnose, learner.body, part, self._running.effects,
                                      self._running.taken_off, contacts,
                                      done=partial(self._then, partial(self._conclude, looked)))
        self._running = self._running._replace(job=job)
        self._node.get_logger().info(f'a diagnosis looks at {looked}, in a process beside the node.')
        self._tell(Progress(f'looks at {looked}', diagnosis_jobs.expected_s(len(part)) / share))

    def _conclude(self, looked: str, outcome: DiagnosisOutcome) -> None:
        assert self._running is not None
        effects, (head, *found) = self._running.effects, outcome.summary
        answer = '\n'.join([f'With {_listed(effects)} declared: {head}', *found, 'Details:',
                            f'It looked at {looked}.', *outcome.words])
        report = json.dumps({'schema': 1, 'looked_at': looked, **outcome.report})
        self._node.get_logger().info(f'the diagnosis is over. {answer}')
        self._outcome, self._examined = outcome, effects
        self._until = int(self._running.samples.stamps[-1])
        self._report.publish(String(data=report))
        self._end(f'the last one: {head}')(answer)

    def _tell(self, progress: Progress) -> None:
        self._stage, self._left_s = f'{progress.words}; about {progress.left_s:.0f} s left.', progress.left_s
        self._progress.publish(String(data=self._stage))

    def _end(self, stage: str) -> Reply:
        """Nothing runs any more; who waits for the answer."""
        ended, self._running = self._running, None
        assert ended is not None
        self._stage = stage
        self._progress.publish(String(data=stage))
        return ended.reply


def _looked(samples: SampleBatch, part: SampleBatch) -> str:
    """Sentence on the samples that a diagnosis looks at."""
    seconds = (samples.stamps[-1] - samples.stamps[0]) * 1e-9
    return f'{len(part)} of {len(samples)} samples, evenly spread over {seconds:.0f} s'


def _left_out(samples: SampleBatch, contacts: Sequence[tuple[int, int]]) -> str:
    """Words on the stretches [ns] of them in which the robot was touched; '' without any."""
    begin, end = (int(stamp) for stamp in samples.stamps[[0, -1]])
    seconds = sum(max(min(last, end) - max(first, begin), 0) for first, last in contacts) * 1e-9
    return f', but for {seconds:.1f} s of contacts' if seconds > 0.0 else ''


def _listed(effects: tuple[Effect, ...]) -> str:
    """Kinds and places, without their values."""
    return ', '.join(spelling(effect.kind, effect.where) for effect in effects) or 'no effects'
