"""What one parameter is: its name, type, default, permitted values, unit and description."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import Field, dataclass, field
from typing import Any, TypeAlias

Value: TypeAlias = bool | int | float | str | tuple[str, ...] | tuple[float, ...]

KINDS = {'bool': 'bool', 'int': 'integer', 'float': 'double', 'str': 'string', 'tuple[str, ...]': 'string_array',
         'tuple[float, ...]': 'double_array'}
"""ROS parameter type of each annotation in the table."""

EXPECTED = {'bool': 'true or false', 'integer': 'an integer', 'double': 'a number', 'string': 'a text',
            'string_array': 'a list of texts', 'double_array': 'a list of numbers'}


@dataclass(frozen=True)
class Parameter:
    """One row of the table; ``minimum`` and ``maximum`` are inclusive and bind every item of an array."""

    name: str
    default: Value
    kind: str
    description: str
    unit: str = ''
    choices: tuple[str, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    live: bool = False

    @property
    def field(self) -> str:
        """Attribute of the snapshot: the name with dots as underscores."""
        return self.name.replace('.', '_')

    @property
    def permitted(self) -> str:
        """The permitted values in words, empty when any value of the type will do."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.minimum is not None and self.maximum is not None:
            return f'{_number(self.minimum)} to {_number(self.maximum)}'
        if self.minimum is not None:
            return f'at least {_number(self.minimum)}'
        return '' if self.maximum is None else f'at most {_number(self.maximum)}'

    def convert(self, value: Any) -> Any:
        """Meet the spellings of YAML and of ROS: 1 for 1.0, and empty or unset lists; anything else unchanged."""
        if self.kind == 'double' and _is_integer(value):
            return float(value)
        if self.kind.endswith('_array'):
            return _convert_items(value, self.kind)
        return value

    def refusal(self, value: Any) -> str | None:
        """A sentence saying why a (converted) value is refused, or None."""
        if not _has_kind(value, self.kind):
            return f'{self.name} is {shown(value)}; expected {EXPECTED[self.kind]}{self._hint()}.'
        for item in value if isinstance(value, tuple) else (value,):
            if not self._permits(item):
                return f'{self.name} is {shown(value)}; expected {self._wanted()}.'
        return None

    def _permits(self, item: Any) -> bool:
        if self.choices:
            return item in self.choices
        if isinstance(item, float) and not math.isfinite(item):
            return False
        above = self.minimum is None or item >= self.minimum
        return above and (self.maximum is None or item <= self.maximum)

    def _wanted(self) -> str:
        text = self.permitted or 'finite numbers'
        return f'{text} [{self.unit}]' if self.unit else text

    def _hint(self) -> str:
        return f', {self.permitted}' if self.permitted else ''


def declare(name: str, default: Value, description: str, **details: Any) -> Any:
    """A row of the table, written as a field of the snapshot."""
    return field(default=default, metadata={'name': name, 'description': description, **details})


def from_field(row: Field[Any]) -> Parameter:
    """Read a row back."""
    default: Any = row.default
    return Parameter(default=default, kind=KINDS[str(row.type)], **row.metadata)


def shown(value: Any) -> str:
    """A value as it would stand in a parameter file, shortened."""
    text = f"'{value}'" if isinstance(value, str) else str(list(value) if isinstance(value, Sequence) else value)
    text = {'True': 'true', 'False': 'false', 'None': 'empty'}.get(text, text)
    return text if len(text) <= 80 else f'{text[:77]}...'


def _number(bound: float) -> str:
    return str(int(bound)) if bound == int(bound) else f'{bound:g}'


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _convert_items(value: Any, kind: str) -> Any:
    if value is None:
        return ()  # ROS reads an empty list in a file as an unset value
    if isinstance(value, str) or not hasattr(value, '__iter__'):
        return value
    items = tuple(value)
    if kind == 'string_array':
        return () if items == ('',) else items
    return tuple(float(item) if _is_integer(item) else item for item in items)


def _has_kind(value: Any, kind: str) -> bool:
    if kind.endswith('_array'):
        item = str if kind == 'string_array' else float
        return isinstance(value, tuple) and all(isinstance(entry, item) for entry in value)
    if kind == 'integer':
        return _is_integer(value)
    return isinstance(value, {'bool': bool, 'double': float, 'string': str}[kind])
