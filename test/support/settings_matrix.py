"""Every pair of settings, run through the real path: messages, samples, learner, state file.

All-pairs testing: covertable chooses rows such that any two values of two different factors meet in one of them, and
any three of the groups in ``TRIPLES``.

Each row is run three times: by the command's offline learner, by the node's learner, and by the node's learner saved
half-way and loaded into another one. All three must say the same of every sample, bit for bit, and finite numbers only.
"""

from __future__ import annotations

import itertools
import json
import tempfile
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from covertable import make

from semiparam_ros.bags.loading import sample_stream
from semiparam_ros.core.horizon_error import HorizonErrors
from semiparam_ros.core.initial_window import gathered_from
from semiparam_ros.core.robot.external_wrench import ExternalWrench
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.variants import CHOICES, FREQUENCIES, PRIORS
from semiparam_ros.effects import effect_to_text, kinds
from semiparam_ros.effects.base import Effect
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.experiments.initial_window import Estimation, fitted_settings
from semiparam_ros.export.estimate import from_estimator
from semiparam_ros.export.live import consistent_parameters
from semiparam_ros.online import state_file
from semiparam_ros.online.identified_parameters import carried_load, is_shown
from semiparam_ros.online.learner import Answer
from semiparam_ros.online.learning import is_change
from semiparam_ros.online.tare import Tare
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body
from support.estimates import Estimates
from support.learner_stage import Stage
from support.node_helpers import JOINTS, URDF, DelayedBackground, InlineBackground

OUTPUTS = 'wrench', 'effort'
FACTORS: dict[str, tuple[object, ...]] = {
    'variant': CHOICES,
    'priors': PRIORS,
    'joint_friction': (True, False),
    'effect': (*kinds(), 'none'),
    'outputs': OUTPUTS,
    'efforts': ('all', 'last'),
    'asked': ('by name', 'auto'),
    'values': ('bare', 'all'),
    'times': ('none', 'late', 'stamps'),
    'place': ('first', 'last'),
    'forgetting': ('auto', 1.0, 0.999, 0.9, 0.5),
    'noise': ('output', 'one'),
    'length_scales': ('kind', 'one', 'input'),
    'features': (10, 'auto'),
    'frequencies': FREQUENCIES,
    'learn_every': (1, 3),
    'least_gain': (0.0, 0.05),
    'gate': (True, False),
    'tare': (True, False),
    'auto': ('apply', 'report', 'off'),
    'tools': (True, False),
    'horizon': (25, 1, 200),
    'motion': ('filtered', 'measured', 'missing'),
    'still': ('none', 'noisy', 'exact'),
    'temperatures': ('none', 'measured'),
    'consistent': (True, False),
    'hyperparameters': ('estimated', 'given'),
    'background': ('delayed', 'inline'),
}
"""What is not a parameter's value:

efforts: of which joints they are outputs; the others are inputs only, and their efforts no numbers. Of a wrench, all.
asked: for the outputs; auto leaves them to the sensor's frame.
start: of the effect; none, in seconds since the start of the recording, or as a stamp.
motion: velocities and accelerations measured; accelerations filtered from the velocities; velocities missing, filtered
from the positions.
temperatures: none, or of the sensor (of the last joint), which are not known in the first second.
still: the robot stands still for some seconds first, with the sensor's noise or without any: none of it may count.
hyperparameters: estimated from the first samples, or given, as `semiparam fit` writes them and with noise that is alike
for four samples.
background: hyperparameters are estimated at once, or while further samples come and the provisional model answers.
"""

TRIPLES: tuple[tuple[str, ...], ...] = (
    ('effect', 'outputs', 'values'), ('effect', 'outputs', 'place'), ('effect', 'outputs', 'efforts'),
    ('effect', 'values', 'times'), ('variant', 'outputs', 'forgetting', 'still', 'background'),
    ('variant', 'forgetting', 'gate', 'tare'), ('variant', 'forgetting', 'horizon'), ('variant', 'outputs', 'motion'),
    ('variant', 'noise', 'length_scales'), ('variant', 'forgetting', 'features'))
"""Groups of factors of which any three values meet: they cost hardly a row more, as each variant meets each effect."""

IMPOSSIBLE: dict[tuple[str, str, str], str] = {
    **{(name, 'outputs', outputs): f'does not act on outputs {outputs}'
       for name, kind in kinds().items() for outputs in OUTPUTS if outputs not in kind.outputs},
    **{(name, 'times', times): 'has a start or an end; expected none'
       for name, kind in kinds().items() for times in ('late', 'stamps') if kind.calibrations}}
"""(effect, factor, value) that cannot be together; they are refused, and a test asks for this part of the sentence."""

WINDOW = 24
PERIOD_NS, START_NS = 10_000_000, 5_000_000_000
WARMER_EVERY_NS = 500_000_000
CONTACT_EVERY_S, CONTACT_S = 20.0, 0.4
RUN_BACKGROUND_EVERY = 25
KNOWN_AFTER = 1500
TOOL = 'ft {"mass": 0.4, "centre": [0.0, 0.02, 0.1], "inertia": [2e-3, 0, 0, 2e-3, 0, 1e-3]}'
LARGEST_PREDICTION = 1e4
"""[N], [N m] The outputs stay within 70; a model from a poor window may err, but must not burst. With a memory of ten
samples for hundreds of features, or for a rigid body with wide priors, it does (docs/mathematics.md, Forgetting):
there predictions need only be finite."""

Row = dict[str, object]


def is_possible(row: Row) -> bool:
    """Whether a row, or the part of it that is there, can be."""
    if (row.get('effect'), row.get('values'), row.get('place')) == ('cable_hysteresis', 'all', 'last'):
        return False  # its last place is a joint, where a cable has no direction
    return not any((row.get('effect'), factor, row.get(factor)) in IMPOSSIBLE for factor in ('outputs', 'times'))


@cache
def rows() -> tuple[Row, ...]:
    """Rows in which every possible pair of values occurs; always the same ones."""
    excluded = [{'operator': 'fn', 'requires': ['effect', factor], 'evaluate': is_possible}
                for factor in ('outputs', 'times')]
    excluded.append({'operator': 'fn', 'requires': ['effect', 'values', 'place'], 'evaluate': is_possible})
    triples = [{'fields': list(group), 'strength': 3} for group in TRIPLES]
    return tuple(make({name: list(values) for name, values in FACTORS.items()}, constraints=excluded,
                      sub_models=triples))


def pairs_of(row: Row) -> set[tuple[object, ...]]:
    """The pairs of values that a row tests."""
    return {(one, row[one], other, row[other]) for one, other in itertools.combinations(FACTORS, 2)}


def possible_pairs() -> set[tuple[object, ...]]:
    """All pairs of values that can be."""
    return {(one, a, other, b) for one, other in itertools.combinations(FACTORS, 2)
            for a, b in itertools.product(FACTORS[one], FACTORS[other]) if is_possible({one: a, other: b})}


# The model of a row

@cache
def body_of(outputs: str, efforts: str = 'all'):
    """The two-joint arm, with a wrench sensor in its hand or torque sensors in its joints."""
    return build_rigid_body(Settings(robot_description=URDF, joints=JOINTS, outputs=outputs,
                                     output_joints=output_joints_of(outputs, efforts),
                                     sensor_frame='ft' if outputs == 'wrench' else ''))


def body_of_settings(settings: Settings):
    """The same of a row's parameters."""
    return body_of(settings.outputs, 'last' if settings.output_joints else 'all')


def output_joints_of(outputs: object, efforts: object) -> tuple[str, ...]:
    """The parameter of a row."""
    return JOINTS[-1:] if (outputs, efforts) == ('effort', 'last') else ()


def effect_of(row: Row, duration_s: float) -> Effect | None:
    """The effect of a row: bare or with all of its values, at the first or the last of its places."""
    if row['effect'] == 'none':
        return None
    kind, body = kinds()[str(row['effect'])], body_of(str(row['outputs']), str(row.get('efforts')))
    places = kind.places(body) or kind.permitted(body)
    where = places[0 if row['place'] == 'first' else -1]
    shape = {'sin(q_a)': 1.0} if kind.kind == 'terms' else {}
    reference: tuple[float, ...] = ()
    if row['values'] == 'all':
        shape = all_values(kind, where, body)
        reference = tuple(body.base_parameters)
    if row['times'] == 'late':
        shape['start_s'] = 0.7 * duration_s
    elif row['times'] == 'stamps':
        shape['start_stamp_s'] = 1e-9 * START_NS + 0.05 * duration_s
        shape['end_stamp_s'] = 1e-9 * START_NS + 0.8 * duration_s
    return kind.from_values(where, shape, reference)


def all_values(kind: type[Effect], where: str | None, body: RigidBody) -> dict[str, float]:
    """Every value that the kind knows, those that choose the form of its columns as a search would set them."""
    if kind.kind == 'terms':
        return {'time*abs(dq_a)': 1.2, 'bump(q_b,0.1,0.3)': 1.0, 'q_a^2*sin(q_b)': 0.3}
    moving = samples_of(raw_motion('wrench', 'none', 400), Settings(sensor_frame='ft'), 'wrench', 'measured')
    motion = Samples.from_list(moving)
    motion = replace(motion, temperature=30.0 + motion.time[:, None] * np.ones(body.n_joints))
    residual = np.random.default_rng(0).standard_normal((len(motion), body.n_outputs))
    found = kind.searches(body, motion, where, residual)
    small = dict.fromkeys((name for name, _ in kind.calibrations), 0.01)
    return {**dict.fromkeys(kind.parameter_units, 0.05), **small, **(dict(found[-1]) if len(found) else {})}


def settings_of(row: Row, count: int) -> Settings:
    """The parameters of a row."""
    effect = effect_of(row, count * PERIOD_NS * 1e-9)
    wrench = row['outputs'] == 'wrench'
    return Settings.from_mapping({
        'robot_description': URDF, 'joints': list(JOINTS), 'sensor_frame': 'ft' if wrench else '',
        'outputs': row['outputs'] if row['asked'] == 'by name' else 'auto',
        'output_joints': output_joints_of(row['outputs'], row['efforts']), 'variant': row['variant'],
        'priors': row['priors'], 'joint_friction': row['joint_friction'],
        'temperatures': [] if row['temperatures'] == 'none' else ['ft'] if wrench else JOINTS[-1:],
        'effects': [effect_to_text(effect)] if effect else [], 'forgetting': row['forgetting'], 'noise': row['noise'],
        'features.length_scales': row['length_scales'], 'features.count': row['features'],
        'features.frequencies': row['frequencies'],
        'learn.every': row['learn_every'], 'learn.least_gain': row['least_gain'], 'initial.samples': WINDOW,
        'diagnosis.auto': row['auto'],
        'gate.enabled': row['gate'], 'tools': [TOOL] if row['tools'] else [], 'horizon.length': row['horizon'],
        'parameters.consistent': row['consistent'], 'retained.samples': max(count // 10, 20)})


def with_hyperparameters(settings: Settings, samples: list[Sample]) -> Settings:
    """Those of the initial window, filled in as `semiparam fit` does."""
    recording = Samples.from_list(samples)
    window = recording[gathered_from(recording, settings.initial_samples).indices]
    fitted, _ = fitted_settings(settings, window, None, Estimation(starts=1))
    return fitted.changed({'hyperparameters.autocorrelation_time': (4.0,)})


# The motion of a row

class Motion(NamedTuple):
    """States and outputs at even times, (N, 2) and (N, n)."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    outputs: np.ndarray


@cache
def raw_motion(outputs: str, still: str, count: int) -> Motion:
    """Sums of sines, a hand heavier than described, a bump that no column explains, a drift, noise and contacts."""
    rng = np.random.default_rng(7)
    body = body_of(outputs)
    quiet = 0 if still == 'none' else 2 * WINDOW
    time_s = np.maximum(np.arange(count) - quiet, 0)[:, None, None] * PERIOD_NS * 1e-9
    rate, phase = rng.uniform(1.0, 6.0, (1, 2, 3)), rng.uniform(0.0, 2 * np.pi, (1, 2, 3))
    angle = rate * time_s + phase
    position, velocity = 0.4 * np.sin(angle).sum(2), 0.4 * (rate * np.cos(angle)).sum(2)
    acceleration = -0.4 * (rate**2 * np.sin(angle)).sum(2)
    velocity[:quiet] = acceleration[:quiet] = 0.0
    stamps = np.arange(count, dtype=np.int64)
    regressors = body.regressors(Samples(stamps, position, velocity, acceleration, np.zeros((count, 1)), 0))
    measured = regressors @ (1.2 * body.base_parameters) + 0.3 * np.sin(3.0 * position[:, :1]) + 1e-3 * time_s[:, :, 0]
    measured += 0.02 * rng.standard_normal(measured.shape)
    if still == 'exact':
        measured[:quiet] = measured[0]
    contact = np.zeros(count, dtype=bool)
    for start in (*range(count * 3 // 4, count, round(CONTACT_EVERY_S * 1e9 / PERIOD_NS)), count // 2 - 10):
        contact[start:start + round(CONTACT_S * 1e9 / PERIOD_NS)] = True
    measured[contact] += 5.0
    return Motion(position, velocity, acceleration, measured)


def samples_of(motion: Motion, settings: Settings, outputs: str, source: str, burst: int = 1) -> list[Sample]:
    """What a stream makes of the messages when the topics come in bursts of so many messages."""
    stream = sample_stream(settings, JOINTS, source == 'measured')
    late = PERIOD_NS // 3 if outputs == 'wrench' else 0  # a wrench between two joint states
    found: list[Sample] = []
    stamps = [START_NS + index * PERIOD_NS for index in range(len(motion.position))]
    for start in range(0, len(stamps), burst):
        part = _part(stamps, motion, start, burst)
        for stamp, position, velocity, _, measured in part:
            found += stream.joint_state(stamp, JOINTS, position, () if source == 'missing' else velocity,
                                        efforts_of(measured, settings) if outputs == 'effort' else ())
        for stamp, _, _, acceleration, _ in part if source == 'measured' else ():
            found += stream.accelerations(stamp, JOINTS, acceleration)
        for stamp, _, _, _, measured in part if outputs == 'wrench' else ():
            found += stream.wrench(stamp + late, 'ft', measured)
        for stamp, *_ in part:
            if settings.temperatures and stamp % WARMER_EVERY_NS == 0:
                stream.temperature(stamp, settings.temperatures[0], 20.0 + 1e-9 * stamp)
    assert not stream.faults, stream.last_fault
    return found


def efforts_of(measured: list[float], settings: Settings) -> list[float]:
    """Those of the joints that are inputs only are no numbers."""
    outputs = settings.output_joints or JOINTS
    return [effort if joint in outputs else np.nan for joint, effort in zip(JOINTS, measured, strict=True)]


def _part(stamps: list[int], motion: Motion, start: int, burst: int) -> list[tuple]:
    block = slice(start, start + burst)
    return list(zip(stamps[block], *(values[block].tolist() for values in motion), strict=True))


# Three ways to run it

@dataclass
class Record:
    """What was said of each sample."""

    answers: list[tuple] = field(default_factory=list)
    horizons: list[tuple] = field(default_factory=list)
    final: dict[str, np.ndarray] = field(default_factory=dict)
    news: list[str] = field(default_factory=list)
    failed_windows: int = 0

    def horizon(self, errors: HorizonErrors) -> None:
        """Horizon errors, after the sample that completed them was answered."""
        self.horizons.append((self.answers[-1][0], errors.origin, errors.eps.tolist(), errors.eps_centred.tolist()))

    def finish(self, estimator, tare: Tare, settings: Settings) -> None:
        self.final = {**estimator.model.recursion.state(), 'bias': tare.bias}
        if settings.parameters_consistent:
            self.final |= consistent(estimator)


def consistent(estimator) -> dict[str, np.ndarray]:
    """What ``~/parameters`` and ``~/payload`` would tell; empty where the model learns no inertia."""
    try:
        estimate = from_estimator(estimator, None, 'the row')
    except SemiparamError as error:
        assert 'learns no inertial parameters' in str(error)
        return {}
    load = carried_load(estimator)
    carried = None if load is None or not is_shown(load) else (load.parameters, load.covariance)
    found = consistent_parameters(URDF, estimate, carried)
    assert (found.load is None) == (carried is None)
    for link in json.loads(found.document)['links'].values():
        moments = np.linalg.eigvalsh(link['inertia'])
        assert link['mass'] > 0.0 and moments[0] > 0.0 and moments[0] + moments[1] > moments[2], link
    return {'bodies': found.theta} | ({} if found.load is None else {'load': found.load})


class Live(Stage):
    """The node's learner, its background at once or late."""

    def __init__(self, row: Row, settings: Settings) -> None:
        self.record, body = Record(), body_of_settings(settings)
        self.external = ExternalWrench(body, 'ft')
        super().__init__(settings, DelayedBackground() if row['background'] == 'delayed' else InlineBackground(), body)
        self._offered = 0

    def answered(self, answer: Answer) -> None:
        prediction = answer.prediction
        self.record.answers.append((prediction.sample.stamp, answer.learnt, answer.contact, prediction.ready,
                                    prediction.mean.tolist(), prediction.std.tolist(),
                                    outside(self.external, answer, self.learner.gate.widening)))

    def horizon_completed(self, errors: HorizonErrors) -> None:
        self.record.horizon(errors)

    def failed(self, place: str, error: BaseException) -> None:
        raise AssertionError(f'{place}: {type(error).__name__}: {error}') from error

    def offer(self, samples: list[Sample]) -> None:
        for sample in samples:
            self.learner.offer(sample)
            self._offered += 1
            if self._offered % RUN_BACKGROUND_EVERY == 0:
                self.run_background()

    def run_background(self) -> None:
        if isinstance(self.background, DelayedBackground):
            self.background.run()

    def finish(self) -> Record:
        """What was said, when nothing else was."""
        assert not self.reverted and not self.horizons, self.news
        self.record.news = self.news
        self.record.finish(self.learner.estimator, self.learner.tare, self.learner.settings)
        return self.record


def outside(external: ExternalWrench, answer: Answer, widening: np.ndarray) -> list[float]:
    """The external wrench and its deviations."""
    found = external.of(answer.prediction, answer.residual, widening, answer.followed)
    return [*found.wrench.tolist(), *found.std.tolist()]


def offline(settings: Settings, samples: list[Sample], tares: list[int], takeovers: list[int]) -> Record:
    """The commands' learner; a tare before the samples of these numbers."""
    record, learner = Record(), OfflineLearner(settings, [], lambda: None, takeovers)
    tare, external = Tare(learner.estimator.body.n_outputs), ExternalWrench(learner.estimator.body, 'ft')
    forces: list[list[float]] = []
    learner.on_answer = lambda answer, widening: forces.append(
        outside(external, answer, widening))
    for index, sample in enumerate(samples):
        if index in tares:
            tare.take()
            learner.learner.takes_off_otherwise()
        if tare.active:
            sample = sample._replace(outputs=sample.outputs - tare.bias)
        refused, turns = learner.learner.gate.refused, learner.learner.changes.applied.turns
        prediction = learner.step(sample, True)
        contact = learner.learner.gate.refused > refused
        tare.add(sample.stamp, prediction.sample.outputs - prediction.model_mean,
                 prediction.ready and not prediction.off)
        if learner.learner.changes.applied.turns != turns or is_change(learner.answer.learning):
            tare.begin_anew()
        mean = prediction.mean + tare.bias if tare.active else prediction.mean
        learnt = not contact and prediction.motion.is_news
        record.answers.append((sample.stamp, learnt, contact, prediction.ready, mean.tolist(),
                               prediction.std.tolist(), forces[-1]))
        if prediction.horizon is not None:
            record.horizon(prediction.horizon)
    record.finish(learner.estimator, tare, settings)
    record.failed_windows = len(learner.learner.failed_windows)
    return record


def live(row: Row, settings: Settings, samples: list[Sample], tares: list[int],
         path: Path) -> tuple[Record, Record, list[int]]:
    """Uninterrupted; the second half by another learner that loaded the first one's state from ``path``; and how many
    samples came from each window to its takeover."""
    half = len(samples) // 2
    first = Live(row, settings)
    _offer_with_tares(first, samples[:half], tares)
    first.run_background()
    state_file.save(path, first.learner.state())
    second = Live(row, settings)
    second.learner.restore(state_file.load(path, settings, body_of_settings(settings)))
    for stage in (first, second):
        _offer_with_tares(stage, samples[half:], [index - half for index in tares])
        stage.run_background()
    return first.finish(), second.finish(), first.learner.takeovers


def _offer_with_tares(stage: Live, samples: list[Sample], tares: list[int]) -> None:
    edges = [0, *(index for index in tares if 0 <= index < len(samples)), len(samples)]
    for start, end in itertools.pairwise(edges):
        if start:
            stage.run_background()
            stage.learner.take_tare()
        stage.offer(samples[start:end])


# What must hold

ESTIMATES = Estimates(starts=1)


@patch('semiparam_ros.core.model.estimate', ESTIMATES)
@patch('semiparam_ros.online.renewal.SHARE', 2.0)
def check(row: Row, count: int) -> None:
    """Run one row; AssertionError says what does not hold.

    Windows are so short here that usual motion leaves them. When live the models that follow would take over is
    the background's affair, so there are none; test/online/test_renewal.py compares them.
    """
    ESTIMATES.known.clear()
    settings, outputs = settings_of(row, count), str(row['outputs'])
    motion = raw_motion(outputs, str(row['still']), count)
    recorded = samples_of(motion, settings, outputs, str(row['motion']))
    given = row['hyperparameters'] == 'given'
    if given:
        settings = with_hyperparameters(settings, recorded)
    received = samples_of(motion, settings, outputs, str(row['motion']), burst=7)
    assert_same_samples(recorded, received)
    assert len(recorded) >= count - 1
    tares = [len(recorded) * 45 // 100, len(recorded) * 95 // 100] if row['tare'] else []
    with tempfile.TemporaryDirectory() as folder:
        whole, resumed, takeovers = live(row, settings, received, tares, Path(folder) / 'state.npz')
    if given:
        assert not takeovers, 'given hyperparameters were estimated again'
    else:
        assert takeovers, 'the initial window is not over'
        assert (takeovers[0] > 0) == (row['background'] == 'delayed')
    expected = offline(settings, recorded, tares, takeovers)
    short = row['forgetting'] in (0.9, 0.5) and (row['features'] == 'auto' or row['priors'] == 'paper')
    assert_finite(expected, np.inf if short else LARGEST_PREDICTION)
    assert expected.answers[-1][3], 'the initial window is not over'
    assert not expected.failed_windows, 'a window of motion gives no hyperparameters'
    assert expected.horizons, 'no horizon was completed'
    known = count >= KNOWN_AFTER or row['motion'] == 'measured'  # else the gate does not know the motion yet
    eager = row['gate'] and row['forgetting'] in ('auto', 1.0) and row['variant'] == 'SPK-ML'
    if known and eager and row['still'] == 'none':
        assert any(answer[2] for answer in expected.answers), 'no contact was seen'
    assert_same('live and offline', whole, expected, since=0)
    assert_same('loaded and uninterrupted', resumed, whole, since=len(recorded) // 2)


def assert_same_samples(one: list[Sample], other: list[Sample]) -> None:
    for mine, theirs in itertools.zip_longest(zip(*one, strict=True), zip(*other, strict=True)):
        assert np.array_equal(mine, theirs, equal_nan=True), 'samples depend on how topics interleave'


def assert_finite(record: Record, largest: float = LARGEST_PREDICTION) -> None:
    for index, (_, _, _, _, mean, std, forces) in enumerate(record.answers):
        assert np.isfinite([*mean, *std, *forces]).all(), f'sample {index} is predicted as {mean} +- {std}; {forces}'
        assert min(std) > 0.0, f'sample {index} has a standard deviation of {min(std)}'
        assert max(map(abs, mean)) < largest, f'sample {index} is predicted as {mean}'
    for name, values in record.final.items():
        assert np.isfinite(values).all(), f"the final '{name}' is not finite"


def assert_same(what: str, one: Record, other: Record, since: int) -> None:
    assert len(one.answers) == len(other.answers) - since, f'{what}: {len(one.answers)} answers; {one.news}'
    for index, (mine, theirs) in enumerate(zip(one.answers, other.answers[since:], strict=True)):
        assert mine == theirs, f'{what}: sample {since + index} differs: {mine} and {theirs}; {one.news}'
    first = other.answers[since][0]
    expected = [errors for errors in other.horizons if errors[0] >= first]
    assert [errors[1:] for errors in one.horizons] == [errors[1:] for errors in expected], f'{what}: horizons differ'
    assert one.final.keys() == other.final.keys()
    for name, values in one.final.items():
        assert np.array_equal(values, other.final[name]), f"{what}: the final '{name}' differs"


