"""Diagnoses of samples: what the process beside the node does to name what the model lacks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.applied_effects import Contribution, as_measured
from semiparam_ros.online.history import SampleBatch
from semiparam_ros.online.worker import report_progress

if TYPE_CHECKING:
    from semiparam_ros.diagnosis.diagnose import Diagnosis
    from semiparam_ros.diagnosis.named_change import NamedChange
    from semiparam_ros.effects import Effect

SAMPLES_AT_MOST, SAMPLES_AT_LEAST = 5000, 1000
"""That a diagnosis looks at, where it gets a whole processor, and however little of one."""
PROBED_S = 0.5
"""So long the share of a processor is measured."""
FIXED_S, EACH_S = 3.5, 4.2e-3
"""[s] Processor time of a diagnosis, and of each of its samples: 24 s for 4688 of a six-joint arm
that lacks 14 effects, 6 s for 600 (measured)."""
LINGERS = 0.2
"""What takes longer than expected takes this share of the time so far yet."""


class Progress(NamedTuple):
    """Progress of a diagnosis: what is being tried, and how long it is expected to take yet [s]."""

    words: str
    left_s: float


def expected_s(samples: int) -> float:
    """Processor time [s] of a diagnosis of so many samples."""
    return FIXED_S + EACH_S * samples


def left_s(samples: int, passed: float, used: float) -> float:
    """Time [s] that a diagnosis is expected to take yet that ``passed`` seconds ago began, and has
    ``used`` so much of a processor."""
    return max(expected_s(samples) - used, LINGERS * used) * passed / max(used, 1e-3)


def processor_share() -> float:
    """The share of a processor that this process gets at present, above 0 and at most 1."""
    begun, used, passed = time.perf_counter(), time.process_time(), 0.0
    while passed < PROBED_S:
        passed = time.perf_counter() - begun
    return min(max((time.process_time() - used) / passed, 0.01), 1.0)


class DiagnosisOutcome(NamedTuple):
    """A diagnosis in words and as the machine-readable report; ``effects`` are all that the model
    then declares.

    ``summary`` has what was found, line by line, ``words`` all that is to be said of it.
    """

    summary: list[str]
    words: list[str]
    report: dict[str, object]
    effects: tuple[Effect, ...]


def diagnose(body: RigidBody, batch: SampleBatch, effects: Sequence[Effect],
             taken_off: Sequence[Contribution] = (),
             contacts: Sequence[tuple[int, int]] = ()) -> DiagnosisOutcome:
    """Diagnose samples with the effects declared so far; raises SemiparamError as the command does.

    :param taken_off: what was taken off the samples before they were kept. :param contacts: stamps
        [ns] between which the robot was touched.
    """
    from semiparam_ros.diagnosis.diagnose import diagnose
    from semiparam_ros.diagnosis.text_report import summary, text_report

    begun, used = time.perf_counter(), time.process_time()
    assert batch.samples is not None
    samples = as_measured(body, batch.samples, taken_off)

    def progress(words: str, share: float) -> None:
        report_progress(Progress(f'{words} ({share:.0%})', left_s(len(batch), time.perf_counter() - begun,
                                                       time.process_time() - used)))

    found = diagnose(body, samples, effects, progress=progress,
                     touched=_seconds(contacts, samples.origin))
    return DiagnosisOutcome(summary(found), text_report(found), found.as_dict(), declared(found))


def setup_problems(body: RigidBody, batch: SampleBatch, effects: Sequence[Effect], taken_off: Sequence[Contribution],
                   contacts: Sequence[tuple[int, int]]) -> dict[tuple[str, str | None], str]:
    """Tell what seems wrong with the set-up, what and where with a sentence each; arguments as of :func:`diagnose`.

    That no inertias explain the outputs is no such thing before an effect was looked for.
    """
    from semiparam_ros.diagnosis.setup.checks import NO_MATCH, setup_problems

    if batch.samples is None:
        return {}
    samples = as_measured(body, batch.samples, taken_off)
    found = setup_problems(body, samples, touched=_seconds(contacts, samples.origin), effects=effects)
    return {(problem.what, problem.where): problem.sentence for problem in found if problem.what != NO_MATCH}


def name_change(
    body: RigidBody,
    batch: SampleBatch,
    effects: Sequence[Effect],
    since: tuple[int, int],
    ended: int | None,
    inputs: bytes | None,
    taken_off: Sequence[Contribution],
    contacts: Sequence[tuple[int, int]] = (),
) -> NamedChange:
    """Name what began between two stamps [ns], and ended at another; times of the effect as stamps.
    See :func:`~semiparam_ros.diagnosis.change.name_change`.

    :param inputs: those of the name before. :param taken_off: what was taken off the samples before they were kept.
    :param contacts: stamps [ns] between which the robot was touched.
    """
    from semiparam_ros.diagnosis.change import name_change

    samples = batch.samples
    if samples is None:
        raise SemiparamError('there are no samples to name a change from.')
    samples, origin = as_measured(body, samples, taken_off), samples.origin
    touched_s, since_s = ((stamp - origin) * 1e-9 for stamp in since)
    ended_s = None if ended is None else (ended - origin) * 1e-9
    found = name_change(
        body, samples, effects, since_s, ended_s, inputs, touched_s=touched_s,
        contacts=_seconds(contacts, origin)
    )
    return found if found.effect is None else replace(found, effect=found.effect.at_stamps(origin))


def _seconds(spans: Sequence[tuple[int, int]], origin: int) -> list[tuple[float, float]]:
    """[s] since an origin [ns], of stamps."""
    return [((first - origin) * 1e-9, (last - origin) * 1e-9) for first, last in spans]


def gain_since(body: RigidBody, batch: SampleBatch, since: int, before: Sequence[Effect],
               after: Sequence[Effect], taken_off: Sequence[Contribution],
               contacts: Sequence[tuple[int, int]] = ()) -> float | None:
    """By how much [nat] other effects predict what came after a stamp [ns] better than those
    before; None where that is too little to tell. Both are fitted to what came before the stamp, or to the first half
    where that is less, or the clock went back since.

    :param taken_off: what was taken off the samples before they were kept. :param contacts: stamps
        [ns] between which the robot was touched.
    """
    from semiparam_ros.diagnosis.change import gain_since

    samples = batch.samples
    if samples is None:
        return None
    middle, newest = samples.stamps[[len(samples) // 2, -1]].tolist()
    since = max(since, middle) if since <= newest else middle
    try:
        samples = as_measured(body, samples, taken_off)
        return gain_since(body, samples, (since - samples.origin) * 1e-9, before, after,
                          contacts=_seconds(contacts, samples.origin)).total
    except SemiparamError:
        return None


def declared(found: Diagnosis) -> tuple[Effect, ...]:
    """The effects of the final model, times as stamps: a node counts time from its own start, which
    a reset moves."""
    origin = found.recorded.samples.origin
    return tuple(effect.at_stamps(origin) for effect in found.everything.effects)


def thinned(batch: SampleBatch, share: float) -> SampleBatch:
    """Return as many of them, evenly spread, as a diagnosis looks at that gets a share of a processor."""
    count = len(batch)
    step = min(-(-count // int(share * SAMPLES_AT_MOST)), count // SAMPLES_AT_LEAST)
    return batch.part(0, step=max(step, 1))
