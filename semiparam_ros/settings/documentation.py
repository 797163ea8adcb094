"""The page docs/parameters.md, written from the table."""

from __future__ import annotations

from pathlib import Path

from semiparam_ros.settings.files import params_text
from semiparam_ros.settings.parameter_table import PARAMETERS, Parameter, shown
from semiparam_ros.settings.rules import RULES

HEADER = """# Parameters

Made from the table in `semiparam_ros/settings/parameter_table.py` by `python -m semiparam_ros.settings.documentation`;
edit it there. One file configures the node (`semiparam run --params FILE`, or `--ros-args --params-file FILE`)
and every offline command (`--params FILE`). `config/estimator.yaml` holds every parameter at its default.

A parameter marked *live* may change while the node runs (`ros2 param set`); the others are read at the start.
A value that is refused leaves everything as it was, and the answer gives the reason in one sentence. ROS tells numbers
by their spelling; here `1` is accepted for `1.0`. An empty list means "not given".

| Parameter | Default | | Meaning |
|---|---|---|---|
"""


def page() -> str:
    """The whole page."""
    rules = '\n'.join(f'- {(rule.__doc__ or rule.__name__).strip()} (`{rule.__name__}`)' for rule in RULES)
    return HEADER + '\n'.join(map(_row, PARAMETERS)) + f'\n\n## Rules across parameters\n\n{rules}\n'


def write_all(repository: str = '.') -> None:
    """Write docs/parameters.md and config/estimator.yaml anew."""
    Path(repository, 'docs', 'parameters.md').write_text(page(), encoding='utf-8')
    Path(repository, 'config', 'estimator.yaml').write_text(params_text(None), encoding='utf-8')


def _row(parameter: Parameter) -> str:
    kind = ', '.join(filter(None, [parameter.kind, parameter.permitted, parameter.unit and f'[{parameter.unit}]']))
    cells = [f'`{parameter.name}`', f'`{shown(parameter.default)}`', '*live*' if parameter.live else '',
             f'{parameter.description} ({kind})']
    return '| ' + ' | '.join(cells) + ' |'


if __name__ == '__main__':
    write_all()
