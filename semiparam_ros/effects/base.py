"""An effect: a named physical cause with its place, its nonlinear parameters, and the columns it adds.

Three things can be asked of one. *Additive* kinds give columns whose coefficients the estimator learns. *Calibration*
kinds have no columns; their parameters move the inputs or shape the regressors, and are fitted by Gauss-Newton. And
every kind lists the places and the coarse values of its nonlinear parameters where a search should look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from semiparam_ros.core.columns import Effect as Acting
from semiparam_ros.core.columns import Memory
from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

Shape = dict[str, float]
Self = TypeVar('Self', bound='Effect')
CHANNELS = ('fx', 'fy', 'fz', 'tx', 'ty', 'tz')
ALWAYS: Shape = {}
FLAGS = ('at_link', 'directions', 'link_axes')
"""Values of a shape that choose the form of the columns; they are no physical quantities."""


class Coefficient(NamedTuple):
    """One number that an effect brings: its name and its unit."""

    name: str
    unit: str


@dataclass(frozen=True)
class Effect:
    """Base of every kind.

    :param where: joint, axis or link that it acts on; None when it has no place.
    :param shape: nonlinear parameters by name, ``start_s`` among them for what begins during a recording.
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
    coefficient_scale: ClassVar[float] = 100.0

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        """Where the kind could act on this robot."""
        return (None,)

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None,
                 residual: Array) -> Sequence[Shape]:
        """Coarse values of the nonlinear parameters (start times aside) among which to look first.

        :param residual: (N, n) what the model has left so far; a spectrum of it may say where to look.
        """
        return (ALWAYS,)

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        """Names and units of the columns' coefficients, in order."""
        return ()

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """(N, n, c) columns as if the effect had always been there."""
        return np.zeros((len(samples), body.n_outputs, 0)), None

    @property
    def n_columns(self) -> int:
        """Number of coefficients learnt with the model; known from the kind and its place alone."""
        return 0

    @property
    def prior_scale(self) -> Array:
        """(n_columns,) wide prior standard deviations over gamma, in the coefficients' units."""
        return np.full(self.n_columns, self.coefficient_scale)

    def physical(self, coefficients: Array) -> bool:
        """False for coefficients (n_columns,) that this cause cannot have, such as a friction that drives the joint."""
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
        """Seconds after the start of the recording when it begins; None when it was always there."""
        return self.shape.get('start_s')

    def correct(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[RigidBody, Samples, Memory]:
        """Inputs are left as they are unless a kind says otherwise."""
        return body, samples, None

    def transform(self, body: RigidBody, regressors: Array) -> Array:
        """Regressors are left as they are unless a kind says otherwise."""
        return regressors

    def columns(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        """(N, n, n_columns) columns, zero before the start."""
        columns, memory = self.basis(body, samples, memory)
        if self.start_s is not None:
            columns = columns * (samples.time >= self.start_s)[:, None, None]
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
        return 'start_s', *cls.shape_units, *(name for name, _ in cls.calibrations), *FLAGS

    def unit_of(self, name: str) -> str:
        """Unit of a nonlinear parameter or calibration."""
        known: dict[str, Any] = {'start_s': 's', **self.shape_units, **dict(self.calibrations)}
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
