"""Hiding of causes in a world, each at the size that was asked for, with an entry in the truth; and
the few causes that every real robot has.

No model of the bundled recordings declares these few. They belong to the robot, not to a recording:
drawn and sized once on a reference motion, so that recordings with the same robot seed meet the
same cable with the same stiffness. Only the warming up belongs to the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import brentq

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.causes import CAUSES, HiddenCause, Site, cause_of
from semiparam_ros.simulation.scenario import EffectRequest
from semiparam_ros.simulation.world import World

SHARE_OF_SIZE = 0.10
SUBSET = 400
RANK_TOLERANCE = 1e-9

DRAWS = 8
VISIBLE = 0.3

REFERENCE_MOTION, REFERENCE_S, REFERENCE_HZ = 'mixed', 60.0, 20.0
OF_ROBOT = (EffectRequest('joint_offset', size=0.4), EffectRequest('cable_spring', size=0.6),
            EffectRequest('cable_hysteresis', size=0.45), EffectRequest('two_mass_flexibility', size=0.2))
OF_RECORDING = (EffectRequest('thermal_drift', size=0.3),)
BASELINES = ('none', 'bundled')


def share(change: Array, scale: Array) -> float:
    """RMS of a change (N, n) over the outputs' standard deviation ``scale`` (n,), mean over channels."""
    return float(np.mean(np.sqrt(np.mean(change**2, axis=0)) / scale))


def scaled_magnitude(reached: float, target: float, typical: float, name: str) -> float:
    """Magnitude of a cause in proportion, from the share ``reached`` at ``typical``."""
    if not reached > 0.0:
        raise SemiparamError(f"effect '{name}' changes nothing on this motion; ask for another place or motion.")
    return typical * target / reached


def solve_magnitude(share_at: Callable[[float], float], target: float, typical: float, name: str) -> float:
    """Magnitude at which the share is ``target``: bracketed from ``typical`` on, then root finding.

    An effect that cannot grow so large raises SemiparamError.
    """
    upper = typical
    for _ in range(40):
        reached = share_at(upper)
        if reached >= target:
            break
        upper *= 2.0 if reached <= 0.0 else min(max(1.05 * target / reached, 1.05), 4.0)
    else:
        raise SemiparamError(f"effect '{name}' cannot be made as large as asked on this motion; ask for a smaller "
                             'size or another place.')
    return float(brentq(lambda m: share_at(m) - target if m > 0 else -target, 0.0, upper, xtol=1e-14, rtol=1e-11))


class RigidBodyFit:
    """Fit of inertial parameters, and for a wrench of an offset, to a subset of one motion."""

    def __init__(self, world: World, scale: Array) -> None:
        self.scale = scale
        self.rows = np.unique(np.linspace(0, len(world.times) - 1, SUBSET).astype(int))
        columns = list(self._inertial_columns(world))
        if world.arm.outputs == 'wrench':
            columns += [np.broadcast_to(unit, (len(self.rows), 6)) for unit in np.eye(6)]
        matrix = np.stack([(column / scale).ravel() for column in columns], axis=1)
        matrix /= np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        left, singular, _ = np.linalg.svd(matrix, full_matrices=False)
        self.basis = left[:, singular > RANK_TOLERANCE * singular[0]]

    def unexplained(self, change: Array) -> float:
        """The share of a change (N, n) that stays when the rigid body has been fitted to it."""
        target = (change[self.rows] / self.scale).ravel()
        rest = target - self.basis @ (self.basis.T @ target)
        return share(rest.reshape(len(self.rows), -1), np.ones(change.shape[1]))

    def _inertial_columns(self, world: World) -> list[Array]:
        """Outputs are linear in the ten parameters of each body, so differences are the regressor's columns."""
        states = [values[self.rows] for values in world.motion(world.times)[1:]]
        columns = []
        for joint in world.arm.distal_joints:
            start = (world.arm.model.inertias[joint] + pin.Inertia.FromSphere(1.0, 0.1)).toDynamicParameters()
            base = world.arm.with_inertias({joint: pin.Inertia.FromDynamicParameters(start)}).evaluate(*states)
            for unit in np.eye(10):
                body = pin.Inertia.FromDynamicParameters(start + unit)
                columns.append(world.arm.with_inertias({joint: body}).evaluate(*states) - base)
        return columns


@dataclass(frozen=True)
class Hidden:
    """One cause at its magnitude, the world with it, and its entry in the truth."""

    cause: HiddenCause
    magnitude: float
    world: World
    truth: dict[str, Any]


def output_scale(world: World) -> Array:
    """Standard deviation (n,) of the rigid body's outputs; a channel that never changes raises SemiparamError."""
    scale = world.outputs.std(axis=0)
    still = [name for name, value in zip(world.arm.channels, scale, strict=True) if value < 1e-9]
    if still:
        raise SemiparamError(f'this motion never changes the output of {", ".join(still)}: nothing can be scaled to '
                             'it; choose other joints or another motion.')
    return np.asarray(scale)


def add_effects(world: World, effects: Sequence[EffectRequest], scale: Array,
                rng: np.random.Generator) -> tuple[World, list[dict[str, Any]]]:
    """Put the effects into the world one after the other."""
    truth: list[dict[str, Any]] = []
    if not effects:
        return world, truth
    fit = RigidBodyFit(world, scale)
    for effect in effects:
        hidden = hide(world, effect, scale, fit, rng)
        world = hidden.world
        truth.append(hidden.truth)
    return world, truth


def hide(world: World, effect: EffectRequest, scale: Array, fit: RigidBodyFit, rng: np.random.Generator) -> Hidden:
    """Draw one effect and size it.

    Some draws are nothing but another inertia (a force that hangs straight down, the rotor of the first joint): draw
    again while the rigid body could explain most of it, and keep the plainest.
    """
    drawn: list[Hidden] = []
    without = world.outputs
    for _ in range(DRAWS):
        site = Site(world, scale, effect.where, effect.start_s, effect.end_s, rng)
        cause = replace(cause_of(effect.kind, world.arm.outputs).draw(site), end_s=effect.end_s)
        drawn.append(_sized(cause, world, without, effect.size, scale, fit))
        if drawn[-1].truth['unexplained_share'] >= VISIBLE * drawn[-1].truth['rms_share']:
            break
    return max(drawn, key=lambda hidden: float(hidden.truth['unexplained_share']))


def described(hidden: Hidden, change: Array, scale: Array, fit: RigidBodyFit) -> dict[str, Any]:
    """The entry in the truth of a cause that changes the outputs by ``change`` (N, n)."""
    quantities = {name: {'value': np.asarray(entry.value).tolist(), 'unit': entry.unit}
                  for name, entry in hidden.cause.true_values(hidden.magnitude, hidden.world).items()}
    return {'kind': hidden.cause.kind, 'where': hidden.cause.where, 'start_s': hidden.cause.start_s,
            'end_s': hidden.cause.end_s,
            'size': round(share(change, scale) / SHARE_OF_SIZE, 9), 'rms_share': share(change, scale),
            'unexplained_share': fit.unexplained(change), 'parameters': quantities}


def _sized(cause: HiddenCause, world: World, without: Array, size: float, scale: Array, fit: RigidBodyFit) -> Hidden:
    """The cause at the magnitude that gives the asked size."""
    def share_at(magnitude: float) -> float:
        return share(cause.apply(world, magnitude).outputs - without, scale)

    if cause.linear:
        magnitude = scaled_magnitude(share_at(cause.typical), SHARE_OF_SIZE * size, cause.typical, cause.kind)
    else:
        magnitude = solve_magnitude(share_at, SHARE_OF_SIZE * size, cause.typical, cause.kind)
    hidden = Hidden(cause, magnitude, cause.apply(world, magnitude), {})
    return Hidden(cause, magnitude, hidden.world,
                  described(hidden, hidden.world.outputs - without, scale, fit))


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
