"""Hyperparameters of every model class, estimated from the initial window and then kept (Romeres et al. 2016)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from semiparam_ros.core.hyperparameters.autocorrelation import autocorrelation_time
from semiparam_ros.core.hyperparameters.feature_count import fewest_features
from semiparam_ros.core.hyperparameters.marginal_likelihood import Window
from semiparam_ros.core.hyperparameters.maximisation import EvidenceMaximum, draft_maximum, maximise_evidence
from semiparam_ros.core.hyperparameters.validation import Grid, select_by_validation
from semiparam_ros.core.hyperparameters.window import (
    LengthScales,
    Noise,
    check_window,
    input_groups,
    least_squares_beside,
    residual_scale,
    without_rounding,
)
from semiparam_ros.core.types import Array
from semiparam_ros.core.variants import single, variant_named


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters, which the initial window decides once; what a class does not have is 0, or
    None for ``pi``.

    :param gamma: prior standard deviation of theta (times the block's own prior scale).
    :param rho: prior standard deviation of the feature weights; of output k it is rho * output_scale[k].
    :param tau: 1 length scale, 3 (position, velocity, acceleration) or one for each input, of scaled inputs; P: none.
    :param sigma: noise standard deviation; of output k it is sigma * output_scale[k].
    :param output_scale: (n,), geometric mean one; ones when all outputs share one noise.
    :param pi: coefficients of the rigid body and the offset, for SP and SP2.
    :param features: number D of random features that these are for; 0: the class has none, or it is not known.
    :param drift_share: part of sigma^2 that is a slow drift, 0 to 1. :param drift_memory: its e-folding time
        [samples]; both only say what the window showed, predictions take all of sigma for white.
    :param autocorrelation_time: r, samples that together tell as much of the coupled columns as one of white noise
        (see ``autocorrelation``), where P learns them with physical priors; learning counts them so.
    """

    gamma: float
    rho: float
    tau: tuple[float, ...]
    sigma: float
    output_scale: tuple[float, ...]
    pi: tuple[float, ...] | None = None
    drift_share: float = 0.0
    drift_memory: float = 0.0
    features: int = 0
    autocorrelation_time: float = 1.0


def estimate(variant: str, outputs: Array, coupled: Array, inputs: Array, spectrum: Array, *,
             length_scales: LengthScales = 'one', noise: Noise = 'one', drifting: bool = True,
             method: str = 'quasi-newton', prior_scale: Array | None = None, starts: int = 4, jobs: int = 1,
             grid: Grid | None = None, progress: Callable[[int, int], None] | None = None,
             n_effects: int = 0, fewest: bool = False, draft: bool = False, prior_mean: Array | None = None,
             physical: bool = False) -> Hyperparameters:
    """Estimate the hyperparameters of a variant, or of the first of those averaged, from its initial window.

    :param outputs: Y (t, n). :param coupled: C (t, n, p), offset columns included. NP has the effects' columns alone.
    :param inputs: scaled inputs (t, m). :param spectrum: omega (d, m) of the random features; ignored by P.
    :param fewest: take as few features as are enough (see ``feature_count``), from the first on; a draft takes all.
    :param length_scales: one, one for each kind of input, or one for each input (VS then tries one for each kind).
    :param noise: one standard deviation, or one for each output.
    :param drifting: the evidence allows for slowly drifting noise; False: white noise, as in the paper.
    :param method: 'quasi-newton' or 'nelder-mead'; of no consequence to the VS variants.
    :param prior_scale: (p,) prior standard deviations of theta in units of gamma; ones if left out.
    :param progress: called as progress(done, total) by the VS variants.
    :param n_effects: of the coupled columns, the last so many are effects', which every variant learns online.
    :param draft: by a search of a fraction of a second, of the evidence for the VS variants too.
    :param prior_mean: (p,) of theta, where the variant learns it; zeros if left out.
    :param physical: ``prior_scale`` is in the units of theta, so gamma is 1; and features explain no more than the
        coupled columns leave (``Window.physical``). False: the paper's.
    :raises SemiparamError: unknown variant, too few samples, a constant or non-finite channel.
    """
    variant_named(variant)
    check_window(outputs, coupled, inputs)
    own = coupled.shape[2] - n_effects
    coupled = without_rounding(coupled, own)
    if prior_mean is not None:
        outputs = outputs - coupled[:, :, :own] @ prior_mean[:own] * (variant_named(variant).pi == 'learnt')
        outputs = outputs - coupled[:, :, own:] @ prior_mean[own:]
    kind, _, selection = single(variant).partition('-')
    scale = np.ones(coupled.shape[2]) if prior_scale is None else np.asarray(prior_scale, dtype=float)
    groups = input_groups('kind' if selection == 'VS' and length_scales == 'input' else length_scales,
                          inputs.shape[1])
    window = Window(outputs, coupled, inputs, spectrum, groups, scale, n_effects=n_effects, physical=physical)
    if selection == 'VS' and not draft:
        found = _by_validation(kind, window, noise, grid, progress, fewest)
        by_input = tuple(np.array(found.tau)[groups].tolist())
        return replace(found, tau=by_input) if length_scales == 'input' else found

    def search(of_kind: Window) -> EvidenceMaximum:
        return (draft_maximum(of_kind, noise, drifting, method) if draft else
                maximise_evidence(of_kind, noise, drifting, method, starts, jobs))

    pi = _posterior_mean_of_p(window, search, prior_mean) if kind == 'SP2' else None
    of_kind = _window_of_kind(kind, window, pi)
    maximum = search(of_kind)
    if fewest and len(of_kind.spectrum) and not draft:
        of_kind, maximum = fewest_features(of_kind, maximum, noise, drifting, method)
    found = _by_evidence(kind, maximum, maximum.theta[:_n_own(window)] if kind == 'SP' else pi,
                         2 * len(of_kind.spectrum))
    if kind != 'P' or not physical:
        return found
    return replace(found, autocorrelation_time=autocorrelation_time(of_kind, maximum.at))


def _by_evidence(kind: str, found: EvidenceMaximum, pi: Array | None, features: int) -> Hyperparameters:
    """The online model knows one noise: white part and drift together, so that its bands cover both."""
    at = found.at
    tau = () if kind == 'P' else tuple(at.tau.tolist())
    return Hyperparameters(at.gamma, at.rho, tau, at.sigma * float(np.sqrt(1.0 + at.kappa)),
                           tuple(at.output_scale.tolist()), None if pi is None else tuple(pi.tolist()),
                           at.kappa / (1.0 + at.kappa), at.memory if at.kappa else 0.0, features)


def _posterior_mean_of_p(window: Window, search: Callable[[Window], EvidenceMaximum],
                         prior_mean: Array | None) -> Array:
    """(p,) pi of SP2: least squares burst where the window shows little."""
    own = window.coupled.shape[2] - window.n_effects
    mean = np.zeros(own) if prior_mean is None else prior_mean[:own]
    around = replace(window, outputs=window.outputs - window.coupled[:, :, :own] @ mean)
    return mean + search(_window_of_kind('P', around, None)).theta[:own]


def _by_validation(kind: str, window: Window, noise: Noise, grid: Grid | None,
                   progress: Callable[[int, int], None] | None, fewest: bool) -> Hyperparameters:
    choice = select_by_validation(window, kind == 'SP2', noise, grid or Grid(), progress, fewest)
    pi = _mean_first(window, noise) if kind == 'SP2' else None
    return Hyperparameters(0.0, choice.rho, choice.tau, choice.sigma, choice.output_scale,
                           None if pi is None else tuple(pi.tolist()), features=choice.features)


def _window_of_kind(kind: str, window: Window, pi: Array | None) -> Window:
    """The window with only the terms that the class has (the table in core.variants)."""
    own = _n_own(window)
    spectrum, groups = window.spectrum, window.groups
    outputs, coupled, scale = window.outputs, window.coupled, window.prior_scale
    if kind == 'P':
        spectrum, groups = spectrum[:0], np.zeros(len(groups), dtype=np.int64)
    if kind == 'SP2' and pi is not None:
        outputs = outputs - coupled[:, :, :own] @ pi
    if kind in ('NP', 'SP2'):
        coupled, scale = coupled[:, :, own:], scale[own:]
    return replace(window, outputs=outputs, coupled=coupled, spectrum=spectrum, groups=groups, prior_scale=scale,
                   profiled=kind in ('NP', 'SP', 'SP2'))


def _n_own(window: Window) -> int:
    """Columns of the rigid body and the offset."""
    return window.coupled.shape[2] - window.n_effects


def _mean_first(window: Window, noise: Noise) -> Array:
    """pi of SP2-VS, by least squares."""
    own = _n_own(window)
    return plain_least_squares(window.outputs, window.coupled, noise, window.prior_scale[own:])[:own]


def plain_least_squares(outputs: Array, coupled: Array, noise: Noise, effect_std: Array | None = None) -> Array:
    """theta (p,) by least squares; with one noise for each output its channels are weighed by their own residuals.

    :param effect_std: (c,) prior standard deviations of the last columns, those of effects.
    """
    std = np.zeros(0) if effect_std is None else effect_std
    theta = least_squares_beside(outputs, coupled, std)
    if noise == 'one':
        return theta
    scale = residual_scale(outputs - coupled @ theta, outputs)
    return least_squares_beside(outputs / scale, coupled / scale[:, None], std)
