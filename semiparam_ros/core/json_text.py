"""JSON that people write into parameters."""

from __future__ import annotations

import json
from typing import Any


def parse(text: str) -> Any:
    """The value of a text; raises ValueError or RecursionError for what is none, also where a name has two values."""
    return json.loads(text, object_pairs_hook=_distinct)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f'{next(name for name in names if names.count(name) > 1)!r} is there twice')
    return values
