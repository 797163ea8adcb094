"""One self-contained HTML page of a comparison (no network, no script, light and dark), and the same as rows of text
and as JSON.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from itertools import groupby
from typing import NamedTuple

from semiparam_ros import __version__
from semiparam_ros.core.initial_window import gathered_from
from semiparam_ros.experiments.comparison import (
    BAND,
    LEVELS,
    Comparison,
    IndexFigures,
    ModeFigures,
    Spread,
    VariantFigures,
    verdict,
)
from semiparam_ros.report import comparison_figures
from semiparam_ros.report.html import Picture, environment, picture
from semiparam_ros.settings.robot_description import output_joints

SYMBOLS = {'eps_force': 'ε^F', 'eps_torque': 'ε^T', 'eps_effort': 'ε'}

WRENCH_CHANNELS = ('force x', 'force y', 'force z', 'torque x', 'torque y', 'torque z')


class Column(NamedTuple):
    """One figure of the table: its heading in two lines, and how to get and write it."""

    heading: str
    detail: str
    get: Callable[[VariantFigures], Spread | None]
    percent: bool = False
    best: Callable[..., float] = min


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
    best = column.best(means.values()) if len(means) > 1 else None
    return {variant: Cell(_text(figure.mean, column.percent), _spread_text(figure, column.percent),
                          figure.mean == best) for variant, figure in figures.items() if figure is not None}


def as_dictionary(comparison: Comparison) -> dict[str, object]:
    """Figures in SI units; None where a recording is too short or a seed alone."""
    scenario = comparison.scenario
    return {
        'command': 'compare', 'verdict': verdict(comparison.figures, comparison.findings),
        'findings': [finding._asdict() for finding in comparison.findings],
        'train_samples': len(scenario.train), 'initial_samples': scenario.settings.initial_samples,
        'subsets': [list(rows) for rows in scenario.subsets], 'seeds': list(scenario.seeds),
        'features': scenario.settings.features_count, 'horizon': scenario.settings.horizon_length,
        'estimation': _estimation(comparison),
        'variants': {variant: _variant(one) for variant, one in comparison.figures.items()}}


def _estimation(comparison: Comparison) -> dict[str, object]:
    estimation, settings = comparison.scenario.estimation, comparison.scenario.settings
    return {'method': estimation.method, 'starts': estimation.starts, 'drifting_noise': estimation.drifting,
            'length_scales': settings.features_length_scales, 'noise': settings.noise,
            'forgetting': settings.forgetting}


def _variant(one: VariantFigures) -> dict[str, object]:
    return {'seeds': list(one.seeds), 'first_recording': _mode(one.first),
            'learning': _mode(one.adaptive), 'frozen': _mode(one.frozen),
            **{name: _index_dictionary(index) for name, index in one.indices.items()},
            'hyperparameters': [asdict(hyperparameters) for hyperparameters in one.hyperparameters],
            'fit_seconds': one.fit_seconds}


def _mode(mode: ModeFigures) -> dict[str, object]:
    return {'nmse': mode.nmse._asdict(), 'nmse_by_output': mode.nmse_by_channel, 'coverage': mode.coverage._asdict(),
            'coverage_by_level': dict(zip(map(str, LEVELS), mode.coverage_by_level, strict=True)),
            'log_density': mode.log_density._asdict()}


def _index_dictionary(index: IndexFigures) -> dict[str, object]:
    phases: Mapping[str, Spread | None] = {'first_30_s': index.first_30_s, 'first_60_s': index.first_60_s,
                                           'steady_state': index.steady_state, 'interquartile_range': index.spread}
    return {name: None if spread is None else spread._asdict() for name, spread in phases.items()}


def _index(name: str, field: str) -> Callable[[VariantFigures], Spread | None]:
    def get(one: VariantFigures) -> Spread | None:
        spread: Spread | None = getattr(one.indices[name], field)
        return spread
    return get


def _nearest_band(values: Iterable[float]) -> float:
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


def page(comparison: Comparison, train: str, test: str, command: str) -> str:
    """The page's text.

    :param train: name of the first recording. :param test: of the second. :param command: what made it.
    """
    shown, scenario = columns(comparison), comparison.scenario
    window = gathered_from(scenario.train, scenario.settings.initial_samples).end
    template = environment().get_template('comparison.html.j2')
    return template.render(
        version=__version__, train=train, test=test, command=command, scenario=scenario, window=window,
        verdict=verdict(comparison.figures, comparison.findings), findings=comparison.findings, columns=shown,
        groups=_groups([column.heading for column in shown]),
        rows={variant: [cells(comparison, column)[variant] for column in shown] for variant in comparison.figures},
        pictures=pictures(comparison), hyperparameters=[_hyperparameters(one) for one in comparison.figures.values()],
        colours=comparison_figures.COLOURS)


def pictures(comparison: Comparison) -> list[Picture]:
    """Pictures of the comparison, with their captions."""
    figures, scenario = comparison.figures, comparison.scenario
    names = WRENCH_CHANNELS if scenario.settings.outputs == 'wrench' else output_joints(
        scenario.settings, scenario.settings.joints)
    several = f"{_count(len(scenario.subsets), 'subset')} and {_count(len(scenario.seeds), 'feature draw')}"
    steady = all(index.steady_state for one in figures.values() for index in one.indices.values())
    return [
        picture('Error over the horizon, in time', 'courses', comparison_figures.courses(figures),
                 f'Relative squared error of predicting the next {scenario.settings.horizon_length} samples, averaged '
                 f'over {several} and smoothed over two seconds. Lower is better. Look at how fast a curve falls in '
                 'the first minute, and where it settles. Dotted lines: 30 s and 60 s.'),
        *([picture('Error over the horizon, in steady state', 'boxes', comparison_figures.boxes(figures),
                   'The same index after the first 30 s: box from quartile to quartile, line at the median, whiskers '
                   'from the 5th to the 95th percentile. A low box is accurate, a short one dependable.')]
          if steady else []),
        picture('Are the uncertainties honest?', 'calibration', comparison_figures.calibration(figures),
                 'How many more measurements a band holds than it promises. Zero is honest, below zero the model is '
                 'too sure of itself, above it too cautious; the shaded strip is two points wide on either side.'),
        picture('Error of each output', 'channels', comparison_figures.channels(figures, names),
                 'Mean squared error over the variance of the output: open circles while the model learns, filled '
                 'circles frozen as the first recording left it. The distance between the two is what learning on is '
                 'worth.')]


def _count(number: int, noun: str) -> str:
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def _groups(headings: list[str]) -> list[tuple[str, int]]:
    """Equal neighbouring headings with their number, for cells that span columns."""
    return [(heading, len(list(group))) for heading, group in groupby(headings)]


def _hyperparameters(one: VariantFigures) -> dict[str, str]:
    """Hyperparameters of the first seed, as text; a dash for what the class does not have."""
    first = one.hyperparameters[0]
    drift = f'{100 * first.drift_share:.0f} %' if first.drift_share > 0 else '–'
    return {'variant': one.variant, 'gamma': _or_dash(first.gamma), 'rho': _or_dash(first.rho),
            'tau': ', '.join(number(value) for value in first.tau) or '–', 'sigma': number(first.sigma),
            'scale': ', '.join(number(value) for value in first.output_scale), 'drift': drift,
            'seconds': number(one.fit_seconds, 2)}


def _or_dash(value: float) -> str:
    return number(value) if value else '–'
