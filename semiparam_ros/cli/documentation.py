"""The page docs/reference/commands.md, written from the parsers of the commands themselves.

Not from the text of ``--help``: that depends on Python's version and on the width of the terminal.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Iterator
from pathlib import Path

from semiparam_ros.cli.main import COMMANDS

HEADER = """# Commands

Made from the commands themselves by `python -m semiparam_ros.cli.documentation`; edit them there.

Each is `semiparam COMMAND`, and `ros2 run semiparam_ros COMMAND` in a ROS workspace. `estimator` is `semiparam run`,
and `bag_replay` is `semiparam replay`. One ROS parameter file (`--params FILE`) configures the node and every command.

| Exit code | Meaning |
|---|---|
| 0 | done |
| 1 | something failed that is not the caller's mistake; `SEMIPARAM_TRACEBACK=1` shows where |
| 2 | a mistake in the call or in a file: one sentence on standard error says what, where, and what was expected |
| 130 | ended by Ctrl-C |
| 141 | the reader of the output has left (`semiparam ... \\| head`) |
"""


def page() -> str:
    """The whole page, one section for each command."""
    return HEADER + ''.join(f'\n{_section(command)}' for command in COMMANDS)


def write(repository: str = '.') -> None:
    """Write docs/reference/commands.md anew."""
    Path(repository, 'docs', 'reference', 'commands.md').write_text(page(), encoding='utf-8')


def _section(command: str) -> str:
    module = importlib.import_module(f'semiparam_ros.cli.{command}')
    parser = argparse.ArgumentParser(prog=f'semiparam {command}')
    module.add_arguments(parser)
    rows = '\n'.join(_rows(parser))
    return f'## semiparam {command}\n\n{module.HELP}\n\n| Argument | Meaning |\n|---|---|\n{rows}\n'


def _rows(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Positional arguments first, then the options in the order of the help; a group's heading is a row of its own."""
    for group in parser._action_groups:
        actions = [action for action in group._group_actions if not isinstance(action, argparse._HelpAction)]
        if actions and group.title not in ('positional arguments', 'options'):
            yield f'| *{group.title}* | {_cell(group.description or "")} |'
        for action in actions:
            yield f'| {_spelling(action)} | {_cell(_meaning(action))} |'


def _spelling(action: argparse.Action) -> str:
    """Spellings of the option, with what it takes behind the last: ``-r, --rate R``."""
    value = '' if action.nargs == 0 else _value(action)
    words = ', '.join(action.option_strings)
    return '`' + f'{words} {value}'.strip().replace('|', '\\|') + '`'


def _value(action: argparse.Action) -> str:
    name = action.metavar or ('{' + ','.join(map(str, action.choices)) + '}' if action.choices else action.dest)
    name = ' '.join(name) if isinstance(name, tuple) else name
    many = {'+': f'{name} [{name} ...]', '*': f'[{name} ...]', '?': f'[{name}]'}
    return many.get(str(action.nargs), str(name))


def _meaning(action: argparse.Action) -> str:
    return (action.help or '').replace('%%', '%')


def _cell(text: str) -> str:
    return text.replace('|', '\\|')


if __name__ == '__main__':
    write()
