"""Scenarios that cannot be simulated are refused, each with its sentence."""

from __future__ import annotations

import numpy as np

from semiparam_ros.errors import SemiparamError
from semiparam_ros.simulation.baseline import check_baseline
from semiparam_ros.simulation.causes import cause_of
from semiparam_ros.simulation.scenario import EffectRequest, Scenario

MIN_SAMPLES = 10


def check(scenario: Scenario) -> None:
    """Refuse what cannot be simulated, each with its sentence."""
    if scenario.samples < MIN_SAMPLES:
        raise SemiparamError(f'{scenario.samples} samples are too few; expected at least {MIN_SAMPLES}.')
    if not (np.isfinite(scenario.rate_hz) and 0 < scenario.rate_hz <= 1000):
        raise SemiparamError(f'rate {scenario.rate_hz} Hz is out of range; expected more than 0 and at most 1000.')
    if scenario.seed < 0 or (scenario.robot_seed or 0) < 0:
        raise SemiparamError('a seed is negative; expected a whole number from 0 on.')
    for name in ('noise', 'encoder_noise'):
        if not (np.isfinite(getattr(scenario, name)) and getattr(scenario, name) >= 0):
            raise SemiparamError(f'{name} {getattr(scenario, name)} is out of range; expected 0 or more.')
    check_baseline(scenario.baseline)
    for effect in scenario.effects:
        check_effect(effect, scenario)


def check_effect(effect: EffectRequest, scenario: Scenario) -> None:
    """Size and start of one requested effect."""
    cause = cause_of(effect.kind, scenario.outputs)
    if not (np.isfinite(effect.size) and effect.size > 0):
        raise SemiparamError(f"size {effect.size} of effect '{effect.kind}' is out of range; expected more than 0.")
    if effect.where is not None and not cause.takes_place:
        raise SemiparamError(f"effect '{effect.kind}' has no place; leave out '@{effect.where}'.")
    if effect.start_s is not None and not cause.can_start:
        raise SemiparamError(f"effect '{effect.kind}' is there all the time; it cannot have a start.")
    if effect.start_s is not None and not 0 <= effect.start_s < scenario.samples / scenario.rate_hz:
        raise SemiparamError(f"start {effect.start_s} s of effect '{effect.kind}' lies outside the recording of "
                             f'{scenario.samples / scenario.rate_hz:g} s.')
