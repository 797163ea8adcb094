"""Motion and rest of the robot. At rest it repeats one sample, which says nothing new, whatever its
noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semiparam_ros.core.compiled import Vector, compiled
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.stamps import LONGEST_PAUSE_NS
from semiparam_ros.core.types import Array, Mask, Stamps

STEP = 0.02
"""[rad, m] What a joint must leave its place by. Encoders jitter by less, where measured velocities at rest may reach
those of slow motion, and accelerations that are differences of these reach any."""

REST_NS = 10**9
"""A robot that has not made a step for so long is at rest."""

STILL = 0.001
"""[rad, m] Within this of each other two positions are the same place, unless the encoders jitter by more."""
STEPPED = 2
STEP_NS = 4_000_000
"""Of the samples of one step [ns] a window takes the first: those of faster robots are nearly alike, and a thousand of
them would be a moment of one motion."""
STILL_STEPS = 5
"""Samples of so many steps of time at one place are news."""


def begins_step(stamp: int, before: int | None) -> bool:
    """Tell whether a sample is the first of its step, by its stamp and that of the sample before it [ns]."""
    return before is None or stamp // STEP_NS != before // STEP_NS


def beginning_steps(stamps: Stamps) -> Mask:
    """(N,) the same of samples in order."""
    steps = stamps // STEP_NS
    return np.concatenate([np.ones(min(len(steps), 1), dtype=bool), np.diff(steps) != 0])


class Motion(NamedTuple):
    """Place of the joints, and since when they are there.

    A step is made when any joint is ``STEP`` away from where it was at the step before. The start counts as one, so
    that a recording of a moving robot counts from its first sample on.
    """

    place: Array  # (n_joints,) at the last step
    since: int  # [ns] stamp of the last step, or of the start
    newest: int  # [ns] stamp of this sample
    nearby: Array  # (n_joints,) at the first of the last samples that are within STILL of it
    still: int  # steps of time, of ``STEP_NS``, that these are of
    outputs: Array  # (n,) of this sample
    is_news: bool
    """Whether this sample is worth learning: it belongs to a motion, it is one of the first at its place, and there its
    outputs are neither all zero nor exactly those of the sample before, as of motors that are off behind brakes."""
    stays: bool = False
    """Whether it is at the place of the sample before."""

    def after(self, stamp: int, position: Array, outputs: Array) -> Motion:
        """With one sample more.

        It starts afresh when the clock has jumped. The first sample after a jump is no news: where velocities and
        accelerations are filtered, the filter has begun anew with it and knows no rate yet.
        """
        if not 0 <= stamp - self.newest <= LONGEST_PAUSE_NS:
            return at_start(stamp, position, outputs)._replace(is_news=False)
        moved = compared(position, self.place, self.nearby)
        if moved == STEPPED:
            return at_start(stamp, position, outputs)
        nearby, still = (position, 1) if moved else (self.nearby, self.still + begins_step(stamp, self.newest))
        is_news = stamp - self.since <= REST_NS and still <= STILL_STEPS
        if is_news and not moved:
            is_news = bool(outputs.any() and (outputs != self.outputs).any())
        return Motion(self.place, self.since, stamp, nearby, still, outputs, is_news, not moved)

    def interrupted(self) -> Motion:
        """Begin as after a jump of the clock, whatever the stamp of the next sample."""
        return self._replace(newest=self.newest - 2 * LONGEST_PAUSE_NS)


def at_start(stamp: int, position: Array, outputs: Array) -> Motion:
    """Motion of the first sample, and of a step."""
    return Motion(position, stamp, stamp, position, 1, outputs, True)


def moving(samples: Samples) -> Mask:
    """(N,) where the robot moves, of samples in order."""
    motion, found = None, []
    for row in zip(samples.stamps.tolist(), samples.position, samples.outputs, strict=True):
        motion = at_start(*row) if motion is None else motion.after(*row)
        found.append(motion.is_news)
    return np.array(found)


@compiled
def compared(position: Vector, place: Vector, nearby: Vector) -> int:
    """``STEPPED`` when a joint has left the place (n_joints,) of the last step, else whether one is not nearby."""
    moved = 0
    for joint in range(len(position)):
        if abs(position[joint] - place[joint]) > STEP:
            return STEPPED
        if abs(position[joint] - nearby[joint]) > STILL:
            moved = 1
    return moved
