"""Figures of one variant over all seeds and subsets: errors, horizon indices and how honest the bands are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from semiparam_ros.core.hyperparameters import Hyperparameters
from semiparam_ros.core.types import Array
from semiparam_ros.report.comparison.runs import Followed, Learnt, Trace

TRANSIENT_S = 30.0
EARLY_S = 60.0
LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
BAND = 0.95


class Spread(NamedTuple):
    """A figure over feature seeds; ``std`` is None for a single seed."""

    mean: float
    std: float | None
    values: tuple[float, ...]


class ModeFigures(NamedTuple):
    """Errors and bands of one way of predicting (predict, then learn; or frozen), over all subsets."""

    nmse: Spread  # mean over channels of squared error over variance
    nmse_by_channel: tuple[float | None, ...]  # mean over seeds; None for a constant channel
    coverage: Spread  # part of the measurements within the 95 % band
    coverage_by_level: tuple[float, ...]  # mean over seeds, for LEVELS
    log_density: Spread  # mean per sample [nat]


class IndexFigures(NamedTuple):
    """One horizon index: its course, averaged over subsets, and what the paper reads off it."""

    time: Array  # (K,) [s]
    series: Array  # (seeds, K)
    first_30_s: Spread | None  # None where nothing falls into the phase
    first_60_s: Spread | None
    steady_state: Spread | None  # after the first 30 s
    spread: Spread | None  # interquartile range after the first 30 s


@dataclass(frozen=True)
class VariantFigures:
    """Everything of one variant. ``indices``: 'eps_force' and 'eps_torque', or 'eps_effort'."""

    variant: str
    seeds: tuple[int, ...]
    first: ModeFigures  # the rest of the first recording, predicted and learnt
    adaptive: ModeFigures
    frozen: ModeFigures
    indices: dict[str, IndexFigures]
    hyperparameters: tuple[Hyperparameters, ...]
    fit_seconds: float


def figures_of(outputs: str, learnt: Sequence[Learnt], followed: Sequence[Followed]) -> VariantFigures:
    """Gather the runs of one variant. :param outputs: 'wrench' or 'effort'."""
    seeds = tuple(one.model.seed for one in learnt)
    by_seed = [sorted((run for run in followed if run.seed == seed), key=lambda run: run.subset) for seed in seeds]
    adaptive = [[run.adaptive for run in runs] for runs in by_seed]
    frozen = [[run.frozen for run in runs] for runs in by_seed]
    indices = {name: index_figures(adaptive, channels) for name, channels in channel_groups(outputs).items()}
    first = mode_figures([[one.trace] for one in learnt])
    return VariantFigures(learnt[0].model.variant, seeds, first, mode_figures(adaptive), mode_figures(frozen), indices,
                          tuple(one.hyperparameters for one in learnt),
                          float(np.mean([one.fit_seconds for one in learnt])))


def channel_groups(outputs: str) -> dict[str, slice]:
    """Horizon indices and the outputs that each is the mean over."""
    if outputs == 'wrench':
        return {'eps_force': slice(0, 3), 'eps_torque': slice(3, 6)}
    return {'eps_effort': slice(None)}


def mode_figures(seeds: Sequence[Sequence[Trace]]) -> ModeFigures:
    """:param seeds: for each seed the traces of all subsets."""
    pooled = [_pool(traces) for traces in seeds]
    ratios = np.array([_normalised(trace) for trace in pooled])
    covered = np.array([[_coverage(trace, level) for level in LEVELS] for trace in pooled])
    known = ~np.isnan(ratios).any(axis=0)
    channels = tuple(float(value) if ok else None for value, ok in zip(ratios.mean(axis=0), known, strict=True))
    return ModeFigures(_spread(ratios[:, known].mean(axis=1)), channels, _spread(covered[:, LEVELS.index(BAND)]),
                       tuple(covered.mean(axis=0).tolist()),
                       _spread(np.array([trace.log_density.mean() for trace in pooled])))


def index_figures(seeds: Sequence[Sequence[Trace]], channels: slice) -> IndexFigures:
    """The index of one group of outputs from the traces of all subsets, for each seed."""
    length = min(len(trace.eps) for traces in seeds for trace in traces)
    time = seeds[0][0].horizon_time[:length]
    series = np.array([np.mean([trace.eps[:length, channels].mean(axis=1) for trace in traces], axis=0)
                       for traces in seeds])
    late = time >= TRANSIENT_S
    return IndexFigures(time, series, _phase(series, ~late), _phase(series, time < EARLY_S), _phase(series, late),
                        _phase(series, late, interquartile_range))


def interquartile_range(values: Array) -> float:
    """Distance of the quartiles."""
    lower, upper = np.percentile(values, [25, 75])
    return float(upper - lower)


def _phase(series: Array, within: NDArray[np.bool_], measure: Callable[[Array], float] | None = None) -> Spread | None:
    if not within.any():
        return None
    return _spread(np.array([(measure or np.mean)(row[within]) for row in series]))


def _spread(values: Array) -> Spread:
    std = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Spread(float(np.mean(values)), std, tuple(float(value) for value in values))


def _pool(traces: Sequence[Trace]) -> Trace:
    return Trace(*(np.concatenate(parts) for parts in zip(*traces, strict=True)))


def _normalised(trace: Trace) -> Array:
    """(n,) mean squared error over variance, NaN for a constant channel."""
    variance = trace.outputs.var(axis=0)
    square = np.mean(trace.errors**2, axis=0)
    return np.divide(square, variance, out=np.full_like(square, np.nan), where=variance > 0.0)


def _coverage(trace: Trace, level: float) -> float:
    return float(np.mean(np.abs(trace.errors) <= norm.ppf(0.5 + level / 2.0) * trace.std))
