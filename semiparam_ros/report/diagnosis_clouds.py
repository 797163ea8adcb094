"""Residuals against a variable: what an effect explains of it, and what no effect does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.diagnose import Diagnosis
from semiparam_ros.diagnosis.findings import Finding
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.search import Step
from semiparam_ros.diagnosis.structure import Structure
from semiparam_ros.effects.terms import variable_values
from semiparam_ros.report.diagnosis_figures import AFTER, BEFORE, OTHER, WIDTH, limits
from semiparam_ros.report.suspected_variable import Variable, suspected_variable
from semiparam_ros.report.svg import INK, page_style

HEIGHT = 2.7
MOST_POINTS = 900
CLOUD_DPI = 200
BINS = 40
MOST_VARIABLES = 2
QUANTITIES = {'q': 'position of {} [rad]', 'dq': 'velocity of {} [rad/s]', 'ddq': 'acceleration of {} [rad/s²]'}


class Suspicion(NamedTuple):
    """Findings of one round that show in the same output against the same variable."""

    findings: list[Finding]
    step: Step
    channel: int
    variable: Variable
    explained: Array


def suspicions(diagnosis: Diagnosis) -> list[Suspicion]:
    """All findings, those together that one picture shows."""
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
    """The residual of an output before and after what was found in it, at the samples that fitted."""
    channel, use = suspicion.channel, diagnosis.first.use
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
        panels[0].set_ylabel(_residual_label(diagnosis.first, channel))
        panels[0].set_ylim(*limits(*(residual for _, residual, _ in sides)))
    return figure


def telling_channel(step: Step, final: Fit, finding: Finding) -> int:
    """The channel in which a finding explains most over what is left; an effort's own joint."""
    if finding.effect.where in final.body.output_names:
        return final.body.output_names.index(str(finding.effect.where))
    explained = (step.before.residual - step.after.residual) / final.scale
    return int(np.argmax((explained**2).sum(axis=0)))


def against_unexplained(state: Fit, structure: Structure) -> tuple[Figure, str]:
    """What is left of the channel with most structure against what it depends on most, and the channel's name.

    Where time is among the variables, the beginning and the end of the recording have courses of their own.
    """
    channel, use = int(np.argmax(structure.channel_shares)), state.use
    residual, time = state.residual[use, channel], state.samples.time[use]
    names = [each.name for each in structure.variables]
    chosen = sorted(names, key=lambda name: name == 'time')[:MOST_VARIABLES] or ['time']
    with page_style():
        figure = Figure(figsize=(WIDTH, HEIGHT), dpi=CLOUD_DPI)
        panels = np.atleast_1d(figure.subplots(1, len(chosen), sharey=True))
        for panel, name in zip(panels, chosen, strict=True):
            variable = Variable(_quantity(name), variable_values(name, state.body, state.samples)[use])
            _cloud(panel, variable, residual, AFTER)
            for label, rows, colour in _periods(time, 'time' in names and name != 'time'):
                _course(panel, Variable(variable.label, variable.values[rows]), residual[rows], label, colour)
        panels[0].set_ylabel(_residual_label(state, channel))
        panels[0].set_ylim(*limits(residual))
    return figure, state.body.output_names[channel]


def _periods(time: Array, apart: bool) -> list[tuple[str, Mask, str]]:
    if not apart:
        return [('its mean', np.ones(len(time), dtype=bool), INK)]
    third = (time[-1] - time[0]) / 3.0
    return [('mean of the first third', time < time[0] + third, INK),
            ('mean of the last third', time > time[-1] - third, OTHER)]


def _quantity(name: str) -> str:
    role, _, joint = name.partition('_')
    return QUANTITIES[role].format(joint) if role in QUANTITIES else 'time [s]'


def _residual_label(state: Fit, channel: int) -> str:
    return f'residual of {state.body.output_names[channel]} [{state.body.output_units[channel]}]'


def _cloud(panel: Axes, variable: Variable, residual: Array, colour: str) -> None:
    chosen = np.unique(np.linspace(0, len(residual) - 1, MOST_POINTS).astype(int))
    panel.plot(variable.values[chosen], residual[chosen], linestyle='none', marker='o', markersize=2.4, color=colour,
               markeredgewidth=0, alpha=0.6, rasterized=True)  # a point in SVG takes a hundred bytes
    panel.axhline(0.0, color=INK, linewidth=0.7)
    panel.set_xlabel(variable.label)


def _course(panel: Axes, variable: Variable, values: Array, label: str, colour: str = INK) -> None:
    """The mean of values in bins of the variable."""
    edges = np.unique(np.quantile(variable.values, np.linspace(0.0, 1.0, BINS + 1)))
    bins = np.clip(np.searchsorted(edges, variable.values, side='right') - 1, 0, max(len(edges) - 2, 0))
    count = np.bincount(bins)
    filled = count > 0
    centre, mean = (np.bincount(bins, column)[filled] / count[filled] for column in (variable.values, values))
    panel.plot(centre, mean, color=colour, linewidth=1.5, label=label)
    panel.legend(loc='best', fontsize=8)
