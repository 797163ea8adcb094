"""Checks and first guesses on the initial window, shared by both ways of choosing hyperparameters."""

from __future__ import annotations

from typing import Literal

import numpy as np

from semiparam_ros.core.random_features import KINDS
from semiparam_ros.core.samples import variance
from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.errors import SemiparamError

LengthScales = Literal['one', 'kind', 'input']
Noise = Literal['one', 'output']

FEWEST_SAMPLES = 20
ROUNDING = 1e-12
"""A column less than this, over the largest of the rigid body, holds rounding errors alone."""


def input_groups(length_scales: str, n_inputs: int) -> Stamps:
    """(m,) index of each input's length scale."""
    if length_scales == 'one':
        return np.zeros(n_inputs, dtype=np.int64)
    if length_scales == 'kind' and n_inputs % KINDS == 0:
        return np.repeat(np.arange(KINDS, dtype=np.int64), n_inputs // KINDS)
    if length_scales == 'input':
        return np.arange(n_inputs, dtype=np.int64)
    raise SemiparamError(f"unknown length scales '{length_scales}' for {n_inputs} inputs; "
                         "expected 'one', 'kind' or 'input'.")


def check_window(outputs: Array, coupled: Array, inputs: Array) -> None:
    """Refuse windows from which nothing can be estimated, in one sentence each."""
    if len(outputs) < FEWEST_SAMPLES:
        raise SemiparamError(f'the initial window holds {len(outputs)} samples; expected at least {FEWEST_SAMPLES}.')
    if not len(outputs) == len(coupled) == len(inputs):
        raise SemiparamError(f'the initial window holds {len(outputs)} outputs, {len(coupled)} regressors and '
                             f'{len(inputs)} inputs; expected one of each for a sample.')
    for name, values in (('outputs', outputs), ('coupled columns', coupled), ('inputs', inputs)):
        if not np.isfinite(values).all():
            raise SemiparamError(f'the {name} of the initial window hold values that are not finite.')
    same = np.ptp(outputs, axis=0) <= 1e-12 * np.abs(outputs).max(axis=0)
    constant = np.flatnonzero(same | (variance(outputs) == 0.0))  # squares of 1e-300 are none
    if len(constant):
        channels = ', '.join(str(channel) for channel in constant)
        raise SemiparamError(f'output {channels} (counted from 0) is constant over the initial window; '
                             'expected every output to vary, for its noise is estimated there.')


def without_rounding(coupled: Array, n_own: int) -> Array:
    """C (t, n, p) with those columns zero that hold rounding errors alone, as most of a robot at rest.

    Scaled up they would fit a constant with coefficients of 1e15, the start of the search for gamma among them.

    :param n_own: columns of the rigid body and the offset, [N] or [N m] for a coefficient of 1.
    """
    sizes = np.sqrt(np.mean(coupled**2, axis=(0, 1)))
    return coupled * (sizes > ROUNDING * max(1.0, sizes[:n_own].max(initial=0.0)))


def least_squares(outputs: Array, coupled: Array) -> Array:
    """(p,) minimum-norm least squares of Y (t, n) on C (t, n, p), columns scaled first."""
    if not coupled.shape[2]:
        return np.zeros(0)
    rows = coupled.reshape(-1, coupled.shape[2])
    norms = np.linalg.norm(rows, axis=0)
    scale = np.where(norms > 0.0, 1.0 / np.maximum(norms, np.finfo(float).tiny), 0.0)
    return np.asarray(scale * np.linalg.lstsq(rows * scale, outputs.ravel(), rcond=1e-9)[0])


def least_squares_beside(outputs: Array, coupled: Array, effect_std: Array) -> Array:
    """(p,) the same with a Gaussian prior on the last columns, of standard deviations ``effect_std`` (c,).

    What the samples do not excite of them stays zero, and what they hardly excite stays within its prior.
    """
    theta = least_squares(outputs, coupled)
    if not len(effect_std):
        return theta
    p = coupled.shape[2]
    sigma = float(np.sqrt(np.mean(residual_scale(outputs - coupled @ theta, outputs) ** 2)))
    prior = np.zeros((len(effect_std), 1, p))
    prior[:, 0, p - len(effect_std):] = np.diag(sigma / effect_std)
    return least_squares(np.concatenate([outputs.reshape(-1, 1), np.zeros((len(effect_std), 1))]),
                         np.concatenate([coupled.reshape(-1, 1, p), prior]))


def residual_scale(residuals: Array, outputs: Array) -> Array:
    """(n,) root mean square of each channel's residual, never below a millionth of the channel's own, nor zero."""
    floor = np.maximum(1e-6 * np.sqrt(np.mean(outputs**2, axis=0)), 1e-12)
    return np.asarray(np.maximum(np.sqrt(np.mean(residuals**2, axis=0)), floor))


def normalised(scale: Array) -> Array:
    """(n,) with geometric mean one: the common factor belongs to sigma and rho."""
    return np.asarray(scale / np.exp(np.mean(np.log(scale))))
