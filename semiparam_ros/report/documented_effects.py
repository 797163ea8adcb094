"""The tables of effects in docs/reference/effects.md, written from the classes themselves."""

from __future__ import annotations

import inspect
import re
from itertools import groupby
from pathlib import Path

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.effects import Coefficient, Effect
from semiparam_ros.effects.registry import BUILT_IN
from semiparam_ros.effects.terms import Terms
from semiparam_ros.simulation.robots import ICUB_JOINTS, ICUB_SENSOR, bundled_urdf

BEGIN, END = '<!-- tables of effects: begin -->', '<!-- tables of effects: end -->'
GROUPS = {
    'In wrenches and in efforts': ('wrench', 'effort'), 'In wrenches': ('wrench',), 'In joint efforts': ('effort',)}
HEADER = ('| Kind | Physics | Values that are found | Can be mistaken for | What separates them |\n'
          '|---|---|---|---|---|\n')
MOST_NAMES, MOST_VALUES = 4, 12


def tables() -> str:
    """Tables of the built-in kinds but formulas, one for each set of outputs."""
    return '\n'.join(f'### {title}\n\n{HEADER}' + ''.join(
        _row(kind, _body(outputs[0])) for kind in BUILT_IN
        if kind.outputs == outputs and kind is not Terms) for title, outputs in GROUPS.items())


def with_tables(page: str) -> str:
    """The page with its tables as they should be, between the two marks."""
    return re.sub(f'(?<={re.escape(BEGIN)}\n).*(?={re.escape(END)})', lambda _: tables(), page, flags=re.DOTALL)


def write(repository: str = '.') -> None:
    """Write the tables of docs/reference/effects.md anew."""
    path = Path(repository, 'docs', 'reference', 'effects.md')
    path.write_text(with_tables(path.read_text(encoding='utf-8')), encoding='utf-8')


def _body(outputs: str) -> RigidBody:
    return RigidBody.from_urdf(bundled_urdf().read_text(encoding='utf-8'), ICUB_JOINTS, outputs, ICUB_SENSOR)


def _row(kind: type[Effect], body: RigidBody) -> str:
    rivals = ', '.join(f'`{name}`' for name in kind.mistaken_for)
    cells = (f'`{kind.kind}`', _physics(kind), _values(kind, body), rivals, kind.separated_by)
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |\n'


def _physics(kind: type[Effect]) -> str:
    """Sentence that a user reads of the kind, and the first paragraph of its docstring."""
    first = ' '.join((inspect.getdoc(kind) or '').split('\n\n')[0].split()).replace('``', '`')
    return f'{kind.sentence[0].upper()}{kind.sentence[1:]}. {first}'


def _values(kind: type[Effect], body: RigidBody) -> str:
    """Values that are learnt or calibrated, in every form that the kind has, and those searched."""
    motion = _motion(body)
    tried = [kind.from_values(where, values).finer() for where in kind.places(body) or kind.permitted(body)
             for values in kind.searches(body, motion, where, motion.outputs)]
    forms = dict.fromkeys(_listed([*effect.coefficients(body), *kind.calibrations]) for effect in tried)
    start = ('start_s', 'end_s') if kind.may_start or kind.must_start else ()
    names = dict.fromkeys([*start, *(name for effect in tried for name in effect.parameters)])
    searched = [Coefficient(name, kind().unit_of(name)) for name in names]
    return '; or '.join(forms) + (f'; searched: {_listed(searched)}' if searched else '')


def _motion(body: RigidBody) -> Samples:
    """Motion of every joint, for a kind that looks at it to choose where a search begins."""
    phase = np.linspace(0.0, 30.0, 400)[:, None] * (1.0 + 0.3 * np.arange(body.n_joints))
    outputs = np.sin(5.0 * phase[:, :1]) * np.ones(body.n_outputs)
    return Samples(np.arange(400) * 50_000_000, np.sin(phase), np.cos(phase), -np.sin(phase), outputs, 0,
                   temperature=30.0 + phase[:, :body.n_joints if body.outputs == 'effort' else 1])


def _listed(values: list[Coefficient]) -> str:
    """Names with units, neighbours of the same unit together; a long list by its ends."""
    if len(values) > MOST_VALUES:
        return f'`{values[0].name}`, …, `{values[-1].name}` ({len(values)} values)'
    return ', '.join(_together([value.name for value in group], unit)
                     for unit, group in groupby(values, key=lambda value: value.unit))


def _together(names: list[str], unit: str) -> str:
    shown = names if len(names) <= MOST_NAMES else [names[0], '…', names[-1]]
    text = ', '.join(name if name == '…' else f'`{name}`' for name in shown)
    return f'{text} [{unit}]' if unit else text


if __name__ == '__main__':
    write()
