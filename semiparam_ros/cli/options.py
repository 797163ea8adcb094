"""Options, consoles, progress bars, tables and files of results that sub-commands share."""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from semiparam_ros.atomic_write import require_writable, write_text
from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from semiparam_ros.core.robot.rigid_body import RigidBody

SCHEMA = 1
NO_WIDTH = 80
"""Columns of what has none: those of a file."""


class _Console(Console):
    """A console that leaves it to `main` to end the command when its reader has left, and that has a width."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if not self.width:  # COLUMNS=0, as of a terminal that does not know its own: no table had any letters
            self.width = NO_WIDTH

    def on_broken_pipe(self) -> NoReturn:
        """Raise what is being handled; rich would end with the code of a fault of the program."""
        raise


console = _Console(stderr=True, markup=False, highlight=False)
"""Progress and remarks; standard output is left to results."""

output = _Console(markup=False, highlight=False)
"""Results: tables that a user may pipe into a file."""


def add_params_option(parser: argparse.ArgumentParser) -> None:
    """Add `--params FILE`: the ROS parameter file that also configures the node."""
    parser.add_argument('--params', metavar='FILE', type=Path,
                        help='ROS parameter file (YAML), the same that configures the node')


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add `--json FILE`: where the result goes in machine-readable form."""
    parser.add_argument('--json', metavar='FILE', type=Path, help='write the result to this JSON file, in SI units')


def remark(body: RigidBody) -> None:
    """Say on standard error what of a robot its description leaves open."""
    if body.remark:
        console.print(body.remark)


def tell(line: str) -> None:
    """Print a line of the result, which the terminal may wrap but no table's width does."""
    output.print(line, soft_wrap=True)


def plain_table(name: str = '', figures: Sequence[str] = ()) -> Table:
    """Table with no lines but one under its headings: a column of names, then those of figures."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    if name:
        table.add_column(name, no_wrap=True)
    for heading in figures:
        table.add_column(heading, justify='right', no_wrap=True)
    return table


def progress_bar() -> Progress:
    """A bar on standard error, silent where that is no terminal."""
    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, disable=not console.is_terminal)


def require_places(*paths: Path | None, inputs: Iterable[Path | None] = ()) -> None:
    """Raises SemiparamError where a result could not be written, before minutes of work rather than after them, or
    would replace another one or what is read."""
    given = [path for path in paths if path is not None]
    read = [file for path in inputs if path is not None for file in (path.iterdir() if path.is_dir() else [path])]
    for index, path in enumerate(given):
        if os.path.realpath(path) in map(os.path.realpath, given[:index]):
            raise SemiparamError(f'{path} is named for two results; expected another name for each.')
        if path.exists() and any(file.exists() and path.samefile(file) for file in read):
            raise SemiparamError(f'{path} is read, too; expected another name for the output.')
        folder = path.absolute().parent
        if not folder.is_dir():
            raise SemiparamError(f'cannot write {path}: there is no folder {folder}.')
        require_writable(path)


def require_distinct(recordings: Iterable[Path | None]) -> None:
    """Raises SemiparamError where one recording is named twice: it would count as two that agree, and what was fitted
    to it would be judged on it."""
    seen = set[str]()
    for path in recordings:
        if path is not None:
            if os.path.realpath(path) in seen:
                raise SemiparamError(f'{path} is named twice; expected another recording.')
            seen.add(os.path.realpath(path))


def remark_on_learnt(judged: Sequence[Path], learnt: Sequence[Path], learning: bool = False) -> None:
    """Say on standard error which recordings are judged though they were learnt before.

    :param learning: those that are judged are learnt meanwhile.
    """
    seen = {os.path.realpath(path) for path in learnt}
    for path in judged:
        if os.path.realpath(path) in seen:
            console.print(f'{path} is judged after it was learnt: its errors say nothing of another recording.',
                          soft_wrap=True)
        seen.update([os.path.realpath(path)] * learning)


def require_counts(args: argparse.Namespace, *options: str) -> None:
    """Raises SemiparamError where an option that counts something is below one."""
    for option in options:
        if getattr(args, option) < 1:
            raise SemiparamError(f'--{option} is {getattr(args, option)}; expected at least 1.')


def require_bag_name(path: Path) -> None:
    """Raises SemiparamError for a name by which no other program would know an MCAP bag."""
    if path.suffix != '.mcap':
        raise SemiparamError(f'{str(path)!r} is no name for an MCAP bag; expected one that ends in .mcap.')


def write_json(path: Path, result: Mapping[str, Any]) -> None:
    """Write a result, versioned by "schema", atomically; a number that is not finite raises SemiparamError."""
    document = {'schema': SCHEMA, **_plain(result, '')}
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + '\n')


def _plain(value: Any, where: str) -> Any:
    """Python numbers, lists and dicts from numpy's; `where` names the entry in an error."""
    if hasattr(value, 'tolist'):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry, f'{where}.{key}' if where else str(key)) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry, f'{where}[{index}]') for index, entry in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise SemiparamError(f'the result holds {value} at {where}, where a finite number was expected.')
    return value
