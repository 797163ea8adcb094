"""The whole diagnosis of one recording: is anything missing, what, where, since when, how large, and what it brings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.data.identifiability import unidentifiable
from semiparam_ros.diagnosis.data.outliers import excluded
from semiparam_ros.diagnosis.data.preparation import Inputs, best_inputs, require_enough, resting
from semiparam_ros.diagnosis.data.splits import interleaved_split, ranges
from semiparam_ros.diagnosis.evaluation import Evaluation, evaluate_here, evaluate_there
from semiparam_ros.diagnosis.findings import Finding, findings
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.residual.noise import noise_floor
from semiparam_ros.diagnosis.residual.structure import Structure, remaining_structure
from semiparam_ros.diagnosis.search.stepwise import Progress, Step, search, starting_fit
from semiparam_ros.diagnosis.setup.checks import NO_MATCH, SetupProblem, setup_problems
from semiparam_ros.effects import Effect, kinds
from semiparam_ros.errors import SemiparamError

LEAST_SAMPLES = 200
LEAST_MOTION = 1e-3
PATCH_ROUNDS, PATCH_SHARE = 2, 1.0 / 3.0
"""So many rounds that leave so much structure resemble a cause of another kind, and do not explain it."""
PUSHED = 0.1
"""Share of variance that a first effect may leave where no inertias explain the outputs, to be believed instead."""
VERDICTS = ('effect_found', 'nothing_missing', 'unexplained')


class Recorded(NamedTuple):
    """The recordings as they came, before smoothing: what may fit (``fitting`` (N,)), and what judges (``valid``)."""

    samples: Samples
    fitting: Mask
    judged: Samples
    valid: Mask


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and everything needed to show it. ``before`` and ``after`` judge on ``held_out`` samples."""

    verdict: str
    findings: list[Finding]
    steps: list[Step]
    first: Fit
    final: Fit
    held_out: Mask
    before: Evaluation
    after: Evaluation
    inputs: Inputs
    structure: Structure | None
    setup: list[SetupProblem]
    notes: list[str]
    recorded: Recorded
    judged_by_step: list[Evaluation] = field(default_factory=list)
    judged_elsewhere: str | None = None
    judged: Samples | None = None
    judged_valid: Mask | None = None

    @property
    def noise_floor_rmse(self) -> Array:
        """(n,) standard deviation of what no model can predict, from the final residual of the held-out samples."""
        parts = [self.after.residual[start:end] for start, end in self.after.parts if end - start > 3]
        floors = np.array([noise_floor(part) for part in parts])
        weights = np.array([len(part) for part in parts], dtype=float)
        return np.asarray(np.sqrt((floors**2 * (weights / weights.sum())[:, None]).sum(axis=0)))

    def as_dict(self) -> dict[str, Any]:
        """The machine-readable report."""
        found = {'verdict': self.verdict, 'effects': [finding.as_dict() for finding in self.findings],
                 'before': self.before.as_dict(), 'after': self.after.as_dict(),
                 'by_step': [evaluation.as_dict() for evaluation in self.judged_by_step],
                 'noise_floor_rmse': self.noise_floor_rmse.tolist(), 'held_out': self._held_out(),
                 'outputs': list(self.first.body.output_names), 'motion': self.inputs.motion,
                 'samples_averaged': self.inputs.factor,
                 'setup': [problem._asdict() for problem in self.setup], 'notes': self.notes}
        return found | {'unexplained': self.structure.as_dict() if self.structure else None}

    def _held_out(self) -> dict[str, Any]:
        """Sample numbers of the recording that judged, half-open."""
        mask = self.held_out if self.judged_valid is None else self.judged_valid
        parts = [[self.inputs.factor * edge for edge in part] for part in ranges(mask)]
        return {'recording': self.judged_elsewhere, 'ranges': parts}


def diagnose(body: RigidBody, samples: Samples, effects: Sequence[Effect] = (), train_mask: Mask | None = None,
             other: tuple[str, Samples] | None = None, only: Sequence[str] = (),
             progress: Progress = lambda words, share: None) -> Diagnosis:
    """Find what the model lacks in one recording.

    :param effects: those declared already.
    :param train_mask: (N,) true for the samples that may fit; others are held out. Interleaved blocks unless given.
    :param other: name and samples of another recording that judges instead; then all samples of this one fit.
    :param only: kinds to consider; all unless given.
    :param progress: called with a few words and the share of the round that is done.

    Raises SemiparamError when the recording is too short, too little of it can be used, or nothing moves in it.
    """
    check(samples, body)
    effects = [effect.in_recording(samples.origin) for effect in effects]
    suspected = setup_problems(body, samples)
    clean = ~excluded(samples)
    may_fit = _fitting(samples, train_mask, other is not None)
    inputs = best_inputs(body, samples, effects, clean & may_fit)
    chosen, valid = inputs.prepare(samples), inputs.mask(clean)
    fitting = valid & inputs.mask(may_fit)
    if body.outputs == 'effort':
        fitting &= ~resting(chosen)
    held_out = valid & ~inputs.mask(may_fit)
    require_enough(fitting, *([held_out] if other is None else []))
    first = starting_fit(body, chosen, effects, fitting)
    steps, setup = _searched(first, considered(body, only), suspected, progress)
    final = steps[-1].after if steps else first
    progress('what is left', 0.0)
    structure = None if setup else remaining_structure(body, chosen, final.residual, fitting, final.scale)
    recorded = Recorded(samples, clean & may_fit, *((samples, clean & ~may_fit) if other is None
                                                    else (other[1], ~excluded(other[1]))))
    judged = None if other is None else inputs.prepare(other[1])
    judged_valid = None if other is None else inputs.mask(recorded.valid)

    def judge(fit: Fit) -> Evaluation:
        if judged is None or judged_valid is None:
            return evaluate_here(fit, held_out)
        return evaluate_there(fit, judged, judged_valid)

    by_step = [judge(step.after) for step in steps]
    before = judge(first)
    after = by_step[-1] if by_step else before
    notes = unidentifiable(body, samples) + _left_out(clean)
    return Diagnosis(verdict(first, final, steps, structure, setup), findings(final, steps), steps, first, final,
                     held_out, before, after, inputs, structure, setup, notes, recorded, by_step,
                     other[0] if other else None, judged, judged_valid)


def _searched(first: Fit, considered: dict[str, type[Effect]], suspected: list[SetupProblem],
              progress: Progress) -> tuple[list[Step], list[SetupProblem]]:
    """The steps of the search, and what stays suspected of the setup.

    A recording that no inertias explain need not be of another robot: somebody may have pushed this one. That shows
    in the first effect, which then explains nearly everything.
    """
    if any(problem.what != NO_MATCH for problem in suspected):
        return [], suspected
    steps = search(first, considered, progress, _unlike if suspected else lambda fit: False)
    return ([], suspected) if suspected and (not steps or _unlike(steps[-1].after)) else (steps, [])


def _unlike(fit: Fit) -> bool:
    outputs = fit.samples.outputs[fit.train_mask]
    return bool(np.mean(fit.squares / (len(outputs) * outputs.var(axis=0) + 1e-300)) > PUSHED)


def check(samples: Samples, body: RigidBody) -> None:
    """Refuse a recording from which nothing can be told."""
    if len(samples) < LEAST_SAMPLES:
        raise SemiparamError(f'the recording holds {len(samples)} complete samples; a diagnosis needs at least '
                             f'{LEAST_SAMPLES}.')
    if np.all(np.ptp(samples.position, axis=0) < LEAST_MOTION):
        raise SemiparamError(f'no joint moves by more than {LEAST_MOTION} rad in the recording; a diagnosis needs '
                             f'motion of {", ".join(body.joints)}.')


def considered(body: RigidBody, only: Sequence[str] = ()) -> dict[str, type[Effect]]:
    """The kinds for these outputs, or those of them that are named."""
    known = kinds(body.outputs)
    unknown = [name for name in only if name not in known]
    if unknown:
        raise SemiparamError(f"effect kind '{unknown[0]}' does not act on {body.outputs}; expected some of "
                             f'{", ".join(known)}.')
    return {name: kind for name, kind in known.items() if not only or name in only}


def _fitting(samples: Samples, train_mask: Mask | None, judged_elsewhere: bool) -> Mask:
    if train_mask is not None:
        return train_mask
    return np.ones(len(samples), dtype=bool) if judged_elsewhere else interleaved_split(len(samples))


def verdict(first: Fit, final: Fit, steps: list[Step], structure: Structure | None, setup: list[SetupProblem]) -> str:
    """One of VERDICTS: an effect counts as found only when it explains more than what stays unexplained."""
    if setup or patched(steps, structure):
        return 'unexplained'
    left = 0.0
    if structure is not None and structure.significant:
        left = structure.share * float((final.squares / final.scale**2).sum())
    removed = float(((first.squares - final.squares) / final.scale**2).sum())
    if left > removed:
        return 'unexplained'
    return 'effect_found' if steps else 'nothing_missing'


def patched(steps: list[Step], structure: Structure | None) -> bool:
    """Whether effect was added after effect, and still much of what is left is more than noise."""
    return len(steps) >= PATCH_ROUNDS and structure is not None and structure.significant \
        and structure.share > PATCH_SHARE


def _left_out(valid: Mask) -> list[str]:
    count = int((~valid).sum())
    return [f'{count} of {len(valid)} samples next to gaps and shocks are left out.'] if count else []
