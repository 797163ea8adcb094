"""What a robot description must be before a library reads it, each failure in one sentence of our own."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

from semiparam_ros.errors import SemiparamError

MOST_LINKS, MOST_JOINTS = 1000, 200
"""Of a robot, and those that move: a humanoid with its fingers has a hundred. More would take minutes and gigabytes."""

TYPES = ('revolute', 'continuous', 'prismatic', 'fixed', 'floating', 'planar')
NUMBERS = {'origin': {'xyz': 3, 'rpy': 3}, 'axis': {'xyz': 3}, 'mass': {'value': 1},
           'inertia': dict.fromkeys(('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'), 1)}


def check_tree(robot: ElementTree.Element) -> None:
    """Raise SemiparamError unless links and joints form one tree with finite numbers."""
    links, joints = _named(robot, 'link'), _named(robot, 'joint')
    moving = sum(joint.get('type') != 'fixed' for joint in joints.values())
    for count, most, what in ((len(links), MOST_LINKS, 'links'), (moving, MOST_JOINTS, 'moving joints')):
        if count > most:
            raise _fault(f'it has {count} {what}; expected at most {most}.')
    parents: dict[str, str] = {}
    for name, joint in joints.items():
        if joint.get('type') not in TYPES:
            raise _fault(f"joint '{name}' has type '{joint.get('type')}'; expected one of {', '.join(TYPES)}.")
        child = _end(joint, 'child', links)
        if child in parents:
            raise _fault(f"link '{child}' is the child of two joints; expected a tree.")
        parents[child] = _end(joint, 'parent', links)
    _check_one_root(links, parents)
    for element in (*links.values(), *joints.values()):
        _check_numbers(element)
        _check_axis(element)
        _check_inertial(element)


def _end(joint: ElementTree.Element, end: str, links: dict[str, ElementTree.Element]) -> str:
    element = joint.find(end)
    name = None if element is None else element.get('link')
    if name is None or name not in links:
        raise _fault(f"joint '{joint.get('name')}' has "
                     + (f'no {end} link.' if name is None else f"the {end} link '{name}', which is not described."))
    return name


def _named(robot: ElementTree.Element, kind: str) -> dict[str, ElementTree.Element]:
    table: dict[str, ElementTree.Element] = {}
    for element in robot.findall(kind):
        name = element.get('name')
        if not name:
            raise _fault(f'a {kind} has no name.')
        if name in table:
            raise _fault(f"two {kind}s are called '{name}'.")
        table[name] = element
    return table


def _check_one_root(links: dict[str, ElementTree.Element], parents: dict[str, str]) -> None:
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        raise _fault(f'{len(roots)} links are nobody\'s child ({", ".join(roots[:4]) or "a loop"}); '
                     'expected one root link.')
    for name in links:
        if not any(ancestor == roots[0] for ancestor in _ancestors(name, parents)):
            raise _fault(f"link '{name}' is part of a loop; expected a tree.")


def _ancestors(name: str, parents: dict[str, str]) -> Iterator[str]:
    """The link and those it hangs on, at most once around a loop."""
    for _ in range(len(parents) + 1):
        yield name
        if name not in parents:
            return
        name = parents[name]


def _check_numbers(element: ElementTree.Element) -> None:
    for part in element.iter():
        for attribute, count in NUMBERS.get(part.tag, {}).items():
            text = part.get(attribute)
            if text is not None and not _is_finite(text, count):
                raise _fault(f"{element.tag} '{element.get('name')}' has {part.tag} {attribute}=\"{text}\"; expected "
                             f'{count} finite number{"s" if count > 1 else ""}.')


def _check_axis(element: ElementTree.Element) -> None:
    axis = element.find('axis')
    if axis is None or element.get('type') not in ('revolute', 'continuous', 'prismatic'):
        return
    if not any(float(word) for word in str(axis.get('xyz', '')).split()):
        raise _fault(f"joint '{element.get('name')}' moves about the axis \"{axis.get('xyz')}\"; expected a direction.")


def _check_inertial(element: ElementTree.Element) -> None:
    inertial = element.find('inertial')
    if inertial is None:
        return
    values = {tag: {} if part is None else part.attrib
              for tag, part in (('mass', inertial.find('mass')), ('inertia', inertial.find('inertia')))}
    for tag, given in values.items():
        missing = [name for name in NUMBERS[tag] if name not in given]
        if missing:
            raise _fault(f"link '{element.get('name')}' has an inertial without {tag} {', '.join(missing)}.")
    if float(values['mass']['value']) < 0.0:
        raise _fault(f"link '{element.get('name')}' has a negative mass ({values['mass']['value']} kg).")


def _is_finite(text: str, count: int) -> bool:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return False
    return len(values) == count and all(math.isfinite(value) for value in values)


def _fault(sentence: str) -> SemiparamError:
    return SemiparamError(f'robot description: {sentence}')
