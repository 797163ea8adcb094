"""Base of the hidden causes: each is drawn at random and changes the world by an amount."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.world import World

BOTH = ('wrench', 'effort')
ALONG = {'rad': 'm', 'rad/s': 'm/s', '1/revolution': '1/m', 'N m': 'N', 'N m s/rad': 'N s/m',
         'N m s/(rad K)': 'N s/(m K)', 'N m/rad': 'N/m', 'kg m^2': 'kg'}
"""Units along a joint that slides, by those about one that turns."""


class TrueValue(NamedTuple):
    """A number, or a list of numbers, with its unit."""

    value: Any
    unit: str


@dataclass(frozen=True)
class Site:
    """Site for the draw of a cause: the world without it, the deviation (n,) of its outputs.

    ``where``, ``start_s`` and ``end_s`` [s] are what was requested, or None.
    """

    world: World
    scale: Array
    where: str | None
    start_s: float | None
    end_s: float | None
    rng: np.random.Generator

    def random_start(self) -> float:
        """The requested start, or one in the second quarter of the recording, or of the time until the end, or soon
        after [s]."""
        share, end = float(self.rng.uniform(0.25, 0.6)), self.world.duration
        until = end if self.end_s is None else min(end, self.end_s)
        return share * until if self.start_s is None else self.start_s

    def sign(self) -> float:
        """Sign at random, -1 or 1."""
        return float(self.rng.choice([-1.0, 1.0]))

    def joint(self) -> int:
        """Index of the requested joint, or of a random one."""
        return self._choose('joint', self.world.arm.joints)

    def channel(self) -> int:
        """Index of the requested output channel, or of a random one."""
        return self._choose('channel', self.world.arm.channels)

    def frame(self) -> str:
        """The requested frame, or one of the two outermost links."""
        arm, drawn = self.world.arm, int(self.rng.integers(2))
        outer = arm.distal_frames()[-2:]
        return self._checked_frame(outer[drawn % len(outer)])

    def hand(self) -> str:
        """The requested frame, or the outermost link with a mass."""
        return self._checked_frame(self.world.arm.distal_frames()[-1])

    def _choose(self, what: str, names: tuple[str, ...]) -> int:
        drawn = int(self.rng.integers(len(names)))
        if self.where is not None and self.where not in names:
            raise SemiparamError(f"there is no {what} '{self.where}'; expected one of {', '.join(names)}.")
        return drawn if self.where is None else names.index(self.where)

    def _checked_frame(self, default: str) -> str:
        arm = self.world.arm
        joint = arm.model.frames[arm.frame_id(self.where or default)].parentJoint
        if joint not in arm.distal_joints:
            raise SemiparamError(f"frame '{self.where}' does not load the sensor; expected one distal of it: "
                                 f"{', '.join(arm.distal_frames())}.")
        return self.where or default


@dataclass(frozen=True)
class HiddenCause:
    """A hidden cause with all that is random about it settled; only its magnitude is open.

    ``apply`` gives the world with it at a magnitude (in the unit of ``typical``, a first guess), ``parameters`` what a
    perfect diagnosis would find. ``start_s`` is None where the cause is there from the beginning, ``end_s`` where it
    stays. What a ``linear``
    cause changes is proportional to its magnitude. One ``by_temperature`` needs a world that has temperatures.
    """

    where: str | None
    start_s: float | None
    end_s: float | None = field(default=None, kw_only=True)

    kind: ClassVar[str]
    acts_on: ClassVar[tuple[str, ...]] = BOTH
    takes_place: ClassVar[bool] = True
    can_start: ClassVar[bool] = False
    can_end: ClassVar[bool] = False
    typical: ClassVar[float] = 1.0
    linear: ClassVar[bool] = False
    by_temperature: ClassVar[bool] = False
    of_joint: ClassVar[bool] = False
    """Mark of kinds whose place is a joint: their units are written for one that turns."""
    quantity: ClassVar[tuple[str, str]]
    """Name and unit of what the magnitude tells."""
    along: ClassVar[str] = ''
    """Field by which that is the magnitude times: a sign, a direction."""
    beside: ClassVar[Mapping[str, str]] = {}
    """Units of the fields that a diagnosis should find, too."""

    @classmethod
    def draw(cls, site: Site) -> HiddenCause:
        """Settle place, time, direction and shape."""
        raise NotImplementedError

    def apply(self, world: World, magnitude: float) -> World:
        """The world with this cause in it."""
        raise NotImplementedError

    def acting(self, time: Array) -> Array:
        """Factor (N, 1) at the times (N,) [s]: 1 from the start to the end, 0 before and after."""
        start, end = self.start_s, self.end_s
        later = time >= (-np.inf if start is None else start)
        return np.asarray(later & (time < (np.inf if end is None else end)), dtype=float)[:, None]

    def parameters(self, magnitude: float) -> dict[str, TrueValue]:
        """Values that a perfect diagnosis would find, by name."""
        name, unit = self.quantity
        value = magnitude * getattr(self, self.along) if self.along else magnitude
        return {name: TrueValue(value, unit),
                **{other: TrueValue(getattr(self, other), its) for other, its in self.beside.items()}}

    def true_values(self, magnitude: float, world: World) -> dict[str, TrueValue]:
        """The same in the units of its place in a world; a phase is an angle all the same."""
        found = self.parameters(magnitude)
        if not (self.of_joint and world.arm.slides(str(self.where))):
            return found
        return {name: entry if name == 'phase' else entry._replace(unit=ALONG.get(entry.unit, entry.unit))
                for name, entry in found.items()}
