"""Units of a joint's quantities: written for joints that turn, and for those that slide what becomes of them."""

from __future__ import annotations

import re

_SLIDING = (('kg m^2', 'kg'), ('N^2 m^2', 'N^2'), ('N m', 'N'), ('rad', 'm'))
_ALONE = re.compile(r'\(([^ ()]+)\)')


def sliding(unit: str) -> str:
    """The unit along a prismatic joint of what has ``unit`` about a turning one: N for N m, N s/m for N m s/rad."""
    for turning, along in _SLIDING:
        unit = unit.replace(turning, along)
    return _ALONE.sub(r'\1', unit)
