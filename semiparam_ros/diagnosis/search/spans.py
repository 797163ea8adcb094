"""From when to when an effect acts.

With sums of products from each of some times to the end of the recording, A_i, what columns explain between times i and
j beside the declared ones follows from A_i - A_j, so that every span of time is cheap to try.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_solve

from semiparam_ros.core.types import Array, Indices
from semiparam_ros.diagnosis.data.recordings import breaks_s, without_pauses
from semiparam_ros.diagnosis.data.splits import correlation_times
from semiparam_ros.diagnosis.regression import ROUNDED, Fit, refit_weights, refitted
from semiparam_ros.diagnosis.search.candidates import added_columns
from semiparam_ros.effects import Effect
from semiparam_ros.effects.base import Span

START_RIDGE = 1e-6


def best_spans(fit: Fit, effect: Effect, columns: Array, most: int | None = None) -> list[Span]:
    """When the effect may act, with columns (N, n, c) as if it always did: always, from a start on, until an end, or
    between both, of each the best; the ``most`` likeliest, of those that the kind's coefficients allow where there are
    such. What must begin does not always act, and what others do for a moment is a touch. Whatever does not belong to
    one recording may be in some of several.

    Each time costs the log of how many were tried, and as many samples count as one as stay alike in what the best span
    leaves. What was there until a time and what began then with the opposite sign are often one and the same to the
    model: then the sign tells them apart where the kind has one.
    """
    fitting, config = np.flatnonzero(fit.train_mask), fit.config
    begins = [] if effect.of_one_recording else np.searchsorted(
        fitting, [part.start for part in fit.samples.recordings[1:]]).tolist()
    breaks = [number for number in begins if 0 < number < len(fitting)]  # of some recordings nothing may fit
    margin = max(int(config.start_margin * len(fitting)), 1)
    within = np.linspace(margin, len(fitting) - margin, config.start_grid if effect.changes else 0).astype(int)
    edges = np.unique([*within.tolist(), *breaks]).astype(int)
    cost = np.where(np.isin(edges, breaks), math.log(len(breaks) + 1), math.log(config.start_grid))
    block, last, times = len(fitting) / config.blocks, len(edges) + 1, fit.samples.time[fitting[edges]]
    least_s = config.longest_contact_s if effect.from_outside else 0.0
    forms = [[(0, last)], [(i, last) for i in range(1, last)], [(0, j) for j in range(1, last)],
             [(i, j) for i in range(1, last) for j in range(i + 1, last)
              if edges[j - 1] - edges[i - 1] >= block and times[j - 1] - times[i - 1] > least_s]]
    forms = [form for form in forms[effect.must_start:] if form]
    spans = np.array([span for form in forms for span in form])
    squares, coefficients = _explained(fit, columns, fitting[np.append(0, edges)], spans)
    start, end = np.append(fitting[np.append(0, edges)], len(fit.samples))[spans[squares.argmax()]]
    left = fit.explain(columns * _between(len(fit.samples), start, end)).residual
    repeated = float(correlation_times(fit.used(left), config).mean())
    nats = 0.5 * squares / repeated - np.concatenate([[0.0], cost, [0.0]])[spans].sum(axis=1)
    parts = np.split(np.arange(len(spans)), np.cumsum([len(form) for form in forms])[:-1])
    best = sorted((int(part[nats[part].argmax()]) for part in parts), key=lambda number: -nats[number])
    best = [number for number in best if effect.physical(coefficients[number])] or best
    return [_to_the_sample(fit, columns, edges, start, end if end < last else 0)
            for start, end in spans[best[:most]].tolist()]


def _between(count: int, start: int, end: int) -> Array:
    """(N, 1, 1) one for samples from a number on until another, else zero."""
    number = np.arange(count)
    return ((number >= start) & (number < end)).astype(float)[:, None, None]


def _to_the_sample(fit: Fit, columns: Array, edges: Indices, start: int, end: int) -> Span:
    """The best span near one of which the start and the end are edges number ``start`` and ``end``, 0 for none; those
    at the beginning of a recording stay."""
    fitting = np.flatnonzero(fit.train_mask)
    times, breaks = fit.samples.time[fitting], breaks_s(fit.samples)
    step = int(np.diff(edges).max(initial=1))
    numbers = {name: int(edges[number - 1]) for name, number in (('start_s', start), ('end_s', end)) if number}
    found = {name: next((break_s for break_s in breaks if times[number - 1] < break_s <= times[number]),
                        float(times[number])) for name, number in numbers.items()}
    span = Span(**found)
    open_times = [name for name in numbers if found[name] not in breaks]
    for name in (*open_times, *open_times[:len(open_times) - 1]):
        low, high = np.clip((numbers[name] - step, numbers[name] + step), 0, len(times) - 1)
        span = best_edge(fit, columns, span, name, (float(times[low]), float(times[high])))
    return span


def best_edge(fit: Fit, columns: Array, span: Span, name: str, within_s: tuple[float, float]) -> Span:
    """The span with its ``start_s`` or ``end_s`` where columns (N, n, c), as if always there, explain most, between two
    times [s]. Between two samples that fit nothing tells one time from another: halfway errs least."""
    fitting, other = np.flatnonzero(fit.train_mask), replace(span, **{name: None})
    held = columns * other.holds(fit.samples.stamps, fit.samples.origin)[:, None, None]
    count = len(fitting)
    low, high = np.searchsorted(fit.samples.time[fitting], within_s).tolist()
    if other.start_s is not None:  # the other time is kept, and no span is empty
        low = max(low, int(np.searchsorted(fit.samples.time[fitting], other.start_s, 'right')) + 1)
    if other.end_s is not None:
        high = min(high, int(np.searchsorted(fit.samples.time[fitting], other.end_s)) - 1)
    low, high = min(max(low, 1), count - 1), min(max(low, high, 1), count - 1)
    near = np.unique(np.linspace(low, high, fit.config.start_grid).astype(int))
    for _ in range(2):  # some of the samples between both times, then every one near the best
        number = np.arange(1, len(near) + 1)
        spans = np.stack([number, np.full(len(near), len(near) + 1)] if name == 'start_s' else [0 * number, number], 1)
        best = int(near[np.argmax(_explained(fit, held, fitting[np.append(0, near)], spans)[0])])
        step = int(np.diff(near).max(initial=1))
        near = np.arange(max(best - step, 1), min(best + step + 1, count))
    edge = int(fitting[best - 1] + fitting[best] + 1) // 2
    return replace(other, **{name: float(fit.samples.time[edge])})


def with_best_edge(fit: Fit, effect: Effect, name: str, within_s: tuple[float, float]) -> Effect:
    """The effect with its ``start_s`` or ``end_s`` at the best between two times [s].

    :param fit: the model without the effect.
    """
    columns = added_columns(fit, effect.without_span())
    return replace(effect, span=best_edge(fit, columns, effect.span, name, within_s))


def around(fit: Fit, time_s: float) -> tuple[float, float]:
    """[s] from one block before a time to one after it; pauses between recordings are in no block."""
    times = without_pauses(fit.samples)[fit.train_mask]
    reach = float(times[-1] - times[0]) / fit.config.split_blocks
    return time_s - reach, time_s + reach


def without_divided(fit: Fit) -> Fit:
    """The model with no output counted of the working samples in which something begins or ends: a mean of what was
    before and of what came then is neither, and what is taken off means for their curvature reaches the next ones.

    The first one after a time tells it, so the one before may be the divided one.
    """
    times, length, breaks = fit.samples.time, fit.samples.averaged_s, breaks_s(fit.samples)
    divided = np.zeros(len(times), dtype=bool)
    for time_s in (time_s for effect in fit.effects for time_s in effect.span.values.values()):
        if time_s not in breaks:
            divided |= np.abs(times - (time_s - 0.5 * length)) < 3.0 * length
    if not fit.counted[divided].any():
        return fit
    return refit_weights(refitted(fit, fit.effects, fit.nuisance, fit.counted & ~divided[:, None]))


def _explained(fit: Fit, columns: Array, edges: Indices, spans: Indices) -> tuple[Array, Array]:
    """(k,) squares in scaled units that columns (N, n, c) explain beside the declared ones in spans (k, 2) between
    edges (s,), sample numbers in ascending order, and their coefficients (k, c); edge s is the end of the recording."""
    sums = _sums_from(fit, columns, edges)
    solved = cho_solve(fit.factor, np.hstack(list(sums[2]))).reshape(fit.n_columns, *sums[1].shape)
    i, j = spans.T
    gram, right, cross, solved = (each[i] - each[j] for each in (
        np.concatenate([each, 0.0 * each[:1]]) for each in (*sums, solved.transpose(1, 0, 2))))
    inner = gram - cross.transpose(0, 2, 1) @ solved
    least = ROUNDED * np.diagonal(sums[0][0]) + 1e-300  # below, a difference of sums is rounding
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), least))
    scaled = inner * unit[:, :, None] * unit[:, None, :] + START_RIDGE * np.eye(right.shape[1])
    found = np.linalg.solve(scaled, (right * unit)[:, :, None])[:, :, 0]
    return np.asarray((right * unit * found).sum(axis=1)), found * unit


def _sums_from(fit: Fit, columns: Array, starts: Indices) -> tuple[Array, Array, Array]:
    """Products of columns (N, n, c) with one another (s, c, c), with the residual (s, c) and with the declared ones
    (s, p, c) over the samples in use from each of the starts (s,) on, sample numbers in ascending order."""
    size = columns.shape[2]
    gram, right = np.zeros((len(starts), size, size)), np.zeros((len(starts), size))
    cross = np.zeros((len(starts), fit.n_columns, size))
    for channel in np.flatnonzero(columns.any(axis=(0, 2))).tolist():
        used, rows, support = (each[channel] for each in (
            fit.samples_in_use.numbers, fit.design.rows, fit.design.support))
        own, residual, weight = columns[used, channel], fit.residual[used, channel, None], fit.scale[channel] ** -2.0
        # One product a start: a few samples lie between most of them, and then a call costs more than its sums.
        left, part, sums = np.hstack([own, residual, rows]).T, own * weight, []
        for start, end in pairwise([*np.searchsorted(used, starts).tolist(), len(used)]):
            sums.append(left[:, start:end] @ part[start:end])
        channel_gram, channel_right, channel_cross = np.split(np.stack(sums), [size, size + 1], axis=1)
        gram += channel_gram
        right += channel_right[:, 0]
        cross[:, support] += channel_cross
    return _suffix(gram), _suffix(right), _suffix(cross)


def _suffix(values: Array) -> Array:
    return np.asarray(np.cumsum(values[::-1], axis=0)[::-1])
