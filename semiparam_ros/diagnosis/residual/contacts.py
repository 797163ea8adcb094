"""Touches in a recording: short stretches that no effect explains, when they were, where they show, and how large."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, grey_opening

from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.data.outliers import NORMAL_MAD
from semiparam_ros.diagnosis.data.splits import ranges
from semiparam_ros.diagnosis.regression import Fit, with_effects


class Contact(NamedTuple):
    """One touch, from ``start_s`` to ``end_s`` [s since the origin].

    ``channels``: the outputs that show it, with the largest residual in their units. ``joint``: of efforts, the last
    joint that feels it, so the touch is on the link that it moves; None for a wrench.
    """

    start_s: float
    end_s: float
    channels: dict[str, float]
    joint: str | None


def contacts(fit: Fit) -> list[Contact]:
    """Touches in the order of time; none where what is left bursts so often that it is no touch.

    A joint feels every touch on the links beyond it, and none on those before it.
    """
    config = fit.config
    fit = _without_bursts(fit)
    middle = _middle(fit)
    deviations = _deviations(fit)
    time = fit.samples.time
    found, touched = list[Contact](), 0
    for start, end in _merged(ranges(deviations.max(axis=1) > config.contact_release), time, config.contact_pause_s):
        peaks = deviations[start:end].max(axis=0)
        if peaks.max() < config.contact_deviations or time[end - 1] - time[start] > config.longest_contact_s:
            continue
        felt = peaks > config.contact_release
        left = (fit.residual[start:end] - middle) * fit.counted[start:end]
        largest = left[np.abs(left).argmax(axis=0), np.arange(left.shape[1])]
        channels = {name: float(value) for name, value, shows in zip(
            fit.body.output_names, largest, felt, strict=True) if shows}
        last = max(np.flatnonzero(felt).tolist(), key=lambda number: int(fit.body.output_rows[number]))
        joint = fit.body.output_names[last] if fit.body.outputs == 'effort' else None
        found.append(Contact(float(time[start]), float(time[end - 1]), channels, joint))
        touched += end - start
    return found if touched < config.most_contact_share * len(time) else []


def bend(spans: Sequence[tuple[float, float]], fit: Fit) -> bool:
    """Return whether touches between some times [s] hold much of what the model leaves of an output, in little time:
    what lasts longer may be what the model lacks."""
    inside, squares = np.zeros(len(fit.samples), dtype=bool), (fit.residual * fit.counted) ** 2
    for start_s, end_s in spans:
        inside |= (start_s <= fit.samples.time) & (fit.samples.time <= end_s)
    shares = squares[inside].sum(axis=0) / (squares.sum(axis=0) + 1e-300)
    return bool(inside.mean() < fit.config.little < shares.max())


def _without_bursts(fit: Fit) -> Fit:
    """The same model fitted where nothing bursts: large touches bend a fit until everything seems to burst a little."""
    for _ in range(fit.config.rounds):
        calm = _deviations(fit).max(axis=1) < fit.config.contact_release
        use = fit.train_mask & calm
        if use.sum() < (1.0 - fit.config.most_contact_share) * fit.train_mask.sum():
            break
        fit = with_effects(replace(fit, train_mask=use), fit.effects)
    return fit


def _deviations(fit: Fit) -> Array:
    """(N, n) sizes of the residual in robust standard deviations, as far as neighbouring samples agree."""
    left = np.abs(fit.residual - _middle(fit))
    scale = NORMAL_MAD * np.array([np.median(values[fit.train_mask & use]) if (fit.train_mask & use).any() else 0.0
                                   for values, use in zip(left.T, fit.counted.T, strict=True)])
    scale = np.maximum(scale, 1e-6 * np.abs(fit.samples.outputs).max(axis=0) + 1e-12)
    deviations = left / scale * (fit.counted & ~_turning(fit))
    deviations = grey_opening(deviations, (fit.config.contact_samples, 1))  # a single sample counts for nothing
    inside = np.flatnonzero(fit.train_mask)
    deviations[:inside[0] + 1] = deviations[inside[-1]:] = 0.0  # a smoother sees the ends from one side
    return deviations


def _turning(fit: Fit) -> Mask:
    """(N, n) efforts of joints that are just turning back, where the model holds their friction: its form is only known
    so well there, and next to little noise the rest of it looks like a touch."""
    rubbing = [any(effect.where == joint and effect.shows_against == 'velocity' for effect in fit.effects)
               for joint in fit.body.output_names]
    if not any(rubbing):
        return np.zeros(fit.residual.shape, dtype=bool)
    forward = fit.samples.velocity[:, fit.body.output_index] > 0.0
    turns = np.diff(forward, axis=0, prepend=forward[:1])
    return np.asarray(binary_dilation(turns, np.ones((2 * fit.config.contact_samples + 1, 1))) & rubbing)


def _middle(fit: Fit) -> Array:
    """(n,) median of what is left of each output."""
    return np.asarray(np.median(fit.residual[fit.train_mask], axis=0))


def _merged(parts: list[tuple[int, int]], time: Array, pause_s: float) -> list[tuple[int, int]]:
    """Parts with shorter pauses between them as one."""
    merged: list[tuple[int, int]] = []
    for start, end in parts:
        if merged and time[start] - time[merged[-1][1] - 1] < pause_s:
            merged[-1] = (merged[-1][0], end)
        else:
            merged.append((start, end))
    return merged

