"""Plain forms in numpy of what the package compiles: each as its formula says, with nothing saved."""

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_triangular
from scipy.signal import lfilter

from semiparam_ros.core import band_calibration, wandering_offset
from semiparam_ros.core.band_calibration import MEMORIES
from semiparam_ros.core.input_range import LEAST_RANGE
from semiparam_ros.core.mixture import DEGREES
from semiparam_ros.core.random_features import LEAST_SHARE
from semiparam_ros.core.wandering_offset import DECAY, PACES
from semiparam_ros.effects.hysteresis import MOST_APART, PARTS


def student(standardised):
    return -0.5 * (DEGREES + 1.0) * np.log1p(standardised**2 / DEGREES)


def weights(log_weights):
    shares = np.exp(log_weights)
    return shares / shares.sum(axis=0)


def weigh(log_weights, evidence, memory, least):
    """(H, n) log weights and weights after one sample."""
    log_weights = (1.0 - 1.0 / memory) * log_weights + evidence
    log_weights = np.maximum(log_weights - log_weights.max(axis=0), least)
    return log_weights, weights(log_weights)


def follow(residual, std, table):
    """Table of the wandering offsets after one sample."""
    values, log_weights = np.split(table[:2 * len(PACES)], 2)
    standardised = (residual - values) / std
    log_weights, shares = weigh(log_weights, student(standardised), wandering_offset.EVIDENCE_MEMORY,
                                wandering_offset.LEAST_LOG_WEIGHT)
    step = std * np.clip(standardised, -wandering_offset.LARGEST_STEP, wandering_offset.LARGEST_STEP)
    values = DECAY[:, None] * (values + PACES[:, None] * step)
    return np.vstack([values, log_weights, shares * values, (shares * values).sum(axis=0)])


def calibrate(innovation, std, table):
    """Table of the bands after one sample."""
    values, log_weights = np.split(table[:2 * len(MEMORIES)], 2)
    ratio = np.minimum((innovation / std) ** 2, band_calibration.LARGEST_STEP * values.max(axis=0))
    widening, rate = (1.0 + 2.0 / (2.0 * MEMORIES - 3.0))[:, None], 1.0 / MEMORIES[:, None]
    wide = widening * values
    log_weights, shares = weigh(log_weights, -0.5 * (np.log(wide) + ratio / wide), band_calibration.EVIDENCE_MEMORY,
                                band_calibration.LEAST_LOG_WEIGHT)
    step = np.minimum(ratio, band_calibration.LARGEST_STEP * values) - values
    values = np.maximum(values + rate * step, band_calibration.LEAST_SCALE)
    return np.vstack([values, log_weights, np.sqrt((shares * widening * values).sum(axis=0))])


def project(root, phi):
    """f, S f and Theta' phi."""
    size = len(phi)
    array = root.array.T + root.left[:root.waiting].T @ root.right[:root.waiting]
    root_s, used = root.inflation * array[:, :size], root.places >= 0
    regressed = np.zeros(len(root.places))
    regressed[used] = (phi @ array[:, size:])[root.places[used]]
    return root_s.T @ phi, root_s @ (root_s.T @ phi), regressed


def predict(recursion, phi, columns, known, extra_variance):
    """Mean and covariance of the outputs."""
    root, regression = recursion.arrays
    f, _, regressed = project(root, phi)
    regressed = regressed.reshape(len(columns), -1)
    regressed[:, -1] += known
    left, s = columns - regressed[:, :-1], regression.sigma**2 + f @ f
    half = solve_triangular(regression.information[:-1, :-1], left.T[::-1], trans=1)
    return regressed[:, -1] + left @ recursion.theta, np.diag(s * regression.scale**2 + extra_variance) + half.T @ half


def learn(recursion, prior, outputs):
    """(p,) theta, and (n, p + 1) innovations of a sample."""
    _, regression = recursion.arrays
    innovations = np.column_stack([prior.columns, outputs]) - prior.projection.regressed.reshape(len(outputs), -1)
    s = regression.tempered_sigma**2 + prior.projection.f @ prior.projection.f
    r = (regression.tempered_sigma / regression.sigma) ** 2
    rows = innovations / np.sqrt(s * regression.scale**2 + r * prior.extra_variance)[:, None]
    rows = np.hstack([rows[:, -2::-1], rows[:, -1:]])
    r = np.linalg.qr(np.vstack([regression.information, rows]), mode='r')
    return solve_triangular(r[:-1, :-1], r[:-1, -1])[::-1], innovations


def pool_weights(weights, std):
    """(..., K, n) v, one in sum over the K models; w is (..., K, n) and the standard deviations are (K, n)."""
    shares = weights * (std.min(axis=0) / std) ** 2
    return shares / shares.sum(axis=-2, keepdims=True)


def pool_together(weights, means, covariances, disagreeing=None):
    """(n,) mean and (n, n) covariance of the pool; ``disagreeing``: weights by which the disagreement counts."""
    std = np.sqrt(covariances.diagonal(axis1=1, axis2=2))
    shares = pool_weights(weights, std)
    roots, mean = np.sqrt(shares), (shares * means).sum(axis=0)
    apart = (roots if disagreeing is None else np.sqrt(pool_weights(disagreeing, std))) * (means - mean)
    return mean, np.einsum('mk,mkj,mj->kj', roots, covariances, roots) + apart.T @ apart


def pool_desired(weights, disagreeing, shown, needed, covariances, ratios):
    std = np.sqrt(covariances.diagonal(axis1=1, axis2=2))
    ratio = pool_weights(disagreeing, std).mean(axis=1) @ ratios
    mean, covariance = pool_together(weights, shown, covariances, disagreeing)
    return mean, (pool_weights(weights, std) * needed).sum(axis=0), covariance, ratio


def weigh_elsewhere(log_weights, known, without):
    """(K, n) weights at a state; ``without``: numbers of the models without features."""
    alike, likely = np.sqrt(known)[:, None], known / len(known)
    likely[without] += (1.0 - likely.sum()) / len(without)
    log_weights = alike * log_weights + (1.0 - alike) * log_weights[without].max(axis=0) + np.log(likely)[:, None]
    weights = np.exp(log_weights - log_weights.max(axis=0))
    return weights / weights.sum(axis=0)


def pool(weights, means, std):
    """(n,) mean and standard deviation of a pool."""
    shares = pool_weights(weights, std)
    mean = (shares * means).sum(axis=0)
    return mean, np.sqrt((shares * (std**2 + (means - mean) ** 2)).sum(axis=0))


def pool_both(weights, means, std, model_means, covariances):
    return (*pool(weights, means, std), *pool_together(weights, model_means, covariances))


def correlated(left, right, a):
    """(2,) sums over all pairs of rows of x_i y_j a^k and of x_i y_j k a^k with k = |i - j|, whose weights, from k = 1
    on, have the generating functions a z / (1 - a z) and a z / (1 - a z)^2."""
    sums = []
    for denominator in ([1.0, -a], [1.0, -2.0 * a, a * a]):
        before = [lfilter([0.0, a], denominator, columns, axis=0) for columns in (left, right)]
        sums.append(np.sum(left * before[1] + right * before[0]))
    return sums[0] + np.sum(left * right), sums[1]


def solved(diagonals, right):
    factor = cholesky_banded(diagonals.T, lower=True)
    return factor.T, cho_solve_banded((factor, True), right)


def jumps(states, transition, precision):
    jump = states[1:] - np.einsum('tij,tj->ti', transition, states[:-1])
    return np.sum(jump * np.einsum('tij,tj->ti', precision, jump))


def beyond(known, x, n_joints):
    if not np.isfinite(x).all():
        return np.nan
    if not len(known):
        return 0.0
    outside = np.maximum(known[0] - x, x - known[1])
    ranges = (known[1] - known[0]).reshape(-1, n_joints)
    ranges = np.maximum(ranges, LEAST_SHARE * ranges.max(axis=1, keepdims=True)).ravel()
    return float((outside / np.maximum(ranges, LEAST_RANGE)).max(initial=0.0))


def towards(aims, keep, state):
    """States (M, k), each of which keeps a share (M,) of its difference to an aim (M, k)."""
    states = []
    for aim, kept in zip(aims, keep, strict=True):
        state = aim + (state - aim) * kept
        states.append(state)
    return np.array(states)


def play(steps, place):
    places = []
    for step in steps:
        place = min(max(place + step, -1.0), 1.0)
        places.append(place)
    return np.array(places)


def followed(way):
    """Signed travel and velocity (N PARTS,) in each part of the steps of a way, from its first sample on."""
    step = np.diff(way.stamps, prepend=way.stamps[0]) * 1e-9
    net, after = np.diff(way.position, prepend=way.position[0]), way.velocity * step
    before = np.append(way.velocity[0], way.velocity[:-1]) * step
    apart = ~(np.abs(net - 0.5 * (before + after)) < MOST_APART * (np.abs(before) + np.abs(after)))
    before, after = np.where(apart, net, before), np.where(apart, net, after)
    time, place = parts_of_steps(before, 6.0 * net - 4.0 * before - 2.0 * after, 3.0 * (before + after) - 6.0 * net)
    travel, lengths = np.diff(place, axis=1), np.diff(time, axis=1) * step[:, None]
    speeds = np.divide(travel, lengths, out=np.zeros_like(travel), where=lengths > 0.0)
    return travel.ravel(), speeds.ravel()


def parts_of_steps(start, rise, bend):
    """Ends (N, PARTS + 1) of the parts of steps in which the velocity is start + rise u + bend u^2 (N,), the middle one
    at its zero, and the travel until then."""
    half = np.linspace(0.0, 1.0, PARTS // 2 + 1)
    root = -0.5 * (rise + np.copysign(np.sqrt(np.maximum(rise**2 - 4.0 * bend * start, 0.0)), rise))
    turns = start * (start + rise + bend) < 0.0
    middle = np.divide(start, root, out=np.full_like(start, 0.5), where=turns & (root != 0.0))
    outside = (middle < 0.0) | (middle > 1.0)  # the other zero
    middle = np.where(outside, np.divide(root, bend, out=np.full_like(start, 0.5), where=outside), middle)[:, None]
    time = np.hstack([middle * half, middle + (1.0 - middle) * half[1:]])
    return time, time * (start[:, None] + time * (rise[:, None] / 2.0 + time * bend[:, None] / 3.0))
