"""Subsets of a second recording, each from the model that the first one left."""

from dataclasses import replace

import numpy as np

from semiparam_ros.experiments.comparison import ComparisonScenario, TrainedModel, follow
from semiparam_ros.experiments.scoreboard import samples_of
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator
from semiparam_ros.simulation.scenario import Scenario
from semiparam_ros.simulation.simulate import simulate


def followed(made, start_s, since_s):
    """A subset that begins so long after the start of its recording, with a load from ``start_s`` on."""
    samples = samples_of(made)
    settings = Settings(variant='P', joints=made.joint_names, sensor_frame=made.frame_id, initial_samples=50,
                        wrench_convention=made.convention, effects=(f'payload@r_hand{{"start_s": {start_s}}}',))
    estimator = build_estimator(settings, made.urdf, samples.origin)
    for sample in samples[:60]:
        estimator.step(sample)
    later = replace(samples, origin=samples.origin - round(since_s * 1e9))
    scenario = ComparisonScenario(settings, samples, later, made.urdf, ((0, 60),), ('P',), (0,))
    return follow(scenario, TrainedModel(settings, estimator.state()), 0).adaptive


def test_a_subset_hours_after_the_start_of_its_recording_is_at_its_own_time():
    """It was taken for a jump of the clock, by which time went back to an hour: the load never came."""
    made = simulate(Scenario(samples=60, robot_seed=1))
    soon, late = followed(made, 100.0, 110.0), followed(made, 7200.0, 7210.0)
    assert np.array_equal(soon.errors, late.errors)
