"""URDF text: checked before a library reads it, its joints, and cutting the tree at a sensor."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence

from semiparam_ros.errors import SemiparamError, listed

MOST_LINKS, MOST_JOINTS = 1000, 200
"""Of a robot, and those that move: a humanoid with its fingers has a hundred. More would take minutes and gigabytes."""

MOVING = ('revolute', 'continuous', 'prismatic')
TYPES = (*MOVING, 'fixed', 'floating', 'planar')
NUMBERS = {'origin': {'xyz': 3, 'rpy': 3}, 'axis': {'xyz': 3}, 'mass': {'value': 1},
           'mimic': {'multiplier': 1, 'offset': 1},
           'inertia': dict.fromkeys(('ixx', 'ixy', 'ixz', 'iyy', 'iyz', 'izz'), 1)}

IGNORED = {'link': ('visual', 'collision'), 'joint': ('dynamics',)}
"""What no rigid body needs: the reader refuses a robot for values there."""
MOST_CHARACTERS = 2_000_000
"""Of a description: ten times the longest of a humanoid."""
MOST_DEPTH = 100
"""Of elements within each other: whoever writes or copies them calls itself once for each."""
UNIVERSE = 'universe'
"""Pinocchio's name for what the root hangs on."""
SENSOR, ROOT = 'semiparam_sensor', 'semiparam_root'
"""Names of the frame of a wrench sensor, and of the joint by which the bodies beyond it hang there."""
TAKEN = (UNIVERSE, SENSOR, ROOT)
"""Names that nothing else may have."""
FARTHEST_M = 1e4
"""Of an origin from what it is told of: beyond, numbers lose the digits that inertias need."""
MOST = {'origin': FARTHEST_M, 'mass': 1e9, 'inertia': 1e9}
"""Of numbers by their element: what bodies add up to, and their squares, stay numbers."""

XACRO = '/xacro}'
"""End of the name space of what is left of a description that was not expanded."""

NO_LIMIT = '1e9'
SAME_PLACE = 1e-9
"""[rad, m] Rounding of a joint's position."""


def parse(urdf: str) -> ElementTree.Element:
    """The robot element, without meshes and limits, and with unlimited joints written as revolute ones.

    Raises SemiparamError when the text is not a URDF of one tree, or too long.
    """
    if len(urdf) > MOST_CHARACTERS:
        raise SemiparamError(f'the robot description has {len(urdf)} characters; expected at most {MOST_CHARACTERS}.')
    try:
        robot = ElementTree.fromstring(urdf)
    except (ElementTree.ParseError, UnicodeEncodeError) as error:
        raise SemiparamError(f'the robot description is not valid XML ({error}); expected a URDF.') from error
    _check_depth(robot)
    if any(XACRO in str(element.tag) for element in robot.iter()):
        raise SemiparamError('the robot description is xacro, which is no URDF yet; expand it first, by xacro FILE > '
                             'FILE.urdf, and give what comes out.')
    if robot.tag != 'robot' or robot.find('link') is None:
        raise SemiparamError(f'the robot description starts with <{robot.tag}> and holds '
                             f'{len(robot.findall("link"))} links; expected a URDF <robot> with at least one.')
    for kind, names in IGNORED.items():
        for owner in robot.findall(kind):
            for element in [each for name in names for each in owner.findall(name)]:
                owner.remove(element)
    check_tree(robot)
    for joint in robot.findall('joint'):
        if joint.get('type') == 'continuous':
            joint.set('type', 'revolute')  # pinocchio would store cos and sin; an angle is what joint states hold
        if joint.get('type') in MOVING:
            _widen_limit(joint)
    return robot


def joint_types(robot: ElementTree.Element) -> dict[str, str]:
    """Every joint's name and type."""
    return {str(joint.get('name')): str(joint.get('type')) for joint in robot.findall('joint')}


def unfollowed_joints(robot: ElementTree.Element) -> tuple[str, ...]:
    """Names of the joints that may move, but have no single position that a joint state could hold."""
    return tuple(name for name, kind in joint_types(robot).items() if kind not in (*MOVING, 'fixed'))


def misled_joints(robot: ElementTree.Element, joints: Sequence[str], locked: Mapping[str, float]) -> tuple[str, ...]:
    """Names of the mimic joints that are held elsewhere than their leaders put them, each with its leader."""
    found, types = list[str](), joint_types(robot)
    for joint in robot.findall('joint'):
        name, mimic = str(joint.get('name')), joint.find('mimic')
        leader = '' if mimic is None else str(mimic.get('joint'))
        if mimic is None or name in joints or types.get(leader) not in MOVING:
            continue
        multiplier, offset = float(mimic.get('multiplier', 1.0)), float(mimic.get('offset', 0.0))
        place = multiplier * locked.get(leader, 0.0) + offset
        if leader in joints or not math.isclose(place, locked.get(name, 0.0), abs_tol=SAME_PLACE):
            found.append(f'{name} (of {leader})')
    return tuple(found)


def remark(robot: ElementTree.Element, joints: Sequence[str], locked: Mapping[str, float]) -> str:
    """Sentences about joints that are held where they may not be; '' without any."""
    loose, misled, sentences = unfollowed_joints(robot), misled_joints(robot, joints, locked), list[str]()
    if loose:
        sentences.append(f'the robot description has joints that are floating or planar, {listed(loose)}, which are '
                         'held at zero, for no joint state follows them. Where they move, what is predicted and found '
                         'is wrong.')
    if misled:
        sentences.append(f'the robot description has joints that mimic others, {listed(misled)}, but are held where '
                         'these do not put them. Where they move a mass, what is predicted and found is wrong; '
                         'expected them among joints, with joint states that hold their positions, or, beside a leader '
                         'that is locked, among locked_joints.')
    return ' '.join(sentences)


def check_joints(robot: ElementTree.Element, joints: Sequence[str]) -> None:
    """Raise SemiparamError unless every name is a distinct moving joint of the robot."""
    types = joint_types(robot)
    moving = [name for name, kind in types.items() if kind in MOVING]
    if not joints:
        raise SemiparamError(f'no joints are named; expected some of: {", ".join(moving)}.')
    for name in joints:
        if name not in types:
            raise SemiparamError(f"joint '{name}' is not in the robot description; its moving joints are: "
                                 f'{", ".join(moving)}.')
        if types[name] not in MOVING:
            raise SemiparamError(f"joint '{name}' is {types[name]}; expected a revolute, continuous or prismatic one.")
    if len(set(joints)) != len(joints):
        raise SemiparamError(f'a joint is named twice in {", ".join(joints)}; expected distinct names.')


def check_output_joints(joints: Sequence[str], output_joints: Sequence[str]) -> None:
    """Raise SemiparamError when an effort is to be predicted of a joint that does not move."""
    for name in output_joints:
        if name not in joints:
            raise SemiparamError(f"output_joints names '{name}'; expected some of the joints {', '.join(joints)}.")


def sensor_link(robot: ElementTree.Element, frame: str) -> str:
    """The link whose frame is the sensor's: ``frame`` names that link, or the joint that carries it."""
    links = [str(link.get('name')) for link in robot.findall('link')]
    for joint in robot.findall('joint'):
        if joint.get('name') == frame:
            return _linked(joint, 'child')
    if frame in links:
        return frame
    likely = [name for name in (*joint_types(robot), *links) if 'sensor' in name or 'ft' in name.split('_')]
    hint = f'; names that look like a sensor: {", ".join(likely[:8])}' if likely else ''
    raise SemiparamError(f"sensor frame '{frame}' is neither a link nor a joint of the robot description{hint}.")


def distal_subtree(robot: ElementTree.Element, root: str) -> str:
    """URDF text of link ``root`` and everything after it: the bodies that hang on the sensor."""
    children = _joints_by_parent(robot)
    subtree = ElementTree.Element('robot', name='distal')
    links = {link.get('name'): link for link in robot.findall('link')}
    pending = [root]
    while pending:
        name = pending.pop()
        subtree.append(links[name])
        for joint in children.get(name, ()):
            subtree.append(joint)
            pending.append(_linked(joint, 'child'))
    return ElementTree.tostring(subtree, encoding='unicode')


def _joints_by_parent(robot: ElementTree.Element) -> dict[str, list[ElementTree.Element]]:
    table: dict[str, list[ElementTree.Element]] = {}
    for joint in robot.findall('joint'):
        table.setdefault(_linked(joint, 'parent'), []).append(joint)
    return table


def _linked(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    assert element is not None  # check_tree saw to it
    return str(element.get('link'))


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


def _check_depth(robot: ElementTree.Element) -> None:
    level = [robot]
    for _ in range(MOST_DEPTH):
        level = [child for element in level for child in element]
        if not level:
            return
    raise _fault(f'elements lie more than {MOST_DEPTH} deep within each other.')


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
        if name in TAKEN:
            raise _fault(f"a {kind} is called '{name}', a name that is taken; rename it.")
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
            if text is None:
                continue
            part.set(attribute, ' '.join(text.split()))  # a link of the mass " 1.5" has none to the reader
            most = MOST.get(part.tag, math.inf)
            if max(map(abs, map(float, text.split()))) > most:
                raise _fault(f"{element.tag} '{element.get('name')}' has {part.tag} {attribute}=\"{text}\"; expected "
                             f'numbers up to {most:g}.')


def _check_axis(element: ElementTree.Element) -> None:
    axis = element.find('axis')
    if axis is None or element.get('type') not in MOVING:
        return
    if not any(float(word) for word in str(axis.get('xyz', '')).split()):
        raise _fault(f"joint '{element.get('name')}' moves about the axis \"{axis.get('xyz')}\"; expected a direction.")
    values = [float(word) for word in str(axis.get('xyz')).split()]
    exponent = math.frexp(max(map(abs, values)))[1] - 1
    # Squares of 1e-200 are zero, and those of 1e200 infinite: to the reader, such an axis is none.
    axis.set('xyz', ' '.join(repr(math.ldexp(value, -exponent)) for value in values))


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
    if '_' in text or not text.isascii():  # Python reads 1_0 and digits of other scripts
        return False
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return False
    return len(values) == count and all(math.isfinite(value) for value in values)


def _fault(sentence: str) -> SemiparamError:
    return SemiparamError(f'robot description: {sentence}')


def _widen_limit(joint: ElementTree.Element) -> None:
    """Limits of position and speed that never bind: the reader demands them, the dynamics do not. That of the effort
    stays where it is one: feedforward keeps to it."""
    effort = NO_LIMIT
    for limit in joint.findall('limit'):
        joint.remove(limit)
        text = limit.get('effort', '')
        if _is_finite(text, 1) and 0.0 < float(text) < float(NO_LIMIT):
            effort = text.strip()
    ElementTree.SubElement(joint, 'limit', lower=f'-{NO_LIMIT}', upper=NO_LIMIT, effort=effort, velocity=NO_LIMIT)
