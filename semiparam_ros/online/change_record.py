"""Record of a change: what was noticed, how it was named, and what was decided about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import place
from semiparam_ros.online.followed_change import Change
from semiparam_ros.online.wandering_contact import CONTACT_S

if TYPE_CHECKING:
    from semiparam_ros.diagnosis.named_change import NamedChange

ASSUMED = 'taken off until it is named'
TRIED, APPLIED, TAKEN_BACK = 'tried beside the model', 'applied', 'taken back'
DROPPED, LEARNT = 'dropped, as nothing spoke for it', 'learnt, as no effect of the robot explains it'


class Decision(NamedTuple):
    """Decision about a change at a stamp [ns]: one of ``ASSUMED`` to ``LEARNT``.

    :param evidence: [nat] of what came since it was tried, or since it was over.
    :param error_share: the error while it was applied over what it would have been without; None
        for what never was.
    """

    what: str
    stamp: int
    evidence: float | None = None
    error_share: float | None = None

    @property
    def sentence(self) -> str:
        """For people, without a full stop."""
        found = f'{self.what} at {self.stamp / NANOSECONDS:.2f} s'
        if self.evidence is not None:
            found += f' (evidence {self.evidence:.0f} nat)'
        if self.error_share is not None:
            found += f'; the error was {self.error_share:.0%} of what it would have been'
        return found

    def as_dict(self) -> dict[str, object]:
        """For the log."""
        return {'what': self.what, 'stamp_s': self.stamp / NANOSECONDS, 'evidence': self.evidence,
                'error_share': self.error_share}


@dataclass(frozen=True)
class ChangeRecord:
    """All that is known of one change; ``named`` is what
    :func:`~semiparam_ros.diagnosis.change.name_change` found."""

    change: Change
    named: NamedChange | None = None
    times_named: int = 0
    decisions: tuple[Decision, ...] = ()
    """With ``diagnosis.auto: apply``, in their order."""
    unnamed: str = ''
    """A sentence why it could not be named when that was last tried."""
    restored: Effect | None = None
    """What it was by the state that was loaded, its times as stamps."""
    part_of: int | None = None
    """The change that it was the end of, or that came again; None: it is one of its own."""

    @property
    def effect(self) -> Effect | None:
        """Effect that it is, its times as stamps; over when the change is."""
        effect = self.restored if self.named is None else self.named.effect
        if effect is None or effect.ends or self.change.ended is None:
            return effect
        end_s = self.change.ended / NANOSECONDS
        return replace(effect, span=replace(effect.span, end_stamp_s=end_s))

    @property
    def retracted(self) -> bool:
        """Return whether it was no change after all: no effect explains it better than none, or it was
        over as soon as a contact is and no load."""
        effect = self.effect
        if self.part_of is not None:
            return True
        if effect is None:
            unexplained = self.brief or (self.named is not None and bool(self.change.kind))
            return unexplained and not self.was_applied
        return self.brief and not effect.is_load

    @property
    def brief(self) -> bool:
        """Return whether it was over as soon as a contact is; that is not known where the clock was set back."""
        change = self.change
        return change.ended is not None and 0 <= change.ended - change.since < CONTACT_S * NANOSECONDS

    @property
    def was_applied(self) -> bool:
        """Return whether the model was helped by it."""
        return any(decision.what in (APPLIED, TAKEN_BACK) for decision in self.decisions)

    @property
    def times_s(self) -> tuple[float | None, float | None]:
        """[s] when it began and ended, as stamps count; None for what was there before, or is there
        yet."""
        change, effect = self.change, self.effect
        ended = None if change.ended is None else change.ended / NANOSECONDS
        if effect is not None:
            known = effect.span.end_stamp_s
            return effect.span.start_stamp_s, ended if known is None else known
        return change.since / NANOSECONDS, ended

    @property
    def events(self) -> list[tuple[int, str]]:
        """Stamps [ns] of what happened, and what, for a plot: it began, was applied, was over."""
        effect, change = self.effect, self.change
        kind = change.kind if effect is None else effect.kind
        found = [(change.since, f'{kind or "change"} begins')]
        silent = ASSUMED, TRIED
        found += [(each.stamp, each.what) for each in self.decisions if each.what not in silent]
        ended = change.ended if not self.was_applied else None
        return found if ended is None else [*found, (ended, 'over')]

    @property
    def sentence(self) -> str:
        """For people."""
        change, effect = self.change, self.effect
        begun, ended = self.times_s
        since = f'since {begun:.2f} s' if begun is not None else 'from before'
        until = '' if ended is None else f', over at {ended:.2f} s'
        decided = f' It was {self.decisions[-1].sentence}.' if self.decisions else ''
        if self.retracted:
            why = 'it was over as soon as a contact is' if self.brief else 'no effect explains it'
            if self.part_of is not None:
                why = f'what came or went is change {self.part_of}'
            return f'the robot has not changed {since}{until}: {why}.{decided}'
        if effect is None:
            what = (
                f'likeliest {place(change.kind, change.where)}' if change.kind else 'nothing known'
            )
            asked = '' if self.named is None else '; no effect explains it better than none'
            felt = ', '.join(change.outputs[:3])
            unnamed = f' It could not be named: {self.unnamed}' if self.unnamed else ''
            return (f'the robot has changed {since}{until} ({what}, felt by {felt}){asked}.'
                    f'{unnamed}{decided}')
        values = ', '.join(
            f'{name} {value.value:.3g} +- {value.std or 0.0:.1g} {value.unit}'.rstrip()
            for name, value in list(self.named.parameters.items() if self.named else ())[:4]
        )
        what, values = place(effect.kind, effect.where), f' ({values})' if values else ''
        return f'{what} {since}{until}: {effect.sentence}{values}.{decided}'

    def as_dict(self) -> dict[str, object]:
        """For the log; times in seconds as stamps count."""
        change = self.change
        return {
            'schema': 1,
            'change': change.number,
            'since_stamp_s': change.since / NANOSECONDS,
            'noticed_stamp_s': change.noticed / NANOSECONDS,
            'ended_stamp_s': None if change.ended is None else change.ended / NANOSECONDS,
            'noticed_as': {
                'kind': change.kind or None,
                'where': change.where,
                'evidence': change.evidence,
                'outputs': list(change.outputs),
            },
            'named': None if self.named is None else self.named.as_dict(),
            'unnamed': self.unnamed or None,
            'decisions': [decision.as_dict() for decision in self.decisions],
            'retracted': self.retracted,
            'part_of': self.part_of,
            'sentence': self.sentence,
        }
