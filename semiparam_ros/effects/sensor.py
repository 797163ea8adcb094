"""Sensors of force and torque: bias, drift, temperature, gains, crosstalk, mounting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import pinocchio as pin

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import bias_scale
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.effects.base import (
    CHANNELS,
    Axis,
    Coefficient,
    Effect,
    Values,
    channel_units,
    on_joint,
)

N_CHANNELS = 6


class ChannelEffect(Effect):
    """A function of time alone, with one coefficient for each channel."""

    outputs: ClassVar[tuple[str, ...]] = ('wrench',)
    of_sensor: ClassVar[bool] = True
    per: ClassVar[str] = ''

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        return channel_units(body, self.per)

    def prior_scale(self, body: RigidBody) -> Array:
        """Prior (6,) of a wrench's offset."""
        return bias_scale(body)

    def profile(self, time: Array) -> Array:
        """Function (N,) of the time (N,) [s] that every channel follows."""
        return np.ones_like(time)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        return self.profile(samples.time)[:, None, None] * np.eye(N_CHANNELS), None


class SensorOffset(ChannelEffect):
    """A jump of the bias; the constant bias of a recording is part of every model with a wrench."""

    kind: ClassVar[str] = 'sensor_offset'
    own_in_each_recording: ClassVar[bool] = True
    shows_against: ClassVar[Axis] = 'time'
    sentence: ClassVar[str] = "the sensor's bias jumped, as after a knock, a re-zeroing or a pinched cable"
    mistaken_for: ClassVar[tuple[str, ...]] = ('payload', 'external_force', 'sensor_drift')
    separated_by: ClassVar[str] = 'turning the sensor through gravity: a bias does not turn with it'
    must_start: ClassVar[bool] = True


class SensorDrift(ChannelEffect):
    """A bias that grows in proportion to time."""

    kind: ClassVar[str] = 'sensor_drift'
    shows_against: ClassVar[Axis] = 'time'
    of_one_recording: ClassVar[bool] = True
    sentence: ClassVar[str] = "the sensor's bias drifts steadily with time"
    mistaken_for: ClassVar[tuple[str, ...]] = ('thermal_drift', 'sensor_offset')
    separated_by: ClassVar[str] = 'a longer recording: a thermal drift settles, a linear one goes on'
    per: ClassVar[str] = 's'

    def profile(self, time: Array) -> Array:
        return time


class ThermalDrift(ChannelEffect):
    """A bias that settles as exp(-t / time constant)."""

    kind: ClassVar[str] = 'thermal_drift'
    shows_against: ClassVar[Axis] = 'time'
    of_one_recording: ClassVar[bool] = True
    sentence: ClassVar[str] = 'the sensor warms up: its bias settles exponentially'
    mistaken_for: ClassVar[tuple[str, ...]] = ('sensor_drift', 'temperature_drift', 'sensor_offset')
    separated_by: ClassVar[str] = 'a recording of several time constants from a cold start'
    parameter_units: ClassVar[dict[str, str]] = {'time_constant_s': 's'}
    positive: ClassVar[tuple[str, ...]] = ('time_constant_s',)

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None,
                 residual: Array) -> Sequence[Values]:
        shares = (0.02, 0.04, 0.07, 0.12, 0.2, 0.35, 0.6, 1.0)
        return [{'time_constant_s': samples.recorded_s * share} for share in shares]

    def profile(self, time: Array) -> Array:
        return -np.expm1(-time / self.value('time_constant_s', 60.0))


class _Calibration(Effect):
    """A matrix (6, 6) that multiplies the true wrench, the identity plus the calibrations."""

    outputs: ClassVar[tuple[str, ...]] = ('wrench',)
    of_sensor: ClassVar[bool] = True

    def matrix(self) -> Array:
        """Reported wrench over true wrench, a matrix (6, 6)."""
        raise NotImplementedError

    def transform(self, body: RigidBody, regressors: Array) -> Array:
        return np.asarray(self.matrix() @ regressors)


class _Gains(_Calibration):
    """A matrix with a gain for each channel."""

    def without_common_gain(self) -> _Gains:
        common = float(np.median(np.diag(self.matrix())))
        if not common > 0.0:
            return self
        values = {}
        for name, _ in self.calibrations:
            own = float(name.startswith('gain'))
            values[name] = (own + self.value(name)) / common - own
        return self.with_values(**values)


class SensorGain(_Gains):
    """Each channel reads too much or too little. The common gain of all forces cannot be told from the masses."""

    kind: ClassVar[str] = 'sensor_gain'
    shows_against: ClassVar[Axis] = 'output'
    sentence: ClassVar[str] = 'channels of the sensor have wrong gains'
    mistaken_for: ClassVar[tuple[str, ...]] = ('sensor_crosstalk', 'sensor_misalignment')
    separated_by: ClassVar[str] = 'motion that turns gravity through every axis of the sensor'
    calibrations: ClassVar[tuple[Coefficient, ...]] = tuple(Coefficient(f'gain_{name}', '') for name in CHANNELS)

    def matrix(self) -> Array:
        return np.eye(N_CHANNELS) + np.diag([self.value(f'gain_{name}') for name in CHANNELS])


class SensorNonlinearity(Effect):
    """A joint's effort reads more of large loads than of small ones, or less: its error grows with the square and the
    cube of the load that the rigid body predicts."""

    kind: ClassVar[str] = 'sensor_nonlinearity'
    shows_against: ClassVar[Axis] = 'output'
    outputs: ClassVar[tuple[str, ...]] = ('effort',)
    of_sensor: ClassVar[bool] = True
    needs_reference: ClassVar[bool] = True
    sentence: ClassVar[str] = "the joint's measured effort is not in proportion to its load"
    mistaken_for: ClassVar[tuple[str, ...]] = ('effort_gain', 'load_friction')
    separated_by: ClassVar[str] = 'known loads, small and large, in both directions'

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return body.output_names

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        units = {'quadratic': '1/(N m)', 'cubic': '1/(N^2 m^2)'}
        return tuple(Coefficient(name, body.joint_unit(self.where, unit)) for name, unit in units.items())

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        load = self.predicted_load(body, samples)
        return on_joint(body, self.where, np.column_stack([load**2, load**3])), None


CROSS = tuple((to, by) for to in CHANNELS for by in CHANNELS if to != by)


HEARD = 0.2
"""Standard deviation of a crosstalk over that of a gain."""


def _cross_unit(to: str, by: str) -> str:
    if to[0] == by[0]:
        return ''
    return 'm' if to[0] == 't' else '1/m'


class SensorCrosstalk(_Gains):
    """Each channel hears the others: the off-diagonal part of the calibration matrix."""

    kind: ClassVar[str] = 'sensor_crosstalk'
    shows_against: ClassVar[Axis] = 'output'
    sentence: ClassVar[str] = 'channels of the sensor hear one another: its calibration matrix is off'
    mistaken_for: ClassVar[tuple[str, ...]] = ('sensor_misalignment', 'sensor_gain', 'joint_offset', 'gravity_tilt')
    separated_by: ClassVar[str] = 'motion that turns gravity through every axis of the sensor'
    calibrations: ClassVar[tuple[Coefficient, ...]] = (
        *(Coefficient(f'{to}_from_{by}', _cross_unit(to, by)) for to, by in CROSS),
        *(Coefficient(f'gain_{name}', '') for name in CHANNELS))

    def calibration_scale(self, body: RigidBody) -> Array:
        """A channel hears much less of the others than its own gain may be off."""
        shares = np.array([HEARD if '_from_' in name else 1.0 for name, _ in self.calibrations])
        return np.asarray(shares * super().calibration_scale(body))

    def matrix(self) -> Array:
        matrix = np.eye(N_CHANNELS) + np.diag([self.value(f'gain_{name}') for name in CHANNELS])
        for to, by in CROSS:
            matrix[CHANNELS.index(to), CHANNELS.index(by)] = self.value(f'{to}_from_{by}')
        return matrix


class SensorMisalignment(_Calibration):
    """The sensor is turned in its mount by a rotation vector, so the wrench arrives turned the other way."""

    kind: ClassVar[str] = 'sensor_misalignment'
    shows_against: ClassVar[Axis] = 'output'
    sentence: ClassVar[str] = 'the sensor sits turned in its mount'
    mistaken_for: ClassVar[tuple[str, ...]] = ('sensor_crosstalk', 'joint_offset', 'gravity_tilt')
    separated_by: ClassVar[str] = 'motion of the joints before the sensor about more than one axis'
    calibrations: ClassVar[tuple[Coefficient, ...]] = tuple(Coefficient(f'rotation_{axis}', 'rad') for axis in 'xyz')

    def matrix(self) -> Array:
        rotation = pin.exp3(np.array([self.value(f'rotation_{axis}') for axis in 'xyz']))
        return np.kron(np.eye(2), rotation.T)
