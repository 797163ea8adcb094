"""Changes of the robot while it works: noticed as samples come, then named in the background.

What was noticed (:mod:`semiparam_ros.online.changes`) is named from the samples before and after it
(:mod:`semiparam_ros.diagnosis.change`), again and again as more of them come, beside what the model
declares and the changes that were named before.

Of samples that stand out nothing is learnt before it is told what they are, so that what was learnt
stays that of the robot before the change. Then the model follows what was told. With
``diagnosis.auto: apply`` what was named is tried beside the model instead, applied, and taken back
when it is over (:mod:`semiparam_ros.online.applied_effects`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from semiparam_ros.core.columns import ColumnBlock, CoupledColumns
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.model import Model
from semiparam_ros.core.prediction import Prediction
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import Span, place
from semiparam_ros.effects.loads import Payload, ToolExchange
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online import diagnosis_jobs
from semiparam_ros.online.applied_effects import AppliedEffects, KnownEffect
from semiparam_ros.online.change_record import (
    APPLIED,
    ASSUMED,
    DROPPED,
    LEARNT,
    TAKEN_BACK,
    TRIED,
    ChangeRecord,
    Decision,
)
from semiparam_ros.online.changes import ChangeDetector
from semiparam_ros.online.followed_change import Change, Followed
from semiparam_ros.online.history import History
from semiparam_ros.online.identified_parameters import Load
from semiparam_ros.online.learning import Learning, learning_after
from semiparam_ros.online.motion_block import BLOCK_S, MotionBlock
from semiparam_ros.online.worker import Background, Urgency

if TYPE_CHECKING:
    from semiparam_ros.diagnosis.named_change import NamedChange

BEFORE_S = 60.0
"""So much of what came before a change is looked at, pauses not counted."""
MORE_MOTION = 1.5
"""What a load is, is estimated anew after so many times as much motion."""
NAMED_AFTER_S = tuple(6.0 * MORE_MOTION**times for times in range(6))
"""[s of motion] So long after it began a change is named, and named anew: 6 to 46 s."""
MOST_RECORDS = 50
"""The latest changes are kept."""

STATES = (
    'not looked for',
    'learns what is usual',
    'as it was',
    'touched, or changing',
    'changed',
    'changed, and allowed for',
)
QUIET = (*STATES[:3], STATES[5])
"""States in which nothing is wrong."""
NAMED_TWICE = 2
"""Namings without an effect after which a change is learnt."""
HELD_S = 30.0
"""[s of motion] What stands out is kept from being learnt no longer; as much motion in which nothing
does makes up for it."""


class Contacts:
    """Stretches of motion [ns] that stood out and were over without a change: what touched the
    robot then is no part of what its outputs are before and after a change."""

    def __init__(self) -> None:
        self.over: deque[tuple[int, int]] = deque(maxlen=MOST_RECORDS)
        self._since: int | None = None

    def see(self, block: MotionBlock, touched: bool, told: bool) -> None:
        """One block is finished.

        :param touched: whether it stands out. :param told: whether it was a change all the same.
        """
        if told:
            self._since = None
        elif touched:
            began = block.start - round(BLOCK_S * NANOSECONDS)  # what stands out began a little before
            self._since = began if self._since is None else self._since
        else:
            self.end(block.end)

    def end(self, stamp: int) -> None:
        """End what stood out, or is looked at no longer, at a stamp [ns]."""
        if self._since is not None:
            self.over.append((self._since, stamp))
            self._since = None

    def reset(self) -> None:
        """Forget them, as after a jump of the clock."""
        self.over.clear()
        self._since = None


def _identity(effect: Effect | None) -> tuple[str, str | None] | None:
    return None if effect is None else (effect.kind, effect.where)


def known(declared: Sequence[Effect], named: Sequence[Effect]) -> tuple[Effect, ...]:
    """Effects that are declared or were named, each once: with its end, where one is known."""
    found: dict[tuple[str, str | None, float | None], Effect] = {}
    for effect in (*declared, *named):
        identity = effect.kind, effect.where, effect.span.start_stamp_s
        if identity not in found or effect.ends:
            found[identity] = effect
    return tuple(found.values())


class LearntChange(NamedTuple):
    """A change that the model has followed: its number, None where nobody has told it; how; and
    whether the model has it, or has returned from it."""

    number: int | None
    learning: Learning
    there: bool = True


class ChangeWatch:
    """Notices changes of one robot, has them named, and applies what was named.

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
        self.applies = False
        """Whether what was named is applied (``diagnosis.auto: apply``)."""
        self.applied = AppliedEffects(body)
        self.holds = self.begins_to_hold = False
        """Whether the next sample is not to be learnt, and whether it is the first one."""
        self.follows: Learning | None = None
        """What follows with the next sample that is learnt, the first one of a robot that has changed."""
        self._waited: int | None = None
        """Number of the change that it is, where no detector follows that any more."""
        self._assumed = 0, 0
        """The change whose load is taken off before it is named, and of how many blocks it is."""
        self._body, self._background, self._told, self._failed = body, background, told, failed
        self._columns: CoupledColumns | None = None
        self._held_s = self._moved_s = 0.0
        """Motion that was held, less what made up for it, and that was judged so far."""
        self._due: list[tuple[float, int]] = []
        """After how much motion [s] changes of these numbers are named next."""
        self._naming, self._contacts = False, Contacts()
        self._past = 0
        """Number of the last change from before the clock jumped: stamps of those mean another time."""
        self._forgotten = 0
        """The largest number of a change that turned out to be a part of another one: no other one gets it."""
        self._inputs: bytes | None = None
        """How the samples of this robot are best prepared, once that is known."""
        self._now = 0
        """[ns] The newest sample."""
        self._anew_at: int | None = None
        """[ns] When the model last returned, or began anew with the contact gate; None where the clock jumped since."""
        self._learnt = list[LearntChange]()
        """The latest, as many as the model knows what was before."""
        self._first: int | None = None
        """[ns] The first sample since then: of those before it is not known what was there."""

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
        if self.applied.applied:
            return STATES[5]
        return STATES[2] if detector.knows else STATES[1]

    @property
    def contacts(self) -> tuple[tuple[int, int], ...]:
        """The latest stretches of motion [ns] in which the robot was touched, and did not change."""
        return tuple(self._contacts.over)

    @property
    def latest(self) -> ChangeRecord | None:
        """Record of the change noticed last; None before any."""
        records = self.records.values()
        return max(records, key=lambda record: record.change.number, default=None)

    @property
    def sentence(self) -> str:
        """For people: what the latest change is while it lasts, and the state at any other time."""
        latest, state = self.latest, self.state
        if latest is not None and state in STATES[4:] and latest.change.ended is None:
            return latest.sentence
        there = [place(trial.effect.kind, trial.effect.where) for trial in self.applied.applied]
        which = f' ({", ".join(there)})' if state == STATES[5] else ''
        last = '' if latest is None else f' The latest change: {latest.sentence}'
        return f'the robot: {state}{which}.{last}'

    @property
    def picked(self) -> tuple[bool, Load | None]:
        """Return whether a load was picked up or put down, and what is there of it, as far as that is known."""
        loads = [
            Load(str(trial.effect.where), trial.coefficients, np.diag(trial.std**2))
            for trial in self.applied.applied
            if trial.effect.is_load
        ]
        followed = self._followed
        record = None if followed is None else self.records.get(followed.change.number)
        if record is not None and record.named is not None and record.effect is not None:
            if record.effect.is_load:  # what is over was there before, and is no more
                values, std = record.named.coefficients
                values = -values if record.effect.ends else values
                loads.append(Load(str(record.effect.where), values, np.diag(std**2)))
        elif self.detector is not None and record is not None and record.change.kind == Payload.kind:
            if self.detector.load is None:
                return True, None
            loads.append(self.detector.load)
        if not loads:
            return False, None
        parts = [load for load in loads if load.link == loads[0].link]
        return True, Load(
            loads[0].link,
            np.sum([load.parameters for load in parts], axis=0),
            np.sum([load.covariance for load in parts], axis=0),
        )

    @property
    def _followed(self) -> Followed | None:
        return None if self.detector is None else self.detector.followed

    def begin(self) -> None:
        """Go on with an estimator that has not learnt what the one before did; what was told stays."""
        self.reset()
        self.forget()
        self._learnt, self._held_s = [], 0.0

    def forget(self) -> None:
        """Another model predicts, of which nothing is known yet; what was told stays."""
        self.detector = self._columns = None
        self.holds, self.follows, self._waited = False, None, None
        self.applied.assume(None)
        self.applied.settle()
        self._contacts.end(self._now)

    def reset(self) -> None:
        """Drop what is half seen, as after a jump of the clock: what came before is no longer there
        to name a change from."""
        self.follows = self._anew_at = self._waited = None
        self.applied.reset()
        self._contacts.reset()
        self._due, self._past, self._first = [], max(self.records, default=0), None
        if self.detector is not None:
            self.detector.reset()

    def see(self, estimator: Estimator, prediction: Prediction, history: History) -> None:
        """Take one predicted sample into account, before it is learnt."""
        self._first = prediction.sample.stamp if self._first is None else self._first
        part = estimator.rigid_body_part(prediction) if prediction.ready else None
        if part is None:
            self.forget()
            return
        detector = self._detector_of(estimator.columns)
        change = detector.see(*self._as_told(*part), self.applied.added, self.applied.spread, estimator.kept.distance)
        self._now = prediction.sample.stamp
        block = detector.finished
        self._moved_s += BLOCK_S * (block is not None)
        if block is not None:
            self._contacts.see(block, detector.touched, change is not None)
        if change is not None:
            new = change.ended is None and change.number not in self.records
            learnt = self._anew_at is not None and change.since <= self._anew_at <= self._now
            if new and not self.applies and not learnt:
                self.follows = learning_after(change.kind)
            elif change.ended is not None:  # before anything of it was learnt, as where learning is paused
                self.follows = None
            if new and learnt and self._learnt and self._learnt[-1].number is None:
                self._learnt[-1] = self._learnt[-1]._replace(number=change.number)
            self._record(change)
        if block is not None and detector.judges:
            self._judge(detector, block)
        elif detector.weighed:
            self.applied.compare(*detector.weighed, self.applies)
        if block is not None and detector.knows:
            held = self.holds
            self._hold(detector, change is not None)
            self.begins_to_hold = self.holds and (self.begins_to_hold or not held)
            self._assume(detector)
        elif block is not None:  # it learns anew what is usual, so what stood out is learnt
            self.holds = False
        if self._due and not self._naming and self._moved_s >= self._due[0][0]:
            self._name(self._due.pop(0)[1], history, estimator.columns.effects)

    def _judge(self, detector: ChangeDetector, block: MotionBlock) -> None:
        """Apply what the blocks speak for, take back what they speak against, drop the rest."""
        applied, now = self.applied, block.end
        trial = applied.judge(block, detector.innovation_noise, detector.usual_squares, self.applies)
        if trial is not None and not self._surpassed(detector, trial):
            self._switch(detector, trial, now)
        for trial in applied.unsupported():
            applied.drop(trial.number)
            self._decide(trial.number, Decision(DROPPED, now, trial.score))

    def _surpassed(self, detector: ChangeDetector, trial: KnownEffect) -> bool:
        """Return whether something else may as well have happened as that an effect that is known came
        again, or went: a contact, or another load."""
        if not (trial.applied or trial.remembered):
            return False
        row, came = self.applied.trials.index(trial), not trial.applied
        if detector.contact_rather(row, came, trial.since, trial.leaves):
            return True
        likeliest = detector.likeliest() if came else None
        return likeliest is not None and likeliest.evidence > 0.0

    def _switch(self, detector: ChangeDetector, trial: KnownEffect, now: int) -> None:
        """Take what stood out for this effect that came, or went: go on with the model as it was."""
        score, since = trial.score, trial.since
        came_again = trial.remembered and not trial.applied
        share = trial.share if trial.applied else None
        known = self.records.get(trial.number)
        beside = None if detector.followed is None else detector.followed.change.number
        self.applied.switch(trial, now)
        decision = Decision(APPLIED if trial.applied else TAKEN_BACK, now, score, share)
        stood_out = None if beside in (None, trial.number) else self._forget_record(beside)
        if known is None or came_again:
            detector.number += beside is None
            known = self._record_of(trial, known, detector.number, since, now)
            trial.number = detector.number
        if stood_out is not None and stood_out.change.number != trial.number:
            self._told(replace(stood_out, part_of=trial.number))
        trial.reference = detector.reference if trial.applied else trial.reference
        detector.resume(trial.reference)
        record = replace(known, decisions=(*known.decisions, decision))
        self.records[trial.number] = record
        if trial.applied:
            self._told(record)
        else:
            self._record(record.change._replace(noticed=now, ended=since))

    def _record_of(
        self, trial: KnownEffect, known: ChangeRecord | None, number: int, since: int, now: int
    ) -> ChangeRecord:
        """Record of an effect that comes again, or that was there before the node began."""
        effect = trial.effect
        begun = since if trial.applied or known is not None else self.applied.begun(trial, since)
        change = Change(number, begun, now, effect.kind, effect.where, np.nan, np.nan, trial.score, ())
        if known is None:
            span = Span(start_stamp_s=begun / NANOSECONDS)
            return ChangeRecord(change, restored=replace(effect, span=span))
        outputs, named = known.change.outputs, known.named
        if named is not None and named.effect is not None:
            span = Span(start_stamp_s=since / NANOSECONDS)
            named = replace(named, effect=replace(named.effect, span=span))
        return ChangeRecord(change._replace(outputs=outputs), named)

    def _forget_record(self, number: int) -> ChangeRecord | None:
        """It was no change of its own, but another one that was over, or came again."""
        self._name_no_more(number)
        self.applied.drop(number)
        self._forgotten = max(self._forgotten, number)
        return self.records.pop(number, None)

    def _name_no_more(self, number: int) -> None:
        self._due = [(when, other) for when, other in self._due if other != number]

    def _decide(self, number: int, decision: Decision) -> None:
        record = self.records.get(number)
        if record is not None:
            self.records[number] = replace(record, decisions=(*record.decisions, decision))
            self._told(self.records[number])

    def _hold(self, detector: ChangeDetector, now: bool) -> None:
        """Keep what stands out from being learnt until it is known what it is.

        :param now: whether a change was told just now.
        """
        followed = detector.followed
        told = followed is not None and not self.applies  # it is learnt
        waits = followed is not None and not told and self._waits(followed.change.number)
        if followed is not None and told and self.holds and not now:  # it waited to be applied, which nothing is now
            self.follows = learning_after(followed.change.kind)
        if told or not (detector.stands_out or waits):
            self.holds, self._held_s = False, max(self._held_s - BLOCK_S, 0.0)
        elif self._held_s >= HELD_S:
            self._learn()
        elif followed is None or waits:
            self.holds, self._held_s = True, self._held_s + BLOCK_S
        elif self.holds:
            self._learn()
            self._decide(followed.change.number, Decision(LEARNT, self._now))

    def _learn(self) -> None:
        """Let the model learn what no effect of the robot explains; with it another error is usual."""
        self.holds, self._held_s, self.follows = False, 0.0, Learning.AFTER_CHANGE
        self.applied.assume(None)
        self.applied.settle()
        if self.detector is not None:
            self.detector.learn_usual()

    def _as_told(self, prediction: Prediction, model: Model) -> tuple[Prediction, Model]:
        """Return what the detector judges: without what is applied, and nothing else. It follows a load itself."""
        sample, applied = prediction.sample, self.applied
        if applied.provisional is None and not applied.ahead.any():
            return prediction, model
        sample = sample._replace(outputs=sample.outputs + applied.provisional_added + applied.taken_ahead)
        return prediction._replace(sample=sample), model

    def _assume(self, detector: ChangeDetector) -> None:
        """Take off a load that was told, as long as it waits for its name."""
        followed, load = detector.followed, detector.load if self.holds else None
        record = None if followed is None else self.records.get(followed.change.number)
        if followed is None or record is None or load is None or self.applied.ahead.any() or (record.times_named and (
            record.effect is None or not record.effect.is_load
        )):
            self.applied.assume(None)
            return
        number, blocks = self._assumed
        enough = followed.blocks >= MORE_MOTION * blocks or self.applied.provisional is None
        if number == followed.change.number and not enough:
            return
        self._assumed = followed.change.number, followed.blocks
        self.applied.assume(load)
        if number != followed.change.number:
            self._decide(followed.change.number, Decision(ASSUMED, self._now))

    def _waits(self, number: int) -> bool:
        """Return whether a change is still to be named, or tried, or may be over yet."""
        record = self.records.get(number)
        if record is None or any(decision.what == DROPPED for decision in record.decisions):
            return False
        unknown = not record.change.kind  # it may be a contact that lasts
        return unknown or record.times_named < NAMED_TWICE or self.applied.of_change(number) is not None

    def _try(self, record: ChangeRecord) -> None:
        """Let an effect that was named predict beside the model."""
        effect, named, number = record.effect, record.named, record.change.number
        if effect is None or named is None or not self.applies or number <= self._past:
            return
        if effect.from_outside:
            return
        values, std = named.coefficients
        if effect.ends and record.change.ended is None:
            others = [trial.effect for trial in self.applied.trials]
            if not effect.is_load or effect.without_span() in others:
                return
            # put down was what the model has learnt with the arm, which is another one without it
            effect, values = ToolExchange(effect.where), -values
        followed = self._followed
        waits = followed is not None and followed.change.number == number and self.holds
        known = self.applied.of_change(number) is not None
        if (waits or known) and self.applied.offer(number, effect, values, std, self._now):
            self._decide(number, Decision(TRIED, self._now))

    def _detector_of(self, columns: CoupledColumns) -> ChangeDetector:
        """Detector of a model, which goes on where the model's columns are those that it had."""
        known, followed = self._columns, self._followed if self.holds else None
        if (
            self.detector is None
            or known is None
            or known.n_own != columns.n_own
            or known.physical != columns.physical
            or (followed is not None and known.effects != columns.effects)
        ):
            self.forget()  # what stood out of another model keeps nothing from being learnt
            if followed is not None:
                self.follows, self._waited = learning_after(followed.change.kind), followed.change.number
            self.detector = ChangeDetector(columns, max(self._forgotten, *self.records, 0))
        elif known.effects != columns.effects:
            self.detector.reset()
        self._columns = columns
        return self.detector

    def _record(self, change: Change) -> None:
        known = self.records.get(change.number)
        anew = known is None or known.change.since != change.since
        record = replace(known, change=change) if known and not anew else ChangeRecord(change)
        self.records[change.number] = record
        for number in list(self.records)[:-MOST_RECORDS]:
            del self.records[number]
        if (anew or change.ended is not None) and change.number > self._past:
            self._name_no_more(change.number)
            moved_s = 0.0 if self._followed is None else BLOCK_S * self._followed.blocks
            times = NAMED_AFTER_S if change.ended is None else (moved_s,)
            self._due += [(self._moved_s - moved_s + seconds, change.number) for seconds in times]
        self._due.sort()
        self._told(record)

    def _name(self, number: int, history: History, effects: Sequence[ColumnBlock]) -> None:
        """Ask the background what it was, beside all else that is known."""
        record = self.records.get(number)
        if record is None:
            return
        change = record.change
        touched = change.touched or change.since
        batch = history.around(touched, BEFORE_S)
        batch = batch.part(int(np.searchsorted(batch.stamps, self._first or 0)))
        others = [
            other.effect
            for key, other in self.records.items()
            if self._past < key != number and other.effect is not None and not other.retracted
        ]
        self._naming = True
        declared = [effect for effect in effects if isinstance(effect, Effect)]
        self._background.submit(
            diagnosis_jobs.name_change,
            self._body,
            batch,
            known(declared, others),
            (touched, change.since),
            change.ended,
            self._inputs,
            tuple(self.applied.contributions),
            (*self.contacts, *self._unnamed_beside(number)),
            done=partial(self._named, number, asked=change.ended),
            urgency=Urgency.ASKED,
        )

    def _unnamed_beside(self, number: int) -> list[tuple[int, int]]:
        """Stretches [ns] of other changes without a name, which are over, or came later and were not looked at
        yet: they tell of a change only beside what else is there then."""
        found = []
        for key, other in self.records.items():
            change, ended = other.change, other.change.ended
            unnamed = other.effect is None and (other.brief or not other.retracted)
            later = key > number and not other.times_named
            if self._past < key != number and unnamed and (later or ended is not None):
                found.append((change.touched or change.since, self._now if ended is None else ended))
        return found

    def _named(
        self,
        number: int,
        named: NamedChange | None,
        error: BaseException | None,
        asked: int | None = None,
    ) -> None:
        """Take what a change was named; ``asked`` [ns] is its end as it was known then."""
        self._naming = False
        if isinstance(error, SemiparamError):
            self._refused(number, str(error))
        elif error is not None:
            self._failed('naming a change', error)
        record = self.records.get(number)
        if record is not None and named is not None:
            self._inputs = named.inputs
            trial = self.applied.of_change(number)
            doubted = trial is not None and trial.applied and trial.score > 0.0
            if doubted or record.change.ended != asked:  # it was over in some of the samples
                self._ask_again(number, NAMED_AFTER_S[0])
                return
            if (over := self._ended_by(number, named.effect)) is not None:
                self._end(over, number)
                return
            if record.was_applied and _identity(named.effect) != _identity(record.effect):
                named = record.named  # what predicts is what is told
            record = replace(record, named=named, times_named=record.times_named + 1, unnamed='')
            self.records[number] = record
            if record.retracted:
                self._retract(number)
            self._told(record)
            self._try(record)

    def _ended_by(self, number: int, effect: Effect | None) -> int | None:
        """The change that was learnt and is over, where a later one is named as that."""
        if effect is None or not effect.ends:
            return None
        for other, record in self.records.items():
            known, trial = record.effect, self.applied.of_change(other)
            if (self._past < other < number and known is not None and not known.ends and not (trial and trial.applied)
                    and known.without_span() == effect.without_span()
                    and known.span.start_stamp_s == effect.span.start_stamp_s):
                return other
        return None

    def began_anew(self, learning: Learning, told: bool) -> None:
        """The model has followed a change, of which nobody has told where the contact gate gave way to it."""
        followed = self._followed
        number = (self._waited if followed is None else followed.change.number) if told else None
        self._learnt, self._waited = [*self._learnt[-1:], LearntChange(number, learning)], None
        if not told:
            self._anew_at = self._now

    def returned(self, since: int) -> None:
        """The model has changed places with the one from before the last change that it learnt.

        Where the model had that one, it is over, since what was just told or since then; else it came
        again. Where nobody has told it, or it was taken back, there is nothing to tell.

        :param since: [ns] since when it is better.
        """
        self._anew_at = self._now
        followed, detector = self._followed, self.detector
        known = self._learnt.pop() if self._learnt else LearntChange(None, Learning.AFTER_CHANGE)
        if known.learning != Learning.AFTER_CHANGE or not self._learnt:  # else the model has forgotten it
            self._learnt.append(known._replace(there=not known.there))
        record = None if known.number is None else self.records.get(known.number)
        if detector is None:
            return
        told = record is not None and not record.retracted and not record.was_applied
        if record is not None and told and followed is not None and followed.change.number != known.number:
            if record.change.ended is None:
                self._end(record.change.number, followed.change.number)
            elif not known.there:
                self._learnt[-1] = self._learnt[-1]._replace(number=followed.change.number)
            return
        if record is not None and told and known.there and record.change.ended is None:
            self._record(record.change._replace(noticed=self._now, ended=since))
        elif record is not None and told and not known.there:
            detector.number += 1
            self._learnt[-1] = self._learnt[-1]._replace(number=detector.number)
            self._record(record.change._replace(number=detector.number, since=since, noticed=self._now,
                                                ended=None, touched=since))
        if told or followed is None:
            detector.reset()

    def _end(self, number: int, by: int) -> None:
        """A change that was learnt is over since another one began, which is none of its own."""
        ended, record = self.records[by].change.since, self.records[number]
        self._told(replace(self.records[by], part_of=number))
        self._forget_record(by)
        if self.detector is not None and self._followed is not None and self._followed.change.number == by:
            self.detector.reset()
        self._record(record.change._replace(noticed=self._now, ended=ended))

    def _ask_again(self, number: int, seconds: float) -> None:
        """Name a change anew after so much motion, unless that is due anyway, or the clock has jumped since."""
        if number > self._past and all(other != number for _, other in self._due):
            self._due = sorted([*self._due, (self._moved_s + seconds, number)])

    def _refused(self, number: int, why: str) -> None:
        """Say once why a change has no name, and ask again when more of it has come."""
        record = self.records.get(number)
        if record is None:
            return
        if record.change.ended is None:
            self._ask_again(number, NAMED_AFTER_S[-1])
        self.records[number] = replace(record, unnamed=why)
        if not record.unnamed and record.named is None:
            self._told(self.records[number])

    def _retract(self, number: int) -> None:
        self._name_no_more(number)
        self.applied.drop(number)
        followed = self._followed
        if self.detector is None or followed is None or followed.change.number != number:
            return
        if self.applies:
            self._learn()
        else:
            self.detector.reset()
