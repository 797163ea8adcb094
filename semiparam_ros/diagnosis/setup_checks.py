"""What goes wrong most in practice, checked before any effect: units, signs, orders, axes, and too little motion."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.excitation import unidentifiable
from semiparam_ros.diagnosis.exclusion import excluded
from semiparam_ros.diagnosis.layout_checks import NO_MATCH, layout_problems
from semiparam_ros.diagnosis.motion_checks import LEAST_MOTION, motion_problems
from semiparam_ros.diagnosis.setup_problem import SetupProblem

__all__ = ['NO_MATCH', 'SetupProblem', 'excluded', 'setup_problems', 'unidentifiable']

MOST_SAMPLES = 250
LEAST_SAMPLES = 50


def setup_problems(body: RigidBody, samples: Samples) -> list[SetupProblem]:
    """What is wrong with the recording or with its declaration, each with its remedy; empty when nothing is.

    :param samples: as recorded. A quarter of a thousand of them, spread over the recording, are looked at.
    """
    if len(samples) < LEAST_SAMPLES or np.all(np.ptp(samples.position, axis=0) < LEAST_MOTION):
        return []
    if not np.ptp(samples.outputs, axis=0).any():
        return [_constant(body)]
    found, right = motion_problems(body.joints, samples)
    if any(problem.what in ('clock', 'velocity_order') for problem in found):
        return found
    usable = np.flatnonzero(~excluded(samples))
    if len(usable) < LEAST_SAMPLES:
        return found
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, MOST_SAMPLES).astype(int))]
    return found + layout_problems(body, right[chosen])


def _constant(body: RigidBody) -> SetupProblem:
    what = 'wrench' if body.outputs == 'wrench' else 'efforts'
    return SetupProblem('outputs_constant', body.sensor_frame, (
        f'The {what} never change{"s" if what == "wrench" else ""} while the robot moves: check that the sensor is '
        'switched on and that its driver publishes what it measures.'))
