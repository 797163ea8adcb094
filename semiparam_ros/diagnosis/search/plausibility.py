"""Whether a model holds values that its effects can have: positive masses, forces that this robot could bear."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from semiparam_ros.core.robot.consistency import pseudo_inertia
from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.regression import Fit, with_effects
from semiparam_ros.diagnosis.search.candidates import Place, identity
from semiparam_ros.diagnosis.search.refit import declare


def all_plausible(before: Fit, after: Fit) -> bool:
    """Whether no effect has impossible values in the second model that had none in the first."""
    wrong = {identity(effect) for index, effect in enumerate(before.effects)
             if not plausible(before, index)}
    return all(plausible(after, index) or identity(effect) in wrong
               for index, effect in enumerate(after.effects))


def without_impossible(fit: Fit, declared: Collection[Place]) -> Fit:
    """The model without effects whose coefficients their causes cannot have.

    :param declared: kinds and places that stay all the same.
    """
    while True:
        blocks = fit.assembly.blocks
        kept = [effect for index, effect in enumerate(fit.effects) if identity(effect) in declared
                or effect.is_calibration or effect.physical(fit.theta[blocks[str(index)]])]
        if len(kept) == len(fit.effects):
            return fit
        fit = declare(with_effects(fit, kept), [])


def plausible(fit: Fit, index: int) -> bool:
    """Whether the effect with this number has values that its cause can have on this robot."""
    effect = fit.effects[index]
    block = fit.assembly.blocks[str(index)]
    theta = fit.theta[block]
    if not effect.conceivable(fit.body, theta):
        return False
    if effect.is_body and not _is_a_body(fit, theta, block):
        return False
    return not effect.is_load or _weighs(fit, theta, block)


def _weighs(fit: Fit, theta: Array, block: slice) -> bool:
    """Whether the mass and the first moments of a load are more than chance: what has none is no load, however much
    inertia it seems to have."""
    part = slice(block.start, block.start + 4)
    covariance = fit.theta_covariance()[part, part] * float(fit.correlation.mean())
    return float(theta[:4] @ np.linalg.lstsq(covariance, theta[:4], rcond=1e-12)[0]) > fit.config.weight_shows


def _is_a_body(fit: Fit, theta: Array, block: slice) -> bool:
    """Whether ten inertial parameters are, within their uncertainty, those of a body: its pseudo-inertia has no
    negative eigenvalue (Wensing, Kim and Slotine 2018)."""
    values, vectors = np.linalg.eigh(pseudo_inertia(theta))
    slopes = np.einsum('ik,pij,jk->kp', vectors, OF_PSEUDO_INERTIA, vectors)  # of each eigenvalue
    covariance = fit.theta_covariance()[block, block] * float(fit.correlation.mean())
    deviations = np.sqrt(np.einsum('kp,pq,kq->k', slopes, covariance, slopes))
    return bool(np.all(values > -fit.config.unlike_a_body * deviations))


OF_PSEUDO_INERTIA = pseudo_inertia(np.eye(10))
"""(10, 4, 4): the pseudo-inertia is linear in the inertial parameters."""
