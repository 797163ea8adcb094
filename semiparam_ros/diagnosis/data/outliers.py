"""Leaves out samples near gaps and shocks, and outputs of joints at rest, by rules that never look at
the model.

A gap spoils every quantity that is differentiated across it. A shock (a collision, a protective stop, a corrupted
reading) is a change between successive samples that the channel makes at no other time; what follows rings for a while.

Static friction holds any effort up to its own, so the effort of a joint at rest tells nothing. Where
a joint is slow or turns back, the form of its dry friction decides what its effort is; where it
slides, dry friction is constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter1d, minimum_filter1d

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.signals.rests import still, typical_step, window_size
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig

NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


class Gap(NamedTuple):
    """A hole in time: number of the sample before it, when that was [s since the origin], how long the hole is [s]."""

    before: int
    start_s: float
    length_s: float


def gaps(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> list[Gap]:
    """Every step longer than ``config.gap_steps`` median steps, the pauses between recordings aside."""
    if len(samples) < 3:
        return []
    time = samples.time
    steps = np.diff(time)
    return [Gap(int(at), float(time[at]), float(steps[at]))
            for at in np.flatnonzero(steps > config.gap_steps * typical_step(time))
            if samples.stamps[at + 1] not in samples.breaks]


def working_factor(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> int:
    """Number of samples that one working sample averages."""
    if len(samples) < 2:
        return 1
    rate = 1e9 / float(np.median(np.diff(samples.stamps)))
    return max(int(rate / config.working_rate_hz), 1)


def margin(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> int:
    """Number of samples beside a gap or a break that are left out."""
    return max(config.gap_margin, working_factor(samples, config) * config.smoothing_ends)


def untouched(samples: Samples, contacts: Sequence[tuple[float, float]],
              config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N,) the samples that may be used: none :func:`excluded`, and none of contacts [s]."""
    clean = ~excluded(samples, config)
    for first, last in contacts:
        clean &= (samples.time < first) | (samples.time > last)
    return clean


def excluded(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N,) true for samples near a gap or a shock: neither a fit nor an evaluation should use them."""
    if samples.breaks:
        return np.concatenate([excluded(replace(samples[part], breaks=()), config) for part in samples.recordings])
    mask = np.zeros(len(samples), dtype=bool)
    for gap in gaps(samples, config):
        beside = margin(samples, config)
        mask[max(gap.before + 1 - beside, 0):gap.before + 1 + beside] = True
    if len(samples) > 3:
        for channel in samples.outputs.T:
            near = _around(samples.time, shocks(channel, config), config.shock_margin_s)
            mask |= near & (np.mean(near) <= config.most_shock_share)
    return mask


def shocks(channel: Array, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N,) true for the two samples on either side of a change that this channel (N,) makes at no other time.

    The robust deviation is never taken for less than the converter's own step: where most changes are 0 and the rest
    one step, a change of a few steps is no shock.
    """
    changes = np.diff(channel)
    sizes = np.abs(changes - np.median(changes))
    moved = np.abs(changes[changes != 0.0])
    usual = max(NORMAL_MAD * float(np.median(sizes)), float(moved.min()) if len(moved) else 0.0)
    hit = (sizes > config.shock_deviations * usual) & (sizes > config.shock_share * channel.std())
    return np.append(hit, False) | np.append(False, hit)


def _around(time: Array, hit: Mask, margin_s: float) -> Mask:
    """Samples within ``margin_s`` of those that were hit."""
    mask = np.zeros(len(time), dtype=bool)
    for index in np.flatnonzero(hit):
        start, end = np.searchsorted(time, (time[index] - margin_s, time[index] + margin_s), side='left')
        mask[start:end + 1] = True
    return mask


def resting(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N, n_joints) true where a joint stays where it is for ``config.rest_s``."""
    middle = still(samples.time, samples.position, samples.velocity, config.rest_speed_share, config.rest_s)
    return np.asarray(binary_dilation(middle, np.ones((window_size(samples.time, config.rest_s), 1))))


def sliding(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N, n_joints) true where a joint goes one way, and faster than ``config.friction_turn_share`` of
    its highest speed, for ``config.sliding_s`` before and after."""
    size = 2 * max(round(config.sliding_s / typical_step(samples.time)), 1) + 1
    velocity = samples.velocity
    slow = config.friction_turn_share * np.abs(velocity).max(axis=0)
    return np.asarray((minimum_filter1d(velocity, size, axis=0) > slow)
                      | (maximum_filter1d(velocity, size, axis=0) < -slow))


def counted_outputs(body: RigidBody, samples: Samples, config: DiagnosisConfig = DEFAULTS) -> Mask:
    """(N, n) outputs that tell something: of efforts, those of joints that move.

    Those of a joint that hardly ever moves stay, for nothing would be left of it.
    """
    counted = np.ones(samples.outputs.shape, dtype=bool)
    if body.outputs == 'effort':
        moving = ~resting(samples, config)[:, body.output_index]
        counted = moving | (moving.sum(axis=0) < config.least_working_samples)
    return counted
