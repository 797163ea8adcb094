"""Edits to a URDF before pinocchio reads it: a sensor that becomes a joint, joints without full turns."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import TypeAlias

import pinocchio as pin

from semiparam_ros.errors import SemiparamError

Element: TypeAlias = ElementTree.Element
MOVING = ('revolute', 'continuous', 'prismatic')
MAX_ANGLE = '3.141592653589793'


def parse(urdf: str) -> Element:
    """URDF text -> its ``robot`` element; anything else raises SemiparamError."""
    try:
        robot = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise SemiparamError(f'the robot description is not XML: {error}.') from error
    if robot.tag != 'robot':
        raise SemiparamError(f"the robot description begins with <{robot.tag}>; expected a URDF's <robot>.")
    children = [child.get('link') for child in robot.findall('joint/child')]
    for name in children:
        if children.count(name) > 1:  # pinocchio follows the loop until the process dies
            raise SemiparamError(f"link '{name}' of the robot description is the child of two joints; expected a tree.")
    for element in robot.iterfind('link/inertial/*'):
        for name, value in element.items():
            element.set(name, ' '.join(value.split()))  # pinocchio reads a mass of '1.5 ' as none
    return robot


def build(robot: Element) -> pin.Model:
    """pinocchio's model of an edited URDF."""
    try:
        return pin.buildModelFromXML(ElementTree.tostring(robot, encoding='unicode'))
    except (ValueError, RuntimeError) as error:
        raise SemiparamError(f'the robot description cannot be built: {error}.') from error


def single_turn(robot: Element) -> Element:
    """Continuous joints become revolute within one turn: their position is one number then, as encoders give it."""
    for joint in robot.findall('joint'):
        if joint.get('type') == 'continuous':
            _make_revolute(joint)
    return robot


def turning_joints(robot: Element) -> tuple[str, ...]:
    """The joints that turn of their own accord, in the order of the URDF."""
    return tuple(joint.get('name', '') for joint in robot.findall('joint')
                 if joint.get('type') in ('revolute', 'continuous') and joint.find('mimic') is None)


def check_joints(robot: Element, joints: Sequence[str]) -> None:
    """Raise SemiparamError unless each name is a moving joint of the URDF, and none comes twice."""
    moving = {joint.get('name', '') for joint in robot.findall('joint') if joint.get('type') in MOVING}
    if not joints:
        raise SemiparamError('joints is empty; expected the names of the moving joints.')
    for name in joints:
        if name not in moving:
            raise SemiparamError(f"the URDF has no moving joint '{name}'; it has {', '.join(sorted(moving))}.")
    if len(set(joints)) < len(joints):
        raise SemiparamError(f"joints names one joint twice: {', '.join(joints)}.")


def free_sensor_joint(robot: Element, frame: str) -> str:
    """Turn the fixed joint of a sensor into a joint and return its name.

    ``frame`` is that joint or its child link. A link that hangs on a moving joint has the sensor in that joint.
    """
    for joint in robot.findall('joint'):
        child = joint.find('child')
        if frame in (joint.get('name'), child.get('link') if child is not None else None):
            if joint.get('type') not in MOVING:
                _make_revolute(joint)
            return str(joint.get('name'))
    raise SemiparamError(f"the URDF has no frame '{frame}' to put the force/torque sensor in.")


def massive_links(robot: Element) -> set[str]:
    """Names of the links whose mass is not zero."""
    masses = {link.get('name', ''): link.find('inertial/mass') for link in robot.findall('link')}
    return {name for name, mass in masses.items() if mass is not None and float(mass.get('value', 0)) > 0}


def _make_revolute(joint: Element) -> None:
    joint.set('type', 'revolute')
    speed = '1e3'
    for tag in ('limit', 'mimic'):
        for old in joint.findall(tag):
            speed = old.get('velocity', speed)
            joint.remove(old)
    axis = joint.find('axis')
    if axis is None or not any(float(value) for value in axis.get('xyz', '1 0 0').split()):
        for old in joint.findall('axis'):
            joint.remove(old)
        ElementTree.SubElement(joint, 'axis', xyz='0 0 1')
    ElementTree.SubElement(joint, 'limit', lower=f'-{MAX_ANGLE}', upper=MAX_ANGLE, effort='1e3', velocity=speed)
