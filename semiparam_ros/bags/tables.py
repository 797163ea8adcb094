"""Text tables (white space, commas, semicolons or tabs between numbers) made into bags."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from semiparam_ros.bags import recording_layout as layout_names
from semiparam_ros.bags.conversion import write_description
from semiparam_ros.bags.recording_layout import stamp_fields
from semiparam_ros.bags.table_layout import TIME_UNITS, TableLayout, column_indices
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.errors import SemiparamError

_LATEST_STAMP = 2**31 * 10**9  # a builtin_interfaces/Time has 31 bits of seconds


class Row(NamedTuple):
    """One row in SI units; roles that the table does not have are empty."""

    stamp: int
    position: list[float]
    velocity: list[float]
    acceleration: list[float]
    effort: list[float]
    wrench: list[float]


@dataclass
class Summary:
    """What was converted: rows, the first and last stamp [ns], rows with a number that is not finite."""

    rows: int = 0
    start_ns: int = 0
    end_ns: int = 0
    not_finite: int = 0
    not_increasing: int = 0


def convert_table(path: str | os.PathLike[str], layout: TableLayout, bag: BagWriter,
                  robot_description: str | None = None, progress: Callable[[int], None] = lambda done: None) -> Summary:
    """Write every row of a table as messages of one stamp; returns what was converted.

    :param robot_description: a URDF that travels in the bag.
    :param progress: called with the number of bytes read so far.
    A line that does not fit the layout raises SemiparamError naming line and column.
    """
    summary = Summary()
    for row in read_rows(path, layout.checked(), progress):
        summary.not_increasing += summary.rows > 0 and row.stamp <= summary.end_ns
        summary.rows += 1
        if summary.rows == 1:
            summary.start_ns = row.stamp
            if robot_description is not None:
                write_description(bag, robot_description, row.stamp)
        summary.end_ns = row.stamp
        summary.not_finite += not all(math.isfinite(value) for part in row[1:] for value in part)
        _write(bag, row, layout)
    if not summary.rows:
        raise SemiparamError(f'{str(path)!r} holds no row of numbers.')
    return summary


def read_rows(path: str | os.PathLike[str], layout: TableLayout,
              progress: Callable[[int], None] = lambda done: None) -> Iterator[Row]:
    """The rows of a table. Blank lines and those that begin with # or % are passed by; names may stand in line 1."""
    name = repr(str(path))
    numbers = _lines(Path(path), progress)
    first = next(numbers, None)
    if first is None:
        return
    header = [] if all(map(_is_number, first[1])) else first[1]
    indices = column_indices(layout, header, name)
    width = 1 + max(index for columns in indices.values() for index in columns)
    convert = _Units(layout)
    for number, (line, cells) in enumerate(numbers if header else chain([first], numbers)):
        where = f'{name} line {line}'
        if len(cells) < width:
            raise SemiparamError(f'{where} has {len(cells)} columns; expected at least {width}.')
        yield convert.row({role: [cells[index] for index in columns] for role, columns in indices.items()}, number,
                          where)


def _lines(path: Path, progress: Callable[[int], None]) -> Iterator[tuple[int, list[str]]]:
    """(number of the line, its cells)."""
    read = 0
    try:
        with path.open('rb') as file:
            for number, raw in enumerate(file, 1):
                read += len(raw)
                line = raw.decode('utf-8-sig' if number == 1 else 'utf-8').strip()
                if line and line[0] not in '#%':
                    yield number, _cells(line)
                if number % 100 == 0:
                    progress(read)
    except OSError as error:
        raise SemiparamError(f'{str(path)!r} cannot be read: {error.strerror}.') from error
    except UnicodeDecodeError as error:
        raise SemiparamError(f'{str(path)!r} is neither a bag nor a text table.') from error
    progress(read)


def _cells(line: str) -> list[str]:
    separator = next((mark for mark in ';,\t' if mark in line), None)
    return [cell.strip().strip('"') for cell in line.split(separator)]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


class _Units:
    """From the units and signs of the file to SI units."""

    def __init__(self, layout: TableLayout) -> None:
        angle = math.pi / 180.0 if layout.degrees else 1.0
        self._factors = {'position': angle, 'velocity': angle, 'acceleration': angle, 'effort': layout.effort_sign,
                         'force': layout.wrench_sign, 'torque': layout.wrench_sign}
        self._layout = layout

    def row(self, cells: Mapping[str, list[str]], number: int, where: str) -> Row:
        """The ``number``-th row (from 0) from its cells by role."""
        scaled = {role: [_float(cell, role, where) * factor for cell in cells.get(role, ())]
                  for role, factor in self._factors.items()}
        stamp = self._stamp(cells['time'][0] if 'time' in cells else None, number, where)
        return Row(stamp, scaled['position'], scaled['velocity'], scaled['acceleration'], scaled['effort'],
                   scaled['force'] + scaled['torque'])

    def _stamp(self, cell: str | None, number: int, where: str) -> int:
        """[ns]. Decimal, since a float holds seconds since 1970 to 0.2 us only."""
        if cell is None:
            # Multiplied, not added up: rounding must not pile up over a long recording.
            time = (Decimal(str(self._layout.start)) + number * Decimal(str(self._layout.period))) * 10**9
        else:
            _float(cell, 'time', where)
            time = Decimal(cell) * TIME_UNITS[self._layout.time_unit]
        if not (time.is_finite() and 0 <= time < _LATEST_STAMP):
            raise SemiparamError(f'{where} has the time {time / 10**9:f} s; expected 0 to {_LATEST_STAMP // 10**9} s.')
        return round(time)


def _float(cell: str, role: str, where: str) -> float:
    try:
        return float(cell)
    except ValueError:
        raise SemiparamError(f'{where}: {cell!r} is not a number ({role}).') from None


def _write(bag: BagWriter, row: Row, layout: TableLayout) -> None:
    names = list(layout.joints)
    header: dict[str, Any] = {'stamp': stamp_fields(row.stamp), 'frame_id': ''}
    _put(bag, layout_names.JOINT_STATES, row.stamp, {'header': header, 'name': names, 'position': row.position,
                                                     'velocity': row.velocity, 'effort': row.effort})
    if row.acceleration:
        point = {'positions': row.position, 'velocities': row.velocity, 'accelerations': row.acceleration}
        _put(bag, layout_names.JOINT_ACCELERATIONS, row.stamp, {'header': header, 'joint_names': names,
                                                                'points': [point]})
    if row.wrench:
        force, torque = (dict(zip('xyz', part, strict=True)) for part in (row.wrench[:3], row.wrench[3:]))
        _put(bag, layout_names.WRENCH, row.stamp, {'header': {**header, 'frame_id': layout.wrench_frame},
                                                   'wrench': {'force': force, 'torque': torque}})


def _put(bag: BagWriter, topic: str, stamp: int, message: dict[str, Any]) -> None:
    bag.write(topic, layout_names.TYPES[topic], message, stamp)
