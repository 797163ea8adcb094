"""Effects of known coefficients beside the model: tried, applied, taken back.

A change of the robot that was named is an effect with coefficients theta. What it adds to the
outputs, k = C(x) theta, is taken off them before the model sees them and added to what the model
predicts, as that of a known tool (:mod:`semiparam_ros.core.robot.tools`). So the model stays that
of the robot before the change, and nothing is relearnt when the change is over.

Whether an effect is there is asked of every quarter of a second b of motion. With r what the model
leaves of the outputs, without the effects that are applied, S = diag(s) its standard deviations and
kappa the usual size of what r / s has (:mod:`semiparam_ros.online.changes`),

    d_b = sum (r' S^-2 r - r~' S^-2 r~) / (2 kappa),    r~ = r - k, or r + k where it is applied,

is the log evidence [nat] for the other state: applied or not. The cumulative sum test of Page
(1954, Biometrika 41) switches when

    g <- max(0, g + d_b)

exceeds ``SURE``, and g was last zero when it came or went. One that is tried begins with g = 0 after
it was named: only what comes then speaks for it. One that is known, as it is or was applied, comes
or goes only where a contact is less likely (:meth:`~semiparam_ros.online.changes.ChangeDetector.contact_rather`).

That takes a second, in which a load that was put down would throw the arm about. So what predicts goes
ahead of what is told: each sample is charged to what is known (:mod:`semiparam_ros.core.alternative`),
which is taken off, or no more, as soon as that is clearly better. A hand that pushes like a load is
predicted so while it lasts, and neither told nor learnt.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, cast

import numpy as np

from semiparam_ros.core.alternative import Alternative
from semiparam_ros.core.columns import ColumnBlock, CoupledColumns, Memories, Memory
from semiparam_ros.core.robot.frames import load_in_base
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.core.types import Array
from semiparam_ros.effects import Effect, effect_from_text, effect_to_text
from semiparam_ros.effects.base import STAMP_TOLERANCE_NS, Span
from semiparam_ros.effects.loads import Payload
from semiparam_ros.online.changes import SURE
from semiparam_ros.online.identified_parameters import Load
from semiparam_ros.online.motion_block import BLOCK_S, MotionBlock, gained
from semiparam_ros.online.wandering_contact import CONTACT_S

TRIED_S = 30.0
"""[s of motion] An effect for which nothing speaks so long is dropped."""
REMEMBERED = 4
"""So many that were applied, and are over, are known at once when they come again; of those that
are no load, none that was over as soon as a contact is."""
MOST_CONTRIBUTIONS = 100
LARGEST = 1e9


class Contribution(NamedTuple):
    """An effect with the span in which it was taken off, and its coefficients (c,)."""

    effect: Effect
    coefficients: Array
    shaping: tuple[Effect, ...] = ()
    """Declared effects that shaped its columns."""

    def outputs(self, body: RigidBody, corrected: tuple[RigidBody, Samples]) -> Array:
        """(N, n) what it adds to samples, which the shaping effects have corrected."""
        columns = CoupledColumns(body, (*self.shaping, self.effect))
        return np.asarray(columns.of_effect(len(self.shaping), *corrected) @ self.coefficients)


@dataclass
class KnownEffect:
    """One effect, of the change with a number, that is applied, tried or remembered."""

    number: int
    effect: Effect
    coefficients: Array
    std: Array
    """(c,) standard deviations of the coefficients."""
    applied: bool = False
    acting: bool = False
    """Whether it is taken off now: as ``applied``, or already otherwise."""
    remembered: bool = False
    """It was applied before, and is over."""
    taken_back: int = 0
    """Counts those that were taken back, in that order; 0 where it never was."""
    score: float = 0.0
    """g [nat]"""
    since: int = 0
    """[ns] when the first block began that spoke for it."""
    begun: int | None = None
    """[ns] when it was applied; None where that was long ago, or before a jump of the clock."""
    tried_s: float = 0.0
    reference: Array | None = None
    """(p,) coefficients of the model from before it was applied."""
    squares: Array = field(default_factory=lambda: np.zeros((2, 1)))
    """(2, n) weighed squares of what is left with it and without it, while it is there."""

    leaves: Array = field(default_factory=lambda: np.zeros(1))
    """(n,) ``shares`` when it was last there, and nothing spoke against it."""
    otherwise: Alternative = field(default_factory=Alternative)
    """Evidence that it went, or came again, sample by sample."""
    shaping: tuple[Effect, ...] = ()
    """Declared effects beside which it was named, which shape its columns."""

    @property
    def share(self) -> float:
        """The error of all outputs with it over that without it; 0 before anything is known."""
        with_it, without = self.squares.sum(axis=1)
        return float(np.sqrt(with_it / without)) if without > 0.0 else 0.0

    @property
    def shares(self) -> Array:
        """(n,) the same of each output."""
        with_it, without = self.squares
        return np.sqrt(with_it / np.maximum(without, 1e-300))


class AppliedEffects:
    """Applied effects of one robot, the foremost first."""

    def __init__(self, body: RigidBody) -> None:
        self._body = body
        self.trials: list[KnownEffect] = []
        self.contributions: list[Contribution] = []
        """All that was taken off, for those who need the samples as measured."""
        self.turns = 0
        """How often something else was taken off from then on."""
        self.provisional: Load | None = None
        """A load that was told and has no name yet."""
        self.provisional_added: Array = np.zeros(body.n_outputs)
        """(n,) what that adds to the newest sample."""
        self._stamp = 0
        self.added: Array = np.zeros((0, body.n_outputs))
        """(m, n) k of each trial, of the newest sample."""
        self._columns = list[CoupledColumns]()
        """Of those that are shaped alike, together."""
        self._places = list[tuple[int, slice]]()
        """Group and columns of each trial; then of the provisional load."""
        self._memory = list[Memories]()
        self._newest = list[Array]()
        """(n, c) columns of each group, of the newest sample."""
        self._declared: Sequence[ColumnBlock] = ()
        self._shaping: tuple[Effect, ...] = ()
        """Declared effects that shape what is named from now on."""
        self._changed()

    def shaped_by(self, declared: Sequence[ColumnBlock]) -> None:
        """Let what is named from now on be shaped as the model's own columns are, by the effects that it declares: a
        gain of the sensor multiplies a load too."""
        if declared is self._declared:
            return
        self._declared = declared
        shaping = tuple(effect for effect in declared if isinstance(effect, Effect) and not effect.only_adds)
        if shaping != self._shaping:
            self.assume(None)
            self._shaping = shaping

    @property
    def applied(self) -> list[KnownEffect]:
        """Effects that are there now."""
        return [trial for trial in self.trials if trial.applied]

    @property
    def acts(self) -> bool:
        """Return whether anything is taken off."""
        return self.provisional is not None or any(trial.acting for trial in self.trials)

    @property
    def unsaved(self) -> list[Effect]:
        """Effects that are taken off and in no state: the load that is provisional, and what is tried."""
        load = [] if self.provisional is None else [Payload(self.provisional.link)]
        return [*load, *(trial.effect for trial in self.trials if trial.acting and not trial.applied)]

    @property
    def ahead(self) -> Array:
        """(m,) of each trial 1 where it is taken off though it is not applied yet, -1 where it is applied and not
        taken off any more, else 0."""
        return np.array([float(trial.acting) - float(trial.applied) for trial in self.trials])

    @property
    def taken_ahead(self) -> Array:
        """(n,) what is taken off the newest sample beyond what is applied: it may be what a hand does."""
        return np.asarray(self.ahead @ self.added)

    def clear(self) -> None:
        """Forget all."""
        self.trials, self.contributions, self.provisional = [], [], None
        self._changed()

    def assume(self, load: Load | None) -> None:
        """Take this load off from the next sample on, in place of the one before."""
        before, self.provisional = self.provisional, load
        if before is not None:
            self._end_contribution(Payload(before.link), before.parameters, self._stamp)
        if load is not None:
            self._begin_contribution(Payload(load.link), load.parameters, self._stamp, self._shaping)
        if before is not None or load is not None:
            self._changed()

    def reset(self) -> None:
        """Forget what effects remember and what speaks for a switch, as after a jump of the clock;
        what is applied stays, and is taken off all samples from now on."""
        self._memory = [None] * len(self._columns)
        self.assume(None)
        self.contributions = [Contribution(each.effect, each.coefficients, each.shaping) for each in self.applied]
        for trial in self.trials:
            trial.score, trial.begun, trial.acting = 0.0, None, trial.applied
            trial.otherwise.clear()

    def taken_off(self, sample: Sample) -> tuple[Sample, Array | None]:
        """The sample without what is applied, and that (n,); None where nothing is."""
        self._stamp = sample.stamp
        if not self.trials and self.provisional is None:
            return sample, None
        found = [columns.one(sample, 0, memory) for columns, memory in zip(self._columns, self._memory, strict=True)]
        self._newest, self._memory = [each[0] for each in found], [each[1] for each in found]
        self.added, self.provisional_added = self._added(self._newest)
        if not self.acts:
            return sample, None
        total = self._of_acting(self.added) + self.provisional_added
        return sample._replace(outputs=sample.outputs - total), total

    def desired(self, position: Array, velocity: Array, acceleration: Array) -> tuple[Array, Array]:
        """(n,) what is applied adds to a desired state, as the sensor shows it, and as the arm needs
        it."""
        found = [columns.desired(position, velocity, acceleration, 0, 0) for columns in self._columns]
        both = [self._added([each[number] for each in found]) for number in range(2)]
        shown, needed = (self._of_acting(added) + more for added, more in both)
        return shown, needed

    @property
    def spread(self) -> Array:
        """(n,) standard deviation of what is applied, as it was told, for the newest sample: that of theta, and what
        errors of the inputs leave of k, which grows with k; its share is measured."""
        variance = np.zeros(self._body.n_outputs)
        for (group, block), trial, added in zip(self._places, self.trials, self.added, strict=False):
            if trial.applied:
                of_theta = (self._newest[group][:, block] ** 2) @ trial.std**2
                variance += of_theta + (trial.shares * added) ** 2
        return np.sqrt(variance)

    def bodies_and_bias(self) -> tuple[Array, Array]:
        """(p,) base parameters of the loads that are applied, and (n,) what is the sensor's own, of
        the newest sample."""
        body = self._body
        bodies, bias = np.zeros(body.n_parameters), np.zeros(body.n_outputs)
        for trial, added in zip(self.trials, self.added, strict=True):
            if trial.acting and trial.effect.is_load:
                bodies += load_in_base(body, str(trial.effect.where), trial.coefficients)
            elif trial.acting and trial.effect.of_sensor:
                bias += added
        if self.provisional is not None:
            bodies += load_in_base(body, self.provisional.link, self.provisional.parameters)
        return bodies, bias

    def of_change(self, number: int) -> KnownEffect | None:
        """Effect of the change with a number."""
        return next((trial for trial in self.trials if trial.number == number), None)

    def begun(self, trial: KnownEffect, otherwise: int) -> int:
        """[ns] since when it has been taken off, or was last; ``otherwise`` where that is not known."""
        starts = [
            effect.span.start_stamp_s
            for effect, values, _ in self.contributions
            if effect.without_span() == trial.effect and np.array_equal(values, trial.coefficients)
        ]
        return otherwise if not starts or starts[-1] is None else round(starts[-1] * NANOSECONDS)

    def offer(
        self, number: int, effect: Effect, coefficients: Array, std: Array, now: int
    ) -> bool:
        """Take an effect and its coefficients (c,) from ``now`` [ns] on as that of a change; whether
        it is to be tried from now on. One that is applied, or was, keeps its kind; each keeps its place,
        in which blocks have what it adds."""
        effect, known = effect.without_span(), self.of_change(number)
        if known is None or not (known.applied or known.remembered):
            tried = KnownEffect(number, effect, coefficients, std, since=now, shaping=self._shaping)
            kept = [tried if trial is known else trial for trial in self.trials]
            self._keep(kept if known is not None else [*kept, tried])
            return True
        if (known.effect.kind, known.effect.where) == (effect.kind, effect.where):
            if known.acting:
                self._end_contribution(known.effect, known.coefficients, now)
                self._begin_contribution(effect, coefficients, now, self._shaping)
            known.effect, known.coefficients, known.std = effect, coefficients, std
            known.shaping = self._shaping
            self._changed()
        return False

    def drop(self, number: int) -> None:
        """Try the effect of a change no more; one that is applied stays."""
        self._keep(trial for trial in self.trials if trial.number != number or trial.applied)

    def compare(self, innovation: Array, weight: Array, applies: bool = True) -> None:
        """Charge the newest sample to what is or was applied, and take off from the next one on what came again, no
        more what went. Whether that is so is told by :meth:`judge`: a hand may push like a load for a while.

        :param innovation: (n,) without what is applied, in units of its usual size, by which ``weight`` (n,) weighs
            outputs.
        :param applies: False: nothing comes again.
        """
        if self.provisional is not None:
            return
        each = self.added * weight
        now = innovation - self.ahead @ each
        for trial, added in zip(self.trials, each, strict=True):
            if not (trial.applied or trial.acting or (trial.remembered and applies)):
                continue
            then, seconds = now + added if trial.acting else now - added, trial.otherwise.elapsed(self._stamp)
            if trial.otherwise.charge(seconds, now, then, np.ones_like(now)):
                self._turn(trial, self._stamp)
                break

    def settle(self, now: int | None = None) -> None:
        """Take off what is applied, and nothing else, from the sample after ``now`` [ns] on, which is the newest one
        unless given."""
        for trial in self.trials:
            if trial.acting != trial.applied:
                self._turn(trial, self._stamp if now is None else now)

    def _turn(self, trial: KnownEffect, now: int) -> None:
        """Take it off from the sample after ``now`` [ns] on, or no more."""
        trial.acting = not trial.acting
        if trial.acting:
            self._begin_contribution(trial.effect, trial.coefficients, now, trial.shaping)
        else:
            self._end_contribution(trial.effect, trial.coefficients, now)
        for other in self.trials:
            other.otherwise.clear()

    def judge(
        self, block: MotionBlock, noise: float, usual: float, applies: bool = True
    ) -> KnownEffect | None:
        """Take a finished block into account; the trial whose other state it now speaks for.

        :param noise: kappa of a usual block. :param usual: the weighed squares that one has.
        :param applies: False: those that are applied alone may switch.
        """
        squares, power = block.own[-1], float(block.own[-1].sum())
        for trial, added in zip(self.trials, block.added, strict=True):
            gains = gained(added, came=not trial.applied)
            gain = float(gains.sum())
            there = (squares, squares - gains)
            if trial.applied:
                trial.squares = trial.squares + there
            elif trial.score > 0.0:
                trial.squares = trial.squares + there[::-1]
            kappa = noise * max((power - max(gain, 0.0)) / usual, 1.0)
            trial.since = block.start if trial.score == 0.0 else trial.since
            trial.score += gain / (2.0 * kappa)
            trial.tried_s += BLOCK_S * (not trial.applied and not trial.remembered)
            if trial.score <= 0.0:
                trial.score = 0.0
                trial.squares = trial.squares * trial.applied
                trial.leaves = trial.shares if trial.applied else trial.leaves
        may_switch = self.trials if applies else self.applied
        best = max(may_switch, key=lambda trial: trial.score, default=None)
        return best if best is not None and best.score > SURE else None

    def switch(self, trial: KnownEffect, now: int) -> None:
        """Apply it from the sample after ``now`` [ns] on, or take it back."""
        self.assume(None)
        trial.applied = not trial.applied
        self.settle(now)
        if trial.applied:
            trial.begun = now
        else:
            trial.remembered, trial.squares = True, np.zeros((2, 1))
            trial.taken_back = 1 + max(other.taken_back for other in self.trials)
            brief = trial.begun is not None and now - trial.begun < CONTACT_S * NANOSECONDS
            if brief and not trial.effect.is_load:
                self._keep(other for other in self.trials if other is not trial)
        for other in self.trials:
            other.score = 0.0
        over = [other.taken_back for other in self.trials if other.remembered and not other.applied]
        forgotten = sorted(over)[:-REMEMBERED]
        self._keep(other for other in self.trials if other.applied or other.taken_back not in forgotten)

    def unsupported(self) -> list[KnownEffect]:
        """Effects for which nothing has spoken as long as one is tried."""
        return [
            trial
            for trial in self.trials
            if trial.tried_s >= TRIED_S and not (trial.applied or trial.remembered)
        ]

    def state(self) -> Memory:
        """Values that :meth:`restore` takes back: what is applied or remembered, in the order in which it was taken
        back, and what was taken off. One that is provisional is noticed anew."""
        kept = [trial for trial in self.trials if trial.applied or trial.remembered]
        kept.sort(key=lambda trial: trial.taken_back)
        taken_off, load = self.contributions, self.provisional
        if load is not None:  # the model that is restored goes on without it
            taken_off = _ended(taken_off, Payload(load.link), load.parameters, self._stamp)
        for trial in self.trials:  # and with what is applied, and nothing else
            if trial.acting and not trial.applied:
                taken_off = _ended(taken_off, trial.effect, trial.coefficients, self._stamp)
            elif trial.applied and not trial.acting:
                taken_off = [*taken_off, _begun(trial.effect, trial.coefficients, self._stamp, trial.shaping)]
        return {
            'effects': tuple(effect_to_text(trial.effect) for trial in kept),
            'coefficients': tuple(np.array([trial.coefficients, trial.std]) for trial in kept),
            'applied': tuple(trial.applied for trial in kept),
            'taken_off': tuple(
                (effect_to_text(effect), coefficients.copy())
                for effect, coefficients, _ in taken_off
            ),
        }

    def restore(self, state: Memory) -> None:
        """Go on with what was saved. Raises ValueError or SemiparamError for what cannot be."""
        self.clear()
        if not isinstance(state, dict) or state.keys() != cast('dict[str, Memory]', self.state()).keys():
            raise ValueError('what is applied has other entries')
        effects, coefficients, applied, taken_off = (
            cast('tuple[Any, ...]', part) for part in state.values()
        )
        for number, (text, theta, on) in enumerate(zip(effects, coefficients, applied, strict=True)):
            if type(on) is not bool:
                raise ValueError(f"whether '{text}' is applied is {on!r}")
            (effect, values, _), (_, std, _) = (self._contribution(text, row) for row in theta)
            self.trials.append(KnownEffect(-1 - number, effect, values, std, on, acting=on, remembered=not on,
                                           taken_back=1 + number, shaping=self._shaping))
        self.contributions = [self._contribution(text, theta) for text, theta in taken_off]
        self._changed()

    def _contribution(self, text: str, theta: object) -> Contribution:
        effect = effect_from_text(text)
        effect.check(self._body)
        size = len(effect.coefficients(self._body))
        if not (
            isinstance(theta, np.ndarray)
            and theta.shape == (size,)
            and theta.dtype == np.float64
            and bool((np.abs(theta) < LARGEST).all())
        ):
            raise ValueError(f"'{text}' has not {size} coefficients")
        return Contribution(effect, theta, self._shaping)

    def _added(self, columns: Sequence[Array]) -> tuple[Array, Array]:
        """(m, n) k of each trial, and (n,) that of the provisional load, by the columns (n, c) of each group."""
        n = self._body.n_outputs
        of_each = [columns[group][:, block] for group, block in self._places]
        each = [own @ trial.coefficients for own, trial in zip(of_each, self.trials, strict=False)]
        more = np.zeros(n) if self.provisional is None else of_each[-1] @ self.provisional.parameters
        return np.array(each).reshape(len(each), n), more

    def _of_acting(self, added: Array) -> Array:
        acting = np.array([trial.acting for trial in self.trials], dtype=float)
        return np.asarray(acting @ added)

    def _keep(self, trials: Iterable[KnownEffect]) -> None:
        before, self.trials = self.trials, list(trials)
        kept = set(map(id, self.trials))
        for trial in before:
            if trial.acting and id(trial) not in kept:
                self._end_contribution(trial.effect, trial.coefficients, self._stamp)
        self._changed()

    def _changed(self) -> None:
        """The trials are others: what effects remember begins anew."""
        effects = [(trial.effect, trial.shaping) for trial in self.trials]
        if self.provisional is not None:
            effects.append((Payload(self.provisional.link), self._shaping))
        shapings, groups, places = list[tuple[Effect, ...]](), list[list[Effect]](), list[tuple[int, str]]()
        for effect, shaping in effects:
            if shaping not in shapings:
                shapings.append(shaping)
                groups.append(list(shaping))
            group = shapings.index(shaping)
            places.append((group, str(len(groups[group]))))
            groups[group].append(effect)
        self._columns = [CoupledColumns(self._body, group) for group in groups]
        self._places = [(group, self._columns[group].blocks[name]) for group, name in places]
        self._memory = [None] * len(groups)
        self._newest = [np.zeros((self._body.n_outputs, each.n_columns)) for each in self._columns]
        self.added = np.zeros((len(self.trials), self._body.n_outputs))
        self.provisional_added = np.zeros(self._body.n_outputs)

    def _begin_contribution(self, effect: Effect, coefficients: Array, now: int,
                            shaping: tuple[Effect, ...]) -> None:
        self.turns += 1
        self.contributions.append(_begun(effect, coefficients, now, shaping))
        if len(self.contributions) > MOST_CONTRIBUTIONS:  # the first that is over
            ended = [each.effect.ends for each in self.contributions]
            del self.contributions[ended.index(True) if any(ended) else 0]

    def _end_contribution(self, effect: Effect, coefficients: Array, now: int) -> None:
        self.turns += 1
        self.contributions = _ended(self.contributions, effect, coefficients, now)


def _begun(effect: Effect, coefficients: Array, now: int, shaping: tuple[Effect, ...]) -> Contribution:
    """The contribution of an effect with these coefficients (c,) that begins at ``now`` [ns]."""
    return Contribution(replace(effect, span=Span(start_stamp_s=_after(now))), coefficients, shaping)


def _ended(
    contributions: Iterable[Contribution], effect: Effect, coefficients: Array, now: int
) -> list[Contribution]:
    """Contributions of which those of an effect with these coefficients (c,) end at ``now`` [ns];
    without those that have just begun."""
    found, end_s = [], _after(now)
    for begun, values, shaping in contributions:
        same = np.array_equal(values, coefficients) and begun.without_span() == effect
        if same and not begun.ends:
            if (begun.span.start_stamp_s or 0.0) >= end_s:
                continue
            begun = replace(begun, span=replace(begun.span, end_stamp_s=end_s))
        found.append(Contribution(begun, values, shaping))
    return found


def _after(stamp: int) -> float:
    """[s] from which spans hold the samples after one at a stamp [ns]."""
    return (stamp + 2 * STAMP_TOLERANCE_NS) / NANOSECONDS


def as_measured(body: RigidBody, samples: Samples, taken_off: Iterable[Contribution]) -> Samples:
    """Samples with what was taken off them added again."""
    outputs, corrected = samples.outputs.copy(), dict[int, tuple[RigidBody, Samples]]()
    for each in taken_off:
        if id(each.shaping) not in corrected:  # regressors are remembered with the samples
            moved, inputs, _ = CoupledColumns(body, each.shaping).corrected(samples)
            corrected[id(each.shaping)] = moved, inputs
        outputs += each.outputs(body, corrected[id(each.shaping)])
    return replace(samples, outputs=outputs)
