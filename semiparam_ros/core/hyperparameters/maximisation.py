"""Search for the hyperparameters: where it starts, how it climbs the log evidence, which end it
keeps.

A coarse scan on a thinned window gives the starts; each is searched on a draft; the best ends are polished on all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy  # it loads scipy.optimize, which takes a fifth of a second, with the first use

from semiparam_ros.core.hyperparameters.marginal_likelihood import Point, Slope, Window, evidence
from semiparam_ros.core.hyperparameters.window import least_squares, normalised, residual_scale
from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError

SCAN = (200, 50)
"""Samples and frequencies of the coarse scan that finds the starts."""
DRAFT = (500, 150)
"""Samples and frequencies of the searches from every start; the best end is then polished on all of them."""
TAU_SCAN = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
KIND_PATTERNS = ((1.0, 1.0, 1.0), (1.0, 3.0, 6.0))
SIGNAL_SCAN = (0.3, 3.0)
NOISE_SCAN = (0.03, 0.3, 1.0)
FIRST_KAPPA, FIRST_MEMORY = 0.3, 20.0
LEAST_DRIFT, MOST_DRIFT = (1e-3, 3.0), (1e2, 1e3)
"""Bounds of kappa and memory [samples]: a faster drift is noise, a slower one is an offset."""
LEAST_TAU = 0.1
"""Of scaled inputs, with the paper's priors."""
SAME_BASIN = 0.5
"""Draft ends farther apart than this in any logarithm are polished separately."""
SAME_TOP = 0.2
"""[nat] Unless their values are as close as this: then one flat top lies between them."""

Objective = Callable[[Array, bool], tuple[float, Array]]
"""Point (k,) and whether the gradient is wanted -> value and gradient (k,) (anything if not wanted)."""

METHODS = ('quasi-newton', 'nelder-mead')
SIMPLEX_STEP = 0.5
"""Edge of the first simplex, in logarithms: a factor of 1.65."""


class EvidenceMaximum(NamedTuple):
    """The hyperparameters, theta (p,) there, and the log evidence [nat]."""

    at: Point
    theta: Array
    value: float


@dataclass(frozen=True)
class Coordinates:
    """Logarithms that are searched, in the order gamma, rho, tau, sigma, kappa, memory, output
    scales."""

    free: Array  # boolean mask over the full vector
    base: Array  # logarithms of the values that stay
    groups: int
    drifting: bool

    def point(self, vector: Array) -> Point:
        """Hyperparameters at the searched logarithms; the mean log scale is taken out (it is sigma's and rho's)."""
        full = self.base.copy()
        full[self.free] = vector
        gamma, rho, *tau = np.exp(full[:2 + self.groups]).tolist()
        sigma, kappa, memory = np.exp(full[2 + self.groups:5 + self.groups]).tolist()
        scale = full[5 + self.groups:]
        return Point(gamma, rho, np.array(tau), sigma, np.exp(scale - scale.mean()), kappa * self.drifting, memory)

    def gradient(self, slope: Slope) -> Array:
        """(k,) slope by the searched logarithms."""
        scale = slope.output_scale - slope.output_scale.mean()
        noise = [slope.sigma, slope.kappa, slope.memory]
        full = np.concatenate([[slope.gamma, slope.rho], slope.tau, noise, scale])
        return np.asarray(full[self.free])

    def vector(self, at: Point) -> Array:
        """(k,) searched logarithms of a point."""
        return np.asarray(logarithms(at)[self.free])


def maximise_evidence(window: Window, noise: str, drifting: bool, method: str, starts: int,
                      jobs: int) -> EvidenceMaximum:
    """The best of several searches; every start is drafted on a thinned window, the best ends polished on all of it.

    :param drifting: the noise is white plus a drift; otherwise white, as in the paper.
    """
    guess = first_guess(window, noise, drifting)
    coordinates, bounds = _coordinates(window, guess, noise), _bounds(window, guess)
    box = bounds[coordinates.free]
    draft = window.thinned(*DRAFT)
    begin = [coordinates.vector(at) for at in scan(window, guess, starts)]
    # the draft is only a warm start: an end within a tenth of a nat is as good as any
    ends = maximise(_Objective(draft, coordinates), begin, box, method, iterations=80, tolerance=1e-6, jobs=jobs)
    if len(draft.outputs) == len(window.outputs) and len(draft.spectrum) == len(window.spectrum):
        chosen = [ends[0].point]
    else:
        chosen = [end.point for end in _distinct(ends)]
    return _best(window, coordinates, chosen, box, method, jobs)


def draft_maximum(window: Window, noise: str, drifting: bool, method: str) -> EvidenceMaximum:
    """The best of two searches from the coarse scan and on as few samples as it: in a tenth of the time."""
    guess = first_guess(window, noise, drifting)
    coordinates, bounds = _coordinates(window, guess, noise), _bounds(window, guess)
    begin = [coordinates.vector(at) for at in scan(window, guess, 2)]
    thin = _Objective(window.thinned(*SCAN), coordinates)
    end = maximise(thin, begin, bounds[coordinates.free], method, iterations=80, tolerance=1e-6)[0]
    return _maximum(window, coordinates.point(end.point))


def maximise_from(window: Window, start: Point, noise: str, drifting: bool, method: str) -> EvidenceMaximum:
    """The maximum that a single search finds from a start, such as the maximum of a window much like this one."""
    guess = first_guess(window, noise, drifting)
    coordinates, bounds = _coordinates(window, guess, noise), _bounds(window, guess)
    begin = coordinates.vector(start._replace(gamma=start.gamma or guess.gamma))
    return _best(window, coordinates, [begin], bounds[coordinates.free], method)


def _best(window: Window, coordinates: Coordinates, starts: Sequence[Array], box: Array, method: str,
          jobs: int = 1) -> EvidenceMaximum:
    best = maximise(_Objective(window, coordinates), starts, box, method, jobs=jobs)[0]
    return _maximum(window, coordinates.point(best.point))


def _maximum(window: Window, at: Point) -> EvidenceMaximum:
    result = evidence(window, at, gradient=False)
    present = at._replace(gamma=at.gamma * _has_prior(window), rho=at.rho * (len(window.spectrum) > 0))
    return EvidenceMaximum(present, result.theta, result.value)


class _Objective:
    """The evidence as a function of the searched logarithms."""

    def __init__(self, window: Window, coordinates: Coordinates) -> None:
        self.window, self.coordinates = window, coordinates

    def __call__(self, vector: Array, gradient: bool) -> tuple[float, Array]:
        result = evidence(self.window, self.coordinates.point(vector), gradient)
        return result.value, vector if result.slope is None else self.coordinates.gradient(result.slope)


def first_guess(window: Window, noise: str, drifting: bool = False) -> Point:
    """A point of the right orders of magnitude, from a least squares fit of the coupled columns."""
    theta = least_squares(window.outputs, window.coupled)
    residuals = window.outputs - window.coupled @ theta
    scale = residual_scale(residuals, window.outputs)
    output_scale = np.ones_like(scale) if noise == 'one' else normalised(scale)
    left = float(np.sqrt(np.mean((residuals / output_scale) ** 2)))
    spread = theta / window.prior_scale
    gamma = 1.0
    if len(theta) and not window.physical:
        gamma = max(float(np.sqrt(np.mean(spread**2))), 1e-3)
    groups = int(window.groups.max()) + 1
    return Point(gamma, left, np.full(groups, 2.0), left, output_scale, FIRST_KAPPA * drifting, FIRST_MEMORY)


def scan(window: Window, guess: Point, starts: int) -> list[Point]:
    """The best points of a coarse grid on a thinned window, no two with the same length scales."""
    if not len(window.spectrum):
        return [guess._replace(sigma=guess.sigma * factor) for factor in (1.0, 0.5, 2.0, 0.1)[:starts]]
    thin = window.thinned(*SCAN)
    scored = sorted(((evidence(thin, at, gradient=False).value, index, at)
                     for index, at in enumerate(_grid(window, guess))), key=lambda entry: -entry[0])
    chosen: dict[tuple[float, ...], Point] = {}
    for _, _, at in scored:
        chosen.setdefault(tuple(at.tau.tolist()), at)
    return list(chosen.values())[:max(starts, 1)]


def _grid(window: Window, guess: Point) -> Iterator[Point]:
    groups, shortest = len(guess.tau), shortest_scale(window)
    patterns = KIND_PATTERNS if groups > 1 else KIND_PATTERNS[:1]
    for tau, pattern, signal, left in product(TAU_SCAN, patterns, SIGNAL_SCAN, NOISE_SCAN):
        per_group = np.repeat(pattern, max(1, groups // len(pattern)))[:groups]
        yield guess._replace(tau=np.maximum(tau * per_group, shortest), rho=signal * guess.rho,
                             sigma=left * guess.sigma)


def shortest_scale(window: Window) -> float:
    """Least length scale.

    D features show their kernel to D^-1/2. With physical priors two inputs of the window are at least as alike as that,
    exp(-m / tau^2): what is rougher is the features' own, not the robot's.
    """
    if not window.physical or not len(window.spectrum):
        return LEAST_TAU
    frequencies, inputs = window.spectrum.shape
    return float(np.sqrt(2.0 * inputs / np.log(2.0 * frequencies)))


def _coordinates(window: Window, guess: Point, noise: str) -> Coordinates:
    nonparametric, n = bool(len(window.spectrum)), window.outputs.shape[1]
    several, drifting = noise == 'output' and n > 1, guess.kappa > 0.0
    free = [_has_prior(window) and not window.physical, nonparametric, *[nonparametric] * len(guess.tau), True,
            drifting, drifting, *[several] * n]
    return Coordinates(np.array(free), logarithms(guess), len(guess.tau), drifting)


def _bounds(window: Window, guess: Point) -> Array:
    """(k, 2) logarithms: generous, yet such that the shared covariance keeps a Cholesky factor."""
    size = float(np.sqrt(np.mean((window.outputs / guess.output_scale) ** 2)))
    low = [1e-4 * guess.gamma, 1e-3 * guess.rho, *[shortest_scale(window)] * len(guess.tau), 1e-4 * guess.sigma,
           *LEAST_DRIFT, *(1e-4 * guess.output_scale)]
    largest = guess.rho if window.physical else 1e3 * size
    high = [1e4 * guess.gamma, largest, *[300.0] * len(guess.tau), 10.0 * size, *MOST_DRIFT,
            *(1e4 * guess.output_scale)]
    return np.asarray(np.log(np.column_stack([low, high])))


def _distinct(ends: list[Maximum]) -> list[Maximum]:
    """The best end, and the next best if it lies in another basin and is not clearly worse."""
    others = [end for end in ends[1:] if np.abs(end.point - ends[0].point).max() > SAME_BASIN
              and SAME_TOP < ends[0].value - end.value < 10.0]
    return [ends[0], *others[:1]]


def _has_prior(window: Window) -> bool:
    return window.coupled.shape[2] > 0 and not window.profiled


def logarithms(at: Point) -> Array:
    """The full vector of logarithms of a point."""
    noise = [at.sigma, at.kappa or 1.0, at.memory]
    return np.asarray(np.log(np.concatenate([[at.gamma, at.rho], at.tau, noise, at.output_scale])))


class Maximum(NamedTuple):
    """End of a search."""

    point: Array
    value: float


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
    with ThreadPoolExecutor(jobs) as threads:
        ends = list((map if jobs == 1 else threads.map)(
            lambda start: search(objective, start, bounds, iterations, tolerance), inside))
    return sorted(ends, key=lambda end: -end.value)


def _quasi_newton(objective: Objective, start: Array, bounds: Array, iterations: int, tolerance: float) -> Maximum:
    # the value may be thousands of nats: scaled, so that the first step is about one unit long
    unit = max(1.0, float(np.abs(objective(start, True)[1]).max()))

    def descend(point: Array) -> tuple[float, Array]:
        value, gradient = objective(point, True)
        return -value / unit, -gradient / unit

    found = scipy.optimize.minimize(
        descend, start, jac=True, method='L-BFGS-B', bounds=bounds,
        options={'maxiter': iterations, 'ftol': tolerance, 'gtol': 1e-7, 'maxcor': 20})
    return Maximum(np.asarray(found.x), -float(found.fun) * unit)


def _nelder_mead(objective: Objective, start: Array, bounds: Array, iterations: int, tolerance: float) -> Maximum:
    inward = np.where(start + SIMPLEX_STEP > bounds[:, 1], -SIMPLEX_STEP, SIMPLEX_STEP)
    simplex = np.vstack([start, start + np.diag(inward)])
    found = scipy.optimize.minimize(
        lambda point: -objective(point, False)[0], start, method='Nelder-Mead', bounds=bounds,
        options={'maxiter': 20 * iterations, 'maxfev': 20 * iterations, 'initial_simplex': simplex,
                 'fatol': max(1e-3, tolerance), 'xatol': 1e-3, 'adaptive': True})
    return Maximum(np.asarray(found.x), -float(found.fun))
