"""Hyperparameters are estimated again when later motion leaves the window that they are from."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online.renewal import later_window
from semiparam_ros.online.worker import InlineBackground
from support.learner_stage import Stage
from support.node_helpers import SETTINGS, faster, motion

TAKEOVER_AFTER = 15


SLOWER = replace(SETTINGS, initial_samples=100)
SAMPLES = motion(550)
DAY = [*faster(SAMPLES[:200], 0.15), *SAMPLES[200:]]


def renewals(stage):
    return sum('estimated again' in sentence for sentence in stage.news)


@pytest.mark.parametrize('variant', ['SPK-ML', 'NP-ML', 'SP2-ML'])
def test_once_where_motion_becomes_faster_and_live_as_offline(variant, monkeypatch):
    monkeypatch.setattr('semiparam_ros.online.renewal.LEAST_DRAFT', 1)
    settings = replace(SLOWER, variant=variant)
    stage, waited, scales = Stage(settings), 0, []
    for sample in DAY:
        stage.offer([sample])
        if stage.background.jobs:
            waited += 1
            if waited > TAKEOVER_AFTER:
                stage.background.run(1)
                waited = 0
        if stage.learner.estimator.ready:
            scales.append(stage.learner.estimator.input_scaling[1])
    assert renewals(stage) == 1 and 'has new hyperparameters and takes over' in stage.news[-1]
    assert (scales[-1] > 3.0 * scales[0])[2:].all()
    assert 'a draft of its hyperparameters' in stage.news[1]
    drafted, first, *later = stage.learner.takeovers
    assert 0 < drafted < first and len(later) == 2 and min(later) > 0
    offline = OfflineLearner(settings, [], lambda: None, stage.learner.takeovers)
    steps = [offline.step(sample, True) for sample in DAY]
    assert offline.renewals == 1
    np.testing.assert_allclose(stage.means, [step.mean for step in steps], rtol=1e-9, atol=1e-9)


def test_motion_within_the_window_is_no_reason():
    stage = Stage(SLOWER, InlineBackground())
    stage.offer([*SAMPLES[:200], *faster(SAMPLES[200:], 0.1)])
    assert renewals(stage) == 0


def test_a_window_that_gives_nothing_leaves_the_model_as_it_is_and_is_not_tried_for_ever():
    stage = Stage(SLOWER)
    stage.offer(DAY[:120])
    stage.background.run()
    ready = stage.learner.estimator
    for sample in DAY[120:]:
        stage.offer([sample])
        while stage.background.jobs:
            stage.background.jobs.popleft().done(None, SemiparamError('there was no memory for it.'))
    assert stage.learner.estimator is ready and stage.learner.learnt == len(DAY)
    assert 1 <= renewals(stage) <= 2 and 'goes on with those it has' in stage.news[-1]
    assert not stage.learner.switcher.renewed


def test_a_shadow_follows():
    stage = Stage(replace(SLOWER, shadow_variants=('NP-ML',)), InlineBackground())
    stage.offer(DAY)
    shadow = stage.learner.switcher.shadows['NP-ML'].estimator
    assert renewals(stage)
    np.testing.assert_allclose(shadow.input_scaling[1], stage.learner.estimator.input_scaling[1], rtol=0.5)


def test_a_later_window_is_made_of_the_latest_samples_learnt():
    learnt = np.ones(300, dtype=bool)
    learnt[250:260] = False
    chosen = later_window(learnt, 100)
    assert chosen.sum() == 100 and chosen[190:].sum() == 100 and not chosen[~learnt].any()
    assert later_window(learnt[:20], 100).all()
