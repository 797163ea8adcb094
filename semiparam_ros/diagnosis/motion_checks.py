"""Do positions, velocities, accelerations and stamps tell the same story? No model is needed to see it.

The change of a signal over a fraction of a second is compared with the integral of its declared rate; their ratio is 1
when units, signs, order and clock are right. Measured: 0.92 to 0.97 on a real iCub (its velocities lag), 1.00 on a UR3,
1.02 on a Franka arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.exclusion import GAP_STEPS, typical_step
from semiparam_ros.diagnosis.setup_problem import SetupProblem

SPAN_S = 0.2
"""Seconds over which a change is compared with an integral: long against noise, short against the motion."""
LEAST_SPANS, MOST_SPANS = 50, 4000
"""The spans are shortened where stamps in a wrong unit would leave too few of them."""
LEAST_MOTION = 0.01
"""A joint that moves less than this in all [rad, or m] says nothing about units."""
TOLERANCE = 1.25
"""A ratio within this factor of a known one is that one; within it of 1, all is well."""
AGREEING = 0.6
"""Share of the spans that must agree with the median ratio, to a third of it, before anything is said."""
THEIRS, OWN = 0.9, 0.5
"""Least correlation with another joint's velocity, and most with the own one, before their order is doubted."""
STILL = 1e-3
DEGREE = float(np.pi / 180.0)
UNITS = {1.0 / DEGREE: ('position', 'degrees', DEGREE), DEGREE: ('velocity', 'degrees per second', DEGREE),
         0.5 / np.pi: ('position', 'revolutions', 2.0 * np.pi),
         np.pi / 30.0: ('velocity', 'revolutions per minute', np.pi / 30.0)}
RATE_UNITS = {DEGREE: 'degrees per second squared'}


class Ratio(NamedTuple):
    """Change of a signal over the integral of its declared rate: the median, and the share of spans that agree."""

    value: float
    agreement: float

    @property
    def is_telling(self) -> bool:
        """Whether the spans agree at all."""
        return self.agreement > AGREEING

    def near(self, value: float) -> bool:
        """Whether it is ``value``, sign included, beyond doubt."""
        share = self.value / value
        return self.is_telling and 1.0 / TOLERANCE < share < TOLERANCE


def motion_problems(joints: Sequence[str], samples: Samples) -> tuple[list[SetupProblem], Samples]:
    """Contradictions between positions, velocities, accelerations and stamps, and the samples put right."""
    moving = np.ptp(samples.position, axis=0) > LEAST_MOTION
    changes, integrals = _spans(samples.time, samples.position, samples.velocity)
    order = _velocity_order(joints, changes, integrals, moving)
    if order:
        return order, samples
    ratios = [_ratio(changes[:, joint], integrals[:, joint]) if moving[joint] else Ratio(1.0, 0.0)
              for joint in range(len(joints))]
    clock = _clock(samples, ratios)
    if clock:
        return clock, samples
    problems, right = [], samples
    for joint, (name, ratio) in enumerate(zip(joints, ratios, strict=True)):
        silent = moving[joint] and np.std(integrals[:, joint]) < STILL * np.std(changes[:, joint])
        found = _silent(name) if silent else _velocity(name, ratio)
        if found is not None:
            problem, role, factor = found
            problems.append(problem)
            right = _scaled(right, role, joint, factor)
    return problems + _accelerations(joints, samples, right, moving), right


def _spans(time: Array, values: Array, rates: Array) -> tuple[Array, Array]:
    """(M, k) changes of values (N, k) over SPAN_S, and the integrals of their rates over the same spans."""
    steps = np.diff(time)
    typical = typical_step(time)
    width = int(np.clip(round(SPAN_S / typical), 1, max(len(time) // LEAST_SPANS, 1)))
    pieces = 0.5 * (rates[1:] + rates[:-1]) * steps[:, None]
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(pieces, axis=0)])
    starts = np.unique(np.linspace(0, max(len(time) - 1 - width, 0), MOST_SPANS).astype(int))
    ends = np.minimum(starts + width, len(time) - 1)
    whole = time[ends] - time[starts] < (width + GAP_STEPS) * typical
    starts, ends = starts[whole], ends[whole]
    return values[ends] - values[starts], total[ends] - total[starts]


def _ratio(changes: Array, integrals: Array) -> Ratio:
    """Of one joint, from the faster half of its spans."""
    fast = np.abs(integrals) > np.median(np.abs(integrals))
    if not fast.any():
        return Ratio(1.0, 0.0)
    shares = changes[fast] / integrals[fast]
    middle = float(np.median(shares))
    return Ratio(middle, float(np.mean(np.abs(shares - middle) < abs(middle) / 3.0)))


def _velocity_order(joints: Sequence[str], changes: Array, integrals: Array, moving: Array) -> list[SetupProblem]:
    """Pairs of joints whose velocities belong to each other's positions."""
    likeness = _correlation(changes, integrals)
    own = np.diag(likeness)
    found = []
    for one in range(len(joints)):
        for other in range(one + 1, len(joints)):
            crossed = min(likeness[one, other], likeness[other, one])
            if moving[one] and moving[other] and crossed > THEIRS and max(own[one], own[other]) < OWN:
                found.append(SetupProblem('velocity_order', joints[one], (
                    f"The velocities of '{joints[one]}' and '{joints[other]}' belong to each other's positions: they "
                    'are swapped in the joint states; put them in the order of the names.')))
    return found


def _correlation(left: Array, right: Array) -> Array:
    """(k, k) correlations between columns about zero; 0 where one stands still."""
    size = np.outer(np.linalg.norm(left, axis=0), np.linalg.norm(right, axis=0))
    return np.divide(left.T @ right, size, out=np.zeros_like(size), where=size > 0.0)


def _clock(samples: Samples, ratios: list[Ratio]) -> list[SetupProblem]:
    """Stamps that run too fast or too slow for every joint alike."""
    telling = np.array([ratio.value for ratio in ratios if ratio.is_telling])
    if len(telling) < 2 or telling.min() <= 0.0 or telling.max() > TOLERANCE * telling.min():
        return []
    factor = float(np.median(telling))
    if 1.0 / TOLERANCE < factor < TOLERANCE or any(Ratio(factor, 1.0).near(known) for known in UNITS):
        return []
    step = typical_step(samples.time)
    return [SetupProblem('clock', None, (
        f'The stamps are {step:.4g} s apart, but positions and velocities agree with {factor * step:.4g} s: correct '
        f'the stamps (for a text table: semiparam convert --period {factor * step:.4g}, or --time-unit).'))]


def _silent(name: str) -> tuple[SetupProblem, str, float]:
    return SetupProblem('velocity_missing', name, (
        f"The position of '{name}' changes while its velocity stays zero: have the driver publish velocities.")), \
        'velocity', 1.0


def _velocity(name: str, ratio: Ratio) -> tuple[SetupProblem, str, float] | None:
    """What a joint's ratio says, and which role times which factor puts it right."""
    if not ratio.is_telling or ratio.near(1.0):
        return None
    if ratio.near(-1.0):
        return SetupProblem('velocity_sign', name, (
            f"The velocity of '{name}' has the opposite sign of its change of position: negate one of them in the "
            'driver.')), 'velocity', -1.0
    for known, (role, unit, factor) in UNITS.items():
        if ratio.near(known):
            right = 'rad' if role == 'position' else 'rad/s'
            return SetupProblem(f'{role}_units', name, (
                f"The {role} of '{name}' is in {unit}, its {'velocity' if role == 'position' else 'position'} is not: "
                f'publish it in {right} (for a text table with degrees throughout: semiparam convert --degrees).')), \
                role, factor
    return SetupProblem('velocity_scale', name, (
        f"The position of '{name}' changes {ratio.value:.3g} times as fast as its velocity says: check the gear ratio "
        'and the units in the driver.')), 'velocity', ratio.value


def _accelerations(joints: Sequence[str], samples: Samples, right: Samples, moving: Array) -> list[SetupProblem]:
    """Accelerations that contradict the velocities as they are recorded and as they should be."""
    recorded = _spans(samples.time, samples.velocity, samples.acceleration)
    corrected = _spans(samples.time, right.velocity, samples.acceleration)
    found = []
    for joint, name in enumerate(joints):
        if not moving[joint] or _ratio(recorded[0][:, joint], recorded[1][:, joint]).near(1.0):
            continue
        ratio = _ratio(corrected[0][:, joint], corrected[1][:, joint])
        units = [unit for known, unit in RATE_UNITS.items() if ratio.near(known)]
        if ratio.near(-1.0):
            found.append(SetupProblem('acceleration_sign', name, (
                f"The measured acceleration of '{name}' has the opposite sign of its change of velocity: negate it, or "
                'set acceleration.source to filter.')))
        elif units:
            found.append(SetupProblem('acceleration_units', name, (
                f"The measured acceleration of '{name}' is in {units[0]}: publish it in rad/s^2, or set "
                'acceleration.source to filter.')))
    return found


def _scaled(samples: Samples, role: str, joint: int, factor: float) -> Samples:
    """The samples with one joint's position, or its velocity, times a factor."""
    values = getattr(samples, role).copy()
    values[:, joint] *= factor
    return replace(samples, **{role: values})
