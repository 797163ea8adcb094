"""Putting causes into a world, each at the size that was asked for, and writing down the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.causes import Cause, Site, cause_of
from semiparam_ros.simulation.scenario import EffectRequest
from semiparam_ros.simulation.sizing import SHARE_OF_SIZE, RigidBodyFit, scaled_magnitude, share, solve_magnitude
from semiparam_ros.simulation.world import World

DRAWS = 8
VISIBLE = 0.3


@dataclass(frozen=True)
class Hidden:
    """One cause at its magnitude, the world with it, and its entry in the truth."""

    cause: Cause
    magnitude: float
    size: float
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
        site = Site(world, scale, effect.where, effect.start_s, rng)
        cause = cause_of(effect.kind, world.arm.outputs).draw(site)
        drawn.append(_sized(cause, world, without, effect.size, scale, fit))
        if drawn[-1].truth['unexplained_share'] >= VISIBLE * drawn[-1].truth['rms_share']:
            break
    return max(drawn, key=lambda hidden: float(hidden.truth['unexplained_share']))


def described(hidden: Hidden, change: Array, scale: Array, fit: RigidBodyFit) -> dict[str, Any]:
    """The entry in the truth of a cause that changes the outputs by ``change`` (N, n)."""
    quantities = {name: {'value': np.asarray(entry.value).tolist(), 'unit': entry.unit}
                  for name, entry in hidden.cause.parameters(hidden.magnitude).items()}
    return {'kind': hidden.cause.kind, 'where': hidden.cause.where, 'start_s': hidden.cause.start_s,
            'size': round(share(change, scale) / SHARE_OF_SIZE, 9), 'rms_share': share(change, scale),
            'unexplained_share': fit.unexplained(change), 'parameters': quantities}


def _sized(cause: Cause, world: World, without: Array, size: float, scale: Array, fit: RigidBodyFit) -> Hidden:
    """The cause at the magnitude that gives the asked size."""
    def share_at(magnitude: float) -> float:
        return share(cause.apply(world, magnitude).outputs - without, scale)

    if cause.linear:
        magnitude = scaled_magnitude(share_at(cause.typical), SHARE_OF_SIZE * size, cause.typical, cause.kind)
    else:
        magnitude = solve_magnitude(share_at, SHARE_OF_SIZE * size, cause.typical, cause.kind)
    hidden = Hidden(cause, magnitude, size, cause.apply(world, magnitude), {})
    return Hidden(cause, magnitude, size, hidden.world,
                  described(hidden, hidden.world.outputs - without, scale, fit))
