"""The scoreboard: simulated recordings with known hidden effects, diagnosed as if nothing were known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypedDict

import numpy as np
from rich.console import Console
from rich.table import Table

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.diagnose import Diagnosis, diagnose
from semiparam_ros.diagnosis.evaluation import evaluate_here
from semiparam_ros.diagnosis.regression import fit_model
from semiparam_ros.effects import kinds
from semiparam_ros.effects.base import CHANNELS
from semiparam_ros.experiments.parallel import run_all, workers
from semiparam_ros.simulation.causes import CAUSES, cause_of
from semiparam_ros.simulation.scenario import EffectRequest, Scenario, SimulatedRecording
from semiparam_ros.simulation.simulate import simulate

NOTHING = 'nothing'
MOTION = 'circle_xy'
TOGETHER = '+'
"""Sign between kinds that are hidden at once."""
NEAR_SAMPLES = 2.0
"""A start counts as right within so many samples."""
SURE_DEVIATIONS = 2.0
"""A value counts as right within so many of its standard deviations."""


@dataclass(frozen=True)
class Plan:
    """Plan of recordings: every kind, size and seed, and as many with nothing missing.

    :param kinds: those to hide, or several at once as ``viscous_friction+time_delay``; each one
        unless given.
    :param accelerations: whether they are measured; a diagnosis estimates them otherwise.
    :param noise_correlation_s: time over which the outputs' noise is correlated [s]; 0 for white
        noise.
    """

    outputs: str
    kinds: tuple[str, ...]
    sizes: tuple[float, ...]
    seeds: int
    samples: int
    first_seed: int = 0
    accelerations: bool = True
    rate_hz: float = 20.0
    noise_correlation_s: float = 0.0

    @property
    def cases(self) -> list[tuple[str, float, int]]:
        """Kind, size and seed of each recording; the kind ``nothing`` has no hidden effect."""
        names = self.kinds or tuple(name for name in kinds(self.outputs) if name in CAUSES)
        first = self.first_seed
        hidden = [(name, size, first + seed) for name in names for size in self.sizes for seed in range(self.seeds)]
        return hidden + [(NOTHING, 0.0, first + seed) for seed in range(self.seeds * len(self.sizes))]

    @property
    def count(self) -> int:
        """Number of recordings."""
        return len(self.cases)


class ScoreboardRow(TypedDict):
    """One recording: what was hidden and what was found; None where nothing was hidden."""

    kind: str
    size: float
    seed: int
    where: str | None
    verdict: str
    visible_share: float | None
    found: list[str]
    found_where: list[str | None]
    group: list[str]
    removed: float | None
    start_off_samples: float | None  # of a hidden start whose kind was found first; all of them where no start was
    deviations_off: list[float]  # of the true kind's values, where it was found at its place


class ScoreboardSummary(TypedDict):
    """Shares of the rows (None without rows), by kind, and how often each kind was found for each hidden one."""

    right_first: float | None
    right_or_in_group: float | None
    exactly: float | None
    false_alarms: float | None
    starts_near: float | None
    values_sure: float | None
    removed_median: float | None
    by_kind: dict[str, float]
    confusion: dict[str, dict[str, int]]


class Scoreboard(TypedDict):
    """The scoreboard as the machine-readable report has it."""

    outputs: str
    samples: int
    rows: list[ScoreboardRow]
    summary: ScoreboardSummary


def scoreboard(plan: Plan, jobs: int, done: Callable[[], None]) -> Scoreboard:
    """Diagnose every case of the plan; rows and a summary. ``done`` is called after each.

    Raises SemiparamError for a kind that cannot be simulated.
    """
    for names in plan.kinds:
        for name in names.split(TOGETHER) if names != NOTHING else ():
            cause_of(name, plan.outputs)
    with workers(jobs):
        rows = run_all(case, [(plan, *entry) for entry in plan.cases], done)
    return {'outputs': plan.outputs, 'samples': plan.samples, 'rows': rows, 'summary': summary(rows)}


def case(plan: Plan, kind: str, size: float, seed: int) -> ScoreboardRow:
    """One recording: what was hidden, what was found, and the share of the removable error that was removed."""
    hidden = () if kind == NOTHING else tuple(
        EffectRequest(name, size=size) for name in kind.split(TOGETHER))
    clean = Scenario(motion=MOTION, samples=plan.samples, rate_hz=plan.rate_hz, seed=seed, outputs=plan.outputs,
                     accelerations=plan.accelerations, noise_correlation_s=plan.noise_correlation_s)
    recording = simulate(replace(clean, effects=hidden))
    found = diagnose(body_of(recording), samples_of(recording))
    truth = recording.truth[0] if recording.truth else {}
    return {'kind': kind, 'size': size, 'seed': seed, 'where': truth.get('where'), 'verdict': found.verdict,
            'visible_share': truth.get('unexplained_share'),
            'found': [finding.effect.kind for finding in found.findings],
            'found_where': [finding.effect.where for finding in found.findings],
            'group': [rival.effect.kind for rival in found.findings[0].rivals] if found.findings else [],
            'removed': removed_share(found, samples_of(simulate(clean))) if hidden else None,
            'start_off_samples': start_off(found, recording.truth, plan),
            'deviations_off': [off for true in recording.truth for off in deviations_off(found, true)]}


def start_off(found: Diagnosis, truth: Sequence[dict[str, Any]], plan: Plan) -> float | None:
    """Samples between the first hidden start and the one found for it, all of them where no start was found; None where
    that kind was not found first."""
    starts = [true for true in truth if true['start_s'] is not None]
    if not starts or not found.findings or found.findings[0].effect.kind != starts[0]['kind']:
        return None
    start_s = found.findings[0].effect.start_s
    return float(plan.samples) if start_s is None else abs(start_s - float(starts[0]['start_s'])) * plan.rate_hz


def deviations_off(found: Diagnosis, true: dict[str, Any]) -> list[float]:
    """Deviations of each value from the true one, in standard deviations, if found at its place."""
    at_place = [finding for finding in found.findings if finding.effect.kind == true['kind']
                and (finding.effect.where == true['where'] or true['kind'] == 'sensor_gain')]
    if not at_place:
        return []
    parameters = at_place[0].parameters
    return [(parameters[name].value - value) / deviation for name, value in true_values(true).items()
            if name in parameters and (deviation := parameters[name].std)]


def true_values(true: dict[str, Any]) -> dict[str, float]:
    """Name of a coefficient or calibration -> its true value, from an entry of a simulated recording's truth.

    Those that mean the same to the effect: not the stiffnesses of a cable, which the effect linearises.
    """
    values = {name: entry['value'] for name, entry in true['parameters'].items()}
    kind = true['kind']
    if kind.startswith('cable_'):
        return {}
    if kind == 'payload':
        return {'mass': values['mass']} | {f'first_moment_{axis}': values['mass'] * place
                                           for axis, place in zip('xyz', values['centre'], strict=True)}
    if kind == 'sensor_gain':
        return {f'gain_{true["where"]}': values['gain']}
    if kind == 'sensor_crosstalk':
        return {f'{to}_from_{by}': values['crosstalk'][row][column] for row, to in enumerate(CHANNELS)
                for column, by in enumerate(CHANNELS) if row != column}
    if kind == 'joint_spring':
        return {'stiffness': values['stiffness'], 'rest_torque': -values['stiffness'] * values['rest_position']}
    if kind in ('transmission_ripple', 'periodic_disturbance'):
        return _waves(values)
    names = {'force': [f'force_{axis}' for axis in 'xyz'], 'rotation_vector': [f'rotation_{axis}' for axis in 'xyz']}
    flat: dict[str, float] = {}
    for name, value in values.items():
        each = names.get(name, CHANNELS) if isinstance(value, list) else [name]
        flat |= dict(zip(each, value if isinstance(value, list) else [value], strict=True))
    return flat


def _waves(values: dict[str, Any]) -> dict[str, float]:
    """Sine and cosine of a wave of known amplitude (of a joint, or three of a force) and phase."""
    parts = {'sin': np.cos(values['phase']), 'cos': np.sin(values['phase'])}
    if 'force' in values:
        return {f'{part}_force_{axis}': share * size for part, share in parts.items()
                for axis, size in zip('xyz', values['force'], strict=True)}
    size = values['amplitude'] if 'amplitude' in values else values['torque']
    return {part: share * size for part, share in parts.items()}


def body_of(recording: SimulatedRecording) -> RigidBody:
    """The rigid body that a user would declare: the description, not the true inertias."""
    return RigidBody.from_urdf(recording.urdf, recording.joint_names, recording.outputs_kind,
                               recording.frame_id or None, recording.convention)


def samples_of(recording: SimulatedRecording) -> Samples:
    """The recording as the estimator sees it."""
    acceleration = np.zeros_like(recording.velocity) if recording.acceleration is None else recording.acceleration
    found = Samples(recording.stamps, recording.position, recording.velocity, acceleration, recording.outputs,
                    int(recording.stamps[0]))
    return found if recording.temperature is None else replace(found, temperature=recording.temperature)


def removed_share(found: Diagnosis, twin: Samples) -> float:
    """Share of the removable error that the effects found removed, over channels relative to their variance.

    :param twin: the same recording, noise included, without the hidden effect. What the declared model leaves of it
        no diagnosis can remove.
    """
    first = found.first
    floor = evaluate_here(fit_model(first.body, found.inputs.prepare(twin), first.effects, first.train_mask,
                                    first.scale, first.config, first.counted),
                          found.judged)
    variance = found.before.outputs.var(axis=0)
    before, after, least = (float(np.sum(evaluation.rmse**2 / variance))
                            for evaluation in (found.before, found.after, floor))
    return (before - after) / max(before - least, 1e-12)


def summary(rows: Sequence[ScoreboardRow]) -> ScoreboardSummary:
    """Shares of right kinds and false alarms, errors removed, and the confusion matrix."""
    hidden = [row for row in rows if row['kind'] != NOTHING]
    clean = [row for row in rows if row['kind'] == NOTHING]
    names = list(dict.fromkeys(row['kind'] for row in hidden))
    confusion = {name: dict(Counter(_first(row) or row['verdict'] for row in hidden if row['kind'] == name))
                 for name in names}
    return {'right_first': _share([_first(row) in row['kind'].split(TOGETHER) for row in hidden]),
            'right_or_in_group': _share([named(row) for row in hidden]),
            'exactly': _share([exactly(row) for row in hidden]),
            'false_alarms': _share([row['verdict'] != 'nothing_missing' for row in clean]),
            'starts_near': _share([row['start_off_samples'] <= NEAR_SAMPLES for row in hidden
                                   if row['start_off_samples'] is not None]),
            'values_sure': _share([abs(off) <= SURE_DEVIATIONS for row in hidden for off in row['deviations_off']]),
            'removed_median': float(np.median([row['removed'] for row in hidden])) if hidden else None,
            'by_kind': {name: float(np.mean([named(row) for row in hidden if row['kind'] == name])) for name in names},
            'confusion': confusion}


def named(row: ScoreboardRow) -> bool:
    """The hidden kind was found first, or stands in the group that the first one cannot be told from."""
    causes = row['kind'].split(TOGETHER)
    return _first(row) is not None and any(kind in causes for kind in (_first(row), *row['group']))


def exactly(row: ScoreboardRow) -> bool:
    """Tell whether what was hidden was found, and nothing beside it."""
    return row['verdict'] == 'effect_found' and sorted(row['found']) == sorted(row['kind'].split(TOGETHER))


def _first(row: ScoreboardRow) -> str | None:
    """The kind that the report names, None where it says that nothing is missing, or that no kind explains it."""
    return row['found'][0] if row['found'] and row['verdict'] == 'effect_found' else None


def _share(values: list[bool]) -> float | None:
    return float(np.mean(values)) if values else None


def print_scoreboard(console: Console, result: Scoreboard) -> None:
    """The confusion matrix, a line for each hidden kind, and the summary."""
    rows, totals = result['rows'], result['summary']
    table = Table('hidden', 'named', 'removed (median)', 'found first')
    for name, counts in totals['confusion'].items():
        removed = np.median([row['removed'] for row in rows if row['kind'] == name])
        found = ', '.join(f'{kind} {count}' for kind, count in sorted(counts.items(), key=lambda item: -item[1]))
        table.add_row(name, f'{100 * totals["by_kind"][name]:.0f} %', f'{100 * removed:.0f} %', found)
    console.print(table)
    for label, share in (('right kind first', totals['right_first']),
                         ('right kind first or in its group', totals['right_or_in_group']),
                         ('exactly the hidden kinds, and nothing beside them', totals['exactly']),
                         ('false alarms', totals['false_alarms']),
                         (f'starts found within {NEAR_SAMPLES:g} samples', totals['starts_near']),
                         (f'true values within {SURE_DEVIATIONS:g} standard deviations', totals['values_sure']),
                         ('removable error removed, median', totals['removed_median'])):
        if share is not None:
            console.print(f'{label}: {100 * share:.1f} %')
