"""Estimate of the coefficients of a robot's model: from a recording, or from an estimator.

A recording is there as a whole, so its motion is smoothed, which a live model cannot do, and all of
its samples are fitted at once by weighted least squares with the priors of the variant P. Errors of
neighbouring samples resemble each other: a channel whose residual has the integrated correlation
time tau tells as much as one sample in tau of independent ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from semiparam_ros.core.columns import CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.motion import moving
from semiparam_ros.core.robot.frames import load_in_base
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples, variance
from semiparam_ros.core.signals.correlation import correlation_time
from semiparam_ros.core.signals.smoothing import smoothed
from semiparam_ros.core.types import Array, Indices, Mask
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import ALWAYS, Span
from semiparam_ros.errors import SemiparamError

MOTIONS = {'smoothed': 2, 'smoothed from positions': 1, 'smoothed with accelerations': 3}
"""Number of signals that the smoother uses: velocities and accelerations may lag."""
MOST_VALUES = 20_000_000
"""Largest number of values in the columns of all samples, 160 MB; beyond, samples are spread."""
BLOCKS, FOLDS = 40, 5
REWEIGHTINGS = 4
DEGREES = 5.0
"""Degrees of freedom of Student's t, as for the online estimator's averages."""
FISHER = np.sqrt((DEGREES + 1.0) / (DEGREES + 3.0))
"""Root of a sample's information over that of a normal one of the same scale (Lange, Little and
Taylor 1989)."""
LEAST_STD = 1e-9
"""Least standard deviation of a coefficient, in its unit."""
KNOWN = 1e8
"""Times the precision of inertias that are known."""


class EffectEstimate(Protocol):
    """An effect whose coefficients (c,) and their standard deviations (c,) are known."""

    effect: Effect
    coefficients: Array
    std: Array


class Estimate(NamedTuple):
    """Estimate theta ~ N(mean, information^-1), in the order of the columns.

    :param how: what it is from, as a phrase. :param top_speed: (n_joints,) largest velocities seen
        [rad/s, m/s]. :param table: samples that judge it.
    :param held_out: whether it can be fitted anew without the samples that judge.
    :param origin: stamp [ns] from which its time counts. :param bias: (n,) of a tare, which its outputs are without.
    """

    columns: CoupledColumns
    mean: Array  # (p,)
    information: Array  # (p, p)
    how: str
    top_speed: Array
    table: SampleTable | None = None
    held_out: bool = False
    origin: int = 0
    bias: Array | None = None

    @property
    def starts(self) -> dict[int, float]:
        """Times [s] when effects begin that were not there from the beginning, by their first columns."""
        spans = [effect.span.in_recording(self.origin) if isinstance(effect, Effect) else ALWAYS
                 for effect in self.columns.effects]
        declared = {self.columns.blocks[str(index)].start: span.start_s
                    for index, span in enumerate(spans) if span.start_s is not None}
        return declared if self.table is None else declared | dict(self.table.starts)


@dataclass(frozen=True, eq=False)
class SampleTable:
    """Columns and outputs of a recording.

    :param columns: (N, n, p). :param outputs: (N, n). :param used: (N,) samples that tell
        something.
    :param deviation: (n,) of a sample that counts as an independent one. :param weight: (N, n) of
        each output by Student's t, so that a touch decides nothing.
    """

    model: CoupledColumns
    columns: Array
    outputs: Array
    used: Mask
    deviation: Array
    weight: Array
    starts: Mapping[int, float] = field(default_factory=dict)
    """Times [s] when the samples show that loads appear, by their first columns."""
    keep_inertias: bool = False
    """Mark of a rigid body that is known to be as described."""

    @cached_property
    def folds(self) -> list[Mask]:
        """Masks (N,) of as many samples each, in consecutive parts of the recording."""
        number = (np.cumsum(self.used) - 1) * FOLDS // self.used.sum()
        return [self.used & (number == fold) for fold in range(FOLDS)]

    @cached_property
    def fold_estimates(self) -> list[tuple[Array, Array]]:
        """Estimates without each fold; see :meth:`estimate`."""
        return [self.estimate(self.used & ~fold) for fold in self.folds]

    @cached_property
    def prior(self) -> tuple[Array, Array]:
        """Mean (p,) and precision (p,) before any sample."""
        precision = self.model.prior_scale**-2.0
        if self.keep_inertias:
            precision[self.model.blocks['rigid_body']] *= KNOWN
        return self.model.expected, precision

    def estimate(self, rows: Mask) -> tuple[Array, Array]:
        """Mean (p,) and information (p, p) of theta from some samples (N,)."""
        mean, precision = self.prior
        information, right = self._of_samples(rows)
        information, right = information + np.diag(precision), right + precision * mean
        try:
            mean = cho_solve(cho_factor(information), right)
        except np.linalg.LinAlgError as error:
            raise SemiparamError('the samples fit no inertias: outputs and masses of the robot '
                                 'description differ by many powers of ten; check their units.') from error
        return mean, np.asarray(information, dtype=np.float64)

    def _of_samples(self, rows: Mask) -> tuple[Array, Array]:
        """Information (p, p) of some samples (N,) alone, and its product (p,) with what they say of theta."""
        count = self.columns.shape[2]
        information, right = np.zeros((count, count)), np.zeros(count)
        for channel, deviation in enumerate(self.deviation):
            root = np.sqrt(self.weight[rows, channel]) / deviation
            columns = self.columns[rows, channel] * root[:, None]
            information += columns.T @ columns
            right += columns.T @ (self.outputs[rows, channel] * root)
        return information, right

    def by_samples_alone(self) -> SampleTable:
        """The same with the deviations of what the samples leave of themselves, whatever the prior says.

        :meth:`weighed` may end in either of two places, for errors of the prior that are taken for slow noise make the
        samples say little.
        """
        mean, precision = self.prior
        scale = precision**-0.5
        information, right = self._of_samples(self.used)
        apart = np.linalg.lstsq(information * np.outer(scale, scale), (right - information @ mean) * scale)[0]
        left = self.residual(mean + scale * apart)[self.used]
        return replace(self, deviation=np.maximum(left.std(axis=0), 1e-9 * self.deviation))

    def residual(self, theta: Array) -> Array:
        """Residual (N, n) of theta (p,)."""
        return np.asarray(self.outputs - self.columns @ theta)

    def error(self, theta: Array, rows: Mask) -> Array:
        """Mean squared error (n,) over the variance of all outputs in use; NaN where that is 0."""
        spread = variance(self.outputs[self.used])
        square = np.mean(self.residual(theta)[rows] ** 2, axis=0)
        return np.divide(square, spread, out=np.full(len(square), np.nan), where=spread > 0.0)

    def weighed(self) -> SampleTable:
        """The same with the deviations of what the fit leaves, correlation in time included."""
        table = self
        for _ in range(REWEIGHTINGS):
            left = table.residual(table.estimate(table.used)[0])
            weighted = np.sqrt(table.weight) * left
            size = np.maximum(weighted[table.used].std(axis=0), 1e-9 * self.deviation)
            memory = [correlation_time(values) for values in weighted[table.used].T]
            table = replace(table, deviation=size * np.sqrt(memory) / FISHER,
                            weight=(DEGREES + 1.0) / (DEGREES + (left / size) ** 2))
        return table


def from_recording(body: RigidBody, effects: Sequence[Effect], samples: Samples,
                   joint_friction: bool, keep_inertias: bool, name: str) -> Estimate:
    """Estimate from a recording, by the smoothed motion that predicts parts left out best.

    :param keep_inertias: whether the rigid body is known to be as described.

    A declared load without a start begins where the samples say, at a multiple of 1/40 of the
    recording, and what is around it is left out.

    Raises SemiparamError when the recording has fewer samples in motion than the model has
    coefficients.
    """
    effects = [effect.in_recording(samples.origin) for effect in effects]
    model = CoupledColumns(body, effects, joint_friction, physical=True)
    step = -(-len(samples) * body.n_outputs * model.n_columns // MOST_VALUES)
    moves = moving(samples)
    if moves.sum() < model.n_columns:
        raise SemiparamError(f'{name} holds {int(moves.sum())} samples of a robot that moves; '
                             f'expected at least {model.n_columns}, as many as the model has '
                             'coefficients.')
    best: tuple[float, str, SampleTable] | None = None
    for motion, measured in MOTIONS.items():
        rows = replace(smoothed(samples, measured), whole=True)[::step]
        begun = _table(model, rows, moves[::step], keep_inertias)
        for table in (begun, begun.by_samples_alone()):
            table = _with_starts(table.weighed(), rows.time)
            loss = sum(float(np.nansum(table.error(mean, fold)) * fold.sum())
                       for fold, (mean, _) in zip(table.folds, table.fold_estimates, strict=True))
            if best is None or loss < best[0]:
                best = loss, motion, table
    assert best is not None
    _, motion, table = best
    how = f'{int(table.used.sum())} samples of {name}, motion {motion}' + ''.join(
        f', another load at {effect.where} until {effect.span.end_s:.1f} s apart'
        for effect in table.model.effects[len(effects):] if isinstance(effect, Effect))
    mean, information = table.estimate(table.used)
    top_speed = np.abs(samples.velocity).max(axis=0)
    return Estimate(table.model, mean, information, how, top_speed, table, held_out=True)


def from_estimator(estimator: Estimator, samples: Samples | None, name: str) -> Estimate:
    """Estimate of an estimator, of its rigid body alone where several models are averaged.

    :param samples: that judge it; None or empty: nothing does.

    Raises SemiparamError when it has learnt no rigid body.
    """
    if not estimator.ready:
        raise SemiparamError(f'{name} holds no model yet: there is none until '
                             f'{estimator.model_comes}.')
    model = estimator.rigid_body_model
    if model.variant.pi != 'learnt':
        raise SemiparamError(f'{name} learns no inertial parameters: its variant is '
                             f'{estimator.options.variant}; expected P, SPK-ML or auto.')
    if not len(estimator.inputs_learnt):
        raise SemiparamError(f'{name} has learnt no sample yet: its hyperparameters were given.')
    columns, root = estimator.columns, model.recursion.theta_root()
    table = None
    if samples is not None and len(samples):
        table = _table(columns, samples, moving(samples))
    n = estimator.body.n_joints
    top_speed = np.abs(estimator.inputs_learnt[:, n:2 * n]).max(axis=0)
    return Estimate(columns, model.theta, root.T @ root, f'the model of {name}', top_speed, table,
                    origin=estimator.origin or 0)


def with_known(estimate: Estimate, known: Sequence[EffectEstimate]) -> Estimate:
    """The estimate with effects beside it that were taken off all samples, as loads in the hand.

    Another tool, which is a difference of bodies, is a part of the rigid body.
    """
    old, mean = estimate.columns, estimate.mean.copy()
    exchanged = [each for each in known if each.effect.is_load and not each.effect.is_body]
    others = [each for each in known if each.effect.is_body or not each.effect.is_load]
    model = CoupledColumns(old.body, [*old.effects, *(each.effect for each in others)],
                           old.has_friction, old.physical)
    for each in exchanged:
        mean[old.blocks['rigid_body']] += load_in_base(old.body, str(each.effect.where),
                                                       each.coefficients)
    table = estimate.table
    if table is not None:
        absent = np.zeros((*table.columns.shape[:2], model.n_columns - old.n_columns))
        table = replace(table, model=model,
                        columns=np.concatenate([table.columns, absent], axis=2),
                        outputs=table.outputs + table.columns @ (mean - estimate.mean))
    precisions = [np.diag(np.maximum(each.std, LEAST_STD) ** -2.0) for each in others]
    return estimate._replace(
        columns=model, mean=np.concatenate([mean, *(each.coefficients for each in others)]),
        information=block_diag(estimate.information, *precisions), table=table)


def _table(model: CoupledColumns, samples: Samples, used: Mask,
           keep_inertias: bool = False) -> SampleTable:
    spread = np.maximum(samples.outputs[used].std(axis=0), 1e-9)
    return SampleTable(model, model.batch(samples)[0], samples.outputs, used, spread,
                       np.ones(samples.outputs.shape), keep_inertias=keep_inertias)


def _with_starts(table: SampleTable, time: Array) -> SampleTable:
    """Note what the samples show of loads that do not say when they start, and set the columns to
    zero before; what was carried at the same place before is another one, which is over."""
    block: Indices = np.arange(len(time)) * BLOCKS // len(time)
    open_ended = [(index, effect) for index, effect in enumerate(table.model.effects)
                  if effect.is_load and isinstance(effect, Effect) and not effect.span.values]
    places = [effect.where for _, effect in open_ended]
    for index, effect in open_ended:
        part = table.model.blocks[str(index)]
        best = _best_start(table, part, block)
        if best < BLOCKS and places.count(effect.where) == 1:  # of several, each is what is there before the next
            table, best = _with_others(table, effect, part, block, time, best)
        if best == 0:
            continue
        table = _beginning(table, part, block, best)
        if best < BLOCKS:
            table = replace(table, starts={**table.starts, part.start: float(time[block == best][0])})
    return table.weighed()


def _with_others(table: SampleTable, effect: Effect, part: slice, block: Indices, time: Array,
                 start: int) -> tuple[SampleTable, int]:
    """The same with other loads before that of ``part``, one after another, and the block when this begins, where the
    samples show so."""
    before = [(earlier, start) for earlier in range(start)]
    while True:
        pairs = [*before, *((start, later) for later in range(start + 1, BLOCKS))]
        pair = _another(table, effect, part, block, time, start, pairs) if pairs else None
        if pair is None:
            return table, start
        table, start, before = _with_over(table, effect, part, block, time, pair), pair[1], []


def _another(table: SampleTable, effect: Effect, part: slice, block: Indices, time: Array, start: int,
             pairs: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
    """The blocks between which another load was there before that of ``part``; None where the samples show none."""
    def evidence(table: SampleTable) -> list[float]:
        sums = _sums(table, block)
        return [_evidence(table.prior, sums, part, own, first) for first, own in pairs]

    fitting = pairs[int(np.argmax(evidence(table.by_samples_alone())))]
    both = _with_over(table, effect, part, block, time, fitting)
    as_sure = _beginning(both, part, block, fitting[1]).by_samples_alone().weighed()
    table = replace(table, deviation=as_sure.deviation, weight=as_sure.weight)
    found, alone = evidence(table), _evidence(table.prior, _sums(table, block), part, start)
    return pairs[int(np.argmax(found))] if max(found) > alone + np.log(len(pairs)) else None


def _with_over(table: SampleTable, effect: Effect, part: slice, block: Indices, time: Array,
               between: tuple[int, int]) -> SampleTable:
    """The same with a load of its own between two blocks, of which what is around the first tells nothing."""
    old, (first, last) = table.model, between
    start_s, end_s = (float(time[block == each][0]) for each in between)
    other = replace(effect, span=Span(start_s=start_s, end_s=end_s))
    model = CoupledColumns(old.body, [*old.effects, other], old.has_friction, old.physical)
    there = ((first <= block) & (block < last))[:, None, None]
    columns = np.concatenate([table.columns, np.where(there, table.columns[:, :, part], 0.0)], axis=2)
    return replace(table, model=model, columns=columns, used=table.used & ~_around(block, first))


def _beginning(table: SampleTable, part: slice, block: Indices, start: int) -> SampleTable:
    """The same where the columns of ``part`` are there from a block on, of which what is around tells nothing."""
    columns = table.columns.copy()
    columns[block < start, :, part] = 0.0
    return replace(table, columns=columns, used=table.used & ~_around(block, start))


def _around(block: Indices, start: int) -> Mask:
    """Mask (N,) of the samples in the blocks about a start; none about the beginning and the end."""
    return np.asarray((np.abs(block - start + 0.5) < 1.0) & (0 < start < BLOCKS))


def _best_start(table: SampleTable, part: slice, block: Indices) -> int:
    """The block from which on the columns of ``part`` are most probably there, by the evidence of
    the samples; BLOCKS where they never are.

    The samples are as unsure as with the start that fits them best: what is wrong with another is no slow noise.
    """
    fitting = int(np.argmax(_evidence_of_starts(table.by_samples_alone(), part, block)))
    best = _beginning(table, part, block, fitting).by_samples_alone().weighed()
    evidence = _evidence_of_starts(replace(table, deviation=best.deviation, weight=best.weight), part, block)
    found = int(np.argmax(evidence))
    likely = evidence[found] > evidence[0] + np.log(BLOCKS)  # before, as probable as all others
    return found if likely else 0


def _evidence_of_starts(table: SampleTable, part: slice, block: Indices) -> Array:
    """Log evidence [nat] (BLOCKS + 1,) of each start, the last of none."""
    sums = _sums(table, block)
    return np.array([_evidence(table.prior, sums, part, start) for start in range(BLOCKS + 1)])


def _sums(table: SampleTable, block: Indices) -> tuple[Array, Array]:
    """Information (BLOCKS, p, p) of each block, and its product (BLOCKS, p) with what its samples say of theta."""
    grams, rights = [], []
    for number in range(BLOCKS):
        rows = table.used & (block == number)
        root = np.sqrt(table.weight[rows]) / table.deviation
        columns = table.columns[rows] * root[:, :, None]
        grams.append(np.einsum('tnp,tnq->pq', columns, columns, optimize=True))
        rights.append(np.einsum('tnp,tn->p', columns, table.outputs[rows] * root))
    return np.array(grams), np.array(rights)


def _evidence(prior: tuple[Array, Array], sums: tuple[Array, Array], part: slice, start: int,
              before: int | None = None) -> float:
    """Log evidence [nat] of a load with the columns of ``part`` from a block on, and of another one from the block
    ``before`` until then."""
    mean, precision = prior
    grams, rights = sums
    own = np.arange(len(mean))
    other, absent, constant = own.copy(), np.delete(own, part), 0.0
    first = start if before is None else before
    if before is not None:
        other[part] = len(own) + np.arange(len(own[part]))
        constant = 0.5 * float(np.sum(np.log(precision[part]) - precision[part] * mean[part] ** 2))
        mean, precision = np.append(mean, mean[part]), np.append(precision, precision[part])
    information, right = np.diag(precision), precision * mean
    for phase, taken, put in ((slice(0, first), absent, absent), (slice(first, start), own, other),
                              (slice(start, None), own, own)):
        information[np.ix_(put, put)] += grams[phase].sum(axis=0)[np.ix_(taken, taken)]
        right[put] += rights[phase].sum(axis=0)[taken]
    factor = cho_factor(information)
    return constant + float(0.5 * right @ cho_solve(factor, right) - np.log(np.diag(factor[0])).sum())
