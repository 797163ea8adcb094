"""Time-aligned samples of one robot: inputs x = [q, dq, ddq] and measured outputs y."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple, overload

import numpy as np

from semiparam_ros.core.types import Array, Stamps
from semiparam_ros.errors import SemiparamError

PAUSE_NS = 60 * 10**9
"""Between two recordings that are taken for one after the other, though their stamps are not."""


NO_TEMPERATURE = np.zeros(0)


class Sample(NamedTuple):
    """One instant. ``stamp`` [ns]; joints (n_joints,) in rad, rad/s, rad/s^2; ``outputs`` (n,) in N and N m.

    ``temperature`` [deg C]: (0,) where none are recorded, else of each joint (n_joints,) beside efforts, of the sensor
    (1,) beside a wrench; NaN for those that are not known.
    """

    stamp: int
    position: Array
    velocity: Array
    acceleration: Array
    outputs: Array
    temperature: Array = NO_TEMPERATURE

    @property
    def inputs(self) -> Array:
        """(m,) x = [q, dq, ddq]."""
        return np.concatenate([self.position, self.velocity, self.acceleration])

    def in_rows(self, n_joints: int, n_outputs: int) -> Sample:
        """The same, its values as arrays of floats without gaps, as compiled loops take them.

        Raises SemiparamError when there are more or fewer values, or others than numbers.
        """
        found: dict[str, Any] = {}
        for name, value, count in zip(self._fields[1:5], self[1:5], (n_joints,) * 3 + (n_outputs,), strict=True):
            if type(value) is np.ndarray and value.dtype == float and value.shape == (count,) \
                    and value.flags.c_contiguous:
                continue
            try:
                row = np.ascontiguousarray(value, dtype=np.float64)
            except (TypeError, ValueError):
                raise SemiparamError(f'{name} of a sample is no array of numbers.') from None
            if row.shape != (count,):
                raise SemiparamError(f'{name} of a sample has the shape {row.shape}; expected ({count},).')
            found[name] = row
        return self._replace(**found) if found else self


def variance(values: Array) -> Array:
    """(n,) of values (N, n); exactly 0 of those that stay the same, where rounding leaves more."""
    return np.asarray(values.var(axis=0) * (np.ptp(values, axis=0) > 0.0))


def at_middle(means: Array, stamps: Stamps, length_s: float, count: int) -> Array:
    """Means (N, ...) of ``count`` neighbours over ``length_s``, less what they differ by from the values in
    their middles (N,) ``stamps`` [ns] where a quantity curves: T^2 / 24 times its second derivative, as the second
    neighbours tell it: the next ones would bring more noise."""
    steps = np.maximum((stamps[2:] - stamps[:-2]) * 1e-9, 2.0 * length_s)  # a gap leaves no curvature
    steps = steps.reshape(-1, *(1,) * (means.ndim - 1))
    slopes = (means[2:] - means[:-2]) / steps
    second = 2.0 * (slopes[2:] - slopes[:-2]) / (steps[2:] + steps[:-2])
    found = means.copy()
    found[2:-2] -= (1.0 - 1.0 / count**2) * length_s**2 / 24.0 * second
    return found


@dataclass(frozen=True, eq=False)
class Samples:
    """N samples in order of time; ``origin`` [ns] is where ``time`` starts, and slices keep it.

    ``breaks`` [ns]: where several recordings are one, the first stamp of each but the first. ``whole``: nothing comes
    in later, so what belongs to one sample may be read from those after it too. ``averaged_s`` [s]: each value is the
    mean over so long a time, of ``averaged_of`` samples. ``every``: they are each so-many-th of those that were
    recorded. ``temperature`` (N, k) [deg C]: see :class:`Sample`; k = 0
    unless given.

    Values are kept as floats, each row without gaps. Two are the same only when they are one object, so that what is
    computed of them can be cached.
    """

    stamps: Stamps
    position: Array
    velocity: Array
    acceleration: Array
    outputs: Array
    origin: int
    breaks: tuple[int, ...] = ()
    whole: bool = False
    averaged_s: float = 0.0
    averaged_of: int = 1
    every: int = 1
    temperature: Array = field(default_factory=lambda: NO_TEMPERATURE)

    def __post_init__(self) -> None:
        for name in Sample._fields[1:5]:
            given = getattr(self, name)
            rows = np.asarray(given, dtype=np.float64)
            rows = rows if rows.strides[-1] == rows.itemsize else np.ascontiguousarray(rows)
            if rows is not given:
                object.__setattr__(self, name, rows)
        if not self.temperature.size:
            object.__setattr__(self, 'temperature', np.empty((len(self.stamps), 0)))

    @classmethod
    def joined(cls, recordings: Sequence[Samples]) -> Samples:
        """Several recordings of one robot as one, in this order; an empty list raises SemiparamError.

        Stamps stay as they are where a recording begins after the one before it; else it is moved to ``PAUSE_NS``
        after it.
        """
        if not recordings:
            raise SemiparamError('no recordings to join: expected at least one.')
        stamps = [recordings[0].stamps]
        for recording in recordings[1:]:
            since = int(recording.stamps[0] - stamps[-1][-1])
            stamps.append(recording.stamps if since > 0 else recording.stamps + (PAUSE_NS - since))
        position, velocity, acceleration, outputs, temperature = (
            np.concatenate([getattr(recording, name) for recording in recordings])
            for name in ('position', 'velocity', 'acceleration', 'outputs', 'temperature'))
        return cls(np.concatenate(stamps), position, velocity, acceleration, outputs, recordings[0].origin,
                   tuple(int(part[0]) for part in stamps[1:]), temperature=temperature)

    @property
    def recordings(self) -> list[slice]:
        """The samples of each recording, in order."""
        edges = [0, *np.searchsorted(self.stamps, self.breaks).tolist(), len(self)]
        return [slice(start, end) for start, end in pairwise(edges)]

    @property
    def recorded_s(self) -> float:
        """[s] in which something was recorded: without the pauses between recordings."""
        return float(sum(np.ptp(self.time[part]) for part in self.recordings if part.start < part.stop))

    @classmethod
    def from_list(cls, samples: Iterable[Sample]) -> Samples:
        """Stack single samples; the first stamp becomes the origin. An empty list raises SemiparamError."""
        rows = list(samples)
        if not rows:
            raise SemiparamError('no complete samples: expected at least one joint state matched with one output.')
        stamps, *columns = zip(*rows, strict=True)
        position, velocity, acceleration, outputs, temperature = (
            np.array(column, dtype=np.float64) for column in columns)
        return cls(np.array(stamps, dtype=np.int64), position, velocity, acceleration, outputs, int(rows[0].stamp),
                   temperature=temperature)

    @property
    def time(self) -> Array:
        """(N,) seconds since the origin."""
        return np.asarray((self.stamps - self.origin) * 1e-9)

    @property
    def inputs(self) -> Array:
        """(N, m) rows x = [q, dq, ddq], m = 3 n_joints."""
        return np.hstack([self.position, self.velocity, self.acceleration])

    def __len__(self) -> int:
        return len(self.stamps)

    @overload
    def __getitem__(self, index: int) -> Sample: ...

    @overload
    def __getitem__(self, index: slice | Array | Stamps) -> Samples: ...

    def __getitem__(self, index: int | slice | Array | Stamps) -> Sample | Samples:
        """One sample by its number; some of them by a slice, a mask or an array of numbers."""
        if isinstance(index, int | np.integer):
            return Sample(int(self.stamps[index]), self.position[index], self.velocity[index],
                          self.acceleration[index], self.outputs[index], self.temperature[index])
        return replace(self, stamps=self.stamps[index], position=self.position[index], velocity=self.velocity[index],
                       acceleration=self.acceleration[index], outputs=self.outputs[index],
                       temperature=self.temperature[index])

    def __iter__(self) -> Iterator[Sample]:
        rows = zip(self.stamps.tolist(), self.position, self.velocity, self.acceleration, self.outputs,
                   self.temperature, strict=True)
        return (Sample(*row) for row in rows)
