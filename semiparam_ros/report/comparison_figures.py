"""The figures of a comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter

from semiparam_ros.core.types import Array
from semiparam_ros.experiments.comparison import EARLY_S, LEVELS, VariantFigures
from semiparam_ros.experiments.evaluation import TRANSIENT_S
from semiparam_ros.report.html import FAINT, INK, PLAIN, page_style

# Families share a hue, validation sets are dashed; told apart without red and green.
COLOURS = {'P': '#8c8c8c', 'NP-ML': '#e08a00', 'NP-VS': '#e08a00', 'SP-ML': '#3b7dd8', 'SP2-ML': '#c060a8',
           'SP2-VS': '#c060a8', 'SPK-ML': '#1a9c78', 'auto': '#202020'}
TITLES = {'eps_force': 'Forces', 'eps_torque': 'Torques', 'eps_effort': 'Efforts'}
SMOOTHING_S = 2.0
MOST_POINTS = 400
PANEL = (8.6, 2.7)


def courses(figures: Mapping[str, VariantFigures]) -> Figure:
    """Courses of each index: mean over subsets and seeds, smoothed over two seconds."""
    names = _indices(figures)
    with page_style():
        figure = Figure(figsize=(PANEL[0], PANEL[1] * len(names) + 0.4))
        panels = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
        for name, panel in zip(names, panels, strict=True):
            for variant, one in figures.items():
                panel.plot(*_course(one.indices[name].time, one.indices[name].series.mean(axis=0)),
                           color=COLOURS[variant], linestyle=_dash(variant), label=variant)
            panel.set(yscale='log', ylabel='horizon error')
            panel.set_title(TITLES[name])
            _mark_phases(panel)
        panels[-1].set_xlabel('time since the start of a subset [s]')
        _legend(figure, panels[0], figures)
    return figure


def boxes(figures: Mapping[str, VariantFigures]) -> Figure:
    """Distribution of each index after the first 30 s, over time and seeds; there must be some."""
    names = _indices(figures)
    with page_style():
        figure = Figure(figsize=(PANEL[0], 3.0))
        panels = np.atleast_1d(figure.subplots(1, len(names)))
        for name, panel in zip(names, panels, strict=True):
            indices = [one.indices[name] for one in figures.values()]
            values = [index.series[:, index.time >= TRANSIENT_S].ravel() for index in indices]
            drawn = panel.boxplot(values, whis=(5, 95), showfliers=False, widths=0.6, patch_artist=True,
                                  tick_labels=list(figures), medianprops={'color': INK, 'linewidth': 1.4})
            for variant, box in zip(figures, drawn['boxes'], strict=True):
                box.set(facecolor=COLOURS[variant], edgecolor=COLOURS[variant], alpha=0.75)
            for line in [*drawn['whiskers'], *drawn['caps']]:
                line.set_color(INK)
            panel.set(yscale='log')
            panel.set_title(f'{TITLES[name]}, after {TRANSIENT_S:g} s')
            panel.tick_params(axis='x', labelsize=8, labelrotation=35)
            panel.grid(axis='x', visible=False)
        panels[0].set_ylabel('horizon error')
    return figure


def calibration(figures: Mapping[str, VariantFigures]) -> Figure:
    """Part of the measurements inside bands of several levels, against the level; learning and frozen."""
    with page_style():
        figure = Figure(figsize=(PANEL[0], 3.0))
        panels = figure.subplots(1, 2, sharey=True)
        for panel, mode, title in zip(panels, ('adaptive', 'frozen'), ('While it learns', 'Frozen'), strict=True):
            panel.axhspan(-0.02, 0.02, color=FAINT, alpha=0.6, linewidth=0)
            for variant, one in figures.items():
                excess = np.array(getattr(one, mode).coverage_by_level) - LEVELS
                panel.plot(LEVELS, excess, color=COLOURS[variant], linestyle=_dash(variant), marker='o', markersize=3,
                           label=variant)
            panel.set(xlabel='level of the band')
            panel.set_title(title)
            panel.xaxis.set_major_formatter(PercentFormatter(1.0))
        panels[0].yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{100 * value:+.0f}'))
        panels[0].set_ylabel('held minus level [points]')
        _legend(figure, panels[0], figures)
    return figure


def channels(figures: Mapping[str, VariantFigures], names: Sequence[str]) -> Figure:
    """Normalised error of each output; open marks while learning, filled ones frozen."""
    with page_style():
        figure = Figure(figsize=(PANEL[0], 0.34 * len(names) + 1.3))
        panel = figure.subplots()
        for variant, one in figures.items():
            for mode, face in (('adaptive', 'none'), ('frozen', COLOURS[variant])):
                errors = getattr(one, mode).nmse_by_channel
                rows = [row for row, error in enumerate(errors) if error is not None]
                panel.plot([errors[row] for row in rows], rows, linestyle='none', marker='o', markersize=6,
                           markerfacecolor=face, markeredgecolor=COLOURS[variant], alpha=0.85,
                           label=variant if mode == 'frozen' else None)
        panel.set(xscale='log', xlabel='squared error over variance')
        panel.set_yticks(range(len(names)), names, **PLAIN)
        panel.invert_yaxis()
        _legend(figure, panel, figures)
    return figure


def _legend(figure: Figure, panel: Axes, figures: Mapping[str, VariantFigures]) -> None:
    figure.legend(*panel.get_legend_handles_labels(), loc='outside upper center', ncols=len(figures))


def _indices(figures: Mapping[str, VariantFigures]) -> list[str]:
    return list(next(iter(figures.values())).indices)


def _dash(variant: str) -> str:
    return '--' if variant.endswith('VS') else '-'


def _course(time: Array, values: Array) -> tuple[Array, Array]:
    """A running mean over two seconds, thinned to what a page can show."""
    if len(time) < 2:
        return time, values
    width = max(1, min(len(time), round(SMOOTHING_S / max(float(np.median(np.diff(time))), 1e-9))))
    kernel = np.ones(width) / width
    smooth, centre = np.convolve(values, kernel, 'valid'), np.convolve(time, kernel, 'valid')
    step = max(1, len(smooth) // MOST_POINTS)
    return centre[::step], smooth[::step]


def _mark_phases(panel: Axes) -> None:
    for second in (TRANSIENT_S, EARLY_S):
        if second < panel.get_xlim()[1]:
            panel.axvline(second, color=INK, linewidth=0.9, linestyle=(0, (1, 3)))
