"""The one score of a model: the log predictive density of blocks of the recording, each given all the others.

For linear-Gaussian models it follows from products of the columns alone. With theta ~ N(m, S^2) and noise of variance
s_k^2 in channel k, of which r_k neighbouring samples repeat each other,

    log p(y_b | y_-b) = log Z(all) - log Z(all but b),
    log Z = b' K^-1 b / 2 - log|K| / 2 - sum_k (w_k y_k' y_k + N_k log(2 pi s_k^2) / r_k) / 2,
    K = I + S (sum_k w_k C_k' C_k) S,   b = S sum_k w_k C_k' y_k,   w_k = 1 / (s_k^2 r_k),

with outputs y less those of the prior mean. A block of which the others say little is predicted with the variance that
this leaves, and costs no more than that; a coefficient that helps nowhere costs its share of every block. Calibrations
are columns too, linear near where they stand; the nonlinear values of effects are taken as they are.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from semiparam_ros.core.compiled import Integers, Matrix, Stack, Vector, compiled
from semiparam_ros.core.robot.size import reach_of
from semiparam_ros.core.types import Array, Indices
from semiparam_ros.diagnosis.config import DiagnosisConfig
from semiparam_ros.diagnosis.data.recordings import breaks_s
from semiparam_ros.diagnosis.data.splits import block_sums
from semiparam_ros.diagnosis.design import Part, PartInUse
from semiparam_ros.diagnosis.named_change import Gain
from semiparam_ros.diagnosis.regression import Fit, refit_weights, with_effects
from semiparam_ros.diagnosis.search.candidates import added_columns, identity
from semiparam_ros.diagnosis.search.refit import calibrated_values, points_of, shape_columns, told_by_sliding


class ChannelGrams(NamedTuple):
    """Products of one channel, block by block: columns that act there, with one another and with the outputs."""

    acting: Indices  # (p_k,)
    gram: Array  # (B, p_k, p_k)
    moment: Array  # (B, p_k)


@dataclass(frozen=True, eq=False)
class BlockGrams:
    """Products of a model's columns with one another and with the outputs, block by block.

    :param prior: (p,) standard deviations of the coefficients about their prior mean.
    :param power: (B, n) squared outputs less those of the prior mean. :param counts: (B, n) how many count.
    """

    prior: Array
    channels: list[ChannelGrams]
    power: Array
    counts: Array

    @cached_property
    def whole(self) -> BlockGrams:
        """The same of one block, the whole recording."""
        channels = [ChannelGrams(each.acting, each.gram.sum(axis=0)[None], each.moment.sum(axis=0)[None])
                    for each in self.channels]
        return BlockGrams(self.prior, channels, self.power.sum(axis=0)[None], self.counts.sum(axis=0)[None])

    def densities(self, scale: Array, correlation: Array, kept: Indices | None = None) -> Array:
        """(B,) log predictive density of each block given the others, with the columns ``kept`` alone."""
        weighed = self._weighed(1.0 / (scale**2 * correlation), kept)
        constant = self.power @ (1.0 / (scale**2 * correlation)) \
            + (self.counts / correlation) @ np.log(2.0 * np.pi * scale**2)
        whole = weighed.sum(axis=0)
        return np.asarray(_log_evidence(whole) - _log_evidence(whole - weighed) - 0.5 * constant)

    def scale_with(self, kept: Indices, scale: Array) -> Array:
        """(n,) root mean square of what the columns ``kept`` leave, fitted with the weights of a ``scale`` (n,)."""
        root, theta = _root(self.whole._weighed(scale**-2.0, kept)[0]), np.zeros(len(self.prior))
        theta[kept] = solve_triangular(root[:-1, :-1], root[-1, :-1], trans='T', lower=True) * self.prior[kept]
        squares = [float(power) - 2.0 * own @ channel.moment[0] + own @ channel.gram[0] @ own
                   for power, channel in zip(self.whole.power[0], self.whole.channels, strict=True)
                   for own in [theta[channel.acting]]]
        return np.asarray(np.sqrt(np.maximum(squares, 1e-12 * self.power.sum(axis=0)) / self.counts.sum(axis=0)))

    def _weighed(self, weights: Array, kept: Indices | None) -> Array:
        """(B, p + 1, p + 1) lower triangles of S (sum_k w_k C_k' C_k) S, with b below them, of the columns ``kept``."""
        kept = np.arange(len(self.prior)) if kept is None else kept
        places = np.full(len(self.prior), -1)
        places[kept] = np.arange(len(kept))
        weighed = np.zeros((len(self.power), len(kept) + 1, len(kept) + 1))
        for channel, weight in zip(self.channels, weights.tolist(), strict=True):
            _add(weighed, channel.gram, np.ascontiguousarray(channel.moment), places[channel.acting],
                 self.prior[channel.acting], weight)
        return weighed


@compiled
def _add(weighed: Stack, gram: Stack, moment: Matrix, places: Integers, prior: Vector, weight: float) -> None:
    """Add one channel's products to those of all; its columns are in order, and those at -1 are left out."""
    for block in range(len(gram)):
        for i in range(len(places)):
            if places[i] < 0:
                continue
            row, scale = weighed[block, places[i]], weight * prior[i]
            weighed[block, -1, places[i]] += scale * moment[block, i]
            for j in range(i + 1):
                if places[j] >= 0:
                    row[places[j]] += scale * prior[j] * gram[block, i, j]


def _root(weighed: Array) -> Array:
    """(..., p + 1, p + 1) L of K = L L', with b' L^-T below it, of one or of many lower triangles with b below them."""
    diagonal, right = np.diagonal(weighed, axis1=-2, axis2=-1)[..., :-1], weighed[..., -1, :-1]
    # Without noise, sums of squares hold no digits of the prior's: 1e-13 of each is rounding.
    added = 1.0 + 1e-13 * diagonal
    # The corner only has to be large enough: b' K^-1 b is at most b' b.
    corner = 1.0 + 2.0 * (right**2).sum(axis=-1, keepdims=True)
    whole = weighed + np.concatenate([added, corner], axis=-1)[..., None] * np.eye(weighed.shape[-1])
    return np.asarray(np.linalg.cholesky(whole))


def _log_evidence(weighed: Array) -> Array:
    """log Z without its terms that hold no column, of one or of many lower triangles with b below them."""
    root = _root(weighed)
    logarithm = np.log(np.diagonal(root, axis1=-2, axis2=-1)[..., :-1]).sum(axis=-1)
    return np.asarray(0.5 * (root[..., -1, :-1] ** 2).sum(axis=-1) - logarithm)


def block_grams(fit: Fit) -> BlockGrams:
    """Block grams of a fitted model."""
    columns, spread, values = _open_columns(fit)
    samples, design = fit.samples_in_use, fit.design
    further, target = PartInUse(Part(columns), samples), fit.at_prior + columns @ values
    acting = [numbers + design.n_columns for numbers in further.part.acting]
    channels = [ChannelGrams(np.append(support, more), gram, moment) for support, more, gram, moment in zip(
        design.support, acting, design.block_grams(further), design.moments(target, [further]), strict=True)]
    power = [(samples.of(channel, left[None])[0] ** 2).sum(axis=1) for channel, left in enumerate(target.T)]
    return BlockGrams(np.append(fit.prior_deviation, spread), channels, np.stack(power, axis=1),
                      np.diff(samples.ends).T.astype(float))


def _open_columns(fit: Fit) -> tuple[Array, Array, Array]:
    """(N, n, c) derivatives of the prediction by the calibrations and by points of application, their prior deviations
    (c,) and their values."""
    calibrated = [effect for effect in fit.effects if effect.is_calibration]
    points = points_of(fit)
    columns = [added_columns(fit, effect) for effect in calibrated]
    spread = [effect.calibration_scale(fit.body) for effect in calibrated]
    values = [calibrated_values(effect) for effect in calibrated]
    where = [fit.effects[shape.number].value(shape.name) for shape in points]
    return (np.concatenate([shape_columns(fit, []), *columns, shape_columns(fit, points)], axis=2),
            np.concatenate([np.zeros(0), *spread, np.full(len(points), reach_of(fit.body))]),
            np.concatenate([np.zeros(0), *values, where]))


def gain(before: Fit, after: Fit, times_s: Collection[float] = ()) -> Gain:
    """Gain of the second model over the first, with as many independent samples as the second one's residual leaves.

    :param times_s: [s] when something begins or ends that one of them has and the other lacks. A search for a time fits
        a block, and so the best block tells the time and nothing else: it does not count.
    """
    gains, breaks = block_gains(before, after), breaks_s(before.samples)
    searched = sum(time_s not in breaks for time_s in times_s)
    return summed(np.sort(gains)[:len(gains) - searched])


def gain_of_values(before: Fit, after: Fit) -> Gain:
    """Gain of the second model over the first, with their calibrations as they are: :func:`gain` holds these open in
    both, and then no declared value is wrong."""
    repeated = repetition(after)
    less = (before.residual**2 - after.residual**2) * after.counted / (2.0 * after.scale**2 * repeated)
    return summed(block_sums(less[after.train_mask], after.config.blocks).sum(axis=1))


def block_gains(before: Fit, after: Fit) -> Array:
    """(B,) gain of each block; where models have columns for errors of the inputs, with or without these, whichever
    gains less: what only makes up for what they spoil explains nothing, nor does what only they do better.

    Models of which one has a calibration that moves friction are compared where joints slide; where one averages the
    noise of inputs, the other does so too.
    """
    moving, others = ({identity(effect) for effect in fit.effects if told_by_sliding(fit, effect)}
                      for fit in (before, after))
    if moving != others:
        before, after = before.sliding, after.sliding
    repeated = repetition(after)
    densities = [[_densities(fit, repeated, np.append(zero, gone)) for gone in _views(fit)]
                 for fit, zero in (_averaged_as(after, before), _averaged_as(before, after))]
    return min((one - other for one, other in zip(*densities, strict=True)), key=np.sum)


def _averaged_as(fit: Fit, other: Fit) -> tuple[Fit, Indices]:
    """The model with those calibrations of the other that average inputs, at zero, and their columns, which are not
    its own."""
    known = {identity(effect) for effect in fit.effects}
    added = [effect for effect in other.effects if effect.averages and identity(effect) not in known]
    if not added:
        return fit, np.zeros(0, dtype=int)
    if 'averaged' not in fit.asked:
        zeros = [effect.with_values(**{each.name: 0.0 for each in effect.calibrations}) for effect in added]
        fit.asked['averaged'] = refit_weights(with_effects(fit, [*fit.effects, *zeros]))
    averaged = fit.asked['averaged']
    return averaged, np.concatenate(columns_of_effects(averaged)[-len(added):])


def _views(fit: Fit) -> list[Indices]:
    """Columns to leave out: none, and those for errors of the inputs where the model has such."""
    none, errors = np.zeros(0, dtype=int), 0 if fit.nuisance is None else fit.nuisance.shape[2]
    return [none, fit.n_columns - 1 - np.arange(errors)][:1 + bool(errors)]


def unlikely(fit: Fit) -> float:
    """[nat] minus the log prior density of a model's values, but for a constant: how far they are from what was known.
    """
    declared = {identity(effect): calibrated_values(effect) for effect in fit.declared}
    moved = [(calibrated_values(effect) - declared.get(identity(effect), 0.0)) / effect.calibration_scale(fit.body)
             for effect in fit.effects if effect.is_calibration]
    return 0.5 * float(np.sum(np.concatenate([(fit.theta - fit.prior_mean()) / fit.prior_deviation, *moved]) ** 2))


def repetition(fit: Fit) -> Array:
    """(n,) how many samples of each channel count as one: those over which the model's residual stays alike."""
    return coarsened(fit.correlation, fit.counts, fit.config)


def coarsened(correlation: Array, counts: Array, config: DiagnosisConfig) -> Array:
    """(n,) correlation times [samples] of what a model leaves of ``counts`` (n,) samples, the longer the more there
    are. No model of a robot is exactly true, so its evidence does not grow without limit (coarsened posterior; Miller
    and Dunson 2019, Journal of the American Statistical Association 114)."""
    independent = float((counts / correlation).sum())
    return np.asarray(correlation * (1.0 + independent / config.coarseness))


def _densities(fit: Fit, correlation: Array, gone: Indices) -> Array:
    """(B,) of a model without some of its columns."""
    grams: BlockGrams = fit.sums.get('grams') or block_grams(fit)
    fit.sums['grams'] = grams
    if not len(gone):
        return grams.densities(fit.scale, correlation)
    kept = np.setdiff1d(np.arange(len(grams.prior)), gone)
    return grams.densities(grams.scale_with(kept, fit.scale), correlation, kept)


def summed(gains: Array) -> Gain:
    """The total of the gains of blocks (B,), and its standard error as the losses among them scatter.

    What acts in few blocks gains in these alone; that they differ from the others says nothing against it. Where
    nothing is gained, gains and losses scatter alike.
    """
    return Gain(float(gains.sum()), float(np.sqrt(2.0 * (np.minimum(gains, 0.0) ** 2).sum())))


def worth(fit: Fit) -> list[Gain]:
    """Gain of each effect of the model over the model without it, nothing else searched anew."""
    gains = _worth(fit)
    told = [told_by_sliding(fit, effect) for effect in fit.effects]
    sliding = _worth(fit.sliding) if any(told) else gains
    return [there if slides else each
            for each, there, slides in zip(gains, sliding, told, strict=True)]


def _worth(fit: Fit) -> list[Gain]:
    repeated, views, gains = repetition(fit), _views(fit), []
    whole = [_densities(fit, repeated, gone) for gone in views]
    for columns in columns_of_effects(fit):
        without = [_densities(fit, repeated, np.append(columns, gone)) for gone in views]
        differences = [one - other for one, other in zip(whole, without, strict=True)]
        gains.append(summed(min(differences, key=np.sum)))
    return gains


def columns_of_effects(fit: Fit) -> list[Indices]:
    """Numbers of each effect's columns in the block grams; a calibration's come last."""
    found, end = [], fit.n_columns
    point = end + sum(len(effect.calibrations) for effect in fit.effects)
    points = [shape.number for shape in points_of(fit)]
    for index, effect in enumerate(fit.effects):
        if effect.is_calibration:
            found.append(np.arange(end, end + len(effect.calibrations)))
            end += len(effect.calibrations)
        else:
            block = fit.assembly.blocks[str(index)]
            found.append(np.append(np.arange(block.start, block.stop), point + np.flatnonzero(np.equal(points, index))))
    return found
