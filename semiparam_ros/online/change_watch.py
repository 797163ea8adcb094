"""Changes of the robot while it works: noticed as samples come, then named in the background.

What was noticed (:mod:`semiparam_ros.online.changes`) is named from the samples before and after it
(:mod:`semiparam_ros.diagnosis.change`), again and again as more of them come, beside what the model
declares and the changes that were named before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from semiparam_ros.core.columns import ColumnBlock, CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import place
from semiparam_ros.effects.loads import Payload
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import worker
from semiparam_ros.online.changes import BLOCK_S, LASTING, Change, ChangeDetector
from semiparam_ros.online.history import History
from semiparam_ros.online.identified_parameters import Load
from semiparam_ros.online.worker import Background, Urgency

if TYPE_CHECKING:
    from semiparam_ros.diagnosis.change import NamedChange
    from semiparam_ros.diagnosis.preparation import Inputs

CONTACT_S = LASTING * BLOCK_S
"""A contact does not last longer."""
BEFORE_S = 60.0
"""So much of what came before a change is looked at."""
NAMED_AFTER_S = (6.0, 12.0, 25.0, 50.0)
"""So long after it began a change is named, and named anew."""
MOST_RECORDS = 50
"""The latest changes are kept."""

STATES = ('not looked for', 'learns what is usual', 'as it was', 'touched, or changing', 'changed')


@dataclass(frozen=True)
class ChangeRecord:
    """All that is known of one change; ``named`` is what
    :func:`~semiparam_ros.diagnosis.change.name_change` found."""

    change: Change
    named: NamedChange | None = None

    @property
    def effect(self) -> Effect | None:
        """What it is, its times as stamps."""
        return None if self.named is None else self.named.effect

    @property
    def retracted(self) -> bool:
        """Whether it was no change after all: no effect explains it better than none, or it was
        over as soon as a contact is and no load."""
        change, effect = self.change, self.effect
        brief = change.ended is not None and change.ended - change.since < CONTACT_S * NANOSECONDS
        if effect is None:
            return brief or (self.named is not None and bool(change.kind))
        return brief and not effect.is_load

    @property
    def times_s(self) -> tuple[float | None, float | None]:
        """[s] when it began and ended, as stamps count; None for what was there before, or is there
        yet."""
        change, effect = self.change, self.effect
        if effect is not None:
            return effect.span.start_stamp_s, effect.span.end_stamp_s
        return (
            change.since / NANOSECONDS,
            None if change.ended is None else change.ended / NANOSECONDS,
        )

    @property
    def sentence(self) -> str:
        """For people."""
        change, effect = self.change, self.effect
        begun, ended = self.times_s
        since = f'since {begun:.2f} s' if begun is not None else 'from before'
        until = '' if ended is None else f', over at {ended:.2f} s'
        if self.retracted:
            brief = change.ended is not None
            why = 'it was over as soon as a contact is' if brief else 'no effect explains it'
            return f'the robot has not changed {since}{until}: {why}.'
        if effect is None:
            what = (
                f'likeliest {place(change.kind, change.where)}' if change.kind else 'nothing known'
            )
            asked = '' if self.named is None else '; no effect explains it better than none'
            felt = ', '.join(change.outputs[:3])
            return f'the robot has changed {since}{until} ({what}, felt by {felt}){asked}.'
        assert self.named is not None
        values = ', '.join(
            f'{name} {value.value:.3g} +- {value.std or 0.0:.1g} {value.unit}'.rstrip()
            for name, value in list(self.named.parameters.items())[:4]
        )
        return f'{place(effect.kind, effect.where)} {since}{until}: {effect.sentence} ({values}).'

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
            'retracted': self.retracted,
            'sentence': self.sentence,
        }


def known(declared: Sequence[Effect], named: Sequence[Effect]) -> tuple[Effect, ...]:
    """Effects that are declared or were named, each once: with its end, where one is known."""
    found: dict[tuple[str, str | None, float | None], Effect] = {}
    for effect in (*declared, *named):
        identity = effect.kind, effect.where, effect.span.start_stamp_s
        if identity not in found or effect.ends:
            found[identity] = effect
    return tuple(found.values())


class ChangeWatch:
    """Notices changes of one robot, and has them named.

    :param told: called with each record when it is new, and when more is known of it.
    :param failed: called with what went wrong while one was named.
    """

    def __init__(
        self,
        body: RigidBody,
        background: Background,
        told: Callable[[ChangeRecord], None],
        failed: Callable[[str, BaseException], None],
    ) -> None:
        self.records: dict[int, ChangeRecord] = {}
        """The latest, by their numbers."""
        self.detector: ChangeDetector | None = None
        """None while no model can be judged: with features in every one, or coefficients that are
        fixed."""
        self._body, self._background, self._told, self._failed = body, background, told, failed
        self._columns: CoupledColumns | None = None
        self._due: list[tuple[int, int]] = []
        """When [ns] changes of these numbers are named next."""
        self._naming = False
        self._inputs: Inputs | None = None
        """How the samples of this robot are best prepared, once that is known."""

    @property
    def state(self) -> str:
        """One of STATES."""
        detector = self.detector
        if detector is None:
            return STATES[0]
        if detector.followed is not None:
            return STATES[4]
        if detector.touched:
            return STATES[3]
        return STATES[2] if detector.knows else STATES[1]

    @property
    def picked(self) -> tuple[bool, Load | None]:
        """Whether a load was picked up that is still there, and that load where it is named."""
        followed = None if self.detector is None else self.detector.followed
        record = None if followed is None else self.records.get(followed.change.number)
        if record is None or followed is None:
            return False, None
        named, effect = record.named, record.effect
        if named is None or effect is None:
            return followed.change.kind == Payload.kind, None
        if not effect.is_load or effect.ends:
            return False, None
        values = list(named.parameters.values())
        return True, Load(
            str(effect.where),
            np.array([value.value for value in values]),
            np.diag([(value.std or 0.0) ** 2 for value in values]),
        )

    def forget(self) -> None:
        """Another model predicts, of which nothing is known yet; what was told stays."""
        self.detector = self._columns = None

    def reset(self) -> None:
        """Drop what is half seen, as after a jump of the clock."""
        if self.detector is not None:
            self.detector.reset()

    def see(self, estimator: Estimator, prediction: Prediction, history: History) -> None:
        """Take one predicted sample into account, before it is learnt."""
        part = estimator.rigid_body_part(prediction) if prediction.ready else None
        if part is None:
            self.forget()
            return
        change = self._detector_of(estimator.columns).see(*part)
        now = prediction.sample.stamp
        if change is not None:
            self._record(change, now)
        if self._due and not self._naming and now >= self._due[0][0]:
            self._name(self._due.pop(0)[1], history, estimator.columns.effects, now)

    def _detector_of(self, columns: CoupledColumns) -> ChangeDetector:
        """That of a model, which goes on where the model's columns are those that it had."""
        known, self._columns = self._columns, columns
        if (
            self.detector is None
            or known is None
            or known.n_own != columns.n_own
            or known.physical != columns.physical
        ):
            self.detector = ChangeDetector(columns, max(self.records, default=0))
        elif known.effects != columns.effects:
            self.detector.reset()
        return self.detector

    def _record(self, change: Change, now: int) -> None:
        known = self.records.get(change.number)
        record = ChangeRecord(change) if known is None else replace(known, change=change)
        self.records[change.number] = record
        for number in list(self.records)[:-MOST_RECORDS]:
            del self.records[number]
        if known is None:
            self._due += [
                (change.since + round(seconds * NANOSECONDS), change.number)
                for seconds in NAMED_AFTER_S
            ]
        elif change.ended is not None:
            self._due = [(when, number) for when, number in self._due if number != change.number]
            self._due.append((now, change.number))
        self._due.sort()
        self._told(record)

    def _name(
        self, number: int, history: History, effects: Sequence[ColumnBlock], now: int
    ) -> None:
        """Ask the background what it was, beside all else that is known."""
        record = self.records.get(number)
        if record is None:
            return
        change = record.change
        batch = history.span((now - change.since) / NANOSECONDS + BEFORE_S)
        others = [
            other.effect
            for key, other in self.records.items()
            if key != number and other.effect is not None and not other.retracted
        ]
        self._naming = True
        declared = [effect for effect in effects if isinstance(effect, Effect)]
        self._background.submit(
            worker.name_change,
            self._body,
            batch,
            known(declared, others),
            change.since,
            change.ended,
            self._inputs,
            done=partial(self._named, number),
            urgency=Urgency.ASKED,
        )

    def _named(self, number: int, named: NamedChange | None, error: BaseException | None) -> None:
        self._naming = False
        if error is not None and not isinstance(error, SemiparamError):
            self._failed('naming a change', error)
        record = self.records.get(number)
        if record is not None and named is not None:
            self._inputs = named.inputs
            self.records[number] = replace(record, named=named)
            if self.records[number].retracted:
                self._retract(number)
            self._told(self.records[number])

    def _retract(self, number: int) -> None:
        self._due = [(when, other) for when, other in self._due if other != number]
        followed = None if self.detector is None else self.detector.followed
        if self.detector is not None and followed is not None and followed.change.number == number:
            self.detector.reset()
