"""The fenced blocks of the README and of the documentation, and how a test runs each of them.

A block says in its first line, where a reader sees it too, what is special about it:

- ``# file: NAME`` the block is the file NAME, which the blocks after it use
- ``# terminal 1`` it runs until Ctrl-C, while the other blocks of the page run beside it
- ``# not tested: REASON`` it needs what no test has, such as apt or the ros2 command

Blocks ``bash`` must exit with 0, blocks ``python`` too; commands of ours that ask nothing of a shell are forked from a
process that has loaded them. A block ``text`` behind them is part of what they print, with
``...`` for anything. Blocks ``yaml`` are parsed, and loaded as parameters where they are a parameter file.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import os
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO

import yaml
from markdown_it import MarkdownIt

from semiparam_ros.cli.main import COMMANDS
from semiparam_ros.settings import load_params
from support import forked

START_S, STOP_S = 3.0, 30.0
RUN = {'bash': ['bash', '-euo', 'pipefail', '-c'], 'python': [sys.executable, '-c']}
SPECIAL = re.compile(r'\A(?:#|//|<!--) ?(file|not tested): ?(.*?)(?: -->)?$', re.MULTILINE)
PROGRAMS = ('semiparam', 'bag_replay', 'estimator', 'python', 'pytest', 'make', 'ros2', 'pip', 'sudo', 'colcon')
WRITTEN = {'json', 'toml', 'xml', 'ini'}
SHOWN = {'text', 'mermaid'}


@dataclass(frozen=True)
class Block:
    """One fenced block. ``special`` is 'file', 'not tested' or '', and ``detail`` what follows it."""

    page: str
    line: int
    language: str
    text: str
    special: str
    detail: str

    @property
    def background(self) -> bool:
        """True for what a reader leaves running in a terminal of its own."""
        return self.language == 'bash' and self.text.startswith('# terminal 1')

    def __str__(self) -> str:
        return f'{self.page}:{self.line} ({self.language})'


@cache
def blocks(path: Path) -> list[Block]:
    """The fenced blocks of a page, in order. Commands in an indented block, which no test would see, are refused."""
    found = []
    for token in MarkdownIt().parse(path.read_text(encoding='utf-8')):
        line = token.map[0] + 1 if token.map else 0
        if token.type == 'code_block':
            assert token.content.split()[0] not in PROGRAMS, f'{path}:{line}: a command needs a fenced block.'
        if token.type == 'fence':
            match = SPECIAL.match(token.content)
            special, detail = match.groups() if match else ('', '')
            found.append(Block(path.name, line, token.info.strip(), token.content, special, detail))
    return found


class Workshop:
    """A folder with the bundled recordings and parameters, in which the blocks of one page run in order.

    :param known: what blocks on other pages made, by their text: the same block is not run twice.
    """

    def __init__(self, folder: Path, repository: Path, known: dict[str, tuple[str, dict[str, bytes]]]) -> None:
        self.folder, self._known = folder, known
        self._printed = ''
        self._background: list[subprocess.Popen[bytes]] = []
        folder.mkdir(parents=True, exist_ok=True)
        for name in ('bags', 'config', 'docs'):
            (folder / name).symlink_to(repository / name)
        self.environment = os.environ | {
            'PATH': f'{Path(sys.executable).parent}{os.pathsep}{os.environ["PATH"]}', 'OMP_NUM_THREADS': '1',
            'PYTHONPATH': f'{repository}{os.pathsep}{folder / "site"}', 'ROS_HOME': str(folder / 'ros_home'),
            # `pip install` of a page's package goes into the folder, and asks no index. (0 stands for: no isolation.)
            'PIP_TARGET': str(folder / 'site'), 'PIP_NO_BUILD_ISOLATION': '0', 'PIP_NO_INDEX': '1',
            'PIP_DISABLE_PIP_VERSION_CHECK': '1', 'COLUMNS': '100'}

    def __enter__(self) -> Workshop:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._background:
            process.send_signal(signal.SIGINT)
        codes = []
        for process in self._background:
            try:
                codes.append(process.wait(STOP_S))
            except subprocess.TimeoutExpired:
                process.kill()
                codes.append(process.wait())
        assert not any(codes), f'programs in the background ended with {codes}.'

    def run(self, block: Block) -> None:
        """Do what a reader would do with the block."""
        if block.special == 'file':
            path = self.folder / block.detail
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding='utf-8')
            if block.language == 'yaml':
                self.check_yaml(block)
        elif block.language == 'yaml':
            self.check_yaml(block)
        elif block.language == 'text':
            check_printed(block, self._printed)
        elif block.background:
            self._start(block)
        else:
            self._printed = self._run(block)

    def check_yaml(self, block: Block) -> None:
        """It is YAML, and where it is a parameter file, one that loads."""
        document = yaml.safe_load(block.text)
        assert isinstance(document, dict | list), block
        if 'ros__parameters' in block.text:
            path = self.folder / f'.block_{block.line}.yaml'
            path.write_text(block.text, encoding='utf-8')
            load_params(path)

    def _start(self, block: Block) -> None:
        """Commands of one terminal, the last of which runs until the page ends."""
        *first, last = commands(block)
        for command in first:
            self._finish(block, own_arguments(command) or ['bash', '-c', command])
        path = self.folder / f'terminal_{block.line}.log'
        with path.open('wb') as log:
            process = self._begin(own_arguments(last) or ['bash', '-c', f'exec {last}'], log)
        self._background.append(process)
        time.sleep(START_S)
        assert process.poll() is None, (str(block), path.read_text())

    def _run(self, block: Block) -> str:
        if block.text in self._known:
            printed, files = self._known[block.text]
            for name, content in files.items():
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                (self.folder / name).write_bytes(content)
            return printed
        before = self._stamps()
        ours = [own_arguments(command) for command in commands(block)] if block.language == 'bash' else [None]
        processes = ours if all(ours) else [[*RUN[block.language], block.text]]
        printed = ''.join(self._finish(block, arguments) for arguments in processes)
        if not self._background:
            made = [name for name, stamp in self._stamps().items() if before.get(name) != stamp]
            self._known[block.text] = (printed, {name: (self.folder / name).read_bytes() for name in made})
        return printed

    def _begin(self, arguments: list[str], log: IO[bytes]) -> subprocess.Popen[bytes]:
        """A process of these arguments, of which those that begin with `semiparam` are ours."""
        if arguments[0] == 'semiparam':
            return forked.start(arguments[1:], log, self.environment, self.folder)
        return subprocess.Popen(arguments, cwd=self.folder, env=self.environment, stdout=log, stderr=subprocess.STDOUT)

    def _finish(self, block: Block, arguments: list[str]) -> str:
        """What a process prints that must succeed; how long it may take is for pytest to say."""
        with tempfile.TemporaryFile() as log:
            code = self._begin(arguments, log).wait()
            log.seek(0)
            printed = log.read().decode()
        assert code == 0, f'{block} ended with {code}:\n{block.text}\n{printed}'
        return printed

    def _stamps(self) -> dict[str, int]:
        """When each file of the folder was written, the bundled ones apart."""
        return {str(path.relative_to(self.folder)): path.stat().st_mtime_ns for path in self.folder.rglob('*')
                if path.is_file() and not path.is_symlink() and 'ros_home' not in path.parts}


def check_printed(block: Block, printed: str) -> None:
    """Every line of the block is among those printed, in this order."""
    rest = [' '.join(line.split()) for line in printed.splitlines()]
    for line in block.text.splitlines():
        words = ' '.join(line.split())
        if words in ('', '...'):
            continue
        pattern = re.compile('.*'.join(map(re.escape, words.split('...'))))
        place = next((number for number, found in enumerate(rest) if pattern.fullmatch(found)), None)
        assert place is not None, f'{block}: {line!r} was not printed:\n{printed}'
        rest = rest[place + 1:]


def commands(block: Block) -> list[str]:
    """The commands of a bash block, continuation lines joined, comments left out."""
    lines = block.text.replace('\\\n', ' ').splitlines()
    return [line for line in lines if line.strip() and not line.lstrip().startswith('#')]


def own_arguments(command: str) -> list[str] | None:
    """`semiparam` and its arguments; None of another program, and where a shell has more to do than start it."""
    program, *arguments = shlex.split(command, comments=True)
    first = {'semiparam': ['semiparam'], 'bag_replay': ['semiparam', 'replay']}.get(program)
    return None if first is None or re.search(r'[|&;<>$*~]', command) else [*first, *arguments]


def check_parses(block: Block, repository: Path) -> None:
    """The programs of a block that takes minutes exist, and have the options that it gives them."""
    for command in commands(block):
        words = [word for word in shlex.split(command, comments=True) if (word != '&' and '=' not in word.split('/')[0])
                 or word.startswith('-')]
        if words != ['wait']:
            check_command(words[:words.index('--ros-args')] if '--ros-args' in words else words, repository)


@cache
def options_of(script: tuple[str, ...]) -> set[str]:
    """Those that the --help of a script or of a module (-m) names."""
    if script[0] == '-m':
        return set(re.findall(r'--[a-z-]+', subprocess.run(
            [sys.executable, *script, '--help'], capture_output=True, text=True, check=True).stdout))
    path, argv = sys.path.copy(), sys.argv
    sys.path.insert(0, str(Path(script[0]).parent))
    sys.argv = [*script, '--help']
    try:  # in this process, which has loaded most of what it imports
        with contextlib.redirect_stdout(io.StringIO()) as printed, contextlib.suppress(SystemExit):
            runpy.run_path(script[0], run_name='__main__')
    finally:
        sys.path[:], sys.argv = path, argv
    return set(re.findall(r'--[a-z-]+', printed.getvalue()))


@cache
def look_at_rules(arguments: tuple[str, ...], repository: Path) -> None:
    """`make` knows what to do; the interpreter is given, for which it would look for a second and more."""
    subprocess.run([shutil.which('make') or 'make', '-n', 'PYTHON=python3', *arguments], cwd=repository, check=True,
                   stdout=subprocess.DEVNULL)


def check_command(words: list[str], repository: Path) -> None:
    """One command: ours against its own parser, a script against its --help, a test against its file."""
    program, arguments = words[0], words[1:]
    if program == 'bag_replay':
        program, arguments = 'semiparam', ['replay', *arguments]
    if program == 'semiparam':
        assert arguments[0] in COMMANDS, words
        module = importlib.import_module(f'semiparam_ros.cli.{arguments[0]}')
        parser = argparse.ArgumentParser(exit_on_error=False)
        module.add_arguments(parser)
        parser.parse_args(arguments[1:])
    elif program == 'python':
        script = arguments[:2] if arguments[0] == '-m' else [str(repository / arguments[0])]
        options = {word for word in arguments[1:] if word.startswith('--')}
        assert script[0] == '-m' or Path(script[0]).exists(), words
        assert not options or options <= options_of(tuple(script)), words
    elif program == 'pytest':
        files = [word for word in arguments if word.startswith('test/')]
        assert files, words
        for name in files:
            assert (repository / name).exists(), name
    elif program == 'make':
        look_at_rules(tuple(arguments), repository)
    elif program not in ('grep', 'sed'):
        raise AssertionError(f'{program} is no program of ours: {words}')
