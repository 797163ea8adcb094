"""One self-contained HTML page of a diagnosis, made for looking first: no network, no script, light and dark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from semiparam_ros import __version__
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.recordings import without_pauses
from semiparam_ros.diagnosis.diagnose import Diagnosis, Elsewhere
from semiparam_ros.diagnosis.evaluation import Evaluation
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.residual.formula import Formula
from semiparam_ros.diagnosis.residual.structure import Structure
from semiparam_ros.diagnosis.text_report import next_step, rounded, table_rows, text_report, when
from semiparam_ros.effects import Effect, effect_to_text
from semiparam_ros.effects.base import place
from semiparam_ros.report import diagnosis_figures as figures
from semiparam_ros.report.diagnosis_figures import Suspicion, against_suspected, against_unexplained, suspicions
from semiparam_ros.report.html import Picture, environment, picture

if TYPE_CHECKING:
    from semiparam_ros.experiments.variants_with_effects import VariantErrors

MOST_ODDS = 1000

SHOWN_OPEN = 3
"""Pictures of a kind that stand open; further ones fold away."""

LOADS = 'A load is tried at one link of each body, and once it is found named after the link nearest to its centre.'


class OutputRow(NamedTuple):
    """One output: its errors before and after with their 95 % intervals, and the noise floor."""

    name: str
    unit: str
    nmse: tuple[float, float]
    nmse_interval: tuple[float, float]
    rmse: tuple[float, float]
    rmse_interval: tuple[float, float]
    floor: float


def output_rows(diagnosis: Diagnosis) -> list[OutputRow]:
    """One row for each output."""
    body, before, after = diagnosis.first.body, diagnosis.before, diagnosis.after
    bounds, variance = after.square_intervals(), after.variance
    rows = []
    for index, (name, unit) in enumerate(zip(body.output_names, body.output_units, strict=True)):
        low, high = bounds[index]
        rows.append(OutputRow(
            name, unit, (before.nmse[index], after.nmse[index]), (low / variance[index], high / variance[index]),
            (before.rmse[index], after.rmse[index]), (float(np.sqrt(low)), float(np.sqrt(high))),
            diagnosis.noise_floor_rmse[index]))
    return rows


def relative_floor(diagnosis: Diagnosis) -> Array:
    """Noise floor of each output, squared and over its variance, (n,)."""
    return np.asarray(diagnosis.noise_floor_rmse**2 / diagnosis.after.variance)


def rounds(diagnosis: Diagnosis) -> list[tuple[str, Evaluation]]:
    """The declared model, and then every round: what it added, and the errors that were left."""
    named = [', '.join(_named(effect) for effect in step.added) for step in diagnosis.steps]
    return list(zip(['as declared', *named], [diagnosis.before, *diagnosis.by_step], strict=True))


def _named(effect: Effect) -> str:
    return place(effect.kind, effect.where)


def odds_text(odds: float) -> str:
    """Odds as people say them: ``1 : 20``."""
    ratio = max(odds, 1.0 / odds)
    if ratio > MOST_ODDS:
        return f'over {MOST_ODDS} : 1' if odds > 1.0 else f'under 1 : {MOST_ODDS}'
    number = f'{ratio:.1f}' if ratio < 9.95 else f'{ratio:.0f}'
    return f'{number} : 1' if odds >= 1.0 else f'1 : {number}'


def variant_rows(variants: Mapping[str, VariantErrors]) -> list[tuple[str, float, float, str]]:
    """Variant, mean held-out error without the effects and with them, and in how many draws of features it fell."""
    rows = []
    for name, entry in variants.items():
        pairs = list(zip(entry['draws']['before'], entry['draws']['after'], strict=True))
        lower = f' (lower in {sum(after < before for before, after in pairs)} of {len(pairs)} draws)' \
            if len(pairs) > 1 else ''
        rows.append((name, entry['before']['nmse_mean'], entry['after']['nmse_mean'], lower))
    return rows


def diagnosis_page(diagnosis: Diagnosis, variants: Mapping[str, VariantErrors], title: str,
                   written: str = '') -> str:
    """The page's text.

    :param variants: other models without and with the effects, where they were evaluated.
    :param title: name of the recording.
    """
    def since(effect: Effect) -> str:
        return when(diagnosis, effect, dated=False).removeprefix(', ') or 'from the beginning'

    opening, *words = text_report(diagnosis)
    structure = diagnosis.structure if diagnosis.structure and diagnosis.structure.significant else None
    return environment().get_template('diagnosis.html.j2').render(
        version=__version__, title=title, verdict=diagnosis.verdict, opening=opening, words=words,
        summary=table_rows(diagnosis), next=next_step(diagnosis, written),
        before=diagnosis.before, after=diagnosis.after, floor=relative_floor(diagnosis).mean(),
        rows=output_rows(diagnosis),
        outputs=picture('Error of each output', 'outputs', figures.outputs_of(diagnosis), ''),
        rounds=rounds(diagnosis), over_time=_over_time(diagnosis),
        findings=[_against_variable(diagnosis, suspicion, number)
                  for number, suspicion in enumerate(suspicions(diagnosis))],
        structure=structure, unexplained=_unexplained(diagnosis.final, structure) if structure else None,
        formulas=_formulas(structure, diagnosis.config.declared_share) if structure else [],
        spectra=_spectra(diagnosis), candidates=_candidates(diagnosis), causes=diagnosis.findings,
        named=_named, since=since, rounded=rounded, odds_text=odds_text,
        variants=variant_rows(variants), open=SHOWN_OPEN, facts=_facts(diagnosis),
        effects=[effect_to_text(effect) for effect in diagnosis.standing])


def _labels(diagnosis: Diagnosis) -> list[str]:
    body = diagnosis.first.body
    return [f'{name} [{unit}]' for name, unit in zip(body.output_names, body.output_units, strict=True)]


def _over_time(diagnosis: Diagnosis) -> list[Picture]:
    """Residuals over time of the recording diagnosed, and of the one that judged, if another."""
    first, final, added = diagnosis.first, diagnosis.final, bool(diagnosis.steps)
    changes = [(name + _named(effect), time_s) for effect in diagnosis.everything.effects
               if effect not in diagnosis.offsets
               for name, time_s in (('', effect.start_s), ('end of ', effect.end_s)) if time_s is not None]
    held_out = diagnosis.held_out if diagnosis.elsewhere is None else np.zeros(len(first.samples), dtype=bool)
    caption = 'What the model does not explain of each output'
    caption += ', before and after the effects were added.' if added else '.'
    caption += ' The shaded blocks were not used for the fit.' if held_out.any() else ''
    caption += ' A dashed line marks the start or the end of an effect.' if changes else ''
    caption += ' The recordings follow one another without their pauses.' if first.samples.breaks else ''
    time = without_pauses(first.samples)
    marks = [(name, float(np.interp(time_s, first.samples.time, time))) for name, time_s in changes]
    own = figures.over_time(time, figures.curves(first.residual, final.residual, added), _labels(diagnosis), held_out,
                            marks)
    shown = [picture('Residual over time', 'time', own, caption)]
    if diagnosis.elsewhere is not None:
        shown.append(_over_time_elsewhere(diagnosis, diagnosis.elsewhere))
    return shown


def _over_time_elsewhere(diagnosis: Diagnosis, elsewhere: Elsewhere) -> Picture:
    time = elsewhere.samples.time[elsewhere.valid]
    both = figures.curves(diagnosis.before.residual, diagnosis.after.residual, bool(diagnosis.steps))
    figure = figures.over_time(time, both, _labels(diagnosis), np.zeros(len(time), dtype=bool), [])
    return picture('Residual over time, on the recording that judges', 'judged', figure,
                    f'The same models on {elsewhere.name}, of which they saw nothing.')


def _against_variable(diagnosis: Diagnosis, suspicion: Suspicion, number: int) -> Picture:
    names = ' and '.join(_named(finding.effect) for finding in suspicion.findings)
    channel = diagnosis.first.body.output_names[suspicion.channel]
    return picture(names, f'variable{number}', against_suspected(diagnosis, suspicion),
                    f'Residual of {channel}, the output in which this shows most. Left: without it, and without what '
                    'later rounds found. Right: with everything found. The points should follow the line on the left '
                    'and lie flat on the right.')


def _unexplained(fit: Fit, structure: Structure) -> Picture:
    figure, channel = against_unexplained(fit, structure)
    return picture('What no kind explains', 'unexplained', figure,
                    f'What is left of {channel}, the output with most structure, against what it depends on most. A '
                    'course that is not flat is something that the model lacks.')


def _formulas(structure: Structure, least_share: float) -> list[tuple[Formula, str]]:
    """Formulas, each with the effect that declares it where it is worth declaring, else ''."""
    return [(formula, effect_to_text(formula.effect) if formula.share > least_share else '')
            for formula in structure.formulas]


def _spectra(diagnosis: Diagnosis) -> Picture:
    return picture('Spectrum of the residual', 'spectra', figures.spectra(diagnosis),
                    'Power of the residual over that of its white noise, mean over outputs. What stands above the '
                    'dashed line is structure: broad at low frequencies for what follows the motion, a peak for '
                    'something periodic.')


def _candidates(diagnosis: Diagnosis) -> list[Picture]:
    return [picture(f'Candidates of round {number}', f'round{number}', figures.candidates_of(step, number),
                    LOADS if any(effect.is_load for effect in step.added) else '')
            for number, step in enumerate(diagnosis.steps, start=1)]


def _facts(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Facts about how the diagnosis was done, in a few lines."""
    samples, train_mask = diagnosis.first.samples, diagnosis.first.train_mask
    mean = f', each the mean of {diagnosis.inputs.factor} that were recorded' if diagnosis.inputs.factor > 1 else ''
    step = float(np.median(np.diff(samples.time)))
    judged = diagnosis.elsewhere.name if diagnosis.elsewhere else \
        f'{int(diagnosis.judged.sum())} samples of the same recording'
    return [('Recording', f'{len(samples)} samples over {samples.recorded_s:.1f} s, one in '
                          f'{1000.0 * step:.3g} ms{mean}; {int(train_mask.sum())} of them fitted.'),
            ('Judged on', f'{judged}. Nothing of it was used to find, to fit or to rank.'),
            ('Joint motion', f'{diagnosis.inputs.motion}; of the recorded and the smoothed motion, the one with which '
                             'the declared model predicted unseen blocks best.'),
            ('Declared before', ', '.join(effect_to_text(effect) for effect in diagnosis.first.effects
                                          if effect not in diagnosis.offsets) or 'no effects')]
