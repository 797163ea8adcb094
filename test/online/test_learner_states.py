"""A learner driven through random lives: whatever happens in whatever order, samples are answered once and in order.

    pytest --long test/online/test_learner_states.py

runs hundreds of lives instead of ten.
"""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import hypothesis
import numpy as np
import pytest
from hypothesis import Phase
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from semiparam_ros.core.motion import STEP_NS
from semiparam_ros.core.robot.consistency import pseudo_inertia
from semiparam_ros.core.robot.external_wrench import ExternalWrench
from semiparam_ros.core.variants import PRIORS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.estimate import from_estimator
from semiparam_ros.export.files import export_to
from semiparam_ros.export.urdf import described_links
from semiparam_ros.online.compensation import Compensation
from semiparam_ros.online.feedforward import Feedforward
from semiparam_ros.online.history import KEPT_OF_REST
from semiparam_ros.online.learner import Learner
from semiparam_ros.online.learning import Learning, observe, plain, see_again
from semiparam_ros.online.model_jobs import known_of, new_estimator
from semiparam_ros.online.model_switcher import State, same_model
from semiparam_ros.online.state_file import load, save
from semiparam_ros.settings.build import build_rigid_body
from support.node_helpers import BODY, JOINTS, PERIOD_NS, SETTINGS, DelayedBackground, motion

SMALL = replace(SETTINGS, features_count=4, initial_samples=20, horizon_length=3, variant='P',
                temperatures=('ft',))
MOTION = motion(400)
VARIANTS = ('P', 'NP-ML', 'SP-ML', 'SP2-ML', 'SPK-ML', 'NP-VS', 'SP2-VS', 'auto')
EFFECTS = ('sensor_drift', 'payload@ft', 'payload@ft{"start_s": 0.5}', 'time_delay{"delay_s": 0.005}',
           'temperature_drift', 'sensor_gain{"fx": 0.1}', 'periodic_disturbance{"frequency_hz": 1.3}',
           'viscous_drag@ft')
TOOLS = ('ft {"mass": 0.6, "centre": [0.01, 0.0, 0.1]}', '- ft {"mass": 0.2, "inertia": [1e-3, 0, 0, 1e-3, 0, 1e-3]}')
EFFORT_EFFECTS = ('viscous_friction@a', 'coulomb_friction@b{"turn_speed": 0.02}', 'payload@ft',
                  'coulomb_friction@a{"presliding": 0.01}', 'effort_offset@b{"start_s": 0.5}',
                  'time_delay{"delay_s": 0.005}', 'temperature_friction@a', 'effort_gain@b{"gain": 0.1}')


def fast(motion, body):
    """The same places at eight times the speed."""
    return [sample._replace(velocity=8.0 * sample.velocity, acceleration=64.0 * sample.acceleration,
                            outputs=body.regressor(sample.position, 8.0 * sample.velocity,
                                                   64.0 * sample.acceleration) @ (1.2 * body.base_parameters))
            for sample in motion]


YEAR_NS = 365 * 86400 * 10**9


class Lives(RuleBasedStateMachine):
    """Listens to the learner as the node does, and keeps what the active model has been given."""

    settings, body, motion, fast = SMALL, BODY, MOTION, fast(MOTION, BODY)
    effects = EFFECTS

    def __init__(self):
        super().__init__()
        self.background = DelayedBackground()
        self.offered, self.answers, self.given, self.saved = [], [], [], []
        self.stamp, self.place, self.warmth = self.motion[0].stamp, 0, np.nan
        self.learner, self.feedforward = None, Feedforward()
        self.period_ns = PERIOD_NS
        self.since = set()  # the last motion: 'rest', 'jump'
        self.drafted = False  # a draft from the initial window is in force
        self.kept = False  # and stays, as the window after it failed
        self.external, self.compensation = ExternalWrench(self.body, 'ft'), Compensation(0.3)

    @initialize(count=st.sampled_from([4, 'auto']), every=st.sampled_from([1, 3]), gain=st.sampled_from([0.0, 0.1]),
                period_ns=st.sampled_from([PERIOD_NS, STEP_NS // 3]))
    def begin(self, count=4, every=1, gain=0.0, period_ns=PERIOD_NS):
        self.period_ns = period_ns
        settings = replace(self.settings, features_count=count, learn_every=every, learn_least_gain=gain)
        self.learner = Learner(settings, self.body, self.background, self)

    # What the learner tells

    def answered(self, answer):
        self.answers.append(answer.prediction.sample.stamp)
        self.given.append((answer.prediction.sample, answer.learning))
        assert np.isfinite(answer.prediction.mean).all() and np.isfinite(answer.prediction.std).all()
        found = self.external.of(answer.prediction, answer.residual, np.ones(self.body.n_outputs), answer.followed)
        assert np.isfinite([*found.wrench, *found.std]).all() and (found.std >= 0.0).all()
        assert not answer.places.any() or (answer.contact and answer.places.sum() == pytest.approx(1.0))
        if self.body.outputs == 'wrench' and self.learner is not None:
            assert np.isfinite(self.learner.compensated(answer, self.compensation)).all()

    def horizon_completed(self, errors):
        assert np.isfinite(errors.eps).all()

    def shadow_horizon_completed(self, variant, errors):
        assert variant in self.learner.settings.shadow_variants and np.isfinite(errors.eps).all()

    def announce(self, sentence):
        if 'another one is gathered' in sentence:
            self.given.clear()
        self.kept |= 'goes on with those it has' in sentence and self.drafted
        self.drafted = 'with a draft of its hyperparameters' in sentence or (
            self.drafted and not any(words in sentence for words in ('takes over', 'gathered', 'those it has')))

    def model_switched(self, success, sentence):
        if success:
            assert same_model(self.learner.built, self.learner.settings), 'nobody asked for this model any more'

    def settings_reverted(self, settings):
        assert settings == self.learner.settings

    def change_reported(self, record):
        assert record.sentence

    def failed(self, place, error):
        raise AssertionError(f'internal error at {place}') from error

    # Samples

    def now(self, sample):
        """The sample as it comes next."""
        warmth = np.full(len(self.settings.temperatures), self.warmth)
        return sample._replace(stamp=self.stamp + self.period_ns, temperature=warmth)

    def offer(self, sample):
        sample = self.now(sample)
        self.stamp = sample.stamp
        self.since.clear()
        self.place += 1
        self.offered.append(sample.stamp)
        self.learner.offer(sample)

    @rule(count=st.integers(1, 40))
    def moves(self, count):
        for _ in range(count):
            self.offer(self.motion[self.place % len(self.motion)])

    @rule(count=st.integers(1, 60))
    def moves_fast(self, count):
        """Other motion than in the window: the hyperparameters are estimated again."""
        for _ in range(count):
            self.offer(self.fast[self.place % len(self.fast)])

    @rule(count=st.integers(1, 25))
    def moves_with_a_dead_sensor(self, count):
        """A window of it gives no hyperparameters."""
        for _ in range(count):
            dead = np.full(self.body.n_outputs, 1.0)
            self.offer(self.motion[self.place % len(self.motion)]._replace(outputs=dead))

    @precondition(lambda self: 'rest' not in self.since)
    @rule(count=st.integers(1, 50 + KEPT_OF_REST))
    def rests(self, count):
        """The same place, with a noise of the sensor: after a second it is not learnt, and a model that is built later
        knows the last samples of it alone."""
        rng = np.random.default_rng(count)
        for _ in range(count):
            self.offer(self.motion[self.place % len(self.motion)]._replace(
                position=self.motion[7].position,
                outputs=self.motion[7].outputs + 0.01 * rng.standard_normal(self.body.n_outputs)))
        self.since.add('rest')

    @rule(warmth=st.sampled_from([20.0, 21.5, 40.0]))
    def warms(self, warmth):
        """A temperature comes; before the first, none is known."""
        self.warmth = warmth

    @precondition(lambda self: 'jump' not in self.since)  # two of them without a sample between may be none
    @rule(jump=st.sampled_from([-YEAR_NS, -10**10, 2 * 3600 * 10**9, YEAR_NS]))
    def clock_jumps(self, jump):
        self.stamp += jump
        self.since.add('jump')
        self.learner.clear_pending()

    # Settings, as the node checks and applies them

    def change(self, **values):
        settings = replace(self.learner.settings, **values)
        try:
            self.learner.check(settings)
        except SemiparamError:
            return
        self.learner.change(settings)

    @rule(variant=st.sampled_from(VARIANTS))
    def chooses(self, variant):
        self.change(variant=variant)

    @rule(chosen=st.lists(st.integers(0, len(EFFECTS) - 1), max_size=2, unique=True))
    def declares_some(self, chosen):
        self.declares([self.effects[index] for index in chosen])

    def declares(self, effects):
        self.change(effects=tuple(effects))

    @rule(forgetting=st.sampled_from(['auto', 1.0, 0.99, 0.9]), horizon=st.sampled_from([1, 3, 7]),
          noise=st.sampled_from(['one', 'output']))
    def tunes(self, forgetting, horizon, noise):
        self.change(forgetting=forgetting, horizon_length=horizon, noise=noise)

    @rule(auto=st.sampled_from(('off', 'report', 'apply')))
    def looks_for_changes(self, auto):
        self.change(diagnosis_auto=auto)

    @rule(priors=st.sampled_from(PRIORS), joint_friction=st.booleans())
    def holds_beforehand(self, priors, joint_friction):
        self.change(priors=priors, joint_friction=joint_friction)

    @rule(shadows=st.lists(st.sampled_from(VARIANTS), max_size=2, unique=True))
    def shadows(self, shadows):
        self.change(shadow_variants=tuple(shadows))

    @rule(learning=st.booleans(), gate=st.booleans())
    def pauses(self, learning, gate):
        self.change(learning=learning, gate_enabled=gate, gate_timeout=0.3)

    @rule(tools=st.sampled_from([(), TOOLS[:1], TOOLS]))
    def carries(self, tools):
        """Known tools come and go; the model never sees them."""
        self.change(tools=tools)

    @rule(values=st.lists(st.floats(-1e9, 1e9), min_size=6, max_size=6),
          before=st.sampled_from(['withhold', 'description']))
    def asks_for_feedforward(self, values, before):
        self.change(feedforward_before_ready=before)
        try:
            found = self.feedforward.answer(self.learner, *np.reshape(values, (3, 2)))
        except SemiparamError as error:
            assert 'withheld' in str(error) and before == 'withhold' and not self.learner.estimator.ready, error
        else:
            assert np.isfinite([*found.outputs, *found.outputs_std, *found.efforts_std]).all()
            assert (np.abs(found.efforts) <= self.body.effort_limits).all()

    @rule(ago=st.integers(0, 60))
    def applies_a_diagnosis(self, ago):
        start = (self.stamp - ago * self.period_ns) * 1e-9
        self.change(effects=(f'payload@ft{{"start_stamp_s": {start!r}}}',))

    # Services

    @rule()
    def resets(self):
        self.given.clear()
        self.drafted = self.kept = False
        self.learner.reset()

    @rule()
    def tares(self):
        try:
            self.learner.take_tare()
        except SemiparamError as error:
            absurd = 'predicts nothing like' in str(error)  # a model of the paper's priors from so few samples
            assert absurd or 'no prediction of the last second' in str(error)

    @rule()
    def saves(self):
        self.saved[:] = [(pickle.loads(pickle.dumps(self.learner.state())), list(self.given), self.drafted)]

    @precondition(lambda self: self.saved)
    @rule()
    def loads(self):
        state, given, self.drafted = self.saved[0]
        self.given[:] = given
        self.learner.restore(pickle.loads(pickle.dumps(state)))

    @rule()
    def exports(self):
        """Bodies that can be, to the ten digits of a file, whatever was learnt; nothing of the life changes."""
        try:
            estimate = from_estimator(self.learner.estimator, None, 'the life')
        except SemiparamError as error:
            assert 'no model yet' in str(error) or 'learns no inertial parameters' in str(error), error
            return
        with TemporaryDirectory() as folder:
            export_to(Path(folder), 'life', self.settings.robot_description, estimate)
            text = Path(folder, 'life.urdf').read_text()
        assert np.isfinite(build_rigid_body(replace(self.settings, robot_description=text)).base_parameters).all()
        for link in described_links(text).values():
            moments = np.linalg.eigvalsh(pseudo_inertia(link))
            assert moments[0] > -1e-9 * moments[-1]

    # The background

    def run_tasks(self):
        self.background.run(0)

    @rule(count=st.integers(1, 3))
    def works(self, count):
        self.background.run(count)

    @precondition(lambda self: self.background.jobs)
    @rule()
    def loses_its_worker(self):
        job = self.background.jobs.popleft()
        if not job.cancelled:
            job.done(None, SemiparamError('the background process died 2 times over it.'))

    # What always holds

    @invariant()
    def answers_at_once_and_in_order(self):
        assert self.answers == self.offered

    @invariant()
    def has_one_successor_at_most_and_no_orphans(self):
        if self.learner is None:
            return
        switcher = self.learner.switcher
        working = [model for model in switcher.models if model.state is not State.LIVE]
        jobs = [job for job in self.background.jobs if not job.cancelled]
        assert len(jobs) <= len(working)
        if switcher.successor is not None:
            assert same_model(switcher.successor.settings, self.learner.settings)

    @rule()
    def comes_to_rest(self):
        """When all is quiet, the model is that of a fresh estimator that was given the same."""
        self.background.run()
        learner = self.learner
        assert learner.switcher.successor is None
        assert same_model(learner.built, learner.settings)
        known = known_of(learner.estimator) if learner.switcher.renewed else None  # of a window chosen at some time
        fresh = self.given_again(known)
        assert fresh.ready == learner.estimator.ready
        if not fresh.ready or self.kept:
            return  # the provisional model has also learnt from windows that gave no hyperparameters
        if known and any(plain(np.array(learning)) == Learning.AFTER_CHANGE for _, learning in self.given):
            return  # a later window's model learns nothing from before a change
        mine, its = (each.model.hyperparameters for each in (learner.estimator, fresh))
        if max(mine.sigma, its.sigma) < ROUNDED:
            return  # twenty samples were explained to the last digit, and nothing but rounding is left
        if fresh.input_scaling is not None and known_of(fresh) != known_of(learner.estimator):
            # columns of a batch and of one sample after the other differ by rounding, and flat maxima by more
            for ours, theirs in zip((mine, *learner.estimator.others), (its, *fresh.others), strict=True):
                np.testing.assert_allclose([ours.sigma, *ours.output_scale], [theirs.sigma, *theirs.output_scale],
                                           rtol=5e-3)
            fresh = self.given_again(known_of(learner.estimator))
        assert learner.estimator.origin == fresh.origin, 'time counts from the same moment'
        for ours, theirs in zip(learner.estimator.ensemble.models, fresh.ensemble.models, strict=True):
            for name in ('calibration', 'wandering'):  # of a model that weighs little an answer shows nothing
                if (found := getattr(ours, name)) is not None:
                    np.testing.assert_allclose(found.table, getattr(theirs, name).table, rtol=1e-6, atol=1e-6)
            assert ours.window_left == theirs.window_left
        for sample in self.motion[::80]:
            sample = self.now(sample)
            expected, found = fresh.predict(sample), learner.estimator.predict(sample)
            np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(found.std, expected.std, rtol=1e-6, atol=1e-6)

    def given_again(self, known):
        """A fresh estimator that learns all that was given."""
        fresh = new_estimator(self.learner.built, self.body, known, self.learner.history.origin)
        for sample, learning in self.given:
            see_again(fresh, sample, learning)
        if self.learner._anew:
            fresh.forget_offset()
        return fresh

    def teardown(self):
        if self.learner is not None:
            self.comes_to_rest()


class EffortLives(Lives):
    """The same with the efforts of the joints, which have friction."""

    settings = replace(SMALL, outputs='effort', sensor_frame='', temperatures=JOINTS)
    body = build_rigid_body(settings)
    motion = motion(400, body=body)
    fast = fast(motion, body)
    effects = EFFORT_EFFECTS


ROUNDED = 1e-9
"""Of the outputs' scale: noise that the positions and efforts of a life, of fifteen digits, do not hold."""

LIVES = hypothesis.settings(max_examples=hypothesis.settings.default.max_examples // 10,
                            stateful_step_count=40, deadline=None,
                            phases=[Phase.explicit, Phase.reuse, Phase.generate],  # not shrinking
                            suppress_health_check=list(hypothesis.HealthCheck))
PATCHES = {'online.renewal.LEAST_DRAFT': 1,
           'online.model_jobs.OLDER': 1}  # a fresh estimator learns all
for kind in (Lives, EffortLives):
    kind.TestCase.settings = LIVES
    for name, value in PATCHES.items():
        kind.TestCase.runTest = patch(f'semiparam_ros.{name}', value)(kind.TestCase.runTest)
TestLives, TestEffortLives = Lives.TestCase, EffortLives.TestCase


def with_a_window():
    """A life whose SPK-ML has its hyperparameters, and an effect that remembers the past."""
    life = Lives()
    life.begin()
    life.chooses('SPK-ML')
    life.declares(['time_delay{"delay_s": 0.005}'])
    life.moves(40)
    life.background.run()
    return life


def test_a_file_holds_what_a_life_goes_on_with(tmp_path, monkeypatch):
    """The state that the lives above keep in memory is the one that the file gives back."""
    monkeypatch.setattr('semiparam_ros.online.model_jobs.OLDER', 1)  # a fresh estimator learns all
    life = with_a_window()
    save(tmp_path / 's.npz', life.learner.state())
    life.learner.restore(load(tmp_path / 's.npz', life.learner.settings, BODY))
    life.moves(40)
    life.comes_to_rest()


def test_a_life_in_which_the_hyperparameters_are_estimated_again(tmp_path, monkeypatch):
    monkeypatch.setattr('semiparam_ros.online.model_jobs.MOST_WORSE', np.inf)
    monkeypatch.setattr('semiparam_ros.online.model_jobs.OLDER', 1)
    monkeypatch.setattr('semiparam_ros.online.renewal.LEAST_DRAFT', 1)
    life = with_a_window()
    life.moves_fast(45)
    life.background.run()  # so few samples give no draft
    life.moves_fast(1)
    life.shadows(['NP-ML'])
    assert not life.learner.switcher.renewed and life.learner.switcher.successor is not None
    life.moves(10)
    life.comes_to_rest()
    assert life.learner.switcher.renewed
    save(tmp_path / 's.npz', life.learner.state())
    life.learner.restore(load(tmp_path / 's.npz', life.learner.settings, BODY))
    assert life.learner.switcher.renewed
    life.chooses('SP2-ML')
    life.moves_fast(40)
    life.comes_to_rest()
    life.resets()
    assert not life.learner.switcher.renewed


def test_a_state_saved_while_a_draft_answers_is_refined_as_the_life_that_went_on(monkeypatch):
    """The draft's hyperparameters counted as the final ones."""
    monkeypatch.setattr('semiparam_ros.online.renewal.LEAST_DRAFT', 1)
    life = Lives()
    life.begin()
    life.chooses('SP-ML')
    life.shadows(['NP-ML', 'P'])
    life.comes_to_rest()
    life.moves(32)
    life.background.run(3)
    life.saves()
    assert life.learner.estimator.ready and life.learner.switcher.successor is not None
    life.loads()
    life.comes_to_rest()


def test_a_clock_that_jumps_while_a_model_is_built_jumps_for_it_at_the_same_sample():
    """It used to forget what its effects remember after all that waited, the samples after the jump among them."""
    life = Lives()
    life.begin()
    life.moves(21)
    life.declares(['time_delay{"delay_s": 0.005}'])
    life.clock_jumps(-YEAR_NS)
    life.moves(3)
    life.comes_to_rest()


def test_averaged_variants_live_as_any_other(tmp_path, monkeypatch):
    """Chosen while another one answers, and left again; a file; a jump of the clock; rest; another window."""
    monkeypatch.setattr('semiparam_ros.online.model_jobs.OLDER', 1)
    life = Lives()
    life.begin()
    life.chooses('SPK-ML')
    life.moves(40)
    life.background.run()
    life.chooses('auto')
    life.moves(5)
    life.background.run()
    life.moves(5)
    assert life.learner.built.variant == 'auto' and life.learner.estimator.weights
    life.comes_to_rest()
    save(tmp_path / 's.npz', life.learner.state())
    life.learner.restore(load(tmp_path / 's.npz', life.learner.settings, BODY))
    life.clock_jumps(-YEAR_NS)
    life.rests(60)
    life.moves_fast(45)
    life.comes_to_rest()
    life.chooses('P')
    life.shadows(['auto'])
    life.moves(5)
    life.comes_to_rest()
    life.chooses('auto')
    assert life.learner.built.variant == 'auto', 'the shadow takes over at once'
    life.resets()
    life.moves(40)
    life.comes_to_rest()
    assert life.learner.estimator.weights


def test_priors_and_friction_are_switched_and_back(tmp_path, monkeypatch):
    monkeypatch.setattr('semiparam_ros.online.model_jobs.OLDER', 1)
    life = EffortLives()
    life.begin()
    life.chooses('SPK-ML')
    life.moves(40)
    life.comes_to_rest()
    for priors, joint_friction in (('paper', True), ('paper', False), ('physical', True)):
        life.holds_beforehand(priors, joint_friction)
        life.moves(5)
        life.comes_to_rest()
        columns = life.learner.estimator.columns
        assert (columns.physical, columns.has_friction) == (priors == 'physical', joint_friction)
        save(tmp_path / 's.npz', life.learner.state())
        life.learner.restore(load(tmp_path / 's.npz', life.learner.settings, life.body))
        life.comes_to_rest()


def test_a_window_given_again_leaves_bands_and_offset_as_the_first_time():
    """The offset of the model that was given it again ebbed at samples that had not been learnt."""
    settings = replace(SMALL, variant='SPK-ML')
    learnt = [True] * 10 + [False] * 30 + [True] * 10
    first = new_estimator(settings, BODY)
    for estimator in (first, None):
        estimator = estimator or new_estimator(settings, BODY, known_of(first))
        for sample, learn in zip(MOTION, learnt, strict=False):
            observe(estimator, estimator.predict(sample._replace(temperature=np.zeros(1))), learn)
    for ours, theirs in zip(first.ensemble.models, estimator.ensemble.models, strict=True):
        for name in ('calibration', 'wandering'):
            tables = getattr(ours, name).table, getattr(theirs, name).table
            np.testing.assert_allclose(*tables, rtol=1e-9, atol=1e-9)


def test_a_window_that_follows_a_jump_and_one_without_hyperparameters_has_the_same_time():
    """A model built later counted time from the start, and so took the jump for time."""
    life = Lives()
    life.begin()
    life.declares(['payload@ft{"start_s": 0.5}'])
    life.moves_with_a_dead_sensor(5)
    life.clock_jumps(YEAR_NS)
    life.moves_with_a_dead_sensor(16)
    life.background.run()
    assert not life.given
    life.moves(40)
    life.comes_to_rest()
    life.chooses('SP2-VS')
    life.comes_to_rest()


def test_what_is_rest_is_judged_once_by_the_model_in_force():
    """Each model beside it judged by its own predictions, and one built later by what a history
    keeps of a rest."""
    life = EffortLives()
    life.begin()
    life.chooses('SP2-VS')
    life.moves(22)
    life.background.run()
    life.rests(50)
    life.declares(['payload@ft'])
    life.comes_to_rest()
    life.moves(5)
    life.comes_to_rest()
