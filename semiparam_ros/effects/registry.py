"""Registry of effects by kind, those of other packages among them, and their text form.

A package adds a kind with an entry point in the group ``semiparam_ros.effects`` that names a
subclass of Effect. Text is never evaluated: an effect is written ``kind``, ``kind@where``, or
either with a JSON object of numbers.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from semiparam_ros.core import json_text
from semiparam_ros.effects import cables, drive, friction, geometry, loads, periodic, sensor, temperature, terms
from semiparam_ros.effects.base import Effect, spelling
from semiparam_ros.errors import SemiparamError

GROUP = 'semiparam_ros.effects'
LARGEST = 4e9
"""Largest value: seconds up to it, stamps among them, can be counted in ns in 64 bits, and no
column overflows."""
SUPERSEDED = ('at_link', 'directions')
"""Values that older files hold and that follow from the place."""
BUILT_IN: tuple[type[Effect], ...] = (
    loads.Payload, loads.ToolExchange, sensor.SensorOffset, sensor.SensorDrift, sensor.ThermalDrift,
    temperature.TemperatureDrift, sensor.SensorGain, sensor.SensorCrosstalk,
    sensor.SensorMisalignment, geometry.TimeDelay, geometry.JointOffset, geometry.GravityTilt,
    geometry.BaseShift, geometry.ZeroSlip,
    loads.ExternalForce, loads.ViscousDrag, loads.QuadraticDrag, cables.CableSpring,
    cables.CableHysteresis, periodic.PeriodicDisturbance, friction.ViscousFriction,
    friction.CoulombFriction, friction.StribeckFriction, friction.AsymmetricFriction,
    friction.LoadFriction, temperature.TemperatureFriction, drive.RotorInertia, drive.JointSpring,
    drive.EffortOffset, drive.EffortGain, drive.TransmissionRipple, drive.Backlash,
    drive.GearCoupling, sensor.SensorNonlinearity, drive.CommonGain, geometry.VelocityFilter,
    terms.Terms)


@cache
def _all_kinds() -> dict[str, type[Effect]]:
    known = {kind.kind: kind for kind in BUILT_IN}
    for point in entry_points(group=GROUP):
        kind = _loaded(point)
        if not (isinstance(kind, type) and issubclass(kind, Effect) and kind.kind):
            raise SemiparamError(f"entry point '{point.name}' of group {GROUP} is {kind!r}; expected a subclass of "
                                 'semiparam_ros.effects.Effect with a kind.')
        if kind.kind in known:
            raise SemiparamError(f"entry point '{point.name}' of group {GROUP} defines the kind '{kind.kind}', "
                                 'which exists already; expected a new name.')
        known[kind.kind] = kind
    return known


def _loaded(point: EntryPoint) -> object:
    try:
        return point.load()
    except Exception as error:  # another package's code may fail in any way
        raise SemiparamError(f"entry point '{point.name}' of group {GROUP} cannot be loaded: {error}.") from error


def kinds(outputs: str | None = None) -> dict[str, type[Effect]]:
    """Kinds by name, all or only those that act on ``outputs`` (wrench or effort)."""
    return {name: kind for name, kind in _all_kinds().items() if outputs is None or outputs in kind.outputs}


def effect_to_text(effect: Effect, shared: tuple[float, ...] = ()) -> str:
    """The effect as the parameter ``effects`` holds it; :func:`effect_from_text` reads it back exactly.

    :param shared: (p,) reference model that stands beside the text, which leaves it out.
    """
    values: dict[str, object] = dict(effect.values)
    if effect.needs_reference and effect.reference != shared:
        values['reference'] = list(effect.reference)
    return spelling(effect.kind, effect.where) + (json.dumps(values) if values else '')


def effects_to_parameters(effects: Sequence[Effect]) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """The parameters ``effects`` and ``effects_reference``: texts, and the reference (p,) that most have."""
    counts = Counter(effect.reference for effect in effects if effect.reference)
    shared = counts.most_common(1)[0][0] if counts else ()
    return tuple(effect_to_text(effect, shared) for effect in effects), shared


def effect_from_text(text: str, shared: tuple[float, ...] = ()) -> Effect:
    """Read ``kind[@where][{"name": number, ...}]``. Anything else raises SemiparamError.

    :param shared: (p,) reference model of kinds that need one, where the text holds none.
    """
    head, brace, tail = text.strip().partition('{')
    name, _, where = head.strip().partition('@')
    if name not in _all_kinds():
        raise SemiparamError(f"effect '{text}' names no known kind; expected one of {', '.join(_all_kinds())}.")
    values = _values(text, brace + tail) if brace else {}
    reference = values.pop('reference', list(shared))
    if not isinstance(reference, list) or not all(map(_is_number, reference)):
        raise SemiparamError(f"effect '{text}' has a reference that is not a list of numbers.")
    wrong = [key for key, value in values.items() if not _is_number(value)]
    if wrong:
        raise SemiparamError(f"effect '{text}' has values that are not finite numbers: {', '.join(wrong)}.")
    for key, value in values.items():
        if not -LARGEST <= float(str(value)) <= LARGEST:
            raise SemiparamError(f"effect '{text}' has {key} {value}; expected at most {LARGEST:g}.")
    values = {key: value for key, value in values.items() if key not in SUPERSEDED}
    known = _all_kinds()[name].value_names()
    unknown = [key for key in values if key not in known]
    if unknown:
        raise SemiparamError(f"effect '{text}' has no value '{unknown[0]}'; expected some of {', '.join(known)}.")
    numbers = {key: float(str(value)) for key, value in values.items()}
    return _all_kinds()[name].from_values(where or None, numbers, tuple(float(value) for value in reference))


def _values(text: str, part: str) -> dict[str, object]:
    try:
        values = json_text.parse(part)
    except (ValueError, RecursionError) as error:
        raise SemiparamError(f"effect '{text:.80}' does not end in a JSON object of numbers ({error}).") from error
    return dict(values)


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return -sys.float_info.max <= value <= sys.float_info.max
