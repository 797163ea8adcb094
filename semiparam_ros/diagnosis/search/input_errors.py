"""What errors of estimated accelerations do to the outputs, as columns that any effect must explain more than.

A smoother takes a little of the motion for noise and leaves some of the noise. Both errors reach the outputs through
the inertia matrix, are of the size of sensor noise where a fast motion is recorded at 20 Hz, and are a function of the
motion: a small force beside the true effect explains some of them. Between accelerations smoothed more and less there
is the same error, only larger, joint by joint. Columns of that difference stand for it in every model of the search.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.config import DiagnosisConfig
from semiparam_ros.diagnosis.regression import Fit, refit_weights, refitted
from semiparam_ros.diagnosis.residual.noise import resmoothed


def with_error_columns(fit: Fit) -> Fit:
    """The model with a column for each joint and each other smoothing: what that acceleration would change."""
    body, inputs = fit.corrected
    still = body.outputs_of(inputs, fit.rigid_part)
    columns = []
    for joint, errors in enumerate(np.moveaxis(_differences(inputs, fit.config), 2, 0)):
        moved = inputs.acceleration.copy()
        moved[:, joint] += 1.0
        inertia = body.outputs_of(replace(inputs, acceleration=moved), fit.rigid_part) - still  # linear in it
        columns += [inertia * error[:, None] for error in errors]
    return refit_weights(refitted(fit, fit.effects, np.stack(columns, axis=2), fit.counted))


def without_error_columns(fit: Fit) -> Fit:
    """The same effects fitted to the motion as it is."""
    return fit if fit.nuisance is None else refit_weights(refitted(fit, fit.effects, None, fit.counted))


def _differences(samples: Samples, config: DiagnosisConfig) -> Array:
    """(windows, N, n_joints) accelerations smoothed over each window of samples, less those that there are."""
    found = np.zeros((len(config.resmoothing_windows), *samples.acceleration.shape))
    for part in samples.recordings:
        alone = replace(samples[part], breaks=())
        for number, window in enumerate(config.resmoothing_windows):
            if len(alone) >= window:
                other = resmoothed(alone, window, config.resmoothing_degree)
                found[number, part] = other.acceleration - alone.acceleration
    return found
