"""HTML pages from the templates of this package."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape


def environment() -> Environment:
    """Templates in which everything is escaped and a missing value is an error."""
    return Environment(loader=PackageLoader('semiparam_ros', 'report/templates'), undefined=StrictUndefined,
                       autoescape=select_autoescape(default=True, default_for_string=True), trim_blocks=True,
                       lstrip_blocks=True)
