"""World of a recording: the rigid body, the hidden causes that act on it, and its sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin

from semiparam_ros.core.types import Array
from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.trajectory import Instants, Trajectory
from semiparam_ros.simulation.warming import Temperature

Change: TypeAlias = Callable[['World', Instants, Array], Array]
"""Function of a world, its motion and its outputs (N, n) to the outputs with one more cause."""


class AttachedBody(NamedTuple):
    """A body that hangs on ``frame`` from ``start_s`` [s] until ``end_s``."""

    frame: str
    inertia: pin.Inertia
    start_s: float
    end_s: float


@dataclass(frozen=True)
class World:
    """One recording before noise. ``times`` (N,) [s] are the sampling instants.

    ``joint_shift`` (n_joints,) [rad] is the true position minus the reported one; ``delay_s`` is how late the outputs
    are. ``mechanical`` changes are forces on the arm, ``sensing`` ones belong to the sensor; each in order. ``before``
    is the world with fewer of them, whose outputs need not be computed again. ``temperature`` is that of the joints, or
    of the sensor of a wrench; None where nobody asks.
    """

    arm: Arm
    trajectory: Trajectory
    times: Array
    joint_shift: Array
    delay_s: float = 0.0
    bodies: tuple[AttachedBody, ...] = ()
    mechanical: tuple[Change, ...] = field(default=())
    sensing: tuple[Change, ...] = field(default=())
    temperature: Temperature | None = None
    before: World | None = field(default=None, repr=False, compare=False)

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return float(self.times[-1])

    def motion(self, times: Array | None = None) -> Instants:
        """The true joint motion at ``times``, by default when the outputs of the samples arose (delay included)."""
        instants = self.trajectory.at(self.times - self.delay_s if times is None else times)
        return instants._replace(position=instants.position + self.joint_shift)

    def rigid(self, motion: Instants) -> Array:
        """Outputs (N, n) of the arm with the bodies that hang on it at each instant, by recursive Newton-Euler."""
        time = motion.time
        there = [(time >= body.start_s) & (time < body.end_s) for body in self.bodies]
        hanging = np.array(there).reshape(-1, len(time)).T
        outputs = np.empty((len(motion.time), len(self.arm.channels)))
        for present in np.unique(hanging, axis=0):
            rows = (hanging == present).all(1)
            arm = self.arm
            for body in (body for body, there in zip(self.bodies, present, strict=True) if there):
                arm = arm.with_body(body.frame, body.inertia)
            outputs[rows] = arm.evaluate(*(values[rows] for values in motion[1:]))
        return outputs

    @cached_property
    def now(self) -> Instants:
        """The motion at which the samples' outputs arise."""
        return self.motion()

    @cached_property
    def loaded(self) -> Array:
        """Outputs (N, n) of arm and forces, before the sensor."""
        known = self.before
        values = self.rigid(self.now) if known is None else known.loaded
        for change in self.mechanical[0 if known is None else len(known.mechanical):]:
            values = change(self, self.now, values)
        return values

    @cached_property
    def outputs(self) -> Array:
        """Outputs (N, n) [N, N m] that a perfect sensor reports at ``times``."""
        values = self.loaded
        for change in self.sensing:
            values = change(self, self.now, values)
        return values

    def rigid_on_grid(self, step: float) -> tuple[Array, Array]:
        """A grid of ``step`` [s] over the whole motion, and the rigid body's outputs on it; kept for the next call."""
        if step not in self._grids:
            fine = self.motion(np.arange(self.trajectory.start, self.trajectory.end, step))
            self._grids[step] = fine.time, self.rigid(fine)
        return self._grids[step]

    @cached_property
    def _grids(self) -> dict[float, tuple[Array, Array]]:
        return {}

    def changed(self, **values: Any) -> World:
        """The same world with another arm, joint zero, delay or load."""
        return replace(self, before=None, **values)

    def with_mechanical(self, change: Change) -> World:
        """The same world with one more force on the arm."""
        return replace(self, mechanical=(*self.mechanical, change), before=self)

    def with_sensing(self, change: Change) -> World:
        """The same world with one more fault of the sensor, behind the others."""
        return replace(self, sensing=(*self.sensing, change), before=self)
