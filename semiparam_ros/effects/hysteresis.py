"""States that remember the way travelled."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, cast

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.compiled import (
    AVAILABLE,
    INTEGER,
    INTEGERS,
    MATRIX,
    NUMBER,
    VECTOR,
    compiled,
)
from semiparam_ros.core.types import Array, Stamps

MOST_APART = 0.1
"""Largest difference of a travel from its two speeds' mean, over their sum, that is believed."""
PARTS = 8
"""Parts of a step between two samples that are followed one by one; half of them lie before the joint turns back."""
_HALF = np.linspace(0.0, 1.0, PARTS // 2 + 1)


def dahl_state(travel: Array, slip: float, memory: Memory) -> tuple[Array, Memory]:
    """States (N, k) in [-1, 1] along travels (N, k), and (last travel, last state) to go on from.

    Each step of travel is followed exactly: the state decays towards its direction over ``slip``.
    """
    place, state = cast('tuple[Array, Array]', memory) if memory is not None else (travel[0], np.zeros(travel.shape[1]))
    states = _dahl(np.diff(travel, axis=0, prepend=place[None]), slip, state)
    return states, (travel[-1], states[-1])


def bouc_wen_state(travel: Array, slip: float, unloading: float, memory: Memory) -> tuple[Array, Memory]:
    """States z (N,) in [-1, 1] along a travel (N,), and (last travel, last state) to go on from
    (Wen 1976, J. Eng. Mech. Div. 102).

    Along its travel it is Dahl's: slip dz/dx = 1 - z. Back to zero it is slip dz/dx = 1 - (slip /
    unloading) z, which is Dahl's too where the two are equal. Each step is followed exactly.
    """
    place, state = cast('tuple[float, float]', memory) if memory is not None else (float(travel[0]), 0.0)
    states = np.empty(len(travel))
    _follow_bouc_wen(np.diff(travel, prepend=place) / slip, slip / unloading, float(state), states)
    return states, (float(travel[-1]), float(states[-1]))


def bristle(way: Way, slip: float, memory: Memory) -> tuple[Array, Memory]:
    """States (N,) in [-1, 1] of a Dahl bristle along a way, which may turn back within a step."""
    states, memory = _bent(way, lambda aims, speeds: (aims[:, None], slip), memory)
    return states[:, 0], memory


def sticking_bristle(way: Way, slip: float, stuck: float, stribeck_speed: float,
                     memory: Memory) -> tuple[Array, Memory]:
    """States (N, 2) of a bristle: one slides at 1, one at exp(-(speed / stribeck_speed)^2).

    It bends over ``slip`` while it slides and over ``stuck`` at standstill: a bristle that is as
    stiff at every level bends the further the higher that is (LuGre; Canudas de Wit et al. 1995,
    IEEE TAC 40).
    """
    def levels(aims: Array, speeds: Array) -> tuple[Array, Array]:
        fading = np.exp(-(speeds / stribeck_speed) ** 2)
        return np.column_stack([aims, aims * fading]), slip + (stuck - slip) * fading
    return _bent(way, levels, memory)


def _bent(way: Way, levels: Callable[[Array, Array], tuple[Array, Array | float]],
          memory: Memory) -> tuple[Array, Memory]:
    """States (N, k) along a way that decay towards levels (N PARTS, k) of its direction and speed.
    """
    state, past = cast('tuple[Array | None, Memory]', memory) if memory is not None else (None, None)
    travel, speeds, past = way.followed(past)
    aims, slips = levels(np.sign(travel), speeds)
    states = _towards(aims, np.exp(-np.abs(travel) / slips), np.zeros(aims.shape[1]) if state is None else state)
    return states[PARTS - 1::PARTS].copy(), (states[-1].copy(), past)


def play_place(way: Way, gap: float, memory: Memory) -> tuple[Array, Memory]:
    """Places (N,) in [-1, 1] between the flanks of a gap along a way, and the memory after."""
    place, past = cast('tuple[float, Memory]', memory) if memory is not None else (0.0, None)
    travel, _, past = way.followed(past)
    steps, places = 2.0 / gap * travel, np.empty(len(travel))
    if AVAILABLE:
        _play_all(steps, float(place), places)
    else:
        for index, step in enumerate(steps.tolist()):
            place = min(max(place + step, -1.0), 1.0)
            places[index] = place
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
        begin = cast('tuple[int, float, float]', past) if past is not None else self._sample(0)
        if AVAILABLE:
            travel, speeds = np.empty((2, len(self.stamps) * PARTS))
            _follow_way(*map(np.array, self), *begin, _HALF, travel, speeds)
            return travel, speeds, self._sample(-1)
        return (*self._followed(*begin), self._sample(-1))

    def _sample(self, index: int) -> tuple[int, float, float]:
        return int(self.stamps[index]), float(self.position[index]), float(self.velocity[index])

    def _followed(self, stamp: int, place: float, speed: float) -> tuple[Array, Array]:
        step = np.diff(self.stamps, prepend=stamp) * 1e-9
        net, after = np.diff(self.position, prepend=place), self.velocity * step
        before = np.append(speed, self.velocity[:-1]) * step
        apart = ~(np.abs(net - 0.5 * (before + after)) < MOST_APART * (np.abs(before) + np.abs(after)))
        before, after = np.where(apart, net, before), np.where(apart, net, after)
        parts = _parts_of_steps(before, 6.0 * net - 4.0 * before - 2.0 * after, 3.0 * (before + after) - 6.0 * net)
        travel, lengths = np.diff(parts.travel, axis=1), np.diff(parts.time, axis=1) * step[:, None]
        speeds = np.divide(travel, lengths, out=np.zeros_like(travel), where=lengths > 0.0)
        return travel.ravel(), speeds.ravel()


class _Parts(NamedTuple):
    """Ends of the parts of N steps: ``time`` (N, PARTS + 1) from 0 to 1, and the ``travel`` until then."""

    time: Array
    travel: Array


def _parts_of_steps(start: Array, rise: Array, bend: Array) -> _Parts:
    """Parts of steps in which the velocity is start + rise u + bend u^2 (N,), with the middle one at its zero."""
    root = -0.5 * (rise + np.copysign(np.sqrt(np.maximum(rise**2 - 4.0 * bend * start, 0.0)), rise))
    turns = start * (start + rise + bend) < 0.0
    middle = np.divide(start, root, out=np.full_like(start, 0.5), where=turns & (root != 0.0))
    outside = (middle < 0.0) | (middle > 1.0)  # the other zero
    middle = np.where(outside, np.divide(root, bend, out=np.full_like(start, 0.5), where=outside), middle)[:, None]
    time = np.hstack([middle * _HALF, middle + (1.0 - middle) * _HALF[1:]])
    return _Parts(time, time * (start[:, None] + time * (rise[:, None] / 2.0 + time * bend[:, None] / 3.0)))


@compiled(INTEGERS, VECTOR, VECTOR, INTEGER, NUMBER, NUMBER, VECTOR, VECTOR, VECTOR)
def _follow_way(stamps: Stamps, position: Array, velocity: Array, stamp: int, place: float,
                speed: float, shares: Array, travel: Array, speeds: Array) -> None:
    """Write travels and speeds (N PARTS,) as :meth:`Way.followed`; ``shares`` is _HALF."""
    halves = len(shares) - 1
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
            share = shares[part + 1 - halves * late]
            time = middle + (1.0 - middle) * share if late else middle * share
            there = time * (start + time * (rise / 2.0 + time * bend / 3.0))
            length, index = (time - before) * step, 2 * halves * i + part
            travel[index] = there - gone
            speeds[index] = travel[index] / length if length > 0.0 else 0.0
            before, gone = time, there
        stamp, place, speed = stamps[i], position[i], velocity[i]


def _dahl(steps: Array, slip: float, state: Array) -> Array:
    """States (N, k) after each step (N, k) of travel."""
    length = np.linalg.norm(steps, axis=1)
    aims = np.divide(steps, length[:, None], out=np.zeros_like(steps), where=length[:, None] > 0.0)
    return _towards(aims, np.exp(-length / slip), state)


def _towards(aims: Array, keep: Array, state: Array) -> Array:
    """States (M, k), each of which keeps a share (M,) of its difference to an aim (M, k)."""
    states = np.empty(aims.shape)
    if AVAILABLE:
        _follow_all(keep, np.ascontiguousarray(aims), np.array(state, dtype=float), states)
    else:
        for column, aim in enumerate(aims.T.tolist()):
            states[:, column] = _follow(float(state[column]), keep.tolist(), aim)
    return states


@compiled(VECTOR, MATRIX, VECTOR, MATRIX)
def _follow_all(keep: Array, aims: Array, state: Array, states: Array) -> None:
    for row in range(len(keep)):
        for column in range(len(state)):
            state[column] = aims[row, column] + (state[column] - aims[row, column]) * keep[row]
            states[row, column] = state[column]


def _follow(state: float, keep: list[float], aims: list[float]) -> list[float]:
    states = []
    for kept, aim in zip(keep, aims, strict=True):
        state = aim + (state - aim) * kept
        states.append(state)
    return states


@compiled(VECTOR, NUMBER, NUMBER, VECTOR)
def _follow_bouc_wen(steps: Array, share: float, state: float, states: Array) -> None:
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


@compiled(VECTOR, NUMBER, VECTOR)
def _play_all(steps: Array, place: float, places: Array) -> None:
    for index in range(len(steps)):
        place = min(max(place + steps[index], -1.0), 1.0)
        places[index] = place
