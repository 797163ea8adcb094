"""The figures of a diagnosis: residuals over time, against what is suspected, their spectrum, and the candidates."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from scipy.signal import welch

from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.blocks import ranges
from semiparam_ros.diagnosis.diagnose import Diagnosis
from semiparam_ros.diagnosis.findings import Finding
from semiparam_ros.diagnosis.judgement import Judgement
from semiparam_ros.diagnosis.noise import noise_floor
from semiparam_ros.diagnosis.ranking import Trial
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.search import Step
from semiparam_ros.diagnosis.words import place
from semiparam_ros.report.suspected_variable import Variable, suspected_variable
from semiparam_ros.report.svg import FAINT, INK, page_style

BEFORE, AFTER, CHOSEN, RIVAL, OTHER = '#e08a00', '#3b7dd8', '#1a9c78', '#c060a8', '#8c8c8c'
WIDTH = 8.6
MOST_COLUMNS = 360
MOST_POINTS = 700
MOST_BARS = 9
SEGMENT = 256
GROUPS = {'wrench': {'Forces': slice(0, 3), 'Torques': slice(3, 6)}, 'effort': {'Efforts': slice(None)}}


def over_time(time: Array, before: Array, after: Array, labels: list[str], held_out: Mask,
              starts: list[tuple[str, float]]) -> Figure:
    """Each channel's residual (N, n) before and after as the span of its values in short pieces of time."""
    with page_style():
        figure = Figure(figsize=(WIDTH, 1.25 * len(labels) + 0.7))
        panels = np.atleast_1d(figure.subplots(len(labels), 1, sharex=True))
        for index, (panel, label) in enumerate(zip(panels, labels, strict=True)):
            for values, colour, name in ((before, BEFORE, 'before'), (after, AFTER, 'after')):
                centre, low, high = envelope(time, values[:, index])
                panel.fill_between(centre, low, high, color=colour, linewidth=0.6, label=name)
            for start, end in ranges(held_out):
                panel.axvspan(time[start], time[end - 1], color=FAINT, alpha=0.45, linewidth=0, zorder=0)
            for _, second in starts:
                panel.axvline(second, color=INK, linewidth=0.9, linestyle=(0, (2, 2)))
            panel.set_title(label, fontsize=9, pad=3)
            panel.set_ylim(*_limits(before[:, index], after[:, index]))
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


def _limits(before: Array, after: Array) -> tuple[float, float]:
    """A span that a few outliers do not stretch."""
    both = np.concatenate([before, after])
    low, high = np.quantile(both, (0.002, 0.998))
    margin = 0.12 * max(float(high - low), 1e-12)
    return float(low) - margin, float(high) + margin


def against_variable(diagnosis: Diagnosis, finding: Finding) -> tuple[Figure, str]:
    """The residual of the channel that an effect explains most, before and after it, and the channel's name."""
    step = diagnosis.steps[finding.round_number - 1]
    channel = telling_channel(step, diagnosis.final, finding)
    explained = step.before.residual[:, channel] - step.after.residual[:, channel]
    variable = suspected_variable(finding.effect, step.before, explained, channel)
    body = diagnosis.first.body
    sides = (('before', step.before, BEFORE), ('after', diagnosis.final, AFTER))
    with page_style():
        figure = Figure(figsize=(WIDTH, 2.7))
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for panel, (title, state, colour) in zip(panels, sides, strict=True):
            _cloud(panel, variable, state.residual[:, channel], colour)
            panel.set_title(title)
            panel.set_xlabel(variable.label)
        _course(panels[0], variable, explained)
        panels[0].set_ylabel(f'residual of {body.output_names[channel]} [{body.output_units[channel]}]')
        panels[0].set_ylim(*_limits(step.before.residual[:, channel], diagnosis.final.residual[:, channel]))
    return figure, body.output_names[channel]


def telling_channel(step: Step, final: Fit, finding: Finding) -> int:
    """The channel in which a finding explains most over what is left; an effort's own joint."""
    if finding.effect.where in final.body.output_names:
        return final.body.output_names.index(str(finding.effect.where))
    explained = (step.before.residual - step.after.residual) / final.scale
    return int(np.argmax((explained**2).sum(axis=0)))


def _cloud(panel: Axes, variable: Variable, residual: Array, colour: str) -> None:
    chosen = np.unique(np.linspace(0, len(residual) - 1, MOST_POINTS).astype(int))
    panel.plot(variable.values[chosen], residual[chosen], linestyle='none', marker='o', markersize=2.4, color=colour,
               markeredgewidth=0, alpha=0.6)
    panel.axhline(0.0, color=INK, linewidth=0.7)


def _course(panel: Axes, variable: Variable, explained: Array) -> None:
    """What the effect explains, as the mean in bins of the variable."""
    edges = np.unique(np.quantile(variable.values, np.linspace(0.0, 1.0, 41)))
    bins = np.clip(np.searchsorted(edges, variable.values, side='right') - 1, 0, max(len(edges) - 2, 0))
    count = np.bincount(bins)
    filled = count > 0
    centre, mean = (np.bincount(bins, values)[filled] / count[filled] for values in (variable.values, explained))
    panel.plot(centre, mean, color=INK, linewidth=1.5, label='what the effect explains')
    panel.legend(loc='best', fontsize=8)


def spectra(diagnosis: Diagnosis) -> Figure:
    """Power of the residual over that of its white noise, before and after, mean over outputs of a kind."""
    before, after = diagnosis.first, diagnosis.final
    floor = noise_floor(after.residual[after.use])
    groups = GROUPS[after.body.outputs]
    with page_style():
        figure = Figure(figsize=(WIDTH, 2.8))
        panels = np.atleast_1d(figure.subplots(1, len(groups), sharey=True))
        for panel, (title, channels) in zip(panels, groups.items(), strict=True):
            for state, colour, name in ((before, BEFORE, 'before'), (after, AFTER, 'after')):
                frequency, power = relative_power(state, floor)
                panel.plot(frequency, power[:, channels].mean(axis=1), color=colour, label=name)
            panel.axhline(1.0, color=INK, linewidth=0.9, linestyle=(0, (2, 2)), label='white noise')
            panel.set(yscale='log', xscale='log', xlabel='frequency [Hz]')
            _plain_ticks(panel)
            panel.set_title(title)
        panels[0].set_ylabel('power over the noise')
        figure.legend(*panels[0].get_legend_handles_labels(), loc='outside upper right', ncols=3)
    return figure


def relative_power(state: Fit, floor: Array) -> tuple[Array, Array]:
    """Frequencies (F,) [Hz] and spectral density (F, n) over that of white noise with deviation ``floor`` (n,)."""
    step = float(np.median(np.diff(state.samples.time)))
    length = min(SEGMENT, len(state.residual))
    frequency, power = welch(state.residual, 1.0 / step, nperseg=length, axis=0)
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


def _plain_ticks(panel: Axes) -> None:
    """Numbers without powers of ten at a logarithmic axis: all digits over a short span, 1, 2 and 5 over a long one."""
    low, high = panel.get_xlim()
    digits = '123456789' if high < 4.0 * low else '125'
    formatter = FuncFormatter(lambda value, _: f'{value:g}' if f'{value:.0e}'[0] in digits else '')
    panel.xaxis.set_major_formatter(formatter)
    panel.xaxis.set_minor_formatter(formatter)
    panel.tick_params(axis='x', which='minor', labelsize=9)


def outputs_of(before: Judgement, after: Judgement, floor: Array, labels: list[str]) -> Figure:
    """Error of each output over its standard deviation: before, after with its interval, and the noise floor."""
    spread = np.maximum(after.outputs.std(axis=0), 1e-300)
    rows = np.arange(len(labels))
    with page_style():
        figure = Figure(figsize=(WIDTH, 0.34 * len(labels) + 1.1))
        panel = figure.subplots()
        panel.hlines(rows, after.rmse / spread, before.rmse / spread, color=FAINT, linewidth=3.0)
        panel.plot(floor / spread, rows, linestyle='none', marker='|', markersize=13, color=INK, label='noise floor')
        panel.plot(before.rmse / spread, rows, linestyle='none', marker='o', color=BEFORE, label='before')
        panel.plot(after.rmse / spread, rows, linestyle='none', marker='o', color=AFTER, label='after')
        panel.set(xscale='log', xlabel='held-out root mean square error over the standard deviation of the output')
        _plain_ticks(panel)
        panel.set_yticks(rows, labels)
        panel.invert_yaxis()
        figure.legend(*panel.get_legend_handles_labels(), loc='outside upper right', ncols=3)
    return figure
