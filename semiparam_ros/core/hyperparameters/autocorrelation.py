"""Information of a sample of a rigid body while noise stays alike for seconds.

Noise of covariance sigma^2 (I + kappa R) that is learnt as if it were white says the same thing
again and again. So many of its samples tell as much of the columns as one of white noise with the
same variance (the integrated autocorrelation time; Newey and West 1987):

    r = 1 + 2 sum_k rho_e(k) rho_x(k)

with the autocorrelations rho_e of the noise and rho_x of the columns, as far as that is positive.
A sample that counts 1 / r leaves more to the prior, which may be wrong. So r counts as far as it
does not harm on parts of the window that are left out (SafeBayes; Gruenwald and van Ommen 2017).
"""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.hyperparameters.marginal_likelihood import Point, Window
from semiparam_ros.core.types import Array

FOLDS = 5
"""Parts of the window; each is left out in turn."""


def autocorrelation_time(window: Window, at: Point) -> float:
    """Return the largest of 1, the root of r and r that predicts the left-out parts as well as the best of them, within
    a standard error (Breiman et al. 1984), of a rigid body with physical priors."""
    most = integrated_autocorrelation_time(window.coupled * window.prior_scale, at.kappa, at.memory)
    tried = np.array([1.0, np.sqrt(most), most])
    scale = at.sigma * np.sqrt(1.0 + at.kappa) * at.output_scale
    rows = window.coupled / scale[:, None] * window.prior_scale
    outputs = window.outputs / scale
    folds = np.array_split(np.arange(len(outputs)), FOLDS)
    flat = [(rows[fold].reshape(-1, rows.shape[2]), outputs[fold].ravel()) for fold in folds]
    grams, moments = (np.array(each) for each in zip(
        *((x.T @ x, x.T @ y) for x, y in flat), strict=True))
    losses = np.zeros((len(tried), FOLDS))
    others = zip(flat, grams.sum(axis=0) - grams, moments.sum(axis=0) - moments, strict=True)
    for fold, ((x, y), gram, moment) in enumerate(others):
        for number, r in enumerate(tried):
            theta = np.linalg.lstsq(gram + r * np.eye(len(gram)), moment, rcond=None)[0]  # singular to rounding
            losses[number, fold] = np.log(np.mean((y - x @ theta) ** 2))
    worse = losses - losses[losses.mean(axis=1).argmin()]
    as_good = worse.mean(axis=1) <= worse.std(axis=1) / np.sqrt(FOLDS - 1.0)
    return float(tried[as_good].max())


def integrated_autocorrelation_time(columns: Array, kappa: float, memory: float) -> float:
    """The r of columns (t, n, p), each as large as it may count."""
    t = len(columns)
    varying = columns.reshape(t, -1)
    varying = varying - varying.mean(axis=0)
    power = np.square(np.abs(np.fft.rfft(varying, 2 * t, axis=0))).sum(axis=1)
    alike = np.fft.irfft(power, 2 * t)[:t]
    if alike[0] <= 0.0 or kappa <= 0.0:
        return 1.0
    alike = alike / alike[0]
    end = int(np.argmax(alike <= 0.0)) or t
    noise = kappa / (1.0 + kappa) * np.exp(-np.arange(1, end) / memory)
    return float(1.0 + 2.0 * noise @ alike[1:end])
