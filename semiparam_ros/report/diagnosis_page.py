"""One self-contained HTML page of a diagnosis, made for looking first: no network, no script, light and dark."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from semiparam_ros import __version__
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.diagnose import Diagnosis
from semiparam_ros.diagnosis.formula import Formula
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.structure import Structure
from semiparam_ros.diagnosis.words import in_words, place
from semiparam_ros.effects import effect_to_text
from semiparam_ros.report import diagnosis_figures as figures
from semiparam_ros.report.diagnosis_clouds import Suspicion, against_suspected, against_unexplained, suspicions
from semiparam_ros.report.diagnosis_tables import causes, output_rows, relative_floor, round_rows, variant_rows
from semiparam_ros.report.rendering import environment
from semiparam_ros.report.svg import inline_svg

SHOWN_OPEN = 3
"""Pictures of a kind that stand open; further ones fold away."""

LOADS = 'A load is tried at one link of each body, and once it is found named after the link nearest to its centre.'


class Picture(NamedTuple):
    """A figure and the caption that says what to see."""

    title: str
    svg: Markup
    caption: str


def diagnosis_page(diagnosis: Diagnosis, result: dict[str, Any], title: str) -> str:
    """The page's text.

    :param result: the machine-readable report, for what the diagnosis itself does not hold (other variants).
    :param title: name of the recording.
    """
    opening, *words = in_words(diagnosis)
    structure = diagnosis.structure if diagnosis.structure and diagnosis.structure.significant else None
    return environment().get_template('diagnosis.html.j2').render(
        version=__version__, title=title, verdict=diagnosis.verdict, opening=opening, words=words,
        headline=_headline(diagnosis), outputs=_outputs(diagnosis), rows=output_rows(diagnosis),
        rounds=round_rows(diagnosis), over_time=_over_time(diagnosis), findings=_against_variables(diagnosis),
        structure=structure, unexplained=_unexplained(diagnosis.final, structure) if structure else None,
        formulas=_formulas(structure) if structure else [],
        spectra=_spectra(diagnosis), candidates=_candidates(diagnosis), causes=causes(diagnosis),
        variants=variant_rows(result.get('variants') or {}), open=SHOWN_OPEN, facts=_facts(diagnosis),
        effects=[effect_to_text(effect) for effect in diagnosis.final.effects])


def _headline(diagnosis: Diagnosis) -> dict[str, Any]:
    """The mean normalised errors that matter most."""
    low, high = diagnosis.after.interval()
    return {'before': diagnosis.before.nmse.mean(), 'after': diagnosis.after.nmse.mean(), 'low': low, 'high': high,
            'floor': float(relative_floor(diagnosis).mean())}


def _labels(diagnosis: Diagnosis) -> list[str]:
    body = diagnosis.first.body
    return [f'{name} [{unit}]' for name, unit in zip(body.output_names, body.output_units, strict=True)]


def _outputs(diagnosis: Diagnosis) -> Picture:
    figure = figures.outputs_of(diagnosis, list(diagnosis.first.body.output_names))
    return _picture('Error of each output', 'outputs', figure, '')


def _over_time(diagnosis: Diagnosis) -> list[Picture]:
    """Of the recording that was diagnosed, and of the one that judged, where that is another."""
    first, final, added = diagnosis.first, diagnosis.final, bool(diagnosis.steps)
    starts = [(place(effect.kind, effect.where), effect.start_s) for effect in final.effects
              if effect.start_s is not None]
    held_out = diagnosis.held_out if diagnosis.judged is None else np.zeros(len(first.samples), dtype=bool)
    caption = 'What the model does not explain of each output'
    caption += ', before and after the effects were added.' if added else '.'
    caption += ' The shaded blocks were not used for the fit.' if held_out.any() else ''
    caption += ' A dashed line marks the start of an effect.' if starts else ''
    own = figures.over_time(first.samples.time, figures.curves(first.residual, final.residual, added),
                            _labels(diagnosis), held_out, starts)
    shown = [_picture('Residual over time', 'time', own, caption)]
    if diagnosis.judged is not None and diagnosis.judged_valid is not None:
        shown.append(_over_time_elsewhere(diagnosis, diagnosis.judged.time[diagnosis.judged_valid]))
    return shown


def _over_time_elsewhere(diagnosis: Diagnosis, time: Array) -> Picture:
    both = figures.curves(diagnosis.before.residual, diagnosis.after.residual, bool(diagnosis.steps))
    figure = figures.over_time(time, both, _labels(diagnosis), np.zeros(len(time), dtype=bool), [])
    return _picture('Residual over time, on the recording that judges', 'judged', figure,
                    f'The same models on {diagnosis.judged_elsewhere}, of which they saw nothing.')


def _against_variables(diagnosis: Diagnosis) -> list[Picture]:
    return [_against_variable(diagnosis, suspicion, number)
            for number, suspicion in enumerate(suspicions(diagnosis))]


def _against_variable(diagnosis: Diagnosis, suspicion: Suspicion, number: int) -> Picture:
    names = ' and '.join(place(finding.effect.kind, finding.effect.where) for finding in suspicion.findings)
    channel = diagnosis.first.body.output_names[suspicion.channel]
    return _picture(names, f'variable{number}', against_suspected(diagnosis, suspicion),
                    f'Residual of {channel}, the output in which this shows most. Left: without it, and without what '
                    'later rounds found. Right: with everything found. The points should follow the line on the left '
                    'and lie flat on the right.')


def _unexplained(state: Fit, structure: Structure) -> Picture:
    figure, channel = against_unexplained(state, structure)
    return _picture('What no kind explains', 'unexplained', figure,
                    f'What is left of {channel}, the output with most structure, against what it depends on most. A '
                    'course that is not flat is something that the model lacks.')


def _formulas(structure: Structure) -> list[tuple[Formula, str]]:
    """Each formula, and the effect that declares it where it is worth declaring."""
    worth = structure.effects
    return [(formula, effect_to_text(formula.effect) if formula.effect in worth else '')
            for formula in structure.formulas]


def _spectra(diagnosis: Diagnosis) -> Picture:
    return _picture('Spectrum of the residual', 'spectra', figures.spectra(diagnosis),
                    'Power of the residual over that of its white noise, mean over outputs. What stands above the '
                    'dashed line is structure: broad at low frequencies for what follows the motion, a peak for '
                    'something periodic.')


def _candidates(diagnosis: Diagnosis) -> list[Picture]:
    return [_picture(f'Candidates of round {number}', f'round{number}', figures.candidates_of(step, number),
                     LOADS if any(trial.effect.kind == 'payload' for trial in step.added) else '')
            for number, step in enumerate(diagnosis.steps, start=1)]


def _picture(title: str, name: str, figure: Figure, caption: str) -> Picture:
    return Picture(title, Markup(inline_svg(figure, name, title.replace('"', ''))), caption)


def _facts(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """How it was done, in a few lines."""
    samples, use = diagnosis.first.samples, diagnosis.first.use
    step = float(np.median(np.diff(samples.time)))
    judged = diagnosis.judged_elsewhere or f'{int(diagnosis.held_out.sum())} samples of the same recording'
    return [('Recording', f'{len(samples)} samples over {samples.time[-1] - samples.time[0]:.1f} s, one in '
                          f'{1000.0 * step:.3g} ms; {int(use.sum())} of them fitted.'),
            ('Judged on', f'{judged}. Nothing of it was used to find, to fit or to rank.'),
            ('Joint motion', f'{diagnosis.inputs.motion}; of the recorded and the smoothed motion, the one with which '
                             'the declared model predicted unseen blocks best.'),
            ('Declared before', ', '.join(map(effect_to_text, diagnosis.first.effects)) or 'no effects')]
