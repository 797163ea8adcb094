"""States that remember the way travelled."""

from __future__ import annotations

from typing import cast

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.compiled import AVAILABLE, MATRIX, NUMBER, VECTOR, compiled
from semiparam_ros.core.types import Array


def dahl_state(travel: Array, slip: float, memory: Memory) -> tuple[Array, Memory]:
    """(N, k) state in [-1, 1] along travels (N, k), and (last travel, last state) to go on from.

    Each step of travel is followed exactly: the state decays towards its direction over ``slip``.
    """
    place, state = cast('tuple[Array, Array]', memory) if memory is not None else (travel[0], np.zeros(travel.shape[1]))
    steps = np.diff(travel, axis=0, prepend=place[None])
    length = np.linalg.norm(steps, axis=1)
    aims = np.divide(steps, length[:, None], out=np.zeros_like(steps), where=length[:, None] > 0.0)
    keep = np.exp(-length / slip)
    states = np.empty(aims.shape)
    if AVAILABLE:
        _follow_all(keep, np.ascontiguousarray(aims), np.array(state, dtype=float), states)
    else:
        for column, aim in enumerate(aims.T.tolist()):
            states[:, column] = _follow(float(state[column]), keep.tolist(), aim)
    return states, (travel[-1], states[-1])


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


def play_place(travel: Array, gap: float, memory: Memory) -> tuple[Array, Memory]:
    """(N,) place in [-1, 1] between the flanks of a gap that travel (N,) crosses, and what to go on from."""
    last, place = cast('tuple[float, float]', memory) if memory is not None else (float(travel[0]), 0.0)
    steps, places = 2.0 / gap * np.diff(travel, prepend=last), np.empty(len(travel))
    if AVAILABLE:
        _play_all(steps, float(place), places)
    else:
        for index, step in enumerate(steps.tolist()):
            place = min(max(place + step, -1.0), 1.0)
            places[index] = place
    return places, (float(travel[-1]), float(places[-1]))


@compiled(VECTOR, NUMBER, VECTOR)
def _play_all(steps: Array, place: float, places: Array) -> None:
    for index in range(len(steps)):
        place = min(max(place + steps[index], -1.0), 1.0)
        places[index] = place
