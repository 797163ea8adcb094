"""ROS parameter files: reading the section of one node, and writing one with every parameter explained."""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import yaml

from semiparam_ros.atomic_write import write_text
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.parameter_table import BY_NAME, PARAMETERS, Parameter
from semiparam_ros.settings.robot_description import PACKAGE_URI
from semiparam_ros.settings.snapshot import Settings, is_foreign, nearest
from semiparam_ros.settings.yaml_file import read_yaml

WIDTH = 110
LAUNCHED = 'launch_params_'
"""Prefix of the files in which ROS's launch hands over single parameters."""
NO_REMARKS: Mapping[str, Sequence[Sequence[str]]] = {}


class Loader(yaml.SafeLoader):
    """PyYAML takes 1e-7, 1.5e3, 08, inf and y for texts, ROS for numbers and a truth; so do we."""

    bool_values: ClassVar[dict[str, bool]] = {**yaml.SafeLoader.bool_values, 'y': True, 'n': False}


class Dumper(yaml.SafeDumper):
    """Dumper that quotes the texts which without quotes are none to ROS."""


for _kind in (Loader, Dumper):
    _kind.add_implicit_resolver('tag:yaml.org,2002:float', re.compile(
        r'^[-+]?((\d+\.?\d*|\.\d+)[eE][-+]?\d+|0\d*[89]\d*|(?i:inf|infinity|nan))$'), list('-+.0123456789iInN'))
    _kind.add_implicit_resolver('tag:yaml.org,2002:bool', re.compile('^[yYnN]$'), list('yYnN'))


def load_params(path: str | Path | None, node: str = 'estimator') -> Settings:
    """Settings of one node from a ROS parameter file; the sections that ROS hands to it apply in order.

    :param node: its full name, ``/left/estimator``; a bare one is that of the only node of this name in the file.

    Relative paths count from the file: see :func:`located`.

    Raises SemiparamError, naming the file, when it cannot be read or a parameter is refused.
    """
    if path is None:
        return Settings.from_mapping({})
    return located(Settings.from_mapping(read_params(path, node), where=str(path)), [Path(path)])


def located(settings: Settings, files: Sequence[Path]) -> Settings:
    """Settings with relative paths as meant: ``robot_description_file`` beside the first of the
    parameter files that has it there, ``state_folder`` beside the first that gives it.

    Else they stay relative to the working folder.
    """
    description, states = settings.robot_description_file, settings.state_folder
    if _is_relative(description):
        beside = (file.parent / description for file in files)
        description = next((str(path) for path in beside if path.is_file()), description)
    if _is_relative(states):
        states = next((str(file.parent / states) for file in files if _gives(file, 'state_folder', states)), states)
    return replace(settings, robot_description_file=description, state_folder=states)


def _is_relative(path: str) -> bool:
    return bool(path) and not path.startswith((PACKAGE_URI, '~')) and not Path(path).is_absolute()


def _gives(file: Path, name: str, value: object) -> bool:
    """Tell whether a section of a parameter file gives it that launch has not made up somewhere."""
    try:
        sections = _parse(file).values()
    except SemiparamError:
        return False
    found = [body.get('ros__parameters') for body in sections if isinstance(body, dict)]
    return not file.name.startswith(LAUNCHED) and any(
        dict(_flat(parameters, '')).get(name) == value for parameters in found if isinstance(parameters, dict))


def read_params(path: str | Path, node: str = 'estimator') -> dict[str, object]:
    """Read unchecked names (dotted) and values of one node's sections."""
    document = _parse(Path(path))
    values: dict[str, object] = {}
    sections = {name: body for name, body in document.items() if fits(name, node)}
    if not sections:
        found = ', '.join(document) or 'nothing'
        raise SemiparamError(f"{path}: ROS gives no section to the node {node} (found: {found}); "
                             f"expected '{node}:' or '/**:'.")
    if len({name.lstrip('/') for name in sections if '*' not in name}) > 1:
        raise SemiparamError(f"{path}: sections of several nodes ({', '.join(sections)}); expected those of one.")
    for name, body in sections.items():
        values.update(_section(body, name, str(path)))
    return values


def dump_params(settings: Settings, path: str | Path, node: str = 'estimator',
                remarks: Mapping[str, Sequence[Sequence[str]]] = NO_REMARKS) -> None:
    """Write a parameter file that the node and every command load: the whole file or nothing.

    Relative paths, which count from a parameter file, name the same place from the new one.
    """
    folder = Path(path).parent.resolve()  # '..' of a link leads to where the linked folder is
    description, states = (os.path.relpath(_physical(place), folder) if _is_relative(place) else place
                           for place in (settings.robot_description_file, settings.state_folder))
    settings = replace(settings, robot_description_file=description, state_folder=states)
    write_text(path, params_text(settings, node, remarks))


def _physical(place: str) -> Path:
    """A place by its folder's own path, without links; its name stays."""
    return Path(place).parent.resolve() / Path(place).name


def params_text(settings: Settings | None, node: str = 'estimator',
                remarks: Mapping[str, Sequence[Sequence[str]]] = NO_REMARKS) -> str:
    """The parameter file, each value under its explanation.

    :param settings: None for the defaults.
    :param remarks: by the name of a parameter that is a list of texts, lines of comment above each of its items.
    """
    section = node if node.startswith('/') else f'/**/{node}'  # in every namespace
    lines = [f'{section}:', '  ros__parameters:']
    groups: dict[str, list[Parameter]] = {}
    for parameter in PARAMETERS:
        groups.setdefault(parameter.name.rpartition('.')[0], []).append(parameter)
    for group, members in groups.items():
        indent = '      ' if group else '    '
        lines += [f'    {group}:'] if group else []
        for parameter in members:
            lines += textwrap.wrap(_comment(parameter), WIDTH, initial_indent=f'{indent}# ',
                                   subsequent_indent=f'{indent}# ', break_on_hyphens=False)
            name = parameter.name.rpartition('.')[2]
            value: Any = parameter.default if settings is None else getattr(settings, parameter.field)
            if value and parameter.name in remarks:
                lines.append(f'{indent}{name}:')
                lines += _items(value, remarks[parameter.name], f'{indent}  ')
            else:
                lines.append(f'{indent}{name}: {_scalar(value)}')
    return '\n'.join(lines) + '\n'


def _comment(parameter: Parameter) -> str:
    details = [parameter.permitted, f'[{parameter.unit}]' if parameter.unit else '', 'live' if parameter.live else '']
    return f'{parameter.description} ({", ".join(filter(None, [parameter.kind, *details]))})'


def _items(items: Sequence[str], remarks: Sequence[Sequence[str]], indent: str) -> Iterator[str]:
    for item, remark in zip(items, remarks, strict=True):
        for line in remark:
            yield from textwrap.wrap(line, WIDTH, initial_indent=f'{indent}# ', subsequent_indent=f'{indent}#     ',
                                     break_on_hyphens=False)
        yield f"{indent}- '{item.replace(chr(39), 2 * chr(39))}'"


def _scalar(value: object) -> str:
    """One value on one line, as YAML and as ROS reads it."""
    flow = list(value) if isinstance(value, tuple) else value
    text = yaml.dump(flow, Dumper=Dumper, default_flow_style=True, width=2**31, allow_unicode=True)
    return text.removesuffix('...\n').strip()


def _parse(path: Path) -> Mapping[str, object]:
    document = read_yaml(path, 'the parameter file', Loader)
    if not isinstance(document, dict):
        raise SemiparamError(f'{path} holds no parameters; expected a ROS parameter file that starts with estimator:.')
    return dict(_sections(document, ''))


def _sections(tree: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    """Sections by their names, also where a namespace holds them: ``left: {estimator: {ros__parameters: {}}}``."""
    for name, body in tree.items():
        inner = body if isinstance(body, dict) and 'ros__parameters' not in body else {}
        named: list[tuple[str, object]] = [
            (deep, held) for deep, held in _sections(inner, f'{prefix}{name}/')
            if isinstance(held, dict) and 'ros__parameters' in held]
        yield from named or [(f'{prefix}{name}', body)]


def fits(section: str, node: str) -> bool:
    """Return whether ROS hands a section to a node, of a bare name to one in some namespace: a star is one name,
    two are any number of them."""
    stars = {'*': '/[^/]+', '**': '(/[^/]+)*'}
    tokens = section.removeprefix('/').split('/')
    tokens = tokens if '/' in node else ['**', tokens[-1]]
    pattern = ''.join(stars.get(token, '/' + re.escape(token)) for token in tokens)
    return re.fullmatch(pattern, '/' + node.removeprefix('/')) is not None


def _section(body: object, name: str, path: str) -> dict[str, object]:
    parameters = body.get('ros__parameters') if isinstance(body, dict) else None
    if not isinstance(parameters, dict):
        raise SemiparamError(f"{path}: section '{name}' holds no 'ros__parameters:'; expected a ROS parameter file.")
    pairs = list(_flat(parameters, ''))
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [key for key, _ in pairs]
        twice = next(key for key in values if names.count(key) > 1)
        raise SemiparamError(f"{path}: section '{name}' gives {twice} twice; expected one value.")
    for key, value in values.items():
        if isinstance(value, list) and len({type(item) for item in value}) > 1:
            texts = any(isinstance(item, str) for item in value)
            raise SemiparamError(f'{path}: {key} mixes types in one list, which ROS refuses; ' + (
                "write 'y', not y, among texts." if texts else 'write 1.0, not 1, among decimal numbers.'))
    if '*' in name:
        return {key: value for key, value in values.items() if _is_ours(key)}
    return values


def _is_ours(name: str) -> bool:
    """A wildcard section serves other nodes as well: only what could be ours, or a misspelling of it, concerns us."""
    return name in BY_NAME or is_foreign(name) or nearest(name) is not None


def _flat(tree: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value
