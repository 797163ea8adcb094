"""The command `semiparam COMMAND ...` and the two programs that ROS users start by name.

A sub-command is the module of its name beside this one, with ``HELP``, ``add_arguments(parser)`` and
``run(args) -> exit code``. Only the chosen one is imported, so that `--help` answers at once.
"""

from __future__ import annotations

import argparse
import ast
import atexit
import gc
import importlib
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from semiparam_ros import __version__
from semiparam_ros.errors import SemiparamError
from semiparam_ros.interrupts import remember_interrupts

COMMANDS = ('run', 'replay', 'evaluate', 'fit', 'compare', 'diagnose', 'export', 'simulate', 'convert',
            'bench', 'record')

NODES = ('run', 'replay', 'record')
"""Commands that start a node, for which arguments of ROS are."""

DISTRIBUTIONS = {'mcap': 'mcap-ros2-support', 'mcap_ros2': 'mcap-ros2-support', 'pinocchio': 'pin',
                 'sklearn': 'scikit-learn', 'yaml': 'pyyaml'}
"""Distributions to install for modules that have another name."""

FAILED, BAD_INPUT, INTERRUPTED, BROKEN_PIPE = 1, 2, 130, 141


def main(argv: Sequence[str] | None = None, prog: str = 'semiparam') -> int:
    """Run one sub-command and return its exit code: 2, with one sentence on stderr, for anything a user can mend."""
    # The matrices are small: a second linear algebra thread only fights with the executor (read when numpy loads).
    os.environ.setdefault('OMP_NUM_THREADS', '1')
    _open_standard_streams()
    # At the end everything goes with the process: to look through it first takes a third of a second.
    atexit.register(gc.freeze)
    arguments, ros_arguments = split_ros_arguments(sys.argv[1:] if argv is None else argv)
    try:
        try:
            with remember_interrupts():
                return _dispatch(arguments, ros_arguments, prog)
        finally:
            sys.stdout.flush()
    except SystemExit as stop:
        # argparse leaves this way, with 0 after --help and 2 after a mistake.
        return int(stop.code or 0)
    except SemiparamError as error:
        return _complain(prog, str(error), BAD_INPUT)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has left (`semiparam ... | head`); Python would complain once more when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as error:
        name = f'{error.filename}: ' if error.filename else ''
        return _complain(prog, f'{name}{error.strerror or error}.', BAD_INPUT)
    except ModuleNotFoundError as error:
        return _unexpected(prog, error) if _ours(error) else _complain(prog, _missing(error), BAD_INPUT)
    except Exception as error:  # Ctrl-C in the midst of an import may be its cause
        return INTERRUPTED if isinstance(error.__cause__, KeyboardInterrupt) else _unexpected(prog, error)


def _open_standard_streams() -> None:
    """Put the null device where a stream was closed (`semiparam ... >&-`), or the next file that is opened becomes what
    libraries print to."""
    for name, mode in (('stdin', 'r'), ('stdout', 'w'), ('stderr', 'w')):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode, encoding='utf-8'))


def estimator() -> int:
    """The node as a program of its own: `semiparam run`."""
    return main(['run', *sys.argv[1:]], prog='estimator')


def bag_replay() -> int:
    """The replay tool as a program of its own: `semiparam replay`."""
    return main(['replay', *sys.argv[1:]], prog='bag_replay')


def split_ros_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split into our arguments, and those from each `--ros-args` to the next `--`, for rclpy.

    A sub-command finds the latter in ``args.ros_args``.
    """
    ours: list[str] = []
    theirs: list[str] = []
    inside = False
    for argument in argv:
        inside = inside or argument == '--ros-args'
        (theirs if inside else ours).append(argument)
        inside = inside and argument != '--'
    return ours, theirs


def _dispatch(argv: list[str], ros_arguments: list[str], prog: str) -> int:
    """Choose the sub-command, let it parse the rest and run it."""
    overview = _overview()
    if not argv:
        overview.print_help(sys.stderr)
        return BAD_INPUT
    chosen = overview.parse_args(argv)
    if ros_arguments and chosen.command not in NODES:
        raise SemiparamError(f'{chosen.command} starts no node; expected --ros-args with {", ".join(NODES)} alone, and '
                             'a parameter file as --params FILE.')
    module = importlib.import_module(f'semiparam_ros.cli.{chosen.command}')
    name = f'{prog} {chosen.command}' if prog == 'semiparam' else prog
    parser = _Parser(prog=name, description=module.HELP)
    module.add_arguments(parser)
    return int(module.run(parser.parse_args(chosen.arguments, argparse.Namespace(ros_args=ros_arguments))))


class _Parser(argparse.ArgumentParser):
    """Parser that tells a mistake in one sentence, without the usage of thirty options, and takes no empty text, as of
    a variable of the shell that is not set: ``Path('')`` is the working folder, and other options were not heard."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.register('type', Path, _path)
        self.register('type', None, _text)

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f'{self.prog}: {message}; {self.prog} --help explains.\n')


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError('the name is empty')
    return Path(text)


def _text(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError('the text is empty')
    return text


def _overview() -> argparse.ArgumentParser:
    """The parser of the first word alone."""
    lines = [f'  {command:<10}{summary(command)}' for command in COMMANDS]
    parser = _Parser(prog='semiparam', usage='%(prog)s [--version] COMMAND ...',
                     description="Learn a robot's inverse dynamics while it moves.",
                     formatter_class=argparse.RawDescriptionHelpFormatter,
                     epilog='\n'.join(['commands:', *lines, '', 'semiparam COMMAND --help explains each.']))
    parser.add_argument('--version', action='version', version=f'semiparam_ros {__version__}')
    parser.add_argument('command', choices=COMMANDS, metavar='COMMAND', help='one of the commands below')
    parser.add_argument('arguments', type=str, nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    return parser


def summary(command: str) -> str:
    """Read the first line of a command's HELP from its source: to import all ten takes seconds."""
    source = Path(__file__).with_name(f'{command}.py')
    for statement in ast.parse(source.read_text(encoding='utf-8')).body if source.exists() else []:
        target = statement.targets[0] if isinstance(statement, ast.Assign) else getattr(statement, 'target', None)
        if isinstance(target, ast.Name) and target.id == 'HELP':
            return str(ast.literal_eval(statement.value)).splitlines()[0]  # type: ignore[attr-defined]
    return ''


def _complain(prog: str, sentence: str, code: int) -> int:
    """One sentence on standard error; the code tells as much where that cannot be written."""
    with suppress(OSError):
        print(f'{prog}: {sentence}', file=sys.stderr, flush=True)
    return code


def _ours(error: ModuleNotFoundError) -> bool:
    """Tell whether a module of this package is missing, which no user can mend."""
    return (error.name or 'semiparam_ros').partition('.')[0] == 'semiparam_ros'


def _missing(error: ModuleNotFoundError) -> str:
    """apt cannot install every package that some commands need, so that an installation without them is no fault."""
    module = str(error.name).partition('.')[0]
    package = DISTRIBUTIONS.get(module, module)
    return f"this command needs the Python package '{package}', which is not installed: pip install {package}."


def _unexpected(prog: str, error: Exception) -> int:
    """A fault of the program itself: still no traceback unless it is asked for."""
    if os.environ.get('SEMIPARAM_TRACEBACK'):
        traceback.print_exc()
    sentence = f'internal error, {type(error).__name__}: {error} (SEMIPARAM_TRACEBACK=1 shows where).'
    return _complain(prog, sentence, FAILED)


if __name__ == '__main__':
    sys.exit(main())
