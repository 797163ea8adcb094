"""States that remember the way travelled."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.compiled import AVAILABLE, MATRIX, NUMBER, VECTOR, compiled
from semiparam_ros.core.types import Array, Stamps

MOST_APART = 0.1
"""Of the sum of two speeds times the step: how far a turning joint's travel may be from their mean's."""


def dahl_state(travel: Array, slip: float, memory: Memory) -> tuple[Array, Memory]:
    """(N, k) state in [-1, 1] along travels (N, k), and (last travel, last state) to go on from.

    Each step of travel is followed exactly: the state decays towards its direction over ``slip``.
    """
    place, state = cast('tuple[Array, Array]', memory) if memory is not None else (travel[0], np.zeros(travel.shape[1]))
    states = _dahl(np.diff(travel, axis=0, prepend=place[None]), slip, state)
    return states, (travel[-1], states[-1])


def bristle(way: Way, slip: float, memory: Memory) -> tuple[Array, Memory]:
    """(N,) state of a Dahl bristle in [-1, 1] along a way that may turn back between two samples."""
    state, past = cast('tuple[float, Memory]', memory) if memory is not None else (0.0, None)
    pieces, past = way.pieces(past)
    states = _dahl(pieces[:, None], slip, np.array([state]))[1::2, 0]
    return states, (float(states[-1]), past)


def play_place(way: Way, gap: float, memory: Memory) -> tuple[Array, Memory]:
    """(N,) place in [-1, 1] between the flanks of a gap that a way crosses, and what to go on from."""
    place, past = cast('tuple[float, Memory]', memory) if memory is not None else (0.0, None)
    pieces, past = way.pieces(past)
    steps, places = 2.0 / gap * pieces, np.empty(len(pieces))
    if AVAILABLE:
        _play_all(steps, float(place), places)
    else:
        for index, step in enumerate(steps.tolist()):
            place = min(max(place + step, -1.0), 1.0)
            places[index] = place
    return places[1::2].copy(), (float(places[-1]), past)


class Way(NamedTuple):
    """What a joint travels over N samples: ``stamps`` (N,) [ns], ``position`` and ``velocity`` (N,)."""

    stamps: Stamps
    position: Array
    velocity: Array

    def pieces(self, past: Memory) -> tuple[Array, Memory]:
        """(2 N,) two signed pieces of travel before each sample, and (stamp, position, velocity) of the last one.

        Where the velocity changes its sign between two samples, the joint went on and came back: with a velocity that
        is linear in between, the turning point follows. Dry friction turns over there, not where the net travel ends.
        Elsewhere, and where positions and velocities disagree, the second piece is zero.
        """
        stamp, place, speed = cast('tuple[int, float, float]', past) if past is not None else (
            int(self.stamps[0]), float(self.position[0]), float(self.velocity[0]))
        before, step = np.append(speed, self.velocity[:-1]), np.diff(self.stamps, prepend=stamp) * 1e-9
        net, after = np.diff(self.position, prepend=place), self.velocity
        change = np.abs(before) + np.abs(after)
        on = 0.5 * before * step * np.divide(np.abs(before), change, out=np.zeros_like(net), where=change > 0.0)
        turns = (before * after < 0.0) & (np.abs(net - 0.5 * (before + after) * step) < MOST_APART * change * step)
        turns &= (net - on) * after >= 0.0
        pieces = np.column_stack([np.where(turns, on, net), np.where(turns, net - on, 0.0)]).ravel()
        return pieces, (int(self.stamps[-1]), float(self.position[-1]), float(self.velocity[-1]))


def _dahl(steps: Array, slip: float, state: Array) -> Array:
    """(N, k) states after each step (N, k) of travel."""
    length = np.linalg.norm(steps, axis=1)
    aims = np.divide(steps, length[:, None], out=np.zeros_like(steps), where=length[:, None] > 0.0)
    keep = np.exp(-length / slip)
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


@compiled(VECTOR, NUMBER, VECTOR)
def _play_all(steps: Array, place: float, places: Array) -> None:
    for index in range(len(steps)):
        place = min(max(place + steps[index], -1.0), 1.0)
        places[index] = place
