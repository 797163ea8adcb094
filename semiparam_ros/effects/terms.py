"""Terms of a formula as an effect: what a diagnosis found where no physical kind fits.

A term is a product of factors in a closed grammar, looked up and never evaluated as code::

    term     = factor { "*" factor }                        at most four factors
    factor   = variable | variable "^" digit | function "(" variable ")" | "bump(" variable "," centre "," width ")"
    variable = "time" | "q_" joint | "dq_" joint | "ddq_" joint
    function = sin | cos | abs | sign

``bump`` is exp(-((v - centre) / width)^2 / 2). An effect ``terms@fx{"sin(q_elbow)": 1.2, "time*dq_elbow": 0.1}`` adds
one column for each term to the channel fx; the numbers are the coefficients that were found, and set how far the
learnt ones may stray.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, NamedTuple

import numpy as np

from semiparam_ros.core.columns import Memory
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.effects.base import TIMES, Coefficient, Effect
from semiparam_ros.errors import SemiparamError

FUNCTIONS: dict[str, Callable[[Array], Array]] = {'sin': np.sin, 'cos': np.cos, 'abs': np.abs, 'sign': np.sign}
PURE = ('sin', 'cos', 'sign', 'bump')
MOST_FACTORS, HIGHEST_POWER = 4, 5
ROLES = {'q': ('position', ''), 'dq': ('velocity', '/s'), 'ddq': ('acceleration', '/s^2')}
FREEDOM = 10.0

_VARIABLE = r'(?P<variable>time|(?:q|dq|ddq)_[A-Za-z0-9_.:/-]+)'
_NUMBER = r'[+-]?\d{1,9}(?:\.\d{0,12})?(?:e[+-]?\d{1,2})?'
_FACTORS = tuple(re.compile(pattern) for pattern in (
    _VARIABLE, rf'{_VARIABLE}\^(?P<power>[2-{HIGHEST_POWER}])', rf'(?P<function>{"|".join(FUNCTIONS)})\({_VARIABLE}\)',
    rf'(?P<function>bump)\({_VARIABLE},(?P<centre>{_NUMBER}),(?P<width>{_NUMBER})\)'))


class Factor(NamedTuple):
    """A function of one variable."""

    variable: str
    function: str = ''
    power: int = 1
    centre: float = 0.0
    width: float = 1.0

    def of(self, values: Array) -> Array:
        """Factor (N,) of the variable's values (N,)."""
        if self.function == 'bump':
            return np.asarray(np.exp(-0.5 * ((values - self.centre) / self.width) ** 2))
        return FUNCTIONS[self.function](values) if self.function else np.asarray(values**self.power)


@cache
def parse_term(text: str) -> tuple[Factor, ...]:
    """The factors of a term; anything outside the grammar raises SemiparamError."""
    parts = text.replace(' ', '').split('*')
    if len(parts) > MOST_FACTORS:
        raise SemiparamError(f"term '{text}' has {len(parts)} factors; expected at most {MOST_FACTORS}.")
    return tuple(_factor(part, text) for part in parts)


def _factor(part: str, text: str) -> Factor:
    match = next((match for pattern in _FACTORS if (match := pattern.fullmatch(part))), None)
    if match is None:
        raise SemiparamError(
            f"term '{text}' holds '{part}', which is no factor; expected time, q_JOINT, dq_JOINT or ddq_JOINT, a power "
            f'of one of them (^2 to ^{HIGHEST_POWER}), {", ".join(FUNCTIONS)} of one, or bump(VARIABLE,CENTRE,WIDTH).')
    found = match.groupdict()
    factor = Factor(found['variable'], found.get('function') or '', int(found.get('power') or 1),
                    float(found.get('centre') or 0.0), float(found.get('width') or 1.0))
    if factor.width <= 0.0:
        raise SemiparamError(f"term '{text}' has a bump of width {factor.width}; expected more than 0.")
    return factor


def term_values(text: str, body: RigidBody, samples: Samples) -> Array:
    """Values (N,) of a term along the samples. An unknown joint raises SemiparamError."""
    values = np.ones(len(samples))
    for factor in parse_term(text):
        values = values * factor.of(variable_values(factor.variable, body, samples))
    return values


def nameable(variable: str) -> bool:
    """Tell whether the grammar has a name for a variable: a joint may be called by letters that stand in no term."""
    return re.fullmatch(_VARIABLE, variable) is not None


def variable_values(name: str, body: RigidBody, samples: Samples) -> Array:
    """Values (N,) of a variable along the samples."""
    if name == 'time':
        return samples.time
    role, joint = name.split('_', 1)
    return np.asarray(getattr(samples, ROLES[role][0])[:, _joint(joint, body)])


def term_unit(text: str, body: RigidBody, channel: int) -> str:
    """Unit of the term's coefficient in an output channel."""
    powers: dict[str, int] = {}
    for factor in parse_term(text):
        for unit, power in _units(factor, body):
            powers[unit] = powers.get(unit, 0) + power * factor.power
    above = ' '.join(_power(unit, -power) for unit, power in powers.items() if power < 0)
    below = ' '.join(_power(unit, power) for unit, power in powers.items() if power > 0)
    numerator = f'{body.output_units[channel]} {above}'.strip()
    if not below:
        return numerator
    return f'{numerator}/({below})' if ' ' in below else f'{numerator}/{below}'


def _units(factor: Factor, body: RigidBody) -> list[tuple[str, int]]:
    """Base units of a factor with their powers."""
    if factor.function in PURE:
        return []
    if factor.variable == 'time':
        return [('s', 1)]
    role, joint = factor.variable.split('_', 1)
    return [(body.joint_unit(body.joints[_joint(joint, body)], 'rad'), 1), ('s', -('q', 'dq', 'ddq').index(role))]


def _power(unit: str, power: int) -> str:
    return unit if power == 1 else f'{unit}^{power}'


def _joint(name: str, body: RigidBody) -> int:
    if name not in body.joints:
        raise SemiparamError(f"a term names the joint '{name}'; expected one of {', '.join(body.joints)}.")
    return body.joints.index(name)


class _EveryTerm(tuple[str, ...]):
    """Names that cannot be listed: whether one is a term is for the grammar to say, with a sentence of its own."""

    __slots__ = ()

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str)


@dataclass(frozen=True)  # for the check after __init__
class Terms(Effect):
    """Terms of a formula, with one coefficient each, on one output channel."""

    kind: ClassVar[str] = 'terms'
    sentence: ClassVar[str] = 'a formula without a physical name describes what is left'
    separated_by: ClassVar[str] = 'a look at the robot: the formula says where to look'

    def __post_init__(self) -> None:
        for term in self.parameters:
            parse_term(term)

    @classmethod
    def places(cls, body: RigidBody) -> Sequence[str | None]:
        """Return no place: a search does not try it, a diagnosis writes it down at its end."""
        return ()

    @classmethod
    def value_names(cls) -> tuple[str, ...]:
        return _EveryTerm((*TIMES, 'TERM'))

    @property
    def searched(self) -> tuple[str, ...]:
        """Return no name: the numbers of terms are coefficients."""
        return ()

    @classmethod
    def permitted(cls, body: RigidBody) -> Sequence[str | None]:
        return body.output_names

    def check(self, body: RigidBody) -> None:
        super().check(body)
        for factor in (factor for name in self.parameters for factor in parse_term(name)):
            if factor.variable != 'time':
                _joint(factor.variable.split('_', 1)[1], body)

    def prior_scale(self, body: RigidBody) -> Array:
        found = np.array([abs(value) for value in self.parameters.values()])
        return np.asarray(np.where(found > 0.0, FREEDOM * found, super().prior_scale(body)))

    def coefficients(self, body: RigidBody) -> tuple[Coefficient, ...]:
        channel = self._channel(body)
        return tuple(Coefficient(name, term_unit(name, body, channel)) for name in self.parameters)

    def basis(self, body: RigidBody, samples: Samples, memory: Memory) -> tuple[Array, Memory]:
        columns = np.zeros((len(samples), body.n_outputs, len(self.parameters)))
        channel = self._channel(body)
        for column, name in enumerate(self.parameters):
            columns[:, channel, column] = term_values(name, body, samples)
        return columns, None

    def _channel(self, body: RigidBody) -> int:
        if self.where not in body.output_names:
            raise SemiparamError(f"effect 'terms' acts on the output '{self.where}'; expected terms@CHANNEL with one "
                                 f'of {", ".join(body.output_names)}.')
        return body.output_names.index(self.where)
