"""The initial window: samples of motion, gathered until there are enough to estimate hyperparameters from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.motion import Motion, at_start, beginning_steps
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.types import Array, Stamps


class Remembered(NamedTuple):
    """A sample of the window with its coupled columns (n, p), in N and N m, as they were at the time."""

    inputs: Array  # (m,)
    outputs: Array  # (n,)
    columns: Array  # (n, p)


class InitialWindow:
    """The samples that were learnt: of a robot that moves, for one at rest is not learnt.

    :param wanted: samples to gather.
    """

    def __init__(self, wanted: int, n_inputs: int, n_outputs: int, n_columns: int) -> None:
        self.wanted = wanted
        self._sizes = (n_inputs, n_outputs, n_columns)
        self._rows = np.zeros((0, n_inputs + n_outputs + n_outputs * n_columns))
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def full(self) -> bool:
        """Tell whether there are as many as wanted."""
        return self._count >= self.wanted

    def append(self, sample: Sample, columns: Array) -> None:
        """Add one sample with its coupled columns (n, p)."""
        self._make_room(self._count + 1)
        np.concatenate((*sample[1:5], columns.ravel()), out=self._rows[self._count])
        self._count += 1

    def unmoved(self, n_joints: int, least: float) -> list[int]:
        """Joints, by their number, whose positions range over less than ``least`` [rad, m]."""
        position = self._rows[:self._count, :n_joints]
        span = np.ptp(position, axis=0) if self._count else np.zeros(n_joints)
        return np.flatnonzero(span < least).tolist()

    @property
    def inputs(self) -> Array:
        """(N, m)."""
        return np.ascontiguousarray(self._rows[:self._count, :self._sizes[0]])

    @property
    def outputs(self) -> Array:
        """(N, n)."""
        m, n, _ = self._sizes
        return np.ascontiguousarray(self._rows[:self._count, m:m + n])

    @property
    def columns(self) -> Array:
        """(N, n, p)."""
        m, n, p = self._sizes
        return np.ascontiguousarray(self._rows[:self._count, m + n:]).reshape(self._count, n, p)

    def __iter__(self) -> Iterator[Remembered]:
        return map(Remembered, self.inputs, self.outputs, self.columns)

    def state(self) -> dict[str, Array | Stamps]:
        """Copies of everything, for a file; :meth:`restore` takes them back."""
        return {'rows': self._rows[:self._count].copy()}

    def restore(self, state: Mapping[str, Array | Stamps]) -> None:
        """Return to a saved :meth:`state`. Raises ValueError when it is of another size."""
        rows = state['rows'].reshape(-1, self._rows.shape[1])
        self._make_room(len(rows))
        self._rows[:len(rows)], self._count = rows, len(rows)

    def _make_room(self, size: int) -> None:
        have = len(self._rows)
        if size > have:
            more = max(size, self.wanted, 2 * have) - have
            self._rows = np.concatenate((self._rows, np.zeros((more, self._rows.shape[1]))))


class Gathered(NamedTuple):
    """Part of a recording that an initial window takes."""

    indices: Stamps  # of the samples that it holds
    end: int  # samples of the recording until it is full, or all of them
    full: bool


def gathered_from(samples: Samples, wanted: int) -> Gathered:
    """The initial window of a recording that is learnt from its first sample on."""
    taken: list[int] = []
    motion: Motion | None = None
    rows = zip(samples.stamps.tolist(), samples.position, samples.outputs, strict=True)
    for index, (begins, row) in enumerate(zip(beginning_steps(samples.stamps).tolist(), rows, strict=True)):
        motion = at_start(*row) if motion is None else motion.after(*row)
        if motion.is_news and begins:
            taken.append(index)
        if len(taken) == wanted:
            return Gathered(np.array(taken), index + 1, True)
    return Gathered(np.array(taken, dtype=np.int64), len(samples), False)
