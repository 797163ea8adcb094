"""Variables that the structure in a residual depends on, by forward selection, and a sparse formula
for one output channel, from named terms that the effect kind ``terms`` understands. Unseen blocks
judge both."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.residual.flexible import (
    StandardisedInputs,
    bells,
    fold_labels,
    predictions,
    random_features,
)
from semiparam_ros.effects.terms import Terms, nameable, term_unit, term_values


class Dependence(NamedTuple):
    """A variable (q_, dq_, ddq_ and a joint, or time) and the share of the residual that it adds to those before it."""

    name: str
    share: float


def dependences(motion: StandardisedInputs, targets: Array, within_reach: float,
                counted: Mask | None = None) -> tuple[Dependence, ...]:
    """Variables of which a smooth function predicts targets (M, k), the most telling first.

    :param within_reach: share of the targets that a function of all variables predicts.
    :param counted: (M, k) targets that tell something, all unless given; the others are zero.
    """
    config, power = motion.config, float(np.sum(targets**2)) + 1e-300
    chosen, found, reached = list[int](), list[Dependence](), 0.0

    def share(added: tuple[int, ...]) -> float:
        """Share of the squared targets that these and those chosen predict on unseen blocks."""
        predicted = predictions(_features(motion, [*chosen, *added]), targets, config, counted)
        return 1.0 - float(np.sum((targets - predicted) ** 2)) / power

    while len(chosen) < config.most_variables:
        others = [index for index in range(len(motion.names)) if index not in chosen]
        shares: dict[tuple[int, ...], float] = {(index,): share((index,)) for index in others}
        if not chosen and max(shares.values()) < config.most * within_reach:
            # A product of two variables with means of zero shows in neither of them.
            shares |= {pair: share(pair) for pair in combinations(others, 2)}
        best = max(shares, key=lambda added: shares[added] * _plainness(motion, added))
        gained = shares[best] - reached
        if gained < config.variable_share * max(within_reach, reached):
            break
        chosen += best
        found += [Dependence(motion.names[index], gained / len(best)) for index in best]
        reached = shares[best]
    return tuple(found)


def _plainness(motion: StandardisedInputs, added: tuple[int, ...]) -> float:
    """Among near equals a position is preferred to a velocity, and that to an acceleration, which noise spoils."""
    order = [('q', 'time', 'dq', 'ddq').index(motion.names[index].split('_')[0]) for index in added]
    return (1.0 - motion.config.variable_share * sum(order)) / (1.0 if len(added) == 1 else motion.config.pair_worth)


def _features(motion: StandardisedInputs, chosen: Sequence[int]) -> Array:
    """Functions of each chosen variable, of all of them together, and of each with a slowly changing coefficient."""
    config, time = motion.config, len(motion.names) - 1
    parts = [bells(motion.values[:, index], config.bells) for index in chosen]
    if len(chosen) > 1:
        parts.append(random_features(motion.values[:, list(chosen)], 3 * config.bells * len(chosen),
                                     config.motion_scales[0], len(chosen)))
    if time in chosen:
        slow = motion.of_time(config.slow_waves)
        parts += [slow, *(motion.values[:, [index]] * slow for index in chosen if index != time)]
    return np.column_stack(parts)


class Summand(NamedTuple):
    """A term with its coefficient."""

    term: str
    coefficient: float
    unit: str


class Formula(NamedTuple):
    """Formula found for one channel; ``share`` of the residual that it explains on unseen blocks."""

    channel: str
    summands: tuple[Summand, ...]
    share: float

    @property
    def text(self) -> str:
        """The formula as a reader writes it."""
        parts = [f'{each.coefficient:+.3g} {each.unit} {each.term}'.replace('  ', ' ') for each in self.summands]
        return f'{self.channel} = {" ".join(parts)}'.replace('= +', '= ')

    @property
    def effect(self) -> Terms:
        """The same as an effect that can be declared."""
        return Terms(self.channel, {each.term: each.coefficient for each in self.summands})


def library(variables: Sequence[str], body: RigidBody, samples: Samples,
            config: DiagnosisConfig = DEFAULTS) -> list[str]:
    """Names of the terms made of those variables that a term can name, the plainest first."""
    motion = [name for name in variables if name != 'time' and nameable(name)]
    plain = [term for name in motion for term in _of_one(name)]
    if 'time' in variables:
        plain = ['time', 'time^2', *plain, *(f'time*{term}' for term in plain), *(f'time^2*{name}' for name in motion)]
    bumps = [term for name in motion if name.startswith('q_') for term in _bumps(name, body, samples, config)]
    return [*plain, *_products(motion), *bumps]


def _of_one(name: str) -> list[str]:
    if name.startswith('q_'):
        return [name, f'{name}^2', f'{name}^3', f'sin({name})', f'cos({name})']
    if name.startswith('dq_'):
        return [name, f'sign({name})', f'abs({name})', f'{name}*abs({name})', f'{name}^2', f'{name}^3']
    return [name, f'abs({name})', f'{name}^2']


def _products(names: Sequence[str]) -> Iterator[str]:
    for one, other in combinations(names, 2):
        yield f'{one}*{other}'
        for still, moving in ((one, other), (other, one)):
            if still.startswith('q_') and moving.startswith('dq_'):
                yield f'{still}*sign({moving})'
                yield f'{still}*abs({moving})'
            if still.startswith('q_'):
                yield f'sin({still})*{moving}'
                yield f'cos({still})*{moving}'


def _bumps(name: str, body: RigidBody, samples: Samples, config: DiagnosisConfig) -> Iterator[str]:
    values = term_values(name, body, samples)
    spread = float(values.std())
    if spread <= 1e-6:
        return
    for centre in np.quantile(values, config.bump_quantiles):
        for width in config.bump_widths:
            yield f'bump({name},{centre:.4f},{max(width * spread, 1e-4):.4f})'


def find_formula(variables: Sequence[str], body: RigidBody, samples: Samples, values: Array,
                 channel: int, config: DiagnosisConfig = DEFAULTS) -> Formula | None:
    """The shortest formula for values (M,) in output ``channel``; None without variables or a term that helps on
    unseen blocks.

    Orthogonal matching pursuit puts the terms in order; blocks left out of the fit say how many of them to keep.
    """
    terms = {name: term_values(name, body, samples)
             for name in library(variables, body, samples, config)}
    names = [name for name, each in terms.items() if each.std() > 1e-9]
    if not names:
        return None
    columns = np.column_stack([terms[name] for name in names])
    shares = _held_out_shares(columns, values, config)
    if shares.max() < config.channel_share:
        return None
    count = 1 + int(np.argmax(shares >= config.formula_enough * shares.max()))
    kept = _pursuit(columns, values, config.most_terms)[:count]
    coefficients = _least_squares(columns[:, kept], values)[:-1]
    summands = tuple(Summand(names[index], float(value), term_unit(names[index], body, channel))
                     for index, value in zip(kept, coefficients, strict=True))
    return Formula(body.output_names[channel], summands, float(shares[count - 1]))


def _pursuit(columns: Array, values: Array, most: int) -> list[int]:
    """Numbers of the columns in the order in which they come in; the values' size, however small, changes nothing."""
    from sklearn.linear_model import orthogonal_mp  # a second of loading, for the few who need it

    moved = columns - columns.mean(axis=0)
    moved /= np.linalg.norm(moved, axis=0) + 1e-12
    targets = values - values.mean()
    targets /= np.linalg.norm(targets) + 1e-300  # the pursuit takes what is small for nothing
    steps = min(most, moved.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)  # terms that depend on one another end the pursuit early
        path = orthogonal_mp(moved, targets, n_nonzero_coefs=steps, return_path=True)
    if not path.size:  # nor does anything of what stays the same
        return []
    present = np.atleast_2d(path.reshape(moved.shape[1], -1) != 0.0)
    entered = np.where(present.any(axis=1), present.argmax(axis=1), steps + 1)
    return [int(index) for index in np.argsort(entered, kind='stable') if entered[index] <= steps]


def _held_out_shares(columns: Array, values: Array, config: DiagnosisConfig) -> Array:
    """(most_terms,) share of the variance of values that formulas of 1, 2, ... terms predict of unseen blocks.

    Each fold chooses its own terms: terms chosen with the held-out blocks would score too well on them.
    """
    most, folds = config.most_terms, config.structure_folds
    labels = fold_labels(len(values), config.split_blocks, folds)
    squares = np.zeros(most)
    for fold in range(folds):
        held = labels == fold
        order = _pursuit(columns[~held], values[~held], most)
        for count in range(1, most + 1):
            kept = order[:count]
            found = _least_squares(columns[~held][:, kept], values[~held])
            squares[count - 1] += np.sum((values[held] - columns[held][:, kept] @ found[:-1] - found[-1]) ** 2)
    return np.asarray(1.0 - squares / (np.sum((values - values.mean()) ** 2) + 1e-300))


def _least_squares(columns: Array, values: Array) -> Array:
    """Coefficients, and a constant after them."""
    return np.asarray(np.linalg.lstsq(np.column_stack([columns, np.ones(len(columns))]), values, rcond=1e-10)[0])
