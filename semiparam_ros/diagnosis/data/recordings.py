"""Several recordings of one robot in one diagnosis: what each has for itself, and effects that are in some of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array, Indices, Mask
from semiparam_ros.effects import Effect, kinds
from semiparam_ros.effects.base import Span
from semiparam_ros.errors import SemiparamError


def whole_groups(samples: Samples, factor: int, stretches: Sequence[int] = ()) -> Samples:
    """The samples without a remainder of each recording, so that no mean of ``factor`` samples is over two of them.

    :param stretches: how many samples each stretch of a long recording holds, in place of recordings.

    Raises SemiparamError for a recording of fewer.
    """
    kept = in_whole_groups(samples, factor, stretches)
    return samples if len(kept) == len(samples) else samples[kept]


def in_whole_groups(samples: Samples, factor: int, stretches: Sequence[int] = ()) -> Indices:
    """(M,) the numbers of the samples that :func:`whole_groups` keeps."""
    counts = stretches or [part.stop - part.start for part in samples.recordings]
    if len(counts) == 1 or factor == 1:
        return np.arange(len(samples))
    if not stretches and min(counts) < factor:
        raise SemiparamError(f'recording {counts.index(min(counts)) + 1} holds {min(counts)} samples; '
                             f'expected at least {factor}, which are averaged.')
    starts = np.cumsum([0, *counts[:-1]]).tolist()
    keep = [np.arange(start, start + count - count % factor) for start, count in zip(starts, counts, strict=True)]
    return np.concatenate(keep)


def beside_breaks(samples: Samples, margin: int) -> Mask:
    """(N,) true for the first and the last ``margin`` samples of each recording that lie at a break."""
    mask = np.zeros(len(samples), dtype=bool)
    for part in samples.recordings[1:]:
        mask[max(part.start - margin, 0):part.start + margin] = True
    return mask


def alone(samples: Samples, part: slice) -> Samples:
    """One of the recordings, its time counted from its own start."""
    return replace(samples[part], breaks=(), origin=int(samples.stamps[part.start]))


def breaks_s(samples: Samples) -> list[float]:
    """[s] where recordings after the first begin."""
    return [(stamp - samples.origin) * 1e-9 for stamp in samples.breaks]


def own_time(samples: Samples, names: Sequence[str], time_s: float) -> tuple[float, str]:
    """A time [s] since the beginning of the recording that it is in, and words that name that one of several."""
    breaks = breaks_s(samples)
    number = int(np.searchsorted(breaks, time_s, side='right'))
    return time_s - [0.0, *breaks][number], f' of {names[number]}' if breaks else ''


def without_pauses(samples: Samples) -> Array:
    """(N,) [s] times as if each recording began a second after the one before it."""
    steps = np.diff(samples.time, prepend=samples.time[0])
    steps[[part.start for part in samples.recordings[1:] if part.start < part.stop]] = 1.0
    return np.asarray(samples.time[0] + np.cumsum(steps)) if samples.breaks else samples.time


def own_offsets(body: RigidBody, samples: Samples) -> list[Effect]:
    """The offset of a wrench in each recording after the first, whose offset belongs to the model."""
    times = breaks_s(samples)
    return [kind(span=Span(start, end_s=end)) for kind in kinds(body.outputs).values() if kind.own_in_each_recording
            for start, end in zip(times, [*times[1:], None], strict=False)]


def during(samples: Samples, number: int, effect: Effect) -> Effect:
    """The effect in one of the recordings alone, its own times counted from where that one begins."""
    begin, end = ([None, *breaks_s(samples), None][place] for place in (number, number + 1))
    own = effect.at_stamps(samples.origin + round((begin or 0.0) * 1e9)).in_recording(samples.origin).span
    starts, ends = ([time_s for time_s in times if time_s is not None]
                    for times in ((begin, own.start_s), (end, own.end_s)))
    return replace(effect, span=Span(max(starts, default=None), end_s=min(ends, default=None)))


def present(samples: Samples, names: Sequence[str], effect: Effect) -> tuple[str, ...]:
    """Names of the recordings in which the effect acts, at least for a part."""
    start, end = effect.span.start_s, effect.span.end_s
    times = [samples.time[[part.start, part.stop - 1]] for part in samples.recordings]
    return tuple(name for name, (begin, stop) in zip(names, times, strict=True)
                 if (start is None or start <= stop) and (end is None or begin < end))
