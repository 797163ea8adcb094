"""A model of the outputs, of any class of the paper: its terms, its hyperparameters, and how it comes by them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log
from typing import TypeAlias

import numpy as np

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters, estimate
from semiparam_ros.core.hyperparameters.feature_count import MOST
from semiparam_ros.core.hyperparameters.window import LengthScales, Noise
from semiparam_ros.core.initial_window import InitialWindow
from semiparam_ros.core.random_features import RandomFeatures, spectrum
from semiparam_ros.core.recursion import Prior, SemiParametricRecursion
from semiparam_ros.core.robot.joint_friction import turning_variance
from semiparam_ros.core.robot.size import output_scale
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.core.variants import FREQUENCIES, VARIANTS, Variant, variant_named
from semiparam_ros.errors import SemiparamError

AUTO = 'auto'
"""Forgetting: the model forgets nothing, and what it leaves is followed at the pace that is seen. Number of features:
as few as the initial window asks for."""

EFFECT_GAMMA = 1.0
"""Standard deviation of effects over their prior scale, in the variants that have no gamma."""

PROVISIONAL_GAMMA, PROVISIONAL_SIGMA = 0.3, 0.1
"""Of the model before the first window is over, with the paper's priors. With physical ones gamma is 1, and the noise
is so large a share of what an output may be beside the described body (``robot.size.output_scale``)."""


class Model:
    """One variant with its hyperparameters: features, a fixed mean where pi is fixed, the recursion.

    Of the columns of C, those of the rigid body and the offset are learnt, fixed or absent, as the variant has it;
    those of effects, which stand last, are learnt in every variant.

    :param prior_scale: (p,) prior standard deviations of theta over gamma. :param prior_mean: (p,), zero unless given.
    :param n_effects: how many of the columns are effects'. :param directions: see :func:`turning_variance`.
    """

    def __init__(self, variant: Variant, hyperparameters: Hyperparameters, features: RandomFeatures | None,
                 prior_scale: Array, prior_mean: Array | None = None, forgetting: float = 1.0,
                 n_effects: int = 0, directions: Indices | None = None) -> None:
        self.variant, self.hyperparameters, self.features = variant, hyperparameters, features
        self.n_effects = n_effects
        own, everything = len(prior_scale) - n_effects, len(prior_scale)
        learnt = variant.pi == 'learnt'
        self.gamma = hyperparameters.gamma if learnt else EFFECT_GAMMA
        self.learnt = slice(0 if learnt else own, everything)
        """Columns of C that the recursion learns."""
        self.covered = slice(own if variant.pi == 'absent' else 0, everything)
        """Columns of C that ``theta`` has coefficients for."""
        self.pi = np.asarray(hyperparameters.pi, dtype=float) if variant.pi == 'fixed' else None
        self.recursion = SemiParametricRecursion(
            len(hyperparameters.output_scale), features.count if features else 0,
            self.gamma * prior_scale[self.learnt], hyperparameters.rho, hyperparameters.sigma,
            None if prior_mean is None else prior_mean[self.learnt], forgetting,
            np.array(hyperparameters.output_scale), hyperparameters.autocorrelation_time)
        self._directions: Indices = np.zeros(0, dtype=np.int64)
        if directions is not None and variant.pi != 'absent':
            self._directions = directions
        self._no_features = np.zeros(0)

    @property
    def theta(self) -> Array:
        """Coefficients, learnt or fixed, of the ``covered`` columns: of all, or of the effects where pi is absent."""
        return self.recursion.theta if self.pi is None else np.concatenate([self.pi, self.recursion.theta])

    def theta_std(self) -> Array:
        """Their posterior standard deviations; zero where pi is fixed."""
        std = np.zeros(len(self.theta))
        if self.recursion.n_columns:
            std[-self.recursion.n_columns:] = np.sqrt(np.diag(self.recursion.theta_covariance()))
        return std

    def part(self, block: slice) -> Array:
        """Coefficients of a block of columns; empty where the model has none for it."""
        start = self.covered.start
        return self.theta[block.start - start:block.stop - start] if block.start >= start else np.zeros(0)

    @property
    def by_steps(self) -> bool:
        """Tell whether it learns one sample of each step, as of the window that tells how much one counts."""
        return self.hyperparameters.autocorrelation_time > 1.0

    @property
    def noise_std(self) -> Array:
        """(n,) standard deviation of each output's noise, in N and N m."""
        return self.recursion.sigma * self.recursion.scale

    def predict(self, x: Array, columns: Array) -> Prior:
        """Prior of the recursion at x (m,), of which the columns (n, p) are all of C."""
        return self.predict_by(self.recursion, self.features(x) if self.features else self._no_features, columns)

    def predict_by(self, recursion: SemiParametricRecursion, phi: Array, columns: Array) -> Prior:
        """Prior of a recursion of this variant with features phi (D,)."""
        known = None if self.pi is None else columns[:, :len(self.pi)] @ self.pi
        learnt = columns[:, self.learnt] if self.learnt.start else columns
        extra_variance = None if not len(self._directions) else \
            turning_variance(self._directions, recursion.theta if self.pi is None else self.pi, columns)
        return recursion.predict(phi, learnt, known, extra_variance)


def information_gain(prior: Prior, noise_std: Array) -> float:
    """Bound on what learning a sample can tell of the model [nat]: the log of predictive over noise
    deviation (n,), summed over the outputs, whose correlation is left out."""
    return 0.5 * sum(map(log, (prior.std**2 / (noise_std**2 + prior.extra_variance)).tolist()))


@dataclass(frozen=True)
class ModelOptions:
    """Choices of a user; see docs/parameters.md. ``hyperparameters`` None: from the initial
    window."""

    variant: str = 'SPK-ML'
    features_count: int | str = 200
    features_seed: int = 0
    features_frequencies: str = FREQUENCIES[0]
    length_scales: LengthScales = 'kind'
    noise: Noise = 'output'
    initial_samples: int = 1000
    horizon: int = 25
    forgetting: float | str = AUTO
    learn_every: int = 1
    learn_least_gain: float = 0.0
    hyperparameters: Hyperparameters | None = None
    input_mean: tuple[float, ...] = ()
    input_scale: tuple[float, ...] = ()
    joint_friction: bool = True
    """Whether friction and offset of every joint are part of the rigid body's model, with joint efforts."""
    priors: str = 'physical'
    """What is held of the model before anything is measured: see :data:`~semiparam_ros.core.variants.PRIORS`."""
    others: tuple[Hyperparameters, ...] = ()
    """With given hyperparameters: those of the variants averaged with the first one; none: they have the same."""

    alone: bool = False
    """Whether no other model stands beside the variant, which has all effects that are declared."""

    @property
    def physical(self) -> bool:
        """Tell whether the priors are."""
        return self.priors == 'physical'

    @property
    def most_features(self) -> int:
        """Features that hyperparameters are estimated with; ``auto`` then chooses of them."""
        return self.features_count if isinstance(self.features_count, int) else MOST


InputScaling: TypeAlias = tuple[Array, Array]
"""(m,) mean and scale of the inputs of features."""


def provisional_model(columns: CoupledColumns, options: ModelOptions) -> Model:
    """The rigid body about the robot description, before the initial window is over."""
    gamma, scale = PROVISIONAL_GAMMA, np.ones(columns.body.n_outputs)
    if options.physical:
        gamma, scale = 1.0, output_scale(columns.body)
    hyperparameters = Hyperparameters(gamma=gamma, rho=1.0, tau=(1.0,), sigma=PROVISIONAL_SIGMA,
                                      output_scale=tuple(scale.tolist()), pi=None)
    return Model(VARIANTS['P'], hyperparameters, None, columns.prior_scale, columns.prior_mean,
                 n_effects=columns.n_effects, directions=columns.directions)


def model_with(hyperparameters: Hyperparameters, variant: str, columns: CoupledColumns, options: ModelOptions,
               scaling: InputScaling) -> Model:
    """The variant with these hyperparameters; as many features as they were estimated with, else as the options say.

    Raises SemiparamError when they do not fit the variant or the robot.
    """
    chosen, size, features = variant_named(variant), 3 * columns.body.n_joints, None
    count = hyperparameters.features or options.features_count
    _check_given(hyperparameters, variant, columns, scaling, count)
    if chosen.features:
        assert isinstance(count, int)
        features = RandomFeatures(size, count, options.features_seed, hyperparameters.tau, *scaling,
                                  options.features_frequencies)
    hyperparameters = replace(hyperparameters, features=features.count if features else 0)
    forgetting = options.forgetting if isinstance(options.forgetting, float) else 1.0
    return Model(chosen, hyperparameters, features, columns.prior_scale, columns.expected, forgetting,
                 columns.n_effects, columns.directions)


def _check_given(hyperparameters: Hyperparameters, name: str, columns: CoupledColumns, scaling: InputScaling,
                 count: int | str) -> None:
    variant, size, body = variant_named(name), 3 * columns.body.n_joints, columns.body
    mean, scale = map(len, scaling)
    if variant.features and not mean == scale == size:
        raise SemiparamError(f'hyperparameters.input_mean and .input_scale hold {mean} and {scale} values; expected '
                             f'{size}, three for each joint.')
    if variant.features and count == AUTO:
        raise SemiparamError('features.count is auto, but hyperparameters are given; expected the number of features '
                             'that they were estimated with.')
    if variant.pi == 'fixed' and len(hyperparameters.pi or ()) != columns.n_own:
        raise SemiparamError(f'hyperparameters.pi holds {len(hyperparameters.pi or ())} values; expected '
                             f'{columns.n_own} for {name}: base parameters and offset.')
    if len(hyperparameters.output_scale) != body.n_outputs:
        raise SemiparamError(f'hyperparameters.output_scale holds {len(hyperparameters.output_scale)} values; '
                             f'expected {body.n_outputs}.')


def estimated_from(window: InitialWindow, variant: str, columns: CoupledColumns, options: ModelOptions,
                   scaling: InputScaling, draft: bool = False) -> Hyperparameters:
    """The variant's hyperparameters by the samples of an initial window.

    :param draft: from a few hundred of them and two starts, in about a tenth of the time.

    Raises SemiparamError when the window holds too little to estimate from.
    """
    inputs = (window.inputs - scaling[0]) / scaling[1]
    omega = spectrum(inputs.shape[1], options.most_features, options.features_seed, options.features_frequencies)
    return estimate(variant, window.outputs, window.columns, inputs, omega, length_scales=options.length_scales,
                    noise=options.noise, prior_scale=columns.prior_scale, n_effects=columns.n_effects,
                    fewest=options.features_count == AUTO, draft=draft, prior_mean=columns.expected,
                    physical=options.physical)


def without_features(hyperparameters: Hyperparameters) -> Hyperparameters:
    """Hyperparameters of the rigid body alone, from those of a variant with features: what features would explain is
    noise to it."""
    sigma = float(np.hypot(hyperparameters.sigma, hyperparameters.rho))
    return replace(hyperparameters, gamma=hyperparameters.gamma or 1.0, rho=0.0, tau=(), sigma=sigma, pi=None,
                   features=0)
