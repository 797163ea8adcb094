"""The samples that were received, kept to build another variant from, or to diagnose.

They lie in chunks that are only ever appended to, so that any number of them can be handed over, to a thread, a process
or a file, without copying them first: the thread that answers samples has no time for that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.motion import beginning_steps, begins_step
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.core.stamps import LONGEST_PAUSE_NS, LONGEST_STEP_S
from semiparam_ros.core.types import Array, Codes, Mask, Stamps
from semiparam_ros.online.learning import Learning, begins_anew

KEPT_OF_REST = 20
"""Samples of rest that are kept, the last before each motion."""

CHUNK = 2048
"""Samples of a chunk, which is sent to a process in one piece: some hundred kilobytes."""


LONGEST_GAP_NS = LONGEST_PAUSE_NS // 2
"""Of samples that are let go one is kept so often: a longer gap would be taken for a jump of the clock
(:mod:`semiparam_ros.core.estimator`)."""


class Rows(NamedTuple):
    """N samples in order of time that nobody changes any more."""

    stamps: Stamps  # (N,) [ns]
    values: Array  # (N, 3 n_joints + n_outputs) position, velocity, acceleration, outputs
    learnt: Codes  # (N,) what became of each, see Learning
    temperature: Array  # (N, k)

    def part(self, chosen: slice | Mask) -> Rows:
        """Some of them; those of a slice are not copied."""
        return Rows(self.stamps[chosen], self.values[chosen], self.learnt[chosen], self.temperature[chosen])

    def copy(self) -> Rows:
        """The same, which keep nothing else in memory."""
        return Rows(self.stamps.copy(), self.values.copy(), self.learnt.copy(), self.temperature.copy())


@dataclass(frozen=True)
class SampleBatch:
    """Samples in order of time, and which of them were learnt; ``origin`` [ns] is where their time starts, and they are
    each ``every``-th of those that came."""

    rows: Sequence[Rows]
    n_joints: int
    origin: int | None
    every: int = 1

    def __len__(self) -> int:
        return sum(len(rows.stamps) for rows in self.rows)

    @property
    def stamps(self) -> Stamps:
        """(N,) [ns], a copy."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *(rows.stamps for rows in self.rows)])

    @property
    def learnt(self) -> Mask:
        """(N,), a copy."""
        return self.learning > 0

    @property
    def learning(self) -> Codes:
        """(N,) what became of each, see :class:`~semiparam_ros.online.learning.Learning`; a copy."""
        return np.concatenate([np.zeros(0, dtype=np.int8), *(rows.learnt for rows in self.rows)])

    @property
    def samples(self) -> Samples | None:
        """A copy of the samples; None where there are none."""
        if not len(self) or self.origin is None:
            return None
        values, n = np.concatenate([rows.values for rows in self.rows]), self.n_joints
        return Samples(self.stamps, values[:, :n], values[:, n:2 * n], values[:, 2 * n:3 * n], values[:, 3 * n:],
                       self.origin, every=self.every,
                       temperature=np.concatenate([rows.temperature for rows in self.rows]))

    def pairs(self) -> Iterator[tuple[Sample, int]]:
        """One sample after the other."""
        n = self.n_joints
        for rows in self.rows:
            for stamp, row, learnt, temperature in zip(rows.stamps.tolist(), rows.values, rows.learnt.tolist(),
                                                       rows.temperature, strict=True):
                yield Sample(stamp, row[:n], row[n:2 * n], row[2 * n:3 * n], row[3 * n:], temperature), learnt

    def part(self, start: int, stop: int | None = None, step: int = 1) -> SampleBatch:
        """Some of them, not copied: those of these numbers."""
        chosen, stop = [], len(self) if stop is None else stop
        for rows in self.rows:
            end = min(stop, len(rows.stamps))
            if start < end:
                chosen.append(rows.part(slice(start, end, step)))
                start += -(-(end - start) // step) * step
            start, stop = start - len(rows.stamps), stop - len(rows.stamps)
        return replace(self, rows=chosen, every=step * self.every)

    def chosen(self, mask: Mask) -> SampleBatch:
        """Samples of a mask (N,), copied."""
        ends = np.cumsum([len(rows.stamps) for rows in self.rows])[:-1]
        return replace(self, rows=[rows.part(part) for rows, part in
                                   zip(self.rows, np.split(mask, ends), strict=True)])


class SampleLog:
    """Samples in order of arrival, the latest ``most`` of them, or all."""

    def __init__(self, most: int | None = None) -> None:
        self._most, self._n_joints = most, 0
        self._chunks: deque[Rows] = deque()
        self._first = self._count = 0
        """The first row in use of the first chunk, and the samples in use."""
        self._free = 0
        """Rows of the last chunk that are still to be written."""

    def __len__(self) -> int:
        return self._count

    def append(self, sample: Sample, learnt: int) -> None:
        """Keep one sample."""
        if not self._free:
            self._n_joints, width = len(sample.position), sum(map(len, sample[1:5]))
            self._chunks.append(Rows(np.empty(CHUNK, np.int64), np.empty((CHUNK, width)),
                                     np.empty(CHUNK, np.int8),
                                     np.empty((CHUNK, len(sample.temperature)))))
            self._free = CHUNK
        chunk = self._chunks[-1]
        row = len(chunk.stamps) - self._free
        chunk.stamps[row], chunk.learnt[row], chunk.temperature[row] = sample.stamp, learnt, sample.temperature
        np.concatenate(sample[1:5], out=chunk.values[row])
        self._free -= 1
        self._count += 1
        self._let_go()

    def extend(self, batch: SampleBatch) -> None:
        """Keep those of a batch, which are not copied, after others of batches."""
        assert not self._free, 'a chunk that is being written stays the last one'
        self._n_joints = batch.n_joints
        for rows in batch.rows:
            for start in range(0, len(rows.stamps), CHUNK):
                part = rows.part(slice(start, start + CHUNK))
                self._chunks.append(part)
                self._count += len(part.stamps)
        self._let_go()

    def rows(self) -> list[Rows]:
        """All of them, not copied."""
        result = []
        for number, chunk in enumerate(self._chunks):
            start = 0 if number else self._first
            end = len(chunk.stamps) - (self._free if number == len(self._chunks) - 1 else 0)
            if start < end:
                result.append(chunk.part(slice(start, end)))
        return result

    def first(self) -> SampleBatch:
        """The oldest one."""
        chunk = self._chunks[0].part(slice(self._first, self._first + 1))
        return SampleBatch([chunk], self._n_joints, int(chunk.stamps[0]))

    def batch(self) -> SampleBatch:
        """All of them; time starts with the first."""
        rows = self.rows()
        return SampleBatch(rows, self._n_joints, int(rows[0].stamps[0]) if rows else None)

    def _let_go(self) -> None:
        """Drop the oldest, a whole chunk at a time."""
        if self._most is None or self._count <= self._most:
            return
        self._first += self._count - self._most
        self._count = self._most
        while self._first >= len(self._chunks[0].stamps):
            self._first -= len(self._chunks.popleft().stamps)


class History:
    """The first ``first`` samples learnt (and what came between them), the latest ``latest`` of those after them, and
    one of each half hour that was let go between them.

    Of a robot at rest one of each half hour, and else only the last samples before it moves are kept, for effects that
    remember the past: hours of rest must not displace the motion.

    Time counts from ``origin`` [ns], the very first sample unless given.
    """

    def __init__(self, first: int, latest: int, n_joints: int, origin: int | None = None) -> None:
        self._n_joints, self._first, self._latest = n_joints, first, max(latest, 1)
        self.origin: int | None
        self.discard(origin)

    def __len__(self) -> int:
        return len(self._window) + len(self._bridge) + len(self._recent)

    def append(self, sample: Sample, learnt: int) -> None:
        """Keep one sample."""
        if self.origin is None:
            self.origin = sample.stamp
        if not len(self) and not self._at_rest:
            self._kept = sample.stamp
        if learnt == Learning.NO_NEWS:
            if len(self._at_rest) == KEPT_OF_REST and _far(self._at_rest[0].stamp, self._kept):
                self._keep(self._at_rest[0], Learning.NO_NEWS)
            self._at_rest.append(sample)
            return
        while self._at_rest:
            self._keep(self._at_rest.popleft(), Learning.NO_NEWS)
        self._keep(sample, learnt)

    def _keep(self, sample: Sample, learnt: int) -> None:
        begins = not len(self) or begins_step(sample.stamp, self._kept)
        if self._gathers:
            self._window.append(sample, learnt)
            self._bridged = sample.stamp
        else:
            if len(self._recent) >= self._latest:
                self._let_go(self._recent.first())
            self._recent.append(sample, learnt)
        self._steps += begins
        self._learnt += begins and learnt > 0
        self._kept = sample.stamp

    def _let_go(self, batch: SampleBatch) -> None:
        """Keep one of each half hour of samples that are let go; copies, as a part keeps its whole chunk."""
        stamps = batch.stamps
        for number in range(len(batch)):
            if _far(int(stamps[number]), self._bridged):
                one = batch.part(number, number + 1)
                self._bridge.extend(replace(one, rows=[rows.copy() for rows in one.rows]))
                self._bridged = int(stamps[number])

    @property
    def _gathers(self) -> bool:
        return self._learnt < self._first and self._steps < 2 * self._first

    def refill(self, batch: SampleBatch) -> None:
        """Keep what another history kept, in place of anything else; time goes on counting from where it did there."""
        self.discard(self.origin)
        stamps = batch.stamps
        begins = beginning_steps(stamps)
        steps, learnt = np.cumsum(begins), np.cumsum(begins & batch.learnt)
        end = min(int(np.searchsorted(learnt, self._first)), int(np.searchsorted(steps, 2 * self._first))) + 1
        end = min(end, len(batch))
        self._window.extend(batch.part(0, end))
        if len(batch):
            self._bridged, self._kept = int(stamps[end - 1]), int(stamps[-1])
        recent = max(end, len(batch) - self._latest)
        self._let_go(batch.part(end, recent))
        self._recent.extend(batch.part(recent))
        if len(batch):
            self._steps, self._learnt = int(steps[-1]), int(learnt[-1])
        self.origin = batch.origin if len(batch) else self.origin

    def discard(self, origin: int | None) -> None:
        """Forget all samples, and begin with the first again; time counts from ``origin`` [ns], which
        has moved along when the clock jumped."""
        self.origin = origin
        self._window, self._bridge, self._recent = SampleLog(), SampleLog(), SampleLog(self._latest)
        self._bridged = self._kept = 0
        self._at_rest: deque[Sample] = deque(maxlen=KEPT_OF_REST)
        self._steps = self._learnt = 0
        """Steps, and those of which a sample was learnt, for the window."""

    def latest(self) -> Sample | None:
        """The last sample, None before the first."""
        rows = (self._recent if len(self._recent) else self._window).rows()
        batch = SampleBatch([each.part(slice(-1, None)) for each in rows[-1:]], self._n_joints, self.origin)
        return next((sample for sample, _ in batch.pairs()), None)

    def batch(self) -> SampleBatch:
        """Everything that is kept, in order."""
        at_rest = batch_of((sample, Learning.NO_NEWS) for sample in self._at_rest)
        rows = [*self._window.rows(), *self._bridge.rows(), *self._recent.rows(), *at_rest.rows]
        return SampleBatch(rows, self._n_joints, self.origin)

    def span(self, seconds: float) -> SampleBatch:
        """The latest samples of so many seconds, learnt or not, since the clock last jumped back."""
        batch = self._since_jump()
        stamps = batch.stamps
        return batch.part(int(np.searchsorted(stamps, stamps[-1:] - round(seconds * 1e9)).sum()))

    def around(self, stamp: int, seconds: float) -> SampleBatch:
        """The samples from a stamp [ns] on, and those of so many seconds before it, in which a pause
        counts as one long step; since the clock last jumped back."""
        batch = self._since_jump()
        stamps = batch.stamps
        passed = np.cumsum(np.minimum(np.diff(stamps, prepend=stamps[:1]) * 1e-9, LONGEST_STEP_S))
        at = int(np.searchsorted(stamps, stamp))
        until = float(passed[min(at, len(passed) - 1)]) if len(passed) else 0.0
        return batch.part(int(np.searchsorted(passed, until - seconds)))

    def _since_jump(self) -> SampleBatch:
        batch = self.batch()
        jumps = np.flatnonzero(np.diff(batch.stamps) <= 0)
        return batch.part(int(jumps[-1]) + 1 if len(jumps) else 0)


def _far(stamp: int, before: int) -> bool:
    return not 0 <= stamp - before <= LONGEST_GAP_NS


def batch_of(pairs: Iterable[tuple[Sample, int]]) -> SampleBatch:
    """The same from single samples; time starts with the first."""
    log = SampleLog()
    for sample, learnt in pairs:
        log.append(sample, learnt)
    return log.batch()


def arrays_of(batch: SampleBatch) -> dict[str, Array | Stamps | Codes]:
    """A batch as arrays for a file; :func:`batch_from` reads them back."""
    samples = batch.samples
    if samples is None:
        return {'learnt': batch.learning}
    return {'stamps': samples.stamps, 'position': samples.position, 'velocity': samples.velocity,
            'acceleration': samples.acceleration, 'outputs': samples.outputs, 'learnt': batch.learning,
            'temperature': samples.temperature, 'origin': np.array(samples.origin)}


def batch_from(arrays: Mapping[str, Array], n_joints: int, n_outputs: int) -> SampleBatch:
    """The batch of :func:`arrays_of`. Raises KeyError and ValueError where these are not its arrays."""
    learnt = arrays['learnt'].astype(np.int8)
    if not np.isin(learnt, [*Learning, *map(begins_anew, Learning)]).all():
        raise ValueError("'learnt' holds what is no fate of a sample")
    if not len(learnt):
        return SampleBatch([], n_joints, None)
    stamps = arrays['stamps'].astype(np.int64)
    widths = {'position': n_joints, 'velocity': n_joints, 'acceleration': n_joints, 'outputs': n_outputs}
    values = np.hstack([arrays[name].reshape(len(learnt), width) for name, width in widths.items()])
    rows = Rows(stamps.reshape(len(learnt)), values, learnt, arrays['temperature'].reshape(len(learnt), -1))
    return SampleBatch([rows], n_joints, int(arrays['origin']))
