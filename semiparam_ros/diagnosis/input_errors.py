"""Noise in the inputs leaves structure in a residual that is no effect of the robot.

Least squares on noisy regressors is pulled towards zero where the motion hardly excites them, and what it then leaves
is a function of the motion. That function lies near the span of the regressors at inputs with other noise: the same
motion, smoothed a little more and a little less. On simulated circles with nothing missing the share that flexible
regression finds falls from up to 5 % to at most 0.4 %; a bump or a resonance at half size keeps 23 % or more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import savgol_filter

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.exclusion import typical_step

WINDOWS = (9, 15)
"""Samples of a moving polynomial of degree DEGREE: at 20 Hz about half a second and three quarters."""
DEGREE = 4
RANK = 1e-7


def without_input_errors(body: RigidBody, samples: Samples, residual: Array, use: Mask, scale: Array) -> Array:
    """(N, n) residual less all that regressors at differently smoothed inputs explain of it.

    :param use: (N,) samples that fit. :param scale: (n,) weight of channel k is 1 / scale[k]^2.
    """
    if use.sum() < 4 * max(WINDOWS):
        return residual
    others = [body.regressors(resmoothed(samples, window)) for window in WINDOWS]
    columns = np.concatenate([body.regressors(samples), *others], axis=2)
    rows = (columns[use] / scale[:, None]).reshape(-1, columns.shape[2])
    size = np.linalg.norm(rows, axis=0) + 1e-12
    change = np.linalg.lstsq(rows / size, (residual[use] / scale).ravel(), rcond=RANK)[0] / size
    return np.asarray(residual - columns @ change)


def resmoothed(samples: Samples, window: int) -> Samples:
    """Positions and velocities by a moving polynomial, accelerations as the derivative of the velocities."""
    step = typical_step(samples.time)
    return replace(samples, position=savgol_filter(samples.position, window, DEGREE, axis=0),
                   velocity=savgol_filter(samples.velocity, window, DEGREE, axis=0),
                   acceleration=savgol_filter(samples.velocity, window, DEGREE, deriv=1, delta=step, axis=0))
