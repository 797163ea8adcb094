"""The figures of a diagnosis: residuals over time and against the variables that tell, their spectrum, the candidates,
and the error of each output.

Against what a residual should be drawn so that an effect shows: time, a joint's motion, a link's, or the load. Every
kind says which (a friction shows against velocity, a spring against position); of which joint or axis is taken from
the effect's place, or, where it has none, from what its explanation depends on most.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from scipy.signal import welch

from semiparam_ros.core.robot.frames import frame_motion
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.data.recordings import without_pauses
from semiparam_ros.diagnosis.data.splits import evenly, ranges
from semiparam_ros.diagnosis.diagnose import Diagnosis
from semiparam_ros.diagnosis.findings import Finding
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.residual.noise import noise_floor
from semiparam_ros.diagnosis.residual.structure import Structure
from semiparam_ros.diagnosis.search.scoring import Trial
from semiparam_ros.diagnosis.search.stepwise import Step
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import ALWAYS, Axis, place
from semiparam_ros.effects.temperature import REFERENCE_C, temperature_of
from semiparam_ros.effects.terms import ROLES, variable_values
from semiparam_ros.report.html import FAINT, INK, PLAIN, page_style

DEPENDENCE_BINS = 20

BEFORE, AFTER, CHOSEN, RIVAL, OTHER = '#e08a00', '#3b7dd8', '#1a9c78', '#c060a8', '#8c8c8c'
WIDTH = 8.6
MOST_COLUMNS = 360
MOST_BARS = 9
SEGMENT = 256
GROUPS = {'wrench': {'Forces': slice(0, 3), 'Torques': slice(3, 6)}, 'effort': {'Efforts': slice(None)}}

HEIGHT = 2.7
MOST_POINTS = 900
CLOUD_DPI = 200
BINS = 40
MOST_VARIABLES = 2
QUANTITIES = {'position': 'rad', 'velocity': 'rad/s', 'acceleration': 'rad/s²'}


class Variable(NamedTuple):
    """A quantity over the recording, (N,), and what to write at its axis."""

    label: str
    values: Array


def suspected_variable(effect: Effect, fit: Fit, explained: Array, channel: int) -> Variable:
    """The variable of an effect: of those that it shows against, the one that the explained part depends on most.

    :param fit: the fit of which it explains a part. :param explained: (N,) that part, in output ``channel``.
    """
    if effect.span != ALWAYS:
        return _time(fit)
    return max(VARIABLES[effect.shows_against](effect, fit, channel),
               key=lambda variable: dependence(variable.values, explained))


def dependence(variable: Array, explained: Array) -> float:
    """Share of a signal's variance between the bins of a variable, 0 to 1 (the correlation ratio)."""
    edges = np.quantile(variable, np.linspace(0.0, 1.0, DEPENDENCE_BINS + 1)[1:-1])
    bins = np.searchsorted(edges, variable)
    count = np.bincount(bins, minlength=DEPENDENCE_BINS)
    mean = np.bincount(bins, explained, DEPENDENCE_BINS) / np.maximum(count, 1)
    spread = float(np.sum((explained - explained.mean()) ** 2))
    return float(count @ (mean - explained.mean()) ** 2) / spread if spread > 0.0 else 0.0


def _time(fit: Fit) -> Variable:
    return Variable('time [s]', without_pauses(fit.samples))


def _joints(effect: Effect, fit: Fit, role: str) -> list[Variable]:
    """The motion of the effect's joint, or of every joint."""
    values: Array = getattr(fit.samples, role)
    return [Variable(_quantity(fit.body, role, joint), values[:, index])
            for index, joint in enumerate(fit.body.joints)
            if effect.where not in fit.body.joints or joint == effect.where]


def _link_velocity(effect: Effect, fit: Fit) -> list[Variable]:
    """Velocity of the effect's link along each axis of the sensor."""
    motion = frame_motion(fit.body, fit.samples, str(effect.where))
    velocity = -fit.body.sign * (motion.force_map[:, :3] @ motion.velocity[:, :, None])[:, :, 0]
    return [Variable(f"velocity of {effect.where} along the sensor's {axis} [m/s]", velocity[:, index])
            for index, axis in enumerate('xyz')]


def _outputs(fit: Fit) -> list[Variable]:
    predicted = _predicted(fit)
    named = zip(fit.body.output_names, fit.body.output_units, strict=True)
    return [Variable(f'predicted {name} [{unit}]', predicted[:, index]) for index, (name, unit) in enumerate(named)]


def _output_rate(fit: Fit, channel: int) -> Variable:
    rate = np.gradient(_predicted(fit)[:, channel], fit.samples.time)
    unit = fit.body.output_units[channel]
    return Variable(f'rate of change of {fit.body.output_names[channel]} [{unit}/s]', rate)


def _phase(effect: Effect, fit: Fit) -> Variable:
    frequency = effect.value('frequency_hz', 1.0)
    return Variable(f'phase at {frequency:.3g} Hz [cycles]', np.mod(frequency * fit.samples.time, 1.0))


def _temperature(effect: Effect, fit: Fit) -> Variable:
    values = temperature_of(fit.body, fit.samples, effect.where)
    known = np.where(np.isnan(values), effect.value('reference_c', REFERENCE_C), values)
    return Variable(f'temperature of {effect.where or "the sensor"} [deg C]', known)


def _predicted(fit: Fit) -> Array:
    """Outputs (N, n) as the fit predicts them."""
    return np.asarray(fit.samples.outputs - fit.residual)


VARIABLES: dict[Axis, Callable[[Effect, Fit, int], list[Variable]]] = {
    'any': lambda effect, fit, channel: [_time(fit), *(variable for role in QUANTITIES
                                                       for variable in _joints(effect, fit, role))],
    'time': lambda effect, fit, channel: [_time(fit)],
    'temperature': lambda effect, fit, channel: [_temperature(effect, fit)],
    'position': lambda effect, fit, channel: _joints(effect, fit, 'position'),
    'velocity': lambda effect, fit, channel: _joints(effect, fit, 'velocity'),
    'acceleration': lambda effect, fit, channel: _joints(effect, fit, 'acceleration'),
    'output': lambda effect, fit, channel: _outputs(fit),
    'output_rate': lambda effect, fit, channel: [_output_rate(fit, channel)],
    'link_velocity': lambda effect, fit, channel: _link_velocity(effect, fit),
    'phase': lambda effect, fit, channel: [_phase(effect, fit)],
}
"""The variables among which an effect shows, for each of what kinds say they show against."""


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
              changes: list[tuple[str, float]]) -> Figure:
    """Residuals of the channels over time, as the span of their values in short pieces."""
    with page_style():
        figure = Figure(figsize=(WIDTH, 1.25 * len(labels) + 0.7))
        panels = np.atleast_1d(figure.subplots(len(labels), 1, sharex=True))
        for index, (panel, label) in enumerate(zip(panels, labels, strict=True)):
            for curve in shown:
                centre, low, high = envelope(time, curve.residual[:, index])
                panel.fill_between(centre, low, high, color=curve.colour, linewidth=0.6, label=curve.name)
            for start, end in ranges(held_out):
                panel.axvspan(time[start], time[end - 1], color=FAINT, alpha=0.45, linewidth=0, zorder=0)
            for _, second in changes:
                panel.axvline(second, color=INK, linewidth=0.9, linestyle=(0, (2, 2)))
            panel.set_title(label, fontsize=9, pad=3, **PLAIN)
            panel.set_ylim(*limits(*(curve.residual[:, index] for curve in shown)))
            panel.margins(x=0.0)
        for name, second in changes:
            panels[0].annotate(name, (second, 1.0), xycoords=('data', 'axes fraction'), xytext=(3, 2),
                               textcoords='offset points', fontsize=8, **PLAIN)
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
    fit = diagnosis.final
    floor = noise_floor(fit.residual[fit.train_mask], fit.counted[fit.train_mask])
    groups, telling = GROUPS[fit.body.outputs], fit.counted / np.sqrt(fit.counted.mean(axis=0))
    step = float(np.median(np.diff(fit.samples.time)))
    with page_style():
        figure = Figure(figsize=(WIDTH, 2.8))
        panels = np.atleast_1d(figure.subplots(1, len(groups), sharey=True))
        for panel, (title, channels) in zip(panels, groups.items(), strict=True):
            for curve in curves(diagnosis.first.residual, fit.residual, bool(diagnosis.steps)):
                frequency, power = relative_power(curve.residual * telling, step, floor)
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
    chosen = {(effect.kind, effect.where) for effect in step.added}
    rivals = {(rival.effect.kind, rival.effect.where) for rival in step.rivals}
    with page_style():
        figure = Figure(figsize=(WIDTH, 0.24 * len(shown) + 0.9))
        panel = figure.subplots()
        for row, trial in enumerate(shown):
            key = (trial.effect.kind, trial.effect.where)
            colour = CHOSEN if key in chosen else RIVAL if key in rivals else OTHER
            panel.barh(row, trial.evidence, color=colour, height=0.72)
            panel.annotate(f'{trial.evidence:.0f}', (trial.evidence, row), xytext=(4, 0), textcoords='offset points',
                           va='center', fontsize=8)
        panel.set_yticks(range(len(shown)), [place(trial.effect.kind, trial.effect.where) for trial in shown], **PLAIN)
        panel.invert_yaxis()
        panel.grid(axis='y', visible=False)
        panel.tick_params(axis='y', length=0)
        panel.margins(x=0.08)
        panel.set_xlabel('log evidence over the model so far [nat]')
        panel.set_title(f'Round {number}')
    return figure


def foremost(step: Step) -> list[Trial]:
    """The best candidates of a round that explain anything, and every one that was added."""
    added = {(effect.kind, effect.where) for effect in step.added}
    worth = [trial for trial in step.ranking if trial.evidence > 0.0]
    later = [trial for trial in worth[MOST_BARS:] if (trial.effect.kind, trial.effect.where) in added]
    return [*worth[:MOST_BARS], *later]


def outputs_of(diagnosis: Diagnosis) -> Figure:
    """Held-out error of each output over its standard deviation: before, after, and the noise floor."""
    before, after, labels = diagnosis.before, diagnosis.after, diagnosis.first.body.output_names
    rows = np.arange(len(labels))
    spread = np.sqrt(after.variance)
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
        shown = every[every > 0.0]  # an output that never changes has no share of its deviation
        panel.set(xscale='log', xlim=(0.8 * shown.min(), 1.25 * shown.max()) if len(shown) else (0.1, 1.0))
        panel.set_xlabel('held-out root mean square error over the standard deviation of the output')
        _plain_ticks(panel)
        panel.set_yticks(rows, labels, **PLAIN)
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


class Suspicion(NamedTuple):
    """Findings of one round that show in the same output against the same variable."""

    findings: list[Finding]
    step: Step
    channel: int
    variable: Variable
    explained: Array


def suspicions(diagnosis: Diagnosis) -> list[Suspicion]:
    """Suspicions of a diagnosis: its findings, those together that one picture shows."""
    found: dict[tuple[int, int, str], Suspicion] = {}
    for finding in diagnosis.findings:
        step = diagnosis.steps[finding.round_number - 1]
        channel = telling_channel(step, diagnosis.final, finding)
        explained = step.before.residual[:, channel] - step.after.residual[:, channel]
        variable = suspected_variable(finding.effect, step.before, explained, channel)
        key = finding.round_number, channel, variable.label
        found.setdefault(key, Suspicion([], step, channel, variable, explained)).findings.append(finding)
    return list(found.values())


def against_suspected(diagnosis: Diagnosis, suspicion: Suspicion) -> Figure:
    """The residual of an output before and after what was found in it, where it fitted."""
    channel = suspicion.channel
    use = diagnosis.final.samples_in_use.numbers[channel]
    variable = Variable(suspicion.variable.label, suspicion.variable.values[use])
    sides = (('before', suspicion.step.before.residual[use, channel], BEFORE),
             ('after', diagnosis.final.residual[use, channel], AFTER))
    with page_style():
        figure = Figure(figsize=(WIDTH, HEIGHT), dpi=CLOUD_DPI)
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for panel, (title, residual, colour) in zip(panels, sides, strict=True):
            _cloud(panel, variable, residual, colour)
            panel.set_title(title)
        _course(panels[0], variable, suspicion.explained[use], 'what the effect explains')
        panels[0].set_ylabel(_residual_label(diagnosis.first, channel), **PLAIN)
        panels[0].set_ylim(*limits(*(residual for _, residual, _ in sides)))
    return figure


def telling_channel(step: Step, final: Fit, finding: Finding) -> int:
    """The channel in which a finding explains most over what is left; an effort's own joint."""
    if finding.effect.where in final.body.output_names:
        return final.body.output_names.index(str(finding.effect.where))
    explained = (step.before.residual - step.after.residual) / final.scale
    return int(np.argmax((explained**2).sum(axis=0)))


def against_unexplained(fit: Fit, structure: Structure) -> tuple[Figure, str]:
    """Residual of the least explained channel against what it depends on most; with its name.

    Where time is among the variables, the beginning and the end of the recording have courses of
    their own.
    """
    channel = int(np.argmax(structure.channel_shares))
    use = fit.samples_in_use.numbers[channel]
    residual, time = fit.residual[use, channel], without_pauses(fit.samples)[use]
    names = [each.name for each in structure.variables]
    chosen = sorted(names, key=lambda name: name == 'time')[:MOST_VARIABLES] or ['time']
    with page_style():
        figure = Figure(figsize=(WIDTH, HEIGHT), dpi=CLOUD_DPI)
        panels = np.atleast_1d(figure.subplots(1, len(chosen), sharey=True))
        for panel, name in zip(panels, chosen, strict=True):
            role, _, joint = name.partition('_')
            variable = _time(fit) if not joint else Variable(
                _quantity(fit.body, ROLES[role][0], joint), variable_values(name, fit.body, fit.samples))
            variable = variable._replace(values=variable.values[use])
            _cloud(panel, variable, residual, AFTER)
            for label, rows, colour in _periods(time, 'time' in names and name != 'time'):
                _course(panel, Variable(variable.label, variable.values[rows]), residual[rows], label, colour)
        panels[0].set_ylabel(_residual_label(fit, channel), **PLAIN)
        panels[0].set_ylim(*limits(residual))
    return figure, fit.body.output_names[channel]


def _periods(time: Array, apart: bool) -> list[tuple[str, Mask, str]]:
    if not apart:
        return [('its mean', np.ones(len(time), dtype=bool), INK)]
    third = (time[-1] - time[0]) / 3.0
    return [('mean of the first third', time < time[0] + third, INK),
            ('mean of the last third', time > time[-1] - third, OTHER)]


def _quantity(body: RigidBody, role: str, joint: str) -> str:
    return f'{role} of {joint} [{body.joint_unit(joint, QUANTITIES[role])}]'


def _residual_label(fit: Fit, channel: int) -> str:
    return f'residual of {fit.body.output_names[channel]} [{fit.body.output_units[channel]}]'


def _cloud(panel: Axes, variable: Variable, residual: Array, colour: str) -> None:
    chosen = evenly(len(residual), MOST_POINTS)
    panel.plot(variable.values[chosen], residual[chosen], linestyle='none', marker='o', markersize=2.4, color=colour,
               markeredgewidth=0, alpha=0.6, rasterized=True)  # a point in SVG takes a hundred bytes
    panel.axhline(0.0, color=INK, linewidth=0.7)
    panel.set_xlabel(variable.label, **PLAIN)


def _course(panel: Axes, variable: Variable, values: Array, label: str, colour: str = INK) -> None:
    """The mean of values in bins of the variable."""
    edges = np.unique(np.quantile(variable.values, np.linspace(0.0, 1.0, BINS + 1)))
    bins = np.clip(np.searchsorted(edges, variable.values, side='right') - 1, 0, max(len(edges) - 2, 0))
    count = np.bincount(bins)
    filled = count > 0
    centre, mean = (np.bincount(bins, column)[filled] / count[filled] for column in (variable.values, values))
    panel.plot(centre, mean, color=colour, linewidth=1.5, label=label)
    panel.legend(loc='best', fontsize=8)
