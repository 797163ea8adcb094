"""An effect: a named physical cause with its place, its nonlinear parameters, and the columns it adds.

Three things can be asked of one. *Additive* kinds give columns whose coefficients the estimator learns. *Calibration*
kinds have no columns; their parameters move the inputs or shape the regressors, and are fitted by Gauss-Newton. And
every kind lists the places and the coarse values of its nonlinear parameters where a search should look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from semiparam_ros.core.columns import ColumnBlock as Acting
from semiparam_ros.core.columns import Memory
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

Shape = dict[str, float]
Self = TypeVar('Self', bound='Effect')
CHANNELS = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')
ALWAYS: Shape = {}
FLAGS = ('link_axes',)
"""Values of a shape that choose the form of the columns; they are no physical quantities."""
STARTS = ('start_s', 'start_stamp_s')
STAMP_TOLERANCE_NS = 1000
"""A double holds today's stamps [s] to 0.24 us."""


class Coefficient(NamedTuple):
    """One number that an effect brings: its name and its unit."""

    name: str
    unit: str


@dataclass(frozen=True)
class Effect:
    """Base of every kind.

    :param where: joint, axis or link that it acts on; None when it has no place.
    :param shape: nonlinear parameters by name. What begins at some time has ``start_s`` [s] after the start of the
        recording (of the node's life), or ``start_stamp_s`` [s] as the stamps of headers count.
    :param reference: (p,) base parameters, for the few kinds whose columns depend on the arm's own load.
    """

    where: str | None = None
    shape: Mapping[str, float] = field(default_factory=dict)
    reference: tuple[float, ...] = ()

    kind: ClassVar[str] = ''
    outputs: ClassVar[tuple[str, ...]] = ('wrench', 'effort')
    sentence: ClassVar[str] = ''
    mistaken_for: ClassVar[tuple[str, ...]] = ()
    separated_by: ClassVar[str] = ''
    may_start: ClassVar[bool] = False
    must_start: ClassVar[bool] = False
    of_one_recording: ClassVar[bool] = False
    of_sensor: ClassVar[bool] = False
    refine_link: ClassVar[bool] = False
    calibrations: ClassVar[tuple[Coefficient, ...]] = ()
    shape_units: ClassVar[Mapping[str, str]] = {}
    positive: ClassVar[tuple[str, ...]] = ()
    """Values of the shape that make sense above 0 alone."""
    coefficient_scale: ClassVar[float] = 100.0

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        """Where a search tries the kind on this robot."""
        return (None,)

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        """Where the kind may be declared: where a search tries it, unless it says otherwise."""
        return cls.places(body)

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None,
                 residual: Array) -> Sequence[Shape]:
        """Coarse values of the nonlinear parameters (start times aside) among which to look first.

        :param residual: (N, n) what the model has left so far; a spectrum of it may say where to look.
        """
        return (ALWAYS,)

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        """Names and units of the columns' coefficients, in order; they follow from kind, place and robot alone."""
        return ()

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """(N, n, c) columns as if the effect had always been there."""
        return np.zeros((len(samples), body.n_outputs, 0)), None

    def prior_scale(self, body: RigidBody) -> Array:
        """(c,) wide prior standard deviations over gamma, one for each coefficient, in its unit."""
        return np.full(len(self.coefficients(body)), self.coefficient_scale)

    def check(self, body: RigidBody) -> None:
        """Raise SemiparamError when the effect cannot be declared on this robot: its outputs, its place, its values."""
        if body.outputs not in self.outputs:
            raise SemiparamError(f"effect '{self.kind}' does not act on outputs {body.outputs}; expected outputs "
                                 f'{self.outputs[0]}.')
        places = self.permitted(body)
        if self.where not in places:
            raise SemiparamError(self._misplaced([place for place in places if place is not None]))
        for name in self.positive:
            if name in self.shape and not self.value(name) > 0.0:
                raise SemiparamError(f"effect '{self.kind}' has {name} {self.value(name):g}; expected more than 0.")
        if all(name in self.shape for name in STARTS):
            raise SemiparamError(f"effect '{self.kind}' has {' and '.join(STARTS)}; expected one of them.")
        if self.is_calibration and self.shape.keys() & STARTS:
            raise SemiparamError(f"effect '{self.kind}' has a start; expected none, for a calibration acts from the "
                                 'beginning.')
        if len(self.reference) not in (0, body.n_parameters):
            raise SemiparamError(f"effect '{self.kind}' has a reference of {len(self.reference)} values; expected "
                                 f'{body.n_parameters}, the base parameters of this robot, or none.')

    def _misplaced(self, places: Sequence[str]) -> str:
        if not places:
            return f"effect '{self.kind}' names the place '{self.where}'; expected none, for it has no place."
        named = 'names no place' if self.where is None else f"cannot act at '{self.where}'"
        return f"effect '{self.kind}' {named}; expected {self.kind}@PLACE with one of {', '.join(places)}."

    def physical(self, coefficients: Array) -> bool:
        """False for coefficients (c,) that this cause cannot have, such as a friction that drives the joint."""
        return True

    def is_noticeable(self, samples: Samples) -> bool:
        """False for a calibration so small that it may merely make the best of noise in the inputs."""
        return True

    def plainer(self) -> tuple[Effect, ...]:
        """Plainer effects that together do the same in a special case, such as equal friction in both directions."""
        return ()

    @property
    def is_calibration(self) -> bool:
        """True when Gauss-Newton fits it and it has no columns of its own."""
        return bool(self.calibrations)

    @property
    def start_s(self) -> float | None:
        """Seconds after the start of the recording when it begins; None when it was always there, or has a stamp."""
        return self.shape.get('start_s')

    @property
    def start_stamp(self) -> int | None:
        """Stamp [ns] from which on it is there; None when it was always there, or counts from the start."""
        seconds = self.shape.get('start_stamp_s')
        return None if seconds is None else round(Fraction(seconds) * 10**9)

    def at_stamp(self: Self, origin: int) -> Self:
        """The same effect with the absolute stamp of its start, for whoever counts time from elsewhere.

        :param origin: [ns] where ``start_s`` counts from.
        """
        if self.start_s is None:
            return self
        return self.without_start().with_shape(start_stamp_s=(origin + round(self.start_s * 1e9)) / 10**9)

    def in_recording(self: Self, origin: int) -> Self:
        """The same effect with its start in seconds after ``origin`` [ns]; the inverse of :meth:`at_stamp`."""
        if self.start_stamp is None:
            return self
        return self.without_start().with_shape(start_s=(self.start_stamp - origin) * 1e-9)

    def without_start(self: Self) -> Self:
        """The same effect, there from the beginning."""
        return replace(self, shape={name: value for name, value in self.shape.items() if name not in STARTS})

    def correct(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[RigidBody, Samples, Memory]:
        """Inputs are left as they are unless a kind says otherwise."""
        return body, samples, None

    def transform(self, body: RigidBody, regressors: Array) -> Array:
        """Regressors are left as they are unless a kind says otherwise."""
        return regressors

    def columns(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """(N, n, c) columns, zero before the start."""
        columns, memory = self.basis(body, samples, memory)
        if self.start_s is not None:
            columns = columns * (samples.time >= self.start_s)[:, None, None]
        if self.start_stamp is not None:
            columns = columns * (samples.stamps >= self.start_stamp - STAMP_TOLERANCE_NS)[:, None, None]
        return columns, memory

    def desired(self) -> Acting:
        """The effect as it acts on a desired state; as on any other, unless a kind says otherwise.

        Such a state is exact, has no past, and is taken as of now: a start that was reached counts, and a drift stands
        where it stands. A kind that concerns the time of a measurement, or a phase that nobody knows beforehand, is
        :class:`~semiparam_ros.core.columns.Absent`.
        """
        return self

    def with_shape(self: Self, **values: float) -> Self:
        """The same effect with some nonlinear parameters changed."""
        return replace(self, shape={**self.shape, **values})

    def value(self, name: str, default: float = 0.0) -> float:
        """A nonlinear parameter, ``default`` when it is not set."""
        return float(self.shape.get(name, default))

    @classmethod
    def value_names(cls) -> tuple[str, ...]:
        """Everything that a shape of this kind may hold."""
        return *STARTS, *cls.shape_units, *(name for name, _ in cls.calibrations), *FLAGS

    def unit_of(self, name: str) -> str:
        """Unit of a nonlinear parameter or calibration."""
        known: dict[str, Any] = {**dict.fromkeys(STARTS, 's'), **self.shape_units, **dict(self.calibrations)}
        return str(known.get(name, ''))


def channel_units(body: RigidBody, per: str = '') -> tuple[Coefficient, ...]:
    """One coefficient for each output channel, its unit divided by ``per``."""
    names = CHANNELS if body.outputs == 'wrench' else body.joints
    return tuple(Coefficient(name, unit + (f'/{per}' if per else ''))
                 for name, unit in zip(names, body.output_units, strict=True))


def on_joint(body: RigidBody, where: str | None, values: Array) -> Array:
    """(N, n, c) columns that act on the channel of joint ``where`` alone, from values (N, c)."""
    columns = np.zeros((len(values), body.n_outputs, values.shape[1]))
    columns[:, joint_index(body, where)] = values
    return columns


def joint_index(body: RigidBody, where: str | None) -> int:
    """Number of a joint by name; SemiparamError lists the joints when there is none."""
    if where not in body.joints:
        raise SemiparamError(f"joint '{where}' of an effect is not among the joints {', '.join(body.joints)}.")
    return body.joints.index(where)
