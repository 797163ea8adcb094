"""Lines of a text table: white space, commas, semicolons or tabs stand between its cells."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

from semiparam_ros.errors import SemiparamError

Cells: TypeAlias = Iterator[tuple[int, list[str]]]
"""Number and cells of each line."""


def text_lines(path: Path, progress: Callable[[int], None] = lambda done: None) -> Cells:
    """Number and cells of each line but for those that are blank or begin with # or %.

    :param progress: called with the number of bytes read so far.
    """
    read = number = 0
    try:
        with path.open('rb') as file:
            for raw in file:
                read += len(raw)
                for part in raw.splitlines():  # of bytes, for a carriage return ends a line too
                    number += 1
                    line = part.decode('utf-8-sig' if number == 1 else 'utf-8')
                    if line.strip() and line.lstrip()[0] not in '#%':
                        yield number, _cells(line, f'{str(path)!r} line {number}')
                    if number % 100 == 0:
                        progress(read)
    except OSError as error:
        raise SemiparamError(f'{str(path)!r} cannot be read: {error.strerror}.') from error
    except UnicodeDecodeError as error:
        raise SemiparamError(f'{str(path)!r} is neither a bag nor a text table.') from error
    progress(read)


def number_in(cell: str) -> float:
    """The number that stands in a cell; raises ValueError for anything else, also for a name such as 1_2, which Python
    reads as 12."""
    if '_' in cell:
        raise ValueError(f'{cell!r} is a name')
    return float(cell)


def filled(cells: list[str]) -> list[str]:
    """Cells without the empty ones at their end."""
    count = len(cells)
    while count and not cells[count - 1]:
        count -= 1
    return cells[:count]


def _cells(line: str, where: str) -> list[str]:
    """Cells of a line; the first and the last may be empty, as over the row numbers of a table. What stands in quotes
    is one."""
    bare = re.sub('"[^"]*"', '""', line).strip()
    separator = next((mark for mark in ';,\t' if mark in bare), None)
    if '""' not in bare:
        cells = line.split(separator)
    else:
        try:
            cells = next(csv.reader([line if separator else line.strip()], delimiter=separator or ' ',
                                    skipinitialspace=True))
        except csv.Error as error:
            raise SemiparamError(f'{where} cannot be read: {error}.') from error
    return [cell.strip().strip('"') for cell in cells]
