"""A node says by itself that a sign is wrong, and forgets it with the samples that said so."""

from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.diagnosis.setup.checks import NO_MATCH, setup_problems
from semiparam_ros.effects import effect_from_text, kinds
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import diagnosis_jobs
from semiparam_ros.online.history import batch_of
from semiparam_ros.ros.estimator.services import _written
from semiparam_ros.ros.estimator.setup_check import SetupCheck
from support.learner_stage import Stage
from support.node_helpers import BODY, JOINTS, SETTINGS, DelayedBackground, InlineBackground, motion

SENTENCE = 'set the parameter wrench_convention to'


def test_a_wrong_sign_is_told_before_anybody_asks(start_node):
    """Links of less than no mass were learnt without a word."""
    node, client = start_node(replace(SETTINGS, variant='P', acceleration_source='measured'))
    client.offer('joint_states', 'joint_accelerations', 'wrench')
    samples = motion(2400)

    def looks(some):
        """The report of learning after the last look at the samples: the one at more than half of them. The first one
        is at 800 at most, and how many it has hangs on the machine."""
        for part, most in ((some[:800], 0), (some[800:], len(some) // 2)):
            client.play(part, JOINTS)
            report = client.wait_report('learning', lambda level, message, values, most=most: most < int(
                values['samples that the set-up was checked with']))
        return report

    level, message, _ = looks([sample._replace(outputs=-sample.outputs) for sample in samples])
    assert level == DiagnosticStatus.WARN and 'The wrench has the opposite sign' in message
    client.wait(lambda: SENTENCE in node.output, 'it is in the log')
    assert client.trigger('reset').success
    client.wait_report('learning', lambda level, message, values: values[
        'samples that the set-up was checked with'] == '0')
    told = looks([sample._replace(stamp=sample.stamp + 60 * 10**9) for sample in samples])
    assert told[:2] == (DiagnosticStatus.OK, 'learning with P.')
    assert node.output.count(SENTENCE) == 1


def test_a_history_that_lets_samples_go_forgets_no_problem_and_a_reset_forgets_them():
    stage, background = Stage(replace(SETTINGS, variant='P'), InlineBackground()), DelayedBackground()
    check = SetupCheck(background, stage.failed)
    samples = [sample._replace(outputs=-sample.outputs) for sample in motion(1600)]
    for part in (samples[:800], samples[800:1200], samples[1200:]):
        stage.offer(part)
        check.look(stage.learner)
        assert len(background.jobs) == (len(part) == 800 or part[0] is samples[1200]), 'twice as many, or none'
        background.run()
        assert part[0] is not samples[0] or (check.checked == 800 and not check.problems), 'one look may err'
    assert check.checked == 1600 and SENTENCE in check.problems[0]
    check._looked_at = 2000
    check.look(stage.learner)
    assert SENTENCE in check.problems[0] and not background.jobs
    stage.learner.reset()
    check.look(stage.learner)
    assert check.problems == [] and check.checked == 0 and not stage.failures


def test_that_no_inertias_explain_the_outputs_is_told_by_a_diagnosis_alone():
    """Somebody may push the arm."""
    rng = np.random.default_rng(0)
    batch = batch_of((sample._replace(outputs=10.0 * rng.standard_normal(6)), 1) for sample in motion(800))
    assert NO_MATCH in [problem.what for problem in setup_problems(BODY, batch.samples)]
    assert diagnosis_jobs.setup_problems(BODY, batch, (), (), ()) == {}


def test_a_saved_state_names_what_is_not_in_it():
    load = kinds()['payload']('hand')
    assert _written('s.npz', [], '') == 's.npz is written.'
    told = _written('s.npz', [load], 'it is s.npz.1 now.')
    assert told == ('s.npz is written. The one before: it is s.npz.1 now. Not in it, as it is not applied yet: '
                    'payload at hand; save again then.')


def test_a_problem_is_the_same_whatever_its_figures_are():
    """Shares, steps and ratios differ from look to look."""
    stage, background = Stage(replace(SETTINGS, variant='P'), InlineBackground()), DelayedBackground()
    check = SetupCheck(background, stage.failed)
    rng = np.random.default_rng(0)
    samples = [sample._replace(velocity=sample.velocity / 3.0 * (1.0 + 0.1 * rng.standard_normal(2)))
               for sample in motion(1600)]
    told = []
    for part in (samples[:800], samples[800:]):
        stage.offer(part)
        check.look(stage.learner)
        told.append(diagnosis_jobs.setup_problems(BODY, stage.learner.history.span(300.0), (), (), ()))
        background.run()
    assert told[0] and told[0] != told[1], 'the figures differ'
    assert check.problems == list(told[1].values()) and not stage.failures


def looked(samples, background, told=SENTENCE):
    """A stage and its check, after two looks that told something."""
    stage = Stage(replace(SETTINGS, variant='P'), InlineBackground())
    check = SetupCheck(background, stage.failed)
    for part in (samples[:800], samples[800:1600]):
        stage.offer(part)
        check.look(stage.learner)
        background.run()
    assert told in check.problems[0] and check.checked == 1600
    return stage, check


def test_a_look_at_little_or_that_fails_forgets_no_problem():
    """After a jump of the clock there are few samples; a process may be killed."""
    samples, background = [sample._replace(outputs=-sample.outputs) for sample in motion(3400)], DelayedBackground()
    stage, check = looked(samples, background)
    stage.offer(samples[1600:3190])
    stage.learner.clear_pending()
    stage.offer(samples[:20])
    check.look(stage.learner)
    background.run()
    assert SENTENCE in check.problems[0] and check.checked == 1600
    stage.offer(samples[20:1000])
    check.look(stage.learner)
    job = background.jobs.popleft()
    job.done(None, SemiparamError('the background process died 2 times over it.'))
    assert SENTENCE in check.problems[0] and check.checked == 1600 and not stage.failures
    check._looked_at = 1600
    check.look(stage.learner)
    background.run()
    assert SENTENCE in check.problems[0] and check.checked == 1000


def test_a_problem_that_declared_effects_mend_is_over_at_once():
    """A history that is full never holds twice as many samples."""
    text, rng, background = 'payload@ft{"mass": 5.0}', np.random.default_rng(0), DelayedBackground()
    coupled, samples = CoupledColumns(BODY, [effect_from_text(text)]), motion(1600)
    loaded = coupled.batch(batch_of((sample, 1) for sample in samples).samples)[0] @ coupled.prior_mean
    stage, check = looked([sample._replace(outputs=outputs + 0.01 * rng.standard_normal(6)) for sample, outputs in zip(
        samples, loaded, strict=True)], background, 'times what the robot description predicts')
    stage.learner.settings = replace(stage.learner.settings, effects=('sensor_offset',))
    check.look(stage.learner)
    background.run()
    assert check.problems, 'this one mends nothing'
    stage.learner.settings = replace(stage.learner.settings, effects=(text,))
    check.look(stage.learner)
    background.run()
    assert check.problems == [] and check.checked == 1600 and not stage.failures
    check.look(stage.learner)
    assert not background.jobs
    for effects in ((), ('sensor_offset',)):
        stage.learner.settings = replace(stage.learner.settings, effects=effects)
        check.look(stage.learner)
        background.run()
        assert check.problems == [], 'the same samples are no second look'
