"""The pages of reference that are made from the code: commands, parameters (and the file that holds
them all), and the tables of effects.

    python docs/reference/render.py
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import numpy as np

from semiparam_ros.cli.main import COMMANDS
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.effects import Coefficient, Effect
from semiparam_ros.effects.registry import BUILT_IN
from semiparam_ros.effects.terms import Terms
from semiparam_ros.settings.files import params_text
from semiparam_ros.settings.parameter_table import PARAMETERS, Parameter, shown
from semiparam_ros.settings.rules import RULES
from semiparam_ros.simulation.robots import ICUB_JOINTS, ICUB_SENSOR, bundled_urdf

REPOSITORY = Path(__file__).resolve().parents[2]
EFFECTS = REPOSITORY / 'docs/reference/effects.md'

OF_COMMANDS = """# Commands

Made from the commands themselves by `python docs/reference/render.py`; edit them there.

Each is `semiparam COMMAND`, and `ros2 run semiparam_ros COMMAND` in a ROS workspace. `estimator` is `semiparam run`,
and `bag_replay` is `semiparam replay`. One ROS parameter file (`--params FILE`) configures the node and every command.

| Exit code | Meaning |
|---|---|
| 0 | done |
| 1 | something failed that is not the caller's mistake; `SEMIPARAM_TRACEBACK=1` shows where |
| 2 | a mistake in the call or in a file: one sentence on standard error says what, where, and what was expected |
| 130 | ended by Ctrl-C before it was done; `run`, `record` and a `replay` without followers end so with 0 |
| 141 | the reader of the output has left (`semiparam ... \\| head`) |
"""
OF_PARAMETERS = """# Parameters

Made from the table in `semiparam_ros/settings/parameter_table.py` by `python docs/reference/render.py`;
edit it there. One file configures the node (`semiparam run --params FILE`, or `--ros-args --params-file FILE`)
and every offline command (`--params FILE`). `config/estimator.yaml` holds every parameter at its default.

A parameter marked *live* may change while the node runs (`ros2 param set`); the others are read at the start.
A value that is refused leaves everything as it was, and the answer gives the reason in one sentence. ROS tells numbers
by their spelling; here `1` is accepted for `1.0`. An empty list means "not given".

| Parameter | Default | | Meaning |
|---|---|---|---|
"""
BEGIN, END = '<!-- tables of effects: begin -->', '<!-- tables of effects: end -->'
GROUPS = {'In wrenches and in efforts': ('wrench', 'effort'), 'In wrenches': ('wrench',),
          'In joint efforts': ('effort',)}
OF_EFFECTS = ('| Kind | Physics | Values that are found | Can be mistaken for | What separates them |\n'
              '|---|---|---|---|---|\n')
MOST_NAMES, MOST_VALUES = 4, 12


def files() -> dict[Path, str]:
    """Every file that is made, as it should be."""
    return {REPOSITORY / 'docs/reference/commands.md': OF_COMMANDS + ''.join(map(section, COMMANDS)),
            REPOSITORY / 'docs/parameters.md': of_parameters(),
            REPOSITORY / 'config/estimator.yaml': params_text(None),
            EFFECTS: with_tables(EFFECTS.read_text(encoding='utf-8'))}


def row(*cells: str) -> str:
    """One of a table."""
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |\n'


# Commands. Not from the text of --help: that depends on Python's version and on the terminal's width.

def section(command: str) -> str:
    """The command with its arguments."""
    module = importlib.import_module(f'semiparam_ros.cli.{command}')
    parser = argparse.ArgumentParser(prog=f'semiparam {command}')
    module.add_arguments(parser)
    return (f'\n## semiparam {command}\n\n{module.HELP}\n\n| Argument | Meaning |\n|---|---|\n'
            + ''.join(arguments(parser)))


def arguments(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Rows of positional arguments first, then of options in the order of the help; a group's heading
    is a row of its own."""
    for group in parser._action_groups:
        actions = [action for action in group._group_actions
                   if not isinstance(action, argparse._HelpAction)]
        if actions and group.title not in ('positional arguments', 'options'):
            yield row(f'*{group.title}*', group.description or '')
        for action in actions:
            yield row(f'`{spelling(action)}`', (action.help or '').replace('%%', '%'))


def spelling(action: argparse.Action) -> str:
    """Spellings of the option, with what it takes behind the last: ``-r, --rate R``."""
    name = action.metavar or ('{' + ','.join(map(str, action.choices)) + '}' if action.choices
                              else action.dest)
    name = ' '.join(name) if isinstance(name, tuple) else name
    many = {'0': '', '+': f'{name} [{name} ...]', '*': f'[{name} ...]', '?': f'[{name}]'}
    return f'{", ".join(action.option_strings)} {many.get(str(action.nargs), name)}'.strip()


# Parameters.

def of_parameters() -> str:
    """The page."""
    rules = '\n'.join(f'- {(rule.__doc__ or rule.__name__).strip()} (`{rule.__name__}`)' for rule in RULES)
    return f'{OF_PARAMETERS}{"".join(map(of_parameter, PARAMETERS))}\n## Rules across parameters\n\n{rules}\n'


def of_parameter(parameter: Parameter) -> str:
    """Its row."""
    kind = ', '.join(filter(None, [parameter.kind, parameter.permitted,
                                   parameter.unit and f'[{parameter.unit}]']))
    return row(f'`{parameter.name}`', f'`{shown(parameter.default)}`', '*live*' if parameter.live else '',
               f'{parameter.description} ({kind})')


# Effects.

def with_tables(page: str) -> str:
    """The page with its tables of the built-in kinds but formulas, one for each set of outputs."""
    tables = '\n'.join(f'### {title}\n\n{OF_EFFECTS}' + ''.join(
        of_kind(kind, body_of(outputs[0])) for kind in BUILT_IN
        if kind.outputs == outputs and kind is not Terms) for title, outputs in GROUPS.items())
    return re.sub(f'(?<={re.escape(BEGIN)}\n).*(?={re.escape(END)})', lambda _: tables, page, flags=re.DOTALL)


def body_of(outputs: str) -> RigidBody:
    """The bundled arm."""
    return RigidBody.from_urdf(bundled_urdf().read_text(encoding='utf-8'), ICUB_JOINTS, outputs, ICUB_SENSOR)


def of_kind(kind: type[Effect], body: RigidBody) -> str:
    """Its row. Physics: the sentence that a user reads, and the first paragraph of the docstring."""
    first = ' '.join((inspect.getdoc(kind) or '').split('\n\n')[0].split()).replace('``', '`')
    return row(f'`{kind.kind}`', f'{kind.sentence[0].upper()}{kind.sentence[1:]}. {first}', values(kind, body),
               ', '.join(f'`{name}`' for name in kind.mistaken_for), kind.separated_by)


def values(kind: type[Effect], body: RigidBody) -> str:
    """Values that are learnt or calibrated, in every form that the kind has, and those searched."""
    motion = motion_of(body)
    tried = [kind.from_values(where, found).finer() for where in kind.places(body) or kind.permitted(body)
             for found in kind.searches(body, motion, where, motion.outputs)]
    forms = dict.fromkeys(named([*effect.coefficients(body), *kind.calibrations]) for effect in tried)
    start = ('start_s', 'end_s') if kind.may_start or kind.must_start else ()
    names = dict.fromkeys([*start, *(name for effect in tried for name in effect.parameters)])
    searched = [Coefficient(name, kind().unit_of(name)) for name in names]
    return '; or '.join(forms) + (f'; searched: {named(searched)}' if searched else '')


def motion_of(body: RigidBody) -> Samples:
    """Motion of every joint, for a kind that looks at it to choose where a search begins."""
    phase = np.linspace(0.0, 30.0, 400)[:, None] * (1.0 + 0.3 * np.arange(body.n_joints))
    outputs = np.sin(5.0 * phase[:, :1]) * np.ones(body.n_outputs)
    return Samples(np.arange(400) * 50_000_000, np.sin(phase), np.cos(phase), -np.sin(phase), outputs, 0,
                   temperature=30.0 + phase[:, :body.n_joints if body.outputs == 'effort' else 1])


def named(coefficients: list[Coefficient]) -> str:
    """Names with units, neighbours of the same unit together; a long list by its ends."""
    if len(coefficients) > MOST_VALUES:
        return f'`{coefficients[0].name}`, …, `{coefficients[-1].name}` ({len(coefficients)} values)'
    return ', '.join(together([each.name for each in group], unit)
                     for unit, group in groupby(coefficients, key=lambda each: each.unit))


def together(names: list[str], unit: str) -> str:
    """Names of one unit."""
    listed = names if len(names) <= MOST_NAMES else [names[0], '…', names[-1]]
    text = ', '.join(name if name == '…' else f'`{name}`' for name in listed)
    return f'{text} [{unit}]' if unit else text


if __name__ == '__main__':
    for path, text in files().items():
        path.write_text(text, encoding='utf-8')
