"""Reading YAML files that people write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from yaml.constructor import ConstructorError
from yaml.reader import ReaderError

from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.text_file import read_text

_MERGE = 'tag:yaml.org,2002:merge'
_OF_MAPPINGS = (_MERGE, 'tag:yaml.org,2002:value')
"""Tags of the keys << and =, which stand for no value."""


def read_yaml(path: Path, what: str, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """The document of a file; one that cannot be read raises SemiparamError with ``what`` it is and the line."""
    try:
        return document(read_text(path), loader)
    except OSError as error:
        raise SemiparamError(f'cannot read {what} {path}: {error.strerror}.') from error
    except RecursionError as error:
        raise SemiparamError(f'{what} {path} is nested too deep; expected names and their values.') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, 'problem_mark', None)
        line = f' in line {mark.line + 1}' if mark else ''
        raise SemiparamError(f'{what} {path} is not valid YAML{line}: {_problem(error)}.') from error


def document(text: str, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """The document of a text; raises yaml.YAMLError or RecursionError for what is none, also where a name has two
    values, or aliases of aliases hold more than the text has letters."""
    reader = loader(text)
    node = reader.get_single_node()
    if node is None:
        return None
    sizes = dict[int, int]()
    if _check(reader, node, sizes) > max(len(text), len(sizes)):
        raise ConstructorError(None, None, 'its aliases hold more than the whole file', node.start_mark)
    return reader.construct_object(node, deep=True)  # deep: a node that holds itself is refused


def _check(reader: yaml.SafeLoader, node: yaml.Node, sizes: dict[int, int]) -> int:
    """Return how many nodes there are from a node on, one that is named again counting again."""
    if id(node) not in sizes:
        sizes[id(node)] = 1
        if isinstance(node, yaml.MappingNode):
            _require_distinct(node)
            parts = [part for pair in node.value for part in pair]
        else:
            parts = node.value if isinstance(node, yaml.SequenceNode) else []
        sizes[id(node)] = 1 + sum(_check(reader, part, sizes) for part in parts)
        if isinstance(node, yaml.ScalarNode) and node.tag not in _OF_MAPPINGS:
            _require_value(reader, node)
    return sizes[id(node)]


def _require_distinct(node: yaml.MappingNode) -> None:
    seen = set[tuple[str, str]]()
    for key, _ in node.value:
        if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
            if (key.tag, key.value) in seen:
                raise ConstructorError(None, None, f'{key.value!r} is there twice', key.start_mark)
            seen.add((key.tag, key.value))


def _require_value(reader: yaml.SafeLoader, node: yaml.ScalarNode) -> None:
    """Raise a yaml.YAMLError for what looks like a number or a time and is none, which PyYAML tells in many ways."""
    try:
        reader.construct_object(node)
    except yaml.YAMLError:
        raise
    except Exception as error:
        kind = node.tag.rpartition(':')[2]
        raise ConstructorError(None, None, f'{node.value!r} is no {kind}', node.start_mark) from error


def _problem(error: yaml.YAMLError | UnicodeDecodeError) -> str:
    if isinstance(error, UnicodeDecodeError):
        return 'not UTF-8 text'
    if isinstance(error, ReaderError):
        return f'it holds the character {chr(error.character)!r}'
    return str(getattr(error, 'problem', None) or error)
