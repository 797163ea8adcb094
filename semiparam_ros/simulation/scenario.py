"""Scenario of a simulation, and the recording that comes out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from semiparam_ros.core.types import Array, Stamps


@dataclass(frozen=True)
class EffectRequest:
    """One hidden cause. ``size`` 1 changes the outputs by 10 % of their standard deviation (RMS, mean over channels).

    ``where`` (a joint, frame or channel) and ``start_s`` [s] are drawn from the seed where they are None; one without
    ``end_s`` [s] stays.
    """

    kind: str
    where: str | None = None
    size: float = 1.0
    start_s: float | None = None
    end_s: float | None = None


@dataclass(frozen=True)
class Scenario:
    """A recording to simulate.

    :param urdf: URDF text; None stands for the package's own iCub arm, and then ``joints``, ``sensor_frame`` and
        ``home`` have defaults too.
    :param locked: joints that stay at positions [rad, m] other than zero.
    :param robot_seed: what the true inertias are drawn from; None takes ``seed``.
    :param baseline: ``none`` (nothing else is missing) or ``bundled`` (a few small unmodelled effects more).
    :param noise: scale of the outputs' noise, 2 % of their standard deviation at 1.
    :param noise_correlation_s: time over which the outputs' noise is correlated [s]; 0 for white noise.
    :param encoder_noise: scale of the noise of positions, velocities, accelerations and temperatures.
    :param temperatures: of the joints, or of a wrench's sensor, are recorded; always where a hidden cause needs them.
    :param home: posture [rad] that circles go around.
    """

    motion: str = 'circle_xy'
    samples: int = 4000
    rate_hz: float = 20.0
    effects: tuple[EffectRequest, ...] = ()
    seed: int = 0
    robot_seed: int | None = None
    outputs: str = 'wrench'
    urdf: str | None = None
    joints: tuple[str, ...] | None = None
    locked: tuple[tuple[str, float], ...] = ()
    sensor_frame: str | None = None
    convention: str = 'reaction'
    baseline: str = 'none'
    noise: float = 1.0
    noise_correlation_s: float = 0.0
    encoder_noise: float = 1.0
    accelerations: bool = True
    temperatures: bool = False
    home: tuple[float, ...] | None = None


@dataclass(frozen=True)
class SimulatedRecording:
    """Recording of N samples as a robot's topics would give them, and the truth behind them.

    ``stamps`` (N,) [ns]; ``position``, ``velocity``, ``acceleration`` (N, n_joints) [rad, rad/s,
    rad/s^2]; ``temperature`` (N, n_joints), of a wrench's sensor (N, 1) [deg C], the newest reading
    at each stamp, or None; ``outputs`` (N, n) [N, N m]; ``noise_std`` (n,) is the standard
    deviation of the outputs' white noise. ``truth`` lists the requested effects, ``baseline_truth``
    what the baseline adds: dicts with ``kind``, ``where``, ``start_s``, ``size``, ``rms_share``,
    ``unexplained_share`` and ``parameters`` (name -> value and unit).
    """

    stamps: Stamps
    joint_names: tuple[str, ...]
    position: Array
    velocity: Array
    acceleration: Array | None
    outputs: Array
    outputs_kind: str
    convention: str
    frame_id: str
    urdf: str
    noise_std: Array
    truth: tuple[dict[str, Any], ...]
    baseline_truth: tuple[dict[str, Any], ...]
    temperature: Array | None = None

    @property
    def temperatures(self) -> tuple[str, ...]:
        """Sources of the temperatures: the joints, or the frame of the sensor."""
        if self.temperature is None:
            return ()
        return self.joint_names if self.outputs_kind == 'effort' else (self.frame_id,)
