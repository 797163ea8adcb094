"""A comparison as rows of text and as the dictionary that `--json` writes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from semiparam_ros.report.comparison.experiment import Comparison
from semiparam_ros.report.comparison.figures import BAND, LEVELS, IndexFigures, ModeFigures, Spread, VariantFigures
from semiparam_ros.report.comparison.findings import verdict

SYMBOLS = {'eps_force': 'ε^F', 'eps_torque': 'ε^T', 'eps_effort': 'ε'}


class Column(NamedTuple):
    """One figure of the table: its heading in two lines, and how to get and write it."""

    heading: str
    detail: str
    get: Callable[[VariantFigures], Spread | None]
    percent: bool = False
    best: Callable[..., float] | None = min


class Cell(NamedTuple):
    """A figure as text, its spread over seeds ('' for one seed), and whether it is the best of its column."""

    text: str
    spread: str
    best: bool


def columns(comparison: Comparison) -> list[Column]:
    """The columns that the recordings are long enough for."""
    chosen: list[Column] = []
    for name in next(iter(comparison.figures.values())).indices:
        for field, detail in (('first_60_s', 'first 60 s'), ('steady_state', 'after 30 s'), ('spread', 'spread')):
            chosen.append(Column(SYMBOLS[name], detail, _index(name, field)))
    chosen += [Column('nMSE', 'learning', lambda one: one.adaptive.nmse),
               Column('nMSE', 'frozen', lambda one: one.frozen.nmse),
               Column('band', 'first', lambda one: one.first.coverage, percent=True, best=_nearest_band),
               Column('band', 'learning', lambda one: one.adaptive.coverage, percent=True, best=_nearest_band),
               Column('band', 'frozen', lambda one: one.frozen.coverage, percent=True, best=_nearest_band),
               Column('log density', 'learning', lambda one: one.adaptive.log_density, best=max),
               Column('log density', 'frozen', lambda one: one.frozen.log_density, best=max)]
    return [column for column in chosen if all(column.get(one) is not None for one in comparison.figures.values())]


def cells(comparison: Comparison, column: Column) -> dict[str, Cell]:
    """One cell for each variant."""
    figures = {variant: column.get(one) for variant, one in comparison.figures.items()}
    means = {variant: figure.mean for variant, figure in figures.items() if figure is not None}
    best = column.best(means.values()) if column.best and len(means) > 1 else None
    return {variant: Cell(_text(figure.mean, column.percent), _spread_text(figure, column.percent),
                          figure.mean == best) for variant, figure in figures.items() if figure is not None}


def as_dictionary(comparison: Comparison) -> dict[str, Any]:
    """Every figure in SI units; None where a recording is too short or a seed alone."""
    scenario = comparison.scenario
    return {
        'command': 'compare', 'verdict': verdict(comparison.figures, comparison.findings),
        'findings': [finding._asdict() for finding in comparison.findings],
        'train_samples': len(scenario.train), 'initial_samples': scenario.settings.initial_samples,
        'subsets': [list(rows) for rows in scenario.subsets], 'seeds': list(scenario.seeds),
        'features': scenario.settings.features_count, 'horizon': scenario.settings.horizon_length,
        'estimation': _estimation(comparison),
        'variants': {variant: _variant(one) for variant, one in comparison.figures.items()}}


def _estimation(comparison: Comparison) -> dict[str, Any]:
    estimation, settings = comparison.scenario.estimation, comparison.scenario.settings
    return {'method': estimation.method, 'starts': estimation.starts, 'drifting_noise': estimation.drifting,
            'length_scales': settings.features_length_scales, 'noise': settings.noise,
            'forgetting': settings.forgetting}


def _variant(one: VariantFigures) -> dict[str, Any]:
    return {'seeds': list(one.seeds), 'first_recording': _mode(one.first),
            'learning': _mode(one.adaptive), 'frozen': _mode(one.frozen),
            **{name: _index_dictionary(index) for name, index in one.indices.items()},
            'hyperparameters': [asdict(hyperparameters) for hyperparameters in one.hyperparameters],
            'fit_seconds': one.fit_seconds}


def _mode(mode: ModeFigures) -> dict[str, Any]:
    return {'nmse': mode.nmse._asdict(), 'nmse_by_output': mode.nmse_by_channel, 'coverage': mode.coverage._asdict(),
            'coverage_by_level': dict(zip(map(str, LEVELS), mode.coverage_by_level, strict=True)),
            'log_density': mode.log_density._asdict()}


def _index_dictionary(index: IndexFigures) -> dict[str, Any]:
    phases: Mapping[str, Spread | None] = {'first_30_s': index.first_30_s, 'first_60_s': index.first_60_s,
                                           'steady_state': index.steady_state, 'interquartile_range': index.spread}
    return {name: None if spread is None else spread._asdict() for name, spread in phases.items()}


def _index(name: str, field: str) -> Callable[[VariantFigures], Spread | None]:
    def get(one: VariantFigures) -> Spread | None:
        spread: Spread | None = getattr(one.indices[name], field)
        return spread
    return get


def _nearest_band(values: Any) -> float:
    nearest: float = min(values, key=lambda value: abs(value - BAND))
    return nearest


def _text(value: float, percent: bool) -> str:
    return f'{100 * value:.1f} %' if percent else number(value)


def _spread_text(figure: Spread, percent: bool) -> str:
    if figure.std is None:
        return ''
    return f'± {100 * figure.std:.1f}' if percent else f'± {number(figure.std, 1)}'


def number(value: float, digits: int = 3) -> str:
    """A few significant digits, and powers of ten only for what is tiny."""
    return f'{value:.{digits}g}' if abs(value) >= 1e-3 or value == 0.0 else f'{value:.{max(digits - 2, 0)}e}'
