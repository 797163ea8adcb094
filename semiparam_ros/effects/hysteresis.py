"""States that remember the way travelled."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.compiled import Integers, Matrix, Vector, compiled
from semiparam_ros.core.signals.rests import LEAST_S, SPEED_SHARE, still
from semiparam_ros.core.types import Array, Stamps

MOST_APART = 0.1
"""Largest difference of a travel from its two speeds' mean, over their sum, that is believed."""
LEAST_SLIP = 1e-300
PARTS = 8
"""Parts of a step between two samples that are followed one by one; half of them lie before the joint turns back."""


def dahl_state(travel: Array, slip: float, memory: Memory) -> tuple[Array, Memory]:
    """States (N, k) in [-1, 1] along travels (N, k), and (last travel, last state) to go on from.

    Each step of travel is followed exactly: the state decays towards its direction over ``slip``.
    """
    place, state = cast('tuple[Array, Array]', memory) if memory is not None else (travel[0], np.zeros(travel.shape[1]))
    states = _dahl(np.diff(travel, axis=0, prepend=place[None]), slip, state)
    return states, (travel[-1].copy(), states[-1])  # the travel is the caller's, who may fill it anew


def bouc_wen_state(travel: Array, slip: float, unloading: float, memory: Memory) -> tuple[Array, Memory]:
    """States z (N,) in [-1, 1] along a travel (N,), and (last travel, last state) to go on from
    (Wen 1976, J. Eng. Mech. Div. 102).

    Along its travel it is Dahl's: slip dz/dx = 1 - z. Back to zero it is slip dz/dx = 1 - (slip /
    unloading) z, which is Dahl's too where the two are equal. Each step is followed exactly.
    """
    place, state = cast('tuple[float, float]', memory) if memory is not None else (float(travel[0]), 0.0)
    states = _follow_bouc_wen(np.diff(travel, prepend=place) / slip, slip / unloading, float(state))
    return states, (float(travel[-1]), float(states[-1]))


def bristle(way: Way, slip: float, memory: Memory) -> tuple[Array, Memory]:
    """States (N,) in [-1, 1] of a Dahl bristle along a way, which may turn back within a step."""
    states, memory = _along(way, 1, (slip, slip, 1.0), memory)
    return states[:, 0], memory


def sticking_bristle(way: Way, slip: float, stuck: float, stribeck_speed: float,
                     memory: Memory) -> tuple[Array, Memory]:
    """States (N, 2) of a bristle: one slides at 1, one at exp(-(speed / stribeck_speed)^2).

    It bends over ``slip`` while it slides and over ``stuck`` at standstill: a bristle that is as
    stiff at every level bends the further the higher that is (LuGre; Canudas de Wit et al. 1995,
    IEEE TAC 40).
    """
    return _along(way, 2, (slip, stuck, stribeck_speed), memory)


def _along(way: Way, count: int, bending: tuple[float, float, float], memory: Memory) -> tuple[Array, Memory]:
    """States (N, ``count``) along a way, and the memory after; see :func:`_bent`."""
    state, past = cast('tuple[Array | None, Memory]', memory) if memory is not None else (None, None)
    states = _bent(*way.from_(past), *bending, np.zeros(count) if state is None else np.array(state, dtype=float))
    return states, (states[-1].copy(), way.last)


def play_place(way: Way, gap: float, memory: Memory) -> tuple[Array, Memory]:
    """Places (N,) in [-1, 1] between the flanks of a gap along a way, and the memory after."""
    place, past = cast('tuple[float, Memory]', memory) if memory is not None else (0.0, None)
    travel, _, past = way.followed(past)
    places = _follow_play(2.0 / gap * travel, float(place))
    return places[PARTS - 1::PARTS].copy(), (float(places[-1]), past)


class Way(NamedTuple):
    """Way of a joint over N samples: stamps [ns], positions and velocities, each (N,)."""

    stamps: Stamps
    position: Array
    velocity: Array

    def followed(self, past: Memory) -> tuple[Array, Array, Memory]:
        """Signed travel and velocity (N PARTS,) in each part of the steps to the samples, and (stamp, position,
        velocity) of the last one.

        Between two samples the velocity is the parabola that has the velocities and the travel measured there. Where it
        changes its sign the joint went on and came back: dry friction turns over there, not where the net travel ends.
        Where positions and velocities disagree, the travel is even.
        """
        return *_followed(*self.from_(past)), self.last

    def from_(self, past: Memory) -> tuple[Stamps, Array, Array, int, float, float]:
        """Arguments of :func:`_followed`: the way, and the sample before it; where there is none, its first one."""
        begin = cast('tuple[int, float, float]', past) if past is not None else self._sample(0)
        return np.array(self.stamps), np.array(self.position), np.array(self.velocity), *begin

    @property
    def last(self) -> Memory:
        """Stamp, position and velocity of the last sample."""
        return self._sample(-1)

    def without_noise_at_rest(self, time: Array) -> Way:
        """The way on which, in each rest, the joint goes only as far as positions leave the range of their noise.

        The steps of noise add up to the length of a bristle within seconds, though the joint stays where it is. In the
        middle half of a rest what is left of the motion before and after is least, so the range there is noise, unless
        it is more than a rest allows: then the joint creeps.
        """
        position, velocity = self.position.copy(), self.velocity.copy()
        most = SPEED_SHARE * LEAST_S * np.abs(velocity).max(initial=0.0)
        edges = np.diff(still(time, position, velocity).astype(int), prepend=0, append=0)
        for start, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
            rest, quarter = position[start:end], (end - start) // 4
            gap = float(np.ptp(rest[quarter:len(rest) - quarter]))
            if 0.0 < gap < most:
                steps = np.diff(rest, prepend=rest[0])
                rest -= 0.5 * gap * _follow_play(2.0 / gap * steps, 0.0)
                velocity[start:end][np.diff(rest, prepend=rest[0]) == 0.0] = 0.0
        return Way(self.stamps, position, velocity)

    def _sample(self, index: int) -> tuple[int, float, float]:
        return int(self.stamps[index]), float(self.position[index]), float(self.velocity[index])


@compiled
def _followed(stamps: Integers, position: Vector, velocity: Vector, stamp: int, place: float,
              speed: float) -> tuple[Vector, Vector]:
    """Travels and speeds (N PARTS,) as :meth:`Way.followed`."""
    halves = PARTS // 2
    travel, speeds = np.empty(len(stamps) * PARTS), np.empty(len(stamps) * PARTS)
    for i in range(len(stamps)):
        step = (stamps[i] - stamp) * 1e-9
        net, start, end = position[i] - place, speed * step, velocity[i] * step
        if not abs(net - 0.5 * (start + end)) < MOST_APART * (abs(start) + abs(end)):
            start = end = net
        rise, bend = 6.0 * net - 4.0 * start - 2.0 * end, 3.0 * (start + end) - 6.0 * net
        inner = max(rise * rise - 4.0 * bend * start, 0.0)
        root = -0.5 * (rise + np.copysign(np.sqrt(inner), rise))
        middle = 0.5
        if start * (start + rise + bend) < 0.0 and root != 0.0:
            middle = start / root
        if middle < 0.0 or middle > 1.0:  # the other zero
            middle = root / bend
        before = gone = 0.0
        for part in range(2 * halves):
            late = part >= halves
            share = (part + 1 - halves * late) / halves
            time = middle + (1.0 - middle) * share if late else middle * share
            there = time * (start + time * (rise / 2.0 + time * bend / 3.0))
            length, index = (time - before) * step, 2 * halves * i + part
            travel[index] = there - gone
            speeds[index] = travel[index] / length if length > 0.0 else 0.0
            before, gone = time, there
        stamp, place, speed = stamps[i], position[i], velocity[i]
    return travel, speeds


@compiled
def _bent(stamps: Integers, position: Vector, velocity: Vector, stamp: int, place: float, speed: float,
          slip: float, stuck: float, stribeck_speed: float, state: Vector) -> Matrix:
    """States (N, k) at the samples of a way, from a state (k,) before it, which each part of a step leads on towards
    the direction of travel; the second one, where there is one, towards a level that fades with the speed."""
    travel, speeds = _followed(stamps, position, velocity, stamp, place, speed)
    states = np.empty((len(stamps), len(state)))
    for part in range(len(travel)):
        way = abs(travel[part])
        aim = 1.0 if travel[part] > 0.0 else -1.0 if travel[part] < 0.0 else 0.0
        if len(state) == 1:
            state[0] = aim + (state[0] - aim) * np.exp(-way / slip)
        else:
            fading = np.exp(-(speeds[part] / stribeck_speed) ** 2)
            # Rounding leaves nothing of a tiny one.
            keep = np.exp(-way / max(slip + (stuck - slip) * fading, LEAST_SLIP))
            state[0] = aim + (state[0] - aim) * keep
            state[1] = aim * fading + (state[1] - aim * fading) * keep
        if (part + 1) % PARTS == 0:
            states[part // PARTS] = state
    return states


def _dahl(steps: Array, slip: float, state: Array) -> Array:
    """States (N, k) after each step (N, k) of travel."""
    length = np.linalg.norm(steps, axis=1)
    aims = np.divide(steps, length[:, None], out=np.zeros_like(steps), where=length[:, None] > 0.0)
    return _follow_all(np.exp(-length / slip), np.ascontiguousarray(aims), np.array(state, dtype=float))


@compiled
def _follow_all(keep: Vector, aims: Matrix, state: Vector) -> Matrix:
    """States (M, k), each of which keeps a share (M,) of its difference to an aim (M, k)."""
    states = np.empty(aims.shape)
    for row in range(len(keep)):
        for column in range(len(state)):
            state[column] = aims[row, column] + (state[column] - aims[row, column]) * keep[row]
            states[row, column] = state[column]
    return states


@compiled
def _follow_bouc_wen(steps: Vector, share: float, state: float) -> Vector:
    states = np.empty(len(steps))
    for index in range(len(steps)):
        way = abs(steps[index])
        sign = 1.0 if steps[index] > 0.0 else -1.0
        along = sign * state
        if along < 0.0:
            back = min(way, np.log1p(-share * along) / share)
            along = (along - 1.0 / share) * np.exp(-share * back) + 1.0 / share
            way -= back
        state = sign * (1.0 + (along - 1.0) * np.exp(-way))
        states[index] = state
    return states


@compiled
def _follow_play(steps: Vector, place: float) -> Vector:
    places = np.empty(len(steps))
    for index in range(len(steps)):
        place = min(max(place + steps[index], -1.0), 1.0)
        places[index] = place
    return places
