"""What the node says of itself on /diagnostics, once a second (REP 107)."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from semiparam_ros.core.horizon import HorizonErrors
from semiparam_ros.ros.answers import Answer
from semiparam_ros.ros.estimates import quantities
from semiparam_ros.ros.excitation import Excitation, conditioning
from semiparam_ros.ros.inputs import Inputs
from semiparam_ros.ros.internal_errors import InternalErrors
from semiparam_ros.ros.learner import Learner
from semiparam_ros.ros.model_switcher import State
from semiparam_ros.ros.refusals import Refusals

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
SILENCE_S = 1.0
IMPLAUSIBLE = 3.0
"""Root mean square of standardised innovations above which the model does not describe the robot."""


class Report(NamedTuple):
    """One status: how serious, in words, and its figures."""

    level: bytes
    message: str
    values: Mapping[str, Any]


class Tally:
    """What is counted between two reports."""

    def __init__(self, joints: tuple[str, ...]) -> None:
        self.excitation = Excitation(joints)
        self.errors: HorizonErrors | None = None
        self.answers = 0
        self._squares = 0.0

    def add(self, answer: Answer) -> None:
        """One answer has gone out."""
        prediction = answer.prediction
        self.excitation.add(prediction.sample)
        if prediction.ready:
            self.answers += 1
            self._squares += answer.innovation**2

    def innovation(self) -> float | None:
        """Root mean square of the standardised innovations since the last call."""
        result = (self._squares / self.answers) ** 0.5 if self.answers else None
        self.answers, self._squares = 0, 0.0
        return result


class InputReport:
    """Rates, silence, and what was refused."""

    def __init__(self, inputs: Inputs, refusals: Refusals) -> None:
        self._inputs, self._refusals = inputs, refusals
        self._since = time.monotonic()
        self._before: Counter[str] = Counter()
        self._refused = self._elsewhere = 0
        self._last = ''

    def make(self) -> Report:
        """Since the last report."""
        now, counts = time.monotonic(), self._inputs.counts
        span, self._since = max(now - self._since, 1e-9), now
        values: dict[str, Any] = {}
        for topic in self._inputs.topics:
            values[f'{topic} rate [Hz]'] = round((counts[topic] - self._before[topic]) / span, 1)
            values[f'{topic} received'] = counts[topic]
            values[f'{topic} publishers'] = self._inputs.publishers(topic)
        self._before = Counter(counts)
        stream = self._inputs.stream
        faults: Counter[str] = stream.faults if stream else Counter()
        values |= {f'refused: {reason}': count for reason, count in sorted((faults + self._refusals.counts).items())}
        self._last, self._elsewhere = self._latest(sum(faults.values())), self._refusals.on_topics
        values['last refusal'] = self._last
        values['ignored: other_joints'] = stream.strangers if stream else 0
        values['waiting for their counterpart'] = stream.pending if stream else 0
        values['lost before the robot was known'] = counts['given up']
        return self._judged(now, sum(faults.values()) + self._refusals.on_topics, values)

    def _latest(self, in_stream: int) -> str:
        if self._refusals.on_topics > self._elsewhere:
            return self._refusals.last
        stream = self._inputs.stream
        return stream.last_fault if stream and in_stream > self._refused - self._elsewhere else self._last

    def _judged(self, now: float, refused: int, values: Mapping[str, Any]) -> Report:
        news, self._refused = refused - self._refused, refused
        silent = [topic for topic in self._inputs.needed if topic in self._inputs.arrived
                  and now - self._inputs.arrived[topic] > SILENCE_S]
        absent = [topic for topic in self._inputs.needed if topic not in self._inputs.arrived]
        if absent:
            stream = self._inputs.stream
            others = f' Ignored: {stream.last_stranger}' if stream and stream.last_stranger else ''
            return Report(WARN, f'nothing received on {", ".join(absent)} yet.{others}', values)
        if silent:
            return Report(WARN, f'nothing received on {", ".join(silent)} for more than {SILENCE_S:g} s.', values)
        if news > 0:
            return Report(WARN, f'{news} messages refused in the last second: {values["last refusal"]}', values)
        return Report(OK, 'receiving.', values)


def timing_report(inputs: Inputs) -> Report:
    """From the arrival of the message that completes a sample to its answer."""
    latency = inputs.stopwatch.quantiles_ms()
    if latency is None:
        return Report(OK, 'no answer yet.', {})
    names = ('latency median [ms]', 'latency p99 [ms]', 'latency max [ms]')
    return Report(OK, 'answering.', {name: round(value, 3) for name, value in zip(names, latency, strict=True)})


def learning_report(learner: Learner, news: str) -> Report:
    """Which model answers, and whether it learns."""
    level, message = _learning_state(learner)
    values = {
        'variant': learner.built.variant, 'effects': ', '.join(learner.built.effects),
        'shadow variants': ', '.join(name for name, shadow in learner.switcher.shadows.items()
                                     if shadow.state is State.LIVE),
        'samples answered': learner.answered, 'samples learnt': learner.learnt, 'samples waiting': len(learner.waiting),
        'samples lost': learner.lost, 'samples not learnt for contact': learner.gate.refused,
        'in contact': learner.gate.closed, 'last news': news}
    return Report(level, message, values)


def _learning_state(learner: Learner) -> tuple[bytes, str]:
    successor, estimator = learner.switcher.successor, learner.estimator
    if learner.lost:
        return ERROR, f'{learner.lost} samples lost: the machine is too slow for their rate.'
    if learner.busy:
        return OK, f'estimating hyperparameters; {len(learner.waiting)} samples wait.'
    if not learner.settings.learning:
        return WARN, 'paused: predicting without learning.'
    if learner.gate.closed:
        return OK, 'in contact: predicting without learning.'
    if successor is not None:
        return OK, f'learning with {learner.built.variant}; {successor.settings.variant} is being built.'
    if not estimator.ready:
        return OK, (f'gathering the initial window: {len(estimator.window)} of {learner.built.initial_samples} '
                    'samples.')
    return OK, f'learning with {learner.built.variant}.'


def model_report(learner: Learner, tally: Tally) -> Report:
    """Health of the model, horizon errors, excitation and conditioning."""
    innovation, sentences = tally.innovation(), tally.excitation.sentences()
    values: dict[str, Any] = {'standardised innovation (rms)': '' if innovation is None else round(innovation, 3)}
    if tally.errors is not None:
        values |= {f'horizon error {name}': f'{error:.3g}' for name, error in
                   zip(learner.body.output_names, tally.errors.eps, strict=True)}
    condition = conditioning(learner.estimator.model, learner.estimator.columns.prior_scale)
    if condition is not None:
        values |= {'condition number': f'{condition.number:.3g}',
                   'undetermined directions': f'{condition.undetermined} of {condition.columns}'}
    values |= {f'excitation {index}': sentence for index, sentence in enumerate(sentences)}
    if innovation is not None and innovation > IMPLAUSIBLE:
        return Report(WARN, f'the outputs lie {innovation:.1f} predicted standard deviations off: the robot has '
                            'changed, or is touched.', values)
    if sentences:
        return Report(WARN, f'{sentences[0]}.', values)
    return Report(OK, 'the outputs are as predicted.' if innovation is not None else 'no prediction yet.', values)


def errors_report(errors: InternalErrors) -> Report:
    """What went wrong in the node itself, by its place."""
    values: dict[str, Any] = {f'internal errors: {place}': count for place, count in sorted(errors.counts.items())}
    values |= {'internal errors': errors.counts.total(), 'last internal error': errors.last}
    return Report(ERROR if errors.counts else OK, errors.last or 'no internal error.', values)


def parameters_report(learner: Learner) -> Report:
    """Every coefficient with its standard deviation."""
    found = quantities(learner.estimator)
    values = {entry.name: f'{entry.value:.6g} +- {entry.std:.2g} {entry.unit}' for entry in found}
    return Report(OK, f'{len(found)} coefficients.', values)


def status(name: str, hardware_id: str, report: Report) -> DiagnosticStatus:
    """The message of one report."""
    values = [KeyValue(key=key, value=str(value)) for key, value in report.values.items()]
    return DiagnosticStatus(level=report.level, name=name, message=report.message, hardware_id=hardware_id,
                            values=values)
