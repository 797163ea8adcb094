"""What the columns of a text table mean."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from semiparam_ros.errors import SemiparamError

TIME_UNITS = {'s': 10**9, 'ms': 10**6, 'us': 10**3, 'ns': 1}
PER_JOINT = ('position', 'velocity', 'acceleration', 'effort')
WIDTHS = {'time': 1, 'force': 3, 'torque': 3}


@dataclass(frozen=True)
class TableLayout:
    """``columns``: role -> columns, each a number from 1 or a name of the header line.

    Roles: 'time', 'position', 'velocity', 'acceleration', 'effort' (one column for each joint), 'force', 'torque'
    (three each). Without 'time', rows are ``period`` [s] apart and the first has the stamp ``start`` [s]. Signs
    multiply what the file holds.
    """

    joints: tuple[str, ...] = ()
    columns: Mapping[str, tuple[int | str, ...]] = field(default_factory=dict)
    degrees: bool = False
    period: float | None = None
    start: float = 1.0
    time_unit: str = 's'
    wrench_frame: str = ''
    wrench_sign: float = 1.0
    effort_sign: float = 1.0

    def checked(self) -> TableLayout:
        """Itself, or SemiparamError for the first thing that is missing or contradicts."""
        sentence = next(_complaints(self), None)
        if sentence:
            raise SemiparamError(sentence)
        return self

    def merged(self, values: Mapping[str, Any], where: str) -> TableLayout:
        """This layout with ``values`` (names as in a YAML file) in place of its own.

        :param where: names the origin of the values in errors. 'rate' [Hz] may stand for 'period'.
        """
        known = {each.name for each in fields(self)} | {'rate'}
        for name in values.keys() - known:
            guess = difflib.get_close_matches(name, known, 1)
            hint = f'; did you mean {guess[0]!r}?' if guess else f': expected one of {", ".join(sorted(known))}.'
            raise SemiparamError(f'{where}: {name!r} is unknown{hint}')
        converted = {name: _converted(name, value, where) for name, value in values.items()}
        if 'rate' in converted:
            converted['period'] = 1.0 / _positive('rate', converted.pop('rate'), where)
        if 'columns' in converted:
            converted['columns'] = {**self.columns, **converted['columns']}
        return replace(self, **converted)


def load_layout(path: str | os.PathLike[str]) -> TableLayout:
    """A layout from a YAML file; a file that cannot be read or holds anything else raises SemiparamError."""
    try:
        values = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise SemiparamError(f'{str(path)!r} cannot be read: {error.strerror}.') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise SemiparamError(f'{str(path)!r} is not valid YAML: {" ".join(str(error).split())}.') from error
    if not isinstance(values, Mapping):
        raise SemiparamError(f'{str(path)!r} holds no columns: expected a mapping such as "joints: [...]".')
    return TableLayout().merged(values, repr(str(path)))


def parse_columns(text: object) -> tuple[int | str, ...]:
    """Columns from '1-4', '1,2,5-7', 'q1,q2', 3, or a list of such."""
    if isinstance(text, list | tuple):
        return tuple(column for part in text for column in parse_columns(part))
    found: list[int | str] = []
    for part in filter(None, (part.strip() for part in str(text).split(','))):
        first, dash, last = part.partition('-')
        if dash and first.strip().isdigit() and last.strip().isdigit():
            found += range(int(first), int(last) + 1)
        else:
            found.append(int(part) if part.isdigit() else part)
    return tuple(found)


def _converted(name: str, value: Any, where: str) -> Any:
    """``value`` as the field of this name wants it."""
    if name == 'joints':
        return tuple(value.split(',') if isinstance(value, str) else map(str, value or ()))
    if name == 'columns':
        if not isinstance(value, Mapping):
            raise SemiparamError(f'{where}: columns is {value!r}; expected a mapping such as "position: 1-4".')
        return {str(role): parse_columns(columns) for role, columns in value.items()}
    if name == 'degrees':
        if not isinstance(value, bool):
            raise SemiparamError(f'{where}: degrees is {value!r}; expected true or false.')
        return value
    if name in ('time_unit', 'wrench_frame'):
        return str(value)
    if name == 'period' and value is not None:
        return _positive(name, value, where)
    return _number(name, value, where)


def _number(name: str, value: Any, where: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise SemiparamError(f'{where}: {name} is {value!r}; expected a number.') from error


def _positive(name: str, value: Any, where: str) -> float:
    number = _number(name, value, where)
    if not 0.0 < number < float('inf'):
        raise SemiparamError(f'{where}: {name} is {value!r}; expected a positive number.')
    return number


def _complaints(layout: TableLayout) -> Any:
    """Sentences about what is wrong, the most basic first."""
    roles = layout.columns
    widths = {**WIDTHS, **dict.fromkeys(PER_JOINT, len(layout.joints))}
    if not layout.joints:
        yield 'the table needs the names of its joints: expected --joints NAME,NAME,... or "joints:" in the file.'
    for role in roles:
        if role not in widths:
            yield f'column role {role!r} is unknown: expected one of {", ".join(widths)}.'
        elif len(roles[role]) != widths[role]:
            yield f'{role} has {len(roles[role])} columns; expected {widths[role]}.'
        elif 0 in roles[role]:
            yield f'{role} names column 0; columns count from 1.'
    if 'position' not in roles:
        yield 'the table has no position columns: expected --position COLUMNS or "position:" under "columns:".'
    if ('force' in roles) is not ('torque' in roles):
        yield 'a wrench needs both force and torque columns; only one of them is named.'
    if 'time' not in roles and layout.period is None:
        yield 'rows have no time: expected --time COLUMN, --rate HZ or --period SECONDS.'
    if layout.time_unit not in TIME_UNITS:
        yield f'time_unit is {layout.time_unit!r}; expected one of {", ".join(TIME_UNITS)}.'


def column_indices(layout: TableLayout, header: Sequence[str], where: str) -> dict[str, list[int]]:
    """Role -> indices from 0 into a row, names looked up in the header line."""
    return {role: [_index(column, header, where) for column in columns] for role, columns in layout.columns.items()}


def _index(column: int | str, header: Sequence[str], where: str) -> int:
    if isinstance(column, int):
        return column - 1
    if column not in header:
        raise SemiparamError(f'{where} has no column {column!r}; its header has {", ".join(header) or "no names"}.')
    return list(header).index(column)
