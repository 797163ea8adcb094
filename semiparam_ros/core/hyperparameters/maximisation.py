"""Maximise a smooth function from several deterministic starts, and keep the best end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed
from scipy.optimize import minimize

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

Objective = Callable[[Array, bool], tuple[float, Array]]
"""Point (k,) and whether the gradient is wanted -> value and gradient (k,) (anything if not wanted)."""

METHODS = ('quasi-newton', 'nelder-mead')
SIMPLEX_STEP = 0.5
"""Edge of the first simplex, in logarithms: a factor of 1.65."""


class Maximum(NamedTuple):
    """Where a search ended."""

    point: Array
    value: float
    evaluations: int


def maximise(objective: Objective, starts: Sequence[Array], bounds: Array, method: str = 'quasi-newton',
             iterations: int = 200, tolerance: float = 1e-9, jobs: int = 1) -> list[Maximum]:
    """Search from every start and return the ends, best first.

    :param bounds: (k, 2) box of the search.
    :param tolerance: relative change of the value at which a search ends.
    :param jobs: searches at a time, in threads (the time goes into LAPACK, which releases the interpreter).
    """
    if method not in METHODS:
        raise SemiparamError(f"unknown optimiser '{method}'; expected one of {', '.join(METHODS)}.")
    search = _quasi_newton if method == 'quasi-newton' else _nelder_mead
    inside = [np.clip(start, bounds[:, 0], bounds[:, 1]) for start in starts]
    ends = Parallel(n_jobs=jobs, prefer='threads')(
        delayed(search)(objective, start, bounds, iterations, tolerance) for start in inside)
    return sorted(ends, key=lambda end: -end.value)


def _quasi_newton(objective: Objective, start: Array, bounds: Array, iterations: int, tolerance: float) -> Maximum:
    # the value may be thousands of nats: scaled, so that the first step is about one unit long
    unit = max(1.0, float(np.abs(objective(start, True)[1]).max()))

    def descend(point: Array) -> tuple[float, Array]:
        value, gradient = objective(point, True)
        return -value / unit, -gradient / unit

    found = minimize(descend, start, jac=True, method='L-BFGS-B', bounds=bounds,
                     options={'maxiter': iterations, 'ftol': tolerance, 'gtol': 1e-7, 'maxcor': 20})
    return Maximum(np.asarray(found.x), -float(found.fun) * unit, int(found.nfev) + 1)


def _nelder_mead(objective: Objective, start: Array, bounds: Array, iterations: int, tolerance: float) -> Maximum:
    inward = np.where(start + SIMPLEX_STEP > bounds[:, 1], -SIMPLEX_STEP, SIMPLEX_STEP)
    simplex = np.vstack([start, start + np.diag(inward)])
    found = minimize(lambda point: -objective(point, False)[0], start, method='Nelder-Mead', bounds=bounds,
                     options={'maxiter': 20 * iterations, 'maxfev': 20 * iterations, 'initial_simplex': simplex,
                              'fatol': max(1e-3, tolerance), 'xatol': 1e-3, 'adaptive': True})
    return Maximum(np.asarray(found.x), -float(found.fun), int(found.nfev))
