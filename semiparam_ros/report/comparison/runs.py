"""The work of a comparison, in pieces that can run anywhere: learn a model, go on with it on one subset."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.hyperparameters import Hyperparameters
from semiparam_ros.core.model import Estimator
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.report.comparison.scenario import Scenario
from semiparam_ros.report.initial_window import fitted_settings
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator


class Trace(NamedTuple):
    """N predicted samples and the horizon errors of K origins, in N and N m; times [s] since the first sample."""

    errors: Array  # (N, n) predicted minus measured
    outputs: Array  # (N, n)
    std: Array  # (N, n) predictive
    log_density: Array  # (N,) [nat]
    horizon_time: Array  # (K,)
    eps: Array  # (K, n)


class TrainedModel(NamedTuple):
    """All that it takes to go on from where the first recording left a model."""

    variant: str
    seed: int
    settings: Settings
    state: dict[str, Array]


class Learnt(NamedTuple):
    """A model, its hyperparameters, and how learning the first recording went."""

    model: TrainedModel
    hyperparameters: Hyperparameters
    fit_seconds: float
    trace: Trace


class Followed(NamedTuple):
    """What a learnt model did on one subset of the second recording."""

    variant: str
    seed: int
    subset: int
    adaptive: Trace  # predict, then learn
    frozen: Trace  # predict only


def learn(scenario: Scenario, variant: str, seed: int) -> Learnt:
    """Hyperparameters from the initial window, then the rest of the first recording, sample by sample."""
    initial = scenario.settings.initial_samples
    chosen = replace(scenario.settings, variant=variant, features_seed=seed)
    start = time.perf_counter()
    settings, hyperparameters = fitted_settings(chosen, scenario.train[:initial], scenario.robot_description,
                                                scenario.estimation)
    seconds = time.perf_counter() - start
    estimator = build_estimator(settings, scenario.robot_description, scenario.train.origin)
    run_through(estimator, scenario.train[:initial], learning=True)
    estimator.clear_pending()
    trace = run_through(estimator, scenario.train[initial:], learning=True)
    model = TrainedModel(variant, seed, settings, estimator.model.recursion.state())
    return Learnt(model, hyperparameters, seconds, trace)


def follow(scenario: Scenario, model: TrainedModel, subset: int) -> Followed:
    """One subset from the trained model, with and without learning it."""
    first, last = scenario.subsets[subset]
    samples = scenario.test[first:last]
    traces = []
    for learning in (True, False):
        estimator = build_estimator(model.settings, scenario.robot_description, samples.origin)
        estimator.model.recursion.restore(model.state)
        traces.append(run_through(estimator, samples, learning))
    return Followed(model.variant, model.seed, subset, *traces)


def run_through(estimator: Estimator, samples: Samples, learning: bool) -> Trace:
    """Predict, then perhaps learn, every sample."""
    mean, std = np.empty_like(samples.outputs), np.empty_like(samples.outputs)
    density = np.empty(len(samples))
    horizons = []
    for row, sample in enumerate(samples):
        prediction = estimator.step(sample, learning)
        mean[row], std[row], density[row] = prediction.mean, prediction.std, prediction.log_density
        if prediction.horizon is not None:
            horizons.append(prediction.horizon)
    origins = np.array([horizon.origin for horizon in horizons], dtype=np.int64)
    eps = np.array([horizon.eps for horizon in horizons]).reshape(-1, samples.outputs.shape[1])
    return Trace(mean - samples.outputs, samples.outputs, std, density, 1e-9 * (origins - samples.stamps[0]), eps)
