"""Splits a recording into contiguous blocks, because neighbouring samples repeat each other, and tests whether an
effect helps on blocks that did not fit it.
"""

from __future__ import annotations

from itertools import pairwise
from weakref import WeakKeyDictionary

import numpy as np

from semiparam_ros.core.types import Array, Mask, Stamps
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.input_errors import without_error_columns
from semiparam_ros.diagnosis.regression import Fit, refitted


def interleaved_split(count: int, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N,) true for samples that fit: of fifteen blocks every third is held out, so both parts span the recording."""
    block = np.minimum(np.arange(count) * config.split_blocks // count, config.split_blocks - 1)
    return np.asarray(block % config.held_out_every != 1)


def leading_split(count: int, share: float) -> Mask:
    """(N,) true for the first ``share`` of the samples; the rest is held out."""
    return np.arange(count) < round(count * share)


def folds(train_mask: Mask, config: DiagnosisConfig = DEFAULTS) -> Stamps:
    """(N,) number of the fold of each sample in use, -1 elsewhere; folds are contiguous and equally long."""
    labels = np.full(len(train_mask), -1, dtype=np.int64)
    used = np.flatnonzero(train_mask)
    labels[used] = np.minimum(np.arange(len(used)) * config.folds // max(len(used), 1), config.folds - 1)
    return labels


def ranges(mask: Mask) -> list[tuple[int, int]]:
    """Half-open index ranges where a mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]


def fold_errors(fit: Fit, scale: Array) -> Array:
    """(folds, n) squared error of each block in use, predicted by a fit of the other blocks with weights 1 / scale^2,
    in the outputs' units."""
    labels, count = folds(fit.train_mask, fit.config), fit.n_columns
    known, pull = fit.known_precision()  # a mass that was declared stays as it is in every fold
    grams, right = np.zeros((fit.config.folds, count, count)), np.zeros((fit.config.folds, count))
    parts = []
    for used, felt, rows, weight, left in zip(fit.in_use, fit.felt, fit.rows, scale**-2.0, fit.residual.T, strict=True):
        edges = np.searchsorted(labels[used], np.arange(fit.config.folds + 1)).tolist()
        parts.append([(rows[start:end], left[used[start:end]]) for start, end in pairwise(edges)])
        for fold, (columns, residual) in enumerate(parts[-1]):
            grams[fold][np.ix_(felt, felt)] += weight * (columns.T @ columns)
            right[fold, felt] += weight * (columns.T @ residual)
    total, moment = grams.sum(axis=0), right.sum(axis=0)
    size = 1.0 / np.sqrt(np.diag(total) + known + 1e-300)
    errors = np.zeros((fit.config.folds, len(scale)))
    for fold in range(fit.config.folds):
        rest = (total - grams[fold] + np.diag(known)) * np.outer(size, size) + 1e-9 * np.eye(count)
        change = np.linalg.lstsq(rest, (moment - right[fold] - pull) * size, rcond=1e-10)[0] * size
        for channel, felt in enumerate(fit.felt):
            columns, residual = parts[channel][fold]
            errors[fold, channel] = np.sum((residual - columns @ change[felt]) ** 2)
    return errors


def telling_errors(fit: Fit, scale: Array) -> Array:
    """(folds, n) the same, but no more than what the mean of the outputs leaves.

    A joint that moves in one block alone leaves the others' fit of it open; how far off they are there tells nothing of
    the effects.
    """
    outputs = fit.used(fit.samples.outputs - fit.used(fit.samples.outputs).sum(axis=0) / fit.counts)
    labels = folds(fit.train_mask, fit.config)[fit.train_mask]
    most = np.array([(outputs[labels == fold] ** 2).sum(axis=0) for fold in range(fit.config.folds)])
    return np.minimum(fold_errors(fit, scale), most)


_scores: WeakKeyDictionary[Fit, float] = WeakKeyDictionary()
"""Those asked for before; a fit that nobody needs any longer is not kept for its score."""


def unseen_score(fit: Fit) -> float:
    """Mean over the channels of half the log of the mean squared error on folds that did not fit: lower is better.

    Errors of models with different effects compare, for neither weights nor numbers of parameters enter.
    """
    if fit not in _scores:
        errors = telling_errors(fit, fit.scale).sum(axis=0) / fit.counts
        _scores[fit] = float(0.5 * np.mean(np.log(errors + 1e-300)))
    return _scores[fit]


def carries_over(before: Fit, after: Fit) -> bool:
    """True when the blocks that the added effects help far outweigh those that they harm."""
    losses, left = ((telling_errors(fit, after.scale) / after.scale**2).sum(axis=1) for fit in (before, after))
    gains = losses - left
    helped, harmed = gains[gains > 0].sum(), -gains[gains < 0].sum()
    config = after.config
    return bool(helped - harmed > config.least_gain * losses.sum()
                and helped > config.least_helped_over_harmed * harmed)


def improves(before: Fit, after: Fit, least: float = 0.0) -> bool:
    """Whether a round may take one model for another: what it changes carries over, and the score that all rounds
    share improves, so that no sequence of rounds leads back.

    With columns for errors of the inputs, it must do so without them too: an effect that only makes up for what those
    columns spoil explains nothing. And where an effect moves the joints' friction, it must help where no joint turns
    over too: near standstill it may only make up for the form of dry friction.

    :param least: by how much the score must improve.
    """
    if not (unseen_score(after) < unseen_score(before) - least and carries_over(before, after)):
        return False
    if not _helps_beyond_turns(before, after):
        return False
    return before.nuisance is None or improves(without_error_columns(before), without_error_columns(after), least)


def _helps_beyond_turns(before: Fit, after: Fit) -> bool:
    """Whether effects that move friction are credible and carry over where joints are too fast for dry friction to
    turn."""
    known = {(effect.kind, effect.where) for effect in before.effects}
    moving = [effect for effect in after.effects if effect.moves_friction and (effect.kind, effect.where) not in known]
    if not moving or after.body.outputs != 'effort':
        return True
    speed, config = np.abs(after.samples.velocity), after.config
    fast = after.counted & (speed > config.turned_speed_share * speed[after.train_mask].max(axis=0))
    if fast[after.train_mask].sum(axis=0).min() < config.least_working_samples:
        return True
    rest = [effect for effect in after.effects if effect not in moving]
    without, within = (refitted(after, effects, after.nuisance, fast) for effects in (rest, after.effects))
    counts = within.counts / within.correlation
    spent = sum(len(effect.calibrations) for effect in moving)
    worth = 0.5 * (counts @ np.log(without.squares / within.squares) - spent * np.log(counts.sum()))
    return bool(worth > config.least_evidence) and carries_over(without, within)
