"""Reading YAML files that people write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from yaml.reader import ReaderError

from semiparam_ros.errors import SemiparamError


def read_yaml(path: Path, what: str, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """The document of a file; one that cannot be read raises SemiparamError with ``what`` it is and the line."""
    try:
        reader = loader(path.read_text(encoding='utf-8'))
        node = reader.get_single_node()
        return node and reader.construct_object(node, deep=True)  # deep: a node that holds itself is refused
    except OSError as error:
        raise SemiparamError(f'cannot read {what} {path}: {error.strerror}.') from error
    except RecursionError as error:
        raise SemiparamError(f'{what} {path} is nested too deep; expected names and their values.') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, 'problem_mark', None)
        line = f' in line {mark.line + 1}' if mark else ''
        raise SemiparamError(f'{what} {path} is not valid YAML{line}: {_problem(error)}.') from error


def _problem(error: yaml.YAMLError | UnicodeDecodeError) -> str:
    if isinstance(error, UnicodeDecodeError):
        return 'not UTF-8 text'
    if isinstance(error, ReaderError):
        return f'it holds the character {chr(error.character)!r}'
    return str(getattr(error, 'problem', None) or error)
