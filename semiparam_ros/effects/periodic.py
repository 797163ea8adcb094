"""Shaking: a disturbance of one frequency that has nothing to do with the motion."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar

import numpy as np

from semiparam_ros.core.columns import Absent, Memory
from semiparam_ros.core.robot.frames import frame_motion, loaded_links, observed_links
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.effects.base import CHANNELS, Axis, Coefficient, Effect, Values, channel_index

PEAKS = 4
EDGE = 0.95
"""Largest frequency over half the sampling rate: above, aliases look like a disturbance."""

PAUSE_STEPS = 5.0
"""Steps between samples from which on a longer one is a pause."""


class PeriodicDisturbance(Effect):
    """A sine and a cosine: in the sensor's axes, on a joint, or of a force on a link along its or the base's axes."""

    kind: ClassVar[str] = 'periodic_disturbance'
    shows_against: ClassVar[Axis] = 'phase'
    refine_link: ClassVar[bool] = True
    of_one_recording: ClassVar[bool] = True
    sentence: ClassVar[str] = 'something shakes the arm at one frequency'
    mistaken_for: ClassVar[tuple[str, ...]] = ('transmission_ripple', 'viscous_drag', 'cable_spring')
    separated_by: ClassVar[str] = 'standing still: the disturbance goes on'
    parameter_units: ClassVar[dict[str, str]] = {'frequency_hz': 'Hz'}
    option_names: ClassVar[tuple[str, ...]] = ('link_axes',)

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        return (*_own_axes(body), *loaded_links(body))

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return (*_own_axes(body), *observed_links(body))

    def at_joint(self, body: RigidBody) -> bool:
        return self.where in _own_axes(body)

    def on_links(self, body: RigidBody) -> bool:
        return not self.at_joint(body)

    def desired(self) -> Absent:
        """Return its mean over all phases, zero: the phase at that time is not known."""
        return Absent(self)

    @classmethod
    def searches(cls, body: RigidBody, samples: Samples, where: str | None, residual: Array) -> Sequence[Values]:
        turning = (0.0,) if where in _own_axes(body) else (0.0, 1.0)
        found, part = list[Values](), _unbroken(samples.time)
        for along in turning:
            directions = cls._directions(body, samples, where, along)
            signal = np.einsum('tni,tn->ti', directions, residual)
            found += [{'frequency_hz': frequency, 'link_axes': along}
                      for frequency in spectral_peaks(samples.time[part], signal[part])]
        return found

    def alike(self, samples: Samples) -> Sequence[PeriodicDisturbance]:
        return [self.with_values(frequency_hz=each) for each in aliases(self.value('frequency_hz', 1.0), samples)]

    @classmethod
    def choices(cls, body: RigidBody, samples: Samples, where: str | None) -> int:
        """Number of frequencies that the recording tells apart."""
        return max(len(samples) // 2, 1)

    def bounds(self, name: str, body: RigidBody, samples: Samples, residual: Array) -> tuple[float, float]:
        width = 0.5 / float(np.ptp(samples.time[_unbroken(samples.time)]))  # half the resolution of the spectrum
        return self.value(name) - width, self.value(name) + width

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        if self.where in body.output_names:
            names = [Coefficient('', body.joint_unit(self.where, 'N m'))]
        elif self.where is None:
            names = [Coefficient(name, unit) for name, unit in zip(CHANNELS, body.output_units, strict=True)]
        else:
            names = [Coefficient(f'force_{axis}', 'N') for axis in 'xyz']
        return tuple(Coefficient(f'{part}_{name}'.rstrip('_'), unit) for part in ('sin', 'cos') for name, unit in names)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        frequency_hz = self.value('frequency_hz', 1.0)
        phase = 2.0 * np.pi * frequency_hz * samples.time[:, None, None]
        directions = self._directions(body, samples, self.where, self.value('link_axes'))
        directions = directions * kept_of_a_sine(np.array(frequency_hz), samples)
        return np.concatenate([np.sin(phase) * directions, np.cos(phase) * directions], axis=2), None

    @staticmethod
    def _directions(body: RigidBody, samples: Samples, where: str | None, link_axes: float) -> Array:
        """Outputs (N, n, k) of a unit disturbance in each of its k directions."""
        if where is None:
            return np.broadcast_to(np.eye(body.n_outputs), (len(samples), body.n_outputs, body.n_outputs))
        if where in body.output_names:
            column = np.eye(body.n_outputs)[:, channel_index(body, where), None]
            return np.broadcast_to(column, (len(samples), *column.shape))
        motion = frame_motion(body, samples, where)
        return motion.force_map @ motion.rotation if link_axes else motion.force_map


def _own_axes(body: RigidBody) -> Sequence[str | None]:
    """Places that shake the outputs themselves, not a link: the sensor, or the drives of the joints."""
    return (None,) if body.outputs == 'wrench' else body.output_names


def kept_of_a_sine(frequency_hz: Array, samples: Samples) -> Array:
    """Share of sines with frequencies (...) that means keep, below zero where they turn one over: that of a mean, of
    which the curvature is taken off as second neighbours tell it."""
    count, turn = samples.averaged_of, np.pi * samples.averaged_s * frequency_hz
    each = count * np.sin(turn / count)
    mean = np.divide(np.sin(turn), each, out=np.ones_like(turn), where=each != 0.0)
    return np.asarray(mean * (1.0 + (1.0 - 1.0 / count**2) / 24.0 * np.sin(2.0 * turn) ** 2))


def aliases(frequency_hz: float, samples: Samples) -> list[float]:
    """A frequency and all others [Hz] that the means of faster samples do not tell from it, below half the rate of
    those."""
    if samples.averaged_of == 1:
        return [frequency_hz]
    rate = 1.0 / samples.averaged_s
    others = [number * rate + sign * frequency_hz for number in range(1, samples.averaged_of // 2 + 1)
              for sign in (-1.0, 1.0)]
    return [frequency_hz, *(each for each in others if each < EDGE * 0.5 * samples.averaged_of * rate)]


def _unbroken(time: Array) -> slice:
    """The samples whose spectrum tells frequencies: all, or, where most of the time (N,) are pauses between recordings
    or between stretches of a long one, those of the longest part without."""
    steps = np.diff(time)
    pauses = steps > PAUSE_STEPS * np.median(steps)
    if 2.0 * steps[pauses].sum() < steps.sum():
        return slice(0, len(time))
    edges = [0, *(np.flatnonzero(pauses) + 1).tolist(), len(time)]
    return max((slice(start, end) for start, end in pairwise(edges)), key=lambda part: part.stop - part.start)


def spectral_peaks(time: Array, signal: Array) -> list[float]:
    """The strongest frequencies [Hz] of signals (N, k), each channel scaled alike; steps in time may vary a little."""
    even = np.linspace(time[0], time[-1], len(time))
    step = even[1] - even[0]
    columns = [np.interp(even, time, column - column.mean()) for column in (signal / (signal.std(axis=0) + 1e-12)).T]
    padded = 4 * len(even)
    window = np.hanning(len(even))
    power = np.sum([np.abs(np.fft.rfft(column * window, padded)) ** 2 for column in columns], axis=0)
    frequencies = np.fft.rfftfreq(padded, step)
    power[(frequencies < 2.0 / (time[-1] - time[0])) | (frequencies > EDGE * frequencies[-1])] = 0.0
    return [float(frequencies[index]) for index in strongest_peaks(power, PEAKS)]


def strongest_peaks(power: Array, most: int) -> list[int]:
    """Indices of a spectrum's strongest local maxima, the strongest first."""
    from scipy.signal import find_peaks  # loads scipy.stats too, for which a node need not wait when it starts

    peaks, _ = find_peaks(power)
    return [int(index) for index in peaks[np.argsort(power[peaks])[::-1][:most]]]
