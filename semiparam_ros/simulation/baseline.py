"""The few things that no model of the bundled recordings declares, as every real robot has them.

They belong to the robot, not to a recording: drawn and sized once on a reference motion, so that recordings with the
same robot seed meet the same cable with the same stiffness. Only the warming up belongs to the recording.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.causes import CAUSES
from semiparam_ros.simulation.hiding import add_effects, described, hide, output_scale
from semiparam_ros.simulation.scenario import EffectRequest
from semiparam_ros.simulation.sizing import RigidBodyFit
from semiparam_ros.simulation.world import World

REFERENCE_MOTION, REFERENCE_S, REFERENCE_HZ = 'mixed', 60.0, 20.0
OF_ROBOT = (EffectRequest('joint_offset', size=0.4), EffectRequest('cable_spring', size=0.6),
            EffectRequest('cable_hysteresis', size=0.45), EffectRequest('two_mass_flexibility', size=0.2))
OF_RECORDING = (EffectRequest('thermal_drift', size=0.3),)
BASELINES = ('none', 'bundled')


def check_baseline(name: str) -> None:
    """An unknown baseline raises SemiparamError."""
    if name not in BASELINES:
        raise SemiparamError(f"baseline '{name}' is unknown; expected one of {', '.join(BASELINES)}.")


def with_baseline(world: World, reference: World, scale: Array, robot: np.random.Generator,
                  recording: np.random.Generator) -> tuple[World, list[dict[str, Any]]]:
    """The world with the baseline's causes, and the truth about them.

    :param reference: the same robot on the reference motion.
    """
    truth: list[dict[str, Any]] = []
    there, here = output_scale(reference), RigidBodyFit(world, scale)
    fit = RigidBodyFit(reference, there)
    for effect in OF_ROBOT:
        hidden = hide(reference, effect, there, fit, robot)
        before, reference = world, hidden.world
        world = hidden.cause.apply(before, hidden.magnitude)
        truth.append(described(hidden, world.outputs - before.outputs, scale, here))
    acting = [effect for effect in OF_RECORDING if world.arm.outputs in CAUSES[effect.kind].acts_on]
    world, more = add_effects(world, acting, scale, recording)
    return world, truth + more
