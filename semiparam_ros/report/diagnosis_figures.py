"""The figures of a diagnosis: residuals over time, their spectrum, the candidates, and the error of each output."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from scipy.signal import welch

from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.blocks import ranges
from semiparam_ros.diagnosis.diagnose import Diagnosis
from semiparam_ros.diagnosis.noise import noise_floor
from semiparam_ros.diagnosis.ranking import Trial
from semiparam_ros.diagnosis.search import Step
from semiparam_ros.diagnosis.words import place
from semiparam_ros.report.svg import FAINT, INK, page_style

BEFORE, AFTER, CHOSEN, RIVAL, OTHER = '#e08a00', '#3b7dd8', '#1a9c78', '#c060a8', '#8c8c8c'
WIDTH = 8.6
MOST_COLUMNS = 360
MOST_BARS = 9
SEGMENT = 256
GROUPS = {'wrench': {'Forces': slice(0, 3), 'Torques': slice(3, 6)}, 'effort': {'Efforts': slice(None)}}


class Curve(NamedTuple):
    """A residual (N, n), and how it is named and drawn."""

    name: str
    residual: Array
    colour: str


def curves(before: Array, after: Array, added: bool) -> list[Curve]:
    """Residuals (N, n) before and after; one alone where nothing was added."""
    if not added:
        return [Curve('residual', after, AFTER)]
    return [Curve('before', before, BEFORE), Curve('after', after, AFTER)]


def over_time(time: Array, shown: list[Curve], labels: list[str], held_out: Mask,
              starts: list[tuple[str, float]]) -> Figure:
    """Each channel's residual as the span of its values in short pieces of time."""
    with page_style():
        figure = Figure(figsize=(WIDTH, 1.25 * len(labels) + 0.7))
        panels = np.atleast_1d(figure.subplots(len(labels), 1, sharex=True))
        for index, (panel, label) in enumerate(zip(panels, labels, strict=True)):
            for curve in shown:
                centre, low, high = envelope(time, curve.residual[:, index])
                panel.fill_between(centre, low, high, color=curve.colour, linewidth=0.6, label=curve.name)
            for start, end in ranges(held_out):
                panel.axvspan(time[start], time[end - 1], color=FAINT, alpha=0.45, linewidth=0, zorder=0)
            for _, second in starts:
                panel.axvline(second, color=INK, linewidth=0.9, linestyle=(0, (2, 2)))
            panel.set_title(label, fontsize=9, pad=3)
            panel.set_ylim(*limits(*(curve.residual[:, index] for curve in shown)))
            panel.margins(x=0.0)
        for name, second in starts:
            panels[0].annotate(name, (second, 1.0), xycoords=('data', 'axes fraction'), xytext=(3, 2),
                               textcoords='offset points', fontsize=8)
        panels[-1].set_xlabel('time [s]')
        figure.legend(*panels[0].get_legend_handles_labels(), loc='outside upper right', ncols=2)
    return figure


def envelope(time: Array, values: Array) -> tuple[Array, Array, Array]:
    """Centre, least and greatest value (M,) of short pieces of a signal (N,)."""
    pieces = min(MOST_COLUMNS, max(len(values) // 3, 1))
    parts = np.array_split(np.arange(len(values)), pieces)
    low, high = (np.array([pick(values[part]) for part in parts]) for pick in (np.min, np.max))
    return np.array([time[part].mean() for part in parts]), low, high


def limits(*residuals: Array) -> tuple[float, float]:
    """A span that a few outliers do not stretch."""
    low, high = np.quantile(np.concatenate(residuals), (0.002, 0.998))
    margin = 0.12 * max(float(high - low), 1e-12)
    return float(low) - margin, float(high) + margin


def spectra(diagnosis: Diagnosis) -> Figure:
    """Power of the residual over that of its white noise, before and after, mean over outputs of a kind."""
    state = diagnosis.final
    floor, groups = noise_floor(state.residual[state.use]), GROUPS[state.body.outputs]
    step = float(np.median(np.diff(state.samples.time)))
    with page_style():
        figure = Figure(figsize=(WIDTH, 2.8))
        panels = np.atleast_1d(figure.subplots(1, len(groups), sharey=True))
        for panel, (title, channels) in zip(panels, groups.items(), strict=True):
            for curve in curves(diagnosis.first.residual, state.residual, bool(diagnosis.steps)):
                frequency, power = relative_power(curve.residual, step, floor)
                panel.plot(frequency, power[:, channels].mean(axis=1), color=curve.colour, label=curve.name)
            panel.axhline(1.0, color=INK, linewidth=0.9, linestyle=(0, (2, 2)), label='white noise')
            panel.set(yscale='log', xscale='log', xlabel='frequency [Hz]')
            panel.set_title(title)
            _plain_ticks(panel)
        low, high = panels[0].get_ylim()
        panels[0].set(ylabel='power over the noise', ylim=(min(low, 0.1), max(high, 10.0)))
        figure.legend(*panels[0].get_legend_handles_labels(), loc='outside upper right', ncols=3)
    return figure


def relative_power(residual: Array, step: float, floor: Array) -> tuple[Array, Array]:
    """Frequencies (F,) [Hz] and density (F, n) of a residual over that of white noise with deviation ``floor`` (n,).

    :param step: time between samples [s].
    """
    frequency, power = welch(residual, 1.0 / step, nperseg=min(SEGMENT, len(residual)), axis=0)
    return frequency[1:], power[1:] / np.maximum(2.0 * step * floor**2, 1e-300)


def candidates_of(step: Step, number: int) -> Figure:
    """Log evidence of the foremost candidates of a round, the chosen ones and their rivals in colours of their own."""
    shown = foremost(step)
    chosen = {(trial.effect.kind, trial.effect.where) for trial in step.added}
    rivals = {(rival.kind, rival.where) for group in step.rivals for rival in group}
    with page_style():
        figure = Figure(figsize=(WIDTH, 0.24 * len(shown) + 0.9))
        panel = figure.subplots()
        for row, trial in enumerate(shown):
            key = (trial.effect.kind, trial.effect.where)
            colour = CHOSEN if key in chosen else RIVAL if key in rivals else OTHER
            panel.barh(row, trial.evidence, color=colour, height=0.72)
            panel.annotate(f'{trial.evidence:.0f}', (trial.evidence, row), xytext=(4, 0), textcoords='offset points',
                           va='center', fontsize=8)
        panel.set_yticks(range(len(shown)), [place(trial.effect.kind, trial.effect.where) for trial in shown])
        panel.invert_yaxis()
        panel.grid(axis='y', visible=False)
        panel.tick_params(axis='y', length=0)
        panel.margins(x=0.08)
        panel.set_xlabel('log evidence over the model so far [nat]')
        panel.set_title(f'Round {number}')
    return figure


def foremost(step: Step) -> list[Trial]:
    """The best candidates of a round that explain anything, and every one that was added."""
    added = {(trial.effect.kind, trial.effect.where) for trial in step.added}
    worth = [trial for trial in step.ranking if trial.evidence > 0.0]
    later = [trial for trial in worth[MOST_BARS:] if (trial.effect.kind, trial.effect.where) in added]
    return [*worth[:MOST_BARS], *later]


def outputs_of(diagnosis: Diagnosis, labels: list[str]) -> Figure:
    """Held-out error of each output over its standard deviation: before, after, and the noise floor."""
    before, after, rows = diagnosis.before, diagnosis.after, np.arange(len(labels))
    spread = np.maximum(after.outputs.std(axis=0), 1e-300)
    marks = curves(before.rmse / spread, after.rmse / spread, bool(diagnosis.steps))
    floor = diagnosis.noise_floor_rmse / spread
    with page_style():
        figure = Figure(figsize=(WIDTH, 0.34 * len(labels) + 1.1))
        panel = figure.subplots()
        panel.hlines(rows, after.rmse / spread, before.rmse / spread, color=FAINT, linewidth=3.0)
        panel.plot(floor, rows, linestyle='none', marker='|', markersize=13, color=INK, label='noise floor')
        for name, errors, colour in marks:
            panel.plot(errors, rows, linestyle='none', marker='o', color=colour, label=name)
        every = np.concatenate([floor, *(errors for _, errors, _ in marks)])
        panel.set(xscale='log', xlim=(0.8 * every.min(), 1.25 * every.max()))
        panel.set_xlabel('held-out root mean square error over the standard deviation of the output')
        _plain_ticks(panel)
        panel.set_yticks(rows, labels)
        panel.invert_yaxis()
        figure.legend(*panel.get_legend_handles_labels(), loc='outside upper right', ncols=3)
    return figure


def _plain_ticks(panel: Axes) -> None:
    """Numbers without powers of ten at a logarithmic axis: all digits over a short span, 1, 2 and 5 over a long one."""
    low, high = panel.get_xlim()
    digits = '123456789' if high < 4.0 * low else '125'
    formatter = FuncFormatter(lambda value, _: f'{value:g}' if f'{value:.0e}'[0] in digits else '')
    panel.xaxis.set_major_formatter(formatter)
    panel.xaxis.set_minor_formatter(formatter)
    panel.tick_params(axis='x', which='minor', labelsize=9)
