"""Noise in a residual: its floor, its correlation time, noise of the same colour, and what noise in the
inputs leaves in it.

A sensor's noise may be correlated over a second. A function of the motion fitted on some blocks then predicts a little
of their neighbours, though nothing is missing. Autoregressive noise with the residual's own autocorrelation shows how
much: it knows nothing of the motion, so what flexible regression finds in it is chance.

Noise in the inputs leaves structure in a residual that is no effect of the robot. Least squares on noisy regressors is
pulled towards zero where the motion hardly excites them, and what it then leaves is a function of the motion. That
function lies near the span of the regressors at inputs with other noise: the same motion, smoothed a little more and a
little less. On simulated circles with nothing missing the share that flexible regression finds falls from up to 5 % to
at most 0.4 %; a bump or a resonance at half size keeps 23 % or more.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import scipy  # it loads scipy.signal, and all of scipy.stats for that, with the first use
from scipy.linalg import solve_toeplitz

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.signals.correlation import autocovariance
from semiparam_ros.core.signals.rests import typical_step
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import gaps
from semiparam_ros.diagnosis.regression import Fit, refit_weights, refitted

WHITENING = 1e-9
"""Share of the power that keeps the equations of a residual that is nearly periodic solvable."""
RANK = 1e-7


def noise_floor(residual: Array, counted: Mask) -> Array:
    """(n,) standard deviation of what changes from sample to sample without any pattern.

    Third differences cancel whatever varies slowly and keep white noise with a gain of sqrt(20) (von Neumann 1941).

    :param counted: (M, n) outputs that tell something: where a joint comes to rest its effort jumps.
    """
    whole = np.lib.stride_tricks.sliding_window_view(counted, 4, axis=0).all(axis=-1)
    squares = np.diff(residual, 3, axis=0) ** 2 * whole
    return np.asarray(np.sqrt(squares.sum(axis=0) / np.maximum(whole.sum(axis=0), 1) / 20.0))


def coloured_noise(residual: Array, count: int, seed: int = 0, config: DiagnosisConfig = DEFAULTS) -> Array:
    """(count, M, n) noise; each channel has the autocorrelation and the power of that of the residual (M, n)."""
    length, channels = 2 * len(residual), []  # it comes round: of twice the length, one half is what any stretch is
    white = np.fft.rfft(np.random.default_rng(seed).standard_normal((residual.shape[1], count, length)))
    for spectrum, values in zip(white, residual.T, strict=True):
        weights, deviation = _autoregression(values, config.noise_order)
        gain = deviation / np.abs(np.fft.rfft(np.append(1.0, -weights), length))
        channels.append(np.fft.irfft(spectrum * gain, length)[:, :len(residual)])
    return np.stack(channels, axis=2)


def _autoregression(values: Array, order: int) -> tuple[Array, float]:
    """(order,) weights of the past values, and the standard deviation of what they do not predict (Yule-Walker)."""
    covariance = autocovariance(values)[:order + 1] / len(values)
    if covariance[0] <= 0.0:
        return np.zeros(order), 0.0
    covariance[0] *= 1.0 + WHITENING
    weights = solve_toeplitz(covariance[:-1], covariance[1:])
    return weights, float(np.sqrt(covariance[0] - weights @ covariance[1:]))


def without_input_errors(fit: Fit) -> Array:
    """(N, n) residual of a model less all that regressors at differently smoothed inputs explain of it."""
    body, samples, config = fit.body, fit.samples, fit.config
    if fit.train_mask.sum() < 4 * max(config.resmoothing_windows):
        return fit.residual
    others = [body.regressors(resmoothed(samples, window, config)) for window in config.resmoothing_windows]
    columns = np.concatenate([body.regressors(samples), *others], axis=2)
    use = fit.counted & fit.train_mask[:, None]
    rows, left = (columns / fit.scale[:, None])[use], (fit.residual / fit.scale)[use]
    size = np.linalg.norm(rows, axis=0) + 1e-12
    change = np.linalg.lstsq(rows / size, left, rcond=RANK)[0] / size
    return np.asarray(fit.residual - columns @ change)


def resmoothed(samples: Samples, window: int, config: DiagnosisConfig = DEFAULTS) -> Samples:
    """The motion by a moving polynomial over ``window`` samples; accelerations are the derivative of velocities.

    Each stretch between gaps and breaks by itself; of one that is shorter than the window, the motion as it is.
    """
    edges = {part.start for part in samples.recordings} | {gap.before + 1 for gap in gaps(samples, config)}
    motion = [samples.position.copy(), samples.velocity.copy(), samples.acceleration.copy()]
    for start, end in pairwise(sorted({*edges, len(samples)})):
        if end - start >= window:
            smooth = partial(scipy.signal.savgol_filter, window_length=window, polyorder=config.resmoothing_degree,
                             delta=typical_step(samples.time[start:end]), axis=0)
            for values, (source, order) in zip(
                    motion, ((samples.position, 0), (samples.velocity, 0), (samples.velocity, 1)), strict=True):
                values[start:end] = smooth(source[start:end], deriv=order)
    return replace(samples, position=motion[0], velocity=motion[1], acceleration=motion[2])


def inertia_columns(body: RigidBody, samples: Samples, psi: Array) -> Array:
    """(N, n, n_joints) what an acceleration of one would add to the outputs, with base parameters
    psi (p,)."""
    still, columns = body.outputs_of(samples, psi), []
    for joint in range(body.n_joints):
        moved = samples.acceleration.copy()
        moved[:, joint] += 1.0
        columns.append(body.outputs_of(replace(samples, acceleration=moved), psi) - still)
    return np.stack(columns, axis=2)


def with_error_columns(fit: Fit) -> Fit:
    """The model with a column for each joint and each other smoothing: what that acceleration would
    change.

    A smoother takes a little of the motion for noise and leaves some of the noise. Both errors
    reach the outputs through the inertia matrix, are of the size of sensor noise where a fast
    motion is recorded at 20 Hz, and are a function of the motion: a small force beside the true
    effect explains some of them. Between accelerations smoothed more and less there is the same
    error, only larger, joint by joint. Whatever a search adds must explain more than these columns.
    """
    body, inputs = fit.corrected
    inertia = inertia_columns(body, inputs, fit.rigid_part)
    others = (resmoothed(inputs, window, fit.config) for window in fit.config.resmoothing_windows)
    columns = [inertia * (other.acceleration - inputs.acceleration)[:, None] for other in others]
    return refit_weights(refitted(fit, fit.effects, np.concatenate(columns, axis=2), fit.counted))


def without_error_columns(fit: Fit) -> Fit:
    """The same effects fitted to the motion as it is."""
    if fit.nuisance is None:
        return fit
    return refit_weights(refitted(fit, fit.effects, None, fit.counted))
