"""Sign and unit of the outputs, against what the robot description itself predicts and against friction's direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.mounting import mounting_problem, turned_over
from semiparam_ros.diagnosis.plausibility import channel_scale, dissipation, equations, misfit, nuisances
from semiparam_ros.diagnosis.setup_problem import SetupProblem

OPPOSITE, LIKE = -0.7, 0.7
"""Correlation of the outputs with the description's prediction that speaks for the other sign, or lets their ratio
speak for a unit. As declared it is 0.83 or more on the real recordings (iCub 0.99, UR3 0.83 and 0.96, Franka 0.99)."""
UNIT_TOLERANCE = 2.0
"""A ratio within this factor of a unit's is that unit; the real UR3's efforts are 1.7 times the description's."""
UNITS = {1.0 / 9.81: 'kilograms-force', 9.81: 'newtons taken for kilograms-force', 1e3: 'thousandths (mN, N mm)',
         1e-3: 'thousands (kN, kN m)', 1e2: 'hundredths (N cm)'}
PUSHING, BRAKING = -0.85, 0.3
"""Share of a joint's effort that goes against all friction, and the other joints' median, before its sign is doubted.
A delay or a resonance of size 3 can push as much, but then it brakes no other joint; a real UR3's joints brake by 0.42
to 0.98."""


FRICTION_SPEAKS = 0.5
"""Sum over the joints of the effort's share that is friction, from where on its direction settles a sign."""


def output_problems(body: RigidBody, samples: Samples) -> tuple[list[SetupProblem], RigidBody, Samples]:
    """Signs and units of the outputs that are wrong, and the body and the samples put right."""
    wrench = body.outputs == 'wrench'
    slopes, likeness = _slopes(body, samples)
    found, factors = [], np.ones(body.n_outputs)
    blocks = [('force', slice(0, 3)), ('torque', slice(3, 6))] if wrench else [('effort', slice(None))]
    if likeness[-1] < OPPOSITE and _is_turned_over(body, samples):
        body = turned_over(body)
        found.append(mounting_problem('upside down'))
    elif likeness[-1] < OPPOSITE:
        found.append(_sign(body))
        factors *= -1.0
    for (name, channels), slope, like in zip(blocks, slopes, likeness, strict=False):
        unit = next((known for known in UNITS if 1.0 / UNIT_TOLERANCE < abs(slope) / known < UNIT_TOLERANCE), None)
        if abs(like) > LIKE and unit is not None:
            found.append(_unit(body, name, unit))
            factors[channels] /= unit
    return found, body, replace(samples, outputs=samples.outputs * factors)


def _is_turned_over(body: RigidBody, samples: Samples) -> bool:
    """Whether opposite outputs come from a base that hangs rather than from a sign: inertia and friction do not turn
    over with gravity."""
    if body.outputs == 'effort':
        friction = float(dissipation(body, samples).sum())
        if abs(friction) > FRICTION_SPEAKS:
            return friction > 0.0
    negated = misfit(equations(body, samples), -samples.outputs, body.outputs == 'wrench')
    hanging = misfit(equations(turned_over(body), samples), samples.outputs, body.outputs == 'wrench')
    return hanging.total < negated.total


def friction_problems(body: RigidBody, samples: Samples) -> list[SetupProblem]:
    """Joints whose effort would drive them where friction holds them back."""
    share = dissipation(body, samples)
    others = np.array([np.median(np.delete(share, joint)) if len(share) > 1 else 0.0 for joint in range(len(share))])
    wrong = (share < PUSHING) & (others > BRAKING)
    return [SetupProblem('effort_sign', name, (
        f"The effort of '{name}' goes with its motion as no friction can: it has the opposite sign of its velocity's; "
        'negate it in the driver.')) for name, flag in zip(body.joints, wrong, strict=True) if flag]


def _slopes(body: RigidBody, samples: Samples) -> tuple[Array, Array]:
    """Slope of the outputs against the description's prediction, and their correlation, for force and torque or for
    efforts; the last correlation is over all channels."""
    predicted = body.regressors(samples) @ body.base_parameters
    measured, predicted = (_without(nuisances(body, samples), values) for values in (samples.outputs, predicted))
    pairs = [(measured, predicted)]
    if body.outputs == 'wrench':
        parts = [(measured[:, part], predicted[:, part]) for part in (slice(0, 3), slice(3, 6))]
        pairs = [*parts, (measured / channel_scale(measured, True), predicted / channel_scale(predicted, True))]
    inner = np.array([[np.sum(y * p), np.sum(p * p), np.sum(y * y)] for y, p in pairs])
    return inner[:, 0] / (inner[:, 1] + 1e-300), inner[:, 0] / np.sqrt(inner[:, 1] * inner[:, 2] + 1e-300)


def _without(columns: Array, values: Array) -> Array:
    """Values (N, n) less what the nuisances explain of each channel."""
    left = np.empty_like(values)
    for channel in range(values.shape[1]):
        own = columns[:, channel, np.any(columns[:, channel] != 0.0, axis=0)]
        left[:, channel] = values[:, channel] - own @ np.linalg.lstsq(own, values[:, channel], rcond=1e-9)[0]
    return left


def _sign(body: RigidBody) -> SetupProblem:
    if body.outputs == 'effort':
        return SetupProblem('effort_sign', None, (
            'The efforts have the opposite sign of what the robot description predicts: negate them (semiparam convert '
            '--effort-sign -1).'))
    other = 'action' if body.sign < 0 else 'reaction'
    return SetupProblem('wrench_sign', body.sensor_frame, (
        'The wrench has the opposite sign of what the robot description predicts: set the parameter wrench_convention '
        f'to {other}.'))


def _unit(body: RigidBody, name: str, unit: float) -> SetupProblem:
    right = {'force': 'N', 'torque': 'N m', 'effort': 'N m'}[name]
    return SetupProblem('output_units', body.sensor_frame, (
        f'The {name} is {unit:.3g} times what the robot description predicts, as if it were in {UNITS[unit]}: publish '
        f'it in {right}.'))
