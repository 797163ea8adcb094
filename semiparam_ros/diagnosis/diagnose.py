"""The whole diagnosis of one recording or several: is anything missing, what, where, since when, and how large."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Indices, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import excluded, gaps, margin, untouched, working_factor
from semiparam_ros.diagnosis.data.recordings import (
    alone,
    beside_breaks,
    breaks_s,
    in_whole_groups,
    own_offsets,
    own_time,
    present,
    whole_groups,
)
from semiparam_ros.diagnosis.data.splits import interleaved_split, ranges
from semiparam_ros.diagnosis.evaluation import Evaluation, evaluate_described, evaluate_here, evaluate_there
from semiparam_ros.diagnosis.findings import Finding, declared_findings, findings, places_in
from semiparam_ros.diagnosis.friction_change import friction_changes
from semiparam_ros.diagnosis.preparation import (
    Inputs,
    bursts,
    fast_enough,
    late,
    prepared,
    require_enough,
    too_fast,
)
from semiparam_ros.diagnosis.regression import Fit, refit_weights, with_effects
from semiparam_ros.diagnosis.residual.aliases import as_recorded
from semiparam_ros.diagnosis.residual.contacts import Contact, bend, contacts
from semiparam_ros.diagnosis.residual.noise import noise_floor, with_error_columns, without_error_columns
from semiparam_ros.diagnosis.residual.structure import Structure, remaining_structure
from semiparam_ros.diagnosis.search.plausibility import all_plausible
from semiparam_ros.diagnosis.search.refit import calibrated, fitted_to_all
from semiparam_ros.diagnosis.search.revision import with_common_forms
from semiparam_ros.diagnosis.search.scoring import Progress
from semiparam_ros.diagnosis.search.stepwise import Step, search, starting_fit
from semiparam_ros.diagnosis.setup.checks import CONSTANT, NO_MATCH, SetupProblem, setup_problems
from semiparam_ros.diagnosis.setup.identifiability import unidentifiable
from semiparam_ros.diagnosis.uncertainty import Estimates, estimates
from semiparam_ros.diagnosis.unlisted import function_explains_more, holding
from semiparam_ros.effects import Effect, effect_to_text, kinds
from semiparam_ros.effects.base import place
from semiparam_ros.effects.geometry import VelocityFilter
from semiparam_ros.errors import SemiparamError

VERDICTS = ('effect_found', 'nothing_missing', 'unexplained')


class Recorded(NamedTuple):
    """The recordings as they came, before smoothing: what may fit (``fitting`` (N,)), and what judges (``valid``).

    ``numbers`` (N,): those of the samples among all that came, where a remainder of each of several recordings is left
    out; None where nothing is.
    """

    samples: Samples
    fitting: Mask
    judged: Samples
    valid: Mask
    numbers: Indices | None = None


class Elsewhere(NamedTuple):
    """Another recording that judges: its name, its working samples, how they were prepared, and which (N,) count."""

    name: str
    samples: Samples
    inputs: Inputs
    valid: Mask


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Findings, and everything needed to show them.

    ``before``, ``after`` and ``by_step`` (the model after each step) judge on the samples ``judged`` (N,) of those
    ``held_out`` (N,) of the recording, or on the recording ``elsewhere``. ``everything`` is the final model fitted to
    all samples after that: what is told of the effects and declared comes from it, and the ``estimates`` are its values
    with their deviations; where that gives an effect values that it cannot have, it is the final model itself.
    ``imitated``: a function that knows nothing of robots explains more than all effects that were found; those that
    hold beside it stay.
    """

    config: DiagnosisConfig
    verdict: str
    findings: list[Finding]
    steps: list[Step]
    first: Fit
    final: Fit
    everything: Fit
    estimates: Estimates
    held_out: Mask
    judged: Mask
    before: Evaluation
    by_step: list[Evaluation]
    inputs: Inputs
    structure: Structure | None
    setup: list[SetupProblem]
    notes: list[str]
    recorded: Recorded
    elsewhere: Elsewhere | None
    names: tuple[str, ...] = ('1',)
    contacts: list[Contact] = field(default_factory=list)
    imitated: bool = False

    @property
    def after(self) -> Evaluation:
        """Error of the final model."""
        return self.by_step[-1] if self.by_step else self.before

    @cached_property
    def described_errors(self) -> tuple[Evaluation, Evaluation]:
        """Errors of the final model on the blocks left out, or on the recording that judges, with the inertias of the
        robot description and with its own."""
        if self.elsewhere is None:
            return evaluate_described(self.final, self.held_out), evaluate_here(self.final, self.held_out)
        described = replace(self.final, theta=self.final.theta_beside(self.final.body.base_parameters))
        there, valid = self.elsewhere[1], self.elsewhere[3]
        return evaluate_there(described, there, valid), evaluate_there(self.final, there, valid)

    @property
    def offsets(self) -> list[Effect]:
        """Effects that nobody declares, of several recordings: the offset of the wrench in each after the first."""
        return own_offsets(self.first.body, self.recorded.samples)

    def lasts(self, effect: Effect) -> bool:
        """Return whether an effect of the final model is still there: neither over, nor the offset of one recording."""
        return not effect.ends and effect not in self.offsets

    @property
    def standing(self) -> list[Effect]:
        """The effects of the final model as who loads them should declare them.

        What began late is there for him, so it has no start; what is over is left out. Two loads picked up one after
        the other are one now.
        """
        lasting = [effect.without_span() for effect in self.everything.effects if self.lasts(effect)]
        return list({effect_to_text(effect): effect for effect in lasting}.values())

    @property
    def declared(self) -> list[Finding]:
        """The effects that were declared beforehand, with their fitted values."""
        return [finding for finding in declared_findings(self.everything, self.findings, self.estimates)
                if finding.effect not in self.offsets]

    @property
    def gain_and_mass_are_one(self) -> bool:
        """Return whether gains of the outputs are found or declared, but no mass that would tell them from masses."""
        gains = any(name.startswith('gain') for effect in self.final.effects for name, _ in effect.calibrations)
        return gains and not self.final.knows_mass

    def recordings_of(self, effect: Effect) -> tuple[str, ...]:
        """Names of the recordings in which an effect acts; empty where there is one recording."""
        samples = self.recorded.samples
        return present(samples, self.names, effect) if samples.breaks else ()

    @property
    def noise_floor_rmse(self) -> Array:
        """(n,) standard deviation of what no model can predict, from the final residual of the held-out samples."""
        parts, count = [slice(start, end) for start, end in self.after.parts if end - start > 3], len(self.after.rmse)
        floors = np.reshape([noise_floor(self.after.residual[part], self.after.counted[part]) for part in parts],
                            (-1, count))  # none where single samples judge
        weights = np.reshape([self.after.counted[part].sum(axis=0) for part in parts], (-1, count)) * (floors > 0.0)
        return np.asarray(np.sqrt((floors**2 * weights).sum(axis=0) / np.maximum(weights.sum(axis=0), 1)))

    @property
    def unexplained_outputs(self) -> dict[str, tuple[float, float]]:
        """Outputs of which the final model leaves most, and more than noise: share of the variance left, and of noise.

        Of held-out samples; an effect that was found elsewhere says nothing of these.
        """
        left = self.after.nmse
        noise = self.noise_floor_rmse**2 * left / np.maximum(self.after.rmse**2, 1e-300)
        most = (left > self.config.most) & (noise < self.config.most * left)
        names = self.first.body.output_names
        return {names[k]: (float(left[k]), float(noise[k])) for k in np.flatnonzero(most)}

    @property
    def shifted_outputs(self) -> list[str]:
        """Outputs of a wrench of which most of what is left on another recording is constant: another offset there."""
        if self.elsewhere is None or self.first.body.outputs == 'effort':
            return []
        constant = self.after.residual.mean(axis=0) ** 2 > self.config.most * self.after.rmse**2
        return [self.first.body.output_names[k] for k in np.flatnonzero(constant)]

    @property
    def on_all_samples(self) -> Evaluation:
        """Residual that the model that is told and declared leaves of the samples that fitted it."""
        return evaluate_here(self.everything, self.everything.train_mask)

    def as_dict(self) -> dict[str, object]:
        """The machine-readable report."""
        return {'verdict': self.verdict, 'effects': [
                    finding.as_dict() | {'recordings': list(self.recordings_of(finding.effect))}
                    for finding in self.findings],
                'declared': [finding.as_dict() for finding in self.declared],
                'recordings': list(self.names),
                'before': self.before.as_dict(), 'after': self.after.as_dict(),
                'by_step': [evaluation.as_dict() for evaluation in self.by_step],
                'all_samples': self.on_all_samples.as_dict(),
                'noise_floor_rmse': self.noise_floor_rmse.tolist(), 'held_out': self._held_out(),
                'outputs': list(self.first.body.output_names), 'motion': self.inputs.motion,
                'samples_averaged': self.inputs.factor,
                'setup': [problem._asdict() for problem in self.setup], 'notes': self.notes,
                'contacts': [contact._asdict() for contact in self.contacts],
                'unexplained': self.structure.as_dict() if self.structure else None}

    def _held_out(self) -> dict[str, object]:
        """Sample numbers of the recording that judged, half-open."""
        inputs, mask = (self.inputs, self.judged) if self.elsewhere is None else self.elsewhere[2:]
        parts = [[inputs.factor * edge for edge in part] for part in ranges(mask)]
        if self.elsewhere is None and (numbers := self.recorded.numbers) is not None:
            parts = [[int(numbers[start]), int(numbers[end - 1]) + 1] for start, end in parts]
        return {'recording': self.elsewhere.name if self.elsewhere else None, 'ranges': parts}


@contextmanager
def _solved() -> Iterator[None]:
    """Raise SemiparamError where doubles do not hold the solution of an equation."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise SemiparamError(f'nothing can be fitted to the samples ({error}): motion, outputs or the robot '
                             'description may be in other units.') from error


def diagnose(body: RigidBody, samples: Samples, effects: Sequence[Effect] = (), train_mask: Mask | None = None,
             other: tuple[str, Samples] | None = None, only: Sequence[str] = (),
             progress: Progress = lambda words, share: None, config: DiagnosisConfig = DEFAULTS,
             names: Sequence[str] = (), touched: Sequence[tuple[float, float]] = ()) -> Diagnosis:
    """Find what the model lacks in one recording, or in several that :meth:`Samples.joined` made one.

    :param effects: those declared already.
    :param train_mask: (N,) true for the samples that may fit; others are held out. Interleaved blocks unless given.
    :param other: name and samples of another recording that judges instead; then all samples of this one fit.
    :param only: kinds to consider; all unless given.
    :param names: those of the recordings; numbers from 1 unless given.
    :param progress: called with a few words and the share of the round that is done.
    :param config: thresholds other than the usual ones.
    :param touched: [s] between which the robot is known to have been touched, which is left out;
        of a single recording. Where touches hold much of what is left of an output in little time, they are left out
        too, and the rest is searched anew: they bend what is found, and hide small causes.

    Raises SemiparamError when the recording is too short, too little of it can be used, nothing moves in it, or an
    output never changes; where its clock is wrong, that may be why, and the error says so.
    """
    of = partial(_diagnosed, body, samples, effects, train_mask, other, only, progress, config, names)
    found = of(touched)
    beside = found.everything.samples.averaged_s  # of the means there, a part may be touched
    felt = [(each.start_s - beside, each.end_s + beside) for each in found.contacts]
    if not bend(felt, found.everything):
        return found
    try:
        return of([*touched, *felt])
    except SemiparamError as error:
        return replace(found, notes=[*found.notes, f'The touches stay in the fit: without them {error}'])


@_solved()
def _diagnosed(body: RigidBody, samples: Samples, effects: Sequence[Effect], train_mask: Mask | None,
               other: tuple[str, Samples] | None, only: Sequence[str], progress: Progress, config: DiagnosisConfig,
               names: Sequence[str], touched: Sequence[tuple[float, float]]) -> Diagnosis:
    """See :func:`diagnose`, of which this is one search."""
    check(samples, body, config)
    again = partial(_diagnosed, body, samples, effects, train_mask, other, only, progress, names=names,
                    touched=touched)
    names = tuple(names) or tuple(str(number) for number in range(1, len(samples.recordings) + 1))
    effects = [effect.in_recording(samples.origin) for effect in effects] + own_offsets(body, samples)
    suspected, chosen = _suspected(body, samples, effects, config, touched), considered(body, only)
    try:
        start = _first_model(body, samples, effects, train_mask, other, config, touched, chosen)
    except SemiparamError as error:
        clock = [problem.sentence for problem in suspected if problem.what == 'clock']  # leaves no time to look at
        raise SemiparamError(clock[0] if clock else str(error)) from error
    samples, config = start.recorded.samples, start.first.config
    steps, setup, imitated = _searched(start, samples, suspected, progress, bool(only))
    *models, final = [start.first, *(step.after for step in steps)]
    faster = fast_enough(final, samples, start.inputs)
    if faster != config:  # what was found had hidden it
        return again(config=faster)
    judged = _decided(final, steps, start)
    before, *by_step = (_evaluated(fit, start, judged) for fit in (*models, final))
    progress('what is left', 0.0)
    structure, fast = (None, []) if setup else _left(final, samples, start)
    everything, told = _estimated(final, steps, samples, start)
    found = findings(final, steps, everything, told)
    touches, notes = [] if setup else contacts(everything), _notes(samples, start, found, names)
    notes += [] if setup else friction_changes(final, names)
    for fit in (start.first, final, everything):
        fit.forget()
    return Diagnosis(
        config=config, verdict=verdict(start.first, final, structure, imitated or bool(setup)), imitated=imitated,
        findings=found, steps=steps, first=start.first, final=final, everything=everything, estimates=told,
        held_out=start.held_out, judged=judged, before=before, by_step=by_step, inputs=start.inputs,
        structure=structure, setup=setup, notes=[*fast, *notes], recorded=start.recorded, elsewhere=start.elsewhere,
        names=names, contacts=touches)


def _suspected(body: RigidBody, samples: Samples, effects: Sequence[Effect], config: DiagnosisConfig,
               touched: Sequence[tuple[float, float]]) -> list[SetupProblem]:
    """Return what seems wrong with the set-up of each recording; outputs that never change raise SemiparamError."""
    stamped = [effect.at_stamps(samples.origin) for effect in effects]
    parts = [(alone(samples, part), ()) for part in samples.recordings] if samples.breaks else [(samples, touched)]
    found = [problem for part, contact in parts for problem in setup_problems(body, part, config, contact, stamped)]
    for problem in found:
        if problem.what == CONSTANT:
            raise SemiparamError(problem.sentence)
    return found


class _Start(NamedTuple):
    """The declared model and how it was fitted: the inputs, which recorded samples (N,) are clean,
    which working samples (M,) fit and judge, and the recordings that do."""

    first: Fit
    inputs: Inputs
    clean: Mask
    fitting: Mask
    held_out: Mask
    recorded: Recorded
    elsewhere: Elsewhere | None


@_solved()
def _first_model(body: RigidBody, samples: Samples, effects: Sequence[Effect],
                 train_mask: Mask | None, other: tuple[str, Samples] | None,
                 config: DiagnosisConfig, touched: Sequence[tuple[float, float]],
                 considered: dict[str, type[Effect]]) -> _Start:
    given, kept = samples, in_whole_groups(samples, working_factor(samples, config))
    samples = whole_groups(samples, working_factor(samples, config))
    require_enough(config, np.ones(len(samples) // working_factor(samples, config), dtype=bool), of=given)
    if train_mask is not None:
        may_fit = np.asarray(train_mask)[kept]
    else:
        may_fit = np.ones(len(samples), dtype=bool) if other else interleaved_split(len(samples), config)
    clean = untouched(samples, touched, config) & ~beside_breaks(samples, margin(samples, config))
    inputs, chosen, valid, counted = prepared(body, samples, effects, may_fit, config, clean=clean)
    fitting, held_out = valid & inputs.mask(may_fit), valid & ~inputs.mask(may_fit)
    require_enough(config, fitting, held_out if other is None else fitting, of=given)
    first = starting_fit(body, chosen, effects, fitting, config, counted, considered)
    unvalued = [effect for effect in first.effects if effect.is_calibration and not effect.parameters]
    faster = fast_enough(first, samples, inputs)
    if faster != config:
        return _first_model(body, given, effects, train_mask, other, faster, touched, considered)
    recorded, elsewhere = Recorded(samples, clean & may_fit, samples, clean & ~may_fit, kept), None
    if other is not None:
        recorded = Recorded(samples, clean & may_fit, other[1], ~excluded(other[1], config))
        there = inputs._replace(factor=working_factor(other[1], config))
        elsewhere = Elsewhere(other[0], there.prepare(other[1]), there, there.mask(recorded.valid))
    return _Start(calibrated(first, unvalued), inputs, clean, fitting, held_out, recorded,
                  elsewhere)


def _decided(final: Fit, steps: list[Step], start: _Start) -> Mask:
    """(M,) the held-out samples of which the final model can say what acts on them: not those between samples that
    fitted where an effect began or ended, for nothing told when, unless with a recording. Neighbours that count as one
    tell no better: what began with the second sample after a gap may have begun in the gap. All of them where none is
    left."""
    decided, fitting, breaks = start.held_out.copy(), np.flatnonzero(start.fitting), breaks_s(final.samples)
    alike = int(np.ceil(final.correlation.min()))
    for effect in (final.effects[index] for index, _ in places_in(final, steps)):
        for time_s in set(effect.span.values.values()).difference(breaks):
            after = int(np.searchsorted(final.samples.time[fitting], time_s))
            if 0 < after < len(fitting):
                before, behind = max(after - 1 - alike, 0), min(after + alike, len(fitting) - 1)
                decided[fitting[before]:fitting[behind]] = False
    return decided if decided.any() else start.held_out


def _evaluated(fit: Fit, start: _Start, judged: Mask) -> Evaluation:
    if start.elsewhere is None:
        return evaluate_here(fit, judged)
    return evaluate_there(fit, start.elsewhere.samples, start.elsewhere.valid)


def _left(final: Fit, samples: Samples, start: _Start) -> tuple[Structure, list[str]]:
    """The structure of what the final model leaves, and what is said of a motion that is too fast for its rate."""
    structure, (fast, by_inputs) = remaining_structure(final), too_fast(samples, start.inputs, final)
    beyond = structure.channel_shares > by_inputs
    if fast and not any(beyond[final.body.output_names.index(name)] for name in structure.channels):
        structure = replace(structure, significant=False)  # errors of the inputs explain as much of each
    return structure, fast


def _estimated(final: Fit, steps: list[Step], samples: Samples, start: _Start) -> tuple[Fit, Estimates]:
    """The final model fitted to all samples, where that gives no effect values that it cannot have, and its values."""
    new = [index for index, _ in places_in(final, steps)]
    everything = final = as_recorded(final, start.recorded.samples, new)
    if steps or final.effects:
        usable = start.fitting | start.held_out
        refit = with_common_forms(fitted_to_all(final, usable, new, start.first.counted)) if steps else \
            refit_weights(with_effects(replace(final, train_mask=usable), final.effects))  # calibrations as declared
        everything = refit if all_plausible(final, refit) else final
    return everything, estimates(everything, new, start.inputs.disturbed(samples) if everything.effects else ())


def _searched(start: _Start, samples: Samples, suspected: list[SetupProblem], progress: Progress,
              some_kinds: bool) -> tuple[list[Step], list[SetupProblem], bool]:
    """The steps of the search, what stays suspected of the setup, and whether effects only imitate something else, and
    were taken back but those that hold beside it; of ``some_kinds`` alone nobody asks that.

    A recording that no inertias explain need not be of another robot: somebody may have pushed this one. That shows
    in the first effect, which then explains nearly everything. A search ends, too, once what was found shows that the
    working rate of the ``samples`` is too low.
    """
    def too_slow(fit: Fit) -> bool:
        return fast_enough(without_error_columns(fit), samples, start.inputs) != fit.config

    if any(problem.what != NO_MATCH for problem in suspected):
        return [], suspected, False
    first = start.first if start.inputs.measured_accelerations else with_error_columns(start.first)
    steps = search(first, progress, lambda fit: (bool(suspected) and _unlike(fit)) or too_slow(fit))
    if suspected and (not steps or _unlike(steps[-1].after)):
        return [], suspected, False
    steps = _on_the_motion(steps)
    if steps and too_slow(steps[-1].after):
        return steps, [], False
    imitated = bool(steps) and not some_kinds and function_explains_more(start.first, steps[-1].after)
    return (holding(steps) if imitated else steps), [], imitated


def _on_the_motion(steps: list[Step]) -> list[Step]:
    """The steps with the models of each fitted to the motion as it is."""
    fits: dict[Fit, Fit] = {}
    for fit in (model for step in steps for model in (step.before, step.after)):
        if fit not in fits:
            fits[fit] = without_error_columns(fit)
            for one in (fit, fits[fit]):
                one.forget()
    return [replace(step, before=fits[step.before], after=fits[step.after]) for step in steps]


def _unlike(fit: Fit) -> bool:
    """Return whether the model leaves too much to be believed where no inertias explain the outputs."""
    outputs = fit.samples.outputs[fit.train_mask]
    left = np.mean(fit.squares / (fit.counts * outputs.var(axis=0) + 1e-300))
    return bool(left > fit.config.little)


def check(samples: Samples, body: RigidBody, config: DiagnosisConfig) -> None:
    """Refuse a recording from which nothing can be told."""
    if len(samples) < config.least_samples:
        raise SemiparamError(f'the recording holds {len(samples)} complete samples; a diagnosis needs at least '
                             f'{config.least_samples}.')
    if np.median(np.diff(samples.stamps)) <= 0:
        raise SemiparamError('most samples have no later stamp than the one before; expected stamps that increase.')
    if np.all(np.ptp(samples.position, axis=0) < config.still_range):
        raise SemiparamError(f'no joint moves by more than {config.still_range} rad or m in the recording; a diagnosis '
                             f'needs motion of {", ".join(body.joints)}.')


def considered(body: RigidBody, only: Sequence[str] = ()) -> dict[str, type[Effect]]:
    """The kinds for these outputs, or those of them that are named."""
    known = kinds(body.outputs)
    unknown = [name for name in only if name not in known]
    if unknown:
        raise SemiparamError(f"effect kind '{unknown[0]}' does not act on {body.outputs}; expected some of "
                             f'{", ".join(known)}.')
    return {name: kind for name, kind in known.items() if not only or name in only}


def verdict(first: Fit, final: Fit, structure: Structure | None, unexplained: bool) -> str:
    """One of VERDICTS: an effect counts as found only when it explains more than what stays unexplained."""
    left = 0.0
    if structure is not None and structure.significant:
        left = structure.share * float((final.squares / final.scale**2).sum())
    removed = float(((first.squares - final.squares) / final.scale**2).sum())
    if unexplained or left > removed:
        return 'unexplained'
    return 'nothing_missing' if final is first else 'effect_found'


def _notes(samples: Samples, start: _Start, found: list[Finding], names: Sequence[str]) -> list[str]:
    """Doubts that are said beside the result."""
    config = start.first.config
    filter_declared = any(effect.kind == VelocityFilter.kind for effect in start.first.effects)
    stamps = bursts(samples, config) or late(start.inputs, samples, filter_declared)
    count, left_out = int((~start.clean).sum()), list[str]()
    if count:
        left_out = [f'{count} of {len(samples)} samples are left out: next to gaps, shocks and breaks, or while the '
                    'robot was touched.']
    return [*stamps, *unidentifiable(start.first.body, samples, config, names), *left_out,
            *_changed_in_gaps(found, samples, names, config)]


def _changed_in_gaps(found: list[Finding], samples: Samples, names: Sequence[str],
                     config: DiagnosisConfig) -> list[str]:
    """A sentence for each effect that may have begun, or ended, anywhere in a gap, as between two stretches of a long
    recording."""
    time, beside, sentences = samples.time, margin(samples, config), list[str]()
    for effect in (finding.effect for finding in found):
        for gap in gaps(samples, config) if effect.span.values else []:
            earliest, latest = time[max(gap.before - beside, 0)], time[min(gap.before + 1 + beside, len(time) - 1)]
            for word, time_s in (('began', effect.start_s), ('ended', effect.end_s)):
                if time_s is not None and earliest <= time_s <= latest:
                    start_s, of = own_time(samples, names, gap.start_s)
                    sentences.append(f'{place(effect.kind, effect.where)} {word} between {start_s:.1f} and '
                                     f'{start_s + gap.length_s:.1f} s{of}, where nothing was looked at.')
    return sentences
