"""The immutable snapshot of all parameters that an estimator works from."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.parameter_table import AUTO, BY_NAME, PARAMETERS, ROS_NAMES, ROS_PREFIXES, Table
from semiparam_ros.settings.rules import broken_rule


@dataclass(frozen=True)
class Settings(Table):
    """Settings: every parameter as an attribute, dots as underscores: ``settings.features_count``.

    ``Settings(...)`` takes the values unchecked, for tests and for code; :meth:`from_mapping`
    checks them.
    """

    @classmethod
    def from_mapping(cls, values: Mapping[str, object], where: str = '') -> Settings:
        """Check parameter names and values and return the settings, the others at their defaults.

        :param where: named in errors, such as the parameter file.

        Raises SemiparamError for an unknown name, a wrong type or range, and a broken rule.
        """
        settings = cls().changed({'outputs': AUTO, **values}, where)
        if (sentence := broken_rule(settings)) is not None:
            raise SemiparamError(located(sentence, where))
        return settings

    def changed(self, values: Mapping[str, object], where: str = '') -> Settings:
        """Replace some settings; each value is checked by itself, the rules across are not."""
        fields: dict[str, Any] = {}
        for name, value in values.items():
            if is_foreign(name):
                continue
            if name not in BY_NAME:
                raise SemiparamError(located(unknown_name(name), where))
            converted = BY_NAME[name].convert(value)
            if (sentence := BY_NAME[name].refusal(converted)) is not None:
                raise SemiparamError(located(sentence, where))
            fields[BY_NAME[name].field] = converted
        return replace(self, **fields)

    def mapping(self) -> dict[str, object]:
        """Parameter name to value, in the order of the table."""
        return {parameter.name: getattr(self, parameter.field) for parameter in PARAMETERS}


def refusal(settings: Settings, changes: Mapping[str, object]) -> str | None:
    """Reason why a change to valid settings is refused, as one sentence, or None."""
    for name in changes:
        if name in BY_NAME and not BY_NAME[name].live:
            return f'{name} cannot change while the node runs; start it again with the new value.'
    try:
        return broken_rule(settings.changed(changes))
    except SemiparamError as error:
        return str(error)


def unknown_name(name: str) -> str:
    """A sentence that names the nearest valid parameter."""
    near = nearest(name)
    hint = f"; the nearest is '{near}'" if near else '; docs/parameters.md lists them all'
    return f"there is no parameter '{name}'{hint}."


def nearest(name: str) -> str | None:
    """The known name that a misspelt one most resembles, or None when none is near."""
    plain = {known.replace('.', '_').lower(): known for known in BY_NAME}
    close = difflib.get_close_matches(name.replace('.', '_').lower(), plain, n=1, cutoff=0.6)
    return plain[close[0]] if close else None


def is_foreign(name: str) -> bool:
    """Parameters of rclpy itself, which stand in the same files."""
    return name in ROS_NAMES or name.startswith(ROS_PREFIXES)


def located(sentence: str, where: str) -> str:
    """Name the place before the sentence."""
    return f'{where}: {sentence}' if where else sentence
