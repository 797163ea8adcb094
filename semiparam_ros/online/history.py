"""The samples that were received, kept to build another variant from, or to diagnose."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.types import Array, Stamps

KEPT_OF_REST = 20
"""Samples of rest that are kept, the last before each motion."""


class SampleBatch(NamedTuple):
    """Samples in order of time, and which of them were learnt, (N,) bool."""

    samples: Samples | None
    learnt: Array

    def __len__(self) -> int:
        return len(self.learnt)

    def pairs(self) -> Iterator[tuple[Sample, bool]]:
        """One sample after the other."""
        return zip(self.samples or (), self.learnt.tolist(), strict=True)


class History:
    """The first ``first`` samples learnt (and what came between them), and the latest ``latest`` of those after them.

    Of a robot at rest only the last samples before it moves are kept, for effects that remember the past: hours of rest
    must not displace the motion.

    Rows are written into arrays made once, so memory stays flat. Time counts from ``origin`` [ns], the very first
    sample unless given.
    """

    def __init__(self, first: int, latest: int, n_joints: int, n_outputs: int, origin: int | None = None) -> None:
        self._n_joints = n_joints
        self._window = _Ring(2 * first, 3 * n_joints + n_outputs)
        self._recent = _Ring(max(latest, 1), 3 * n_joints + n_outputs)
        self._first, self._learnt = first, 0
        self._at_rest: deque[Sample] = deque(maxlen=KEPT_OF_REST)
        self.origin = origin

    def __len__(self) -> int:
        return len(self._window) + len(self._recent)

    def append(self, sample: Sample, learnt: bool, is_news: bool = True) -> None:
        """Keep one sample."""
        if self.origin is None:
            self.origin = sample.stamp
        if not is_news:
            self._at_rest.append(sample)
            return
        while self._at_rest:
            self._keep(self._at_rest.popleft(), False)
        self._keep(sample, learnt)

    def _keep(self, sample: Sample, learnt: bool) -> None:
        ring = self._window if self._learnt < self._first and not self._window.full else self._recent
        ring.append(sample, learnt)
        self._learnt += learnt

    def refill(self, batch: SampleBatch) -> None:
        """Keep what another history kept; time goes on counting from where it did there."""
        for sample, learnt in batch.pairs():
            self.append(sample, learnt)
        if batch.samples is not None:
            self.origin = batch.samples.origin

    def discard(self) -> None:
        """Forget all samples, and begin with the first again; time goes on."""
        self._window.clear()
        self._recent.clear()
        self._at_rest.clear()
        self._learnt = 0

    def latest(self) -> Sample | None:
        """The last sample, None before the first."""
        ring = self._recent if len(self._recent) else self._window
        row = ring.last()
        samples = None if row is None else _samples(*row, self._n_joints, self.origin)
        return None if samples is None else next(iter(samples))

    def batch(self) -> SampleBatch:
        """Everything that is kept, in order."""
        parts = [*self._window.rows(), *self._recent.rows(), *map(_row, self._at_rest)]
        stamps, rows, learnt = (np.concatenate(column) for column in zip(*parts, strict=True))
        return SampleBatch(_samples(stamps, rows, self._n_joints, self.origin), learnt)

    def span(self, seconds: float) -> Samples | None:
        """The latest samples of so many seconds, learnt or not, since the clock last jumped back; None without any."""
        samples = self.batch().samples
        if samples is None:
            return None
        jumps = np.flatnonzero(np.diff(samples.stamps) <= 0)
        samples = samples[int(jumps[-1]) + 1:] if len(jumps) else samples
        return samples[samples.stamps >= samples.stamps[-1] - round(seconds * 1e9)]


def batch_of(pairs: list[tuple[Sample, bool]]) -> SampleBatch:
    """The same from single samples."""
    samples = Samples.from_list([sample for sample, _ in pairs]) if pairs else None
    return SampleBatch(samples, np.array([learnt for _, learnt in pairs], dtype=bool))


def arrays_of(batch: SampleBatch) -> dict[str, Array | Stamps]:
    """A batch as arrays for a file; :func:`batch_from` reads them back."""
    samples = batch.samples
    if samples is None:
        return {'learnt': batch.learnt}
    return {'stamps': samples.stamps, 'position': samples.position, 'velocity': samples.velocity,
            'acceleration': samples.acceleration, 'outputs': samples.outputs, 'learnt': batch.learnt,
            'origin': np.array(samples.origin)}


def batch_from(arrays: Mapping[str, Array], n_joints: int, n_outputs: int) -> SampleBatch:
    """The batch of :func:`arrays_of`. Raises KeyError and ValueError where these are not its arrays."""
    learnt = arrays['learnt']
    if not len(learnt):
        return SampleBatch(None, learnt)
    stamps = arrays['stamps'].astype(np.int64)
    widths = {'position': n_joints, 'velocity': n_joints, 'acceleration': n_joints, 'outputs': n_outputs}
    position, velocity, acceleration, outputs = (arrays[name].reshape(len(stamps), width)
                                                 for name, width in widths.items())
    return SampleBatch(Samples(stamps, position, velocity, acceleration, outputs, int(arrays['origin'])), learnt)


class _Ring:
    """Rows that overwrite the oldest once there are ``size`` of them."""

    def __init__(self, size: int, width: int) -> None:
        self._stamps = np.zeros(size, dtype=np.int64)
        self._rows = np.empty((size, width))
        self._rows.fill(0.0)  # takes the memory now, where zeros would take it page by page while samples come
        self._learnt = np.zeros(size, dtype=bool)
        self._count = 0

    def __len__(self) -> int:
        return min(self._count, len(self._stamps))

    def clear(self) -> None:
        self._count = 0

    @property
    def full(self) -> bool:
        return self._count >= len(self._stamps)

    def append(self, sample: Sample, learnt: bool) -> None:
        slot = self._count % len(self._stamps)
        self._stamps[slot], self._learnt[slot] = sample.stamp, learnt
        np.concatenate(sample[1:], out=self._rows[slot])
        self._count += 1

    def last(self) -> tuple[Stamps, Array] | None:
        """Stamp and row of the latest, as arrays of one."""
        if not self._count:
            return None
        slot = [(self._count - 1) % len(self._stamps)]
        return self._stamps[slot], self._rows[slot]

    def rows(self) -> list[tuple[Stamps, Array, Array]]:
        """Views in order of arrival: the older part and the newer one."""
        slot = self._count % len(self._stamps)
        parts = (slice(slot, None), slice(0, slot)) if self.full else (slice(0, slot),)
        return [(self._stamps[part], self._rows[part], self._learnt[part]) for part in parts]


def _row(sample: Sample) -> tuple[Stamps, Array, Array]:
    """One that is not learnt."""
    return np.array([sample.stamp]), np.concatenate(sample[1:])[None], np.array([False])


def _samples(stamps: Stamps, rows: Array, n: int, origin: int | None) -> Samples | None:
    if not len(stamps) or origin is None:
        return None
    return Samples(stamps, rows[:, :n], rows[:, n:2 * n], rows[:, 2 * n:3 * n], rows[:, 3 * n:], origin)
