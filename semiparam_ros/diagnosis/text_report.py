"""Tells a diagnosis in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import NamedTuple

from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.data.recordings import breaks_s, own_time
from semiparam_ros.diagnosis.diagnose import Diagnosis
from semiparam_ros.diagnosis.findings import Finding
from semiparam_ros.diagnosis.named_change import Quantity
from semiparam_ros.diagnosis.search.candidates import fixed, identity
from semiparam_ros.diagnosis.search.stepwise import Rival
from semiparam_ros.diagnosis.setup.identifiability import listed
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import place

MOST_PARAMETERS, MOST_IN_ROW, MOST_DECIMALS = 4, 2, 6
ONE_FREEDOM = ('A common gain of all outputs and every mass are one and the same freedom, so the gains of a '
               'wrench are told as if the median one were right, those of efforts as if the described masses were. To '
               'know both, record the arm with a load of known mass too, and '
               'declare that: --in LOADED.mcap \'payload@LINK{"mass": KG}\'.')
EARLIEST_DATE_S = 1e9
"""Stamps below it [s] count from the start of something, not from 1970."""


def text_report(diagnosis: Diagnosis) -> list[str]:
    """A few sentences: is anything missing, what, where, since when, how large, how sure, and what it brings."""
    lines = _verdict(diagnosis)
    for finding in diagnosis.findings:
        effect = finding.effect
        lines.append(f'{place(effect.kind, effect.where)}: {effect.sentence}'
                     f'{when(diagnosis, effect)} ({_values(finding)}{_as_declared(diagnosis, effect)}; '
                     f'log evidence {finding.log_evidence_gain:+.0f}).')
        doubt = effect.doubt(diagnosis.final.body, diagnosis.final.samples)
        lines += [f'  {doubt}'] if doubt else []
        lines += _rivals(finding, diagnosis.config.better_odds)
    lines += [f'Declared: {place(each.effect.kind, each.effect.where)}'
              f'{when(diagnosis, each.effect)} ({_values(each)}).' for each in diagnosis.declared]
    lines += [ONE_FREEDOM] if diagnosis.gain_and_mass_are_one else []
    lines += _dropped(diagnosis)
    if diagnosis.findings:
        lines.append(_gain(diagnosis))
    if diagnosis.structure is not None and diagnosis.structure.significant:
        lines.append(diagnosis.structure.sentence)
    return lines + _contacts(diagnosis) + diagnosis.notes


def _dropped(diagnosis: Diagnosis) -> list[str]:
    """Lines on what was found, or declared, and is in the final model no longer."""
    held, declared = ({place(effect.kind, effect.where) for effect in fit.effects}
                      for fit in (diagnosis.final, diagnosis.first))
    dropped = dict.fromkeys(place(effect.kind, effect.where) for step in diagnosis.steps for effect in step.dropped)
    gone = [name for name in dropped if name not in held]
    sorts = {'Declared, but dropped, because the effects above explain it better': declared,
                'Tried first and dropped, because the effects above explain it better': {*gone} - declared}
    told = {sentence: [name for name in gone if name in chosen] for sentence, chosen in sorts.items()}
    return [f'{sentence}: {", ".join(names)}.' for sentence, names in told.items() if names]


def _as_declared(diagnosis: Diagnosis, effect: Effect) -> str:
    """Values that the effect was declared with and has no longer; empty where it was not declared."""
    known = [each for each in diagnosis.first.effects if identity(each) == identity(effect)]
    values = [f'{name} {value:.4g} {each.unit_of(name, diagnosis.first.body)}'.rstrip() for each in known[:1]
              for name, value in each.parameters.items() if value != effect.parameters.get(name)]
    return f'; declared with {", ".join(values)}' * bool(values)


def summary(diagnosis: Diagnosis) -> list[str]:
    """Findings, a line for each effect, and what to do now; :func:`text_report` has the details."""
    lines = _verdict(diagnosis)
    for finding in diagnosis.findings:
        effect = finding.effect
        rivals = ''.join(f'; or {place(rival.effect.kind, rival.effect.where)}' for rival in finding.rivals[:1])
        lines.append(f'- {place(effect.kind, effect.where)}{when(diagnosis, effect)}: '
                     f'{_values(finding, MOST_IN_ROW)}{rivals}')
    return lines


def _verdict(diagnosis: Diagnosis) -> list[str]:
    """Return what is wrong with the set-up, else whether anything is missing, and outputs that stay a
    riddle, whatever was found elsewhere."""
    shifted = 'The offset of its sensor is another one there: diagnose both recordings as one, each with its own.'
    riddles = [f'{name} is not explained: {100 * left:.0f} % of its variance is left, of which '
               f'noise is {100 * noise:.0f} %. ' + (shifted if name in diagnosis.shifted_outputs else
                                                     'Look at its sign, its unit, its place in the message, or for '
                                                     'contact.')
               for name, (left, noise) in diagnosis.unexplained_outputs.items()]
    return [problem.sentence for problem in diagnosis.setup] or [_opening(diagnosis), *riddles]


def _opening(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict == 'nothing_missing':
        if diagnosis.unexplained_outputs:
            return 'No effect that could be named explains what is left.' + _description(diagnosis)
        return ('Nothing is missing: no effect that could be named explains the residual on blocks left out of the fit.'
                + _description(diagnosis))
    if diagnosis.verdict == 'unexplained':
        beside = ' The effects below hold beside it.' * bool(diagnosis.findings)
        function = ' A smooth function of the motion and of time explains more of it than all that resemble it.'
        if diagnosis.imitated or not diagnosis.findings:
            return ('Something is missing that none of the known effects explains.'
                    + (function + beside) * diagnosis.imitated)
        return 'Something is missing, and the effects below explain only the smaller part of it.'
    declared = fixed(diagnosis.final)
    other = sum(identity(finding.effect) in declared for finding in diagnosis.findings)
    count = len(diagnosis.findings) - other
    lacks = f'The model lacks {"one effect" if count == 1 else f"{count} effects"}'
    has = f'{"one effect has" if other == 1 else f"{other} effects have"} other values than declared.'
    return f'{lacks}.' if not other else f'{lacks}, and {has}' if count else has.capitalize()


def _description(diagnosis: Diagnosis) -> str:
    """A sentence on inertias that are others than described, as where the robot always carries a tool; else empty."""
    described, fitted = diagnosis.described_errors
    if not described.interval()[0] > fitted.interval()[1]:
        return ''
    return (f' But the inertias are not those of the robot description: with these the normalised error is '
            f'{described.nmse.mean():.2g}, with those of the fit {fitted.nmse.mean():.2g}. What the robot carries all '
            'the time is part of them.')


def _contacts(diagnosis: Diagnosis) -> list[str]:
    """When the arm was touched and where; the findings are of the rest."""
    if not diagnosis.contacts:
        return []
    units = dict(zip(diagnosis.first.body.output_names, diagnosis.first.body.output_units, strict=True))
    lines = []
    for contact in diagnosis.contacts:
        name, value = max(contact.channels.items(), key=lambda item: abs(item[1]))
        where = f' on the link after {contact.joint} or beyond it' if contact.joint else ''
        start_s, of = own_time(diagnosis.recorded.samples, diagnosis.names, contact.start_s)
        end_s = start_s + contact.end_s - contact.start_s
        lines.append(f'  {start_s:.1f} to {end_s:.1f} s{of}{where}: {name} {value:+.2g} {units[name]}'
                     + (f', and {listed([other for other in contact.channels if other != name])}'
                        if len(contact.channels) > 1 else '') + '.')
    count = 'once' if len(lines) == 1 else f'{len(lines)} times'
    return [f'The arm seems to have been touched {count}:', *lines]


def when(diagnosis: Diagnosis, effect: Effect, dated: bool = True) -> str:
    """From when to when, with dates or without, or in which recordings, an effect is there; empty when it always was.
    """
    names, samples = diagnosis.recordings_of(effect), diagnosis.recorded.samples
    parts = [f', in {listed(names)}'] if names and len(names) < len(diagnosis.names) else []
    breaks = breaks_s(samples)
    for word, time_s in (('since', effect.start_s), ('until', effect.end_s)):
        if time_s is None or time_s in breaks:
            continue
        own_s, of = own_time(samples, diagnosis.names, time_s)
        first = dated and own_s == time_s  # later recordings may have been moved in time
        date = at_time(samples, time_s) if first else ''
        parts.append(f', {word} {own_s:.1f} s{of}{date}')
    return ''.join(parts)


def at_time(samples: Samples, time_s: float) -> str:
    """The date and time of a moment of a recording, in brackets; empty where stamps are no dates."""
    stamp = samples.origin * 1e-9 + time_s
    if stamp < EARLIEST_DATE_S:
        return ''
    return datetime.fromtimestamp(round(stamp, 1), timezone.utc).strftime(' (%Y-%m-%d %H:%M:%S UTC)')


def remarks(diagnosis: Diagnosis, effect: Effect) -> list[str]:
    """Findings of an effect of the final model, its start aside: since when, its values, what it rests on."""
    found = [finding for finding in diagnosis.findings
             if finding.effect.without_span() == effect.without_span()]
    if not found:
        return [f'{place(effect.kind, effect.where)}: {effect.sentence}. Declared before.']
    return [line for finding in found for line in _remark(diagnosis, finding)]


def _remark(diagnosis: Diagnosis, finding: Finding) -> list[str]:
    judged = [diagnosis.before, *diagnosis.by_step]
    before, after = (judged[number].nmse.mean() for number in (finding.round_number - 1, finding.round_number))
    since = when(diagnosis, finding.effect)
    rivals = _with_odds(finding.rivals)
    return [f'{place(finding.effect.kind, finding.effect.where)}: {finding.effect.sentence}{since}.',
            *(f'  {name}: {quantity_text(quantity)}' for name, quantity in finding.parameters.items()),
            f'  Rests on: log evidence {finding.log_evidence_gain:+.0f}; round {finding.round_number} changed the '
            f'held-out normalised error from {error_text(before)} to {error_text(after)}.',
            *([f'  Cannot be told for certain from {rivals}.'] if rivals else [])]


def _values(finding: Finding, most: int | None = None) -> str:
    """Searched values, and the parameters that stand out most from their uncertainty; in their own order, the first
    ``most``. A searched value has none to stand out from, so it takes the place of no other."""
    known = {name: abs(each.value) / each.std for name, each in finding.parameters.items() if each.std}
    left_out = sorted(known, key=lambda name: known[name], reverse=True)[MOST_PARAMETERS:]
    shown = [item for item in finding.parameters.items() if item[0] not in left_out][:most]
    return ', '.join(f'{name} {quantity_text(quantity)}' for name, quantity in shown)


def quantity_text(quantity: Quantity) -> str:
    """A value with its standard deviation and unit, to the digits that the deviation leaves."""
    return f'{" +- ".join(filter(None, rounded(quantity)))} {quantity.unit}'.rstrip()


def rounded(quantity: Quantity) -> tuple[str, str]:
    """A value and its standard deviation, to the digits that the deviation leaves; the latter is empty where it was
    searched."""
    std = quantity.std
    if not std or not math.isfinite(std):
        return f'{quantity.value:.4g}', ''
    place = math.floor(math.log10(std)) - 1
    if -place > MOST_DECIMALS:
        return f'{quantity.value:.{MOST_DECIMALS - 2}g}', f'{std:.2g}'
    decimals = max(-place, 0)
    value = round(quantity.value, -place) + 0.0  # no negative zero
    return f'{value:.{decimals}f}', f'{round(std, -place):.{decimals}f}'


class TableRow(NamedTuple):
    """An effect in the table of a report."""

    where: str
    kind: str
    values: str
    when: str


def table_rows(diagnosis: Diagnosis) -> list[TableRow]:
    """The effects found, those of one joint or body together, joints in their order."""
    order = [*diagnosis.first.body.joints, *diagnosis.first.body.output_names]

    def number(finding: Finding) -> tuple[int, str]:
        where = finding.effect.where
        return (order.index(where) if where in order else len(order), where or '')

    return [TableRow(finding.effect.where or 'all', finding.effect.kind, _values(finding, MOST_IN_ROW),
                     when(diagnosis, finding.effect, dated=False).removeprefix(', '))
            for finding in sorted(diagnosis.findings, key=number)]


def next_step(diagnosis: Diagnosis, written: str = '') -> str:
    """Advice in one line. :param written: the parameter file that declares what was found; '' for none."""
    rivals = [finding for finding in diagnosis.findings if finding.rivals]
    if diagnosis.setup:
        return 'put right what is said above, and diagnose again: nothing else is worth reading before.'
    if rivals:
        return f'to be sure of {rivals[0].effect.kind}, record {rivals[0].effect.separated_by}.'
    if diagnosis.verdict == 'unexplained':
        return 'look at the page (--html FILE.html): against what the residual shows tells where to look on the robot.'
    if diagnosis.findings:
        return (f'start the node with {written}, which declares what was found, or mend the cause.' if written else
                'write the effects with -o FILE.yaml and start the node with that file, or mend the cause.')
    if _description(diagnosis):
        return ('nothing for the model; put the tool into the robot description, or write the inertias of the fit down '
                'with semiparam export.')
    return 'nothing; to see more, record faster motion of more joints.'


def _rivals(finding: Finding, better_odds: float) -> list[str]:
    if not finding.rivals:
        return []
    names = _with_odds(finding.rivals)
    lines = [f'  On this motion it cannot be told for certain from {names}. What would separate them: '
             f'{finding.effect.separated_by}.']
    better = [rival for rival in finding.rivals if rival.odds > better_odds]
    if better:
        lines.append(f'  {_with_odds(better)} would explain it better, with more parameters or against the '
                     'description: the plainer cause was chosen. Look there first if it is not it.')
    return lines


def _with_odds(rivals: Sequence[Rival]) -> str:
    return ', '.join(f'{place(rival.effect.kind, rival.effect.where)} ({_likely(rival.odds)})' for rival in rivals)


def _likely(odds: float) -> str:
    """Likelihood of a rival, against the effect that was chosen."""
    if 0.8 < odds < 1.25:
        return 'as likely'
    ratio = min(max(odds, 1.0 / odds), 1e6)
    return f'{float(f"{ratio:.2g}"):.7g} times {"more" if odds > 1.0 else "less"} likely'


def error_text(value: float) -> str:
    """An error to four decimals, and one that would be zero then to a digit."""
    return f'{value:.4f}' if round(value, 4) or not value else f'{value:.0e}'


def _gain(diagnosis: Diagnosis) -> str:
    before, after = diagnosis.before, diagnosis.after
    low, high = after.interval()
    verb = 'falls' if after.nmse.mean() < before.nmse.mean() else 'rises'
    said = (f'On held-out data the normalised error {verb} from {error_text(before.nmse.mean())} to '
            f'{error_text(after.nmse.mean())} (95 % interval {error_text(low)} to {error_text(high)}).')
    left_out = int((diagnosis.held_out & ~diagnosis.judged).sum())
    if left_out and diagnosis.elsewhere is None:
        said += f' The {left_out} held-out samples about a start or an end do not judge: nothing told when it was.'
    if diagnosis.everything is diagnosis.final:
        return said
    fitted = error_text(diagnosis.on_all_samples.nmse.mean())
    return f'{said} Times and values come from a last fit to all samples, which leaves {fitted} of them.'
