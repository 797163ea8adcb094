"""Against what a residual should be drawn so that an effect shows: time, a joint's motion, a link's, or the load.

Every kind has a role (a friction depends on velocity, a spring on position); which joint or axis of that role is
taken from the effect's place, or, where it has none, from what its explanation depends on most.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semiparam_ros.core.frames import frame_motion
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.effects import Effect

TIME = ('payload', 'sensor_offset', 'sensor_drift', 'thermal_drift', 'effort_offset')
VELOCITY = ('viscous_friction', 'coulomb_friction', 'stribeck_friction', 'asymmetric_friction', 'load_friction')
ACCELERATION = ('rotor_inertia',)
OUTPUT = ('sensor_gain', 'sensor_crosstalk', 'sensor_misalignment', 'effort_gain')
LINK_VELOCITY = ('viscous_drag', 'quadratic_drag')
POSITION = ('joint_offset', 'gravity_tilt', 'joint_spring', 'transmission_ripple', 'backlash', 'cable_spring',
            'cable_hysteresis', 'external_force')
BINS = 20


class Variable(NamedTuple):
    """A quantity over the recording, (N,), and what to write at its axis."""

    label: str
    values: Array


def suspected_variable(effect: Effect, state: Fit, explained: Array, channel: int) -> Variable:
    """The variable of an effect.

    :param state: the fit of which it explains a part. :param explained: (N,) that part, in output ``channel``.
    """
    if effect.kind in TIME or effect.start_s is not None:
        return _time(state)
    if effect.kind == 'periodic_disturbance':
        frequency = effect.value('frequency_hz', 1.0)
        return Variable(f'phase at {frequency:.3g} Hz [cycles]', np.mod(frequency * state.samples.time, 1.0))
    if effect.kind == 'time_delay':
        rate = np.gradient(_predicted(state)[:, channel], state.samples.time)
        unit = state.body.output_units[channel]
        return Variable(f'rate of change of {state.body.output_names[channel]} [{unit}/s]', rate)
    return most_telling(_in_role(effect, state, channel), explained)


def most_telling(variables: list[Variable], explained: Array) -> Variable:
    """The variable that ``explained`` (N,) depends on most."""
    return max(variables, key=lambda variable: dependence(variable.values, explained))


def dependence(variable: Array, explained: Array) -> float:
    """Share of a signal's variance between the bins of a variable, 0 to 1 (the correlation ratio)."""
    edges = np.quantile(variable, np.linspace(0.0, 1.0, BINS + 1)[1:-1])
    bins = np.searchsorted(edges, variable)
    count = np.bincount(bins, minlength=BINS)
    mean = np.bincount(bins, explained, BINS) / np.maximum(count, 1)
    spread = float(np.sum((explained - explained.mean()) ** 2))
    return float(count @ (mean - explained.mean()) ** 2) / spread if spread > 0.0 else 0.0


def _in_role(effect: Effect, state: Fit, channel: int) -> list[Variable]:
    if effect.kind in OUTPUT:
        return _outputs(state)
    if effect.kind in LINK_VELOCITY:
        return _link_velocity(effect, state)
    for role, kinds in (('position', POSITION), ('velocity', VELOCITY), ('acceleration', ACCELERATION)):
        if effect.kind in kinds:
            return _joints(effect, state, role)
    return [_time(state), *(variable for role in ('position', 'velocity', 'acceleration')
                            for variable in _joints(effect, state, role))]


def _time(state: Fit) -> Variable:
    return Variable('time [s]', state.samples.time)


def _joints(effect: Effect, state: Fit, role: str) -> list[Variable]:
    """The motion of the effect's joint, or of every joint."""
    symbol, unit = {'position': ('position', 'rad'), 'velocity': ('velocity', 'rad/s'),
                    'acceleration': ('acceleration', 'rad/s²')}[role]
    values: Array = getattr(state.samples, role)
    return [Variable(f'{symbol} of {joint} [{unit}]', values[:, index])
            for index, joint in enumerate(state.body.joints)
            if effect.where not in state.body.joints or joint == effect.where]


def _link_velocity(effect: Effect, state: Fit) -> list[Variable]:
    """Velocity of the effect's link along each axis of the sensor."""
    motion = frame_motion(state.body, state.samples, str(effect.where))
    velocity = -state.body.sign * (motion.force_map[:, :3] @ motion.velocity[:, :, None])[:, :, 0]
    return [Variable(f"velocity of {effect.where} along the sensor's {axis} [m/s]", velocity[:, index])
            for index, axis in enumerate('xyz')]


def _outputs(state: Fit) -> list[Variable]:
    predicted = _predicted(state)
    named = zip(state.body.output_names, state.body.output_units, strict=True)
    return [Variable(f'predicted {name} [{unit}]', predicted[:, index]) for index, (name, unit) in enumerate(named)]


def _predicted(state: Fit) -> Array:
    """(N, n) outputs as the fit predicts them."""
    return np.asarray(state.samples.outputs - state.residual)
