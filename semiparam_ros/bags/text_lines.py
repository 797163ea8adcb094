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
    read = 0
    try:
        with path.open('rb') as file:
            for number, raw in enumerate(file, 1):
                read += len(raw)
                line = raw.decode('utf-8-sig' if number == 1 else 'utf-8').rstrip()
                if line and line.lstrip()[0] not in '#%':
                    yield number, _cells(line)
                if number % 100 == 0:
                    progress(read)
    except OSError as error:
        raise SemiparamError(f'{str(path)!r} cannot be read: {error.strerror}.') from error
    except UnicodeDecodeError as error:
        raise SemiparamError(f'{str(path)!r} is neither a bag nor a text table.') from error
    progress(read)


def _cells(line: str) -> list[str]:
    """Cells of a line; the first one may be empty, as over the row numbers of a table. What stands in quotes is one."""
    bare = re.sub('"[^"]*"', '', line)
    separator = next((mark for mark in ';,\t' if mark in bare.lstrip()), None)
    quoted = separator is not None and bare != line
    cells = next(csv.reader([line], delimiter=separator or ' ', skipinitialspace=True)) if quoted else \
        line.split(separator)
    return [cell.strip().strip('"') for cell in cells]
