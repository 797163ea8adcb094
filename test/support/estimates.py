"""What is searched for with the same arguments by several tests: found once, and remembered."""

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np

from semiparam_ros.core.hyperparameters.estimation import Hyperparameters, estimate


def digest(value: Any) -> Any:
    """The same for equal arrays; whatever else is a key by itself."""
    return (value.shape, hashlib.sha256(value.tobytes()).digest()) if isinstance(value, np.ndarray) else value


class Estimates:
    """Stands in for ``semiparam_ros.core.model.estimate``, and remembers what it gave for the same window.

    :param options: of every search, such as fewer starts where it does not matter how good its end is.
    """

    def __init__(self, **options: Any) -> None:
        self.options = options
        self.known: dict[object, Hyperparameters] = {}

    def __call__(self, *positional: Any, **named: Any) -> Hyperparameters:
        key = tuple(map(digest, (*positional, *named, *named.values())))
        if key not in self.known:
            self.known[key] = estimate(*positional, **named | self.options)
        return self.known[key]


def remembered(best: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """``best`` of a smoothing problem, searched once for the same motion: many diagnoses are of one motion."""
    known: dict[object, Any] = {}

    def of(problem: Any) -> Any:
        key = problem.order, *map(digest, (problem.steps, *problem.motion))
        if key not in known:
            known[key] = best(problem)
        return known[key].copy()
    return of
