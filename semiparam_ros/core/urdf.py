"""The few operations on URDF text that pinocchio does not offer: checks, and cutting the tree at a sensor."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

from semiparam_ros.core.urdf_checks import check_tree
from semiparam_ros.errors import SemiparamError

MOVING = ('revolute', 'continuous', 'prismatic')
IGNORED = ('visual', 'collision')
MOST_CHARACTERS = 2_000_000
"""Of a description: ten times the longest of a humanoid."""


def parse(urdf: str) -> ElementTree.Element:
    """The robot element, without meshes and limits, and with unlimited joints written as revolute ones.

    Raises SemiparamError when the text is not a URDF of one tree, or too long.
    """
    if len(urdf) > MOST_CHARACTERS:
        raise SemiparamError(f'the robot description has {len(urdf)} characters; expected at most {MOST_CHARACTERS}.')
    try:
        robot = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise SemiparamError(f'the robot description is not valid XML ({error}); expected a URDF.') from error
    if robot.tag != 'robot' or robot.find('link') is None:
        raise SemiparamError(f'the robot description starts with <{robot.tag}> and holds '
                             f'{len(robot.findall("link"))} links; expected a URDF <robot> with at least one.')
    for link in robot.findall('link'):
        for name in IGNORED:
            for element in link.findall(name):
                link.remove(element)
    check_tree(robot)
    for joint in robot.findall('joint'):
        if joint.get('type') == 'continuous':
            joint.set('type', 'revolute')  # pinocchio would store cos and sin; an angle is what joint states hold
        if joint.get('type') in MOVING:
            _widen_limit(joint)
    return robot


def _widen_limit(joint: ElementTree.Element) -> None:
    """A limit that never binds: the reader demands one, the dynamics do not."""
    for limit in joint.findall('limit'):
        joint.remove(limit)
    ElementTree.SubElement(joint, 'limit', lower='-1e9', upper='1e9', effort='1e9', velocity='1e9')


def joint_types(robot: ElementTree.Element) -> dict[str, str]:
    """Every joint's name and type."""
    return {str(joint.get('name')): str(joint.get('type')) for joint in robot.findall('joint')}


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


def sensor_link(robot: ElementTree.Element, frame: str) -> str:
    """The link whose frame is the sensor's: ``frame`` names that link, or the joint that carries it."""
    links = [str(link.get('name')) for link in robot.findall('link')]
    for joint in robot.findall('joint'):
        if joint.get('name') == frame:
            return _end(joint, 'child')
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
            pending.append(_end(joint, 'child'))
    return ElementTree.tostring(subtree, encoding='unicode')


def _joints_by_parent(robot: ElementTree.Element) -> dict[str, list[ElementTree.Element]]:
    table: dict[str, list[ElementTree.Element]] = {}
    for joint in robot.findall('joint'):
        table.setdefault(_end(joint, 'parent'), []).append(joint)
    return table


def _end(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    assert element is not None  # check_tree saw to it
    return str(element.get('link'))
