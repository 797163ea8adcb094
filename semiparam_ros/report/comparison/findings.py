"""The paper's findings, each tested against the figures, and a verdict in words (Romeres et al. 2016, section V)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from semiparam_ros.report.comparison.figures import IndexFigures, Spread, VariantFigures

PARAMETRIC = 'P'
PAIRS = (('NP-ML', 'NP-VS'), ('SP2-ML', 'SP2-VS'))
BEST = ('SP-ML', 'SPK-ML')
TIE = 1.05
"""Figures within 5 % of each other count as equal: feature draws differ by as much."""
CLOSE = 1.5
"""Models are close in steady state when the worst index is at most this many times the best."""
NAMES = {'eps_force': 'force', 'eps_torque': 'torque', 'eps_effort': 'effort'}


class Finding(NamedTuple):
    """A statement of the paper, whether it holds here (None: cannot be said), and the figures that say so."""

    name: str
    statement: str
    holds: bool | None
    evidence: str


def findings_of(figures: Mapping[str, VariantFigures]) -> tuple[Finding, ...]:
    """Those findings whose variants were compared."""
    found = []
    if PARAMETRIC in figures and len(figures) > 1:
        found.append(parametric_is_worst(figures))
    if any(ml in figures and vs in figures for ml, vs in PAIRS):
        found.append(likelihood_beats_validation(figures))
    others = set(figures) - set(BEST) - {PARAMETRIC}
    if set(BEST) <= set(figures) and others:
        found += [semi_parametric_is_best(figures, 'average'), semi_parametric_is_best(figures, 'spread')]
    if len(set(figures) - {PARAMETRIC}) > 1:
        found.append(others_are_close(figures))
    return tuple(found)


def parametric_is_worst(figures: Mapping[str, VariantFigures]) -> Finding:
    """P has the largest index after the first 30 s."""
    verdicts: list[bool | None] = []
    texts: list[str] = []
    for index in _indices(figures):
        values = _means(figures, index, 'steady_state')
        worst = max(values, key=lambda variant: values[variant]) if values else None
        verdicts.append(None if worst is None else worst == PARAMETRIC)
        if worst is not None:
            others = {variant: value for variant, value in values.items() if variant != PARAMETRIC}
            next_worst = max(others, key=lambda variant: others[variant])
            texts.append(f'{NAMES[index]}: P {values[PARAMETRIC]:.3g}, next worst {next_worst} '
                         f'{others[next_worst]:.3g}')
    return Finding('parametric_is_worst', 'The rigid body alone (P) is the poorest model.', _all(verdicts),
                   _joined(texts))


def likelihood_beats_validation(figures: Mapping[str, VariantFigures]) -> Finding:
    """The ML variants have a smaller index than their VS twins in the first 60 s."""
    verdicts: list[bool | None] = []
    texts: list[str] = []
    for index in _indices(figures):
        values = _means(figures, index, 'first_60_s')
        for ml, vs in PAIRS:
            if ml in values and vs in values:
                verdicts.append(values[ml] < values[vs])
                texts.append(f'{NAMES[index]}: {ml} {values[ml]:.3g}, {vs} {values[vs]:.3g}')
    return Finding('likelihood_beats_validation',
                   'Marginal likelihood gives better models than a validation set in the first 60 s.',
                   _all(verdicts), _joined(texts))


def semi_parametric_is_best(figures: Mapping[str, VariantFigures], what: str) -> Finding:
    """SP-ML and SPK-ML have the smallest index, or interquartile range of it, after the first 30 s."""
    field, word = ('steady_state', 'on average') if what == 'average' else ('spread', 'in spread')
    verdicts: list[bool | None] = []
    texts: list[str] = []
    for index in _indices(figures):
        values = _means(figures, index, field)
        others = {variant: value for variant, value in values.items() if variant not in BEST}
        if not others:
            verdicts.append(None)
            continue
        rival = min(others, key=lambda variant: others[variant])
        verdicts += [values[variant] <= TIE * others[rival] for variant in BEST]
        texts.append(f'{NAMES[index]}: ' + ', '.join(f'{variant} {values[variant]:.3g}' for variant in BEST)
                     + f', best of the others {rival} {others[rival]:.3g}')
    return Finding(f'semi_parametric_is_best_{what}', f'SP-ML and SPK-ML are the best {word} (ties within 5 %).',
                   _all(verdicts), _joined(texts))


def others_are_close(figures: Mapping[str, VariantFigures]) -> Finding:
    """All but P are within a factor of 1.5 after the first 30 s."""
    verdicts: list[bool | None] = []
    texts: list[str] = []
    for index in _indices(figures):
        values = {variant: value for variant, value in _means(figures, index, 'steady_state').items()
                  if variant != PARAMETRIC}
        if not values:
            verdicts.append(None)
            continue
        least, most = (pick(values, key=lambda variant: values[variant]) for pick in (min, max))
        verdicts.append(values[most] <= CLOSE * values[least])
        texts.append(f'{NAMES[index]}: {least} {values[least]:.3g} to {most} {values[most]:.3g}, a factor of '
                     f'{values[most] / values[least]:.2f}')
    return Finding('others_are_close', f'All but P are close in steady state (within a factor of {CLOSE:g}).',
                   _all(verdicts), _joined(texts))


def verdict(figures: Mapping[str, VariantFigures], findings: tuple[Finding, ...]) -> str:
    """Which variant to use here and how many of the paper's findings hold, in a few sentences."""
    best = min(figures.values(), key=lambda one: one.adaptive.nmse.mean)
    frozen = min(figures.values(), key=lambda one: one.frozen.nmse.mean)
    sentences = [f'{best.variant} predicts best while it learns (normalised error {_with_spread(best.adaptive.nmse)})']
    if frozen.variant == best.variant:
        sentences[0] += f' and also without learning the second recording ({_with_spread(frozen.frozen.nmse)}).'
    else:
        sentences[0] += (f'; without learning the second recording {frozen.variant} does '
                         f'({_with_spread(frozen.frozen.nmse)}).')
    judged = [finding for finding in findings if finding.holds is not None]
    if judged:
        held = sum(bool(finding.holds) for finding in judged)
        sentences.append(f"{held} of {len(judged)} findings of the paper hold on these recordings.")
    sentences.append(_bands(best))
    return ' '.join(sentences)


def _bands(best: VariantFigures) -> str:
    share = best.adaptive.coverage.mean
    honest = 'honest' if 0.93 <= share <= 0.97 else 'too narrow' if share < 0.93 else 'too wide'
    return f'Its 95 % bands hold {100 * share:.1f} % of the measurements: {honest}.'


def _with_spread(figure: Spread) -> str:
    return f'{figure.mean:.3g}' if figure.std is None else f'{figure.mean:.3g} ± {figure.std:.1g}'


def _indices(figures: Mapping[str, VariantFigures]) -> Iterator[str]:
    return iter(next(iter(figures.values())).indices)


def _means(figures: Mapping[str, VariantFigures], index: str, field: str) -> dict[str, float]:
    """Variant to mean over seeds; empty where the recording is too short for the phase."""
    values: dict[str, float] = {}
    for variant, one in figures.items():
        spread = _phase(one.indices[index], field)
        if spread is not None:
            values[variant] = spread.mean
    return values


def _phase(index: IndexFigures, field: str) -> Spread | None:
    spread: Spread | None = getattr(index, field)
    return spread


def _all(verdicts: Sequence[bool | None]) -> bool | None:
    """None when nothing could be judged."""
    known = [one for one in verdicts if one is not None]
    return all(known) if known else None


def _joined(texts: list[str]) -> str:
    return '; '.join(texts) + '.' if texts else 'The second recording is too short to tell.'
