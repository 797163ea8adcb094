"""Reports of the node on itself: every status once a second on /diagnostics (REP 107), and the
payload."""

from __future__ import annotations

import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import InertiaStamped
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.node import Node

from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.errors import listed, shortened
from semiparam_ros.online.contact_gate import ContactGate
from semiparam_ros.online.feedforward import Feedforward
from semiparam_ros.online.history import History
from semiparam_ros.online.identified_parameters import (
    MOVED_ENOUGH,
    CarriedLoad,
    Excitation,
    LearntCoefficient,
    Load,
    carried_load,
    conditioning,
    quantities,
    reported_load,
)
from semiparam_ros.online.learner import Answer, Learner
from semiparam_ros.online.model_switcher import State
from semiparam_ros.ros.context import steady_timer
from semiparam_ros.ros.estimator.consistent import ConsistentBodies, ConsistentTopic
from semiparam_ros.ros.estimator.publishers import inertia_message
from semiparam_ros.ros.estimator.setup_check import SetupCheck
from semiparam_ros.ros.estimator.subscriptions import ACCELERATIONS, WRENCH, InputStream

DESCRIPTION, PARAMETERS = 'robot_description', 'parameters'
CHECKPOINTS = 'checkpoints'
NO_MESSAGES = PARAMETERS, CHECKPOINTS
"""What is refused there came on no topic, and is told elsewhere."""

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
SILENCE_S = 1.0
LATE_S = 1.0
TEMPERATURE_SILENCE_S = 60.0
IMPLAUSIBLE = 3.0
"""Root mean square of standardised innovations above which the model does not describe the robot."""
REPORTS = 10
"""So many reports, one a second, are looked at together: from second to second that figure goes up and down."""

PERIOD_S = 1.0


class Rejections:
    """Counts by where they came in, and the last sentence of a topic."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.last = ''
        self.sentences: dict[str, str] = {}
        """The last one of each topic."""

    def add(self, where: str, sentence: str) -> None:
        """One more."""
        self.counts[where] += 1
        if where not in NO_MESSAGES:
            self.last = self.sentences[where] = shortened(sentence)

    @property
    def on_topics(self) -> Counter[str]:
        """Numbers of messages refused, by topic."""
        return Counter({where: count for where, count in self.counts.items() if where not in NO_MESSAGES})


class InternalErrors:
    """Counts for /diagnostics, and the log.

    :param log: receives a text that must be seen. :param again: receives the sentence of an error seen before.
    """

    def __init__(self, log: Callable[[str], object], again: Callable[[str], object]) -> None:
        self.counts: Counter[str] = Counter()
        self.last = ''
        self._log, self._again = log, again
        self._seen: set[str] = set()

    def add(self, place: str, error: BaseException) -> str:
        """One more; returns its sentence. The first of its kind goes into the log with its traceback."""
        sentence = f'internal error at {place}, {type(error).__name__}: {error!s:.300}'
        self.counts[place] += 1
        self.last = sentence
        text = ''.join(traceback.format_exception(type(error), error, error.__traceback__))
        kind = f'{place} {type(error).__name__} {_innermost(error)}'
        if kind in self._seen:
            self._again(sentence)
        else:
            self._seen.add(kind)
            self._log(f'{sentence}\n{text}')
        return sentence


def _innermost(error: BaseException) -> str:
    """File and line where it was raised."""
    frames = traceback.extract_tb(error.__traceback__)
    return f'{frames[-1].filename}:{frames[-1].lineno}' if frames else ''


class Report(NamedTuple):
    """One status: how serious, in words, and its figures."""

    level: bytes
    message: str
    values: Mapping[str, object]


class Tally:
    """Counts between two reports."""

    def __init__(self, joints: tuple[str, ...]) -> None:
        self.excitation = Excitation(joints)
        self.errors: HorizonErrors | None = None
        self.stamp: int | None = None
        """Of the latest answer [ns]."""
        self.answers = 0
        self._squares = 0.0
        self._innovations: deque[float] = deque(maxlen=REPORTS)

    def add(self, answer: Answer) -> None:
        """One answer has gone out."""
        prediction = answer.prediction
        self.excitation.add(prediction.sample)
        self.stamp = prediction.sample.stamp
        if prediction.ready:
            self.answers += 1
            self._squares += answer.innovation**2

    def innovation(self) -> float | None:
        """Root mean square of the standardised innovations since the last call."""
        result = (self._squares / self.answers) ** 0.5 if self.answers else None
        self.answers, self._squares = 0, 0.0
        self._innovations.append(result or 0.0)
        return result

    @property
    def worst(self) -> float:
        """The largest of the latest innovations told."""
        return max(self._innovations, default=0.0)


class InputReport:
    """Rates, silence, and what was refused.

    :param warn: receives the first sentence of each reason for which messages are refused.
    """

    def __init__(self, inputs: InputStream, rejections: Rejections, warn: Callable[[str], object]) -> None:
        self._inputs, self._rejections, self._warn = inputs, rejections, warn
        self._since = time.monotonic()
        self._before: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._warned: set[str] = set()
        self._elsewhere = 0
        self._last = ''

    def make(self) -> Report:
        """Since the last report."""
        now, counts = time.monotonic(), self._inputs.counts
        span, self._since = max(now - self._since, 1e-9), now
        values: dict[str, object] = {}
        for topic in self._inputs.topics:
            values[f'{topic} rate [Hz]'] = round((counts[topic] - self._before[topic]) / span, 1)
            values[f'{topic} received'] = counts[topic]
            values[f'{topic} publishers'] = self._inputs.publishers(topic)
        self._before = Counter(counts)
        stream = self._inputs.stream
        faults: Counter[str] = stream.faults if stream else Counter()
        values |= {f'refused: {reason}': count for reason, count in sorted((faults + self._rejections.counts).items())}
        elsewhere = self._rejections.on_topics
        refused = faults + elsewhere
        for reason in (+faults).keys() - self._warned:  # a count goes back to 0 when the clock turns out to have jumped
            assert stream is not None  # it counts them
            self._warned.add(reason)
            self._warn(f'refused: {stream.sentences[reason]} Further ones of this kind are counted on /diagnostics.')
        news, self._refused = refused - self._refused, refused
        self._last, self._elsewhere = self._latest(elsewhere.total(), bool(news)), elsewhere.total()
        values['last refusal'] = self._last
        values['ignored: other_joints'] = stream.ignored if stream else 0
        values['waiting for their counterpart'] = stream.pending if stream else 0
        values['lost before the robot was known'] = counts['given up']
        return self._judged(now, news, values)

    def _latest(self, elsewhere: int, is_new: bool) -> str:
        if elsewhere > self._elsewhere:
            return self._rejections.last
        stream = self._inputs.stream
        return stream.last_fault if stream and is_new else self._last

    def _judged(self, now: float, news: Counter[str], values: Mapping[str, object]) -> Report:
        silent = [topic for topic in self._inputs.needed if topic in self._inputs.arrived
                  and now - self._inputs.arrived[topic] > SILENCE_S]
        absent = [topic for topic in self._inputs.needed if topic not in self._inputs.arrived]
        refusals = self._refusals(news) if news else ''
        more = self._ignored() + (f' {refusals}' if news else '')  # it is news this once, beside a silence too
        if absent:
            remedy = ' The joint states hold efforts: outputs: effort predicts those.'
            remedy = remedy if WRENCH in absent and self._inputs.has_efforts else ''
            return Report(WARN, f'nothing received on {", ".join(absent)} yet.{more}{remedy}', values)
        if silent:
            return Report(WARN, f'nothing received on {", ".join(silent)} for more than {SILENCE_S:g} s.{more}', values)
        if news:
            return Report(WARN, refusals, values)
        cold = [name for name, last in self._inputs.temperatures.items() if now - last > TEMPERATURE_SILENCE_S]
        if cold:
            return Report(WARN, f'no temperature of {listed(cold)} for more than {TEMPERATURE_SILENCE_S:g} s; answers '
                                f'go on with the last one.{self._ignored()}', values)
        stream = self._inputs.stream
        estimated = stream is not None and not stream.velocities_measured
        late = stream is not None and not stream.takes_accelerations and self._inputs.counts[ACCELERATIONS] > 0
        told = ['receiving', *['velocities are estimated from the positions'] * estimated,
                *['joint_accelerations came after the first joint state, and are not used'] * late]
        return Report(OK, f'{"; ".join(told)}.', values)

    def _refusals(self, news: Counter[str]) -> str:
        """Refusals since the last report: the last sentence of each reason."""
        stream = self._inputs.stream
        sentences = {**(stream.sentences if stream else {}), **self._rejections.sentences}
        told = [(f'{count} {reason}: ' if len(news) > 1 else '') + sentences[reason]
                for reason, count in sorted(news.items())]
        many = [f'{count} publish on {topic}.' for topic in self._inputs.topics
                if (count := self._inputs.publishers(topic)) > 1]
        return f'{news.total()} messages refused in the last second: {" ".join([*told, *many])}'

    def _ignored(self) -> str:
        stream = self._inputs.stream
        return f' Ignored: {stream.last_ignored}' if stream and stream.last_ignored else ''


class TimingReport:
    """From the arrival of the message that completes a sample to its answer; what waits, and what was given up.

    :param say: receives a sentence when answers begin to be late, and when they are in time again.
    """

    def __init__(self, inputs: InputStream, say: Callable[[str], None]) -> None:
        self._inputs, self._say = inputs, say
        self._lost, self._is_late = 0, False

    def make(self) -> Report:
        """Now."""
        turns, latency = self._inputs.turns, self._inputs.stopwatch.quantiles_ms()
        new, self._lost = turns.lost - self._lost, turns.lost
        values: dict[str, object] = {'messages waiting': len(turns), 'messages lost': turns.lost}
        if latency is not None:
            names = ('latency median [ms]', 'latency p99 [ms]', 'latency max [ms]')
            values |= {name: round(value, 3) for name, value in zip(names, latency, strict=True)}
        late = turns.late_s
        self._tell(late)
        if new:
            return Report(ERROR, f'{new} messages lost: they come faster than they are answered, and {len(turns)} wait '
                                 'already.', values)
        if late > LATE_S:
            return Report(WARN, f'answers are {late:.1f} s late: messages come faster than they are answered, and '
                                f'{len(turns)} wait.', values)
        return Report(OK, 'answering.' if latency is not None else 'no answer yet.', values)

    def _tell(self, late: float) -> None:
        """Once when it begins, and once when all that waited is answered."""
        if late > LATE_S and not self._is_late:
            self._is_late = True
            self._say(f'messages come faster than they are answered: answers are {late:.1f} s late.')
        elif self._is_late and not len(self._inputs.turns):
            self._is_late = False
            self._say('answers are in time again.')


def learning_report(learner: Learner, news: str) -> Report:
    """Report of which model answers, and whether it learns."""
    level, message = _learning_state(learner)
    values = {
        'variant': learner.built.variant, 'random features': learner.estimator.features_count,
        'effects': ', '.join(learner.built.effects),
        'shadow variants': ', '.join(name for name, shadow in learner.switcher.shadows.items()
                                     if shadow.state is State.LIVE),
        'samples answered': learner.answered, 'samples learnt': learner.learnt,
        'samples passed over': learner.passed_over,
        'samples not learnt': learner.answered - learner.learnt - learner.passed_over,
        'samples of motion in the initial window': '' if learner.estimator.ready else len(learner.estimator.window),
        'samples from each window to its takeover': ','.join(map(str, learner.takeovers)),
        'samples not answered': learner.lost, 'samples not learnt for contact': learner.gate.refused,
        'in contact': learner.gate.closed, 'contacts': learner.gate.contacts,
        'contacts taken for a change of the robot': learner.gate.changes,
        'contact felt in': ', '.join(learner.body.output_names[index] for index in learner.gate.touched()),
        'contact at': _place_of(learner.gate),
        'last news': news}
    return Report(level, message, values)


def _place_of(gate: ContactGate) -> str:
    """The link that is touched most probably; '' without a contact."""
    probabilities, seconds = gate.places()
    if gate.place is None or not probabilities.any():
        return ''
    best = int(probabilities.argmax())
    return f'{gate.place.links[best]} ({probabilities[best]:.0%}), for {seconds:.1f} s'


def stage_of(learner: Learner | None) -> str:
    """The part of its life that the node is in, as a line for the log."""
    if learner is None:
        return 'waiting for a robot description.'
    if learner.estimating:
        return f'estimating the hyperparameters of {learner.built.variant}.'
    if not learner.estimator.ready:
        return f'gathering the initial window of {learner.built.initial_samples} samples of motion.'
    if not learner.settings.learning:
        return 'paused: predicting without learning.'
    return f'ready: {learner.built.variant} predicts and learns.'


def _learning_state(learner: Learner) -> tuple[bytes, str]:
    successor, estimator = learner.switcher.successor, learner.estimator
    if learner.lost:
        return ERROR, f'{learner.lost} samples not answered: the model failed on them, see the status errors.'
    if not learner.settings.learning:
        return WARN, 'paused: predicting without learning.'
    if learner.gate.closed:
        return OK, 'in contact: predicting without learning.'
    if learner.estimating:
        return OK, f'estimating hyperparameters of {learner.built.variant}; the rigid body answers.'
    if successor is not None:
        return OK, f'learning with {learner.built.variant}; {successor.settings.variant} is being built.'
    if not estimator.ready:
        return OK, (f'gathering the initial window: {len(estimator.window)} of {learner.built.initial_samples} '
                    f'samples of motion{_unmoved(learner)}.')
    return OK, f'learning with {learner.built.variant}.'


def _unmoved(learner: Learner) -> str:
    """Joints that the initial window has not seen move yet, in words."""
    joints = [learner.body.joints[index] for index in
              learner.estimator.window.unmoved(learner.body.n_joints, MOVED_ENOUGH)]
    if not joints or learner.history.latest() is None:
        return ''
    if len(joints) == learner.body.n_joints:
        return '; no joint has moved yet'
    return f'; {listed(joints)} {"has" if len(joints) == 1 else "have"} not moved yet'


def model_report(learner: Learner, tally: Tally) -> Report:
    """Health of the model, horizon errors, excitation and conditioning."""
    innovation, sentences = tally.innovation(), tally.excitation.sentences(learner.body.prismatic)
    values: dict[str, object] = {'standardised innovation (rms)': '' if innovation is None else round(innovation, 3)}
    if tally.errors is not None:
        values |= {f'horizon error {name}': f'{error:.3g}' for name, error in
                   zip(learner.body.output_names, tally.errors.eps, strict=True)}
    wandering = learner.estimator.ensemble.first.wandering
    if wandering is not None:
        pace = wandering.pace()
        values |= {f'pace {name} [1/sample]': f'{value:.2g}' for name, value in
                   zip(learner.body.output_names, pace.tolist(), strict=True)}
    values |= {f'weight {name}': f'{weights.mean():.3f}' for name, weights in learner.estimator.weights.items()}
    probability = learner.estimator.effects_probability
    if probability is not None:
        values |= {f'probability of the declared effects {name}': f'{value:.3f}' for name, value in
                   zip(learner.body.output_names, probability.tolist(), strict=True)}
    condition = conditioning(learner.estimator.model, learner.estimator.columns.prior_scale)
    if condition is not None:
        values |= {'condition number': f'{condition.number:.3g}',
                   'undetermined directions': f'{condition.undetermined} of {condition.columns}'}
    values |= {f'excitation {index}': sentence for index, sentence in enumerate(sentences)}
    if tally.worst > IMPLAUSIBLE:
        return Report(WARN, f'the outputs lay {tally.worst:.1f} predicted standard deviations off within the last '
                            f'{REPORTS} s: the robot has changed, or is touched.', values)
    if sentences:
        return Report(WARN, f'{sentences[0]}.', values)
    told = 'the outputs are as predicted.' if innovation is not None else 'no prediction in the last second.'
    return Report(OK, told, values)


def feedforward_report(feedforward: Feedforward) -> Report:
    """Report of how many desired states were answered, and what had to be said of them."""
    counts = feedforward.counts
    values = {'answered': counts['answered'],
              'answered by the robot description': counts['described'],
              'cut to the effort limits': counts['limited'],
              'outside of what was learnt': counts['doubtful'],
              'withheld': counts['withheld'], 'last mark': feedforward.last}
    if feedforward.withheld:
        return Report(WARN, f'{counts["withheld"]} trajectories withheld: {feedforward.withheld}',
                      values)
    return Report(OK, f'{counts["answered"]} desired states answered, '
                      f'{counts["withheld"]} trajectories withheld.', values)


def errors_report(errors: InternalErrors, duplicates: str) -> Report:
    """Report of what went wrong in the node itself, by its place.

    :param duplicates: who else publishes its topics, see :meth:`Outputs.duplicates`.
    """
    values: dict[str, object] = {f'internal errors: {place}': count for place, count in sorted(errors.counts.items())}
    values |= {'internal errors': errors.counts.total(), 'last internal error': errors.last}
    values['another node of this name'] = duplicates
    if duplicates:
        return Report(ERROR, duplicates, values)
    return Report(ERROR if errors.counts else OK, errors.last or 'no internal error.', values)


def believed_load(learner: Learner, tally: Tally) -> tuple[Load | None, str]:
    """Load that the arm carries; None and the reason while that cannot be told."""
    if not learner.estimator.ready:
        return None, f'withheld until {learner.estimator.model_comes}.'
    detector, (picked, load) = learner.changes.detector, learner.changes.picked
    if picked and load is None:
        return None, 'withheld: something was just picked up or put down, and is being named.'
    if load is None and tally.worst > IMPLAUSIBLE:
        return None, (f'withheld: the outputs lay {tally.worst:.1f} predicted standard deviations off within the last '
                      f'{REPORTS} s.')
    before = None if detector is None or detector.before is None else detector.before[:learner.body.n_parameters]
    carried = carried_load(learner.estimator, before, load)
    return carried, '' if carried is not None else 'withheld: the model learns no inertias.'


def payload_sentence(carried: CarriedLoad) -> str:
    """A sentence of what is told of a load."""
    assert carried.std is not None
    untold = ''
    if not np.isfinite(carried.centre).all():
        lighter = carried.mass < -2.0 * carried.std.mass
        why = 'the arm is lighter than its description, or the outputs have the wrong sign' if lighter else \
            'the mass is below two standard deviations'
        untold = f'; its centre and inertia are withheld: {why}.'
    elif not np.isfinite(carried.inertia).all():
        untold = '; its inertia is withheld: no body has the one that fits.'
    return f'{carried.mass:.3g} +- {carried.std.mass:.2g} kg at {carried.link}{untold}'


def parameters_report(found: Sequence[LearntCoefficient], more: Mapping[str, object]) -> Report:
    """Every coefficient with its standard deviation, and more."""
    values = {entry.name: f'{entry.value:.6g} +- {entry.std:.2g} {entry.unit}' for entry in found} | dict(more)
    return Report(OK, f'{len(found)} coefficients.', values)


def status_message(node: Node, title: str, robot_name: str, report: Report) -> DiagnosticArray:
    """The message of one report."""
    name = f'{node.get_fully_qualified_name().lstrip("/")}: {title}'
    values = [KeyValue(key=key, value=str(value)) for key, value in report.values.items()]
    message = DiagnosticArray(status=[DiagnosticStatus(
        level=report.level, name=name, message=report.message, hardware_id=robot_name,
        values=values)])
    message.header.stamp = node.get_clock().now().to_msg()
    return message


class Reports:
    """One status after another, evenly over the second: a sample that comes meanwhile waits for one of them only.

    :param learner: gives the learner, None before the robot is known.
    :param others: makers of further statuses, by their titles.
    :param duplicates: see :meth:`Outputs.duplicates`.
    :param unseen: see :meth:`Outside.unseen <semiparam_ros.ros.estimator.outside.Outside.unseen>`.
    :param consistent: asked each second while ``parameters.consistent``. :param setup: asked each second.
    """

    def __init__(self, node: Node, inputs: InputStream, rejections: Rejections, errors: InternalErrors,
                 learner: Callable[[], Learner | None], feedforward: Feedforward,
                 others: Mapping[str, Callable[[], Report]], duplicates: Callable[[], str],
                 unseen: Callable[[], str], consistent: ConsistentTopic, setup: SetupCheck) -> None:
        self.tally = Tally(())
        self._history: History | None = None
        """That of the learner whose answers are counted."""
        self._consistent, self._setup = consistent, setup
        self._suspected: list[str] = []
        self._published: ConsistentBodies | None = None
        self._news = self._robot_name = self._stage = self._known_duplicates = ''
        self._errors, self._duplicates, self._unseen = errors, duplicates, unseen
        self._node, self._inputs, self._learner = node, inputs, learner
        self._statuses = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._payload = node.create_publisher(InertiaStamped, '~/payload', 10)
        self._payload_std = node.create_publisher(InertiaStamped, '~/payload_std', 10)
        turns = {'inputs': InputReport(inputs, rejections, node.get_logger().warning).make,
                 'timing': TimingReport(inputs, self.say).make, 'learning': self._learning,
                 'model': self._model, 'parameters': self._parameters,
                 'feedforward': lambda: feedforward_report(feedforward), **others,
                 'errors': self._errors_report}
        turn = cycle(turns.items())
        steady_timer(node, PERIOD_S / len(turns), lambda: self._publish(*next(turn)))

    def open(self, robot_name: str, body: RigidBody) -> None:
        """The robot is known: count its answers."""
        self._robot_name, self.tally = robot_name, Tally(body.joints)
        predicted = f'the wrench at {body.sensor_frame}' if body.sensor_frame else 'the effort of each'
        self.say(f'{robot_name or "the robot"} is known by its description and moves {", ".join(body.joints)}; '
                 f'{predicted} is predicted.')
        if body.remark:
            self.say(body.remark, LoggingSeverity.WARN)

    def say(self, sentence: str, severity: LoggingSeverity = LoggingSeverity.INFO) -> None:
        """Into the log, and into the status of learning as the last news."""
        self._news = sentence
        log = self._node.get_logger()
        if severity == LoggingSeverity.ERROR:  # rclpy refuses two severities from one line
            log.error(sentence)
        elif severity == LoggingSeverity.WARN:
            log.warning(sentence)
        else:
            log.info(sentence)

    def _publish(self, title: str, make: Callable[[], Report | None]) -> None:
        try:
            report = make()
        except Exception as error:  # a status that cannot be told must not keep the others back
            self._errors.add(f'the status of {title}', error)
            return
        if report is None:
            return
        self._statuses.publish(status_message(self._node, title, self._robot_name, report))

    def _errors_report(self) -> Report:
        duplicates = self._duplicates()
        if duplicates and not self._known_duplicates:
            self.say(duplicates, LoggingSeverity.ERROR)
        self._known_duplicates = duplicates
        return errors_report(self._errors, duplicates)

    def _learning(self) -> Report:
        for topic in self._inputs.follow_reliability():
            self.say(f'{topic} is offered as best_effort only, and received so.')
        for topic in self._inputs.newly_unheard():
            self.say(f'{topic} has a best_effort publisher beside reliable ones, which alone are heard; '
                     'reliability: best_effort hears both.', LoggingSeverity.WARN)
        for topic, owners in self._inputs.newly_shared():
            self.say(f'{len(owners)} publish on {topic}: {", ".join(owners)}. All that holds this robot\'s joints or '
                     'sensor is learnt, but for joint states that jump.', LoggingSeverity.WARN)
        learner = self._learner()
        self._log_stage(learner)
        if learner is None:
            return Report(WARN, 'waiting for a robot description.', {})
        report, problems = learning_report(learner, self._news), self._setup_problems(learner)
        values = {**report.values, 'external wrench not felt in': self._unseen(),
                  'samples that the set-up was checked with': self._setup.checked}
        level = max(report.level, WARN) if problems else report.level
        return Report(level, ' '.join([report.message, *problems]), values)

    def _setup_problems(self, learner: Learner) -> list[str]:
        """Problems that the samples show; new ones are logged."""
        self._setup.look(learner)
        problems = self._setup.problems
        for sentence in problems:
            if sentence not in self._suspected:
                self.say(f'{sentence} Until then the model learns what is not there; ~/diagnose looks closer.',
                         LoggingSeverity.WARN)
        self._suspected = problems
        return problems

    def _log_stage(self, learner: Learner | None) -> None:
        """A line whenever another part of the node's life begins."""
        stage = stage_of(learner)
        if stage != self._stage:
            self._stage = stage
            self._node.get_logger().info(stage)

    def _model(self) -> Report | None:
        learner = self._learner()
        if learner is None:
            return None
        self._go_on_with(learner)
        return model_report(learner, self.tally)

    def _go_on_with(self, learner: Learner) -> None:
        """Forget what is of the model before a reset, or before a state was loaded."""
        if self._history not in (None, learner.history):
            self.tally = Tally(learner.body.joints)
            self._consistent.stop()
        self._history = learner.history

    def _parameters(self) -> Report | None:
        learner = self._learner()
        if learner is None:
            return None
        self._go_on_with(learner)
        load, sentence = believed_load(learner, self.tally)
        if learner.settings.parameters_consistent:
            return self._consistent_parameters(learner, load, sentence)
        self._consistent.stop()
        if load is not None:
            sentence = self._publish_payload(load, self.tally.stamp)
        return parameters_report(quantities(learner.estimator), {'payload': sentence})

    def _consistent_parameters(self, learner: Learner, load: Load | None, sentence: str) -> Report:
        """Report of the latest bodies that were found; of what was learnt while there are none."""
        before = self._published
        self._consistent.ask(learner, load, self.tally.stamp)
        found = self._published = self._consistent.found
        if found is None:
            return parameters_report(quantities(learner.estimator), {
                'payload': sentence or 'withheld: no consistent parameters are found yet.',
                'consistent': self._consistent.trouble or 'no: they are being looked for.'})
        if load is not None and found.load is not None:
            sentence = self._publish_payload(found.load, None if found is before else found.stamp)
        return parameters_report(found.coefficients, {
            'payload': sentence or 'withheld: it is not among the latest consistent parameters yet.',
            'consistent': f'yes, of the model {time.monotonic() - found.at:.1f} s ago'})

    def _publish_payload(self, load: Load, stamp: int | None) -> str:
        """With a stamp [ns], None: it is not to be published; returns its sentence."""
        carried = reported_load(*load)
        if stamp is not None and carried.std is not None:
            self._payload.publish(inertia_message(stamp, carried))
            self._payload_std.publish(inertia_message(stamp, carried.std))
        return payload_sentence(carried)
