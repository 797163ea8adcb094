"""An effect: a named physical cause with its place, its nonlinear parameters, and the columns it adds.

Three things can be asked of one. *Additive* kinds give columns whose coefficients the estimator learns. *Calibration*
kinds have no columns; their parameters move the inputs or shape the regressors, and are fitted by Gauss-Newton. And
every kind lists the places and the coarse values of its nonlinear parameters where a search should look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np

from semiparam_ros.core.columns import ColumnBlock, Memory
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import arm_size, plausible, size_of
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Mask, Stamps
from semiparam_ros.errors import SemiparamError

Values = dict[str, float]
"""Parameters, options and the times of an effect by name, as its text form has them."""
Self = TypeVar('Self', bound='Effect')
CHANNELS = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')
NO_VALUES: Values = {}
TIMES = ('start_s', 'start_stamp_s', 'end_s', 'end_stamp_s')
BRACKET = 2.5
"""A line search looks from a value over this factor to the value times it."""
CALIBRATED = {'rad': 0.1, 's': 0.05, '': 0.3}
"""Prior standard deviation of a calibration, by its unit; '' stands for a gain or a ratio."""
MOST_TIMES_PLAUSIBLE = 5.0
"""Largest load or force over what is plausible for the robot, a fifth of its own weight."""
STAMP_TOLERANCE_NS = 1000
"""A double holds today's stamps [s] to 0.24 us."""


@dataclass(frozen=True)
class Span:
    """Time in which an effect acts; without a start it always did, without an end it still does.

    :param start_s: [s] after the start of the recording (of the node's life).
    :param start_stamp_s: [s] the start by the stamps of headers.
    :param end_s: [s] end, counted as ``start_s``.
    :param end_stamp_s: [s] end, counted as ``start_stamp_s``.
    """

    start_s: float | None = None
    start_stamp_s: float | None = None
    end_s: float | None = None
    end_stamp_s: float | None = None

    @property
    def values(self) -> Values:
        """Times that are set, by the names of the text form."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def at_stamps(self, origin: int) -> Span:
        """The same by stamps alone; ``origin`` [ns] is where ``start_s`` and ``end_s`` count from."""
        def stamp(seconds: float | None, stamp_s: float | None) -> float | None:
            return stamp_s if seconds is None else (origin + round(seconds * 1e9)) / 10**9

        return Span(None, stamp(self.start_s, self.start_stamp_s), None, stamp(self.end_s, self.end_stamp_s))

    def in_recording(self, origin: int) -> Span:
        """The same by seconds after ``origin`` [ns] alone; the inverse of :meth:`at_stamps`."""
        def counted(seconds: float | None, stamp_s: float | None) -> float | None:
            stamp = nanoseconds(stamp_s)
            return seconds if stamp is None else (stamp - origin) * 1e-9

        return Span(counted(self.start_s, self.start_stamp_s), None, counted(self.end_s, self.end_stamp_s))

    def holds(self, stamps: Stamps | int, origin: int) -> Mask:
        """Mask (N,) of the stamps [ns] within; ``origin`` [ns] is where start_s and end_s count
        from."""
        inside = np.ones(np.shape(stamps), dtype=bool)
        time = np.asarray((stamps + STAMP_TOLERANCE_NS - origin) * 1e-9)  # seconds may be those of a stamp
        start, end = (nanoseconds(stamp_s) for stamp_s in (self.start_stamp_s, self.end_stamp_s))
        if self.start_s is not None:
            inside &= time >= self.start_s
        if start is not None:
            inside &= stamps >= start - STAMP_TOLERANCE_NS
        if self.end_s is not None:
            inside &= time < self.end_s
        if end is not None:
            inside &= stamps < end - STAMP_TOLERANCE_NS
        return inside

    @property
    def fault(self) -> str:
        """Sentence part that says which two times contradict each other; '' when none do."""
        for one, other in (TIMES[:2], TIMES[2:]):
            if {one, other} <= self.values.keys():
                return f'has {one} and {other}; expected one of them'
        for first, last in ((self.start_s, self.end_s), (self.start_stamp_s, self.end_stamp_s)):
            if first is not None and last is not None and not first < last:
                return f'ends at {last:g} s and begins at {first:g} s; expected an end after the start'
        return ''


def nanoseconds(stamp_s: float | None) -> int | None:
    """A stamp [s] in ns, to the nearest one."""
    return None if stamp_s is None else round(Fraction(stamp_s) * 10**9)


ALWAYS = Span()
Axis = Literal['any', 'time', 'position', 'velocity', 'acceleration', 'output', 'output_rate', 'link_velocity', 'phase',
               'temperature']
"""Variable against which an effect shows in a residual; ``any``: the one that tells most."""


class Coefficient(NamedTuple):
    """One number that an effect brings: its name and its unit."""

    name: str
    unit: str


@dataclass(frozen=True)
class Effect(ColumnBlock):
    """Base of every kind.

    :param where: joint, axis or link that it acts on; None when it has no place.
    :param parameters: nonlinear parameters and calibrations by name.
    :param options: values that choose the form of the columns; they are no physical quantities.
    :param span: from when to when it acts.
    :param reference: (p,) base parameters, for kinds with ``needs_reference``; () for those of the description.
    """

    where: str | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    options: Mapping[str, float] = field(default_factory=dict)
    span: Span = ALWAYS
    reference: tuple[float, ...] = ()

    outputs: ClassVar[tuple[str, ...]] = ('wrench', 'effort')
    sentence: ClassVar[str] = ''
    mistaken_for: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ''
    may_start: ClassVar[bool] = False
    includes: ClassVar[tuple[str, ...]] = ()
    """Kinds of which it does the same at its place besides, as friction that differs between directions holds an offset
    while its joint slides."""
    must_start: ClassVar[bool] = False
    may_come: ClassVar[bool] = False
    """Mark of what may come while a robot works; in a whole recording no start of it is searched."""
    of_one_recording: ClassVar[bool] = False
    own_in_each_recording: ClassVar[bool] = False
    """Mark of a cause that each recording has for itself in every model: a sensor's offset."""
    from_outside: ClassVar[bool] = False
    """Mark of what others do to the robot, as a push: told, but no part of the robot."""
    refine_link: ClassVar[bool] = False
    of_joint: ClassVar[bool] = False
    """Mark of kinds whose place is a joint: their units are written for one that turns."""
    is_body: ClassVar[bool] = False
    """Mark of a load that is one body, as it is picked up and put down; else it is a difference of two."""
    bounded_by_weight: ClassVar[bool] = False
    """Mark of a load that the arm must bear: much more than its own weight is no finding."""
    needs_reference: ClassVar[bool] = False
    """Mark of columns that depend on the load of a rigid body with fixed base parameters."""
    moves_friction: ClassVar[bool] = False
    """Mark of a calibration that moves other effects in time or speed: its derivative holds theirs.
    """
    resists: ClassVar[bool] = False
    """Mark of coefficients that add up to a resistance, which cannot be negative."""
    averages: ClassVar[bool] = False
    """Mark of a calibration that averages the noise of inputs, also where its values are zero."""
    group: ClassVar[str] = ''
    """Kinds of one group are also tried at all their places at once."""
    shows_against: ClassVar[Axis] = 'any'
    names: ClassVar[tuple[Coefficient, ...]] = ()
    """Coefficients of the columns, their units those of a joint that turns; unless :meth:`coefficients` tells them."""
    calibrations: ClassVar[tuple[Coefficient, ...]] = ()
    parameter_units: ClassVar[Mapping[str, str]] = {}
    option_names: ClassVar[tuple[str, ...]] = ()
    positive: ClassVar[tuple[str, ...]] = ()
    """Parameters that make sense above 0 alone."""

    @classmethod
    def from_values(cls: type[Self], where: str | None, values: Mapping[str, float],
                    reference: tuple[float, ...] = ()) -> Self:
        """The effect from values by the names of the text form; ``reference`` is kept by kinds that need one."""
        return cls(where, reference=reference if cls.needs_reference else ()).with_values(**values)

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        """Places where a search tries the kind on this robot."""
        return (None,)

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        """Places where the kind may be declared: where a search tries it, unless overridden."""
        return cls.places(body)

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None,
                 residual: Array) -> Sequence[Values]:
        """Coarse values of the nonlinear parameters and the options (start times aside) among which to look first.

        :param residual: (N, n) what the model has left so far; a spectrum of it may say where to look.
        """
        return (NO_VALUES,)

    @classmethod
    def choices(cls, body: RigidBody, samples: Samples, where: str | None) -> int:
        """Number of clearly different nonlinear values among which a search chooses."""
        return max(len(cls.searches(body, samples, where, np.zeros((len(samples), body.n_outputs)))), 1)

    def bounds(self, name: str, body: RigidBody, samples: Samples, residual: Array) -> tuple[float, float]:
        """Bounds of a line search for the nonlinear parameter ``name``; see :meth:`searches`."""
        value = self.value(name)
        if value == 0.0:  # nothing to take a share of: as far as the next value that the search tried
            tried = (abs(values.get(name, 0.0)) for values in self.searches(body, samples, self.where, residual))
            reach = min(filter(None, tried), default=0.0)
            return -reach, reach
        return min(value / BRACKET, value * BRACKET), max(value / BRACKET, value * BRACKET)

    def relocated(self, body: RigidBody, coefficients: Array) -> Effect:
        """The same effect at the place that its coefficients (c,) tell; most kinds stay where they are."""
        return self

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        """Names and units of the columns' coefficients, in order; they follow from kind, place and robot alone."""
        return tuple(Coefficient(name, self._own_unit(unit, body)) for name, unit in self.names)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """Columns (N, n, c) as if the effect had always been there, and the memory after them."""
        return np.zeros((len(samples), body.n_outputs, 0)), None

    def prior_scale(self, body: RigidBody) -> Array:
        """Prior standard deviations (c,) over gamma, plausible for this robot, in each unit.

        Wider ones would cost nothing where the samples excite a coefficient; where they hardly do,
        it would follow every disturbance. What is bounded by weight may be as large as the whole arm
        bears, also where a wrist's sensor feels a light tool alone.
        """
        size = arm_size(body) if self.bounded_by_weight else size_of(body)
        return np.array([plausible(unit, size) for _, unit in self.coefficients(body)])

    def calibration_scale(self, body: RigidBody) -> Array:
        """Prior standard deviations (c,) of the calibrations about zero, in their units."""
        size = size_of(body)
        units = [self.unit_of(name, body) for name, _ in self.calibrations]
        return np.array([CALIBRATED.get(unit, CALIBRATED[''] * plausible(unit, size)) for unit in units])

    def reference_model(self, body: RigidBody) -> Array:
        """(p,) base parameters that ``reference`` holds; those of the description without one."""
        return np.array(self.reference) if self.reference else body.base_parameters

    def predicted_load(self, body: RigidBody, samples: Samples) -> Array:
        """Effort (N,) of joint ``where`` as the rigid body with ``reference`` predicts it."""
        load = body.regressors(samples)[:, channel_index(body, self.where)] @ self.reference_model(body)
        return np.asarray(load)

    def prior_mean(self, body: RigidBody) -> Array:
        """Prior mean (c,) of each coefficient: zero, unless its value was declared."""
        return np.zeros(len(self.coefficients(body)))

    def check(self, body: RigidBody) -> None:
        """Raise SemiparamError when the effect cannot be declared on this robot: its outputs, its place, its values."""
        if body.outputs not in self.outputs:
            raise SemiparamError(f"effect '{self.kind}' does not act on outputs {body.outputs}; expected outputs "
                                 f'{self.outputs[0]}.')
        places = self.permitted(body)
        if self.where not in places:
            raise SemiparamError(self._misplaced([place for place in places if place is not None]))
        for name in self.positive:
            if name in self.parameters and not self.value(name) > 0.0:
                raise SemiparamError(f"effect '{self.kind}' has {name} {self.value(name):g}; expected more than 0.")
        if self.span.fault:
            raise SemiparamError(f"effect '{self.kind}' {self.span.fault}.")
        if self.is_calibration and self.span != ALWAYS:
            raise SemiparamError(f"effect '{self.kind}' has a start or an end; expected none, for a "
                                 'calibration always acts.')
        if len(self.reference) not in (0, body.n_parameters):
            raise SemiparamError(f"effect '{self.kind}' has a reference of {len(self.reference)} values; expected "
                                 f'{body.n_parameters}, the base parameters of this robot, or none.')

    def _misplaced(self, places: Sequence[str]) -> str:
        if not places:
            return f"effect '{self.kind}' names the place '{self.where}'; expected none, for it has no place."
        named = 'names no place' if self.where is None else f"cannot act at '{self.where}'"
        return f"effect '{self.kind}' {named}; expected {self.kind}@PLACE with one of {', '.join(places)}."

    def physical(self, coefficients: Array) -> bool:
        """Tell whether this cause can have coefficients (c,): no friction drives its joint."""
        return True

    def conceivable(self, body: RigidBody, coefficients: Array) -> bool:
        """Tell whether this kind may have coefficients (c,) and its calibrations on this robot:
        :meth:`physical`, :attr:`possible`, and no force much more than the arm's own weight."""
        too_large = self.bounded_by_weight and bool(np.any(
            np.abs(coefficients) > MOST_TIMES_PLAUSIBLE * Effect.prior_scale(self, body)))
        return self.possible and not too_large and self.physical(coefficients)

    @property
    def possible(self) -> bool:
        """Tell whether a robot may have the calibrations: no gain turns an effort's sign."""
        return True

    def doubt(self, body: RigidBody, samples: Samples) -> str:
        """A sentence about values that the kind may have, yet that hint at another cause; empty without a doubt."""
        return ''

    @property
    def late_s(self) -> float:
        """[s] by how much later than the joint states the outputs come."""
        return 0.0

    def led(self: Self, lead_s: float) -> Self:
        """The same effect, turning over so much further ahead of the motion where its form has a lead."""
        return self

    def finer(self: Self) -> Self:
        """The same effect with the values of its form open that a search leaves as they usually are."""
        return self

    def alike(self: Self, samples: Samples) -> Sequence[Self]:
        """The same effect, and others of its kind that samples which average faster ones do not tell from it."""
        return (self,)

    def plainer(self) -> tuple[Effect, ...]:
        """Plainer effects that together do the same in a special case, such as equal friction in both directions."""
        return ()

    def at_joint(self, body: RigidBody) -> bool:
        """Tell whether its place is a joint; a link may have the name of one."""
        return self.where in body.joints

    @property
    def is_calibration(self) -> bool:
        """Tell whether Gauss-Newton fits the effect, which then has no columns of its own."""
        return bool(self.calibrations)

    @property
    def changes(self) -> bool:
        """Tell whether the effect may begin, or be over, while a robot works."""
        return self.may_start or self.must_start

    @property
    def start_s(self) -> float | None:
        """Seconds after the start of the recording when it begins; None when it was always there, or has a stamp."""
        return self.span.start_s

    @property
    def end_s(self) -> float | None:
        """Seconds after the start of the recording when it is over; None when it is not, or has a stamp."""
        return self.span.end_s

    @property
    def ends(self) -> bool:
        """Tell whether an end is known."""
        return self.span.end_s is not None or self.span.end_stamp_s is not None

    def at_stamps(self: Self, origin: int) -> Self:
        """The same effect with the absolute stamps of its times, for whoever counts time from elsewhere.

        :param origin: [ns] where ``start_s`` and ``end_s`` count from.
        """
        return replace(self, span=self.span.at_stamps(origin))

    def without_common_gain(self: Self) -> Self:
        """The same effect with the median of its channels' gains at one: which common gain they have beside the masses
        no motion tells, and most channels of a sensor are right."""
        return self

    def in_recording(self: Self, origin: int) -> Self:
        """The same effect with its times in seconds after ``origin`` [ns]; the inverse of :meth:`at_stamps`."""
        return replace(self, span=self.span.in_recording(origin))

    def without_span(self: Self) -> Self:
        """The same effect, there from the beginning to the end."""
        return replace(self, span=ALWAYS)

    def columns(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """Columns (N, n, c), zero outside the span, and the memory after them."""
        columns, memory = self.basis(body, samples, memory)
        if self.span != ALWAYS:
            columns = columns * self.span.holds(samples.stamps, samples.origin)[:, None, None]
        return columns, memory

    def acts(self, stamp: int, origin: int) -> bool:
        return bool(self.span.holds(stamp, origin))

    def with_values(self: Self, **values: float) -> Self:
        """The same effect with some values changed, by the names of the text form."""
        times = {**self.span.values, **{name: value for name, value in values.items() if name in TIMES}}
        options = {name: value for name, value in values.items() if name in self.option_names}
        parameters = {name: value for name, value in values.items() if name not in (*TIMES, *self.option_names)}
        return replace(self, parameters={**self.parameters, **parameters}, options={**self.options, **options},
                       span=Span(**times))

    @property
    def values(self) -> Values:
        """Parameters, options and times by the names of the text form; :meth:`from_values` takes them back."""
        return {**self.parameters, **self.options, **self.span.values}

    def value(self, name: str, default: float = 0.0) -> float:
        """A parameter or an option, ``default`` when it is not set."""
        return self.parameters.get(name, self.options.get(name, default))

    @property
    def searched(self) -> tuple[str, ...]:
        """Names of the nonlinear parameters that are set, without the calibrations."""
        calibrated = {name for name, _ in self.calibrations}
        return tuple(name for name in self.parameters if name not in calibrated)

    @classmethod
    def value_names(cls) -> tuple[str, ...]:
        """Names of all values that the text form of this kind may hold."""
        return *TIMES, *cls.parameter_units, *(name for name, _ in cls.calibrations), *cls.option_names

    def unit_of(self, name: str, body: RigidBody | None = None) -> str:
        """Unit of a nonlinear parameter or calibration; without ``body`` that of a joint which turns."""
        known: dict[str, Any] = {**dict.fromkeys(TIMES, 's'), **self.parameter_units, **dict(self.calibrations)}
        return self._own_unit(str(known.get(name, '')), body)

    def _own_unit(self, unit: str, body: RigidBody | None) -> str:
        return body.joint_unit(self.where, unit) if body is not None and self.of_joint else unit


def place(kind: str, where: str | None) -> str:
    """A kind with its place, for people: ``joint_offset at r_elbow``."""
    return f'{kind} at {where}' if where else kind


def spelling(kind: str, where: str | None) -> str:
    """The same as parameters have it: ``joint_offset@r_elbow``."""
    return f'{kind}@{where}' if where else kind


def channel_units(body: RigidBody, per: str = '') -> tuple[Coefficient, ...]:
    """One coefficient for each output channel, its unit divided by ``per``."""
    return tuple(Coefficient(name, unit + (f'/{per}' if per else ''))
                 for name, unit in zip(body.output_names, body.output_units, strict=True))


def on_joint(body: RigidBody, where: str | None, values: Array) -> Array:
    """Columns (N, n, c) that act on the effort of joint ``where`` alone, from values (N, c)."""
    columns = np.zeros((body.n_outputs, *values.T.shape))
    columns[channel_index(body, where)] = values.T
    return columns.transpose(2, 0, 1)  # each column lies in one piece: most are zero, and soon seen to be


def channel_index(body: RigidBody, where: str | None) -> int:
    """Number of the output that is a joint's effort; SemiparamError lists the joints when there is none."""
    if where not in body.output_names:
        raise SemiparamError(f"the effort of joint '{where}' of an effect is no output; expected one of "
                             f'{", ".join(body.output_names)}.')
    return body.output_names.index(where)


def joint_index(body: RigidBody, where: str | None) -> int:
    """Number of a joint by name; SemiparamError lists the joints when there is none."""
    if where not in body.joints:
        raise SemiparamError(f"joint '{where}' of an effect is not among the joints {', '.join(body.joints)}.")
    return body.joints.index(where)
