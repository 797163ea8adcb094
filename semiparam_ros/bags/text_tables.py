"""Text tables (white space, commas, semicolons or tabs between numbers), and arrays as tables, made into bags."""

from __future__ import annotations

import difflib
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from decimal import Decimal
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

from semiparam_ros.bags import sample_messages
from semiparam_ros.bags.array_files import array_lines, holds_arrays, raise_unmatched
from semiparam_ros.bags.conversion import write_description
from semiparam_ros.bags.text_lines import filled, number_in, text_lines
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.core.robot.urdf import joint_types, parse
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.errors import SemiparamError, listed
from semiparam_ros.settings.yaml_file import read_yaml

TIME_UNITS = {'s': NANOSECONDS, 'ms': 10**6, 'us': 10**3, 'ns': 1}
PER_JOINT = ('position', 'velocity', 'acceleration', 'effort')
OF_ANGLES = ('position', 'velocity', 'acceleration')
WIDTHS = {'time': 1, 'force': 3, 'torque': 3}
MOST_COLUMNS = 10_000

_LATEST_STAMP = 2**31 * NANOSECONDS  # a builtin_interfaces/Time has 31 bits of seconds


@dataclass(frozen=True)
class TableLayout:
    """Layout of a table; ``columns``: role -> columns, each a number from 1 or a name of the header
    line.

    Roles: 'time', 'position', 'velocity', 'acceleration', 'effort' (one column for each joint),
    'force', 'torque' (three each), 'temperature' [deg C] (one for each of ``temperatures``, which
    the messages have as frame_id; not a number where there is none). Without 'time', rows are
    ``period`` [s] apart and the first has the stamp ``start`` [s]. Signs multiply what the file
    holds, and ``effort_factors`` the efforts of single joints (N m for an ampere, or -1). Joints
    that are ``sliding`` have no angles, which ``degrees`` speaks of.
    """

    joints: tuple[str, ...] = ()
    columns: Mapping[str, tuple[int | str, ...]] = field(default_factory=dict)
    degrees: bool = False
    sliding: tuple[str, ...] = ()
    period: float | None = None
    start: float = 1.0
    time_unit: str = 's'
    wrench_frame: str = ''
    wrench_sign: float = 1.0
    effort_sign: float = 1.0
    effort_factors: Mapping[str, float] = field(default_factory=dict)
    temperatures: tuple[str, ...] = ()

    def checked(self) -> TableLayout:
        """Return the layout; SemiparamError says the first thing that is missing or contradicts."""
        sentence = next(_complaints(self), None)
        if sentence:
            raise SemiparamError(sentence)
        return self

    def merged(self, values: Mapping[str, object], where: str) -> TableLayout:
        """Return the layout with ``values`` (names as in a YAML file) in place of its own.

        :param where: names the origin of the values in errors. 'rate' [Hz] may stand for 'period'.
        """
        known = {each.name for each in fields(self)} | {'rate'}
        for name in map(str, values.keys() - known):
            guess = difflib.get_close_matches(name, known, 1)
            hint = f'; did you mean {guess[0]!r}?' if guess else f': expected one of {", ".join(sorted(known))}.'
            raise SemiparamError(f'{where}: {name!r} is unknown{hint}')
        converted = {name: _converted(name, value, where) for name, value in values.items()}
        if {'rate', 'period'} <= converted.keys():
            raise SemiparamError(f'{where}: both rate and period are given; expected one of them.')
        if 'rate' in converted:
            rate = _positive('rate', converted.pop('rate'), where)
            converted['period'] = _positive('the period of this rate', 1.0 / rate, where)
        if 'columns' in converted:
            converted['columns'] = {**self.columns, **converted['columns']}
        return replace(self, **converted)

    def spread(self, header: Sequence[str]) -> TableLayout:
        """The layout with NAME:1, NAME:2 and so on in place of the NAME of an array of several columns."""
        columns = {role: tuple(part for column in named for part in _parts(column, header))
                   for role, named in self.columns.items()}
        return replace(self, columns=columns)


def load_layout(path: str | os.PathLike[str]) -> TableLayout:
    """A layout from a YAML file; a file that cannot be read or holds anything else raises SemiparamError."""
    values = read_yaml(Path(path), 'the columns')
    if not isinstance(values, Mapping):
        raise SemiparamError(f'{str(path)!r} holds no columns: expected a mapping such as "joints: [...]".')
    layout = TableLayout().merged(values, repr(str(path)))
    if layout.period is not None and 'time' in layout.columns:
        raise SemiparamError(f'{str(path)!r} gives a column of the time, and a rate or period; expected one of them.')
    return layout


def parse_columns(text: object) -> tuple[int | str, ...]:
    """Columns from '1-4', '1,2,5-7', 'q1,q2', 'q:1-6' (those of an array), 3, or a list of such."""
    if isinstance(text, list | tuple):
        return tuple(column for part in text for column in parse_columns(part))
    found: list[int | str] = []
    for part in filter(None, (part.strip() for part in str(text).split(','))):
        array, colon, numbers = part.rpartition(':')
        first, dash, last = numbers.partition('-')
        if dash and first.strip().isdecimal() and last.strip().isdecimal():
            begin, count = _whole(first), _whole(last) + 1 - _whole(first)
            if not 0 < count <= MOST_COLUMNS:
                raise SemiparamError(f'{part!r} names {max(count, 0)} columns; expected 1 to {MOST_COLUMNS}.')
            span = range(begin, begin + count)
            found += [f'{array}:{number}' for number in span] if colon else span
        else:
            found.append(_whole(part) if part.isdecimal() else part)
    return tuple(found)


def _whole(digits: str) -> int:
    try:
        return int(digits)
    except ValueError as error:  # thousands of digits
        raise SemiparamError(f'{digits} is no column; expected a number from 1.') from error


def _converted(name: str, value: Any, where: str) -> Any:
    """Convert ``value`` to what the field of this name holds."""
    if name in ('joints', 'temperatures', 'sliding'):
        return _names(name, value, where)
    if name == 'columns':
        if not isinstance(value, Mapping):
            raise SemiparamError(f'{where}: columns is {value!r}; expected a mapping such as "position: 1-4".')
        return {str(role): parse_columns(columns) for role, columns in value.items()}
    if name == 'effort_factors':
        return effort_factors(value, where)
    if name == 'degrees':
        if not isinstance(value, bool):
            raise SemiparamError(f'{where}: degrees is {value!r}; expected true or false.')
        return value
    if name in ('time_unit', 'wrench_frame'):
        if not isinstance(value, str):
            raise SemiparamError(f'{where}: {name} is {value!r}; expected a text.')
        return value
    if name == 'period' and value is not None:
        return _positive(name, value, where)
    number = _number(name, value, where)
    if name in ('wrench_sign', 'effort_sign') and abs(number) != 1.0:
        raise SemiparamError(f'{where}: {name} is {value!r}; expected 1 or -1.')
    return number


def _names(what: str, value: object, where: str) -> tuple[str, ...]:
    """Distinct names from a list, or from 'NAME,NAME' with or without blanks; anything else raises SemiparamError."""
    parts = value.split(',') if isinstance(value, str) else [] if value is None else value
    texts = parts if isinstance(parts, list | tuple) else ('',)
    names = tuple(str(part).strip() if isinstance(part, str | int) and not isinstance(part, bool) else ''
                  for part in texts)
    if '' in names or len(set(names)) < len(names):
        raise SemiparamError(f'{where}: {what} is {value!r}; expected distinct names such as shoulder,elbow.')
    return names


def effort_factors(value: object, where: str) -> dict[str, float]:
    """Factors by joint from a mapping, or from 'NAME=FACTOR,...'; anything else raises SemiparamError."""
    pairs: list[tuple[object, ...]]
    if isinstance(value, Mapping):
        pairs = list(value.items())
    else:
        pairs = [tuple(part.rsplit('=', 1)) for part in str(value).split(',')]
    if not all(len(pair) == 2 for pair in pairs):
        raise SemiparamError(f'{where}: effort_factors is {value!r}; expected NAME=FACTOR,... such as '
                             'shoulder=11.4,elbow=-9.8.')
    names = [str(name).strip() for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise SemiparamError(f'{where}: effort_factors names {name!r} twice; expected one factor for each.')
    factors = {name: _number(f'the effort factor of {name}', factor, where)
               for name, (_, factor) in zip(names, pairs, strict=True)}
    for name, factor in factors.items():
        if not factor:
            raise SemiparamError(f'{where}: the effort factor of {name} is 0, which leaves nothing of it.')
    return factors


def _number(name: str, value: Any, where: str) -> float:
    try:
        number = float(value if not isinstance(value, bool) else '')
    except (TypeError, ValueError, OverflowError) as error:
        raise SemiparamError(f'{where}: {name} is {value!r}; expected a number.') from error
    if not math.isfinite(number):
        raise SemiparamError(f'{where}: {name} is {value!r}; expected a finite number.')
    return number


def _positive(name: str, value: object, where: str) -> float:
    number = _number(name, value, where)
    if not 0.0 < number < float('inf'):
        raise SemiparamError(f'{where}: {name} is {value!r}; expected a positive number.')
    return number


def _complaints(layout: TableLayout) -> Iterator[str]:
    """Sentences about what is wrong, the most basic first."""
    roles = layout.columns
    widths = {**WIDTHS, **dict.fromkeys(PER_JOINT, len(layout.joints)), 'temperature': len(layout.temperatures)}
    if not layout.joints:
        yield 'the table needs the names of its joints: expected --joints NAME,NAME,... or "joints:" in the file.'
    for role in roles:
        if role not in widths:
            yield f'column role {role!r} is unknown: expected one of {", ".join(widths)}.'
        elif len(roles[role]) != widths[role]:
            yield (f'{role} has {len(roles[role])} columns; expected {widths[role]}'
                   f'{", one for each of --joints" if role in PER_JOINT else ""}'
                   f'{", one for each of --temperatures" if role == "temperature" else ""}.')
        elif 0 in roles[role]:
            yield f'{role} names column 0; columns count from 1.'
    if 'position' not in roles:
        yield 'the table has no position columns: expected --position COLUMNS or "position:" under "columns:".'
    if ('force' in roles) is not ('torque' in roles):
        yield 'a wrench needs both force and torque columns; only one of them is named.'
    for name in layout.sliding:
        if name not in layout.joints:
            yield f'sliding names {name!r}; expected some of the joints {", ".join(layout.joints)}.'
    for name in layout.effort_factors:
        if name not in layout.joints:
            yield f'effort_factors names {name!r}; expected some of the joints {", ".join(layout.joints)}.'
    if layout.effort_factors and 'effort' not in roles:
        yield 'effort_factors needs efforts: expected --effort COLUMNS or "effort:" under "columns:".'
    if 'time' not in roles and layout.period is None:
        yield 'rows have no time: expected --time COLUMN, --rate HZ or --period SECONDS.'
    if layout.time_unit not in TIME_UNITS:
        yield f'time_unit is {layout.time_unit!r}; expected one of {", ".join(TIME_UNITS)}.'


def _parts(column: int | str, header: Sequence[str]) -> list[int | str]:
    """Columns of the array that is named, or the column itself."""
    return [name for name in header if name.rpartition(':')[0] == column] or [column]


def _index(column: int | str, header: Sequence[str], where: str) -> int:
    if isinstance(column, int):
        if str(column) in header and header[column - 1:column] != [str(column)]:
            raise SemiparamError(f'{where}: column {column} is not the one that the header calls {column}; expected '
                                 'names that are no numbers, or # before the header.')
        return column - 1
    if column not in header:
        raise SemiparamError(f'{where} has no column {column!r}; its header has {", ".join(header) or "no names"}.')
    if header.count(column) > 1:
        raise SemiparamError(f'{where} has {header.count(column)} columns {column!r}; expected distinct names, or the '
                             'numbers of columns.')
    return list(header).index(column)


class RecordedRow(NamedTuple):
    """One row in SI units; roles that the table does not have are empty."""

    stamp: int
    position: list[float]
    velocity: list[float]
    acceleration: list[float]
    effort: list[float]
    wrench: list[float]
    temperature: list[float]


@dataclass
class ConversionAccount:
    """Account of a conversion: rows, first and last stamp [ns], rows with a number that is not
    finite."""

    rows: int = 0
    start_ns: int = 0
    end_ns: int = 0
    not_finite: int = 0
    not_increasing: int = 0


def convert_table(path: str | os.PathLike[str], layout: TableLayout, bag: BagWriter,
                  robot_description: str | None = None,
                  progress: Callable[[int], None] = lambda done: None) -> ConversionAccount:
    """Write every row of a table as messages of one stamp; returns what was converted.

    :param robot_description: a URDF that travels in the bag, and tells which joints slide.
    :param progress: called with the number of bytes read so far, of a text table.
    A line that does not fit the layout raises SemiparamError naming line and column.
    """
    summary, written = ConversionAccount(), dict[str, float]()
    if robot_description is not None:
        types = joint_types(parse(robot_description))
        slide = tuple(joint for joint in layout.joints if types.get(joint) == 'prismatic' or joint in layout.sliding)
        layout = replace(layout, sliding=slide)
    for row in read_rows(path, layout, progress):
        summary.not_increasing += summary.rows > 0 and row.stamp <= summary.end_ns
        summary.rows += 1
        if summary.rows == 1:
            summary.start_ns = row.stamp
            if robot_description is not None:
                write_description(bag, robot_description, row.stamp)
        summary.end_ns = row.stamp
        summary.not_finite += not all(math.isfinite(value) for part in row[1:6] for value in part)
        _write(bag, row, layout)
        for name, value in zip(layout.temperatures, row.temperature, strict=False):
            if math.isfinite(value) and value != written.get(name):
                sample_messages.temperature(bag, row.stamp, name, value)
                written[name] = value
    if not summary.rows:
        raise SemiparamError(f'{str(path)!r} holds no row of numbers.')
    return summary


def read_rows(path: str | os.PathLike[str], layout: TableLayout,
              progress: Callable[[int], None] = lambda done: None) -> Iterator[RecordedRow]:
    """The rows of a table. Blank lines and those that begin with # or % are passed by; names may stand in line 1."""
    name = repr(str(path))
    arrays = holds_arrays(Path(path))
    asked = [str(column) for columns in layout.columns.values() for column in columns]
    numbers = array_lines(Path(path), asked) if arrays else text_lines(Path(path), progress)
    lines = list(islice(numbers, 2))
    if not lines:
        return
    header = lines[0][1] if arrays or _holds_names(lines, layout, name) else []
    layout = layout.spread(header)
    unknown = [column for columns in layout.columns.values() for column in columns
               if isinstance(column, str) and column not in header]
    if unknown and arrays:
        raise_unmatched(Path(path), unknown[0], asked)
    layout = layout.checked()
    indices = {role: [_index(str(column) if arrays and str(column) in header else column, header, name)
                      for column in columns]
               for role, columns in layout.columns.items()}
    width = 1 + max(index for columns in indices.values() for index in columns)
    alike = lines[0] if _has_names(layout) or not header else None
    for number, (line, cells) in enumerate(chain(lines[bool(header):], numbers)):
        where = f'{name} line {line}'
        if len(cells) < width:
            raise SemiparamError(f'{where} has {len(cells)} columns; expected at least {width}, the highest that is '
                                 'named. White space, commas, semicolons or tabs separate them.')
        alike = alike or (line, cells)
        _check_width(cells, *alike, where)
        named = {role: [cells[index] for index in columns] for role, columns in indices.items()}
        yield _row(layout, named, number, where)


def _holds_names(lines: Sequence[tuple[int, list[str]]], layout: TableLayout, where: str) -> bool:
    """Tell by the first lines whether the first one of all is a header: a row of numbers that lacks some, in words, is
    none. Raises SemiparamError where it may be both."""
    (line, cells), following = lines[0], lines[-1][1]
    if all(map(_is_number, filter(None, cells))):
        return False
    if _has_names(layout):
        return True
    told = _numbers_asked(cells, layout)
    if not any(told.get('time') or chain(*told.values())):
        whole = _numbers_asked(' '.join(cells).split(), layout)  # a comma in a remark may seem to be what separates
        may_be_row = all(whole.values()) and all(chain(*whole.values()))
    else:
        may_be_row = all(chain(*told.values())) and any(
            cell and not _is_number(cell) and _is_number(below) for cell, below in zip(cells, following, strict=False))
        if not may_be_row:
            return False
    if may_be_row:
        raise SemiparamError(f'{where} line {line} may be a header or a row ({listed(cells)}); expected # before a '
                             'header, and quotes about words.')
    return True


def _numbers_asked(cells: Sequence[str], layout: TableLayout) -> dict[str, list[bool]]:
    """Tell whether there is a number in each column that has one for its name."""
    return {role: [_is_number(cells[int(column) - 1]) for column in columns if 0 < int(column) <= len(cells)]
            for role, columns in layout.columns.items()}


def _has_names(layout: TableLayout) -> bool:
    return any(isinstance(column, str) for columns in layout.columns.values() for column in columns)


def _check_width(cells: list[str], line: int, others: list[str], where: str) -> None:
    """Raise SemiparamError where a row has more or fewer columns than another ``line``: which is which is not known
    then. Empty ones at the end do not count."""
    if len(cells) != len(others) and any(max(cells, others, key=len)[min(len(cells), len(others)):]):
        raise SemiparamError(f'{where} has {len(filled(cells))} columns, but line {line} has {len(filled(others))}; '
                             'expected as many in each, so that a column is the same everywhere.')


def _is_number(cell: str) -> bool:
    try:
        number_in(cell)
    except ValueError:
        return False
    return True


def _row(layout: TableLayout, cells: Mapping[str, list[str]], number: int,
         where: str) -> RecordedRow:
    """The ``number``-th row (from 0) from its cells by role, in SI units."""
    factors = {**dict.fromkeys(OF_ANGLES, 1.0), 'effort': layout.effort_sign, 'force': layout.wrench_sign,
               'torque': layout.wrench_sign, 'temperature': 1.0}
    scaled = {role: [_float(cell, role, where) * factor for cell in cells.get(role, ())]
              for role, factor in factors.items()}
    for role in OF_ANGLES if layout.degrees else ():
        scaled[role] = [value if joint in layout.sliding else value * (math.pi / 180.0)
                        for joint, value in zip(layout.joints, scaled[role], strict=False)]
    if layout.effort_factors and scaled['effort']:
        scaled['effort'] = [value * layout.effort_factors.get(joint, 1.0)
                            for joint, value in zip(layout.joints, scaled['effort'], strict=True)]
    stamp = _stamp(layout, cells['time'][0] if 'time' in cells else None, number, where)
    return RecordedRow(stamp, scaled['position'], scaled['velocity'], scaled['acceleration'],
                       scaled['effort'], scaled['force'] + scaled['torque'], scaled['temperature'])


def _stamp(layout: TableLayout, cell: str | None, number: int, where: str) -> int:
    """Stamp [ns] of a row. Decimal, since a float holds seconds since 1970 to 0.2 us only."""
    if cell is None:
        # Multiplied, not added up: rounding must not pile up over a long recording.
        time = (Decimal(str(layout.start)) + number * Decimal(str(layout.period))) * NANOSECONDS
    else:
        nearly = _float(cell, 'time', where)
        # A Decimal takes no exponent of twenty digits, which is nothing or infinity.
        time = (Decimal(cell) if nearly and math.isfinite(nearly) else Decimal(nearly)) * TIME_UNITS[layout.time_unit]
    if not (time.is_finite() and 0 <= time < _LATEST_STAMP):
        raise SemiparamError(f'{where} has the time {time / NANOSECONDS:f} s; expected 0 to '
                             f'{_LATEST_STAMP // NANOSECONDS} s.')
    return round(time)


def _float(cell: str, role: str, where: str) -> float:
    try:
        return number_in(cell)
    except ValueError:
        raise SemiparamError(f'{where}: {cell!r} is not a number ({role}).') from None


def _write(bag: BagWriter, row: RecordedRow, layout: TableLayout) -> None:
    sample_messages.joint_state(bag, row.stamp, layout.joints, row.position, row.velocity, row.effort)
    if row.acceleration:
        sample_messages.accelerations(
            bag, row.stamp, layout.joints, positions=row.position, velocities=row.velocity,
            accelerations=row.acceleration)
    if row.wrench:
        sample_messages.wrench(bag, row.stamp, layout.wrench_frame, row.wrench)
