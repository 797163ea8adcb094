"""What encoders and sensors make of the truth."""

from __future__ import annotations

import numpy as np

from semiparam_ros.simulation.arrays import Array
from semiparam_ros.simulation.trajectory import Instants

OUTPUT_NOISE_SHARE = 0.02
POSITION_NOISE = 1e-4
VELOCITY_NOISE = 2e-3
ACCELERATION_NOISE = 2e-2
ENCODER_STEP = 2 * np.pi / 2**16
# Converters' steps, powers of two: bags compress well, and the last bits of a processor's arithmetic do not show.
VELOCITY_STEP, ACCELERATION_STEP = 2.0**-14, 2.0**-11
OUTPUT_STEP = 2.0**-15
FORCE_OFFSET, TORQUE_OFFSET = 4.0, 0.3


def joint_readings(motion: Instants, scale: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration (N, n_joints) as measured; the position in steps of a 16-bit encoder."""
    levels = (POSITION_NOISE, VELOCITY_NOISE, ACCELERATION_NOISE)
    noisy = [values + scale * level * rng.standard_normal(values.shape)
             for values, level in zip(motion[1:], levels, strict=True)]
    steps = (ENCODER_STEP, VELOCITY_STEP, ACCELERATION_STEP)
    position, velocity, acceleration = (in_steps(values, step) for values, step in zip(noisy, steps, strict=True))
    return position, velocity, acceleration


def output_readings(outputs: Array, std: Array, rng: np.random.Generator) -> Array:
    """Outputs (N, n) as converted, with white noise of ``std`` (n,); the converter's step suits the largest value."""
    noisy = outputs + std * rng.standard_normal(outputs.shape)
    return in_steps(noisy, OUTPUT_STEP * 2.0 ** np.ceil(np.log2(np.abs(noisy).max(axis=0) + 1e-6)))


def constant_offset(rng: np.random.Generator) -> Array:
    """Offset of a wrench sensor, (6,) [N, N m]."""
    return np.asarray(rng.standard_normal(6) * np.repeat([FORCE_OFFSET, TORQUE_OFFSET], 3))


def in_steps(values: Array, step: float | Array) -> Array:
    """Rounded to multiples of ``step``, one for all columns or one for each."""
    return np.asarray(np.round(values / step) * step)
