"""Parameters that ROS is given several times: the last value counts, of whatever type.

rcl keeps the values of a section by their types, and of a parameter that has an integer there and a decimal number it
takes the integer: ``10`` of a file stayed although the command line said ``20.0``, and ``100`` although it said
``auto``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import yaml

from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.files import Loader, fits, read_params
from semiparam_ros.settings.parameter_table import BY_NAME
from semiparam_ros.settings.yaml_file import document

FILE, RULES = '--params-file', ('-p', '--param')


def last_words(ros_arguments: Sequence[str], node: str) -> dict[str, object]:
    """Values of our parameters that files and rules give a node of this full name more than once, as the last does."""
    values: dict[str, object] = {}
    counts: Counter[str] = Counter()
    for option, argument in pairwise(ros_arguments):
        given = _of_file(argument, node) if option == FILE else _of_rule(argument, node) if option in RULES else {}
        values.update(given)
        counts.update(given.keys())
    return {name: value for name, value in values.items() if counts[name] > 1 and name in BY_NAME}


def _of_file(path: str, node: str) -> Mapping[str, object]:
    with suppress(SemiparamError):  # what is wrong with it others say
        return read_params(Path(path), node)
    return {}


def _of_rule(rule: str, node: str) -> Mapping[str, object]:
    """Read ``[NODE:]NAME:=VALUE``."""
    left, _, text = rule.partition(':=')
    section, _, name = left.rpartition(':')
    if section and not fits(section, node):
        return {}
    with suppress(yaml.YAMLError, RecursionError):
        return {name: document(text, Loader)}
    return {}
