"""Hyperparameters from the initial window of a recording, with every choice that the estimation offers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters, estimate
from semiparam_ros.core.hyperparameters.validation import Grid
from semiparam_ros.core.model import AUTO
from semiparam_ros.core.random_features import input_scaling, spectrum
from semiparam_ros.core.robot.size import radians
from semiparam_ros.core.samples import Samples
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_rigid_body, declared_effects, hyperparameter_values, model_options


@dataclass(frozen=True)
class Estimation:
    """Options of :func:`semiparam_ros.core.hyperparameters.estimation.estimate`."""

    method: str = 'quasi-newton'
    starts: int = 4
    jobs: int = 1
    drifting: bool = True
    grid: Grid | None = None


def fitted_settings(settings: Settings, samples: Samples, robot_description: str | None,
                    estimation: Estimation | None = None,
                    progress: Callable[[int, int], None] | None = None) -> tuple[Settings, Hyperparameters]:
    """The settings with the hyperparameters of ``samples`` filled in, whatever they held, and those by name.

    Raises SemiparamError when the window tells too little, or does not fit the robot.
    """
    estimation = estimation or Estimation()
    body = build_rigid_body(settings, robot_description)
    options = model_options(replace(settings, hyperparameters_sigma=()))
    columns = CoupledColumns(body, declared_effects(settings), options.joint_friction, options.physical)
    coupled, _ = columns.batch(samples)
    mean, scale = input_scaling(samples.inputs, radians(body))
    omega = spectrum(len(mean), options.most_features, options.features_seed, options.features_frequencies)
    found = estimate(
        options.variant, samples.outputs, np.asarray(coupled), (samples.inputs - mean) / scale, omega,
        length_scales=options.length_scales, noise=options.noise, drifting=estimation.drifting,
        method=estimation.method, prior_scale=columns.prior_scale, starts=estimation.starts, jobs=estimation.jobs,
        grid=estimation.grid, progress=progress, n_effects=columns.n_effects,
        fewest=options.features_count == AUTO, prior_mean=columns.expected, physical=options.physical)
    values = hyperparameter_values(found, tuple(mean.tolist()), tuple(scale.tolist()))
    return settings.changed(values), found
